"""The variables of a calibration: which parameters are which GTSAM variable, and their priors as rows.

| key | variable |
|---|---|
| `K(i)` | estimated parameters of joint i, a vector of just those |
| `K(0)`, `K(n + 1)` | the same of the base, and of the tool, where not all six of its parameters are estimated |
| `E(i)` | estimated parameters of the effects of joint i (0: of the base) but for error curves |
| `S(i)` | coefficients of the error curve (spline) of joint i |
| `B(0)`, `T(0)` | the base frame, and the tool frame, as a Pose3 where all six are |
| `X(t)` | world_T_base of table t as a Pose3, where its measurement frame is unknown |
| `L(g)` | base_p of the physical point that group g touches, a Point3 |
| `N(i)` | an unknown of a custom kind of measurement, a vector |

Error curves, the last two, and variables that a user adds to the graph, are *nuisance* variables: estimated too, but
not what a calibration is for. Their columns follow those of the *core* (robot and measurement frame) and are eliminated
before anything is said of the core.

Pose3's tangent is rotation first, and a step moves the frame in itself (`pose * Exp(step)`).

Priors are rows (value - nominal) / tolerance. Of a Pose3 they act on x, y and z as they stand, and on its rotation
from nominal, `Log(R_nominal^T R)`, whose components about the frame's own x, y and z axes have the tolerances of roll,
pitch and yaw: at a pitch of 90 degrees the angles themselves are no coordinates.
"""

from collections.abc import Sequence
from dataclasses import field, replace
from functools import cached_property
from typing import Literal

import gtsam
import numpy as np
from numpy.typing import NDArray

from fg_calib.graph.error_states import Curves, State
from fg_calib.inputs import Brief, Floats, Record
from fg_calib.measurements import Landmarks
from fg_calib.robot import EFFECT_KINDS, FRAME_KINDS, QUARTER_TURN, Chain, Robot, build_chain, names_of, yaw_pitch_roll

VariableKind = Literal["vector", "tool", "base", "frame", "unknown", "curve", "own", "own pose"]


class Variable(Record):
    """One GTSAM variable.

    Attributes:
        key: GTSAM's key.
        kind: A vector of parameters, the pose of tool, base or measurement frame, an unknown of the measurements such
            as a contact point, or a vector or pose that a user added.
        parameters: Indices into the parameter vector of `Variables.parameters`, in the variable's own order;
            for poses in the order of `FRAME_KINDS`.
        columns: Its columns in a Jacobian.
        scales: A change of ordinary size in each column of a nuisance variable.
        prior: Mean and sigma of a nuisance variable's prior; None without one.
    """

    key: int
    kind: VariableKind
    parameters: tuple[int, ...]
    columns: slice
    scales: tuple[float, ...] = ()
    prior: tuple[tuple[float, ...], tuple[float, ...]] | None = None

    @cached_property
    def places(self) -> NDArray[np.int64]:
        """`parameters` as an array, to index with."""
        return np.array(self.parameters, dtype=np.int64)

    @property
    def number(self) -> int:
        """Number in its symbol; a measurement frame has that of its table."""
        return int(gtsam.symbolIndex(self.key))

    @property
    def letter(self) -> str:
        """Letter of its symbol."""
        return chr(gtsam.symbolChr(self.key))

    @property
    def symbol(self) -> str:
        """Symbol `K(3)`, `T(0)`, `X(0)`; GTSAM's own notation for an added one."""
        return str(gtsam.Symbol(self.key)).strip() if self.kind.startswith("own") else f"{self.letter}({self.number})"

    @property
    def is_pose(self) -> bool:
        """Whether it is a Pose3; else it is a vector."""
        return self.kind in ("tool", "base", "frame", "own pose")


