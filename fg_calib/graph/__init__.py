"""The factor graph: variables, factors, whitening, start, problem and solver."""

from fg_calib._lazy import attach

__getattr__, __dir__ = attach(
    __name__,
    {
        "fg_calib.graph.build": "build_problem problem_of",
        "fg_calib.graph.factors": "DistanceFactor RotationAngleFactor",
        "fg_calib.graph.problem": "Problem",
        "fg_calib.graph.solver": "Solution SolverOptions levenberg_marquardt_params solve",
    },
)
