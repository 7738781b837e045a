"""Candidates for measurements: configurations of a table or drawn, among which a design is chosen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fg_calib.arguments import checked
from fg_calib.errors import InputError
from fg_calib.options import check_number
from fg_calib.robot.model import Robot
from fg_calib.robot.shape import Box, foot_in
from fg_calib.simulation.candidates import Candidates, draw_candidates, number_of
from fg_calib.simulation.configurations import Configurations
from fg_calib.sizes import MOST_DRAWN
from fg_calib.threads import single_threaded

__all__ = ["Box", "Candidates", "candidates"]


@checked
@single_threaded
def candidates(
    robot: Robot,
    of: Configurations,
    generator: np.random.Generator,
    *,
    n: int | None = None,
    keep_out: Sequence[Box] = (),
    apart: float | None = None,
) -> Candidates:
    """Configurations in which the arm could be measured.

    Rows of a table are taken in their order. All else is drawn until n were found or 20 n were drawn. Of what a camera
    sees, views that the arm cannot reach are rejected, where a simulation asks for all.

    Args:
        robot: The robot, at its nominal values.
        of: Drawn within the joint limits, of a table, or what a camera or a tracker sees.
        generator: Draws them: with the same seed the same.
        n: How many at most; as many as `of` counts if None.
        keep_out: Boxes that nothing of the arm may be inside, beside those of `of`.
        apart: Least distance of two candidates, [rad], as `Conditions` has it; that of `of` if None.

    Raises:
        InputError: None can be had, which is said with the shares of the reasons; a figure that makes no sense; with
            self-motion held, the first view of a board is not reached.
    """
    if n is None:
        n = number_of(of)
    else:
        check_number("n", n, above=True, whole=True, most=MOST_DRAWN)
    of = replace(of, keep_out=(*of.keep_out, *keep_out), apart=of.apart if apart is None else apart)
    found = draw_candidates(robot, of, generator, n, "candidates")
    if len(found.readings) == 0:
        hint = foot_in(robot, of.keep_out)
        raise InputError("candidates", f"none in {found.reasons()}", "some that the arm can take", hint)
    return found
