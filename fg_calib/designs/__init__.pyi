from .criteria import Criterion
from .design import Design

__all__ = [
    "Criterion",
    "Design",
]
