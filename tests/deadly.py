"""Jobs that fail, and jobs that kill the process that they run on, for tests of executors."""

import os
import signal

from fg_calib import InputError


def work(what):
    """Twice a number; words say how there is none."""
    match what:
        case "refused":
            raise InputError("job.yaml", "found nonsense", "sense", "look at it")
        case "a bug":
            raise KeyError("of\nmine")
        case "too large":
            raise MemoryError
        case "deadly":
            die()
    return 2 * what


def die():
    os.kill(os.getpid(), signal.SIGKILL)


def die_once(marker):
    """Kill this process if nobody has done so before."""
    try:
        marker.touch(exist_ok=False)
    except FileExistsError:
        return
    die()
