"""What no averaging takes away from a response: the parts of its error that stay the same from line to line.

Each part is a largest deviation, as a data sheet states a tolerance, and has a name under which it is shown.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rig.results.response import MOTIONS
from rig.results.uncertainty import CLOCK, SENSITIVITY
from rig.scene.quantities import PER_KELVIN, RATIO, TEMPERATURE, Kind, parse

if TYPE_CHECKING:
    from daq.recording.recording import Recording
    from daq.signal_chain.channel import ChannelInfo

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

REFERENCE_NOISE, LEAKAGE, UNSETTLED = "noise in the reference", "leakage", "not yet steady"
ALIASING, RESOLUTION, MODEL = "aliasing", "converter's resolution", "local model"
REFERENCE = "doubtful reference"
JITTER = "jitter of the sampling instants"
#: Parts that differ from line to line.
ROUGH = (UNSETTLED, RESOLUTION, MODEL, REFERENCE, JITTER)
# Sideways motion as a share of the vertical, where a data sheet of transverse sensitivity goes without one.
_LATERAL = 0.1
# Of fewer lines than these the slope cannot be seen: it may be that of a peak, so many times the ratio of value and
# frequency from a twentieth of its frequency on.
_SLOPE_LINES, _STEEP = 3, 10.0
# A peak between lines is taken for at most so many times as steep as its chords.
_SHARPEST = 10.0
# Power in counts below which rounding hides any signal.
_QUARTER = 1.0 / 16.0


def tolerance(info: ChannelInfo) -> float:
    """Largest relative deviation of a channel's sensitivity that its data sheet leaves open.

    Calibration tolerance, drift with temperature and transverse sensitivity, added up.

    Examples
    --------
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


def sensitivity_part(
    rec: Recording, names: Sequence[str], value: ComplexArray, upper: ComplexArray, lower: ComplexArray
) -> dict[str, Array]:
    """How far the channels' tolerances can put a response off.

    Parameters
    ----------
    rec : Recording
    names : sequence of str
        Channels, in the order of the rows.
    value : ndarray of complex, shape (lines,)
        The response.
    upper, lower : ndarray of complex, shape (channels, lines)
        Share of each channel in the response, and in the reference: they add up to `value`, and to 1.

    Returns
    -------
    dict of str to ndarray, shape (lines,)
        Empty where no data sheet states a tolerance. Infinite where the reference, a small difference of two large
        readings, can be nothing at all.
    """
    share = np.array([[tolerance(rec.channels[name])] for name in names])
    return {SENSITIVITY: off_by_gains(share, of_reading(share), value, upper, lower)} if share.any() else {}


def common_scale(rec: Recording, above: Sequence[str], below: Sequence[str]) -> float:
    """Return the largest relative error that a reference causes in all responses alike: zero for one of two channels.

    Parameters
    ----------
    above, below : sequence of str
        Channels of the response and of the reference.
    """
    alone = len(below) == 1 and below[0] not in above
    return tolerance(rec.channels[below[0]]) if alone else 0.0


def of_reading(share: Array) -> Array:
    """Turn largest deviations as shares of what should be read into shares of what is read: from 1 on infinite.

    A sensor that reads too little is farther off what it reads than its data sheet says of what is there.

    >>> of_reading(np.array([0.2, 0.5, 1.0, 1e20])).tolist()
    [0.25, 1.0, inf, inf]
    """
    return np.divide(share, 1.0 - share, out=np.full(share.shape, np.inf), where=share < 1.0)


def off_by_gains(
    share: Array, far: Array, value: ComplexArray, upper: ComplexArray, lower: ComplexArray
) -> Array:
    """How far a quotient of readings is off when each reads 1 + e times what it should.

    Of readings that add up to u over l the true quotient is off by ``sum (u - l u/l) e/(1+e)`` over ``sum l/(1+e)``.
    That is bounded as it stands, and with the gain of any one channel taken out of both, which leaves e alone of a
    channel that is the whole denominator; the least of these bounds holds.

    Parameters
    ----------
    share, far : ndarray, shape (channels, lines) or (channels, 1)
        Most that ``abs(e)`` and ``abs(e / (1 + e))`` can be.
    value, upper, lower
        As in `sensitivity_part`.

    Returns
    -------
    ndarray, shape (lines,)
        Infinite where the denominator, a small difference of two large readings, can be nothing at all.
    """
    parts: Array = np.asarray(abs(upper - value * lower), dtype=float)
    in_reference: Array = np.asarray(abs(lower), dtype=float)
    with np.errstate(divide="ignore", invalid="ignore"):
        bounds = [
            _quotient(
                np.sum(nothing_times(parts, far), axis=0), np.sum(nothing_times(in_reference, far), axis=0)
            )
        ]
        for one, own in enumerate(share):
            others = np.arange(len(share)) != one
            more = far[others] * (1.0 + own)
            apart = (own + share[others]) * (1.0 + far[others])
            deviation = parts[one] * own + np.sum(nothing_times(parts[others], more), axis=0)
            bounds.append(_quotient(deviation, np.sum(nothing_times(in_reference[others], apart), axis=0)))
    return np.asarray(np.nanmin(bounds, axis=0))


