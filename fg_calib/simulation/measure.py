"""What the instruments of a scenario measure of the true arm, with their noise, and where landmarks truly are.

With R, p the true tool frame in the base (where the joints stand, not their readings), n independent normal noise:

| instrument | measures |
|---|---|
| tracker | `X (p + R t) + n`, X of its station, t the target; orientations `X R exp(n)` |
| pairs | `abs(|p_b - p_a| + n)`, and the angle of `R_a^T R_b` plus n, reflected at 0 and 180 degrees |
| lengths to anchors | `abs(|p - a| + offset + n)`; in contact 0, where `p = a + n` |
| distances from planes | `normal . p - distance + n`; in contact 0, where that holds at the tool point |
| boards | `exp(n) R^T B` and `R^T (b - p) + n`, along and about the camera's axes |
| pixels | the image of `R^T (B c + b - p)`, or of `X (p + R c)` by a fixed camera, plus n |
| sockets | nothing: `p = socket + n`; their distances from each other plus n |

Every draw has a generator of its own, by the seed and the name of what is drawn: changing one leaves the others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fg_calib.inputs import Booleans, Floats, InputError, Integers
from fg_calib.measurements import (
    INSTRUMENTS,
    Groups,
    KnownPoint,
    Labels,
    Measurements,
    Noise,
    Pairs,
    Table,
    form_pairs,
    no_pairs,
)
from fg_calib.measurements.kinds import Camera
from fg_calib.options import PAIR_MODELS, POSE_MODELS, FrameKnowledge
from fg_calib.robot import N_STARTS, Poses, Robot, pose, solve_inverse
from fg_calib.simulation.scenario import (
    BoardCamera,
    BoardViews,
    Configurations,
    Indicator,
    Instrument,
    LengthGauge,
    PairGauge,
    Placement,
    PlainInstrument,
    Plane,
    Sockets,
    Spot,
    Tracker,
    frame_knowledge,
)

MAX_BASE_M = 5.0
"""How far from the world's origin an unknown frame puts the base, along each axis, [m]."""

Truth = Mapping[str, Mapping[str, Any]]
"""Where landmarks truly are, by kind and name: `Spot`, `Plane`, `Placement`; offsets of instruments, [m]."""


def generator_of(seed: int, *names: str) -> np.random.Generator:
    """The generator of what has these names."""
    return np.random.default_rng([seed, *"\n".join(names).encode()])


@dataclass(frozen=True)
class Visits:
    """Configurations that the arm was sent to.

    Attributes:
        readings: Joint readings, shape (n, n_joints), [rad] (prismatic: [m]).
        true_readings: Where the joints stood, of the same shape.
        ids: Name of each, shape (n,).
        test: Which are for test rows, shape (n,).
    """

    readings: Floats
    true_readings: Floats
    ids: NDArray[np.str_]
    test: Booleans

    def __len__(self) -> int:
        return len(self.test)

    def select(self, rows: Integers | Booleans) -> Visits:
        """Some of them."""
        return Visits(*(getattr(self, f.name)[rows] for f in fields(Visits)))

    @staticmethod
    def joined(parts: Sequence[Visits]) -> Visits:
        """Visits one after the other."""
        return Visits(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Visits)))


@dataclass(frozen=True)
class Scene:
    """What an instrument measures, and how well.

    Attributes:
        robot: The nominal robot.
        true_robot: The true one.
        visits: Where it was sent.
        configurations: What these came from.
        noise: True noise.
        stated_noise: Noise that the calibration is given.
        sigma_joint: Noise of the readings that the calibration is given, shape (n_joints,), [rad] (prismatic: [m]).
        frame: world_T_base.
        known_frame: Whether the calibration knows that it is the base.
        seed: Seed of all draws.
        source: The scenario, for messages.
        leave_out: Whether configurations are left out from which a point to touch is not reached.
    """

    robot: Robot
    true_robot: Robot
    visits: Visits
    configurations: Configurations
    noise: Noise
    stated_noise: Noise
    sigma_joint: Floats
    frame: Placement
    known_frame: bool
    seed: int
    source: str = "scenario"
    leave_out: bool = False


