"""How do other packages, and what one writes by hand, do on the same work: error, time, and what they say of it?

Command: python experiments/benchmarks/peers.py [--quick] [--out FOLDER] [--cache FOLDER] [--only PEER ...]
    [--works WORK ...] [--draws N] [--cap S] [--seed N]

Takes about half an hour of processors, most of it pybotics and 5000 poses. With `--only` or `--works` other rows in the
results stay as they are, so that `--only fg_calib` (a minute) is all it takes after a change of ours.

The works are those of `side_by_side/works.py`, how a peer is run and timed stands in `side_by_side/protocol.py`, and
what is called of each in `side_by_side/in_*.py`. Packages are installed into virtual environments of their own in
`--cache`, which need some minutes, 2 GB and a package index the first time. One that does not install, or cannot do a
work, says why. Every process has one BLAS thread, and about `--cap` seconds for a work. On a machine that
others use read the processor time: the clock counts what they did.

Expected: fg_calib within 1 % of the optimum on every work; figaroh within 10 % of it, 0.4 s for 60 poses; robotkinecal
1.2 to 1.4 times and pybotics 1.0 (distances) to 1.5 times the optimum; numpy by hand as good, and quicker than ours.

`--quick` runs what needs no other package, on one draw of poses and of pairs.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
SCRIPTS = Path(__file__).resolve().parent / "side_by_side"
sys.path.insert(0, str(SCRIPTS))

import works  # noqa: E402 - beside this script, for peers' processes too

NAME = "peers"
OPTIMUM = "numpy Gauss-Newton"
"""Whose error on the same draws every error is compared with: minimum-norm least squares of the whitened residuals."""

EQUAL = 1.1
"""Peers count as equally accurate whose error is at most so many times that of the optimum."""

PYTHONS = ("python3.12", "python3.11", "python3.10")
RANGE = ((3, 10), (3, 12))
"""Versions of Python, first and last, for which all pinned packages have wheels."""


@dataclass(frozen=True)
class Peer:
    """One way to calibrate.

    Attributes:
        name: In tables.
        script: In `side_by_side`.
        variant: See `protocol.main`.
        requires: What is installed for it, pinned; empty if it runs in this environment.
        label: In the picture.
    """

    name: str
    script: str
    variant: str
    requires: tuple[str, ...] = ()
    label: str = ""

    @property
    def package(self) -> str:
        """Name and version of what it is, empty if it runs in this environment."""
        return self.requires[0] if self.requires else ""


FIGAROH = ("figaroh==1.0.2", "numpy==2.2.6", "scipy==1.15.3")
ROBOTKINECAL = ("robotkinecal==0.1.0", "roboticstoolbox-python==1.4.4", "numpy==1.26.4", "scipy==1.15.3")
PYBOTICS = ("pybotics==3.1.2", "numpy==1.26.4", "scipy==1.15.3")

PEERS = (
    Peer("fg_calib, calibrate()", "in_fg_calib.py", "calibrate", label="fg_calib: calibrate()"),
    Peer("fg_calib, told tolerances", "in_fg_calib.py", "told"),
    Peer("fg_calib, build and solve", "in_fg_calib.py", "solve", label="fg_calib: solve alone"),
    Peer("figaroh 1.0.2", "in_figaroh.py", "figaroh", FIGAROH, label="figaroh"),
    Peer("robotkinecal 0.1.0", "in_robotkinecal.py", "robotkinecal", ROBOTKINECAL, label="robotkinecal"),
    Peer("pybotics 3.1.2", "in_pybotics.py", "own", PYBOTICS, "pybotics"),
    Peer("pybotics, vector residual", "in_pybotics.py", "vector", PYBOTICS, "pybotics, vector residual"),
    Peer(OPTIMUM, "in_numpy.py", "gauss-newton", label="numpy Gauss-Newton"),
    Peer("scipy, our derivatives", "in_fg_calib.py", "scipy", label="scipy, our derivatives"),
    Peer("scipy, finite differences", "in_numpy.py", "scipy", label="scipy, finite differences"),
    Peer("GTSAM, a Python factor each", "in_fg_calib.py", "one by one", (), "GTSAM, a Python factor each"),
)
CALIBRATE, TOLD, SOLVE = (peer.name for peer in PEERS[:3])

Works = dict[str, Callable[[int], works.Work]]


def works_of(seed: int, quick: bool) -> Works:
    """The works by name, each made from how many draws are wanted."""
    chosen: Works = {
        "poses": lambda draws: works.simulated(60, draws, seed),
        "pairs": lambda draws: works.simulated(60, draws, seed, pairs=True),
    }
    if quick:
        return chosen
    data = Path(os.environ.get("FG_CALIB_DATA", ROOT.parent / "shared" / "data")) / "ur10_tmac"
    chosen["many"] = lambda draws: works.simulated(5000, min(draws, 3), seed)
    chosen["repeats"] = lambda draws: works.simulated(60, draws, seed, one_arm=True)
    if data.is_dir():
        chosen["real"] = lambda draws: works.real(data, min(draws, 3))
    return chosen


def environment(requires: tuple[str, ...], cache: Path, versions: Any = RANGE) -> tuple[Path | None, str]:
    """A virtual environment that has these packages: its Python, or None and why there is none.

    Args:
        requires: Pinned requirements; the first names the folder.
        cache: Where environments are, and stay for the next time.
        versions: First and last version of Python that will do.
    """
    folder = cache / requires[0].replace("==", "-")
    python, done = folder / "bin" / "python", folder / "installed.txt"
    if done.is_file() and done.read_text().split() == list(requires):
        return python, ""
    base = next(filter(None, (_fitting(name, versions) for name in (sys.executable, *PYTHONS))), None)
    if base is None:
        first, last = (".".join(map(str, version)) for version in versions)
        return None, f"no Python {first} to {last} found"
    for command in ([base, "-m", "venv", "--clear", folder], [python, "-m", "pip", "install", "--quiet", *requires]):
        ended = subprocess.run([str(part) for part in command], check=False, capture_output=True, text=True)
        if ended.returncode:
            return None, "does not install: " + (ended.stderr.strip().splitlines() or ["no message"])[-1][:200]
    done.write_text("\n".join(requires) + "\n")
    return python, ""


def _fitting(name: str, versions: Any) -> str | None:
    """The path of a Python if there is one and its version will do."""
    path = shutil.which(name)
    if path is None:
        return None
    code = "import sys; print(*sys.version_info[:2])"
    ended = subprocess.run([path, "-c", code], check=False, capture_output=True, text=True)
    first, last = versions
    return path if ended.returncode == 0 and first <= tuple(map(int, ended.stdout.split())) <= last else None


def run_peer(peer: Peer, python: Path, path: Path, draws: int, cap: float) -> dict[str, Any]:
    """Arrays and notes that a peer made of a work file (see `protocol`)."""
    env = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    env |= {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL")}
    if not peer.requires:
        env["PYTHONPATH"] = str(ROOT)
    out = path.with_name("result.npz")
    out.unlink(missing_ok=True)
    command = [str(python), str(SCRIPTS / peer.script), peer.variant, str(path), str(out), str(draws), f"{cap:g}"]
    limit = 10.0 * cap + 600.0  # by the clock, of what does not listen to its own
    try:
        ended = subprocess.run(command, check=False, capture_output=True, text=True, env=env, timeout=limit)
        message = (ended.stderr.strip().splitlines() or [""])[-1]
    except subprocess.TimeoutExpired:
        message = f"ended after {limit:g} s"
    if not out.is_file():
        return {"notes": {"reason": message[:200]}}
    with np.load(out) as found:
        return {name: json.loads(str(found[name])) if name == "notes" else found[name] for name in found.files}


def judged(work: works.Work, found: dict[str, Any]) -> dict[str, Any]:
    """The numbers of one peer on one work, in SI units."""
    row: dict[str, Any] = {"draws": len(found.get("seconds", ()))} | found["notes"]
    if not row["draws"]:
        return row
    for name in ("seconds", "processors", "setup"):
        row[name] = float(np.median(found[name]))
    row["seconds from, to"] = [float(np.min(found["seconds"])), float(np.max(found["seconds"]))]
    draws = row["draw"] = found["draw"].tolist()
    each = [works.judge(work, *of_draw) for of_draw in zip(draws, found["position"], found["rotation"], strict=True)]
    row["errors"] = {name: [error[name] for error in each] for name in each[0]}
    if "sigma" in found:
        row["sigma zero"] = int(np.max(np.sum(found["sigma"] < 1e-9, axis=1)))
        row["sigma none"] = int(np.max(np.sum(np.isnan(found["sigma"]), axis=1)))
        row["parameters"] = found["sigma"].shape[1]
        row["largest change"] = float(np.max(np.abs(found["parameters"])))
    if "covariance" in found and work.frames_known:
        C, e = found["covariance"], found["position"] - work.position[draws]
        known = np.isfinite(C).all((2, 3))
        row["determined"] = float(np.mean(known))
        of_draws = [nees(e[i][known[i]], C[i][known[i]]) for i in range(len(draws)) if known[i].any()]
        if of_draws and not row.get("sigma zero"):
            chance = np.std(of_draws, ddof=1) / np.sqrt(len(of_draws)) if len(of_draws) > 1 else np.inf
            row["nees"] = [float(np.mean(of_draws)), float(chance)]
    return row


def nees(e: np.ndarray, C: np.ndarray) -> float:
    """Mean squared error over claimed variance: 1 if claims are true.

    Args:
        e: Errors, shape (n, 3), [m].
        C: Their covariances as claimed, shape (n, 3, 3), [m^2].
    """
    return float(np.mean(e[:, None] @ np.linalg.solve(C, e[:, :, None]))) / 3.0


def spread(found: dict[str, Any]) -> list[float]:
    """Least, median and largest over parameters of the spread of estimates over the sigma claimed."""
    claimed = np.sqrt(np.mean(found["sigma"] ** 2, axis=0))
    sd = np.std(found["parameters"], axis=0, ddof=1)
    ratio = (sd / np.where(claimed > 0.0, claimed, np.nan))[np.isfinite(claimed)]
    return [float(of(ratio)) for of in (np.nanmin, np.nanmedian, np.nanmax)]


def run(
    out: Path,
    cache: Path,
    quick: bool = False,
    only: Sequence[str] = (),
    works_wanted: Sequence[str] = (),
    draws: int = 20,
    cap: float = 120.0,
    seed: int = 0,
) -> dict[str, Any]:
    """The benchmark; writes numbers and the picture into `out`."""
    draws = 1 if quick else draws
    made = {
        name: make(draws) for name, make in works_of(seed, quick).items() if not works_wanted or name in works_wanted
    }
    table: dict[str, dict[str, Any]] = {name: {} for name in made}
    skipped: dict[str, str] = {}
    with TemporaryDirectory() as folder:
        paths = {name: Path(folder) / name / "work.npz" for name in made}
        for name, work in made.items():
            paths[name].parent.mkdir()
            work.write(paths[name])
        for peer in PEERS:
            if only and peer.name != OPTIMUM and not any(word in peer.name for word in only):
                continue
            python, reason = Path(sys.executable), ""
            if peer.requires:
                python, reason = (None, "not installed with --quick") if quick else environment(peer.requires, cache)
            if python is None:
                skipped[peer.name] = reason
                continue
            for name, work in made.items():
                if name == "repeats" and "sigma zero" not in table.get("poses", {}).get(peer.name, {"sigma zero": 0}):
                    continue  # it claims no sigma
                found = run_peer(peer, python, paths[name], work.n_draws, cap)
                row = table[name][peer.name] = judged(work, found)
                if name == "repeats" and row["draws"] > 1 and "sigma" in found:
                    row["spread over sigma"] = spread(found)
                print(name, "|", describe_row(row, peer.name, name), file=sys.stderr)
    record = out / f"{NAME}.json"
    if (only or works_wanted) and record.is_file():
        before = json.loads(record.read_text())
        if before["quick"] == quick:  # rows of other draws are not to stand beside these
            for name, rows in before["works"].items():
                table[name] = rows | table.get(name, {})
            skipped = {name: reason for name, reason in before["skipped"].items() if name not in skipped} | skipped
    table = {
        work: {peer.name: rows[peer.name] for peer in PEERS if peer.name in rows}
        for work, rows in ((work, table[work]) for work in HOW if work in table)
    }
    for rows in table.values():
        compare(rows)
    results = {
        "quick": quick,
        "skipped": skipped,
        "packages": {p.package: list(p.requires) for p in PEERS if p.requires},
        "here": {name: importlib.metadata.version(name) for name in ("gtsam", "numba", "numpy", "scipy")},
        "works": table,
        "speed": {name: speed(rows) for name, rows in table.items() if name != "repeats"},
    }
    out.mkdir(parents=True, exist_ok=True)
    record.write_text(json.dumps(rounded(results), indent=1) + "\n")
    draw({name: rows for name, rows in table.items() if name in TITLES}, out / f"{NAME}.png")
    return results


def rounded(value: Any) -> Any:
    """The same with four digits, and None for what is not a number."""
    if isinstance(value, dict):
        return {key: rounded(v) for key, v in value.items()}
    if isinstance(value, list):
        return [rounded(v) for v in value]
    if isinstance(value, float):
        return float(f"{value:.4g}") if np.isfinite(value) else None
    return value


HOW = {"poses": "mean", "many": "mean", "repeats": "mean", "pairs": "rms", "real": "rms"}
"""Which error a work is judged by."""


def error(row: dict[str, Any], work: str, of: str = "position") -> float:
    """Of the draws that were done, [m] or [rad]."""
    return float(np.mean(row["errors"][f"{of} {HOW[work]}"]))


def compare(rows: dict[str, dict[str, Any]]) -> None:
    """Put into every row its error over that of the optimum on the same draws."""
    best = rows.get(OPTIMUM, {"draws": 0})
    for row in rows.values():
        both = sorted(set(row.get("draw", ())) & set(best.get("draw", ())))
        for name in row["errors"] if both else ():
            ours, least = (np.mean([of["errors"][name][of["draw"].index(i)] for i in both]) for of in (row, best))
            row.setdefault("over optimum", {})[name] = float(ours / least)


def speed(rows: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """How many times faster than the fastest package that is as accurate, and than what is written by hand."""
    solved = {name: row for name, row in rows.items() if row["draws"]}
    packages = [peer.name for peer in PEERS if peer.package and peer.name in solved]
    as_good = [name for name in packages if solved[name].get("over optimum", {}).get("position mean", np.inf) <= EQUAL]
    fastest = {"any package": packages, "package as accurate": as_good}
    others = {what: min(names, key=lambda name: solved[name]["processors"]) for what, names in fastest.items() if names}
    others |= {name: name for name in (OPTIMUM, "scipy, our derivatives") if name in solved}
    return {
        what: {"is": other}
        | {
            f"{ours}: {clock}": solved[other][clock] / solved[ours][clock]
            for ours in (CALIBRATE, SOLVE)
            if ours in solved
            for clock in ("seconds", "processors")
        }
        for what, other in others.items()
    }


def describe_row(row: dict[str, Any], name: str, work: str) -> str:
    """A line of the table."""
    if not row["draws"]:
        return f"{name:28} {row.get('reason', '')}"
    over = row.get("over optimum", {}).get(f"position {HOW[work]}")
    cells = [
        f"{name:28}{row['draws']:4}{error(row, work) * 1e3:9.4f}",
        f"{over:7.3f}" if over else " " * 7,
        f"{error(row, work, 'rotation') * 1e3:9.4f}",
        f"{row['seconds'] * 1e3:10.1f}{row['processors'] * 1e3:10.1f}{row['setup'] * 1e3:9.1f}",
        says(row),
        f"({row['failed']} failed)" if "failed" in row else "",
        row.get("reason", ""),
    ]
    return " ".join(filter(None, cells))


def says(row: dict[str, Any]) -> str:
    """What is claimed of the uncertainty against what came true."""
    parts = []
    if "nees" in row:
        mean, chance = row["nees"]
        parts.append(f"NEES {mean:.2f}" + (f" ± {chance:.2f}" if chance and np.isfinite(chance) else ""))
    if row.get("determined", 1.0) < 1.0:
        parts.append(f"no sigma at {1.0 - row['determined']:.0%} of configurations")
    if "spread over sigma" in row:
        least, middle, most = row["spread over sigma"]
        parts.append(f"spread over sigma {middle:.2f} ({least:.2g} to {most:.2g})")
    if row.get("sigma zero"):
        parts.append(f"sigma 0 for {row['sigma zero']} of {row['parameters']}, largest {row['largest change']:.1g}")
    return ", ".join(parts) or row.get("states", "")


def describe(results: dict[str, Any]) -> str:
    """The tables for people."""
    lines = []
    for work, rows in results["works"].items():
        lines += [f"\n{work}", f"{'':28}   n       mm   over      mrad        ms processor    setup  uncertainty"]
        lines += [describe_row(row, name, work) for name, row in rows.items()]
        for what, ratios in results["speed"].get(work, {}).items():
            figures = ", ".join(f"{key} {value:.2f}" for key, value in ratios.items() if key != "is")
            lines.append(f"  {what} ({ratios['is']}) takes times ours, {figures}")
    lines += [f"{name}: {reason}" for name, reason in results["skipped"].items()]
    return "\n".join(lines[1:])


COLOURS = {"poses": "#0072B2", "pairs": "#D55E00", "many": "#009E73", "real": "#CC79A7"}  # Okabe & Ito
MARKS = {"poses": "o", "pairs": "s", "many": "^", "real": "D"}
TITLES = {"poses": "60 poses", "pairs": "300 distances", "many": "5000 poses", "real": "1046 poses, real UR10"}


def draw(table: dict[str, dict[str, Any]], path: Path) -> None:
    """Time and error of every peer, a mark a work."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 4.6), layout="constrained")
    times, errors = figure.subplots(1, 2, sharey=True)
    shown = [peer for peer in PEERS if peer.label]
    for k, (work, rows) in enumerate(table.items()):
        style = {"marker": MARKS[work], "color": COLOURS[work], "linestyle": "", "markersize": 6}
        times.plot([], [], label=TITLES[work], **style)
        for i, peer in enumerate(shown):
            row, y = rows.get(peer.name, {"draws": 0}), i + 0.18 * (k - 1.5)
            if row["draws"]:
                times.plot(row["processors"], y, **style)
                errors.plot(row["over optimum"][f"position {HOW[work]}"], y, **style)
            elif row.get("reason", "").startswith("ended after"):
                times.plot(float(row["reason"].split()[2]), y, **style | {"markerfacecolor": "none"})
    for i in range(len(shown)):
        for axes in (times, errors):
            axes.axhspan(i - 0.5, i + 0.5, color="#000000", alpha=0.04 if i % 2 else 0.0, lw=0)
    times.set_yticks(range(len(shown)), [peer.label for peer in shown])
    times.invert_yaxis()
    times.set_xscale("log")
    times.set_xlabel("processor time to solve, s (hollow: ended)")
    errors.axvline(1.0, color="#666666", lw=0.8)
    errors.set_xlabel("validation error over that of whitened least squares")
    for axes in (times, errors):
        axes.grid(axis="x", alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside upper center", ncols=len(table), frameon=False)
    figure.savefig(path, dpi=130)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="no other packages, one draw, poses and pairs alone")
    parser.add_argument("--out", type=Path, default=ROOT / "experiments" / "results", help="folder for the results")
    cache = Path(gettempdir()) / "fg_calib-peers"
    parser.add_argument("--cache", type=Path, default=cache, help=f"folder of the virtual environments; {cache}")
    parser.add_argument("--only", nargs="+", default=(), help="peers whose names have one of these, and the optimum")
    parser.add_argument("--works", dest="works_wanted", nargs="+", default=(), choices=tuple(HOW), help="these alone")
    parser.add_argument("--draws", type=int, default=20, help="of simulated arms")
    parser.add_argument("--cap", type=float, default=120.0, help="seconds for a peer on a work")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(arguments)
    if unknown := [word for word in given.only if not any(word in peer.name for peer in PEERS)]:
        parser.error(f"--only: no peer is called {', '.join(unknown)}; there are {', '.join(p.name for p in PEERS)}")
    print(describe(run(**vars(given))))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
