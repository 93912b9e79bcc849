"""Delay of a channel: its filter spreads an event over later samples."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from daq.signal_chain.channel import ChannelInfo


def arrival(info: ChannelInfo, first: int, last: int) -> tuple[int, int]:
    """Return the first and last sample of a channel that contain the events between two samples of the clock.

    A marker contains the time of an action. The corresponding samples are later by the channel's delay, unless it was
    removed, and extend to either side by half the length of the filter.

    >>> from daq.signal_chain.channel import ChannelInfo
    >>> from daq.signal_chain.decimation_filter import Decimation
    >>> low_pass = Decimation.standard(5120.0)
    >>> late = ChannelInfo("hammer", "hammer", "force", 1.0, 5120.0, delay=38 / 5120, filter=low_pass.design)
    >>> arrival(late, 1000, 1020)
    (1000, 1096)
    """
    late = info.delay * info.rate
    spread = info.filter.get("delay", 0.0)
    # A millionth of a sample is rounding and must not add another sample.
    begin = math.floor(first + late - spread + 1e-6)
    return begin, math.ceil(last + late + spread + info.average - 1e-6)
