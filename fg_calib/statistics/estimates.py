"""Estimates with their sigmas: parameters, measurement frames, landmarks, and joint readings.

Where encoder noise is estimated, a reading q has an error e = q_true - q of 1 sigma as specified. Its estimate varies
by less: by `sqrt(sigma^2 - s^2)`, s the posterior sigma of the joint value. The error over that is *studentised*: it
has a sigma of 1 for a healthy reading, however little the measurements say of its joint.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from fg_calib import graph
from fg_calib.inputs import Floats, FrozenArrays, Integers, Record, Sigma
from fg_calib.observability import IdentifiabilityClass, Observability
from fg_calib.statistics.covariance import Spread, TangentCovariance
from fg_calib.statistics.residual_table import suspect_level

LEAST_SHARE = 1e-3
"""Share of a reading's variance below which the measurements say nothing of its error."""


MEASURED_SHARE = 0.9
"""Sigma over prior sigma of an error curve's coefficient from which rows do not measure it."""


class ParameterEstimate(Record):
    """One parameter of the robot after calibration.

    Attributes:
        name: Its name.
        unit: `m`, `rad`, or another of `robot.SCALES`.
        nominal: Nominal value.
        estimate: Estimated value; nominal if it is fixed.
        correction: Estimate minus nominal; angles of a frame by the shorter way (see `factors.corrections_of`).
        sigma: 1 sigma of estimate minus true; 0 if fixed; None where neither data nor priors determine it. Of a
            parameter that was left out to fix the gauge: its prior sigma.
        prior_sigma: 1 sigma of its prior; None without one.
        identifiability: Class by the data alone: `independent`, `relative`, `ineffective`; or `fixed`. Coefficients of
            an error curve are relative, to the joint's zero, where rows measure them, else ineffective.
        stands_for: Of a relative parameter that was kept where others were left out to fix the gauge: the combination
            that it was estimated for, factors by name; else None.
        sigma_of_combination: 1 sigma of the estimate as one of that combination; None where it stands for itself.
    """

    name: str
    unit: str
    nominal: float
    estimate: float
    correction: float
    sigma: Sigma | None
    prior_sigma: Sigma | None
    identifiability: IdentifiabilityClass | str
    stands_for: dict[str, float] | None = None
    sigma_of_combination: Sigma | None = None


class FrameEstimate(FrozenArrays):
    """A measurement frame world_T_base.

    Attributes:
        xyz: Translation, shape (3,), [m].
        quaternion_xyzw: Rotation, shape (4,).
        sigma: 1 sigma of a small motion of the frame in itself, rotation first, shape (6,), [rad] and [m]; nan where
            nothing determines it.
    """

    xyz: Floats
    quaternion_xyzw: Floats
    sigma: Floats


class LandmarkEstimate(FrozenArrays):
    """A contact point, a target, an anchor, a plane, a board or an instrument's offset.

    Attributes:
        name: Its name.
        n: Train rows that it takes part in.
        xyz: Position: of a contact point or an anchor in the base frame, of a target in the tool frame, [m]; of a
            plane its unit normal in the base frame, then its distance from the base, [m]; of a board its rotation
            vector, [rad], and position in the base frame, [m]; of an offset what the instrument adds, [m]. Of a group
            without train rows the mean of the predicted tool points.
        sigma: 1 sigma of each, the same shape; 0 where it is known, nan where it is not determined, or not estimated.
        kind: Name of its `LandmarkKind`.
        units: `m` or `rad` of each; empty of a value without unit.
    """

    name: str
    n: int
    xyz: Floats
    sigma: Floats
    kind: str = "point"
    units: tuple[str, ...] = ("m", "m", "m")


