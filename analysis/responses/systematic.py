"""Systematic errors of a response, which averaging does not reduce.

Each part is a largest deviation, like a tolerance in a data sheet, and has a name for display.
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


REFERENCE_NOISE, LEAKAGE, UNSETTLED = "noise in the reference", "leakage", "not yet steady"
ALIASING, RESOLUTION, MODEL = "aliasing", "converter's resolution", "local model"
REFERENCE = "doubtful reference"
JITTER = "jitter of the sampling instants"
#: Parts that differ from line to line.
ROUGH = (UNSETTLED, RESOLUTION, MODEL, REFERENCE, JITTER)
# Assumed transverse motion as a share of the vertical motion, if the data sheet states only a transverse sensitivity.
_LATERAL = 0.1
# Fewer lines do not determine the slope, which may be that of a peak. The slope is then assumed to be this multiple
# of value / frequency, which is sufficient for peaks with a half-width of at least a twentieth of their frequency.
_SLOPE_LINES, _STEEP = 3, 10.0
# The slope of a peak between lines is limited to this multiple of the slope of its chords.
_SHARPEST = 10.0
# Power in counts² below which rounding hides any signal.
_QUARTER = 1.0 / 16.0


@dataclass(frozen=True)
class ReadingShares:
    """Shares of the channels in a response and in its reference."""

    names: Sequence[str]  # channels, in the order of the rows
    frequency: Array  # Hz, shape (lines,)
    motion: str  # quantity of the response
    value: ComplexArray  # response, the sum of `upper`; shape (lines,)
    upper: ComplexArray  # share of each channel in the response, shape (channels, lines)
    lower: ComplexArray  # share of each channel in the reference, whose sum is 1; shape (channels, lines)

    @property
    def difference(self) -> ComplexArray:
        """Return the change of the response per relative change of each channel, shape (channels, lines)."""
        return self.upper - self.value * self.lower


def tolerance(info: ChannelInfo) -> float:
    """Compute the largest relative deviation of a channel's sensitivity by its data sheet.

    The sum of calibration tolerance, temperature drift and transverse sensitivity.

    >>> from daq.signal_chain.channel import ChannelInfo
    >>> sheet = {"accelerometer.sensitivity_tolerance": "0.1", "accelerometer.transverse": "0.05"}
    >>> round(tolerance(ChannelInfo("a1", "body 1", "acceleration", 1.0, 5120.0, sensor=sheet)), 6)
    0.105
    """

    def given(name: str, kind: Kind, otherwise: float = 0.0) -> float:
        for key, text in info.sensor.items():
            if key.endswith("." + name):
                return abs(parse(text, kind))
        return otherwise

    warmth = given("temperature_drift", PER_KELVIN) * given("temperature_change", TEMPERATURE)
    sideways = given("transverse", RATIO) * given("lateral", RATIO, _LATERAL)
    return given("sensitivity_tolerance", RATIO) + warmth + sideways


def sensitivity_part(rec: Recording, shares: ReadingShares) -> dict[str, Array]:
    """Compute the largest deviation of a response by the tolerances of its channels; empty without tolerances."""
    share = np.array([[tolerance(rec.channels[name])] for name in shares.names])
    return {SENSITIVITY: gain_errors(share, of_reading(share), shares)} if share.any() else {}


def common_scale(rec: Recording, above: Sequence[str], below: Sequence[str]) -> float:
    """Return the largest relative error of a single reference channel, which is common to all responses; or 0."""
    alone = len(below) == 1 and below[0] not in above
    return tolerance(rec.channels[below[0]]) if alone else 0.0


def of_reading(share: Array) -> Array:
    """Convert largest deviations relative to true values into deviations relative to readings; infinite from 1 on.

    For a reading that is too small, the deviation relative to the reading exceeds the deviation relative to the true
    value.

    >>> of_reading(np.array([0.2, 0.5, 1.0, 1e20])).tolist()
    [0.25, 1.0, inf, inf]
    """
    return np.divide(share, 1.0 - share, out=np.full(share.shape, np.inf), where=share < 1.0)


def gain_errors(share: Array, far: Array, shares: ReadingShares) -> Array:
    """Compute the largest error of a quotient of readings, each of which is 1 + e times its true value, shape (lines,).

    For readings with the sums u and l, the quotient has the error ``sum (u - l u/l) e/(1+e)`` over ``sum l/(1+e)``.
    This is bounded directly, and after division of both sums by the gain of any single channel, which reduces the error
    to e for a channel that is the entire denominator. The smallest of these bounds is valid. `share` and `far` are
    upper limits of ``abs(e)`` and ``abs(e / (1 + e))``, shape (channels, lines) or (channels, 1). Infinite if the true
    denominator may be zero.
    """
    parts: Array = np.asarray(abs(shares.difference), dtype=float)
    in_reference: Array = np.asarray(abs(shares.lower), dtype=float)
    # Numerator and relative uncertainty of the denominator of each bound.
    quotients = [[np.sum(nothing_times(each, far), axis=0) for each in (parts, in_reference)]]
    with np.errstate(divide="ignore", invalid="ignore"):
        for one, own in enumerate(share):
            others = np.arange(len(share)) != one
            more = far[others] * (1.0 + own)
            apart = (own + share[others]) * (1.0 + far[others])
            deviation = parts[one] * own + np.sum(nothing_times(parts[others], more), axis=0)
            quotients.append([deviation, np.sum(nothing_times(in_reference[others], apart), axis=0)])
        bounds = [
            np.where(doubt < 1.0, deviation / np.maximum(1.0 - doubt, 1e-300), np.inf)
            for deviation, doubt in quotients
        ]
    return np.asarray(np.nanmin(bounds, axis=0))


def nothing_times(part: Array, far: Array) -> Array:
    """Multiply, with zero times infinity defined as zero."""
    return np.asarray(np.where(part > 0.0, part * far, 0.0))


def reference_noise_part(value: ComplexArray, coherence: Array) -> Array:
    """Compute the largest bias of H1 towards zero, if all incoherent power is noise in the reference.

    The true value is between H1 and H2 = H1 / coherence (Bendat and Piersol, section 6.1.4).
    """
    return np.asarray(abs(value) * (1.0 / np.maximum(coherence, 1e-6) - 1.0))


def shared_noise_part(noise: Array, off: ComplexArray, lower: ComplexArray, power: Array) -> Array:
    """Compute the largest error of H1 by noise of channels in the reference that may also be in the response.

    Noise of power N in a channel with the weights u in the response and l in the reference adds ``u l* N`` to their
    cross-spectrum and ``|l|^2 N`` to the reference's power: H1 has the error ``(u - H1 l) l* N`` over the noise-free
    part of that power. The coherence does not show it, because noise common to both looks like a response. `off`: ``u -
    H1 l``.
    """
    left = power - np.sum(abs(lower) ** 2 * noise, axis=0)
    bias = np.sum(abs(off * lower) * noise, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(left > 0.0, bias / left, np.inf))


def doubtful_reference_part(bound: Array, doubt: Array) -> dict[str, Array]:
    """Compute the additional error of a quotient whose denominator may be smaller by a share of its reading.

    With errors dx of a response x = H f and df of its reference, x / f has the error ``(dx - H df) / (f - df)``: the
    first-order error over ``1 - df / f``, unbounded from a share of 1 on.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        more = np.sqrt(1.0 / np.maximum(1.0 - doubt, 0.0) ** 2 - 1.0)
        return {REFERENCE: np.where(doubt < 1.0, np.where(more > 0.0, bound * more, 0.0), np.inf)}


