"""Does a result survive kills, full disks and two writers: is what a reader accepts wholly old or wholly new?

Command: `python experiments/faults.py` (about 3 minutes; `--quick` a tenth of it, `--seed`).

Two calibrations of the space robot are saved in turn to one folder. A process that does so is killed (SIGKILL) at
random moments, and at each of its calls that make, write, move or remove a file; so is the whole command. Disks of
little room are tmpfs of few kilobytes where they may be mounted. After each fault the folder is read with
`Calibration.load`, which must give one of the two, and the files beside `result.json` must be byte by byte of the
same, as the package reads them: what a kill left to be moved to its place counts as written. Then it is written anew.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from fg_calib import Calibration, InputError, calibrate, read_scenario, simulate
from fg_calib.io.disk import read_bytes

NAMES = ("result.json", "residuals.csv", "configurations.csv", "robot_calibrated.yaml")
STEPS = ("rename", "replace", "rmdir", "mkdir", "unlink", "open", "listdir")


def in_child(work: Callable[[], object]) -> int:
    """Start work in a process of its own, which has all that is loaded here; its id."""
    child = os.fork()
    if child:
        return child
    try:
        work()
        os._exit(0)
    except BaseException:
        os._exit(1)


def killed_at_random(folder: Path, versions: list[Calibration], seconds: float) -> int:
    """Save in turn until killed."""

    def work() -> None:
        while True:
            for version in versions:
                version.save(folder)

    child = in_child(work)
    time.sleep(seconds)
    os.kill(child, signal.SIGKILL)
    return os.waitpid(child, 0)[1]


def killed_at_step(folder: Path, version: Calibration, step: int) -> int:
    """Save once, and be killed at the given call that changes or lists files."""

    def work() -> None:
        left = step

        def counted(original: Callable[..., object]) -> Callable[..., object]:
            def call(*args: object, **kwargs: object) -> object:
                nonlocal left
                left -= 1
                if left < 0:
                    os.kill(os.getpid(), signal.SIGKILL)
                return original(*args, **kwargs)

            return call

        for name in STEPS:
            setattr(os, name, counted(getattr(os, name)))
        version.save(folder)

    return os.waitpid(in_child(work), 0)[1]


def accepted(folder: Path, whole: list[dict[str, bytes]]) -> str:
    """Which version the folder holds by its public reader: `0`, `1`, `refused`, or `mixed`."""
    try:
        Calibration.load(folder)
    except InputError as error:
        return f"refused: {error}"
    found = {name: read_bytes(folder / name) for name in NAMES}
    return str(whole.index(found)) if found in whole else "mixed"


def on_a_small_disk(folder: Path, version: Calibration, kilobytes: int) -> str:
    """Save where there is room for so much; what is said, or `no tmpfs` where none may be mounted."""
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={kilobytes}k", "tmpfs", str(folder)], check=False, capture_output=True
    )
    if mounted.returncode:
        return "no tmpfs"

    def work() -> None:
        try:
            version.save(folder)
        except InputError as error:
            os._exit(2 if "\n" in str(error) or any((folder / name).exists() for name in NAMES) else 3)

    ended = os.waitstatus_to_exitcode(os.waitpid(in_child(work), 0)[1])
    subprocess.run(["umount", str(folder)], check=True)
    return {0: "saved", 2: "left files", 3: "one line, no files"}.get(ended, f"ended with {ended}")


def command_killed(job: Path, out: Path, seconds: float) -> None:
    """The whole command, killed after some time."""
    command = [sys.executable, "-m", "fg_calib.cli", "calibrate", str(job), "--out", str(out)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            process.wait(seconds)
        except subprocess.TimeoutExpired:
            process.kill()


def run(folder: Path, part: int, seed: int) -> dict[str, Counter[str]]:
    """All faults, `1 / part` of each; what was found after them, counted."""
    rng, found = random.Random(seed), {}
    simulations = [simulate(read_scenario("space-robot"), k) for k in (1, 2)]
    versions = [calibrate(s.robot, s.measurements, model="distance-rotation") for s in simulations]
    whole = []
    for version in versions:  # in a child: threads of libraries that write do not survive a fork
        os.waitpid(in_child(lambda v=version: v.save(folder)), 0)
        whole.append({name: (folder / name).read_bytes() for name in NAMES})
    found["200 kills at random"] = Counter()
    for _ in range(200 // part):
        killed_at_random(folder, versions, rng.uniform(0.0, 0.5))
        found["200 kills at random"][accepted(folder, whole)] += 1
    found["kills at each step"] = Counter()
    for k in range(0, 80, part):
        step, new = k // 2, k // part % 2
        ended = killed_at_step(folder, versions[new], step)
        which = accepted(folder, whole)
        found["kills at each step"][which if ended else f"not killed, {'new' if which == str(new) else which}"] += 1
    found["two writers, both killed"] = Counter()
    for _ in range(40 // part):
        other = in_child(lambda: [versions[1].save(folder) for _ in range(1000)])
        killed_at_random(folder, versions[:1], rng.uniform(0.0, 0.6))
        os.kill(other, signal.SIGKILL)
        os.waitpid(other, 0)
        found["two writers, both killed"][accepted(folder, whole)] += 1
    small = folder.with_name("small")
    small.mkdir()
    found["disks of 4 to 2000 kB"] = Counter(
        on_a_small_disk(small, versions[0], int(4 * 1.17**k)) for k in range(0, 40, part)
    )
    left = [file.name for file in folder.iterdir() if file.name not in NAMES]
    os.waitpid(in_child(lambda: versions[0].save(folder)), 0)
    found["hidden folders"] = Counter(
        {"before the last writing": len(left), "after it": len(os.listdir(folder)) - len(NAMES)}
    )
    return found | {"20 kills of the whole command": whole_commands(folder.parent, 20 // part, rng)}


def whole_commands(folder: Path, n: int, rng: random.Random) -> Counter[str]:
    """Kills of the whole command, which replaces a result of another job."""
    import fg_calib

    job, old, new = (folder / name for name in ("job", "old", "new"))
    shutil.copytree(Path(fg_calib.__file__).parent / "examples" / "space-robot", job)
    command_killed(job / "calibration.yaml", old, 600)
    text = (job / "calibration.yaml").read_text()
    (job / "calibration.yaml").write_text(text.replace("pairing: star", "pairing: chain"))
    started = time.monotonic()
    command_killed(job / "calibration.yaml", new, 600)
    took = time.monotonic() - started
    pairings, found = {Calibration.load(f).result.pairing: f for f in (old, new)}, Counter[str]()
    for _ in range(n):
        command_killed(job / "calibration.yaml", old, rng.uniform(0.6, 1.1) * took)
        which = pairings[Calibration.load(old).result.pairing]
        same = which == old or read_bytes(old / "residuals.csv") == read_bytes(which / "residuals.csv")
        found["whole" if same else "mixed"] += 1
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for fault, counts in run(Path(folder) / "result", 10 if given.quick else 1, given.seed).items():
            print(f"{fault}: {dict(sorted(counts.items()))}")


if __name__ == "__main__":
    main()
