"""Simulation: a true robot, where it is sent, and what is measured there.

Truth comes from forward kinematics alone; nothing here knows how a calibration works. Encoder noise moves the arm: it
stands where the readings plus that noise say, and the table holds the readings. `measure` says what instruments
measure; without instruments a tracker measures poses of the tool.

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

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from fg_calib import initialization, inputs, io, measurements, parallel
from fg_calib.inputs import PAIR_MODELS, POSE_MODELS, Booleans, Brief, Floats, FrameKnowledge, InputError, Integers
from fg_calib.measurements import INSTRUMENTS, Groups, KnownPoint, Labels, Measurements, Noise, Pairs, Table
from fg_calib.robot import N_STARTS, Poses, Robot, Thermal, build_chain, forward, outside_joints, pose, solve_inverse
from fg_calib.simulation.scenario import BoardViews, Configurations, Instrument, Placement, Plane, Scenario, Spot
from fg_calib.simulation.views import Words, find_readings

MAX_BASE_M = 5.0
"""How far from the world's origin an unknown frame puts the base, along each axis, [m]."""

Truth = Mapping[str, Mapping[str, Any]]
"""True landmarks, by kind and name: `Spot`, `Plane`, `Placement`; offsets of instruments, [m]."""


def generator_of(seed: int, *names: str) -> np.random.Generator:
    """The generator of what has these names."""
    return np.random.default_rng([seed, *"\n".join(names).encode()])


def choose_frame(frame: Placement | str, generator: np.random.Generator) -> Placement:
    """The frame that is given, the base itself, or one of any rotation that is drawn within `MAX_BASE_M`."""
    if isinstance(frame, Placement):
        return frame
    if frame == "base":
        return Placement(np.eye(3), np.zeros(3))
    rotation = Rotation.from_quat(generator.normal(size=4)).as_matrix()  # any rotation as likely as any other
    return Placement(rotation, generator.uniform(-MAX_BASE_M, MAX_BASE_M, 3))


def override_noise(noise: Noise, more: Noise | None) -> Noise:
    """A noise with the values of another where it has some; the joints' stay."""
    values = {} if more is None else {kind: more.get(kind) for kind in io.NOISE_UNITS}
    return noise.updated(**{kind: value for kind, value in values.items() if value is not None})


class Visits(NamedTuple):
    """Configurations that the arm was sent to.

    Attributes:
        readings: Joint readings, shape (n, n_joints), [rad] (prismatic: [m]).
        true_readings: Where the joints stood, of the same shape.
        ids: Name of each, shape (n,).
        test: Which are for test rows, shape (n,).
    """

    readings: Floats
    true_readings: Floats
    ids: Words
    test: Booleans

    def select(self, rows: Integers | Booleans) -> "Visits":
        """Some of the visits."""
        values: list[Any] = [values[rows] for values in self]
        return Visits(*values)

    @staticmethod
    def joined(parts: "Sequence[Visits]") -> "Visits":
        """Visits one after the other."""
        return Visits(*map(np.concatenate, zip(*parts, strict=True)))


