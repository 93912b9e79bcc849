"""One mode of a free decay: its envelope, and its damping ratio against amplitude."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, signal

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
_SAME_MODE = 0.1
# A damping ratio counts when noise leaves it uncertain by less than this part (one standard deviation).
WORST = 0.05
# Levels in nepers: the damping ratio at an amplitude is read off the fall by 6 dB around it, every 1.5 dB.
_HALF = 3.0 / 20.0 * np.log(10.0)


@dataclass(frozen=True)
class ModalDecay:
    """Decay of one mode after band-pass.

    Attributes
    ----------
    frequency : float
        Hz, of the mode at small amplitude.
    time, envelope : ndarray, shape (n,)
        s after the hit; amplitude of the acceleration in m/s².
    noise : float
        Root mean square of what noise adds to the envelope, m/s².
    amplitude : ndarray, shape (levels,)
        Acceleration amplitudes, m/s², falling; only those at which noise lets the damping ratio be told to
        `WORST`.
    damping, damping_error : ndarray, shape (levels,)
        Damping ratio at those amplitudes, and its standard deviation from noise.
    """

    frequency: float
    time: Array
    envelope: Array
    noise: float
    amplitude: Array
    damping: Array
    damping_error: Array

    @property
    def decrement(self) -> Array:
        """Logarithmic decrement at each amplitude: ln of the ratio of successive maxima."""
        return 2.0 * np.pi * self.damping / np.sqrt(1.0 - np.minimum(self.damping, 0.99) ** 2)

    def small_damping(self) -> float:
        """Damping ratio near the end of the decay: median of the lowest third of the amplitudes."""
        return (
            float(np.median(self.damping[-max(1, self.damping.size // 3) :])) if self.damping.size else np.nan
        )

    def at(self, amplitude: float) -> float:
        """Damping ratio at an amplitude, between those measured; NaN outside."""
        if not self.damping.size:
            return float("nan")
        order = np.argsort(self.amplitude)
        return float(
            np.interp(amplitude, self.amplitude[order], self.damping[order], left=np.nan, right=np.nan)
        )


def spectral_peaks(acceleration: Array, rate: float, most: int, low: float, high: float) -> Array:
    """Frequencies of the `most` highest resonances of a decay, in Hz, rising.

    Peaks of the spectrum that stand out by 10 dB from what lies around them and by 20 dB from the median
    of the band, refined by a parabola through the logarithm of three bins.
    """
    size = fft.next_fast_len(4 * acceleration.size, real=True)
    fall = np.cos(np.linspace(0.0, np.pi / 2, acceleration.size)) ** 2
    level = 20.0 * np.log10(abs(fft.rfft(acceleration * fall, size)) + 1e-300)
    frequency = fft.rfftfreq(size, 1.0 / rate)
    inside = (frequency >= low) & (frequency <= high)
    level, frequency = level[inside], frequency[inside]
    where, _ = signal.find_peaks(level, prominence=10.0, height=float(np.median(level)) + 20.0)
    kept: list[int] = []
    for peak in where[np.argsort(level[where], kind="stable")[::-1]]:
        # Dampers shift a mode as they come to rest; that smears or splits its peak but makes no second mode.
        if all(abs(frequency[peak] / frequency[other] - 1.0) > _SAME_MODE for other in kept):
            kept.append(int(peak))
    where = np.sort(np.array(kept[:most], dtype=int))
    left, mid, right = level[where - 1], level[where], level[where + 1]
    shift = 0.5 * (left - right) / (left - 2.0 * mid + right)
    return frequency[where] + shift * (frequency[1] - frequency[0])


def band_width(frequencies: Array, index: int) -> float:
    """Choose the Gaussian band-pass for one of several modes: its standard deviation in Hz.

    A quarter of the distance to the nearest other mode (the neighbour is then let through at exp(-8) of its
    amplitude), and at most a quarter of the frequency.
    """
    others = np.delete(frequencies, index)
    nearest = np.min(abs(others - frequencies[index])) if others.size else np.inf
    return float(min(nearest, frequencies[index]) / 4.0)


def modal_decay(
    acceleration: Array,
    rate: float,
    frequency: float,
    width: float,
    begin: int,
    amplitudes: Array | None = None,
) -> ModalDecay:
    """Envelope of one mode, and its damping ratio against amplitude.

    A Gaussian band-pass over positive frequencies gives the analytic signal at once; a Gaussian changes an
    exponential decay by a constant factor only, so the slope of the envelope is unbiased from three of its
    widths in time after the hit on. The damping ratio at an amplitude is the slope of the logarithm of the
    envelope while it falls by 6 dB around it, from when it is last above the upper level to when it is last
    above the lower one.

    Parameters
    ----------
    acceleration : ndarray, shape (n,)
        m/s², beginning before the hit.
    rate : float
        Hz.
    frequency, width : float
        Centre and standard deviation of the band-pass, Hz.
    begin : int
        Sample at which the free decay begins.
    amplitudes : ndarray, optional
        Amplitudes in m/s² at which the damping ratio is wanted, NaN where the decay has none; omitted, every
        1.5 dB down to the noise.
    """
    size = fft.next_fast_len(acceleration.size + int(8 * rate / (2 * np.pi * width)))
    spectrum = fft.fft(acceleration, size)
    bins = fft.fftfreq(size, 1.0 / rate)
    spectrum *= np.where(bins > 0, 2.0 * np.exp(-0.5 * ((bins - frequency) / width) ** 2), 0.0)
    analytic = fft.ifft(spectrum)[: acceleration.size]
    envelope = abs(analytic)
    edge = int(np.ceil(3.0 * rate / (2 * np.pi * width)))
    time = (np.arange(acceleration.size) - begin) / rate
    usable = slice(begin + edge, max(acceleration.size - edge, begin + edge))
    noise = _noise(analytic[usable], rate, frequency, width)
    amplitude, damping, error = _damping(envelope[usable], rate, frequency, noise, amplitudes)
    return ModalDecay(frequency, time[begin:], envelope[begin:], noise, amplitude, damping, error)


def _noise(analytic: ComplexArray, rate: float, frequency: float, width: float) -> float:
    """Find what noise adds to the envelope, rms: what the end of the decay differs by from an exponential.

    At the end all dampers are at rest and the structure rings linearly; while they are not, their doing
    counts as noise.
    """
    step = max(1, int(rate / (8.0 * width)))
    tail = analytic[-(analytic.size // 4) :][::step]
    if tail.size < 8:
        return 0.0
    t = np.arange(tail.size) * step / rate
    slow = tail * np.exp(-2j * np.pi * frequency * t)
    weight = abs(slow)
    decay, size = np.polyfit(t, np.log(np.maximum(weight, 1e-300)), 1, w=weight)
    turn, angle = np.polyfit(t, np.unwrap(np.angle(slow)), 1, w=weight)
    left = slow - np.exp(decay * t + size + 1j * (turn * t + angle))
    # Four numbers were fitted to as many complex readings as are independent.
    independent = max(t[-1] * np.sqrt(np.pi) * width, 3.0)
    return float(np.sqrt(np.mean(abs(left) ** 2) * independent / (independent - 2.0)))


def _damping(
    envelope: Array, rate: float, frequency: float, noise: float, wanted: Array | None
) -> tuple[Array, Array, Array]:
    """Amplitudes, damping ratios and their standard deviations."""
    if envelope.size < 8 or envelope.max() <= 0:
        return np.empty(0), np.empty(0), np.empty(0)
    # The largest amplitude still to come: falls steadily, so that each level is passed once.
    hull = np.log(np.maximum(np.maximum.accumulate(envelope[::-1])[::-1], 1e-300))
    levels = (
        np.arange(hull[0] - 1.25 * _HALF, hull[-1] + _HALF, -_HALF / 2.0)
        if wanted is None
        else np.log(wanted)
    )
    upper, lower = _passed(hull, levels + _HALF), _passed(hull, levels - _HALF)
    logarithm = np.log(np.maximum(envelope, 1e-300))
    rate_of_fall = np.array([_slope(logarithm, a, b, rate) for a, b in zip(upper, lower, strict=True)])
    damping = rate_of_fall / np.hypot(2.0 * np.pi * frequency, rate_of_fall)
    # Half of the noise changes the envelope; at the two levels it is independent.
    amplitude = np.exp(levels)
    both = np.hypot(np.exp(-_HALF), np.exp(_HALF)) * noise / np.sqrt(2.0) / amplitude
    error = damping * both / (2.0 * _HALF)
    if wanted is not None:
        return amplitude, damping, error
    good = np.isfinite(damping) & (both < WORST * 2.0 * _HALF)
    return amplitude[good], damping[good], error[good]


def _slope(logarithm: Array, first: float, last: float, rate: float) -> float:
    """Rate of fall between two places, 1/s: by a straight line through all between, along which beats average out."""
    if not (np.isfinite(first) and np.isfinite(last)) or last - first < 4.0:
        return float("nan")
    part = logarithm[round(first) : round(last) + 1]
    t = np.arange(part.size) - (part.size - 1) / 2.0
    return float(-(t @ part) / (t @ t) * rate)


def _passed(hull: Array, levels: Array) -> Array:
    """Place, between samples, at which a falling curve passes each level; NaN where it does not."""
    after = hull.size - np.searchsorted(hull[::-1], levels, side="left")
    inside = (after > 0) & (after < hull.size)
    after = np.clip(after, 1, hull.size - 1)
    high, low = hull[after - 1], hull[after]
    part = np.divide(high - levels, high - low, out=np.zeros(levels.shape), where=high > low)
    at_start = levels >= hull[0] - 1e-9
    return np.where(inside, after - 1 + part, np.where(at_start & (levels <= hull[0] + 1e-9), 0.0, np.nan))
