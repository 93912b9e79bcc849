"""Systematic errors of a response, which averaging does not reduce.

Each error has a name for display and a limit of its magnitude, like a tolerance in a data sheet. The functions whose
names end in `_bound` return the limit in the unit of the response, at each spectral line (shape (lines,)), alone or in
a dictionary by name. The functions whose names end in `_sources` return the complex change of the response if the error
of a source (sensor or clock) equals its limit; the key identifies the source, which other responses may share.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from daq.core.recording.recording import Recording
from daq.core.signal_chain.channel import ChannelInfo
from rig.core.base.arrays import Array, ComplexArray
from rig.core.results import format_percent
from rig.core.results.response import MOTIONS
from rig.core.results.uncertainty import CLOCK, COVERAGE_FACTOR, SENSITIVITY, Sources
from rig.core.settings.quantities import PER_KELVIN, RATIO, TEMPERATURE, Kind, parse

# Names of the errors.
REFERENCE_NOISE = "noise in the reference"
LEAKAGE = "leakage"
UNSETTLED = "residual transient"
ALIASING = "aliasing"
RESOLUTION = "converter's resolution"
MODEL = "local model"
REFERENCE = "uncertain reference"
JITTER = "jitter of the sampling instants"
#: Errors that vary irregularly from one spectral line to the next.
IRREGULAR = (UNSETTLED, RESOLUTION, MODEL, REFERENCE, JITTER)
# Assumed ratio of transverse to axial motion, if the data sheet specifies only a transverse sensitivity.
_LATERAL_RATIO = 0.1
# Minimum number of lines that determine the slope of a curve by central differences.
_MIN_SLOPE_LINES = 3
# Slope for fewer lines, in value / frequency: that of a peak with a half-power width of a fifth of its frequency.
_ASSUMED_SLOPE_RATIO = 10.0
# Between lines, the slope of a peak is at most this multiple of the slope of its chords.
_MAX_CHORD_RATIO = 10.0
# Mean square of a signal of a quarter of a count, in counts²; rounding may hide a smaller signal.
_MIN_POWER_COUNTS = 1.0 / 16.0


#: Tolerance of sensors of imported recordings that state none: the uncertainty of a good calibration (ISO 16063-21).
ASSUMED_TOLERANCE = 0.01


@dataclass(frozen=True)
class ChannelContributions:
    """Contributions of the channels to a response and to its reference."""

    names: Sequence[str]  # channels, in the order of the rows of the two following arrays
    frequency: Array  # Hz, shape (lines,)
    motion: str  # quantity of the response
    value: ComplexArray  # response, the sum of its contributions; shape (lines,)
    response: ComplexArray  # contribution of each channel to the response, shape (channels, lines)
    reference: ComplexArray  # contribution of each channel to the reference, with the sum 1; shape (channels, lines)

    @property
    def gain_sensitivity(self) -> ComplexArray:
        """Return the sensitivity of the response to each channel's relative gain error, shape (channels, lines)."""
        return self.response - self.value * self.reference


def stated_tolerance(info: ChannelInfo) -> float:
    """Compute the maximum relative error of a channel's sensitivity according to its data sheet.

    This is the sum of calibration tolerance, temperature drift and transverse sensitivity.

    >>> from daq.core.signal_chain.channel import ChannelInfo
    >>> sheet = {"accelerometer.sensitivity_tolerance": "0.1", "accelerometer.transverse": "0.05"}
    >>> round(stated_tolerance(ChannelInfo("a1", "body 1", "acceleration", 1.0, 5120.0, sensor=sheet)), 6)
    0.105
    """
    return _setting(info, "sensitivity_tolerance", RATIO) + sum(side_errors(info).values())


def side_errors(info: ChannelInfo) -> dict[str, float]:
    """Return the relative errors in a channel's `stated_tolerance`, by cause, that a calibration does not contain."""
    errors = {
        "temperature": _setting(info, "temperature_drift", PER_KELVIN)
        * _setting(info, "temperature_change", TEMPERATURE),
        "transverse sensitivity": _setting(info, "transverse", RATIO)
        * _setting(info, "lateral", RATIO, _LATERAL_RATIO),
    }
    return {cause: error for cause, error in errors.items() if error}


def _setting(info: ChannelInfo, name: str, kind: Kind, default: float = 0.0) -> float:
    return next((abs(parse(text, kind)) for key, text in info.sensor.items() if key.endswith("." + name)), default)


def tolerance(rec: Recording, name: str) -> float:
    """Return the tolerance of a channel: `stated_tolerance`, plus `ASSUMED_TOLERANCE` if its sensor states none."""
    return stated_tolerance(rec.channels[name]) + (ASSUMED_TOLERANCE if has_assumed_tolerance(rec, name) else 0.0)


