"""Designs for several instruments beside each other, on any executor: what each would need, and what it would give."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Executor
from functools import partial
from typing import Any

from fg_calib.arguments import checked
from fg_calib.designs.design import Design, design
from fg_calib.executors import Failure, map_jobs
from fg_calib.job import Job
from fg_calib.simulation.scenario import Scenario


@checked
def compare_designs(
    subjects: Mapping[str, Scenario | Job], executor: Executor | None = None, **choices: Any
) -> dict[str, Design | Failure]:
    """`design` of several scenarios or jobs; one that fails is no matter to the others.

    Each is the same to the last bit wherever it runs.

    Args:
        subjects: The scenarios or jobs, by names.
        executor: Where they run, such as `local_processes(4)`; one after the other in this process if None.
        choices: What `design` takes beside, the same for all.

    Returns:
        By the same names a design, or a failure that says why there is none.

    Raises:
        InputError: The executor is none.
    """
    work = partial(design, **choices)
    names = list(subjects)
    return dict(zip(names, map_jobs(work, subjects.values(), executor, names=names, what="designing"), strict=True))