def measure(instrument: Instrument, scene: Scene) -> tuple[Table, Truth]:
    """Measure with an instrument: its table, and where landmarks truly are.

    Raises:
        InputError: A value of the noise is missing, nothing is seen, or a point is not reached.
    """
    work = _Work(instrument, scene)
    methods: dict[type, Any] = {
        Tracker: work.poses,
        PairGauge: work.pairs,
        LengthGauge: work.lengths,
        Indicator: work.distances,
        Sockets: work.contacts,
        BoardCamera: work.boards if instrument.model == "board" else work.pixels,
        PlainInstrument: work.plain,
    }
    if type(instrument) not in methods:
        raise InputError("instruments", f"found a {type(instrument).__name__}", "an instrument of fg_calib")
    found: tuple[Table, Truth] = methods[type(instrument)](instrument)
    return found


def draw_frame(generator: np.random.Generator) -> Placement:
    """Draw a frame within `MAX_BASE_M`, of any rotation."""
    rotation = Rotation.from_quat(generator.normal(size=4)).as_matrix()  # any rotation as likely as any other
    return Placement(rotation, generator.uniform(-MAX_BASE_M, MAX_BASE_M, 3))


class _Work:
    """One instrument at work."""

    def __init__(self, instrument: Instrument, scene: Scene) -> None:
        self.name, self.model, self.scene, self.visits = instrument.name, instrument.model, scene, scene.visits
        self.place = f"{scene.source}: instruments: {self.name}"
        self.places = generator_of(scene.seed, self.name, "places")

    # --- for all instruments ---

    def at(self) -> Poses:
        """True poses of the tool."""
        return pose(self.scene.true_robot, self.visits.true_readings)

    def noise(self, kind: str, *shape: int) -> Floats:
        """Noise of a kind: standard normal numbers times sigma, so that another sigma scales the same noise."""
        sigma = self._value(self.scene.noise, kind)
        return sigma * generator_of(self.scene.seed, self.name, "noise", kind).normal(size=shape)

    def stated(self, kind: str, *shape: int) -> Floats:
        """The sigma of a kind that the calibration is given.

        Raises:
            InputError: It is 0.
        """
        sigma = self._value(self.scene.stated_noise, kind)
        if sigma == 0.0:
            hint = f"a calibration takes nothing for exact: specify what to assume under job: noise: {kind}"
            raise InputError(f"{self.place}: noise: {kind}", "found 0", "a number above 0", hint)
        return np.full(shape, sigma)

    def _value(self, noise: Noise, kind: str) -> float:
        value = noise.get(kind)
        if value is None:
            raise InputError(f"{self.place}: noise: {kind}", "found none", f"1 sigma, for model {self.model}")
        return float(value)

    def rows(self, k: Integers | None = None, **measured: Any) -> Measurements:
        """Measurements at the configurations, or at those that rows are of."""
        visits = self.visits if k is None else self.visits.select(k)
        nothing: dict[str, Any] = dict.fromkeys(("position", "rotation", "sigma_position", "sigma_orientation"))
        return Measurements(
            readings=visits.readings,
            ids=visits.ids,
            test=visits.test,
            sigma_joint=self.scene.sigma_joint,
            source=f"{self.name}.csv",
            named=True,
            **nothing | measured,
        )

    def nominal(self) -> Poses:
        """Nominal poses of the tool at the train configurations."""
        return pose(self.scene.robot, self.visits.readings[~self.visits.test])

    def workspace(self) -> tuple[Floats, float]:
        """Middle and radius of the nominal tool points, [m]."""
        points = self.nominal().position
        middle = points.mean(axis=0)
        radius = float(np.sqrt(np.mean(np.sum((points - middle) ** 2, axis=1))))
        return middle, max(radius, 1e-3)

    def directions(self, n: int) -> Floats:
        """Unit vectors in any direction, shape (n, 3)."""
        v = self.places.normal(size=(n, 3))
        unit: Floats = v / np.linalg.norm(v, axis=1, keepdims=True)
        return unit

    def named(self, what: str, places: Sequence[Any]) -> dict[str, Any]:
        """Landmarks that are drawn, by names that no other instrument has."""
        stem = self.name if what in self.name else f"{self.name} {what}"
        return {f"{stem} {i + 1}": place for i, place in enumerate(places)}

    def spots(self, given: Mapping[str, Spot] | int, what: str, *, within_reach: bool) -> Mapping[str, Spot]:
        """Points by name, drawn where there is only a number of them."""
        if isinstance(given, Mapping):
            return given
        if within_reach:  # half of the train configurations: those from which the arm moves best
            at = self.nominal()
            slowest = np.linalg.svd(at.jacobian[:, 3:, -self.scene.robot.n_joints :], compute_uv=False)[:, -1]
            inside = at.position[slowest >= np.median(slowest)]
            places = inside[self.places.choice(len(inside), given, replace=given > len(inside))]
        else:
            middle, radius = self.workspace()
            places = middle + radius * self.places.uniform(0.5, 1.5, (given, 1)) * self.directions(given)
        return self.named(what, [Spot(p) for p in places])

    def known(self, spots: Mapping[str, Spot]) -> dict[str, KnownPoint]:
        """What the calibration knows of points: they are off by their tolerances."""
        found = {}
        for name, spot in spots.items():
            if spot.tolerance is not None:
                off = spot.tolerance * generator_of(self.scene.seed, "known", name).normal(size=3)
                found[name] = KnownPoint(spot.xyz + off, spot.tolerance or None)
        return found

    def touch(self, points: Floats, n_starts: int = N_STARTS) -> Booleans:
        """Move the arm from each configuration until the tool point is at a point; which are reached, shape (n,).

        The table holds the reading, so the encoders' error is subtracted from where the joints then stand.
        """
        before, generator = self.visits, generator_of(self.scene.seed, self.name, "touch")
        found = solve_inverse(
            self.scene.true_robot, points, near=before.true_readings, generator=generator, n_starts=n_starts
        )
        lower, upper = self.scene.robot.limits.T
        readings = np.clip(found.readings - (before.true_readings - before.readings), lower, upper)
        ids = np.array([f"{self.name} {i}" for i in before.ids])
        self.visits = Visits(readings, found.readings, ids, before.test)
        return found.reached

    def touch_in_turn(self, spots: Mapping[str, Spot], noise: str) -> Integers:
        """Touch points in turn; the point of each configuration, of which some may be left out.

        Raises:
            InputError: A point was not reached, and none is to be left out, or none was reached at all.
        """
        which = np.arange(len(self.visits)) % len(spots)
        places = np.array([s.xyz for s in spots.values()])[which]
        reached = self.touch(places + self.noise(noise, len(which), 3))
        if self.scene.leave_out and reached.any():
            self.visits = self.visits.select(reached)
        elif not reached.all():
            missed = sorted({list(spots)[i] for i in which[~reached]})
            found = f"{', '.join(missed)} not reached from {np.sum(~reached)} of {len(reached)} configurations"
            raise InputError(self.place, found, "points within the joint limits")
        return which[reached]

    # --- one instrument after the other ---

    def poses(self, i: Tracker) -> tuple[Table, Truth]:
        """Poses of the tool, or positions of targets on it."""
        rotated, placed = POSE_MODELS[self.model] if self.model in POSE_MODELS else PAIR_MODELS[self.model][::-1]
        targets = i.targets
        if not isinstance(targets, Mapping):
            away = 0.1 * self.workspace()[1] * self.directions(targets)
            targets = self.named("target", [Spot(p) for p in away])
        n, n_targets = len(self.visits), max(1, len(targets))
        k, which = np.repeat(np.arange(n), n_targets), np.tile(np.arange(n_targets), n)
        frames, known = self._stations(i)
        station = k % i.stations
        X = np.array([f.rotation for f in frames])[station]
        at, labels, measured = self.at(), dict[str, Labels](), dict[str, Any]()
        R = at.rotation[k]
        if placed:
            t = np.array([s.xyz for s in targets.values()])[which] if targets else np.zeros((len(k), 3))
            points = at.position[k] + np.einsum("nij,nj->ni", R, t)
            seen = np.einsum("nij,nj->ni", X, points) + np.array([f.position for f in frames])[station]
            measured["position"] = seen + self.noise("position", len(k), 3)
            measured["sigma_position"] = self.stated("position", len(k), 3)
        if rotated:
            noise = Rotation.from_rotvec(self.noise("orientation", len(k), 3)).as_matrix()
            measured["rotation"] = X @ R @ noise
            measured["sigma_orientation"] = self.stated("orientation", len(k), 3)
        if targets:
            labels["target"] = Labels(tuple(targets), which)
        names = [self.name]
        if i.stations > 1:
            names = [f"{self.name}, station s{s + 1}" for s in range(i.stations)]
            labels["station"] = Labels(tuple(f"s{s + 1}" for s in range(i.stations)), station)
        frame: FrameKnowledge = "known" if known or self.model in PAIR_MODELS else "unknown"
        table = Table(self.rows(k, labels=labels, **measured), self.model, i.pairing, frame, known=self.known(targets))
        return table, {"targets": targets, "frames": dict(zip(names, frames, strict=True))}

    def _stations(self, i: Tracker) -> tuple[list[Placement], bool]:
        """world_T_base of each station, and whether the calibration knows it."""
        first, known = self.scene.frame, self.scene.known_frame
        if i.frame is not None:
            known = frame_knowledge(i.frame) == "known"
            drawn = i.frame if isinstance(i.frame, Placement) else draw_frame(self.places)
            first = Placement(np.eye(3), np.zeros(3)) if known else drawn
        if i.stations > 1 and known:
            raise InputError(f"{self.place}: stations", f"{i.stations} with frame base", "1")
        return [first, *(draw_frame(self.places) for _ in range(i.stations - 1))], known

    def plain(self, i: PlainInstrument) -> tuple[Table, Truth]:
        """Columns that the model alone has."""
        model, n, at = INSTRUMENTS[self.model], len(self.visits), self.at()
        exact = model.predict(self.rows(), at, lambda kind, name: np.zeros(kind.size))
        columns = {name: exact.columns[name] + self.noise(name, n) for name in model.generic_columns}
        sigmas = {name: self.stated(name, n) for name in model.generic_columns}
        return Table(replace(exact, columns=columns, sigmas=sigmas), i.model), {}

    def pairs(self, i: PairGauge) -> tuple[Table, Truth]:
        """Distances and angles between configurations."""
        at, (distances, angles) = self.at(), PAIR_MODELS[self.model]
        true = form_pairs(self.rows(position=at.position, rotation=at.rotation), i.pairs)
        n = true.n_pairs
        nothing = np.full(n, np.nan)
        found = replace(true, source=f"{self.name}_pairs.csv", distance=nothing, angle=nothing,
                        sigma_distance=nothing, sigma_angle=nothing)  # fmt: skip
        if distances:
            measured = np.abs(true.distance + self.noise("distance", n))
            found = replace(found, distance=measured, sigma_distance=self.stated("distance", n))
        if angles:
            measured = np.pi - np.abs(np.pi - np.abs(true.angle + self.noise("angle", n)))
            found = replace(found, angle=measured, sigma_angle=self.stated("angle", n))
        return Table(self.rows(pairs=found), self.model), {}

    def lengths(self, i: LengthGauge) -> tuple[Table, Truth]:
        """Lengths to anchors."""
        anchors = self.spots(i.anchors, "anchor", within_reach=i.contact)
        which, n = np.arange(len(self.visits)) % len(anchors), len(self.visits)
        if i.contact:
            which = self.touch_in_turn(anchors, "distance")
            length = np.zeros(len(which))
        else:
            places = np.array([a.xyz for a in anchors.values()])[which]
            length = np.linalg.norm(self.at().position - places, axis=1)
            length = np.abs(length + (i.offset or 0.0) + self.noise("distance", n))
        labels = {"anchor": Labels(tuple(anchors), which)}
        m = self.rows(labels=labels, length=length, sigma_length=self.stated("distance", len(which)))
        table = Table(m, "anchor", known=self.known(anchors), offset=i.offset is not None)
        return table, {"anchors": anchors, "offsets": {} if i.offset is None else {self.name: i.offset}}

    def distances(self, i: Indicator) -> tuple[Table, Truth]:
        """Distances from planes."""
        planes = i.planes if isinstance(i.planes, Mapping) else self._draw_planes(i.planes)
        which = np.arange(len(self.visits)) % len(planes)
        normal = np.array([p.normal for p in planes.values()])[which]
        above = np.einsum("ni,ni->n", normal, self.at().position)
        above = above - np.array([p.distance for p in planes.values()])[which] + self.noise("distance", len(which))
        if i.contact:
            reached = self.touch(self.at().position - above[:, None] * normal, n_starts=3)
            if not reached[~self.visits.test].any():
                raise InputError(self.place, "no plane is reached from any configuration", "planes within reach")
            self.visits, which = self.visits.select(reached), which[reached]
        m = self.rows(
            labels={"plane": Labels(tuple(planes), which)},
            length=None if i.contact else above,
            sigma_length=self.stated("distance", len(which)),
        )
        return Table(m, "plane"), {"planes": planes}

    def _draw_planes(self, n: int) -> Mapping[str, Plane]:
        """Planes through the workspace, the first three orthogonal."""
        middle, radius = self.workspace()
        normals = [*Rotation.from_quat(self.places.normal(size=4)).as_matrix(), *self.directions(max(0, n - 3))][:n]
        away = radius * self.places.uniform(-0.5, 0.5, n)
        return self.named("plane", [Plane(v, float(v @ middle + d)) for v, d in zip(normals, away, strict=True)])

    def boards(self, i: BoardCamera) -> tuple[Table, Truth]:
        """Poses of boards in the camera's frame."""
        boards = self._boards_of(i)
        R, b = _in_camera(self.at(), boards)
        k, which = np.nonzero((b[:, :, 2] > 0.0) & _faces(i, boards, R, b))
        self._require_seen(k)
        n = len(k)
        m = self.rows(
            k,
            labels={"board": Labels(tuple(boards), which)},
            rotation=Rotation.from_rotvec(self.noise("orientation", n, 3)).as_matrix() @ R[k, which],
            position=b[k, which] + self.noise("position", n, 3),
            sigma_orientation=self.stated("orientation", n, 3),
            sigma_position=self.stated("position", n, 3),
        )
        return Table(m, "board"), {"boards": boards}

    def _boards_of(self, i: BoardCamera) -> Mapping[str, Placement]:
        """The boards; the one that the configurations look at if none are given.

        Raises:
            InputError: There are none.
        """
        views = self.scene.configurations
        if i.boards:
            return i.boards
        if isinstance(views, BoardViews):
            return {"board": views.board}
        raise InputError(f"{self.place}: boards", "found none", "boards by name, or configurations: {board: ...}")

    def pixels(self, i: BoardCamera) -> tuple[Table, Truth]:
        """Images of the corners of boards that a camera on the tool sees, or of one on the tool."""
        assert i.camera is not None
        assert i.corners is not None
        at, boards = self.at(), dict[str, Placement]()
        if i.fixed:
            X = i.frame or self._looking_in()
            R, b = (X.rotation @ at.rotation)[:, None], (at.position @ X.rotation.T + X.position)[:, None]
            truth: Truth = {"frames": {self.name: X}}
        else:
            boards = dict(self._boards_of(i))
            R, b = _in_camera(at, boards)
            truth = {"boards": boards}
        c = i.corners.points
        points = b[:, :, None] + np.einsum("nkij,cj->nkci", R[:, :, :, :2], c)
        image = i.camera.image(points.reshape(-1, 3))[0].reshape(*points.shape[:3], 2)
        k, which, corner = np.nonzero(_in_image(i.camera, points, image) & _faces(i, boards, R, b)[:, :, None])
        self._require_seen(k)
        n = len(k)
        m = self.rows(
            k,
            labels={"board": Labels(tuple(boards), which)} if boards else {},
            image=np.hstack([image[k, which, corner] + self.noise("pixel", n, 2), c[corner]]),
            sigma_pixel=self.stated("pixel", n, 2),
        )
        frame: FrameKnowledge = "unknown" if i.fixed else "known"
        return Table(m, "pixels", frame=frame, camera=i.camera, fixed_camera=i.fixed), truth

    def _looking_in(self) -> Placement:
        """camera_T_base of a camera that looks at the workspace's middle from outside."""
        middle, radius = self.workspace()
        ahead = -self.directions(1)[0]
        y = np.linalg.svd(ahead[None])[2][1]  # orthogonal to ahead
        base_R_camera = np.stack([np.cross(y, ahead), y, ahead], axis=1)
        return Placement(base_R_camera.T, -base_R_camera.T @ (middle - 2.5 * radius * ahead))

    def _require_seen(self, k: Integers) -> None:
        if self.visits.test[k].all():
            found = f"sees no board at any of {np.sum(~self.visits.test)} configurations"
            raise InputError(self.place, found, hint="configurations: {board: ...} have the camera look at one")

    def contacts(self, i: Sockets) -> tuple[Table, Truth]:
        """Contacts with points, and distances between these."""
        sockets = self.spots(i.sockets, "socket", within_reach=True)
        which = self.touch_in_turn(sockets, "point")
        pairs = no_pairs(f"{self.name}.csv")
        if len(sockets) > 1:
            places = np.array([s.xyz for s in sockets.values()])
            a, b = np.triu_indices(len(sockets), 1)
            d = np.linalg.norm(places[b] - places[a], axis=1) + self.noise("distance", len(a))
            unmeasured, fitted = np.full(len(a), np.nan), np.zeros(len(a), dtype=np.bool_)
            sigma, source = self.stated("distance", len(a)), f"{self.name}_pairs.csv"
            pairs = Pairs(a, b, np.abs(d), unmeasured, sigma, unmeasured, fitted, source)
        m = self.rows(groups=Groups(tuple(sockets), which, pairs), sigma_point=self.stated("point", len(which)))
        return Table(m, "distance"), {"sockets": sockets}


