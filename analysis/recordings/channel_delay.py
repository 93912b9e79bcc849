"""Delay of a channel: the samples over which its filter spreads an event."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from daq.signal_chain.channel import ChannelInfo


def arrival(info: ChannelInfo, first: int, last: int) -> tuple[int, int]:
    """Return the first and last sample of a channel that contain the events between two samples of the clock.

    A marker contains the time of an action. Unless the delay of the channel was removed, the corresponding samples are
    later by this delay. The filter extends them to either side by half its length.

    >>> from daq.signal_chain.channel import ChannelInfo
    >>> from daq.signal_chain.decimation_filter import Decimation
    >>> low_pass = Decimation.standard(5120.0)
    >>> delayed = ChannelInfo("hammer", "hammer", "force", 1.0, 5120.0, delay=38 / 5120, filter=low_pass.design)
    >>> arrival(delayed, 1000, 1020)
    (1000, 1096)
    """
    delay = info.delay * info.rate
    spread = info.filter.get("delay", 0.0)
    # A millionth of a sample is a rounding error and must not add another sample.
    begin = math.floor(first + delay - spread + 1e-6)
    return begin, math.ceil(last + delay + spread + info.average - 1e-6)
