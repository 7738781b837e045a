"""Jobs that fail, and jobs that kill the process that they run on, for tests of executors."""

import os
import signal
from functools import partial

from fg_calib import InputError, calibrate_job


def work(what):
    """Twice a number; words say how there is none."""
    match what:
        case "refused":
            raise InputError("job.yaml", "found nonsense", "sense", "look at it")
        case "a bug":
            raise KeyError("of\nmine")
        case "too large":
            raise MemoryError
        case "cannot be sent":
            return lambda: what
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


def calibrate_or_die_once(job, marker, deadly):
    """`calibrate_job`, which kills its worker the first time that it runs on a certain job."""
    if str(job) == deadly:
        die_once(marker)
    return calibrate_job(job)


def deadly_calibration(marker, deadly):
    return partial(calibrate_or_die_once, marker=marker, deadly=str(deadly))


def every_bit(found):
    """All figures of a calibration's result but for times, floats by their bits."""
    return hexadecimal(found.result.document() | {"covariance of all": found.posterior.tangent.tolist()})


def hexadecimal(found):
    if isinstance(found, dict):
        return {k: hexadecimal(v) for k, v in found.items() if k not in ("seconds", "date")}
    if isinstance(found, list | tuple):
        return [hexadecimal(v) for v in found]
    return found.hex() if isinstance(found, float) else found