def _in_camera(at: Poses, boards: Mapping[str, Placement]) -> tuple[Floats, Floats]:
    """camera_T_board at every configuration, shapes (n, n_boards, 3, 3) and (n, n_boards, 3)."""
    R_T = np.swapaxes(at.rotation, 1, 2)[:, None]
    B, b = np.array([p.rotation for p in boards.values()]), np.array([p.position for p in boards.values()])
    return R_T @ B, (R_T @ (b - at.position[:, None])[..., None])[..., 0]


def _faces(i: BoardCamera, boards: Mapping[str, Placement], R: Floats, b: Floats) -> Booleans:
    """Whether the camera, in whose frame boards are, is on the visible side of them, shape (n, n_boards)."""
    side = np.array([-1.0 if name in i.from_behind else 1.0 for name in boards] or [1.0])
    toward: Booleans = side * np.einsum("nki,nki->nk", R[:, :, :, 2], b) < 0.0
    return toward


def _in_image(camera: Camera, points: Floats, image: Floats) -> Booleans:
    """Whether points in the camera's frame, shape (..., 3), are in front of it and in its image, shape (..., 2).

    The distortion's polynomial is not monotonic far from the axis, and would bring into the image what is far outside.
    """
    ahead = points[..., 2] > 0.0
    within = np.all((image >= 0.0) & (image <= [2.0 * camera.cx, 2.0 * camera.cy]), axis=-1)
    z = np.where(ahead, points[..., 2], 1.0)
    s = np.sum((points[..., :2] / z[..., None]) ** 2, axis=-1)
    outward = np.ones(s.shape, dtype=np.bool_)
    for share in np.linspace(0.1, 1.0, 10):  # r (1 + k1 r^2 + k2 r^4 + k3 r^6) grows all the way to the point
        t = s * share
        outward &= 1.0 + t * (3.0 * camera.k1 + t * (5.0 * camera.k2 + t * 7.0 * camera.k3)) > 0.0
    seen: Booleans = ahead & within & outward
    return seen


def merge_truths(tables: list[Table], truths: list[Truth], source: str) -> tuple[tuple[Table, ...], Truth]:
    """Tables that know the same of points of one name, and all truths together.

    Raises:
        InputError: Landmarks of one kind and name are at different places.
    """
    every: dict[str, dict[str, Any]] = {}
    for truth in truths:
        for kind, landmarks in truth.items():
            for name, landmark in landmarks.items():
                if not _same(every.setdefault(kind, {}).setdefault(name, landmark), landmark):
                    raise InputError(f"{source}: instruments: {kind}: {name}", "at two places", "one, or other names")
    known: dict[bool, dict[str, KnownPoint]] = {True: {}, False: {}}
    for table in tables:
        known[table.model == "anchor"] |= table.known
    takes = [t.model == "anchor" or t.model in POSE_MODELS for t in tables]
    shared = (replace(t, known=known[t.model == "anchor"]) if one else t for t, one in zip(tables, takes, strict=True))
    return tuple(shared), {kind: landmarks for kind, landmarks in every.items() if landmarks}


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, Spot | Plane | Placement):
        return all(np.array_equal(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    return bool(a == b)