@dataclass
class Measuring:
    """One instrument at work.

    Attributes:
        scenario: The scenario.
        instrument: The instrument.
        true_robot: The robot that moves.
        visits: Where it was sent.
        frame: world_T_base.
        seed: Seed of all draws.
        exact: Whether measurements and known points have no errors.
    """

    scenario: Scenario
    instrument: Instrument
    true_robot: Robot
    visits: Visits
    frame: Placement
    seed: int
    exact: bool

    def __post_init__(self) -> None:
        self.name, self.model, self.n = self.instrument.name, self.instrument.model, len(self.visits.ids)
        each = (effect.context(self.true_robot, self.visits.readings, self.read) for effect in self.true_robot.effects)
        self.context = {name: values for one in each for name, values in one.items()}
        self.place = f"{self.scenario.source}: instruments: {self.name}"
        self.places = self.generator("places")
        self.noises = override_noise(self.scenario.noise, self.instrument.noise)
        self.sigmas = override_noise(self.noises, self.scenario.specified_noise)

    def measure(self) -> tuple[Table, Truth]:
        """Measure: a table, and where landmarks truly are.

        Raises:
            InputError: A value of the noise is missing, nothing is seen, or no point is reached.
        """
        if self.instrument.sockets is not None:
            return self.contacts()
        if self.instrument.pairs is not None:
            return self.pairs()
        methods = dict.fromkeys((*POSE_MODELS, *PAIR_MODELS), self.poses)
        methods |= {"anchor": self.lengths, "plane": self.distances, "board": self.boards, "pixels": self.pixels}
        table, truth = methods.get(self.model, self.plain)()
        kept = np.isin(self.visits.ids, table.measurements.ids)
        if self.context and not kept.all():  # sides of approach are by the rows of the table
            return replace(self, visits=self.visits.select(kept)).measure()
        return table, truth

    # --- for all instruments ---

    def generator(self, *names: str) -> np.random.Generator:
        """The generator of something of this instrument."""
        return generator_of(self.seed, self.name, *names)

    def at(self) -> Poses:
        """True poses of the tool."""
        return forward(build_chain(self.true_robot), self.true_robot.trig(self.visits.true_readings, self.context))

    def read(self, names: Sequence[str]) -> Floats:
        """Columns that effects depend on, shape (n, k): temperatures, payloads, sides, or joints outside the chain."""
        effects = self.true_robot.effects
        thermal = {effect.column for effect in effects if isinstance(effect, Thermal)}
        payloads = {m.column: m.mass for effect in effects for m in getattr(effect, "masses", None) or ()}
        each = [[generator_of(self.seed, i, name).uniform() for name in names] for i in self.visits.ids.tolist()]
        drawn, (cold, warm) = np.reshape(each, (self.n, len(names))), self.scenario.temperature
        if names[0] in payloads:  # on or off
            return payloads[names[0]] * np.round(drawn)
        if joint := outside_joints(self.true_robot).get(names[0]):
            lower, upper = np.clip([joint.lower, joint.upper], -np.pi, np.pi)
            return lower + (upper - lower) * drawn
        return cold + (warm - cold) * drawn if names[0] in thermal else np.sign(drawn - 0.5)

    def noise(self, kind: str, *shape: int) -> Floats:
        """Noise of a kind: standard normal numbers times sigma, so that another sigma scales the same noise."""
        sigma = 0.0 if self.exact else self._value(self.noises, kind)
        return sigma * self.generator("noise", kind).normal(size=shape)

    def sigma(self, kind: str, *shape: int) -> Floats:
        """The sigma of a kind that the calibration is given.

        Raises:
            InputError: The sigma is 0.
        """
        sigma = self._value(self.sigmas, kind)
        hint = f"a calibration takes nothing for exact: specify what to assume under job: noise: {kind}"
        inputs.expect(sigma != 0.0, f"{self.place}: noise: {kind}", "found 0", "a number above 0", hint)
        return np.full(shape, sigma)

    def _value(self, noise: Noise, kind: str) -> float:
        if (value := noise.get(kind)) is None:
            raise InputError(f"{self.place}: noise: {kind}", "found none", f"1 sigma, for model {self.model}")
        return float(value)

    def rows(self, k: Integers | None = None, **measured: Any) -> Measurements:
        """Measurements at the configurations, or at those that rows are of."""
        visits = self.visits if k is None else self.visits.select(k)
        noise, source = self.scenario.specified_noise or self.scenario.noise, f"{self.name}.csv"
        measured |= {"sigma_joint": noise.of_joints(self.scenario.robot.n_joints), "source": source, "named": True}
        context = {name: values if k is None else values[k] for name, values in self.context.items()}
        return Measurements(visits.readings, visits.ids, visits.test, context=context, **measured)

    def nominal(self) -> Poses:
        """Nominal poses of the tool at the train configurations."""
        return pose(self.scenario.robot, self.visits.readings[~self.visits.test])

    def workspace(self) -> tuple[Floats, float]:
        """Middle and radius of the nominal tool points, [m]."""
        points = self.nominal().position
        middle = points.mean(axis=0)
        return middle, max(float(np.sqrt(np.mean(np.sum((points - middle) ** 2, axis=1)))), 1e-3)

    def directions(self, n: int) -> Floats:
        """Unit vectors in any direction, shape (n, 3)."""
        v = self.places.normal(size=(n, 3))
        return v / np.linalg.norm(v, axis=1, keepdims=True)

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
            slowest = np.linalg.svd(at.jacobian[:, 3:, -self.scenario.robot.n_joints :], compute_uv=False)[:, -1]
            inside = at.position[slowest >= np.median(slowest)]
            places = inside[self.places.choice(len(inside), given, replace=given > len(inside))]
        else:
            middle, radius = self.workspace()
            places = middle + radius * self.places.uniform(0.5, 1.5, (given, 1)) * self.directions(given)
        return self.named(what, [Spot(p) for p in places])

    def known(self, spots: Mapping[str, Spot]) -> dict[str, KnownPoint]:
        """Points as the calibration knows them: off by their tolerances."""
        found = {}
        for name, spot in spots.items():
            if spot.tolerance is not None:
                off = (0.0 if self.exact else spot.tolerance) * generator_of(self.seed, "known", name).normal(size=3)
                found[name] = KnownPoint(spot.xyz + off, spot.tolerance or None)
        return found

    def touch(self, points: Floats, n_starts: int = N_STARTS) -> Booleans:
        """Move the arm from each configuration until the tool point is at a point; which are reached, shape (n,).

        Others are left out. The table holds the reading, so the encoders' error is subtracted from where the joints
        then stand.

        Raises:
            InputError: None is reached, or effects depend on more than readings.
        """
        if self.context:
            raise InputError(self.place, f"contact, with effects by {', '.join(self.context)}", "none of these effects")
        v, generator = self.visits, self.generator("touch")
        found = solve_inverse(self.true_robot, points, near=v.true_readings, generator=generator, n_starts=n_starts)
        missed = f"nothing is reached from {np.sum(~v.test)} configurations"
        inputs.expect(found.reached[~v.test].any(), self.place, missed, "points within the joint limits")
        readings = np.clip(found.readings - (v.true_readings - v.readings), *self.scenario.robot.limits.T)
        ids = np.array([f"{self.name} {i}" for i in v.ids])
        self.visits = Visits(readings, found.readings, ids, v.test).select(found.reached)
        return found.reached

    # --- one instrument after the other ---

    def poses(self) -> tuple[Table, Truth]:
        """Poses of the tool, or positions of targets on it."""
        i, n = self.instrument, self.n
        rotated, placed = POSE_MODELS[self.model] if self.model in POSE_MODELS else PAIR_MODELS[self.model][::-1]
        targets = i.targets or {}
        if not isinstance(targets, Mapping):
            away = 0.1 * self.workspace()[1] * self.directions(targets)
            targets = self.named("target", [Spot(p) for p in away])
        points = [*([Spot(np.zeros(3))] * i.tool_too), *targets.values()]
        n_targets = max(1, len(points))
        k, which = np.repeat(np.arange(n), n_targets), np.tile(np.arange(n_targets), n)
        first = self.frame if i.frame is None else choose_frame(i.frame, self.places)
        frames = [first, *(choose_frame("unknown", self.places) for _ in range(i.stations - 1))]
        station = k % i.stations
        X = np.array([f.rotation for f in frames])[station]
        at, labels, measured = self.at(), dict[str, Labels](), dict[str, Any]()
        R = at.rotation[k]
        if placed:
            t = np.array([s.xyz for s in points])[which] if points else np.zeros((len(k), 3))
            points = at.position[k] + np.einsum("nij,nj->ni", R, t)
            seen = np.einsum("nij,nj->ni", X, points) + np.array([f.position for f in frames])[station]
            measured["position"] = seen + self.noise("position", len(k), 3)
            measured["sigma_position"] = self.sigma("position", len(k), 3)
        if rotated:
            measured["rotation"] = X @ R @ Rotation.from_rotvec(self.noise("orientation", len(k), 3)).as_matrix()
            measured["sigma_orientation"] = self.sigma("orientation", len(k), 3)
        if targets:
            labels["target"] = Labels(tuple(targets), which - i.tool_too)
        names = [self.name]
        if i.stations > 1:
            names = [f"{self.name}, station s{s + 1}" for s in range(i.stations)]
            labels["station"] = Labels(tuple(f"s{s + 1}" for s in range(i.stations)), station)
        known = self.model in PAIR_MODELS or (i.frame or self.scenario.frame) == "base"
        frame: FrameKnowledge = "known" if known else "unknown"
        m, pairing = self.rows(k, labels=labels, **measured), i.pairing or inputs.Pairing()
        table = Table(m, self.model, pairing, frame, known=self.known(targets))
        return table, {"targets": targets, "frames": dict(zip(names, frames, strict=True))}

    def plain(self) -> tuple[Table, Truth]:
        """Columns that the model alone has."""
        model = INSTRUMENTS[self.model]
        if model.landmarks:
            raise InputError(self.place, f"model {self.model} has landmarks", "a model whose landmarks can be placed")
        exact = model.predict(self.rows(), self.at(), lambda kind, names: np.zeros((len(names), kind.size)))
        columns = {name: exact.columns[name] + self.noise(name, self.n) for name in model.generic_columns}
        sigmas = {name: self.sigma(name, self.n) for name in model.generic_columns}
        return Table(replace(exact, columns=columns, sigmas=sigmas), self.model), {}

    def pairs(self) -> tuple[Table, Truth]:
        """Distances and angles between configurations."""
        at, (distances, angles) = self.at(), PAIR_MODELS[self.model]
        assert self.instrument.pairs is not None
        true = measurements.form_pairs(self.rows(position=at.position, rotation=at.rotation), self.instrument.pairs)
        n, keys = true.n_pairs, ("distance", "angle", "sigma_distance", "sigma_angle")
        found: dict[str, Any] = dict.fromkeys(keys, np.full(n, np.nan))
        if distances:
            found["distance"] = np.abs(true.distance + self.noise("distance", n))
            found["sigma_distance"] = self.sigma("distance", n)
        if angles:
            found["angle"] = np.pi - np.abs(np.pi - np.abs(true.angle + self.noise("angle", n)))
            found["sigma_angle"] = self.sigma("angle", n)
        pairs = replace(true, source=f"{self.name}_pairs.csv", **found)
        return Table(self.rows(pairs=pairs), self.model), {}

    def lengths(self) -> tuple[Table, Truth]:
        """Lengths to anchors."""
        i, n = self.instrument, self.n
        anchors = self.spots(3 if i.anchors is None else i.anchors, "anchor", within_reach=i.contact)
        which = np.arange(n) % len(anchors)
        places = np.array([a.xyz for a in anchors.values()])[which]
        if i.contact:
            which = which[self.touch(places + self.noise("distance", n, 3))]
            length = np.zeros(len(which))
        else:
            length = np.linalg.norm(self.at().position - places, axis=1)
            length = np.abs(length + (i.offset or 0.0) + self.noise("distance", n))
        sigmas = {"distance": self.sigma("distance", len(which))}
        m = self.rows(labels={"anchor": Labels(tuple(anchors), which)}, columns={"distance": length}, sigmas=sigmas)
        table = Table(m, "anchor", known=self.known(anchors), offset=i.offset is not None)
        return table, {"anchors": anchors, "offsets": {} if i.offset is None else {self.name: i.offset}}

    def distances(self) -> tuple[Table, Truth]:
        """Distances from planes."""
        i = self.instrument
        planes = i.planes if isinstance(i.planes, Mapping) else self._draw_planes(3 if i.planes is None else i.planes)
        which, at = np.arange(self.n) % len(planes), self.at().position
        normal = np.array([p.normal for p in planes.values()])[which]
        distance = np.array([p.distance for p in planes.values()])[which]
        above = np.einsum("ni,ni->n", normal, at) - distance + self.noise("distance", self.n)
        if i.contact:
            which = which[self.touch(at - above[:, None] * normal, n_starts=3)]
        labels, sigmas = {"plane": Labels(tuple(planes), which)}, {"distance": self.sigma("distance", len(which))}
        m = self.rows(labels=labels, columns={} if i.contact else {"distance": above}, sigmas=sigmas)
        return Table(m, "plane"), {"planes": planes}

    def _draw_planes(self, n: int) -> Mapping[str, Plane]:
        """Planes through the workspace, the first three orthogonal."""
        middle, radius = self.workspace()
        normals = [*Rotation.from_quat(self.places.normal(size=4)).as_matrix(), *self.directions(max(0, n - 3))][:n]
        away = radius * self.places.uniform(-0.5, 0.5, n)
        return self.named("plane", [Plane(v, float(v @ middle + d)) for v, d in zip(normals, away, strict=True)])

    def contacts(self) -> tuple[Table, Truth]:
        """Contacts with points, and distances between these."""
        sockets = self.spots(self.instrument.sockets or {}, "socket", within_reach=True)
        which, places = np.arange(self.n) % len(sockets), np.array([s.xyz for s in sockets.values()])
        which = which[self.touch(places[which] + self.noise("point", self.n, 3))]
        pairs = measurements.no_pairs(f"{self.name}.csv")
        if len(sockets) > 1:
            a, b = np.triu_indices(len(sockets), 1)
            d = np.linalg.norm(places[b] - places[a], axis=1) + self.noise("distance", len(a))
            unmeasured, fitted = np.full(len(a), np.nan), np.zeros(len(a), dtype=np.bool_)
            sigma, source = self.sigma("distance", len(a)), f"{self.name}_pairs.csv"
            pairs = Pairs(a, b, np.abs(d), unmeasured, sigma, unmeasured, fitted, source)
        m = self.rows(groups=Groups(tuple(sockets), which, pairs), sigmas={"point": self.sigma("point", len(which))})
        return Table(m, "distance"), {"sockets": sockets}

    def boards(self) -> tuple[Table, Truth]:
        """Poses of boards in the camera's frame."""
        boards, R, b, faced = self._boards_in_camera()
        k, which = np.nonzero((b[:, :, 2] > 0.0) & faced)
        self._require_seen(k)
        n = len(k)
        rotation = Rotation.from_rotvec(self.noise("orientation", n, 3)).as_matrix() @ R[k, which]
        position = b[k, which] + self.noise("position", n, 3)
        sigmas = {f"sigma_{kind}": self.sigma(kind, n, 3) for kind in ("orientation", "position")}
        m = self.rows(k, labels={"board": Labels(tuple(boards), which)}, rotation=rotation, position=position, **sigmas)
        return Table(m, "board"), {"boards": boards}

    def pixels(self) -> tuple[Table, Truth]:
        """Images of the corners of boards that a camera on the tool sees, or of one on the tool."""
        i, (boards, R, b, faced) = self.instrument, self._boards_in_camera()
        assert i.camera is not None
        assert i.corners is not None
        points = b[:, :, None] + np.einsum("nkij,cj->nkci", R[:, :, :, :2], i.corners)
        image, seen = project(i.camera, points)
        k, which, corner = np.nonzero(seen & faced[:, :, None])
        self._require_seen(k)
        labels = {} if i.fixed else {"board": Labels(tuple(boards), which)}
        uv = np.hstack([image[k, which, corner] + self.noise("pixel", len(k), 2), i.corners[corner]])
        m = self.rows(k, labels=labels, image=uv, sigmas={"pixel": self.sigma("pixel", len(k), 2)})
        frame: FrameKnowledge = "unknown" if i.fixed else "known"
        table = Table(m, "pixels", frame=frame, camera=i.camera, fixed_camera=i.fixed)
        return table, {"frames" if i.fixed else "boards": boards}

    def _boards_in_camera(self) -> tuple[Mapping[str, Placement], Floats, Floats, Booleans]:
        """The boards, or the frame of a fixed camera; where boards are in the camera's frame, and which it faces.

        Returns:
            base_T_board or camera_T_base by name; camera_R_board, shape (n, n_boards, 3, 3); camera_p_board, shape
            (n, n_boards, 3), [m]; whether the camera is on the visible side, shape (n, n_boards).

        Raises:
            InputError: There are no boards.
        """
        i, at = self.instrument, self.at()
        views = i.configurations or self.scenario.configurations
        if i.fixed:
            X = i.frame if isinstance(i.frame, Placement) else self._looking_in()
            boards: Mapping[str, Placement] = {self.name: X}
            R, b = (X.rotation @ at.rotation)[:, None], (at.position @ X.rotation.T + X.position)[:, None]
        elif i.boards or isinstance(views, BoardViews):
            boards = i.boards or {"board": views.board}  # type: ignore[union-attr]
            R_T, B = np.swapaxes(at.rotation, 1, 2)[:, None], np.array([one.rotation for one in boards.values()])
            step = np.array([one.position for one in boards.values()]) - at.position[:, None]
            R, b = R_T @ B, (R_T @ step[..., None])[..., 0]
        else:
            raise InputError(f"{self.place}: boards", "found none", "boards by name, or configurations: {board: ...}")
        side = np.array([-1.0 if name in i.from_behind else 1.0 for name in boards])
        return boards, R, b, side * np.einsum("nki,nki->nk", R[:, :, :, 2], b) < 0.0

    def _require_seen(self, k: Integers) -> None:
        if self.visits.test[k].all():
            found = f"sees no board at any of {np.sum(~self.visits.test)} configurations"
            raise InputError(self.place, found, hint="configurations: {board: ...} have the camera look at one")

    def _looking_in(self) -> Placement:
        """camera_T_base of a camera that looks at the workspace's middle from outside."""
        middle, radius = self.workspace()
        ahead = -self.directions(1)[0]
        y = np.linalg.svd(ahead[None])[2][1]  # orthogonal to ahead
        base_R_camera = np.stack([np.cross(y, ahead), y, ahead], axis=1)
        return Placement(base_R_camera.T, -base_R_camera.T @ (middle - 2.5 * radius * ahead))


