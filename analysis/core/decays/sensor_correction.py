"""Correction of sampled data for the frequency response of sensor, amplifier and converter."""

import numpy as np
from scipy import fft

from daq.core.signal_chain.channel import ChannelInfo
from rig.core.base.arrays import Array, ComplexArray
from rig.core.results.response import MOTIONS


class CorrectedMotion:
    """Band-limited true motion of a segment of samples, as displacement, velocity or acceleration.

    The samples are mirrored at both ends before the Fourier transform, so the periodic continuation has no step
    between the last sample and the first. If the samples are differentiated, the mirror image is also inverted (odd
    extension), which removes the kink at the ends. The inversion changes the mean value, but differentiation removes
    the mean.

    `samples`, shape (n,): uncorrected samples in the channel's unit, evenly spaced; `low`, `high`: limits of the
    pass band [Hz]. The correction is exact inside the pass band, and fades out over half an octave outside.
    """

    def __init__(self, info: ChannelInfo, samples: Array, low: float, high: float) -> None:
        self.info, self.samples = info, samples
        fade_length = samples.size // 2
        self._fade_in = np.hanning(2 * fade_length + 1)[:fade_length]
        size = fft.next_fast_len(3 * samples.size - 2, real=True)
        frequency = fft.rfftfreq(size, 1.0 / info.rate)
        weights = _band_weights(frequency, low, high)
        nonzero = np.flatnonzero(weights)
        # The pass band is one contiguous interval of frequencies.
        self._pass_band = slice(int(nonzero[0]), int(nonzero[-1]) + 1) if nonzero.size else slice(0, 0)
        self._size, self._j_omega = size, 2j * np.pi * frequency[self._pass_band]
        self._factor = weights[self._pass_band] / info.response(frequency[self._pass_band])
        self._spectra: dict[bool, ComplexArray] = {}

    def __call__(self, motion: str) -> Array:
        """Return displacement, velocity or acceleration, shape (n,), in SI; for a force channel the force in N."""
        quantity, count = self.info.quantity, self.samples.size
        # Number of differentiations; negative for integrations.
        order = MOTIONS.index(motion) - MOTIONS.index(quantity) if quantity in MOTIONS else 0
        factor = self._factor if order == 0 else self._factor * self._j_omega**order
        spectrum = np.zeros(self._size // 2 + 1, dtype=complex)
        spectrum[self._pass_band] = self._spectrum(order > 0) * factor
        return fft.irfft(spectrum, self._size)[count - 1 : 2 * count - 1]

    def _spectrum(self, odd: bool) -> ComplexArray:
        """Return the spectrum of the samples with even or odd extension, in the pass band."""
        if odd not in self._spectra:
            samples, fade_in = self.samples, self._fade_in
            before, after = samples[:0:-1], samples[-2::-1]
            if odd:
                before, after = 2.0 * samples[0] - before, 2.0 * samples[-1] - after
            extended = np.concatenate([before, samples, after])
            extended[: fade_in.size] *= fade_in
            extended[extended.size - fade_in.size :] *= fade_in[::-1]
            self._spectra[odd] = fft.rfft(extended, self._size)[self._pass_band]
        return self._spectra[odd]


def correct_motion(info: ChannelInfo, samples: Array, motion: str, low: float, high: float) -> Array:
    """Return the band-limited true motion of a segment of samples (see `CorrectedMotion`)."""
    return CorrectedMotion(info, samples, low, high)(motion)


def _band_weights(frequency: Array, low: float, high: float) -> Array:
    """Return weights: 1 from `low` to `high`, cosine tapers of half an octave, and 0 at zero frequency if `low` > 0."""
    weights = np.ones(frequency.size)
    if low > 0:
        below = slice(1, int(np.searchsorted(frequency, low)))
        taper = np.clip(np.log2(frequency[below] / low) * 2.0 + 1.0, 0.0, 1.0)
        weights[below] = 0.5 - 0.5 * np.cos(np.pi * taper)
        weights[0] = 0.0
    above = slice(int(np.searchsorted(frequency, high)), None)
    taper = np.clip(np.log2(np.maximum(frequency[above], 1e-300) / high) * 2.0, 0.0, 1.0)
    weights[above] *= 0.5 + 0.5 * np.cos(np.pi * taper)
    return weights
