"""Systematic errors of a response, which averaging does not reduce.

Each *part* is the limit of one error, like a tolerance in a data sheet, and has a name for display. The functions that
end in `_part` return it in the unit of the response, shape (lines,), as a dictionary with its name.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from rig.arrays import Array, ComplexArray
from rig.results.response import MOTIONS
from rig.results.uncertainty import CLOCK, SENSITIVITY
from rig.scene.quantities import PER_KELVIN, RATIO, TEMPERATURE, Kind, parse

if TYPE_CHECKING:
    from daq.recording.recording import Recording
    from daq.signal_chain.channel import ChannelInfo


# Names of the parts.
REFERENCE_NOISE = "noise in the reference"
LEAKAGE = "leakage"
UNSETTLED = "not yet steady"
ALIASING = "aliasing"
RESOLUTION = "converter's resolution"
MODEL = "local model"
REFERENCE = "uncertain reference"
JITTER = "jitter of the sampling instants"
#: Parts whose sign and size differ from line to line.
ROUGH = (UNSETTLED, RESOLUTION, MODEL, REFERENCE, JITTER)
# Assumed ratio of transverse to axial motion, if the data sheet states only a transverse sensitivity.
_LATERAL_RATIO = 0.1
# Smallest number of lines that determine the slope of a curve.
_MIN_SLOPE_LINES = 3
# Slope that is assumed for fewer lines, as a multiple of value / frequency. It is sufficient for peaks with a
# half-width of at least a twentieth of their frequency.
_ASSUMED_SLOPE_RATIO = 10.0
# Largest slope of a peak between lines, relative to the slope of its chords.
_MAX_CHORD_RATIO = 10.0
# Power of a quarter of a count, in counts²: rounding may hide a smaller signal.
_MIN_POWER_COUNTS = 1.0 / 16.0


@dataclass(frozen=True)
class ReadingShares:
    """Contributions of the channels to a response and to its reference."""

    names: Sequence[str]  # channels, in the order of the rows
    frequency: Array  # Hz, shape (lines,)
    motion: str  # quantity of the response
    value: ComplexArray  # response, the sum of its shares; shape (lines,)
    response: ComplexArray  # contribution of each channel to the response, shape (channels, lines)
    reference: ComplexArray  # contribution of each channel to the reference, with the sum 1; shape (channels, lines)

    @property
    def difference(self) -> ComplexArray:
        """Return the change of the response per relative change of each channel, shape (channels, lines)."""
        return self.response - self.value * self.reference


def tolerance(info: ChannelInfo) -> float:
    """Compute the largest relative deviation of a channel's sensitivity by its data sheet.

    It is the sum of calibration tolerance, temperature drift and transverse sensitivity.

    >>> from daq.signal_chain.channel import ChannelInfo
    >>> sheet = {"accelerometer.sensitivity_tolerance": "0.1", "accelerometer.transverse": "0.05"}
    >>> round(tolerance(ChannelInfo("a1", "body 1", "acceleration", 1.0, 5120.0, sensor=sheet)), 6)
    0.105
    """

    def setting(name: str, kind: Kind, default: float = 0.0) -> float:
        for key, text in info.sensor.items():
            if key.endswith("." + name):
                return abs(parse(text, kind))
        return default

    thermal = setting("temperature_drift", PER_KELVIN) * setting("temperature_change", TEMPERATURE)
    transverse = setting("transverse", RATIO) * setting("lateral", RATIO, _LATERAL_RATIO)
    return setting("sensitivity_tolerance", RATIO) + thermal + transverse


def sensitivity_part(rec: Recording, shares: ReadingShares) -> dict[str, Array]:
    """Compute the largest deviation of a response by the tolerances of its channels; empty without tolerances."""
    gain = np.array([[tolerance(rec.channels[name])] for name in shares.names])
    return {SENSITIVITY: gain_error_limit(gain, relative_to_reading(gain), shares)} if gain.any() else {}


def common_scale(rec: Recording, outputs: Sequence[str], references: Sequence[str]) -> float:
    """Return the largest relative error of a single reference channel, common to all responses; 0 for several."""
    is_common = len(references) == 1 and references[0] not in outputs
    return tolerance(rec.channels[references[0]]) if is_common else 0.0


def relative_to_reading(deviation: Array) -> Array:
    """Convert largest deviations relative to true values into deviations relative to readings; infinite from 1 on.

    For a reading that is too small, the deviation relative to the reading exceeds the deviation relative to the true
    value.

    >>> relative_to_reading(np.array([0.2, 0.5, 1.0, 1e20])).tolist()
    [0.25, 1.0, inf, inf]
    """
    return np.divide(deviation, 1.0 - deviation, out=np.full(deviation.shape, np.inf), where=deviation < 1.0)


def gain_error_limit(gain: Array, gain_reading: Array, shares: ReadingShares) -> Array:
    """Compute the largest error of a quotient of readings, each of which is 1 + e times its true value, shape (lines,).

    With the contributions u and l of the channels to numerator and denominator, the quotient has the error
    ``sum (u - l sum(u)) e/(1+e)`` over ``sum l/(1+e)``. A first limit follows directly. Others follow if both sums are
    divided by the gain of any single channel, which reduces the error to e for a channel that is the entire
    denominator. All limits are valid; the smallest is returned. `gain` and `gain_reading` are upper limits of
    ``abs(e)`` and ``abs(e / (1 + e))``, shape (channels, lines) or (channels, 1). The result is infinite if the true
    denominator may be zero.
    """
    in_quotient: Array = np.asarray(abs(shares.difference), dtype=float)
    in_reference: Array = np.asarray(abs(shares.reference), dtype=float)
    # Numerator and relative uncertainty of the denominator of each limit.
    quotients = [[np.sum(zero_times(share, gain_reading), axis=0) for share in (in_quotient, in_reference)]]
    with np.errstate(divide="ignore", invalid="ignore"):
        for row, channel_gain in enumerate(gain):
            others = np.arange(len(gain)) != row
            other_error = gain_reading[others] * (1.0 + channel_gain)
            difference = (channel_gain + gain[others]) * (1.0 + gain_reading[others])
            deviation = in_quotient[row] * channel_gain + np.sum(zero_times(in_quotient[others], other_error), axis=0)
            quotients.append([deviation, np.sum(zero_times(in_reference[others], difference), axis=0)])
        limits = [
            np.where(uncertainty < 1.0, deviation / np.maximum(1.0 - uncertainty, 1e-300), np.inf)
            for deviation, uncertainty in quotients
        ]
    return np.asarray(np.nanmin(limits, axis=0))


def zero_times(share: Array, factor: Array) -> Array:
    """Multiply, with zero times infinity defined as zero."""
    return np.asarray(np.where(share > 0.0, share * factor, 0.0))


def reference_noise_part(value: ComplexArray, coherence: Array) -> Array:
    """Compute the largest bias of H1 towards zero, if all incoherent power is noise in the reference.

    The true value is between H1 and H2 = H1 / coherence (Bendat and Piersol, section 6.1.4).
    """
    return np.asarray(abs(value) * (1.0 / np.maximum(coherence, 1e-6) - 1.0))


def shared_noise_part(
    noise: Array, difference: ComplexArray, reference_weights: ComplexArray, reference_power: Array
) -> Array:
    """Compute the largest error of H1 by noise of channels in the reference that may also be in the response.

    Noise of power N in a channel with the weights u in the response and l in the reference adds ``u l* N`` to their
    cross-spectrum and ``|l|^2 N`` to the reference's power: H1 has the error ``(u - H1 l) l* N`` over the noise-free
    part of that power. The coherence does not show this error, because noise common to both resembles a response.
    `difference`: ``u - H1 l``; `reference_weights`: l, both of shape (channels, lines).
    """
    noise_free = reference_power - np.sum(abs(reference_weights) ** 2 * noise, axis=0)
    bias = np.sum(abs(difference * reference_weights) * noise, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(noise_free > 0.0, bias / noise_free, np.inf))


def uncertain_reference_part(bound: Array, deviation: Array) -> dict[str, Array]:
    """Compute the additional error of a quotient whose denominator may be smaller than its reading.

    With errors dx of a response x = H f and df of its reference, x / f has the error ``(dx - H df) / (f - df)``: the
    first-order error over ``1 - df / f``. `deviation` is the largest ``df / f``; from 1 on the error is unbounded.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        excess = np.sqrt(1.0 / np.maximum(1.0 - deviation, 0.0) ** 2 - 1.0)
        return {REFERENCE: np.where(deviation < 1.0, np.where(excess > 0.0, bound * excess, 0.0), np.inf)}


