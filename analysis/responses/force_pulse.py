"""Force pulse of a hammer hit, without noise before and after it and without the tail due to high-pass filters."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy

from rig.arrays import Array, ComplexArray

if TYPE_CHECKING:
    from daq.signal_chain.channel import ChannelInfo


# The force window stays open for this time, s, after the last sample of the hit, and tapers over an equal time.
SLOPE = 2e-3
# Fast poles ring after the hit; the window stays open for this number of their time constants.
_TIME_CONSTANTS = 7.0


def pulse_alone(info: ChannelInfo, force: Array, first: int, last: int) -> Array:
    """Remove everything but the hit, samples `first` to `last`, from a force channel; N, without its high-pass filters.

    Sensor discharge and AC coupling of amplifier and converter add a long, small tail of opposite sign to a pulse. The
    tail is part of the signal and may be longer than the recording. The high-pass filters are therefore inverted first,
    and the window then removes the noise. `high_passes` returns their effect on the spectrum of the result.
    """
    slow, fast = slow_and_fast(info)
    ringing = _TIME_CONSTANTS / min((abs(pole.real) for pole in fast), default=np.inf)
    slope = max(2, int(SLOPE * info.rate))
    flat = min(last + 1 + int(np.ceil(ringing * info.rate)) + slope, force.size)
    stop = min(flat + slope, force.size)
    out = np.zeros(force.size, dtype=complex)
    out[first:stop] = force[first:stop]
    for above, below in (_high_pass(pole, info.rate) for pole in slow):
        out[:stop] = scipy.signal.lfilter(below, above, out[:stop])
    out[flat:stop] *= 0.5 + 0.5 * np.cos(np.pi * np.arange(1, stop - flat + 1) / (slope + 1))
    # Complex poles occur in conjugate pairs, so the imaginary part is rounding.
    return np.ascontiguousarray(out.real)


def high_passes(info: ChannelInfo, frequency: Array) -> ComplexArray:
    """Frequency response of the high-pass filters that `pulse_alone` inverts; frequencies in Hz."""
    out = np.ones(frequency.size, dtype=complex)
    for pole in slow_and_fast(info)[0]:
        out *= scipy.signal.freqz(*_high_pass(pole, info.rate), frequency, fs=info.rate)[1]
    return out


def slow_and_fast(info: ChannelInfo) -> tuple[list[complex], list[complex]]:
    """Slow poles (high-pass filters: the slowest poles, one for each zero at zero frequency) and all other poles."""
    poles = sorted((pole for pole in info.poles if pole), key=abs)
    count = sum(1 for zero in info.zeros if zero == 0)
    return poles[:count], poles[count:]


def _high_pass(pole: complex, rate: float) -> tuple[ComplexArray, ComplexArray]:
    """Numerator and denominator of s / (s - pole) by the bilinear transform."""
    return np.array([2.0 * rate, -2.0 * rate], dtype=complex), np.array(
        [2.0 * rate - pole, -2.0 * rate - pole]
    )