class JointErrors(FrozenArrays):
    """Estimated joint values of the fitted configurations, of the joints that have noise.

    Attributes:
        configurations: Rows of the measurements, shape (n,).
        joints: Indices of the joints, shape (k,).
        names: Their names.
        reading: Shape (n, k), [rad] (prismatic: [m]).
        error: Estimate minus reading, in the same units, shape (n, k).
        sigma: 1 sigma of a reading, specified or estimated, shape (k,).
        studentised: Error over its own 1 sigma, shape (n, k); nan where the measurements say nothing of it.
        suspects: (row, column) of errors that are too large, the worst first.
    """

    configurations: Integers
    joints: Integers
    names: tuple[str, ...]
    reading: Floats
    error: Floats
    sigma: Floats
    studentised: Floats
    suspects: tuple[tuple[int, int], ...]

    @property
    def mean(self) -> Floats:
        """Mean error of each joint, in sigma of a reading, shape (k,)."""
        return (self.error / self.sigma).mean(axis=0)

    @property
    def scatter(self) -> Floats:
        """RMS of the studentised errors of each joint, 1 if all is as specified; nan if none is known, shape (k,)."""
        known = np.isfinite(self.studentised)
        n, total = known.sum(axis=0), np.sum(np.where(known, self.studentised, 0.0) ** 2, axis=0)
        return np.where(n > 0, np.sqrt(total / np.maximum(n, 1)), np.nan)


class Estimates(Record):
    """All that was estimated.

    Attributes:
        parameters: Every parameter of the robot.
        frames: Every measurement frame that was estimated, table by table.
        landmarks: Contact points, targets, anchors, planes, boards and offsets.
        joint_errors: Estimated errors of the joint readings; None where these were not estimated.
    """

    parameters: tuple[ParameterEstimate, ...]
    frames: tuple[FrameEstimate, ...]
    landmarks: tuple[LandmarkEstimate, ...]
    joint_errors: JointErrors | None

    @property
    def frame(self) -> FrameEstimate | None:
        """The first measurement frame; None where none was estimated."""
        return self.frames[0] if self.frames else None


def estimates_at(solution: graph.Solution, spread: Spread, whole: Spread, observability: Observability) -> Estimates:
    """All estimates of a solution with their sigmas.

    Args:
        solution: The solution.
        spread: The covariance of what was estimated.
        whole: The covariance of all parameters, those left out to fix the gauge among them.
        observability: Observability by the data alone.
    """
    return Estimates(
        parameters=_parameters(solution, spread, whole, observability),
        frames=estimate_frames(solution.problem.variables, solution.parameters, whole),
        landmarks=_landmarks(solution, whole),
        joint_errors=_joint_errors(solution),
    )


def estimate_frames(
    variables: graph.Variables, parameters: Floats, whole: TangentCovariance
) -> tuple[FrameEstimate, ...]:
    """Every measurement frame that was estimated.

    Args:
        variables: The variables.
        parameters: The estimate.
        whole: The covariance of all parameters.
    """
    found, columns = [], np.eye(len(whole.tangent))[whole.variables.n_robot_columns :]
    for k, v in enumerate(variables.frames):
        world_T_base = graph.pose_of(parameters[v.places])
        quaternion = Rotation.from_matrix(world_T_base.rotation().matrix()).as_quat(canonical=True)
        sigma = np.sqrt(np.diag(whole.covariance(columns[6 * k : 6 * k + 6])))
        found.append(FrameEstimate(world_T_base.translation(), quaternion, sigma))
    return tuple(found)


def _parameters(
    solution: graph.Solution, spread: Spread, whole: Spread, observability: Observability
) -> tuple[ParameterEstimate, ...]:
    problem, estimated = solution.problem, spread.variables.names
    classes = dict(zip(observability.names, observability.classes, strict=True))
    sigmas = dict(zip(observability.names, np.sqrt(np.diag(whole.named())), strict=True))
    of_curves = dict(zip(whole.curve_names, np.sqrt(whole.variance(whole.curves)).tolist(), strict=True))
    for p in (p for p in problem.robot.parameters if p.name in of_curves):
        learned = of_curves[p.name] < MEASURED_SHARE * (p.tolerance or np.inf)
        classes[p.name], sigmas[p.name] = "relative" if learned else "ineffective", of_curves[p.name]
    combinations: dict[str, dict[str, float]] = {}
    for group in observability.relative if problem.whole is not None else ():
        combinations |= group.combinations([name for name in group.parameters if name in estimated])
    of_combinations = dict(zip(estimated, np.sqrt(np.diag(spread.named())), strict=False)) if combinations else {}
    corrections = graph.corrections_of(problem.robot, solution.parameters[problem.variables.robot_span])
    return tuple(
        ParameterEstimate(
            name=p.name,
            unit=p.unit,
            nominal=p.nominal,
            estimate=float(solution.parameters[i]),
            correction=float(corrections[i]),
            sigma=finite(sigmas.get(p.name, 0.0)),
            prior_sigma=p.tolerance if p.estimated and (problem.options.has_priors or p.kind == "curve") else None,
            identifiability=classes.get(p.name, "fixed"),
            stands_for=combinations.get(p.name),
            sigma_of_combination=finite(of_combinations[p.name]) if p.name in combinations else None,
        )
        for i, p in enumerate(problem.robot.parameters)
    )