def rounding_part(gain: Array, shares: ReadingShares) -> dict[str, Array]:
    """Compute the largest deviation of a response by rounding, for readings of a few counts.

    `gain`, shape (channels, lines): largest relative change of each channel's gain by rounding, from `noise_gain` or
    `tone_gain`.
    """
    if not gain.any():
        return {}
    return {RESOLUTION: np.sum(gain * np.maximum(abs(shares.difference), 1e-300), axis=0)}


def noise_gain(power: Array) -> Array:
    """Compute the largest relative change of the gain by rounding to counts, for a noise signal of a power in counts².

    The rounding error is random noise except for a part proportional to the signal, at most ``2 exp(-2 pi^2 s^2)`` for
    Gaussian noise of s counts (B. Widrow, I. Kollár, Quantization Noise, Cambridge University Press 2008, sections 4
    and 11). `power` includes the rounding error, 1/12. Below a quarter of a count the gain is unbounded (infinite).
    """
    power = power - 1.0 / 12.0
    return np.asarray(np.where(power > _MIN_POWER_COUNTS, 2.0 * np.exp(-2.0 * np.pi**2 * power), np.inf))


def tone_gain(power: Array) -> Array:
    """Compute the largest relative change of the gain by rounding to counts, for a tone; see `noise_gain`.

    For a tone of a counts, the first term of the quantizer's series in Bessel functions is ``2 / pi^2 / a^(3/2)``;
    the sum of all terms is at most twice that. A tone below half a count is not recorded.
    """
    amplitude = np.sqrt(2.0 * np.maximum(power - 1.0 / 12.0, 0.0))
    with np.errstate(divide="ignore"):
        return np.asarray(np.where(amplitude > 0.5, 4.0 / np.pi**2 * amplitude**-1.5, np.inf))


