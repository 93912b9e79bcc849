"""What other modes do to the band-passed decay of one mode: modes in its band and at other peaks of the spectrum."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.core.decays.band_pass import band_pass, band_width
from analysis.core.decays.close_modes import Poles, close_poles
from rig.core.base.arrays import Array, ComplexArray

# Largest slope of the least-squares line through an oscillation of many beats, relative to the slope of the oscillation
# and times the square of half its phase: 3, and 3.2 with few beats.
_SLOPE_OF_BEATS = 3.2
# Largest distance of a close mode from the center of the band-pass, relative to its width: the width is at most a
# quarter of the distance to the nearest mode, and peaks of the spectrum are not exactly at the frequencies of modes.
_CLOSE_DISTANCE = 4.5
# Largest decay rate of a mode that disturbs another one, relative to the other decay rate: larger ratios are those of
# particle dampers, which change the decay rate of a single mode.
_MAX_DECAY_RATIO = 6.0
# Largest slope of the least-squares line through a step, times its length and relative to the height of the step: 1.5,
# and 4 times as much at the end of a parabola.
_SLOPE_OF_STEP = 6.0


@dataclass(frozen=True)
class Overlap:
    """Exponentials of other modes that disturb the band-passed decay of one mode."""

    begin: int  # sample at which the free decay begins
    amplitude: Array  # at `begin`, before the band-pass, shape (n,) [unit of the signal]
    decay_rate: Array  # shape (n,) [1 per sample]
    pole_difference: ComplexArray  # from the pole of the mode, 0 for the mode itself, shape (n,) [rad per sample]
    response_length: float  # standard deviation of the impulse response of the band-pass [samples]
    noise: float  # rms behind the band-pass; 0: unknown [unit of the signal]

    @property
    def is_close(self) -> bool:
        """Whether another mode lies in the band, or so near that it limits the width of the band-pass."""
        others = self.pole_difference[self.pole_difference != 0.0]
        return bool(np.any(abs(others.imag) * self.response_length < _CLOSE_DISTANCE))

    def rate_errors(self, amplitude: Array, first: Array, last: Array) -> tuple[Array, Array]:
        """Return limits of the errors of the decay rate and of the angular frequency [rad per sample].

        `amplitude`: amplitudes of the mode, shape (m,); `first`, `last`: samples between which the envelope is fitted.
        The limits are infinite where another mode has the larger amplitude.
        """
        time, length = (first - self.begin)[:, None], (last - first)[:, None]
        change, width = abs(self.pole_difference), self.response_length
        distance, decay = self.pole_difference.imag * width, self.decay_rate * width
        passed = self.amplitude * np.exp(-self.decay_rate * time + 0.5 * (decay**2 - distance**2)) * (change > 0.0)
        # Response of the band-pass to the start of an exponential: asymptote of the complementary error function.
        argument = np.maximum(np.hypot(time / width - decay, distance), 1.0)
        transient = self.amplitude * np.exp(-0.5 * (time / width) ** 2) / (np.sqrt(2.0 * np.pi) * argument)
        with np.errstate(divide="ignore", invalid="ignore"):
            passed, transient = (each / np.maximum(amplitude[:, None] - each, 0.0) for each in (passed, transient))
            slope = change * np.minimum(1.0, _SLOPE_OF_BEATS / (0.5 * length * np.maximum(change, 1e-12)) ** 2)
            slope_of_transient = _SLOPE_OF_STEP / length * np.minimum(1.0, width / length)
            rate_error = passed * slope + transient * slope_of_transient
            frequency_error = passed * np.minimum(change, 2.0 / length) + transient / length
        return rate_error.sum(axis=1), frequency_error.sum(axis=1)


NO_OVERLAP = Overlap(0, np.empty(0), np.empty(0), np.empty(0, dtype=complex), 1.0, 0.0)


def resolve_close_modes(
    acceleration: Array, rate: float, peaks: Array, begin: int, is_single: NDArray[np.bool_] | None = None
) -> tuple[Array, list[Overlap]]:
    """Return the frequencies of the modes at the peaks of a spectrum [Hz], and what disturbs the decay of each.

    A peak of several linear modes is replaced by their frequencies.

    Parameters
    ----------
    acceleration : ndarray, shape (n,)
        Acceleration from before the impact [m/s²].
    rate : float
        Sample rate [Hz].
    peaks : ndarray, shape (m,)
        Frequencies of the peaks, ascending [Hz].
    begin : int
        Sample at which the free decay begins.
    is_single : ndarray, shape (m,), optional
        Peaks that are known to be those of one mode: a damper can give it several poles. Default: none.
    """
    if not peaks.size:
        return peaks, []
    angle = 2.0 * np.pi / rate
    widths = [band_width(peaks, index) for index in range(peaks.size)]
    of_peaks = [_poles_of_peak(acceleration, rate, *peak, begin) for peak in zip(peaks, widths, strict=True)]
    if is_single is not None:
        of_peaks = [
            (poles.strongest() if single else poles, delay)
            for (poles, delay), single in zip(of_peaks, is_single, strict=True)
        ]
    frequencies, own_rates, densities = list[float](), list[complex](), list[float]()
    for peak, width, (poles, _) in zip(peaks, widths, of_peaks, strict=True):
        modes = poles.rate[poles.is_mode]
        frequencies += (modes.imag / angle).tolist() or [float(peak)]
        own_rates += modes.tolist() or poles.strongest().rate.tolist() or [1j * angle * peak]
        densities += [poles.residual / np.sqrt(width)] * modes.size or [0.0]
    rates = np.concatenate([poles.rate for poles, _ in of_peaks])
    amplitudes = np.concatenate([poles.amplitude * np.exp(-poles.rate.real * delay) for poles, delay in of_peaks])
    resolved, overlaps = np.array(frequencies), list[Overlap]()
    for index, (own_rate, density) in enumerate(zip(own_rates, densities, strict=True)):
        width = band_width(resolved, index)
        slowest = -own_rate.real if own_rate.real else angle * width
        included = -rates.real <= _MAX_DECAY_RATIO * slowest
        overlaps.append(
            Overlap(
                begin=begin,
                amplitude=amplitudes[included],
                decay_rate=-rates[included].real,
                pole_difference=rates[included] - own_rate,
                response_length=1.0 / (angle * width),
                noise=density * np.sqrt(width),
            )
        )
    return resolved, overlaps


def _poles_of_peak(acceleration: Array, rate: float, peak: float, width: float, begin: int) -> tuple[Poles, int]:
    """Return the poles at a peak, in rad per sample, and the delay after `begin` to which their amplitudes apply."""
    analytic, affected = band_pass(acceleration, rate, peak, width)
    step = max(1, int(rate / (8.0 * width)))
    # The transients of the band-pass decay below 1e-7 within twice the affected samples.
    delay = 2 * affected
    decay = analytic[begin + delay : max(acceleration.size - delay, 0)][::step]
    angle = 2.0 * np.pi / rate
    poles = close_poles(decay * np.exp(-1j * angle * peak * step * np.arange(decay.size)), 2.0 * width * angle * step)
    return Poles(1j * angle * peak + poles.rate / step, poles.amplitude, poles.is_mode, poles.residual), delay
