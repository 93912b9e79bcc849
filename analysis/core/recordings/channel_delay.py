"""Delay of a channel due to the filter of its converter: the samples that contain an event at a given time."""

import math

from daq.core.signal_chain.channel import ChannelInfo


def arrival(info: ChannelInfo, first: int, last: int) -> tuple[int, int]:
    """Return the first and the last sample of a channel that events between two instants of the sample clock affect.

    `first`, `last`: instants as sample indices, for example of a marker. The affected samples are later by the delay of
    the channel, unless the delay was removed. The filter spreads an event to either side by half the length of the
    filter.

    >>> from daq.core.signal_chain.channel import ChannelInfo
    >>> from daq.core.signal_chain.decimation_filter import DecimationFilter
    >>> low_pass = DecimationFilter.standard(5120.0)
    >>> delayed = ChannelInfo("hammer", "hammer", "force", 1.0, 5120.0, delay=38 / 5120, filter=low_pass.parameters)
    >>> arrival(delayed, 1000, 1020)
    (1000, 1096)
    """
    delay = info.delay * info.rate
    half_length = info.filter.get("delay", 0.0)
    # A millionth of a sample is a rounding error and must not add another sample.
    begin = math.floor(first + delay - half_length + 1e-6)
    return begin, math.ceil(last + delay + half_length + info.average - 1e-6)
