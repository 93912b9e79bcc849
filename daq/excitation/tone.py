"""A sine source with glides of frequency and amplitude, without a jump in phase, frequency or amplitude."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Tone:
    """Source of amplitude * sin(phase), with frequency in Hz and the phase in rad at the next sample.

    >>> tone = Tone(1000.0, 10.0)
    >>> up, on = tone.glide(200, 10.0, 2.0), tone.hold(100)
    >>> float(round(abs(np.diff(np.concatenate([up, on]))).max(), 3))  # never steeper than 2 w / rate
    0.126
    """

    def __init__(self, rate: float, frequency: float) -> None:
        self.rate = rate
        self.frequency = frequency
        self.amplitude = 0.0
        self.phase = 0.0

    def hold(self, samples: int) -> Array:
        """Generate samples of constant frequency and amplitude; shape (samples,)."""
        turns = self.frequency / self.rate * np.arange(samples + 1, dtype=float)
        return self.amplitude * np.sin(self._advance(turns))

    def glide(self, samples: int, frequency: float, amplitude: float) -> Array:
        """Glide to a frequency and an amplitude along half a cosine; shape (samples,)."""
        part = np.arange(samples + 1) / samples
        # Phase in periods: the integral of f0 + (f1 - f0) (1 - cos(pi u)) / 2 over u.
        bend = samples * (part / 2 - np.sin(np.pi * part) / (2 * np.pi))
        turns = (self.frequency * samples * part + (frequency - self.frequency) * bend) / self.rate
        rise = (1 - np.cos(np.pi * part[:-1])) / 2
        envelope = self.amplitude + (amplitude - self.amplitude) * rise
        wave = envelope * np.sin(self._advance(turns))
        self.frequency, self.amplitude = frequency, amplitude
        return wave

    def _advance(self, turns: Array) -> Array:
        """Return the phases of a window; `turns` ends with the first sample of the next window."""
        phase = self.phase + 2 * np.pi * np.fmod(turns, 1.0)
        self.phase = float(np.fmod(phase[-1], 2 * np.pi))
        return phase[:-1]
