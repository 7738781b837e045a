"""What a user can choose among, word by word; light enough for the command line's help."""

from typing import Literal, get_args

Model = Literal["pose", "position", "orientation", "distance", "rotation", "distance-rotation"]
"""What a calibration compares with the measurements: each pose, or part of it, or what lies between two poses."""

FrameKnowledge = Literal["known", "unknown"]
"""Whether the measurement frame is the base, or world_T_base is estimated too."""

Gauge = Literal["prior", "keep", "none"]
"""What holds the directions that data do not determine: tolerances as priors; leaving parameters out; nothing."""

Strategy = Literal["star", "chain", "all", "random"]
"""How pairs are formed from poses."""

PairErrors = Literal["shared", "independent"]
"""Whether pairs of one configuration are taken to share its errors, or to be independent as in the paper."""

EncoderNoise = Literal["propagated", "estimated"]
"""Whether the noise of joint readings is added to that of the rows, or each true joint vector is estimated too."""

Loss = Literal["none", "huber", "cauchy", "geman-mcclure", "gnc"]
"""What becomes of large residuals: least squares, or a robust loss."""

LengthUnit = Literal["m", "cm", "mm", "um"]
AngleUnit = Literal["rad", "deg", "mrad"]

MODELS: tuple[Model, ...] = get_args(Model)
