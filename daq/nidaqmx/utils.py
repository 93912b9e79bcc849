"""Lists of channel names, under the names of `nidaqmx.utils`."""

from daq.instrument.terminals import flatten as flatten_channel_string
from daq.instrument.terminals import unflatten as unflatten_channel_string

__all__ = ["flatten_channel_string", "unflatten_channel_string"]