def nothing_times(part: Array, far: Array) -> Array:
    """Multiply, where nothing times whatever is nothing."""
    return np.asarray(np.where(part > 0.0, part * far, 0.0))


def _quotient(deviation: Array, doubt: Array) -> Array:
    """Deviation over a denominator that may be smaller by some part of itself; from 1 on nothing bounds."""
    return np.asarray(np.where(doubt < 1.0, deviation / np.maximum(1.0 - doubt, 1e-300), np.inf))


def reference_noise_part(value: ComplexArray, coherence: Array) -> Array:
    """How far H1 may be low: noise in the reference adds to its power, all of it where the response has none.

    H1 and H2 = H1 / coherence lie on either side of the truth (Bendat and Piersol, section 6.1.4).
    """
    return np.asarray(abs(value) * (1.0 / np.maximum(coherence, 1e-6) - 1.0))


def shared_noise_part(noise: Array, off: ComplexArray, lower: ComplexArray, power: Array) -> Array:
    """How far H1 may be off by noise of channels that a reference is made of, and perhaps the response, too.

    Noise of power N in a channel with the weights u in the response and l in the reference adds ``u l* N`` to their
    cross-spectrum and ``|l|^2 N`` to the reference's power: H1 is off by ``(u - H1 l) l* N`` over what of that power is
    no noise. A coherence does not show it, as what both share looks like a response.

    Parameters
    ----------
    noise : ndarray, shape (channels, lines)
        At most.
    off : ndarray of complex, shape (channels, lines)
        ``u - H1 l``.
    lower : ndarray of complex, shape (channels, lines)
        ``l``.
    power : ndarray, shape (lines,)
        Of the reference.
    """
    left = power - np.sum(abs(lower) ** 2 * noise, axis=0)
    bias = np.sum(abs(off * lower) * noise, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(left > 0.0, bias / left, np.inf))