def has_assumed_tolerance(rec: Recording, name: str) -> bool:
    """Return whether a tolerance is assumed: the recording is imported, and the scene states none for the sensor."""
    info = rec.channels[name]
    is_stated = any(key.endswith(".sensitivity_tolerance") for key in info.sensor) or info.quantity == "voltage"
    return bool(rec.source) and not is_stated


def tolerance_text(rec: Recording, name: str) -> str:
    """Write the `tolerance` of a channel, such as "1 %, assumed"; empty without a tolerance."""
    limit = tolerance(rec, name)
    return f"{format_percent(limit)}{', assumed' * has_assumed_tolerance(rec, name)}" if limit else ""


def sensitivity_limit(rec: Recording, contributions: ChannelContributions) -> dict[str, Array]:
    """Compute the maximum error of a response due to the tolerances of its channels; empty without tolerances."""
    gain = np.array([[tolerance(rec, name)] for name in contributions.names])
    return {SENSITIVITY: gain_error_limit(gain, relative_to_reading(gain), contributions)} if gain.any() else {}


def sensor_sources(rec: Recording, contributions: ChannelContributions) -> dict[str, Sources]:
    """Return the change of a response by each sensor at its tolerance, to first order; empty without tolerances."""
    limits = {name: tolerance(rec, name) for name in contributions.names}
    sources = {
        _identity(rec, rec.channels[name].to_metadata()): limit * change
        for (name, limit), change in zip(limits.items(), contributions.gain_sensitivity, strict=True)
        if limit and np.any(change)
    }
    return {SENSITIVITY: sources} if sources else {}


def _identity(rec: Recording, device: object) -> str:
    """Return the identity of a sensor or clock: equal for recordings with the same scene seed and data sheet."""
    return json.dumps([rec.scene.seed, device], sort_keys=True)


def common_scale(rec: Recording, outputs: Sequence[str], references: Sequence[str]) -> float:
    """Return the maximum relative error of a single reference channel, common to all responses; 0 for several."""
    is_common = len(references) == 1 and references[0] not in outputs
    return tolerance(rec, references[0]) if is_common else 0.0


def relative_to_reading(error: Array) -> Array:
    """Convert maximum errors relative to true values to maximum errors relative to readings.

    The error of a reading that is too small is larger relative to the reading than relative to the true value. The
    result is infinite for errors of 1 or more.

    >>> relative_to_reading(np.array([0.2, 0.5, 1.0, 1e20])).tolist()
    [0.25, 1.0, inf, inf]
    """
    return np.divide(error, 1.0 - error, out=np.full(error.shape, np.inf), where=error < 1.0)


def gain_error_limit(true_ratio: Array, recorded_ratio: Array, contributions: ChannelContributions) -> Array:
    """Compute the maximum error of a response if the reading of each channel is 1 + e times its true value.

    The response is the ratio of two sums over the channels. With their recorded contributions u to the numerator and v
    to the denominator, both relative to the recorded denominator so that sum(v) = 1, its error is ``sum((u - v sum(u))
    e/(1+e)) / sum(v/(1+e))``. A first upper bound follows directly. Further bounds follow if both sums are first
    divided by the factor 1 + e of any single channel; these bounds are smaller for a channel that is the entire
    denominator. All bounds are valid; the smallest is returned. `true_ratio` and `recorded_ratio` are upper bounds of
    ``abs(e)`` and ``abs(e / (1 + e))``, shape (channels, lines) or (channels, 1). The result is infinite if the true
    denominator may be zero.
    """
    in_response: Array = np.asarray(abs(contributions.gain_sensitivity), dtype=float)
    in_reference: Array = np.asarray(abs(contributions.reference), dtype=float)
    # Error of the numerator and relative error of the denominator, for each bound.
    errors = [[np.sum(zero_safe_product(size, recorded_ratio), axis=0) for size in (in_response, in_reference)]]
    with np.errstate(divide="ignore", invalid="ignore"):
        for row, channel_error in enumerate(true_ratio):
            others = np.arange(len(true_ratio)) != row
            other_error = recorded_ratio[others] * (1.0 + channel_error)
            difference = (channel_error + true_ratio[others]) * (1.0 + recorded_ratio[others])
            numerator_error = in_response[row] * channel_error
            numerator_error = numerator_error + np.sum(zero_safe_product(in_response[others], other_error), axis=0)
            errors.append([numerator_error, np.sum(zero_safe_product(in_reference[others], difference), axis=0)])
        bounds = [
            np.where(denominator_error < 1.0, numerator_error / np.maximum(1.0 - denominator_error, 1e-300), np.inf)
            for numerator_error, denominator_error in errors
        ]
    return np.asarray(np.nanmin(bounds, axis=0))