def project(camera: initialization.Camera, points: Floats) -> tuple[Floats, Booleans]:
    """Images of points in the camera's frame, shape (..., 3), and whether they are in front of it and in its image.

    The distortion's polynomial turns back far from the axis, and would bring into the image what is far outside.
    """
    image, J = camera.image(points.reshape(-1, 3))
    within = np.all((image >= 0.0) & (image <= [2.0 * camera.cx, 2.0 * camera.cy]), axis=1)
    seen: Booleans = (points[..., 2] > 0.0) & (within & (np.linalg.det(J[:, :, :2]) > 0.0)).reshape(points.shape[:-1])
    return image.reshape(*points.shape[:-1], 2), seen


def merge_truths(tables: list[Table], truths: list[Truth], source: str) -> tuple[tuple[Table, ...], Truth]:
    """Tables that know the same of points of one name, and all truths together.

    Raises:
        InputError: Landmarks of one kind and name are at different places.
    """
    every: dict[str, dict[str, Any]] = {}
    other: Any
    for kind, name, landmark in ((k, n, one) for t in truths for k, found in t.items() for n, one in found.items()):
        other = every.setdefault(kind, {}).setdefault(name, landmark)
        if other is not landmark and not all(map(np.array_equal, astuple(other), astuple(landmark))):
            raise InputError(f"{source}: instruments: {kind}: {name}", "at two places", "one, or other names")
    known: dict[str, dict[str, KnownPoint]] = {}
    keys = [INSTRUMENTS[str(table.model)].key for table in tables]
    for key, table in zip(keys, tables, strict=True):
        known.setdefault(key, {}).update(table.known)
    shared = tuple(replace(table, known=known[key]) for key, table in zip(keys, tables, strict=True))
    return shared, {kind: landmarks for kind, landmarks in every.items() if landmarks}


