"""What other modes do to the band-passed decay of one mode: modes in its band and at other peaks of the spectrum."""

from dataclasses import dataclass

import numpy as np

from analysis.core.decays.band_pass import band_pass, band_width
from analysis.core.decays.close_modes import Poles, close_poles
from rig.core.base.arrays import Array, ComplexArray

# Largest slope of the least-squares line through an oscillation of many beats, relative to the slope of the oscillation
# and times the square of half its phase: 3, and 3.2 with few beats.
_SLOPE_OF_BEATS = 3.2
# Largest distance of a close mode from the center of the band-pass, relative to its width: the width is at most a
# quarter of the distance to the nearest mode, and peaks of the spectrum are not exactly at the frequencies of modes.
_CLOSE_DISTANCE = 4.5
# Largest decay rate of a mode that disturbs another one, relative to that of the impulse response of the band-pass.
# Faster exponentials are gone, or are transients of the band-pass.
_MAX_DECAY_RATE = 0.25
# Largest slope of the least-squares line through a step, times its length and relative to the height of the step: 1.5,
# and 4 times as much at the end of a parabola.
_SLOPE_OF_STEP = 6.0


@dataclass(frozen=True)
class Overlap:
    """Exponentials of other modes that disturb the band-passed decay of one mode."""

    begin: int  # sample at which the free decay begins
    amplitude: Array  # at `begin`, before the band-pass, shape (n,) [unit of the signal]
    decay_rate: Array  # shape (n,) [1 per sample]
    pole_difference: ComplexArray  # from the pole of the mode, shape (n,) [rad per sample]
    response_length: float  # standard deviation of the impulse response of the band-pass [samples]
    noise: float  # rms behind the band-pass; 0: unknown [unit of the signal]

    @property
    def is_close(self) -> bool:
        """Whether another mode lies in the band, or so near that it limits the width of the band-pass."""
        return bool(np.any(abs(self.pole_difference.imag) * self.response_length < _CLOSE_DISTANCE))

    def rate_errors(self, amplitude: Array, first: Array, last: Array) -> tuple[Array, Array]:
        """Return limits of the errors of the decay rate and of the angular frequency [rad per sample].

        `amplitude`: amplitudes of the mode, shape (m,); `first`, `last`: samples between which the envelope is fitted.
        The limits are infinite where another mode has the larger amplitude.
        """
        time, length = (first - self.begin)[:, None], (last - first)[:, None]
        distance = self.pole_difference.imag * self.response_length
        passed = self.amplitude * np.exp(-self.decay_rate * time - 0.5 * distance**2)
        # Asymptote of the complementary error function: response of the band-pass to the start of an exponential.
        position = time / self.response_length
        transient = self.amplitude * np.exp(-0.5 * position**2) / (np.sqrt(2.0 * np.pi) * np.hypot(position, distance))
        with np.errstate(divide="ignore", invalid="ignore"):
            passed, transient = (each / np.maximum(amplitude[:, None] - each, 0.0) for each in (passed, transient))
            change = abs(self.pole_difference)
            slope = change * np.minimum(1.0, _SLOPE_OF_BEATS / (0.5 * length * change) ** 2)
            rate_error = passed * slope + transient * _SLOPE_OF_STEP / length
            frequency_error = passed * np.minimum(change, 2.0 / length) + transient / length
        return rate_error.sum(axis=1), frequency_error.sum(axis=1)


NO_OVERLAP = Overlap(0, np.empty(0), np.empty(0), np.empty(0, dtype=complex), 1.0, 0.0)


def resolve_close_modes(acceleration: Array, rate: float, peaks: Array, begin: int) -> tuple[Array, list[Overlap]]:
    """Return the frequencies of the modes at the peaks of a spectrum [Hz], and what disturbs the decay of each.

    A peak of several linear modes is replaced by their frequencies. `acceleration`, m/s², from before the impact;
    `peaks`: ascending, Hz; `begin`: sample at which the free decay begins.
    """
    if not peaks.size:
        return peaks, []
    angle = 2.0 * np.pi / rate
    widths = [band_width(peaks, index) for index in range(peaks.size)]
    of_peaks = [_poles_of_peak(acceleration, rate, *peak, begin) for peak in zip(peaks, widths, strict=True)]
    frequencies, own_rates, densities = list[float](), list[complex](), list[float]()
    for peak, width, poles in zip(peaks, widths, of_peaks, strict=True):
        modes = poles.rate[poles.is_mode]
        strongest = [poles.rate[np.argmax(poles.amplitude)]] if poles.amplitude.size else [1j * angle * peak]
        frequencies += (modes.imag / angle).tolist() or [float(peak)]
        own_rates += modes.tolist() or strongest
        densities += [poles.residual / np.sqrt(width)] * modes.size or [0.0]
    rates, amplitudes = (np.concatenate(each) for each in zip(*((p.rate, p.amplitude) for p in of_peaks), strict=True))
    resolved, overlaps = np.array(frequencies), list[Overlap]()
    for index, (own_rate, density) in enumerate(zip(own_rates, densities, strict=True)):
        width, others = band_width(resolved, index), rates != own_rate
        overlaps.append(
            Overlap(
                begin=begin,
                amplitude=amplitudes[others],
                decay_rate=-rates[others].real,
                pole_difference=rates[others] - own_rate,
                response_length=1.0 / (angle * width),
                noise=density * np.sqrt(width),
            )
        )
    return resolved, overlaps


def _poles_of_peak(acceleration: Array, rate: float, peak: float, width: float, begin: int) -> Poles:
    """Return the poles at a peak of the spectrum, with rates in rad per sample and amplitudes at `begin`."""
    analytic, affected = band_pass(acceleration, rate, peak, width)
    step = max(1, int(rate / (8.0 * width)))
    # The transients of the band-pass decay below 1e-7 within twice the affected samples.
    delay = 2 * affected
    decay = analytic[begin + delay : max(acceleration.size - delay, 0)][::step]
    angle = 2.0 * np.pi / rate
    poles = close_poles(decay * np.exp(-1j * angle * peak * step * np.arange(decay.size)), 2.0 * width * angle * step)
    rates = poles.rate / step
    kept = poles.is_mode | (-rates.real < _MAX_DECAY_RATE * angle * width)
    amplitude = poles.amplitude * np.exp(-rates.real * delay)
    return Poles(1j * angle * peak + rates[kept], amplitude[kept], poles.is_mode[kept], poles.residual)