def rounding_part(gain: Array, shares: ReadingShares) -> dict[str, Array]:
    """Compute the largest deviation of a response by rounding, for readings of a few counts.

    `gain`, shape (channels, lines): largest relative change of a channel's gain by rounding: `noise_gain` or
    `tone_gain`.
    """
    if not gain.any():
        return {}
    return {RESOLUTION: np.sum(gain * np.maximum(abs(shares.difference), 1e-300), axis=0)}


def noise_gain(power: Array) -> Array:
    """Compute the largest relative change of the gain by rounding to counts, for a noise signal of a power in counts².

    The rounding error is random noise except for a part proportional to the signal, at most ``2 exp(-2 pi^2 s^2)`` for
    Gaussian noise of s counts (B. Widrow, I. Kollár, Quantization Noise, Cambridge University Press 2008, sections 4
    and 11). The power includes 1/12 of the rounding. Below a quarter of a count the gain is unbounded (infinite).
    """
    power = power - 1.0 / 12.0
    return np.asarray(np.where(power > _QUARTER, 2.0 * np.exp(-2.0 * np.pi**2 * power), np.inf))


def tone_gain(power: Array) -> Array:
    """Compute the largest relative change of the gain by rounding to counts, for a tone; see `noise_gain`.

    For a tone of a counts, the first term of the quantizer's series in Bessel functions is ``2 / pi^2 / a^(3/2)``;
    the sum of all terms is at most twice that. A tone below half a count is not recorded.
    """
    size = np.sqrt(2.0 * np.maximum(power - 1.0 / 12.0, 0.0))
    with np.errstate(divide="ignore"):
        return np.asarray(np.where(size > 0.5, 4.0 / np.pi**2 * size**-1.5, np.inf))