class Simulation(Brief):
    """One run of a scenario.

    Attributes:
        scenario: The scenario.
        seed: The seed.
        robot: The nominal robot.
        true_robot: The robot that moved: the same parameters, with their true values.
        true_readings: Where the joints stood at the scenario's configurations: the readings plus the encoder noise,
            shape (n_configurations, n_joints), [rad] (prismatic: [m]).
        frame: world_T_base.
        tables: The measurements, as `calibrate` takes them: a table for each instrument. Rows of the validation are
            test rows.
        truth: Where targets, anchors, planes, boards, sockets and frames truly are, by kind and name: `Spot`, `Plane`,
            `Placement` (base_T_board, world_T_base); offsets in [m].
    """

    scenario: Scenario
    seed: int
    robot: Robot
    true_robot: Robot
    true_readings: Floats
    frame: Placement
    tables: tuple[Table, ...]
    truth: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    @property
    def measurements(self) -> Measurements:
        """Measurements of the first instrument."""
        return self.tables[0].measurements

    def n_configurations(self, *, test: bool) -> int:
        """Number of different configurations of train or of test rows."""
        tables = [table.measurements for table in self.tables]
        return len(set(np.concatenate([m.ids[m.test == test] for m in tables]).tolist()))

    def summary(self) -> dict[str, Any]:
        """Seed, numbers of rows and truth, for programs: errors and frame in [m] and [rad]."""
        n_train, n_test = (self.n_configurations(test=test) for test in (False, True))
        errors = zip(self.robot.parameters, self.true_robot.nominal - self.robot.nominal, strict=True)
        quaternion = Rotation.from_matrix(self.frame.rotation.copy()).as_quat(canonical=True).tolist()
        truth = {
            "errors": {p.name: float(error) for p, error in errors if error != 0.0},
            "world_T_base": {"xyz": self.frame.position.tolist(), "quaternion_xyzw": quaternion},
        }
        counts = {"n_configurations": n_train + n_test, "n_train": n_train, "n_test": n_test}
        found = {"scenario": self.scenario.name, "seed": self.seed, **counts, "truth": truth}
        if self.scenario.instruments:
            found["tables"] = [
                {"table": m.source, "model": t.model, "n_train": int(np.sum(~m.test)), "n_test": int(np.sum(m.test))}
                for t, m in ((t, t.measurements) for t in self.tables)
            ]
        return found


