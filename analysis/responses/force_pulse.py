"""The force of a hammer's hit alone, without noise before and after, and without the tail that high-passes give it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import NDArray

if TYPE_CHECKING:
    from daq.signal_chain.channel import ChannelInfo

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# After the last sample the hit can reach, the window stays open for this time, s, and closes within as much.
SLOPE = 2e-3
# Fast poles ring on after the hit; the window waits until this many of their time constants have passed.
_TIME_CONSTANTS = 7.0


def pulse_alone(info: ChannelInfo, force: Array, first: int, last: int) -> Array:
    """Take what is not the hit out of a force channel's samples.

    Sensor discharge, amplifier and converter with AC coupling let a pulse be followed by a long faint tail of
    the other sign. It is as much the pulse's as the pulse is, and may last longer than the recording. So the
    high-passes are undone first, and the window then cuts off what is noise; `high_passes` gives their effect on the
    spectrum of what is left.

    Parameters
    ----------
    info : daq.signal_chain.channel.ChannelInfo
        The force channel.
    force : ndarray, shape (n,)
        Its samples, N, from before the hit on, with nothing left of earlier ones.
    first, last : int
        First and last sample that the hit itself reaches.

    Returns
    -------
    ndarray, shape (n,)
        N, as the channel would have read it without its high-passes.
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
    # Complex poles come in pairs.
    return np.ascontiguousarray(out.real)


def high_passes(info: ChannelInfo, frequency: Array) -> ComplexArray:
    """Response of the high-passes that `pulse_alone` has undone, at some frequencies in Hz."""
    out = np.ones(frequency.size, dtype=complex)
    for pole in slow_and_fast(info)[0]:
        out *= scipy.signal.freqz(*_high_pass(pole, info.rate), frequency, fs=info.rate)[1]
    return out


def slow_and_fast(info: ChannelInfo) -> tuple[list[complex], list[complex]]:
    """Poles of the high-passes, as many as there are zeros at zero frequency, the slowest; and all others."""
    poles = sorted((pole for pole in info.poles if pole), key=abs)
    count = sum(1 for zero in info.zeros if zero == 0)
    return poles[:count], poles[count:]


def _high_pass(pole: complex, rate: float) -> tuple[ComplexArray, ComplexArray]:
    """Numerator and denominator of s / (s - pole) by the bilinear transform."""
    return np.array([2.0 * rate, -2.0 * rate], dtype=complex), np.array(
        [2.0 * rate - pole, -2.0 * rate - pole]
    )