class Variables(Brief):
    """All variables of a problem, and the way between GTSAM's values and the parameter vector.

    The parameter vector has the robot's parameters, then six for each unknown measurement frame (at least one) in the
    order of `FRAME_KINDS`, then the values of the nuisance variables.

    Attributes:
        robot: The robot, nominal.
        items: The core variables in the order of their columns.
        names: Name of each estimated scalar, shape (n_columns,): a parameter's, or `frame.x` ... `frame.yaw` (with the
            table's number, if several frames are unknown). Of a pose the names stand in `FRAME_KINDS`' order although
            its columns are tangent directions.
        chains: The kinematic chain with these columns from the measurement frame of each table.
        priors: Whether the robot's tolerances are priors.
        nuisance: The nuisance variables; their columns follow those of the core.
        coordinates: Index into the parameter vector of each coordinate of the landmarks; -1 if it is not estimated.
    """

    robot: Robot
    items: tuple[Variable, ...]
    names: tuple[str, ...]
    chains: tuple[Chain, ...]
    priors: bool
    nuisance: tuple[Variable, ...] = ()
    coordinates: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    others: Floats = field(default_factory=lambda: np.zeros(0))

    @property
    def n_columns(self) -> int:
        """Number of columns of the core's Jacobian: the dimension of its tangent space."""
        return len(self.names)

    @property
    def n_nuisance(self) -> int:
        """Number of columns of the nuisance variables."""
        return sum(len(v.parameters) for v in self.nuisance)

    @property
    def keys(self) -> list[int]:
        """GTSAM's keys in the order of the columns, the core's first."""
        return [v.key for v in self.items + self.nuisance]

    @property
    def robot_span(self) -> slice:
        """Slice of the robot's parameters in the parameter vector."""
        return slice(0, len(self.robot.parameters))

    @property
    def frames(self) -> tuple[Variable, ...]:
        """The unknown measurement frames."""
        return tuple(v for v in self.items if v.kind == "frame")

    @property
    def frame_span(self) -> slice:
        """Slice of the measurement frames' values in the parameter vector."""
        first = len(self.robot.parameters)
        return slice(first, first + 6 * max(1, len(self.frames)))

    @property
    def nuisance_span(self) -> slice:
        """Slice in the parameter vector of the nuisance values that are none of the robot's."""
        return slice(self.frame_span.stop, self.frame_span.stop + self.n_nuisance - self.n_curves)

    @property
    def n_curves(self) -> int:
        """Number of columns of error curves, the first ones of the nuisance variables."""
        return sum(len(v.parameters) for v in self.nuisance if v.kind == "curve")

    def columns_at(self, places: NDArray[np.int64]) -> NDArray[np.int64]:
        """Columns of nuisance values that are none of the robot's, by their places in the parameter vector."""
        return places - self.nuisance_span.start + self.n_columns + self.n_curves

    @property
    def n_robot_columns(self) -> int:
        """Number of columns without the measurement frames', which come last."""
        return self.n_columns - 6 * len(self.frames)

    @cached_property
    def scales(self) -> Floats:
        """A change of ordinary size in each column (see `Robot.scale_of`), shape (n_columns,)."""
        of_pose, units = 3 * ["rad"] + 3 * ["m"], list[str]()
        for v in self.items:
            units += of_pose if v.is_pose else [self.robot.parameters[i].unit for i in v.parameters]
        return np.array([self.robot.scale_of(unit) for unit in units], dtype=np.float64)

    @cached_property
    def prior_scales(self) -> Floats:
        """`scales`, but where there is a prior its sigma: how far each column may be off, shape (n_columns,)."""
        scales = self.scales.copy()
        for v in self.items:
            with_prior, weight = self.prior_weights[v.key]
            scales[v.columns][[_ALONG_TANGENT.index(k) if v.is_pose else k for k in with_prior]] = 1.0 / weight
        return scales

    @cached_property
    def all_scales(self) -> Floats:
        """`scales`, then those of the nuisance columns, shape (n_columns + n_nuisance,)."""
        return np.concatenate([self.scales, *(v.scales for v in self.nuisance)])

    @cached_property
    def prior_weights(self) -> dict[int, tuple[list[int], Floats]]:
        """Parameters with a prior, and 1 / sigma of these, by key of each core variable."""
        found = {}
        for v in self.items:
            of_v = () if v.kind == "frame" or not self.priors else v.parameters
            tolerances = [self.robot.parameters[i].tolerance for i in of_v]
            weights = np.array([1.0 / t for t in tolerances if t is not None])
            found[v.key] = [k for k, t in enumerate(tolerances) if t is not None], weights
        return found

    def nominal(self) -> Floats:
        """The parameter vector at the robot's nominal values, measurement frame and nuisance values zero."""
        return np.concatenate([self.robot.nominal, np.zeros(self.nuisance_span.stop - len(self.robot.parameters))])

    def values(self, parameters: Floats) -> gtsam.Values:
        """GTSAM's values at a parameter vector."""
        values = gtsam.Values()
        for v in self.items + self.nuisance:
            chosen = parameters[v.places]
            values.insert(v.key, pose_of(chosen) if v.is_pose else chosen)
        return values

    def parameters(self, values: gtsam.Values, only: Sequence[Variable] | None = None) -> Floats:
        """The parameter vector at GTSAM's values; what is not a variable (or not in `only`) keeps its nominal value."""
        parameters = self.nominal()
        for v in self.items + self.nuisance if only is None else only:
            of_v = v.places
            if v.is_pose:
                parameters[of_v] = frame_of(values.atPose3(v.key), None if v.kind == "frame" else parameters[of_v])
            else:
                parameters[of_v] = values.atVector(v.key)
        return parameters

    def with_held(self, parameters: Floats) -> Floats:
        """A parameter vector with what is no variable at its nominal value."""
        held = self.nominal()
        for v in self.items + self.nuisance:
            held[v.places] = parameters[v.places]
        return held

    def moved(self, parameters: Floats, step: Floats) -> Floats:
        """The parameter vector after a tangent step of the core, or of all variables; angles of poses stay near."""
        after = parameters.copy()
        for v in self.items + self.nuisance:
            of_v, part = v.places, step[v.columns]
            if not part.any():
                continue  # a step of the core alone moves no landmark
            if v.is_pose:
                after[of_v] = frame_of(pose_of(parameters[of_v]).retract(part), parameters[of_v])
            else:
                after[of_v] += part
        return after

    def step(self, start: Floats, end: Floats) -> Floats:
        """The tangent step from a parameter vector to another, shape (n_columns + n_nuisance,)."""
        out = np.zeros(self.n_columns + self.n_nuisance)
        for v in self.items + self.nuisance:
            if v.is_pose:
                out[v.columns] = gtsam.Pose3.Logmap(pose_of(start[v.places]).between(pose_of(end[v.places])))
            else:
                out[v.columns] = end[v.places] - start[v.places]
        return out

    def with_unknowns(self, unknowns: Landmarks, estimated: NDArray[np.bool_]) -> "Variables":
        """Copy with the measurements' estimated unknowns as nuisance variables."""
        column, place = self.n_columns + self.n_nuisance, self.nuisance_span.stop
        coordinates, more, taken = list[int](), list[Variable](), {v.symbol for v in self.items}
        for index, (item, size) in enumerate(zip(unknowns.items, unknowns.sizes, strict=True)):
            if not estimated[index]:
                coordinates += [-1] * size
                continue
            letter, parameters = item.kind.letter, tuple(range(place, place + size))
            # The base has the letter of boards.
            number = len(unknowns.items) if f"{letter}({index})" in taken else index
            prior = None if item.tolerance is None else (tuple(item.start.tolist()), size * (item.tolerance,))
            key, columns = gtsam.symbol(letter, number), slice(column, column + size)
            scales = tuple(map(self.robot.scale_of, item.units))
            more.append(Variable(key, "unknown", parameters, columns, scales, prior))
            coordinates += parameters
            column, place = column + size, place + size
        others, found = np.nan_to_num(unknowns.start), np.array(coordinates, dtype=np.int64)
        return replace(self, nuisance=self.nuisance + tuple(more), coordinates=found, others=others)

    def at(self, parameters: Floats) -> State:
        """The arm and the measurements' unknowns at a parameter vector."""
        estimated = self.coordinates >= 0
        columns = np.where(estimated, self.columns_at(self.coordinates), -1)
        values = np.where(estimated, parameters[self.coordinates], self.others)
        chains = tuple(chain.at(parameters) for chain in self.chains)
        return State(chains, values, columns, self.n_columns, self.n_nuisance, self._curves(parameters))

    def _curves(self, parameters: Floats) -> Curves | None:
        found = [(v, v.prior) for v in self.nuisance if v.kind == "curve" and v.prior is not None]
        if not found:
            return None
        sigma = np.concatenate([prior[1] for _, prior in found])
        values = np.concatenate([parameters[v.places] for v, _ in found])
        return Curves({v.number - 1: v.columns.start - self.n_columns for v, _ in found}, values, sigma)

    def with_added(self, keys: Sequence[int], initial: gtsam.Values) -> "Variables":
        """The variables with those that a user added, and no others of a user's."""
        v = replace(self, nuisance=tuple(v for v in self.nuisance if not v.kind.startswith("own")))
        for key in keys:
            kind, n = _own_kind(initial, key)
            first, column = v.nuisance_span.stop, v.n_columns + v.n_nuisance
            places, columns = tuple(range(first, first + n)), slice(column, column + n)
            v = replace(v, nuisance=(*v.nuisance, Variable(key, kind, places, columns, scales=(1.0,) * n)))
        return v

    def columns_of(self, other: "Variables", parameters: Floats) -> Floats:
        """Each column of other variables of the same arm in these, shape (n_columns, other.n_columns).

        Args:
            other: The others; columns of what these do not estimate are zero.
            parameters: The parameter vector, of either.
        """
        by_name = dict(zip(self.names, self.tangent_derivative(parameters).T, strict=True))
        poses = {v.key: np.eye(self.n_columns)[v.columns] for v in self.items if v.is_pose}
        out = np.zeros((self.n_columns, other.n_columns))
        for v in other.items:
            if v.key in poses:
                out[:, v.columns] = poses[v.key].T
            elif not v.is_pose:
                columns = [by_name.get(name, np.zeros(self.n_columns)) for name in other.names[v.columns]]
                out[:, v.columns] = np.array(columns).T
        return out

    def named_derivative(self, parameters: Floats) -> Floats:
        """Derivative of the named scalars in the columns, shape (n_columns, n_columns).

        The identity but for poses, where it maps the tangent (rotation first) to x, y, z, yaw, pitch, roll.

        Note:
            At a pitch of a quarter turn roll and yaw have no derivative; their rows are then nan.
        """
        D = np.linalg.pinv(self.tangent_derivative(parameters)).astype(np.float64)
        for v in self.items:
            if v.is_pose and abs(np.cos(parameters[v.parameters[4]])) <= QUARTER_TURN:
                D[v.columns, v.columns][[3, 5]] = np.nan
        return D

    def tangent_derivative(self, parameters: Floats) -> Floats:
        """Derivative of the columns in the named scalars: the inverse of `named_derivative`, finite everywhere.

        At a pitch of a quarter turn it is singular: there roll and yaw turn a frame about the same axis.
        """
        D = np.eye(self.n_columns)
        for v in self.items:
            if v.is_pose:
                D[v.columns, v.columns] = _tangent_derivative(parameters[v.places])
        return D


