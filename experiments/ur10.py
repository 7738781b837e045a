"""A real UR10 before and after its calibration: the picture of the README.

    FG_CALIB_DATA=FOLDER python experiments/ur10.py

Position errors of the 449 test poses of `ur10_tmac`: of the nominal arm, with the frames of tracker and T-Mac fitted,
and of the arm with error curves and compliance (`real_effects.py`). Takes a quarter of a minute.
"""

from __future__ import annotations

import sys
from functools import cache
from pathlib import Path

import numpy as np
import yaml
from common import COLOURS, MM, Question, Row, Task, data_folder, run
from matplotlib.figure import Figure
from real_data import NOISE
from real_effects import SETS, Floats, ur10_job
from scipy.spatial.transform import Rotation

from fg_calib import Robot
from fg_calib.assessment import solve_job
from fg_calib.robot import pose
from fg_calib.statistics.residual_table import residual_table

MAGNIFIED = 100


@cache
def measured() -> dict[str, Floats]:
    """Test points and their errors in the base frame, [m] and [mm]; the joints of the arm at the foremost, [m]."""
    data = data_folder("ur10_tmac")
    if data is None:
        return {}
    solution = solve_job(ur10_job(data, SETS["error curve and compliance"], noise=NOISE | {"estimate": True}))
    table, m = residual_table(solution), solution.problem.measurements
    chosen = table.test & (table.family == table.families.index("position"))
    at = pose(solution.robot, m.readings).position
    base_R_world, _ = Rotation.align_vectors(at - at.mean(axis=0), m.position - m.position.mean(axis=0))
    found = {w: base_R_world.apply(getattr(table, w)[chosen].reshape(-1, 3)) / MM for w in ("before", "after")}
    q, points = m.readings[m.test], at[m.test]
    first = np.argsort(points[:, 0])[-1:]
    joints = yaml.safe_load((data / "robot.yaml").read_text())["joints"]
    rows = [[r["a"], np.deg2rad(r["alpha"]), r["d"], 0] for r in joints]
    arm = [pose(Robot.from_dh(rows[:k], "dh"), q[first, :k]).position for k in range(1, 7)]
    return found | {"points": points, "arm": np.concatenate([np.zeros((1, 3)), *arm, points[first]])}


def before_after(task: Task) -> Row:
    """Median and 95 % quantile of the errors, [mm]."""
    return {w: np.quantile(np.linalg.norm(measured()[w], axis=1), [0.5, 0.95]).tolist() for w in task if measured()}


def draw(found: Row, path: Path) -> None:
    """Draw the arm and the errors, magnified."""
    if not found:
        return
    figure = Figure(figsize=(9, 4.4))
    points, arm = measured()["points"], measured()["arm"]
    for n, (when, colour) in enumerate((("before", COLOURS[1]), ("after", COLOURS[0]))):
        axes = figure.add_axes((0.5 * n, 0, 0.5, 0.88), projection="3d", computed_zorder=False)
        axes.plot(*arm.T, color="0.78", lw=8, solid_capstyle="round")
        axes.plot(*arm[:-1].T, "o", color="0.55", ms=9)
        axes.quiver(*points.T, *(measured()[when] * MM * MAGNIFIED).T, color=colour, lw=1.1, arrow_length_ratio=0)
        axes.scatter(*points.T, color=colour, s=4, depthshade=False)
        axes.set_box_aspect(np.ptp(np.vstack([points, arm]), axis=0), zoom=1.25)
        axes.view_init(elev=24, azim=-55)
        axes.set_axis_off()
        text = f"{when}: median {found[when][0]:.2f} mm, 95 % below {found[when][1]:.2f} mm"
        figure.text(0.25 + 0.5 * n, 0.88, text, color=colour, size=12, weight="bold", ha="center")
    title = (
        f"Position errors of a real UR10 at {len(points)} poses that were not fitted, drawn {MAGNIFIED} times as long"
    )
    figure.text(0.5, 0.95, title, size=11, ha="center")
    figure.savefig(path, dpi=110)


def answer(found: Row) -> str:
    """Before and after."""
    return f"Median (95 %), mm: {' -> '.join(f'{n[0]:.2f} ({n[1]:.2f})' for n in found.values())}"


QUESTIONS = (
    Question("before_after", "What is left of a UR10's errors?", lambda n, s: [("before", "after")],
             before_after, lambda tasks, rows: rows[0], answer, figure=draw),
)  # fmt: skip

if __name__ == "__main__":
    run(QUESTIONS, Path(__file__).stem, __doc__, sys.argv[1:])
