"""Detect a reversed force or motion channel by the direction of power at the driving point.

A passive structure absorbs power from the force: the cross spectrum of force and velocity at the driving point has a
positive real part (Ewins, Modal Testing, 2nd ed., section 2.6). The real part is negative at all frequencies if the
force sensor or the motion sensor has the wrong sign. Near resonances the real part is so large that phase errors of
filters and delays, well below a quarter of a period, do not change its sign.
"""

import numpy as np
from numpy.typing import NDArray

from daq.core.signal_chain.channel import ChannelInfo, Quantity
from rig.core.base.arrays import Array

# The sign of a spectral line's power is clear if its real part is at least this fraction of its magnitude. Other lines
# count only in the total power.
_MIN_REAL_RATIO = 0.3
# The structure returns power if the sum of the real parts is negative, and its magnitude is at least this fraction of
# the sum of their magnitudes: at 0.8 (0.9 - 0.1), at least 90 % of the sum of magnitudes is negative. The fraction is
# below 1 because phase errors can reverse the sign far from resonances.
_MIN_NEGATIVE_SUM = 0.8
# The sign is evaluated only if the lines with a clear sign have at least this fraction of the total power. In a narrow
# band around an antiresonance, their fraction is smaller.
_MIN_CLEAR_SHARE = 0.02
# A line is driven if its force is at least this fraction of the largest line of the force.
_MIN_FORCE_RATIO = 0.1
#: Number of integrations from acceleration to a quantity of motion.
MOTION_INTEGRATIONS: dict[Quantity, int] = {"acceleration": 0, "velocity": 1, "displacement": 2}


def returns_energy(power: NDArray[np.complex128]) -> bool:
    """Return whether complex power, line by line, flows from the structure into the source of the force."""
    return _is_returned(_power_sums(power))


def _power_sums(power: NDArray[np.complex128]) -> Array:
    """Return three sums of power: magnitude at all lines; |real part| and real part at lines with a clear sign."""
    clear_parts = power.real[abs(power.real) > _MIN_REAL_RATIO * abs(power)]
    return np.array([abs(power).sum(), abs(clear_parts).sum(), clear_parts.sum()])


def _is_returned(power_sums: Array) -> bool:
    total, clear_magnitude, clear_sum = power_sums
    return bool(clear_magnitude > _MIN_CLEAR_SHARE * total and -clear_sum > _MIN_NEGATIVE_SUM * clear_magnitude)


class DrivingPower:
    """Sums the power that a force supplies to the motion at its point, block by block."""

    def __init__(self, force: ChannelInfo, motion: ChannelInfo) -> None:
        self._force, self._motion = force, motion
        self._power_sums = np.zeros(3)

    def add(self, force: Array, motion: Array) -> None:
        """Add the next samples in volts; lost samples are NaN."""
        if force.size < 2:
            return
        frequency = np.fft.rfftfreq(force.size, 1.0 / self._force.rate)[1:]
        spectrum = np.fft.rfft(np.nan_to_num(force))[1:]
        driven = abs(spectrum) > _MIN_FORCE_RATIO * abs(spectrum).max()
        driven_hz = frequency[driven]
        integrations = 1 - MOTION_INTEGRATIONS[self._motion.quantity]
        velocity = np.fft.rfft(np.nan_to_num(motion))[1:][driven] / self._motion.response(driven_hz)
        velocity *= (2j * np.pi * driven_hz) ** -integrations
        power = np.conj(spectrum[driven] / self._force.response(driven_hz)) * velocity
        self._power_sums += _power_sums(power)

    def warning(self) -> str:
        """Return a warning if the structure supplies energy; otherwise an empty string."""
        if not _is_returned(self._power_sums):
            return ""
        return (
            f"{self._motion.name} / {self._force.name}: the structure would supply energy at the driving point, "
            f"so one channel is reversed. Give sign: -1 in the channel table for {self._force.name}, or instead for "
            f"{self._motion.name} if only this sensor is reversed."
        )