def zero_safe_product(size: Array, factor: Array) -> Array:
    """Multiply, with zero times infinity defined as zero; `size`: 0 or more."""
    return np.asarray(np.where(size > 0.0, size * factor, 0.0))


def reference_noise_limit(value: ComplexArray, coherence: Array) -> Array:
    """Compute the maximum bias of H1 towards zero: the bias if all incoherent power is noise in the reference.

    The true value is between H1 and H2 = H1 / coherence (Bendat and Piersol, section 6.1.4).
    """
    return np.asarray(abs(value) * (1.0 / np.maximum(coherence, 1e-6) - 1.0))


def shared_noise_limit(
    noise: Array, change_per_reading: ComplexArray, reference_weights: ComplexArray, reference_power: Array
) -> Array:
    """Compute the maximum error of H1 due to noise of channels that contribute to both response and reference.

    Noise of power N in a channel with the weights u in the response and l in the reference adds ``u l* N`` to their
    cross-spectrum and ``|l|^2 N`` to the reference's power: H1 has the error ``(u - H1 l) l* N`` over the noise-free
    part of the reference's power. The coherence does not show this error, because noise common to both resembles a
    response. `noise`: N; `change_per_reading`: ``u - H1 l``; `reference_weights`: l; all of shape (channels, lines).
    """
    noise_free = reference_power - np.sum(abs(reference_weights) ** 2 * noise, axis=0)
    bias = np.sum(abs(change_per_reading * reference_weights) * noise, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(noise_free > 0.0, bias / noise_free, np.inf))


