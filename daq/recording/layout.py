"""The layout of a recording: its topics, schemas and times.

`LAYOUT.md` beside this module says the same for readers who do not use this package.
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
# Groups that are displayed together: most of the time goes into what is done once, whatever the number of messages.
SHOWN_GROUPS = 4


def block_length(rate: float) -> int:
    """Give the number of samples in a full block: the power of two nearest to 0.1 s, at least 256.

    >>> block_length(5120.0), block_length(51200.0), block_length(100.0)
    (512, 4096, 256)
    """
    return max(SHORTEST_BLOCK, 2 ** round(math.log2(max(1.0, rate * BLOCK_S))))


def flush_length(rate: float) -> int:
    """Give the number of samples after which what was recorded goes to the disk: whole blocks, about 0.5 s.

    >>> flush_length(5120.0) / 5120.0
    0.5
    """
    block = block_length(rate)
    return block * max(1, round(FLUSH_S * rate / block))
