"""One mode of a free decay: its envelope, and its damping ratio against amplitude."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, signal

Array = NDArray[np.float64]
_SAME_MODE = 0.1


@dataclass(frozen=True)
class ModalDecay:
    """Decay of one mode after band-pass.

    Attributes
    ----------
    frequency : float
        Hz, of the mode at small amplitude.
    time, envelope : ndarray, shape (n,)
        s after the hit; amplitude of the acceleration in m/s².
    floor : float
        Amplitude at which the envelope drowns in noise, m/s².
    amplitude : ndarray, shape (levels,)
        Acceleration amplitudes, m/s², falling.
    damping, damping_error : ndarray, shape (levels,)
        Damping ratio at those amplitudes, and its standard deviation.
    """

    frequency: float
    time: Array
    envelope: Array
    floor: float
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
    envelope over the 6 dB around it.

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
        Amplitudes in m/s² at which the damping ratio is wanted; omitted, every 1.5 dB down to the noise.
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
    floor = _floor(
        envelope[: max(begin - 2 * edge, 0)], envelope[usable][-max(1, envelope[usable].size // 20) :]
    )
    amplitude, damping, error = _damping(time[usable], envelope[usable], frequency, width, floor, amplitudes)
    return ModalDecay(frequency, time[begin:], envelope[begin:], floor, amplitude, damping, error)


def _floor(before: Array, tail: Array) -> float:
    """Find the envelope below which noise decides: before the hit, and at the end when nothing rings."""
    floor = 3.0 * float(np.mean(before)) if before.size else 0.0
    # Noise through the band has an envelope with a Rayleigh scatter (52 % of its mean); a ringing mode has
    # not.
    if tail.size > 1 and float(np.std(tail)) > 0.2 * float(np.mean(tail)):
        floor = max(floor, 3.0 * float(np.mean(tail)))
    return floor


def _damping(
    time: Array, envelope: Array, frequency: float, width: float, floor: float, wanted: Array | None
) -> tuple[Array, Array, Array]:
    if envelope.size < 8 or envelope.max() <= 0:
        return np.empty(0), np.empty(0), np.empty(0)
    logarithm = np.log(np.maximum(envelope, 1e-300))
    half = np.log(10.0) * 3.0 / 20.0
    top = logarithm.max() - half
    bottom = max(logarithm[-1] + half, np.log(floor) + half if floor > 0 else -np.inf)
    levels = np.arange(top, bottom, -half / 2.0) if wanted is None else np.log(wanted)
    amplitude, damping, error = [], [], []
    for level in levels:
        # From the last time above the level's upper edge to the first time below its lower edge after that.
        above = np.flatnonzero(logarithm >= level + half)
        start = int(above[-1]) if above.size else 0
        below = np.flatnonzero(logarithm[start:] < level - half)
        stop = start + int(below[0]) if below.size else time.size
        if stop - start < 8:
            continue
        t, y = time[start:stop] - time[start], logarithm[start:stop]
        slope, offset = np.polyfit(t, y, 1)
        rest = y - slope * t - offset
        independent = max(2.0, t[-1] * width * 2.0)
        spread = np.std(rest) / (np.std(t) * np.sqrt(independent))
        omega = 2.0 * np.pi * frequency
        amplitude.append(np.exp(level))
        damping.append(-slope / np.hypot(omega, slope))
        error.append(spread / omega)
    # At the end the slope of noise is left; irregular damping higher up is kept, however scattered.
    while wanted is None and damping and error[-1] > 0.2 * damping[-1]:
        del amplitude[-1], damping[-1], error[-1]
    return np.array(amplitude), np.array(damping), np.array(error)