def build_variables(robot: Robot, frames: Sequence[bool], priors: bool = True, *, arm: bool = True) -> Variables:
    """The variables of a robot's estimated parameters, and of the measurement frames that are unknown.

    Args:
        robot: The robot.
        frames: Of each table, whether its measurement frame is unknown.
        priors: Whether the robot's tolerances are priors.
        arm: Whether those of joints are among them; else base and tool alone.
    """
    items, names, n = list[Variable](), list[str](), len(robot.parameters)

    def add(letter: str, number: int, kind: VariableKind, places: Sequence[int], of: Sequence[str]) -> None:
        span = slice(len(names), len(names) + len(of))
        names.extend(of)
        items.append(Variable(gtsam.symbol(letter, number), kind, tuple(places), span))

    for owner in range(robot.n_joints + 2) if arm else (0, robot.n_joints + 1):
        chosen = [i for i in robot.owned_by(owner) if robot.parameters[i].estimated]
        of = names_of(robot.parameters[i] for i in chosen)
        if len(chosen) == 6 and owner == 0:
            add("B", 0, "base", chosen, of)
        elif len(chosen) == 6 and owner > robot.n_joints:
            add("T", 0, "tool", chosen, of)
        elif chosen:
            add("K", owner, "vector", chosen, of)
        kinds = set(EFFECT_KINDS) - {"curve"}
        if more := [i for i, p in enumerate(robot.parameters) if p.owner == owner and p.kind in kinds and p.estimated]:
            add("E", owner, "vector", more, names_of(robot.parameters[i] for i in more))
    for k, table in enumerate(np.flatnonzero(frames).tolist()):
        prefix = "frame" if sum(frames) == 1 else f"frame{table + 1}"
        add("X", table, "frame", range(n + 6 * k, n + 6 * k + 6), [f"{prefix}.{kind}" for kind in FRAME_KINDS])
    vectors = (v for v in items if v.kind == "vector")
    columns = {i: v.columns.start + k for v in vectors for k, i in enumerate(v.parameters)}
    poses, chains = {v.symbol: v for v in items if v.is_pose}, list[Chain]()
    tangents = {symbol: v.columns.start for symbol, v in poses.items()}
    for frame in (f"X({table})" for table in range(len(frames))):
        tool, base, at = map(tangents.get, ("T(0)", "B(0)", frame))
        there = frame in poses
        chain = build_chain(robot, columns, tool_tangent=tool, base_tangent=base, frame_tangent=at, frame=there)
        later = poses[frame].parameters[0] - n if there else -n
        source = np.where(chain.source >= n, chain.source + later, chain.source)
        chains.append(replace(chain, source=source, n_columns=len(names)))
    curves = _curves(robot, len(names)) if arm else ()
    return Variables(robot, tuple(items), tuple(names), tuple(chains), priors, curves)