def doubtful_reference_part(bound: Array, doubt: Array) -> dict[str, Array]:
    """How much farther off a quotient can be because its denominator may be smaller than it reads.

    With errors dx of a response x = H f and df of its reference, x / f is off by ``(dx - H df) / (f - df)``: by what
    propagates to first order over ``1 - df / f``.

    Parameters
    ----------
    bound : ndarray, shape (lines,)
        Bound to first order.
    doubt : ndarray, shape (lines,)
        Bound of the reference, relative to what it reads. From 1 on there may be none, and nothing bounds.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        more = np.sqrt(1.0 / np.maximum(1.0 - doubt, 0.0) ** 2 - 1.0)
        return {REFERENCE: np.where(doubt < 1.0, np.where(more > 0.0, bound * more, 0.0), np.inf)}


def rounding_part(
    gain: Array, value: ComplexArray, upper: ComplexArray, lower: ComplexArray
) -> dict[str, Array]:
    """How far rounding to counts can put a response off, where readings are a few counts only.

    Parameters
    ----------
    gain : ndarray, shape (channels, lines)
        How far rounding can change the gain of a channel, relative: `noise_gain` or `tone_gain`.
    value, upper, lower
        As in `sensitivity_part`.
    """
    if not gain.any():
        return {}
    return {RESOLUTION: np.sum(gain * np.maximum(abs(upper - value * lower), 1e-300), axis=0)}


def noise_gain(power: Array) -> Array:
    """How far rounding to counts can change the gain of noise, relative.

    Rounding is noise of its own, which scatters, but for a part proportional to the signal: with s counts of Gaussian
    noise ``2 exp(-2 pi^2 s^2)`` at most [1]_. Below a quarter of a count it is unbounded: infinite.

    Parameters
    ----------
    power : ndarray
        Mean square of a reading in counts, which rounding itself adds a twelfth to; infinite without a converter.

    References
    ----------
    .. [1] B. Widrow, I. Kollár, Quantization Noise, Cambridge University Press 2008, sections 4 and 11.
    """
    power = power - 1.0 / 12.0
    return np.asarray(np.where(power > _QUARTER, 2.0 * np.exp(-2.0 * np.pi**2 * power), np.inf))


def tone_gain(power: Array) -> Array:
    """How far rounding to counts can change the gain of a tone: as `noise_gain`.

    Of a tone of a counts ``2 / pi^2 / a^(3/2)`` by the first term of the quantiser's series in Bessel functions, and no
    more than twice that by all of them. Below half a count it reads nothing.
    """
    size = np.sqrt(2.0 * np.maximum(power - 1.0 / 12.0, 0.0))
    with np.errstate(divide="ignore"):
        return np.asarray(np.where(size > 0.5, 4.0 / np.pi**2 * size**-1.5, np.inf))


def scattered(power: Array) -> Array:
    """Share of what rounding does to a tone that noise beside it leaves the same from period to period.

    Noise of s counts takes the quantiser's first term down by ``exp(-2 pi^2 s^2)``, and all others by more [1]_.

    Parameters
    ----------
    power : ndarray
        Mean square of the noise in counts, which rounding itself adds a twelfth to.

    References
    ----------
    .. [1] B. Widrow, I. Kollár, Quantization Noise, Cambridge University Press 2008, sections 4 and 11.
    """
    return np.asarray(np.exp(-2.0 * np.pi**2 * np.maximum(power - 1.0 / 12.0, 0.0)))


def in_counts(rec: Recording, names: Sequence[str], squares: Array) -> Array:
    """Mean squares of readings, shape (channels, ...), in counts; infinite where a channel does not count."""
    counts = counts_of(rec, names).reshape(-1, *[1] * (squares.ndim - 1))
    with np.errstate(divide="ignore"):
        return np.asarray(np.where(counts > 0.0, squares / np.where(counts > 0.0, counts, 1.0) ** 2, np.inf))


def counts_of(rec: Recording, names: Sequence[str]) -> Array:
    """Size of a count of each channel in its unit; 0 where it does not count."""
    infos = [rec.channels[name] for name in names]
    return np.array([0.0 if info.volts_per_count is None else info.unit_per_count for info in infos])


def clock_part(
    rec: Recording,
    names: Sequence[str],
    frequency: Array,
    value: ComplexArray,
    upper: ComplexArray,
    lower: ComplexArray,
    motion: str,
) -> dict[str, Array]:
    """How far a sample clock that is off puts every frequency, and with it the curve, off.

    Along its slope; and by the powers of frequency that make a displacement of an acceleration.

    Parameters
    ----------
    rec, names, value, upper, lower
        As in `sensitivity_part`.
    frequency : ndarray, shape (lines,)
        Hz.
    motion : str
        What `value` is a response of.
    """
    off = clock_deviation(rec)
    if not off:
        return {}
    order = np.argsort(frequency, kind="stable")
    moved = np.empty(frequency.size)
    moved[order] = _moved(frequency[order], value[order], off * frequency[order])
    if frequency.size < _SLOPE_LINES:
        moved = np.maximum(moved, off * _STEEP * abs(value))
    measured = [rec.channels[name].quantity for name in names]
    powers = np.array([[MOTIONS.index(each) if each in MOTIONS else 0.0] for each in measured])
    made = np.sum((powers - MOTIONS.index(motion)) * upper, axis=0) - value * np.sum(powers * lower, axis=0)
    return {CLOCK: moved + off * abs(made)}


def clock_deviation(rec: Recording) -> float:
    """Return the largest relative error of all frequencies by the sample clock."""
    return abs(rec.scene.converter.clock_error or 0.0)


def _moved(frequency: Array, value: ComplexArray, by: Array) -> Array:
    """By how much a curve over rising frequencies changes where each is off by so much, up or down.

    Between sparse lines a peak is steeper than its chords: through each line and its neighbours goes one pole beside a
    constant, ``a / (f - p) + b``, whose slope is the product of the chords to both sides over the chord across.
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
    # Where noise makes the chords, the pole may lie anywhere.
    moved[1:-1] = np.clip(through_pole, moved[1:-1], _SHARPEST * moved[1:-1])
    return np.asarray(moved)
