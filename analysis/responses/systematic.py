"""What no averaging takes away from a response: the parts of its error that stay the same from line to line.

Each part is a largest deviation, as a data sheet states a tolerance, and has a name under which it is shown.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rig.scene.quantities import PER_KELVIN, RATIO, TEMPERATURE, Kind, parse

if TYPE_CHECKING:
    from daq.recording.recording import Recording
    from daq.signal_chain.channel import ChannelInfo

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

SENSITIVITY, CLOCK = "sensors' sensitivity", "sample clock"
REFERENCE_NOISE, LEAKAGE, UNSETTLED = "noise in the reference", "leakage", "not yet steady"
ALIASING, RESOLUTION, MODEL = "aliasing", "converter's resolution", "local model"
# Sideways motion as a share of the vertical, where a data sheet of transverse sensitivity goes without one.
_LATERAL = 0.1
# Images of a force in the motion it causes, as a share of the motion times the square of frequency over sample rate.
_IMAGES = 0.1


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
    shares = np.array([tolerance(rec.channels[name]) for name in names])
    if not shares.any():
        return {}
    deviation = shares @ abs(upper - value * lower)
    # The reference itself may be smaller than it reads, all else larger by as much.
    doubt = shares @ abs(lower)
    with np.errstate(divide="ignore", invalid="ignore"):
        return {SENSITIVITY: np.where(doubt < 1.0, deviation / np.maximum(1.0 - doubt, 1e-300), np.inf)}


def aliasing_part(
    rec: Recording,
    names: Sequence[str],
    frequency: Array,
    value: ComplexArray,
    upper: ComplexArray,
    lower: ComplexArray,
) -> dict[str, Array]:
    """How far what folds back from beyond half the sample rate can put a response off.

    The drive goes from sample to sample in straight lines, whose images stand about the sample rate. A channel without
    a decimation filter sees them: of a table's acceleration as much as its servo lets through, of all else little.

    Parameters
    ----------
    rec, names, value, upper, lower
        As in `sensitivity_part`.
    frequency : ndarray, shape (lines,)
        Hz.
    """
    shares = np.zeros(upper.shape)
    bandwidth = getattr(rec.scene.driven_shaker, "bandwidth", None)
    for row, name in enumerate(names):
        info = rec.channels[name]
        if not info.filter:
            share = frequency / info.rate
            if info.at == "table" and bandwidth is not None:
                shares[row] = 2.0 * share / (1.0 + (info.rate / bandwidth) ** 2)
            else:
                shares[row] = _IMAGES * share**2
    if not shares.any():
        return {}
    return {ALIASING: np.sum(shares * abs(upper - value * lower), axis=0)}


def reference_noise_part(value: ComplexArray, coherence: Array) -> dict[str, Array]:
    """How far H1 may be low: noise in the reference adds to its power, all of it where the response has none.

    H1 and H2 = H1 / coherence lie on either side of the truth (Bendat and Piersol, section 6.1.4).
    """
    return {REFERENCE_NOISE: abs(value) * (1.0 / np.maximum(coherence, 1e-6) - 1.0)}


def clock_part(rec: Recording, frequency: Array, value: ComplexArray) -> dict[str, Array]:
    """How far a sample clock that is off puts every frequency, and with it the curve, off."""
    off = abs(rec.scene.converter.clock_error or 0.0)
    if not off or frequency.size < 3:
        return {}
    order = np.argsort(frequency, kind="stable")
    slope = np.empty(frequency.size)
    slope[order] = abs(np.gradient(value[order], frequency[order]))
    return {CLOCK: off * frequency * slope}