def _curves(robot: Robot, column: int) -> tuple[Variable, ...]:
    """A variable for each error curve that is estimated, from a column on."""
    found = list[Variable]()
    for curve in build_chain(robot).curves:
        sigma, n = robot.parameters[curve.source[0]].tolerance or 1.0, len(curve.source)
        if robot.parameters[curve.source[0]].estimated:
            key, columns = gtsam.symbol("S", curve.joint + 1), slice(column, column + n)
            prior = (0.0,) * n, (sigma,) * n
            found.append(Variable(key, "curve", tuple(curve.source.tolist()), columns, (sigma,) * n, prior))
            column += n
    return tuple(found)


def _own_kind(initial: gtsam.Values, key: int) -> tuple[VariableKind, int]:
    """Kind and size of a variable that a user added: a vector, else a pose."""
    try:
        return "own", len(initial.atVector(key))
    except RuntimeError:
        return "own pose", 6


def pose_of(frame: Floats) -> gtsam.Pose3:
    """The pose of x, y, z, yaw, pitch, roll, [m] and [rad]."""
    x, y, z, yaw, pitch, roll = (float(v) for v in frame)
    return gtsam.Pose3(gtsam.Rot3.Ypr(yaw, pitch, roll), np.array([x, y, z]))


def frame_of(pose: gtsam.Pose3, near: Floats | None = None) -> Floats:
    """x, y, z, yaw, pitch, roll of a pose, [m] and [rad].

    Args:
        pose: The pose.
        near: Of the angles that make the same rotation those nearest to the angles of this frame, in the same order,
            are taken; those within half a turn and a quarter turn of pitch if None.
    """
    angles = yaw_pitch_roll(pose.rotation().matrix(), None if near is None else np.asarray(near)[3:])
    return np.concatenate([pose.translation(), angles])