def finite(sigma: float) -> float | None:
    """A sigma as a number; None for one that nothing determines."""
    return float(sigma) if np.isfinite(sigma) else None


def _landmarks(solution: graph.Solution, whole: Spread) -> tuple[LandmarkEstimate, ...]:
    """Landmarks; their sigma comes from the parameters, which they follow, and from their own rows."""
    problem = solution.problem
    unknowns = problem.data.landmarks
    if not unknowns.names:
        return ()
    at = problem.variables.at(solution.parameters)
    left = replace(problem, variables=whole.variables).linearize(solution.parameters).left
    counts, first = _n_rows(problem), np.cumsum([0, *unknowns.sizes])
    names, found = unknowns.keys, []
    for i, (_, name) in enumerate(names):
        kind = unknowns.items[i].kind
        if not kind.heading:
            continue
        span = slice(first[i], first[i + 1])
        columns = at.columns[span] - problem.variables.n_columns
        values, C, units = at.coordinates[span], np.zeros((unknowns.sizes[i],) * 2), unknowns.items[i].units
        if np.all(columns >= 0):
            F, S = left.follow[columns], left.inverse[columns]
            C = whole.covariance(F) + S @ S.T
            C[left.unknown[columns]] = np.nan
        elif not unknowns.items[i].known:
            C[:] = np.nan
        if kind.estimate is not None:
            k = i if kind.reference is None else names.index((kind.reference.letter, name))
            values, C, units = kind.estimate(at.coordinates[first[k] : first[k + 1]], values, C)
        found.append(
            LandmarkEstimate(name, int(counts[i]), values, np.sqrt(np.maximum(np.diag(C), 0.0)), kind.name, units)
        )
    return tuple(found)


def _n_rows(problem: graph.Problem) -> Integers:
    """Number of train measurements that each landmark takes part in, shape (n_landmarks,)."""
    unknowns = problem.data.landmarks
    counts = np.zeros(len(unknowns.names), dtype=np.int64)
    for s in (s for s in problem.data.blocks if s.kind.ends):
        owners = np.sort(unknowns.owners[s.nuisances[s.train]], axis=1)
        counts += np.bincount(owners[np.diff(owners, axis=1, prepend=-1) != 0], minlength=len(counts))
    return counts


def _joint_errors(solution: graph.Solution) -> JointErrors | None:
    problem, data = solution.problem, solution.problem.data
    if not problem.joints_estimated:
        return None
    joints = np.flatnonzero(data.sigma_joint > 0.0)
    sigma = problem.sigma_joint[joints]
    rows, slots = problem.rows.configurations, problem.rows.slots
    share, of_joints = np.zeros((len(rows), problem.robot.n_joints)), slots < problem.robot.n_joints
    variance = problem.linearize(solution.parameters).z_variance.reshape(len(rows), -1)
    share[:, slots[of_joints]] = 1.0 - variance[:, of_joints]  # of its prior variance, by which an error varies
    share = share[:, joints]
    error = graph.joint_errors(problem, solution.parameters)[np.ix_(rows, joints)]
    with np.errstate(invalid="ignore", divide="ignore"):
        studentised = np.where(share > LEAST_SHARE, error / (sigma * np.sqrt(share)), np.nan)
    size = np.nan_to_num(np.abs(studentised))
    worst = np.argsort(-size, axis=None)[: int(np.sum(size > suspect_level(studentised.size)))]
    suspects = tuple((int(i), int(k)) for i, k in zip(*np.unravel_index(worst, size.shape), strict=True))
    names, reading = tuple(problem.robot.joints[j].name for j in joints), data.readings[np.ix_(rows, joints)]
    return JointErrors(rows, joints, names, reading, error, sigma, studentised, suspects)
