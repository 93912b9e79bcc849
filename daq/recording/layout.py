"""The layout of a recording: its topics, schemas and times.

`LAYOUT.md` next to this module describes it for readers who do not use this package.
"""

from __future__ import annotations

import math

VERSION = "1"

RAW = "/raw/"
TRUTH = "/truth/"
DISPLAY = "/display/"
MARKERS = "/markers"
EVENTS = "/truth/events"
ROBOT = "/robot_description"
TRANSFORMS = "/tf"
SCENE_FILE = "scene.yaml"


BLOCK_S = 0.1
SHORTEST_BLOCK = 256
FLUSH_S = 0.5
# Most groups that are displayed together: with few channels, the cost of a batch hardly depends on its size; with many,
# samples that wait take memory.
SHOWN_GROUPS = 4
_SHOWN_CHANNELS = 64


def shown_groups(channels: int) -> int:
    """Give the number of groups that are displayed together.

    >>> shown_groups(3), shown_groups(32), shown_groups(2000)
    (4, 2, 1)
    """
    return min(SHOWN_GROUPS, max(1, _SHOWN_CHANNELS // channels))


def block_length(rate: float) -> int:
    """Give the number of samples in a full block: the power of two nearest to 0.1 s, at least 256.

    >>> block_length(5120.0), block_length(51200.0), block_length(100.0)
    (512, 4096, 256)
    """
    return max(SHORTEST_BLOCK, 2 ** round(math.log2(max(1.0, rate * BLOCK_S))))


def flush_length(rate: float) -> int:
    """Give the number of samples that are committed to the disk together: whole blocks, about 0.5 s.

    >>> flush_length(5120.0) / 5120.0
    0.5
    """
    block = block_length(rate)
    return block * max(1, round(FLUSH_S * rate / block))
