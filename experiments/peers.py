"""How do other packages, and what one writes by hand, do on the same work: error and processor time?

    python experiments/peers.py [--quick] [--only QUESTION ...] [--draws N]

The works are those of `peer_adapters/works.py`; `peer_adapters/protocol.py` says how a peer is run and timed, and
`peer_adapters/in_*.py` what is called of it. Packages are installed, pinned, into virtual environments of their own
below FG_CALIB_PEERS (default: a folder in the system's temporary one), which takes minutes, 2 GB and a package index
the first time. One that does not install, or cannot do a work, says why. Each process has one BLAS thread.

Errors are over those of whitened minimum-norm least squares on the same draws. A package counts as as accurate within
10 %. Time is of the processors, warm; set-up (files, objects) is not in it.

Traps: what could not be equal: robotkinecal takes no weights, pybotics fits positions alone and not Hayati's angle,
figaroh's distances are a cost of ours on its kinematics, and it takes the torques of gravity where joints are reported,
not where they have turned to (1 um here). Each peer is run as its documentation does. Without noise and with
compliance, these find its values: fg_calib and numpy to 1e-5, figaroh to 1e-3.

Takes half an hour, most of it pybotics.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from common import COLOURS, HERE, Question, Row, Task, clean, data_folder, rms, run
from matplotlib.figure import Figure

ADAPTERS = HERE / "peer_adapters"
sys.path.insert(0, str(ADAPTERS))

import works  # noqa: E402 - next to the adapters, for the peers' processes too

CAP = 120.0
"""Seconds after which a solve is ended, and processor seconds after which no further draw is begun."""

EQUAL = 1.1
PYTHONS = ("python3.12", "python3.11", "python3.10")
OPTIMUM = "numpy Gauss-Newton"
CALIBRATE, SOLVE = "fg_calib, calibrate()", "fg_calib, solve()"


@dataclass(frozen=True)
class Peer:
    """One way to calibrate: its adapter, variant, and pinned requirements (none: this environment)."""

    script: str
    variant: str
    requires: tuple[str, ...] = ()


PEERS = {
    CALIBRATE: Peer("in_fg_calib.py", "calibrate"),
    SOLVE: Peer("in_fg_calib.py", "solve"),
    "figaroh 1.0.2": Peer("in_figaroh.py", "figaroh", ("figaroh==1.0.2", "numpy==2.2.6", "scipy==1.15.3")),
    "robotkinecal 0.1.0": Peer(
        "in_robotkinecal.py", "robotkinecal",
        ("robotkinecal==0.1.0", "roboticstoolbox-python==1.4.4", "numpy==1.26.4", "scipy==1.15.3"),
    ),
    "pybotics 3.1.2": Peer("in_pybotics.py", "own", ("pybotics==3.1.2", "numpy==1.26.4", "scipy==1.15.3")),
    OPTIMUM: Peer("in_numpy.py", "gauss-newton"),
    "scipy, finite differences": Peer("in_numpy.py", "scipy"),
}  # fmt: skip
FIGAROH = PEERS["figaroh 1.0.2"]
WITH_COMPLIANCE = {
    "fg_calib, geometry alone": Peer("in_fg_calib.py", "geometry"),
    CALIBRATE: PEERS[CALIBRATE],
    SOLVE: PEERS[SOLVE],
    "figaroh, geometry alone": replace(FIGAROH, variant="geometry"),
    "figaroh 1.0.2": FIGAROH,
    OPTIMUM: Peer("in_numpy.py", "compliant"),
}
"""Peers of the arm that gives way to gravity; the other packages do not model that."""

JUDGED_BY = {name: f"position {'rms' if name in ('distances', 'real') else 'mean'}" for name in
             ("poses", "distances", "compliance", "many", "real")}  # fmt: skip


def make_work(name: str, draws: int) -> works.Work | None:
    """Make one of the works; None where its data are missing."""
    if name == "real":
        data = data_folder("ur10_tmac")
        return None if data is None else works.real(data, min(draws, 3))
    n = 5000 if name == "many" else 60
    return works.simulated(n, min(draws, 3) if name == "many" else draws, 0, name == "distances", name == "compliance")


def peers_of(name: str) -> dict[str, Peer]:
    """The peers that do a work."""
    return WITH_COMPLIANCE if name == "compliance" else PEERS


def environment(requires: tuple[str, ...]) -> tuple[Path | None, str]:
    """The Python of a virtual environment that has these packages, or None and why there is none."""
    if not requires:
        return Path(sys.executable), ""
    cache = Path(os.environ.get("FG_CALIB_PEERS", Path(tempfile.gettempdir()) / "fg_calib_peers"))
    folder = cache / requires[0].replace("==", "-")
    python, done = folder / "bin" / "python", folder / "installed.txt"
    if done.is_file() and done.read_text().split() == list(requires):
        return python, ""
    base = next(filter(None, map(_working, PYTHONS)), None)
    if base is None:
        return None, "no Python 3.10 to 3.12 found"
    for command in ([base, "-m", "venv", "--clear", folder], [python, "-m", "pip", "install", "--quiet", *requires]):
        ended = subprocess.run([str(part) for part in command], check=False, capture_output=True, text=True)
        if ended.returncode:
            return None, "does not install: " + (ended.stderr.strip().splitlines() or ["no message"])[-1][:200]
    done.write_text("\n".join(requires) + "\n")
    return python, ""


def _working(name: str) -> str | None:
    path = shutil.which(name)
    ended = path and subprocess.run([path, "-c", ""], check=False, capture_output=True)
    return path if ended and ended.returncode == 0 else None


def run_peer(task: Task) -> Row:
    """Errors and processor times of one peer on all draws of one work."""
    name, peer_name, draws = task
    peer, work = peers_of(name)[peer_name], make_work(name, draws)
    python, reason = environment(peer.requires)
    if work is None or python is None:
        return {"reason": reason or "the data are missing"}
    env = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    env |= {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL")}
    if not peer.requires:
        env["PYTHONPATH"] = str(HERE.parent)
    with tempfile.TemporaryDirectory() as folder:
        path, out = Path(folder) / "work.npz", Path(folder) / "result.npz"
        work.write(path)
        command = [str(python), str(ADAPTERS / peer.script), peer.variant, str(path), str(out), str(draws), f"{CAP:g}"]
        ended = subprocess.run(command, check=False, capture_output=True, text=True, env=env)
        if not out.is_file():
            return {"reason": (ended.stderr.strip().splitlines() or [""])[-1][:200]}
        with np.load(out) as found:
            notes = json.loads(str(found["notes"]))
            if "processors" not in found:
                return {"reason": notes.get("reason", "no draw ended")}
            each = zip(found["draw"].tolist(), found["position"], found["rotation"], strict=True)
            row = {
                "draws": found["draw"].tolist(),
                "errors": [works.judge(work, *of)[JUDGED_BY[name]] for of in each],
                "seconds": float(np.median(found["processors"])),
            }
            if "compliance" in found and found["compliance"].size:
                estimate, sigma = np.moveaxis(found["compliance"], 1, 0)
                z = (estimate - works.COMPLIANCE[1:]) / sigma
                row |= {"sigma of k": sigma.mean(axis=0), "z of k": rms(z), "z of k by joint": np.sqrt((z**2).mean(0))}
            return row


def summarise(tasks: Sequence[Task], rows: Sequence[Row]) -> Row:
    """Error over the optimum's on the same draws, processor time, and ratios to the fastest package."""
    table: Row = {peer: dict(row) for (_, peer, _), row in zip(tasks, rows, strict=True)}
    best = table[OPTIMUM]
    for row in table.values():
        if "draws" in row and "draws" in best:
            same = [k for k in row["draws"] if k in best["draws"]]
            ours, least = (np.mean([of["errors"][of["draws"].index(k)] for k in same]) for of in (row, best))
            row["over optimum"] = float(ours / least)
    packages = [table[peer] for name, peer, _ in tasks if peers_of(name)[peer].requires]
    good = [row["seconds"] for row in packages if row.get("over optimum", 9.0) <= EQUAL]
    ratios = {who: min(good) / table[who]["seconds"] for who in (CALIBRATE, SOLVE) if good and "seconds" in table[who]}
    return {"peers": table, "fastest package as accurate takes times ours": ratios}