@parallel.single_threaded
def simulate(scenario: Scenario, seed: int = 0, *, exact: bool = False) -> Simulation:
    """Run a scenario.

    Every parameter, every table and every kind of noise has a generator of its own, by its name: changing one leaves
    what is drawn for the others as it is.

    Args:
        scenario: The scenario.
        seed: Same seed, same simulation.
        exact: Whether nothing has noise, and known points are where the calibration takes them to be.

    Raises:
        InputError: The scenario is impossible: poses that the robot does not reach within its joint limits, names that
            are no parameters, values that make no sense.
    """
    inputs.check_number("seed", seed, whole=True)
    source = scenario.source
    true_robot = _draw_robot(scenario, seed, f"{source}: errors")
    frame = choose_frame(scenario.frame, generator_of(seed, "frame"))
    common = [_visit(scenario, scenario.configurations, seed, "configurations", exact)]
    if scenario.validation is not None:
        common.append(_visit(scenario, scenario.validation, seed, "validation", exact, len(common[0].ids)))
    default = Instrument(model="pose", name="poses")
    tables, truths = [], []
    for instrument in scenario.instruments or (default,):
        visits = common
        if instrument.configurations is not None:
            own = _visit(scenario, instrument.configurations, seed, f"instruments: {instrument.name}", exact)
            visits = [own._replace(ids=np.array([f"{instrument.name} {name}" for name in own.ids])), *common[1:]]
        table, truth = Measuring(scenario, instrument, true_robot, Visits.joined(visits), frame, seed, exact).measure()
        if instrument is default:
            table, truth = replace(table, model=scenario.job.get("model"), pairing=scenario.pairing), {}
        tables.append(table)
        truths.append(truth)
    shared, every = merge_truths(tables, truths, source)
    true_readings = Visits.joined(common).true_readings
    return Simulation(scenario, seed, scenario.robot, true_robot, true_readings, frame, shared, every)


