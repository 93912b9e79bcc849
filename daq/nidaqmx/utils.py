"""Lists of channel names, under the names of `nidaqmx.utils`."""

from daq.terminals import flatten as flatten_channel_string
from daq.terminals import unflatten as unflatten_channel_string

__all__ = ["flatten_channel_string", "unflatten_channel_string"]
