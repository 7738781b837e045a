"""What the instruments of a scenario measure of the true arm, with their noise, and where things truly are.

With R, p the true tool frame in the base (where the joints stand, not what they read), n independent normal noise:

| instrument | measures |
|---|---|
| tracker | `X (p + R t) + n`, X of its station, t the target; orientations `X R exp(n)` |
| pairs | `abs(|p_b - p_a| + n)`, and the angle of `R_a^T R_b` plus n, folded at 0 and half a turn |
| lengths to anchors | `abs(|p - a| + offset + n)`; in contact 0, where `p = a + n` |
| distances from planes | `normal . p - distance + n`; in contact 0, where that is so of the tool point |
| boards | `exp(n) R^T B` and `R^T (b - p) + n`, along and about the camera's axes |
| pixels | the image of `R^T (B c + b - p)`, or of `X (p + R c)` by a fixed camera, plus n |
| sockets | nothing: `p = socket + n`; their distances from each other plus n |
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fg_calib.errors import InputError
from fg_calib.measurements.dataset import Groups, Labels, Measurements, Noise, Pairs, form_pairs, no_pairs
from fg_calib.measurements.kinds import Camera
from fg_calib.measurements.table import KnownPoint, Table
from fg_calib.options import PAIR_MODELS, POSE_MODELS, FrameKnowledge
from fg_calib.robot.inverse import N_STARTS, solve_inverse
from fg_calib.robot.kinematics import Poses, pose
from fg_calib.robot.model import Robot
from fg_calib.simulation.configurations import BoardViews, Configurations, Placement
from fg_calib.simulation.instruments import (
    BoardCamera,
    Indicator,
    Instrument,
    LengthGauge,
    PairGauge,
    Plane,
    Sockets,
    Spot,
    Tracker,
    frame_knowledge,
)

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]

FARTHEST_BASE = 5.0
"""How far from the world's origin an unknown frame puts the base, along each axis, [m]."""

Truth = Mapping[str, Mapping[str, Any]]
"""Where things truly are, by kind and name: `Spot`, `Plane`, `Placement`; what instruments add, [m]."""


@dataclass(frozen=True)
class Stops:
    """Where the arm stood.

    Attributes:
        readings: What the encoders said, shape (n, n_joints), [rad] (prismatic: [m]).
        true_readings: Where the joints were, of the same shape.
        ids: Name of each, shape (n,).
        test: Which are for test rows, shape (n,).
    """

    readings: Floats
    true_readings: Floats
    ids: NDArray[np.str_]
    test: Booleans

    def __len__(self) -> int:
        return len(self.test)

    def select(self, rows: Integers | Booleans) -> Stops:
        """Some of them."""
        return Stops(self.readings[rows], self.true_readings[rows], self.ids[rows], self.test[rows])


def together(parts: Sequence[Stops]) -> Stops:
    """Stops one after the other."""
    return Stops(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Stops)))


@dataclass(frozen=True)
class Scene:
    """What an instrument measures, and how well.

    Attributes:
        robot: The nominal robot.
        true_robot: The true one.
        stops: Where it stood.
        configurations: What these came from.
        noise: What truly disturbs.
        stated_noise: What the calibration is told.
        sigma_joint: What it is told of the readings, shape (n_joints,), [rad] (prismatic: [m]).
        frame: world_T_base.
        known_frame: Whether the calibration knows that it is the base.
        places: Draws where things are.
        draws: Draws noise.
        source: The scenario, for messages.
        leave_out: Whether stops are left out from which a point to touch is not reached.
    """

    robot: Robot
    true_robot: Robot
    stops: Stops
    configurations: Configurations
    noise: Noise
    stated_noise: Noise
    sigma_joint: Floats
    frame: Placement
    known_frame: bool
    places: np.random.Generator
    draws: np.random.Generator
    source: str = "scenario"
    leave_out: bool = False