def corrections_of(robot: Robot, values: Floats) -> Floats:
    """Parameter values minus a robot's nominal ones, shape (n_parameters,), [m] and [rad].

    Angles of a frame (base, tool, origins of a URDF's joints) by the shorter way. Near a pitch of 90 degrees yaw and
    roll may change far more than the frame rotates: beyond twice its rotation, the rotation's components about its own
    z, y and x axes replace the differences of yaw, pitch and roll.
    """
    off = values - robot.nominal
    for owner in range(robot.n_joints + 2):
        frame = [i for i in robot.owned_by(owner) if robot.parameters[i].kind in FRAME_KINDS]
        if len(frame) == 6:
            angles = frame[3:]
            off[angles] = np.remainder(off[angles] + np.pi, 2.0 * np.pi) - np.pi
            R = pose_of(robot.nominal[frame]).rotation()
            turn = gtsam.Rot3.Logmap(R.between(pose_of(values[frame]).rotation()))
            if np.abs(off[angles]).max() > 2.0 * np.linalg.norm(turn):
                off[angles] = turn[::-1]
    return off


_ALONG_TANGENT = (5, 4, 3, 0, 1, 2)
"""Which of `FRAME_KINDS` goes with each direction of a pose's tangent: roll, pitch, yaw with turns about x, y, z."""