def reproducible_rounding(power: Array) -> Array:
    """Compute the ratio of a tone's rounding error that is equal in every period, with noise of a power in counts².

    Noise of s counts reduces the first term of the quantizer's series by ``exp(-2 pi^2 s^2)``, and all others more
    (Widrow and Kollár, as in `noise_gain`). `power` includes the rounding error, 1/12.
    """
    return np.asarray(np.exp(-2.0 * np.pi**2 * np.maximum(power - 1.0 / 12.0, 0.0)))


def in_counts(rec: Recording, names: Sequence[str], squares: Array) -> Array:
    """Convert mean squares of readings, shape (channels, ...), to counts²; infinite for channels without counts."""
    counts = counts_of(rec, names).reshape(-1, *[1] * (squares.ndim - 1))
    with np.errstate(divide="ignore"):
        return np.asarray(np.where(counts > 0.0, squares / np.where(counts > 0.0, counts, 1.0) ** 2, np.inf))


def counts_of(rec: Recording, names: Sequence[str]) -> Array:
    """Return the size of a count of each channel in its unit; 0 for channels without counts."""
    infos = [rec.channels[name] for name in names]
    return np.array([0.0 if info.volts_per_count is None else info.unit_per_count for info in infos])


def clock_part(rec: Recording, shares: ReadingShares) -> dict[str, Array]:
    """Compute the largest deviation of a response by the error of the sample clock.

    The frequency error acts through the slope of the curve, and through the powers of frequency that convert an
    acceleration to a displacement.
    """
    deviation = clock_deviation(rec)
    if not deviation:
        return {}
    frequency, value = shares.frequency, shares.value
    order = np.argsort(frequency, kind="stable")
    by_slope = np.empty(frequency.size)
    by_slope[order] = _change_by_shift(frequency[order], value[order], deviation * frequency[order])
    if frequency.size < _MIN_SLOPE_LINES:
        by_slope = np.maximum(by_slope, deviation * _ASSUMED_SLOPE_RATIO * abs(value))
    measured = [rec.channels[name].quantity for name in shares.names]
    powers = np.array([[MOTIONS.index(name) if name in MOTIONS else 0.0] for name in measured])
    by_conversion = np.sum((powers - MOTIONS.index(shares.motion)) * shares.response, axis=0)
    by_conversion = by_conversion - value * np.sum(powers * shares.reference, axis=0)
    return {CLOCK: by_slope + deviation * abs(by_conversion)}


def clock_deviation(rec: Recording) -> float:
    """Return the largest relative error of all frequencies by the sample clock."""
    return abs(rec.scene.converter.clock_error or 0.0)


def _change_by_shift(frequency: Array, value: ComplexArray, shift: Array) -> Array:
    """Compute the change of a curve over rising frequencies by frequency errors of either sign.

    Between sparse lines a peak is steeper than its chords. A pole and a constant, ``a / (f - p) + b``, are therefore
    fitted to each line and its neighbors. The slope of this function is the product of the two adjacent chords over
    the chord across.
    """
    spacing = np.diff(frequency)
    chords = np.divide(np.diff(value), spacing, out=np.zeros(spacing.size, dtype=complex), where=spacing > 0.0)
    steepness = abs(chords)
    change = shift * np.maximum(np.append(steepness, 0.0), np.append(0.0, steepness))
    if frequency.size < 3 or np.any(spacing == 0.0):
        return np.asarray(change)
    left, right = chords[:-1], chords[1:]
    chord_across = (value[2:] - value[:-2]) / (frequency[2:] - frequency[:-2])
    with np.errstate(divide="ignore", invalid="ignore"):
        pole = (right * frequency[2:] - left * frequency[:-2]) / (right - left)
        pole_distance = frequency[1:-1] - pole
        linear_change = shift[1:-1] * left * right / chord_across
        min_distance = np.minimum(abs(pole_distance + shift[1:-1]), abs(pole_distance - shift[1:-1]))
        pole_change = np.nan_to_num(abs(linear_change * pole_distance) / min_distance, posinf=np.inf)
    # If the chords are mainly noise, the position of the pole is arbitrary.
    change[1:-1] = np.clip(pole_change, change[1:-1], _MAX_CHORD_RATIO * change[1:-1])
    return np.asarray(change)