def scattered(power: Array) -> Array:
    """Compute the share of a tone's rounding error that noise of a power in counts² leaves equal in every period.

    Noise of s counts reduces the first term of the quantizer's series by ``exp(-2 pi^2 s^2)``, and all others more
    (Widrow and Kollár, as in `noise_gain`). The power includes 1/12 of the rounding.
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
    off = clock_deviation(rec)
    if not off:
        return {}
    frequency, value = shares.frequency, shares.value
    order = np.argsort(frequency, kind="stable")
    moved = np.empty(frequency.size)
    moved[order] = _moved(frequency[order], value[order], off * frequency[order])
    if frequency.size < _SLOPE_LINES:
        moved = np.maximum(moved, off * _STEEP * abs(value))
    measured = [rec.channels[name].quantity for name in shares.names]
    powers = np.array([[MOTIONS.index(each) if each in MOTIONS else 0.0] for each in measured])
    made = np.sum((powers - MOTIONS.index(shares.motion)) * shares.upper, axis=0)
    made = made - value * np.sum(powers * shares.lower, axis=0)
    return {CLOCK: moved + off * abs(made)}


def clock_deviation(rec: Recording) -> float:
    """Return the largest relative error of all frequencies by the sample clock."""
    return abs(rec.scene.converter.clock_error or 0.0)


def _moved(frequency: Array, value: ComplexArray, by: Array) -> Array:
    """Change of a curve over rising frequencies by frequency errors of either sign.

    Between sparse lines a peak is steeper than its chords. A pole and a constant, ``a / (f - p) + b``, are therefore
    fitted to each line and its neighbours. The slope of this function is the product of the two adjacent chords over
    the chord across.
    """
    apart = np.diff(frequency)
    chords = np.divide(np.diff(value), apart, out=np.zeros(apart.size, dtype=complex), where=apart > 0.0)
    steps = abs(chords)
    moved = by * np.maximum(np.append(steps, 0.0), np.append(0.0, steps))
    if frequency.size < 3 or np.any(apart == 0.0):
        return np.asarray(moved)
    left, right = chords[:-1], chords[1:]
    across = (value[2:] - value[:-2]) / (frequency[2:] - frequency[:-2])
    with np.errstate(divide="ignore", invalid="ignore"):
        pole = (right * frequency[2:] - left * frequency[:-2]) / (right - left)
        to_pole = frequency[1:-1] - pole
        slope = by[1:-1] * left * right / across
        nearest = np.minimum(abs(to_pole + by[1:-1]), abs(to_pole - by[1:-1]))
        through_pole = np.nan_to_num(abs(slope * to_pole) / nearest, posinf=np.inf)
    # If the chords are mainly noise, the position of the pole is arbitrary.
    moved[1:-1] = np.clip(through_pole, moved[1:-1], _SHARPEST * moved[1:-1])
    return np.asarray(moved)