def uncertain_reference_limit(first_order_error: Array, deviation: Array) -> dict[str, Array]:
    """Compute the additional error of a response whose reference may be smaller than its reading.

    With errors dx of a response x = H f and df of its reference, x / f has the error ``(dx - H df) / (f - df)``: the
    first-order error over ``1 - df / f``. `first_order_error`: limit of the first-order error; `deviation`: maximum of
    ``df / f``. For a deviation of 1 or more, the error is unbounded.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        excess = np.sqrt(1.0 / np.maximum(1.0 - deviation, 0.0) ** 2 - 1.0)
        return {REFERENCE: np.where(deviation < 1.0, np.where(excess > 0.0, first_order_error * excess, 0.0), np.inf)}


def rounding_limit(gain: Array, contributions: ChannelContributions) -> dict[str, Array]:
    """Compute the maximum error of a response due to rounding, for readings of a few counts.

    `gain`, shape (channels, lines): maximum relative change of each channel's gain due to rounding, from
    `noise_gain_error` or `tone_gain_error`.
    """
    if not gain.any():
        return {}
    return {RESOLUTION: np.sum(gain * np.maximum(abs(contributions.gain_sensitivity), 1e-300), axis=0)}


def jitter_limit(factor: Array, weights: ComplexArray, power: Array) -> dict[str, Array]:
    """Compute the maximum error of a response due to jitter during and shortly after the impacts.

    `weights`, shape (channels, lines): change of the response per unit change of each reading, for a reference of 1.
    `power`: power of the reference, summed over all impacts.

    >>> part = jitter_limit(np.array([[2.0, 1.0]]), np.array([[1.0], [-2.0]]) + 0j, np.ones(1))
    >>> {name: size.tolist() for name, size in part.items()}  # equal relative errors
    {'jitter of the sampling instants': [0.0]}
    """
    if not factor.any():
        return {}
    return {JITTER: COVERAGE_FACTOR * np.linalg.norm(factor @ weights, axis=0) / np.sqrt(np.maximum(power, 1e-300))}


def noise_gain_error(power: Array) -> Array:
    """Compute the maximum relative change of the gain due to rounding to counts, for noise of a power in counts².

    The rounding error is random noise except for a part proportional to the signal, at most ``2 exp(-2 pi^2 s^2)`` for
    Gaussian noise of s counts (B. Widrow, I. Kollár, Quantization Noise, Cambridge University Press 2008, sections 4
    and 11). `power` includes the rounding error, 1/12. Below a quarter of a count the gain is unbounded (infinite).
    """
    power = power - 1.0 / 12.0
    return np.asarray(np.where(power > _MIN_POWER_COUNTS, 2.0 * np.exp(-2.0 * np.pi**2 * power), np.inf))


def tone_gain_error(power: Array) -> Array:
    """Compute the maximum relative change of the gain due to rounding to counts, for a sine; see `noise_gain_error`.

    For a sine of the amplitude A, in counts, the first term of the quantizer's series in Bessel functions is
    ``2 / (pi^2 A^1.5)``; the sum of all terms is at most twice this term. A sine below half a count is not recorded.
    """
    amplitude = np.sqrt(2.0 * np.maximum(power - 1.0 / 12.0, 0.0))
    with np.errstate(divide="ignore"):
        return np.asarray(np.where(amplitude > 0.5, 4.0 / np.pi**2 * amplitude**-1.5, np.inf))


def reproducible_rounding(power: Array) -> Array:
    """Compute the fraction of a sine's rounding error that repeats in every period, with noise of a power in counts².

    Noise of s counts reduces the first term of the quantizer's series by ``exp(-2 pi^2 s^2)``, and all others more
    (Widrow and Kollár, as in `noise_gain_error`). `power` includes the rounding error, 1/12.
    """
    return np.asarray(np.exp(-2.0 * np.pi**2 * np.maximum(power - 1.0 / 12.0, 0.0)))


def power_in_counts(rec: Recording, names: Sequence[str], squares: Array) -> Array:
    """Convert mean squares of readings, shape (channels, ...), to counts²; infinite for analog channels."""
    steps = quantization_steps(rec, names).reshape(-1, *[1] * (squares.ndim - 1))
    with np.errstate(divide="ignore"):
        return np.asarray(np.where(steps > 0.0, squares / np.where(steps > 0.0, steps, 1.0) ** 2, np.inf))


def quantization_steps(rec: Recording, names: Sequence[str]) -> Array:
    """Return the size of a count of each channel in its unit; 0 for analog channels."""
    infos = [rec.channels[name] for name in names]
    return np.array([0.0 if info.volts_per_count is None else info.unit_per_count for info in infos])


def clock_limit(rec: Recording, contributions: ChannelContributions) -> dict[str, Array]:
    """Compute the maximum error of a response due to the error of the sample clock.

    A wrong frequency has two effects: the curve is shifted, and the powers of frequency that convert an acceleration to
    a displacement are wrong.
    """
    deviation = clock_deviation(rec)
    if not deviation:
        return {}
    frequency, value = contributions.frequency, contributions.value
    order = np.argsort(frequency, kind="stable")
    slope_limit = np.empty(frequency.size)
    slope_limit[order] = _change_by_shift(frequency[order], value[order], deviation * frequency[order])
    if frequency.size < _MIN_SLOPE_LINES:
        slope_limit = np.maximum(slope_limit, deviation * _ASSUMED_SLOPE_RATIO * abs(value))
    return {CLOCK: slope_limit + deviation * abs(_conversion_error(rec, contributions))}


def clock_sources(rec: Recording, contributions: ChannelContributions) -> dict[str, Sources]:
    """Return the change of a response at the limit of the sample clock, to first order; empty without a tolerance.

    The result is also empty for a response with few lines, because the slope of the curve is unknown.
    """
    frequency, value = contributions.frequency, contributions.value
    deviation = clock_deviation(rec)
    if not deviation or frequency.size < _MIN_SLOPE_LINES or np.unique(frequency).size < frequency.size:
        return {}
    order = np.argsort(frequency, kind="stable")
    slope = np.empty(frequency.size, dtype=complex)
    slope[order] = np.gradient(value[order], frequency[order])
    change = deviation * (frequency * slope + _conversion_error(rec, contributions))
    return {CLOCK: {_identity(rec, CLOCK): change}}


def _conversion_error(rec: Recording, contributions: ChannelContributions) -> ComplexArray:
    """Return the error due to integration or differentiation of readings, per relative frequency error."""
    measured = [rec.channels[name].quantity for name in contributions.names]
    powers = np.array([[MOTIONS.index(name) if name in MOTIONS else 0.0] for name in measured])
    error = np.sum((powers - MOTIONS.index(contributions.motion)) * contributions.response, axis=0)
    return np.asarray(error - contributions.value * np.sum(powers * contributions.reference, axis=0))


def clock_deviation(rec: Recording) -> float:
    """Return the maximum relative error of all frequencies due to the sample clock."""
    return abs(rec.scene.converter.clock_error or 0.0)


def _change_by_shift(frequency: Array, value: ComplexArray, shift: Array) -> Array:
    """Compute the largest change of a curve if its frequencies, in ascending order, are shifted by up to `shift` [Hz].

    A *chord* is the slope between two lines. Between sparse lines a peak is steeper than its chords. A pole and a
    constant, ``a / (f - p) + b``, are therefore fitted to each line and its two neighbors. The slope of this function
    at the line is the product of the chords to both neighbors over the chord between the neighbors.
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
