"""Force pulse of a hammer impact, without the noise before and after it and without the tail due to high-pass filters.

The high-pass filters of a force channel are the discharge of the sensor and the AC coupling of amplifier and converter.
"""

import numpy as np
import scipy

from daq.core.signal_chain.channel import ChannelInfo
from rig.core.base.arrays import Array, ComplexArray

# Time for which the force window stays 1 after the impact, in addition to the ringing, and duration of its taper [s].
TAPER_S = 2e-3
# Time for the ringing of low-pass filters, in time constants of the slowest; 0.1 % of the ringing then remains.
_RINGING_TIME_CONSTANTS = 7.0


def isolate_pulse(info: ChannelInfo, force: Array, first: int, last: int) -> Array:
    """Return the readings of a force channel, N, compensated for its high-pass filters, and zero outside the impact.

    `first`, `last`: first and last sample of the impact.

    The high-pass filters add a long, small tail of opposite sign to a pulse, which may be longer than the recording.
    They are therefore inverted first; a window then removes the noise after the impact. The spectrum of the readings is
    the spectrum of the result times `high_pass_response`.
    """
    slow_poles = slow_and_fast(info)[0]
    n_after, n_taper = samples_after_impact(info)
    taper_start = min(last + 1 + n_after, force.size)
    stop = min(taper_start + n_taper, force.size)
    pulse = np.zeros(force.size, dtype=complex)
    pulse[first:stop] = force[first:stop]
    for numerator, denominator in (_high_pass(pole, info.rate) for pole in slow_poles):
        # Numerator and denominator are exchanged to invert the filter.
        pulse[:stop] = scipy.signal.lfilter(denominator, numerator, pulse[:stop])
    pulse[taper_start:stop] *= 0.5 + 0.5 * np.cos(np.pi * np.arange(1, stop - taper_start + 1) / (n_taper + 1))
    # Complex poles occur in conjugate pairs, so the imaginary part is rounding.
    return np.ascontiguousarray(pulse.real)


def samples_after_impact(info: ChannelInfo) -> tuple[int, int]:
    """Return the numbers of samples after an impact in which the force window is 1 and in which it tapers to 0."""
    fast_poles = slow_and_fast(info)[1]
    ringing_s = _RINGING_TIME_CONSTANTS / min((abs(pole.real) for pole in fast_poles), default=np.inf)
    n_taper = max(2, int(TAPER_S * info.rate))
    return int(np.ceil(ringing_s * info.rate)) + n_taper, n_taper


def high_pass_response(info: ChannelInfo, frequency: Array) -> ComplexArray:
    """Compute the frequency response of the high-pass filters that `isolate_pulse` inverts; frequencies in Hz."""
    response = np.ones(frequency.size, dtype=complex)
    for pole in slow_and_fast(info)[0]:
        response *= scipy.signal.freqz(*_high_pass(pole, info.rate), frequency, fs=info.rate)[1]
    return response


def slow_and_fast(info: ChannelInfo) -> tuple[list[complex], list[complex]]:
    """Return the slowest poles, as many as zeros at 0 Hz (high-pass filters), and all other poles [rad/s]."""
    poles = sorted((pole for pole in info.poles if pole), key=abs)
    count = sum(1 for zero in info.zeros if zero == 0)
    return poles[:count], poles[count:]


def _high_pass(pole: complex, rate: float) -> tuple[ComplexArray, ComplexArray]:
    """Return numerator and denominator of s / (s - pole) by the bilinear transform."""
    return np.array([2.0 * rate, -2.0 * rate], dtype=complex), np.array([2.0 * rate - pole, -2.0 * rate - pole])
