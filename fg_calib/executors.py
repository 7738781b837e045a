"""Former name of `parallel`."""

from fg_calib.parallel import *  # noqa: F403
