"""Gaussian band-pass that separates one mode of a free decay."""

import numpy as np
from scipy import fft

from rig.core.base.arrays import Array, ComplexArray


def band_width(frequencies: Array, index: int) -> float:
    """Return the standard deviation of the Gaussian band-pass for one of several modes [Hz].

    The width is a quarter of the distance to the nearest other mode, which attenuates that mode by a factor of exp(-8),
    and at most a quarter of the natural frequency.
    """
    others = np.delete(frequencies, index)
    nearest = np.min(abs(others - frequencies[index])) if others.size else np.inf
    return float(min(nearest, frequencies[index]) / 4.0)


def band_pass(acceleration: Array, rate: float, frequency: float, width: float) -> tuple[ComplexArray, int]:
    """Return the analytic signal after a Gaussian band-pass, and the number of samples that each end affects."""
    padded_length = fft.next_fast_len(acceleration.size + int(8 * rate / (2 * np.pi * width)))
    spectrum = fft.fft(acceleration, padded_length)
    bins = fft.fftfreq(padded_length, 1.0 / rate)
    spectrum *= np.where(bins > 0, 2.0 * np.exp(-0.5 * ((bins - frequency) / width) ** 2), 0.0)
    return fft.ifft(spectrum)[: acceleration.size], int(np.ceil(3.0 * rate / (2 * np.pi * width)))