def _visit(scenario: Scenario, of: Configurations, seed: int, what: str, exact: bool, first: int = 0) -> Visits:
    """Configurations, and where the joints stand there.

    Args:
        scenario: The scenario.
        of: Which configurations.
        seed: Seed of all draws.
        what: The key that says so: `configurations`, `validation`, or `instruments: name`.
        exact: Whether the encoders have no noise.
        first: Number of the first.
    """
    robot, name = scenario.robot, what.removeprefix("instruments: ")
    place = f"{scenario.source}: {what}" + ": configurations" * (name != what)
    readings = find_readings(robot, of, generator_of(seed, name, "configurations"), place)
    noise = generator_of(seed, name, "joint noise").normal(size=readings.shape)
    stood = readings + (0.0 if exact else scenario.noise.of_joints(robot.n_joints)) * noise
    ids = np.array([f"p{first + k}" for k in range(len(readings))])
    return Visits(readings, stood, ids, np.full(len(readings), what == "validation"))


def _draw_robot(scenario: Scenario, seed: int, place: str) -> Robot:
    """Draw the robot that moves, each parameter by its name."""
    robot, errors = scenario.robot, scenario.errors
    if errors is None:
        raise InputError(place, "found none", "one of uniform, normal, values: what the arm that moves has")
    values = errors.by_name(robot, f"{place}: {errors.law}")
    error = np.zeros(len(robot.parameters))
    for k, p in enumerate(robot.parameters):
        size = values.get(p.name, 0.0)
        if errors.law == "values":
            error[k] = size
        elif size < 0.0:
            raise InputError(f"{place}: {errors.law}", f"found {size:g}", "numbers not below 0")
        elif p.estimated:
            generator = generator_of(seed, "errors", p.name)
            error[k] = size * (generator.uniform(-1.0, 1.0) if errors.law == "uniform" else generator.normal())
    return robot.with_values(robot.nominal + error)
