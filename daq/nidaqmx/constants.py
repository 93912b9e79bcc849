"""Constants, under the names of `nidaqmx.constants`."""

from daq.constants import *  # noqa: F403
