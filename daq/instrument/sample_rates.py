"""Rates of the sample clock: what becomes of a request."""

from __future__ import annotations

import math

from daq.instrument.errors import DaqError, DAQmxErrors
from daq.signal_chain.converter import SampleClock
from rig.errors import SceneError
from rig.scene.measurement_chain import Converter

# The fastest rate of the sample clock and its divisors, those of the usual vibration module.
FASTEST_RATE, DIVISORS = 51200.0, range(1, 32)


def coerced(rate: float, converter: Converter) -> float:
    """Give the rate the sample clock makes of a request: the next higher one it can be divided down to.

    Parameters
    ----------
    rate : float
        Samples per second asked for.
    converter : Converter
        The scene's; if it names a module, that module's clock is the one.

    Returns
    -------
    float
        51.2 kHz divided by 1 to 31, or the rate of the scene's converter where just that is asked for.

    Raises
    ------
    DaqError
        With -200077, if the rate is not positive or faster than the clock.

    Examples
    --------
    >>> coerced(5000.0, Converter()), coerced(8000.0, Converter()), coerced(1000.0, Converter())
    (5120.0, 8533.333333333334, 1651.6129032258063)
    """
    if rate == converter.rate:
        return SampleClock.of(converter).rate
    if not 0 < rate <= FASTEST_RATE * (1 + 1e-9):
        raise DaqError(
            f"sample clock rate {rate:g} S/s: expected more than 0 and at most {FASTEST_RATE:g} S/s (what "
            f"lies between becomes {FASTEST_RATE:g} S/s divided by a whole number up to {DIVISORS[-1]})",
            DAQmxErrors.INVALID_ATTRIBUTE_VALUE,
        )
    if converter.preset is None:
        divisor = math.floor(FASTEST_RATE / rate * (1 + 1e-6))
        return FASTEST_RATE / max(1, min(divisor, DIVISORS[-1]))
    try:
        return SampleClock.of(converter.replace(rate=rate)).rate
    except SceneError as error:
        raise DaqError(str(error), DAQmxErrors.INVALID_ATTRIBUTE_VALUE) from None