def measure(instrument: Instrument, scene: Scene) -> tuple[Table, Truth]:
    """The table of an instrument, and where things truly are.

    Raises:
        InputError: A figure of the noise is missing, nothing is seen, or a point is not reached.
    """
    match instrument:
        case Tracker():
            return _Work(instrument, scene).poses(instrument)
        case PairGauge():
            return _Work(instrument, scene).pairs(instrument)
        case LengthGauge():
            return _Work(instrument, scene).lengths(instrument)
        case Indicator():
            return _Work(instrument, scene).distances(instrument)
        case BoardCamera():
            work = _Work(instrument, scene)
            return work.boards(instrument) if instrument.model == "board" else work.pixels(instrument)
        case Sockets():
            return _Work(instrument, scene).touches(instrument)
    raise InputError("instruments", f"found a {type(instrument).__name__}", "an instrument of fg_calib")


def drawn_frame(generator: np.random.Generator) -> Placement:
    """A frame that may be anywhere near, turned anyhow."""
    rotation = Rotation.from_quat(generator.normal(size=4)).as_matrix()  # any rotation as likely as any other
    return Placement(rotation, generator.uniform(-FARTHEST_BASE, FARTHEST_BASE, 3))


class _Work:
    """One instrument at work."""

    def __init__(self, instrument: Instrument, scene: Scene) -> None:
        self.name, self.model, self.scene, self.stops = instrument.name, instrument.model, scene, scene.stops
        self.place = f"{scene.source}: instruments: {self.name}"

    # --- what all have in common ---

    def at(self) -> Poses:
        """Where the tool truly is."""
        return pose(self.scene.true_robot, self.stops.true_readings)

    def noise(self, kind: str, *shape: int) -> Floats:
        """Noise of a kind.

        Raises:
            InputError: Its sigma is not stated.
        """
        # Standard normal numbers: another sigma scales the same noise.
        return self._figure(self.scene.noise, kind) * self.scene.draws.normal(size=shape)

    def stated(self, kind: str, *shape: int) -> Floats:
        """The sigma of a kind that the calibration is told.

        Raises:
            InputError: It is 0.
        """
        sigma = self._figure(self.scene.stated_noise, kind)
        if sigma == 0.0:
            hint = f"a calibration takes nothing for exact: tell it what to assume under job: noise: {kind}"
            raise InputError(f"{self.place}: noise: {kind}", "found 0", "a number above 0", hint)
        return np.full(shape, sigma)

    def _figure(self, noise: Noise, kind: str) -> float:
        figure = getattr(noise, kind)
        if figure is None:
            raise InputError(f"{self.place}: noise: {kind}", "found none", f"1 sigma, for model {self.model}")
        return float(figure)

    def rows(self, k: Integers | None = None, **measured: Any) -> Measurements:
        """Measurements at the stops, or at those that rows are of."""
        stops = self.stops if k is None else self.stops.select(k)
        nothing: dict[str, Any] = dict.fromkeys(("position", "rotation", "sigma_position", "sigma_orientation"))
        return Measurements(
            readings=stops.readings,
            ids=stops.ids,
            test=stops.test,
            sigma_joint=self.scene.sigma_joint,
            source=f"{self.name}.csv",
            named=True,
            **nothing | measured,
        )

    def well_within_reach(self) -> Floats:
        """Tool points of the nominal arm at the half of the train stops that it moves best from, shape (n, 3), [m]."""
        robot = self.scene.robot
        at = pose(robot, self.stops.readings[~self.stops.test])
        slowest = np.linalg.svd(at.jacobian[:, 3:, -robot.n_joints :], compute_uv=False)[:, -1]
        points: Floats = at.position[slowest >= np.median(slowest)]
        return points

    def workspace(self) -> tuple[Floats, float]:
        """Middle and radius of where the nominal arm has its tool point at the train stops, [m]."""
        points = pose(self.scene.robot, self.stops.readings[~self.stops.test]).position
        middle = points.mean(axis=0)
        radius = float(np.sqrt(np.mean(np.sum((points - middle) ** 2, axis=1))))
        return middle, max(radius, 1e-3)

    def named(self, what: str, n: int) -> tuple[str, ...]:
        """Names of things that are drawn: those of no other instrument."""
        stem = self.name if what in self.name else f"{self.name} {what}"
        return tuple(f"{stem} {i + 1}" for i in range(n))

    def directions(self, n: int) -> Floats:
        """Unit vectors in any direction, shape (n, 3)."""
        v = self.scene.places.normal(size=(n, 3))
        unit: Floats = v / np.linalg.norm(v, axis=1, keepdims=True)
        return unit

    def told(self, spots: Mapping[str, Spot]) -> dict[str, KnownPoint]:
        """What the calibration is told of points: off by their tolerances."""
        found = {}
        for name, spot in spots.items():
            off = self.scene.places.normal(size=3)  # drawn for each, so that telling one changes no other
            if spot.tolerance is not None:
                found[name] = KnownPoint(spot.xyz + spot.tolerance * off, spot.tolerance or None)
        return found

    def touching(self, points: Floats, n_starts: int = N_STARTS) -> Booleans:
        """Move the arm from each stop to one where the tool point is at a point; which were reached, shape (n,).

        The table holds the reading, so the encoders' error is taken off where the joints then stand.
        """
        before = self.stops
        found = solve_inverse(
            self.scene.true_robot, points, near=before.true_readings, generator=self.scene.places, n_starts=n_starts
        )
        lower, upper = self.scene.robot.limits.T
        readings = np.clip(found.readings - (before.true_readings - before.readings), lower, upper)
        ids = np.array([f"{self.name} {i}" for i in before.ids])
        self.stops = Stops(readings, found.readings, ids, before.test)
        return found.reached

    def touched(self, reached: Booleans, names: tuple[str, ...], which: Integers) -> Integers:
        """The point that each stop is at, of which some may be left out.

        Raises:
            InputError: A point was not reached, and none is to be left out, or none was reached at all.
        """
        if self.scene.leave_out and reached.any():
            self.stops = self.stops.select(reached)
        elif not reached.all():
            missed = sorted({names[i] for i in which[~reached]})
            found = f"{', '.join(missed)} not reached from {np.sum(~reached)} of {len(reached)} configurations"
            raise InputError(self.place, found, "points within the joint limits")
        return which[reached]

    # --- one instrument after the other ---

    def poses(self, i: Tracker) -> tuple[Table, Truth]:
        """Poses of the tool, or positions of targets on it."""
        turned, placed = POSE_MODELS[self.model] if self.model in POSE_MODELS else PAIR_MODELS[self.model][::-1]
        targets = self._targets(i)
        n, n_targets = len(self.stops), max(1, len(targets))
        k, which = np.repeat(np.arange(n), n_targets), np.tile(np.arange(n_targets), n)
        frames, known = self._stations(i)
        station = k % i.stations
        X = np.array([f.rotation for f in frames])[station]
        at, labels, measured = self.at(), dict[str, Labels](), dict[str, Any]()
        R = at.rotation[k]
        if placed:
            points = at.position[k]
            if targets:
                points = points + np.einsum("nij,nj->ni", R, np.array([s.xyz for s in targets.values()])[which])
            shift = np.array([f.position for f in frames])[station]
            seen = np.einsum("nij,nj->ni", X, points) + shift
            measured["position"] = seen + self.noise("position", len(k), 3)
            measured["sigma_position"] = self.stated("position", len(k), 3)
        if turned:
            noise = Rotation.from_rotvec(self.noise("orientation", len(k), 3)).as_matrix()
            measured["rotation"] = X @ R @ noise
            measured["sigma_orientation"] = self.stated("orientation", len(k), 3)
        if targets:
            labels["target"] = Labels(tuple(targets), which)
        names = [f"{self.name}, station s{s + 1}" for s in range(i.stations)] if i.stations > 1 else [self.name]
        if i.stations > 1:
            labels["station"] = Labels(tuple(f"s{s + 1}" for s in range(i.stations)), station)
        frame: FrameKnowledge = "known" if known or self.model in PAIR_MODELS else "unknown"
        table = Table(self.rows(k, labels=labels, **measured), self.model, i.pairing, frame, known=self.told(targets))
        return table, {"targets": targets, "frames": dict(zip(names, frames, strict=True))}

    def _targets(self, i: Tracker) -> Mapping[str, Spot]:
        if isinstance(i.targets, Mapping):
            return i.targets
        away = 0.1 * self.workspace()[1] * self.directions(i.targets)
        return dict(zip(self.named("target", i.targets), map(Spot, away), strict=True))

    def _stations(self, i: Tracker) -> tuple[list[Placement], bool]:
        """world_T_base of each station, and whether the calibration knows it."""
        first, known = self.scene.frame, self.scene.known_frame
        if i.frame is not None:
            known = frame_knowledge(i.frame) == "known"
            first = Placement(np.eye(3), np.zeros(3))
            if not known:
                first = i.frame if isinstance(i.frame, Placement) else drawn_frame(self.scene.places)
        if i.stations > 1 and known:
            raise InputError(f"{self.place}: stations", f"{i.stations} with frame base", "1")
        return [first, *(drawn_frame(self.scene.places) for _ in range(i.stations - 1))], known

    def pairs(self, i: PairGauge) -> tuple[Table, Truth]:
        """Distances and angles between configurations."""
        at, (distances, angles) = self.at(), PAIR_MODELS[self.model]
        true = form_pairs(self.rows(position=at.position, rotation=at.rotation), i.pairs)
        n = true.n_pairs
        measured: dict[str, Any] = {
            f"{v}{kind}": np.full(n, np.nan) for kind in ("distance", "angle") for v in ("", "sigma_")
        }
        if distances:
            measured["distance"] = np.abs(true.distance + self.noise("distance", n))
            measured["sigma_distance"] = self.stated("distance", n)
        if angles:
            angle = np.abs(true.angle + self.noise("angle", n))
            measured["angle"] = np.pi - np.abs(np.pi - angle)
            measured["sigma_angle"] = self.stated("angle", n)
        found = Pairs(true.a, true.b, test=true.test, source=f"{self.name}_pairs.csv", **measured)
        return Table(self.rows(pairs=found), self.model), {}

    def lengths(self, i: LengthGauge) -> tuple[Table, Truth]:
        """Lengths to anchors."""
        anchors = self._spots(i.anchors, "anchor", within_reach=i.contact)
        which = np.arange(len(self.stops)) % len(anchors)
        places, n = np.array([a.xyz for a in anchors.values()])[which], len(self.stops)
        if i.contact:
            which = self.touched(self.touching(places + self.noise("distance", n, 3)), tuple(anchors), which)
            length = np.zeros(len(which))
        else:
            length = np.linalg.norm(self.at().position - places, axis=1)
            length = np.abs(length + (i.offset or 0.0) + self.noise("distance", n))
        m = self.rows(
            labels={"anchor": Labels(tuple(anchors), which)},
            length=length,
            sigma_length=self.stated("distance", len(which)),
        )
        table = Table(m, "anchor", known=self.told(anchors), offset=i.offset is not None)
        return table, {"anchors": anchors, "offsets": {} if i.offset is None else {self.name: i.offset}}

    def _spots(self, given: Mapping[str, Spot] | int, what: str, *, within_reach: bool) -> Mapping[str, Spot]:
        """Points by name, drawn where there is only a number of them."""
        if isinstance(given, Mapping):
            return given
        if within_reach:
            inside = self.well_within_reach()
            chosen = self.scene.places.integers(len(inside), size=given)
            again = np.setdiff1d(np.arange(given), np.unique(chosen, return_index=True)[1])
            rest = np.setdiff1d(np.arange(len(inside)), chosen)
            if 0 < len(again) <= len(rest):  # no two in one place
                chosen[again] = self.scene.places.choice(rest, len(again), replace=False)
            places = inside[chosen]
        else:
            middle, radius = self.workspace()
            away = self.scene.places.uniform(0.5, 1.5, (given, 1))
            places = middle + radius * away * self.directions(given)
        return dict(zip(self.named(what, given), map(Spot, places), strict=True))

    def distances(self, i: Indicator) -> tuple[Table, Truth]:
        """Distances from planes."""
        planes = i.planes if isinstance(i.planes, Mapping) else self._drawn_planes(i.planes)
        which = np.arange(len(self.stops)) % len(planes)
        normal = np.array([p.normal for p in planes.values()])[which]
        above = np.einsum("ni,ni->n", normal, self.at().position)
        above = above - np.array([p.distance for p in planes.values()])[which] + self.noise("distance", len(which))
        if i.contact:
            reached = self.touching(self.at().position - above[:, None] * normal, n_starts=3)
            if not reached[~self.stops.test].any():
                raise InputError(self.place, "no plane is reached from any configuration", "planes within reach")
            self.stops, which = self.stops.select(reached), which[reached]
        m = self.rows(
            labels={"plane": Labels(tuple(planes), which)},
            length=None if i.contact else above,
            sigma_length=self.stated("distance", len(which)),
        )
        return Table(m, "plane"), {"planes": planes}

    def _drawn_planes(self, n: int) -> Mapping[str, Plane]:
        """Planes through the workspace, three of each four across each other."""
        middle, radius = self.workspace()
        across = Rotation.from_quat(self.scene.places.normal(size=4)).as_matrix()
        normals = [*across, *self.directions(max(0, n - 3))][:n]
        away = radius * self.scene.places.uniform(-0.5, 0.5, n)
        planes = [Plane(normal, float(normal @ middle + d)) for normal, d in zip(normals, away, strict=True)]
        return dict(zip(self.named("plane", n), planes, strict=True))

    def boards(self, i: BoardCamera) -> tuple[Table, Truth]:
        """Poses of boards in the camera's frame."""
        boards, at = self.boards_of(i), self.at()
        R, b = self._in_camera(at, boards)
        k, which = np.nonzero((b[:, :, 2] > 0.0) & _faces(R, b))
        self._require_seen(k)
        n = len(k)
        noise = Rotation.from_rotvec(self.noise("orientation", n, 3)).as_matrix()
        m = self.rows(
            k,
            labels={"board": Labels(tuple(boards), which)},
            rotation=noise @ R[k, which],
            position=b[k, which] + self.noise("position", n, 3),
            sigma_orientation=self.stated("orientation", n, 3),
            sigma_position=self.stated("position", n, 3),
        )
        return Table(m, "board"), {"boards": boards}

    def boards_of(self, i: BoardCamera) -> Mapping[str, Placement]:
        """The boards, that which the configurations look at if none were given.

        Raises:
            InputError: There are none.
        """
        views = self.scene.configurations
        if i.boards:
            return i.boards
        if isinstance(views, BoardViews):
            return {"board": views.board}
        raise InputError(f"{self.place}: boards", "found none", "boards by name, or configurations: {board: ...}")

    def _in_camera(self, at: Poses, boards: Mapping[str, Placement]) -> tuple[Floats, Floats]:
        """camera_T_board at every stop, shapes (n, n_boards, 3, 3) and (n, n_boards, 3)."""
        R_T = np.swapaxes(at.rotation, 1, 2)[:, None]
        B, b = np.array([p.rotation for p in boards.values()]), np.array([p.position for p in boards.values()])
        return R_T @ B, np.einsum(
            "nkij,nkj->nki", np.broadcast_to(R_T, (len(R_T), len(b), 3, 3)), b - at.position[:, None]
        )

    def pixels(self, i: BoardCamera) -> tuple[Table, Truth]:
        """Images of the corners of boards that a camera on the tool sees, or of one on the tool."""
        assert i.camera is not None
        assert i.corners is not None
        at, truth = self.at(), dict[str, Mapping[str, Any]]()
        if i.fixed:
            X = i.frame or self._looking_in()
            R = (X.rotation @ at.rotation)[:, None]
            b = (at.position @ X.rotation.T + X.position)[:, None]
            names: tuple[str, ...] = ()
            truth["frames"] = {self.name: X}
        else:
            boards = self.boards_of(i)
            R, b = self._in_camera(at, boards)
            names, truth["boards"] = tuple(boards), boards
        c = i.corners.points
        points = b[:, :, None] + np.einsum("nkij,cj->nkci", R[:, :, :, :2], c)
        image = i.camera.image(points.reshape(-1, 3))[0].reshape(*points.shape[:3], 2)
        seen = _in_image(i.camera, points, image) & _faces(R, b)[:, :, None]
        k, which, corner = np.nonzero(seen)
        self._require_seen(k)
        n = len(k)
        m = self.rows(
            k,
            labels={"board": Labels(names, which)} if names else {},
            image=np.hstack([image[k, which, corner] + self.noise("pixel", n, 2), c[corner]]),
            sigma_pixel=self.stated("pixel", n, 2),
        )
        frame: FrameKnowledge = "unknown" if i.fixed else "known"
        return Table(m, "pixels", frame=frame, camera=i.camera, fixed_camera=i.fixed), truth

    def _looking_in(self) -> Placement:
        """camera_T_base of a camera that looks at the workspace's middle from outside."""
        middle, radius = self.workspace()
        ahead = -self.directions(1)[0]
        across = np.linalg.svd(ahead[None])[2]  # its rows: ahead or its opposite, and two across it
        y = across[1]
        base_R_camera = np.stack([np.cross(y, ahead), y, ahead], axis=1)
        return Placement(base_R_camera.T, -base_R_camera.T @ (middle - 2.5 * radius * ahead))

    def _require_seen(self, k: Integers) -> None:
        if self.stops.test[k].all():
            found = f"sees no board at any of {np.sum(~self.stops.test)} configurations"
            raise InputError(self.place, found, hint="configurations: {board: ...} have the camera look at one")

    def touches(self, i: Sockets) -> tuple[Table, Truth]:
        """Touches of sockets, and distances between these."""
        sockets = self._spots(i.sockets, "socket", within_reach=True)
        names, n = tuple(sockets), len(self.stops)
        which = np.arange(n) % len(names)
        places = np.array([s.xyz for s in sockets.values()])
        which = self.touched(self.touching(places[which] + self.noise("point", n, 3)), names, which)
        pairs, source = no_pairs(f"{self.name}.csv"), f"{self.name}_pairs.csv"
        if len(names) > 1:
            a, b = np.triu_indices(len(names), 1)
            d, unmeasured = np.linalg.norm(places[b] - places[a], axis=1), np.full(len(a), np.nan)
            d, sigma = np.abs(d + self.noise("distance", len(a))), self.stated("distance", len(a))
            fitted = np.zeros(len(a), dtype=np.bool_)
            pairs = Pairs(a, b, d, unmeasured, sigma, unmeasured, fitted, source)
        m = self.rows(groups=Groups(names, which, pairs), sigma_point=self.stated("point", len(which)))
        return Table(m, "distance"), {"sockets": sockets}