def _tangent_derivative(frame: Floats) -> Floats:
    """Derivative of Pose3's tangent (rotation first, in itself) in x, y, z, yaw, pitch, roll, shape (6, 6)."""
    pitch, roll = frame[4], frame[5]
    E = np.zeros((6, 6))
    E[3:, :3] = pose_of(frame).rotation().matrix().T
    # Body rates of Rz(yaw) Ry(pitch) Rx(roll).
    E[0, 3:] = [-np.sin(pitch), 0.0, 1.0]
    E[1, 3:] = [np.cos(pitch) * np.sin(roll), np.cos(roll), 0.0]
    E[2, 3:] = [np.cos(pitch) * np.cos(roll), -np.sin(roll), 0.0]
    return E


def prior_rows(variables: Variables, parameters: Floats, only: Variable | None = None) -> tuple[Floats, Floats]:
    """Whitened priors and their derivatives, shapes (n_priors,), (n_priors, n_columns): see the module's head.

    Args:
        variables: The variables.
        parameters: The parameter vector.
        only: The variable whose priors are wanted; all if None.
    """
    items, nominal = variables.items if only is None else (only,), variables.nominal()
    n = sum(len(variables.prior_weights[v.key][0]) for v in items)
    r, J, after = np.zeros(n), np.zeros((n, variables.n_columns)), 0
    for v in items:
        with_prior, weight = variables.prior_weights[v.key]
        rows = slice(after, after := after + len(with_prior))
        x, of = parameters[v.places], nominal[v.places]
        off, D = _off_nominal(x, of) if v.is_pose else (x - of, np.eye(len(x)))
        r[rows], J[rows, v.columns] = weight * off[with_prior], weight[:, None] * D[with_prior]
    return r, J


def _off_nominal(frame: Floats, nominal: Floats) -> tuple[Floats, Floats]:
    """How far a frame is from nominal, shape (6,), and the derivative in Pose3's tangent, shape (6, 6).

    x, y, z less their nominal values, then the turn from nominal about its own z, y and x axes, [m] and [rad]. The
    derivative of the turn r = Log(R_nominal^T R) is the inverse right Jacobian of SO(3) at r.
    """
    R = pose_of(frame).rotation()
    turn = gtsam.Rot3.Logmap(pose_of(nominal).rotation().between(R))
    D = np.zeros((6, 6))
    D[:3, 3:] = R.matrix()
    D[3:, :3] = gtsam.Rot3.LogmapDerivative(turn)[::-1]
    return np.concatenate([frame[:3] - nominal[:3], turn[::-1]]), D


def unknown_prior_rows(variables: Variables, parameters: Floats, *, of_curves: bool = True) -> tuple[Floats, Floats]:
    """Whitened priors of nuisance variables and their derivatives, shapes (n,), (n, n_columns + n_nuisance).

    Args:
        variables: The variables.
        parameters: The parameter vector.
        of_curves: Whether those of error curves are among them.
    """
    found = [(v, *v.prior) for v in variables.nuisance if v.prior is not None and (of_curves or v.kind != "curve")]
    columns = np.concatenate([np.zeros(0, np.int64), *(np.r_[v.columns] for v, _, _ in found)])
    x = np.concatenate([np.zeros(0), *(parameters[v.places] - mean for v, mean, _ in found)])
    sigma = np.concatenate([np.ones(0), *(s for _, _, s in found)])
    J = np.zeros((len(x), variables.n_columns + variables.n_nuisance))
    J[np.arange(len(x)), columns] = 1.0 / sigma
    return x / sigma, J
