"""The layout of a recording: its topics, schemas and sample numbers, which have exact times.

`LAYOUT.md` next to this module describes it for readers who do not use this package.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from daq.signal_chain.field_checks import Check, is_number
from rig.errors import RecordingError, SceneError

VERSION = "1"

RAW = "/raw/"
TRUTH = "/truth/"
DISPLAY = "/display/"
MARKERS = "/markers"
EVENTS = "/truth/events"
ROBOT = "/robot_description"
TRANSFORMS = "/tf"
SCENE_FILE = "scene.yaml"

# Approximate length of a block.
BLOCK_S = 0.1
# Shortest block, samples.
MIN_BLOCK_SAMPLES = 256
# Approximate interval of the commits to the disk: a killed process loses less.
FLUSH_S = 0.5
# Largest number of groups that are displayed together. With few channels, the cost of a batch hardly depends on its
# size.
SHOWN_GROUPS = 4
# Largest number of channels times groups that are displayed together: waiting samples take memory.
SHOWN_CHANNELS = 64


def block_length(rate: float) -> int:
    """Return the number of samples in a full block: the power of two nearest to 0.1 s, at least 256.

    >>> block_length(5120.0), block_length(51200.0), block_length(100.0)
    (512, 4096, 256)
    """
    return max(MIN_BLOCK_SAMPLES, 2 ** round(math.log2(max(1.0, rate * BLOCK_S))))


def flush_length(rate: float) -> int:
    """Return the number of samples that are committed to the disk together: whole blocks, about 0.5 s.

    >>> flush_length(5120.0) / 5120.0
    0.5
    """
    block = block_length(rate)
    return block * max(1, round(FLUSH_S * rate / block))


CLOCK = {
    "rate": Check(lambda value: is_number(value) and 1e-9 <= value <= 1e12, "a rate from 1e-9 Hz to 1e12 Hz"),
    "start_ns": Check(lambda value: isinstance(value, int) and abs(value) < 2**63, "nanoseconds below 2^63"),
}


@dataclass(frozen=True)
class Timebase:
    """The sample clock: sample k is taken at start_ns + k / rate, to the nearest nanosecond."""

    rate: float  # Samples per second, Hz
    start_ns: int = 0  # time of sample 0 in nanoseconds since the epoch of the recording

    def __post_init__(self) -> None:
        if not (math.isfinite(self.rate) and self.rate > 0):
            raise RecordingError(f"sample rate: got {self.rate!r} Hz; expected a positive, finite rate.")

    def time_ns(self, sample: int) -> int:
        """Return the time of a sample in nanoseconds; in integers throughout, so that no error builds up.

        >>> Timebase(8533.333333333334).time_ns(10**12) // 10**9
        117187499
        """
        step, numerator, divisor = self._ratio
        return self.start_ns + (step * sample + numerator) // divisor

    def times_ns(self, samples: Iterable[int]) -> NDArray[np.uint64]:
        """Return the times of samples in nanoseconds, as exact as `time_ns`."""
        step, numerator, divisor = self._ratio
        # Python's integers: the products would overflow 64 bits.
        times = (np.array([*samples], object) * step + numerator) // divisor + self.start_ns
        return times.astype(np.uint64)

    @cached_property
    def _ratio(self) -> tuple[int, int, int]:
        """Twice the nanoseconds of a sample interval, as a fraction; and its denominator's half, for rounding."""
        numerator, denominator = float(self.rate).as_integer_ratio()
        return 2 * 10**9 * denominator, numerator, 2 * numerator

    def samples_at(self, time_ns: NDArray[np.uint64]) -> NDArray[np.int64]:
        """Return the sample numbers nearest to times in ns since the recording's epoch, clipped to int64."""
        # The subtraction wraps around in 64 bits, which is right for every span below 292 years.
        since = (time_ns - np.uint64(self.start_ns % 2**64)).view(np.int64)
        return np.clip(np.rint(since * (self.rate * 1e-9)), -(2.0**62), 2.0**62).astype(np.int64)


def refuse_reversed(from_s: float | None, to_s: float | None) -> None:
    """Raise `SceneError` for a stretch, in s, whose end is before its beginning."""
    if from_s is not None and to_s is not None and to_s < from_s:
        raise SceneError(f"--from {from_s:g} s is after --to {to_s:g} s. Give the earlier time first.")