def answer(found: Row) -> str:
    """Error and time of every peer."""
    cells = []
    for peer, row in found["peers"].items():
        if "over optimum" in row:
            z = f", z of k {row['z of k']:.2f}" if "z of k" in row else ""
            cells.append(f"{peer.removeprefix('fg_calib, ')} {row['over optimum']:.2f}, {1e3 * row['seconds']:.3g}{z}")
        else:
            cells.append(f"{peer}: {row.get('reason', '')}")
    ours = {
        who.removeprefix("fg_calib, "): x for who, x in found["fastest package as accurate takes times ours"].items()
    }
    ratios = ", ".join(f"{x:.0f} {'times ' * (k == 0)}{who}" for k, (who, x) in enumerate(ours.items()))
    text = f"Error over optimum, processor ms: {'; '.join(cells)}"
    return f"{text}. Fastest accurate package takes {ratios or '-'}"


TITLES = {
    "poses": "60 simulated poses",
    "compliance": "60 simulated poses, joints that give way",
    "distances": "300 simulated distances",
    "many": "5000 simulated poses",
    "real": "real poses by a laser tracker",
}


def draw(found: Row, path: Path) -> None:
    """Draw time and error of every peer."""
    shown = {peer: row for peer, row in found["peers"].items() if "over optimum" in row}
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    times, errors = figure.subplots(1, 2, sharey=True)
    for k, row in enumerate(shown.values()):
        times.plot(1e3 * row["seconds"], k, "o", color=COLOURS[0])
        errors.plot(row["over optimum"], k, "o", color=COLOURS[1])
    times.set_yticks(range(len(shown)), list(shown))
    times.invert_yaxis()
    times.set(xscale="log", xlabel="processor time [ms]")
    errors.set(xlabel="tool error over that of whitened least squares")
    figure.suptitle(f"A UR10, {TITLES[path.stem.removeprefix('peers_')]}: left is better")
    for axes in (times, errors):
        axes.grid(axis="x", alpha=0.3)
        clean(axes)
    figure.savefig(path, dpi=110)


def question(name: str, words: str, draws: int) -> Question:
    """The question of one work: every peer runs all draws."""
    tasks: Any = lambda n, s: [(name, peer, n) for peer in peers_of(name)]  # noqa: E731
    return Question(name, words, tasks, run_peer, summarise, answer, (draws, 1),
                    draw if peers_of(name) is PEERS else None, timed=True)  # fmt: skip


QUESTIONS = (
    question("poses", "How do other packages do on 60 poses of a UR10?", 20),
    question("compliance", "And where its joints give way?", 20),
    question("distances", "And on 300 distances between 60 poses?", 20),
    question("many", "And on 5000 poses?", 3),
    question("real", "And on a real UR10?", 3),
)

if __name__ == "__main__":
    run(QUESTIONS, Path(__file__).stem, __doc__, sys.argv[1:])
