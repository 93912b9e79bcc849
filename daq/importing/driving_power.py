"""Direction of energy at the driving point of an import: a passive structure takes energy from the force.

The cross spectrum of force and velocity where the force acts has a positive real part, the power supplied (Ewins, Modal
Testing, 2nd ed., section 2.6). It is negative throughout if the force, or the sensor there, has the wrong sign. Near
resonances the real part is large, so that phase errors of filters and delays well below a quarter of a period do not
change its sign.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from daq.signal_chain.channel import ChannelInfo, Quantity
from rig.arrays import Array

# Minimum ratio of the real part to the magnitude; other lines are omitted.
_CLEAR_RATIO = 0.3
# Share of the real part that must be negative. Errors of phase far from resonances give either sign.
_REVERSED_SHARE = 0.8
# Least share of these lines in the whole: an antiresonance alone has less.
_MIN_CLEAR_SHARE = 0.02
# Ratio to its largest line from which the force drives a line.
_DRIVEN_RATIO = 0.1
#: Integrations from acceleration to a quantity of motion.
MOTIONS: dict[Quantity, int] = {"acceleration": 0, "velocity": 1, "displacement": 2}


def returns_energy(power: NDArray[np.complex128]) -> bool:
    """Return whether complex power, line by line, flows from the structure into the source of the force."""
    return _is_returned(_sums(power))


def _sums(power: NDArray[np.complex128]) -> Array:
    """Sum the magnitude of power and, over the lines with a clear sign, the magnitude and value of the real part."""
    clear = power.real[abs(power.real) > _CLEAR_RATIO * abs(power)]
    return np.array([abs(power).sum(), abs(clear).sum(), clear.sum()])


def _is_returned(sums: Array) -> bool:
    total, clear, supplied = sums
    return bool(clear > _MIN_CLEAR_SHARE * total and -supplied > _REVERSED_SHARE * clear)


class DrivingPower:
    """Sums the power that a force supplies to the motion at its point, in pieces of equal length."""

    def __init__(self, force: ChannelInfo, motion: ChannelInfo) -> None:
        self._force, self._motion = force, motion
        self._sums = np.zeros(3)

    def add(self, force: Array, motion: Array) -> None:
        """Add the next samples in volts; NaN where there are none."""
        if force.size < 2:
            return
        frequency = np.fft.rfftfreq(force.size, 1.0 / self._force.rate)[1:]
        spectrum = np.fft.rfft(np.nan_to_num(force))[1:]
        driven = abs(spectrum) > _DRIVEN_RATIO * abs(spectrum).max()
        at = frequency[driven]
        order = 1 - MOTIONS[self._motion.quantity]
        velocity = np.fft.rfft(np.nan_to_num(motion))[1:][driven] / self._motion.response(at)
        velocity *= (2j * np.pi * at) ** -order
        power = np.conj(spectrum[driven] / self._force.response(at)) * velocity
        self._sums += _sums(power)

    def warning(self) -> str:
        """Return a warning if the structure supplies energy; else an empty text."""
        if not _is_returned(self._sums):
            return ""
        return (
            f"{self._motion.name} / {self._force.name}: the structure would supply energy at the driving point, "
            f"the sign of a reversed channel. Reverse the force, or {self._motion.name} if it alone is wrong: sign: -1 "
            "in the table."
        )
