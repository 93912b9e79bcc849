"""The layout of a recording: names of topics, lengths of blocks, and the exact times of sample indices.

`LAYOUT.md` next to this module describes the layout for readers who do not use this package.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from daq.core.signal_chain.field_checks import Check, check, is_number
from rig.core.base.errors import RecordingError, SceneError

# Version of the layout.
VERSION = "1"

# Measured samples of the channels.
RAW = "/raw/"
# True (simulated) motion, which no sensor measures: true quantity values, VIM 2.11.
TRUTH = "/truth/"
# Decimated waveforms, rms and peak of the channels, for viewers.
DISPLAY = "/display/"
# Events of the test, such as measured intervals and impacts, with their samples.
MARKERS = "/markers"
# True contact events of the dampers.
EVENTS = "/truth/events"
# Topic of the description of the drawn rig, for viewers.
ROBOT = "/robot_description"
# Topic of the positions of its parts.
TRANSFORMS = "/tf"
# Name of the attachment with the scene.
SCENE_FILE = "scene.yaml"
# Remedy for a file whose content contradicts this layout.
WRITER_REMEDY = "Correct the program that wrote the file, or record again."

# Upper limit of a voltage in V, and of a true value in SI units. Squares and sums of smaller values do not overflow.
MAX_VOLTS = 1e30

# Approximate duration of a block [s].
BLOCK_S = 0.1
# Shortest full block [samples]; shorter blocks would spend most bytes on headers.
MIN_BLOCK_SAMPLES = 256
# Approximate time between commits to the disk [s]: a killed process loses less.
FLUSH_S = 0.5
# Maximum number of groups (samples of `FLUSH_S`) converted for display together; more save little time.
MAX_DISPLAY_GROUPS = 8
# Largest product of channels and groups converted together: it limits the memory for the display.
MAX_DISPLAY_CHANNELS = 64


def block_length(rate: float) -> int:
    """Return the number of samples in a full block: the power of two nearest to 0.1 s of samples, at least 256.

    `rate`: sample rate [Hz].

    >>> block_length(5120.0), block_length(51200.0), block_length(100.0)
    (512, 4096, 256)
    """
    return max(MIN_BLOCK_SAMPLES, 2 ** round(math.log2(max(1.0, rate * BLOCK_S))))


def flush_length(rate: float) -> int:
    """Return the number of samples that are committed to the disk together: whole blocks, about 0.5 s.

    `rate`: sample rate [Hz].

    >>> flush_length(5120.0) / 5120.0
    0.5
    """
    block = block_length(rate)
    return block * max(1, round(FLUSH_S * rate / block))


CLOCK_CHECKS = {
    "rate": Check(lambda value: is_number(value) and 1e-9 <= value <= 1e12, "a rate from 1e-9 Hz to 1e12 Hz"),
    "start_ns": Check(lambda value: isinstance(value, int) and abs(value) < 2**63, "nanoseconds below 2^63"),
}


@dataclass(frozen=True)
class Timebase:
    """The sample clock: sample k is taken at start_ns + k / rate, rounded to nanoseconds."""

    rate: float  # Samples per second [Hz]
    start_ns: int = 0  # time of sample 0 in nanoseconds since the epoch of the recording

    def __post_init__(self) -> None:
        if not (math.isfinite(self.rate) and self.rate > 0):
            raise RecordingError(f"sample rate: got {self.rate!r} Hz; expected a positive, finite rate.")

    def time_ns(self, sample: int) -> int:
        """Return the time of a sample in nanoseconds, computed in integers, so no error builds up.

        >>> Timebase(8533.333333333334).time_ns(10**12) // 10**9
        117187499
        """
        doubled_interval, numerator, divisor = self._ratio
        return self.start_ns + (doubled_interval * sample + numerator) // divisor

    def times_ns(self, samples: ArrayLike) -> NDArray[np.uint64]:
        """Return the times of samples in nanoseconds, with the accuracy of `time_ns`."""
        doubled_interval, numerator, divisor = self._ratio
        whole, rest = divmod(doubled_interval, divisor)
        numbers = np.asarray(samples)
        stop = int(numbers.max()) + 1
        if max(divisor * stop, self.time_ns(stop)) >= 2**63:
            # At rates that are not whole numbers, the products overflow 64 bits. Python's integers are slower.
            numbers = numbers.astype(object)
        times = whole * numbers + (rest * numbers + numerator) // divisor + self.start_ns
        return times.astype(np.uint64)

    @cached_property
    def _ratio(self) -> tuple[int, int, int]:
        """Twice the sample interval in ns as a fraction: numerator, half the denominator, denominator."""
        # With half the denominator added, the integer division rounds to the nearest nanosecond.
        numerator, denominator = float(self.rate).as_integer_ratio()
        return 2 * 10**9 * denominator, numerator, 2 * numerator

    def samples_at(self, time_ns: NDArray[np.uint64]) -> NDArray[np.int64]:
        """Return the sample indices nearest to times in ns since the recording's epoch, clipped to int64."""
        # The subtraction may overflow 64 bits; the result is right for differences below 292 years.
        elapsed_ns = (time_ns - np.uint64(self.start_ns % 2**64)).view(np.int64)
        return np.clip(np.rint(elapsed_ns * (self.rate * 1e-9)), -(2.0**62), 2.0**62).astype(np.int64)


def require_ordered_times(from_s: float | None, to_s: float | None) -> None:
    """Raise `SceneError` if a segment, in s, ends before it begins."""
    if from_s is not None and to_s is not None and to_s < from_s:
        raise SceneError(f"`from_s` {from_s:g} s is after `to_s` {to_s:g} s. Give the earlier time first.")


def stated_clock(metadata: Mapping[str, str]) -> Timebase | None:
    """Return the sample clock in metadata of a topic (None: not stated); raise `RecordingError` if it is invalid."""
    if "rate" not in metadata or "start_ns" not in metadata:
        return None
    try:
        rate, start_ns = float(metadata["rate"]), int(metadata["start_ns"])
        check({"rate": rate, "start_ns": start_ns}, CLOCK_CHECKS)
    except (ValueError, RecordingError) as error:
        raise RecordingError(f"invalid sample clock ({error!s:.200}).") from None
    return Timebase(rate, start_ns)
