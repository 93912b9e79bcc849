"""Replication of a transient at a control channel: target pulses, their drive, and its correction after each pulse.

The drive of a period is U = A / H at spectral lines, for the target A and the response H to the drive. After a pulse
with the error E, U is corrected by a part of E / H, which converges if |1 - part H_true / H| < 1 at all lines. A target
with a prescribed shock response spectrum is a sum of wavelets, which end with zero velocity and displacement (D. O.
Smallwood, A. R. Nord, Shock Vib. Bull. 44 (1974) 43).
"""

import numpy as np

from daq.core.dsp.shock_response import shock_response
from daq.core.excitation.profiles.spectrum_shaping import Lines, sum_of_tones
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import SceneError
from rig.core.numerics.decibels import in_decibels
from rig.core.scene.excitation.shock import PULSE_POSITION, HalfSine, Shock, ShockProfile

# Minimum number of samples in a half sine; with fewer, its peak lies between two samples.
_MIN_SAMPLES = 6
# Part of the error that a correction removes. The error then decreases as long as the true response is below 2 / 0.7 =
# 2.9 times the identified response.
_CORRECTED_FRACTION = 0.7
# Odd number of half periods of a wavelet, whose bandwidth is then less than the distance of the lines.
_HALF_PERIODS = 25
# The amplitudes of the wavelets are adjusted until the spectrum agrees within this tolerance [dB].
_SYNTHESIS_DB = 0.5
_MAX_SYNTHESIS_STEPS = 200
# Exponent of the adjustment.
_SYNTHESIS_EXPONENT = 0.7
# Fraction of a period in which the drive rises at its start, and falls at its end.
_TAPER_PER_PERIOD = 0.05


class Replication:
    """The drive of a pulse, one period long; `gain`: response of the control channel at `lines`, zero if unknown."""

    def __init__(self, target: Array, lines: Lines, gain: ComplexArray) -> None:
        self.lines, self._period = lines, target.size
        self._target = np.fft.rfft(target)[lines] * (2.0 / target.size)
        self._inverse = np.divide(1.0, gain, out=np.zeros(gain.size, dtype=complex), where=gain != 0.0)
        self._drive = self._target * self._inverse
        rise = round(_TAPER_PER_PERIOD * target.size)
        ramp = (1.0 - np.cos(np.pi * np.arange(rise) / rise)) / 2.0
        self._envelope = np.ones(target.size)
        self._envelope[: ramp.size], self._envelope[target.size - ramp.size :] = ramp, ramp[::-1]

    def drive(self, level: float) -> Array:
        """Return the drive of a pulse at a level (1: the target), shape (period,)."""
        return level * self.to_wave(self._drive) * self._envelope

    def to_wave(self, amplitudes: ComplexArray) -> Array:
        """Return one period of the sum of tones with complex amplitudes at the lines, shape (period,)."""
        return sum_of_tones(self.lines, amplitudes, np.zeros(1), self._period)

    def unknown_part(self) -> Array:
        """Return the target at the lines without a known response, shape (period,)."""
        return self.to_wave(np.where(self._inverse == 0.0, self._target, 0.0))

    def correct(self, response: ComplexArray, level: float) -> None:
        """Correct the drive after a pulse at a level; `response`: accelerations at the lines [m/s²]."""
        self._drive = self._drive + _CORRECTED_FRACTION * (self._target - response / level) * self._inverse


class HalfSinePulse:
    """A compensated half sine; the deviation is relative to its peak."""

    unit, remedy = "of the peak", "Shorten the width, or lower the peak."

    def __init__(self, settings: HalfSine, period: int, rate: float) -> None:
        if settings.width * rate < _MIN_SAMPLES:
            raise SceneError(
                f"test.half_sine.width: a pulse of {settings.width * 1e3:g} ms has fewer than {_MIN_SAMPLES} samples "
                f"at {rate:g} Hz. Give a longer pulse, or raise converter.rate."
            )
        self.target = settings.wave(_time(period, rate))
        self.band = 0.02 / settings.width, 10.0 / settings.width
        self.tolerance, self._peak = settings.tolerance, settings.peak

    def deviation(self, wave: Array) -> tuple[float, str]:
        """Return the largest difference from the pulse, relative to its peak."""
        worst = float(abs(wave - self.target).max()) / self._peak
        return worst, f"the pulse deviates by {100 * worst:.0f} % of its peak"


class SpectrumPulse:
    """A sum of wavelets with a given shock response spectrum; the deviation is the deviation of the spectrum in dB."""

    unit, remedy = "dB", "Lower the spectrum."

    def __init__(self, settings: ShockProfile, period: int, rate: float) -> None:
        self._lines, self._q, self._rate = settings.lines, settings.q, rate
        self._required = settings.at(self._lines)
        self.tolerance = settings.tolerance
        self.band = 0.3 * settings.frequencies[0], 2.0 * settings.frequencies[-1]
        wavelets = np.array([_wavelet(_time(period, rate), frequency) for frequency in self._lines])
        wavelets[1::2] *= -1.0  # alternating signs reduce the peak
        amplitudes, smallest = self._required / settings.q**0.5, np.inf
        for _ in range(_MAX_SYNTHESIS_STEPS):
            target = amplitudes @ wavelets
            ratio = self._required / self.spectrum(target)
            worst = float(np.max(abs(in_decibels(ratio))))
            if worst < smallest:
                self.target, smallest = target, worst
            if worst < _SYNTHESIS_DB:
                break
            amplitudes = amplitudes * ratio**_SYNTHESIS_EXPONENT
        if smallest > settings.tolerance:
            raise SceneError(
                f"test.spectrum: no sum of wavelets has this spectrum; for the best sum, "
                f"{self.deviation(self.target)[1]}. Give a "
                "spectrum that changes less steeply, or a wider tolerance."
            )

    def spectrum(self, wave: Array) -> Array:
        """Return the maximax shock response spectrum at the controlled frequencies [m/s²]."""
        largest, smallest = shock_response([wave], self._rate, self._lines, self._q)
        return np.maximum(largest, -smallest)

    def deviation(self, wave: Array) -> tuple[float, str]:
        """Return the largest difference from the spectrum [dB]."""
        difference = in_decibels(self.spectrum(wave) / self._required)
        index = int(np.argmax(abs(difference)))
        side = "above" if difference[index] > 0.0 else "below"
        text = f"the spectrum at {self._lines[index]:.3g} Hz is {abs(difference[index]):.1f} dB {side}"
        return float(abs(difference[index])), text


# A pulse to replicate: `target` is the acceleration of one period [m/s²], `band` that of the drive [Hz].
Pulse = HalfSinePulse | SpectrumPulse


def pulse_of(test: Shock, period: int, rate: float) -> Pulse:
    """Return the pulse of a test; `period`: samples; `rate`: Hz."""
    if test.half_sine is not None:
        return HalfSinePulse(test.half_sine, period, rate)
    assert test.spectrum is not None
    return SpectrumPulse(test.spectrum, period, rate)


def _time(period: int, rate: float) -> Array:
    """Return the times of the samples of a period, with the middle of the pulse at 0, s."""
    return (np.arange(period) - round(PULSE_POSITION * period)) / rate


def _wavelet(time: Array, frequency: float) -> Array:
    """Return a wavelet of a frequency in Hz, centered at t = 0; its length is a number of half periods."""
    length = _HALF_PERIODS / (2.0 * frequency)
    t = time + length / 2.0
    omega = 2.0 * np.pi * frequency
    return np.where(abs(time) < length / 2.0, np.sin(omega * t / _HALF_PERIODS) * np.sin(omega * t), 0.0)
