"""Delay of a channel: its filter spreads an instant over later samples."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from daq.signal_chain.channel import ChannelInfo


def arrival(info: ChannelInfo, first: int, last: int) -> tuple[int, int]:
    """First and last sample in which a channel holds what happened between two samples of the clock.

    A marker bears the time at which something was done. The samples that show it come later by the
    channel's delay, where that was not removed, and spread to either side by half the length of its filter.

    Examples
    --------
    >>> from daq.signal_chain.channel import ChannelInfo
    >>> from daq.signal_chain.decimation_filter import Decimation
    >>> low_pass = Decimation.standard(5120.0)
    >>> late = ChannelInfo("hammer", "hammer", "force", 1.0, 5120.0, delay=38 / 5120, filter=low_pass.design)
    >>> arrival(late, 1000, 1020)
    (1000, 1096)
    """
    late = info.delay * info.rate
    spread = info.filter.get("delay", 0.0)
    # A millionth of a sample is rounding, and no reason to take one sample more.
    begin = math.floor(first + late - spread + 1e-6)
    return begin, math.ceil(last + late + spread + info.average - 1e-6)