def _faces(R: Floats, b: Floats) -> Booleans:
    """Whether the camera, in whose frame boards are, is on the side of their z axis, shape (n, n_boards)."""
    toward: Booleans = np.einsum("nki,nki->nk", R[:, :, :, 2], b) < 0.0
    return toward


def _in_image(camera: Camera, points: Floats, image: Floats) -> Booleans:
    """Whether points in the camera's frame, shape (..., 3), are before it and seen within its image, shape (..., 2).

    The distortion's polynomial turns back far from the axis, and would bring into the image what is far outside.
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


def share_knowledge(
    tables: list[Table], truths: list[Truth], source: str
) -> tuple[tuple[Table, ...], dict[str, dict[str, Any]]]:
    """Tables that are told the same of points of one name, and all truths together.

    Raises:
        InputError: Things of one kind and name are at different places.
    """
    every: dict[str, dict[str, Any]] = {}
    for truth in truths:
        for kind, things in truth.items():
            for name, thing in things.items():
                if not _alike(every.setdefault(kind, {}).setdefault(name, thing), thing):
                    raise InputError(f"{source}: instruments: {kind}: {name}", "at two places", "one, or other names")
    known: dict[str, dict[str, KnownPoint]] = {}
    for table in tables:
        for name, point in table.known.items():
            known.setdefault(_family(table), {}).setdefault(name, point)
    return tuple(replace(t, known=known.get(_family(t), {})) for t in tables), {k: v for k, v in every.items() if v}


def _family(table: Table) -> str:
    return "anchors" if table.model == "anchor" else "targets" if table.model in POSE_MODELS else ""


def _alike(a: Any, b: Any) -> bool:
    if isinstance(a, Spot):
        return bool(np.array_equal(a.xyz, b.xyz)) and a.tolerance == b.tolerance
    if isinstance(a, Plane):
        return bool(np.array_equal(a.normal, b.normal)) and a.distance == b.distance
    if isinstance(a, Placement):
        return bool(np.array_equal(a.rotation, b.rotation) and np.array_equal(a.position, b.position))
    return bool(a == b)
