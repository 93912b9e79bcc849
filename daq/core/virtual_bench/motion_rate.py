"""Motion of the plant, resampled from ticks (time steps of the bench) to the instants of a different rate."""

from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.core.dsp.interpolation import MIN_CUBIC_FRACTION, cubic_coefficients, parabola_moment
from rig.core.base.arrays import Array
from rig.core.simulation.motion import Motion


class MotionAtRate:
    """Resamples a motion and its drive from ticks to instants: instant n is n / rate ticks after power-on.

    A sample requires `group` instants; only complete groups are returned. `tick` is the duration of a tick [s]; `first`
    is the index of the first instant. An instant at a tick has the motion of the tick. Between ticks and
    discontinuities (jumps of velocity or acceleration), the acceleration is the cubic of `daq.core.dsp.interpolation`,
    integrated to velocity and displacement. The drive is interpolated linearly.

    The plant does not output the exact motion at the instants: beds of grains cannot. The error of the cubic is smaller
    than the noise of any sensor. Errors relative to the rms value with three dampers (159 impacts, 5000 instants, 5120
    ticks per second): at most 5e-11 (displacement), 1e-8 (velocity) and 1e-5 (acceleration). In contacts of 2 ms,
    single accelerations have errors of 1e-4.
    """

    def __init__(self, rate: Fraction, group: int, tick: float, first: int) -> None:
        self._rate, self._group, self._tick = rate, group, tick
        self._first = first
        self._next = first  # first instant that has not been resampled
        self._output_stop = first  # first instant that has not been returned
        # Values at the instants of an incomplete group, and discontinuities after the last returned instant.
        self._pending: list[NDArray[Any]] = []
        self._discontinuities: list[NDArray[Any]] = []
        # Displacement, velocity, acceleration and drive at the last tick.
        self._last: list[Array] = []

    def resample(self, motion: Motion, forces: Array) -> tuple[Motion, Array]:
        """Return motion and drive at the instants of complete groups, given motion and drive at the next ticks."""
        stop = motion.first + forces.shape[1]
        is_group_end = (stop - 1) % self._group == 0
        if self._rate == 1 and self._first == 0 and self._output_stop == motion.first and is_group_end:
            # The instants equal the ticks, and none is pending, so nothing needs to be copied.
            self._next = self._output_stop = stop
            return motion, forces
        earliest_instant, values = self._next, self._interpolate(motion, forces)
        if self._pending:
            values = [np.concatenate(pair, axis=1) for pair in zip(self._pending, values, strict=True)]
        first, complete_groups = self._output_stop, (self._next - 1 - self._first) // self._group
        self._output_stop = max(first, self._first + complete_groups * self._group + 1)
        count = self._output_stop - first
        self._pending = [row[:, count:] for row in values]
        displacement, velocity, acceleration, force, gap, contact = (row[:, :count] for row in values)
        discontinuity_instant, offset, *discontinuity_motion = self._take_discontinuities(motion, earliest_instant)
        resampled = replace(
            motion, first=first - self._first, displacement=displacement, velocity=velocity, acceleration=acceleration,
            gap=gap, contact=contact, discontinuity_sample=discontinuity_instant - self._first,
            discontinuity_offset=offset, discontinuity_displacement=discontinuity_motion[0],
            discontinuity_velocity=discontinuity_motion[1], discontinuity_acceleration=discontinuity_motion[2],
        )  # fmt: skip
        return resampled, force

    def _interpolate(self, motion: Motion, forces: Array) -> list[NDArray[Any]]:
        """Return displacement, velocity, acceleration, drive, gap and contact state at the instants of a block."""
        rate, first_instant = self._rate, self._next
        last_tick = motion.first + forces.shape[1] - 1
        self._next = max(first_instant, last_tick * rate.numerator // rate.denominator + 1)
        ticks, remainder = np.divmod(np.arange(first_instant, self._next) * rate.denominator, rate.numerator)
        fraction = remainder / rate.numerator
        tick = ticks - motion.first
        # An instant before the first tick of the block lies between ticks; its values are replaced below.
        column = np.maximum(tick, 0)
        resampled = [row[:, column] for row in (*_motion_rows(motion), forces, motion.gap, motion.contact)]
        if remainder.any():
            is_between = remainder > 0
            new = _between_ticks(motion, forces, self._last, self._tick, tick[is_between] + fraction[is_between])
            for values, new_values in zip(resampled, new, strict=False):
                values[:, is_between] = new_values
        self._last = [row[:, -1:] for row in (*_motion_rows(motion), forces)]
        return resampled

    def _take_discontinuities(self, motion: Motion, earliest_instant: int) -> list[NDArray[Any]]:
        """Return and remove the discontinuities before `_output_stop`, with the instants after them, as in `Motion`."""
        interval = self._tick / float(self._rate)
        if self._rate == 1:
            new = [motion.discontinuity_sample, motion.discontinuity_offset]
        else:
            time = (motion.discontinuity_sample - 1) * self._tick + motion.discontinuity_offset
            next_instant = np.maximum(np.ceil(time / interval).astype(np.int64), earliest_instant)
            new = [next_instant, np.clip(time - (next_instant - 1) * interval, 0.0, interval)]
        new += [motion.discontinuity_displacement, motion.discontinuity_velocity, motion.discontinuity_acceleration]
        if self._discontinuities:
            new = [np.concatenate(pair, axis=-1) for pair in zip(self._discontinuities, new, strict=True)]
        is_complete = new[0] < self._output_stop
        self._discontinuities = [row[..., ~is_complete] for row in new]
        return [row[..., is_complete] for row in new]


def _motion_rows(motion: Motion) -> tuple[Array, Array, Array]:
    return motion.displacement, motion.velocity, motion.acceleration


def _between_ticks(
    motion: Motion, forces: Array, last: list[Array], tick: float, instants: Array
) -> tuple[Array, Array, Array, Array]:
    """Interpolate motion and drive at instants in ticks after a block's first tick; `tick`: s; `last`: tick before."""
    n_last = 1 if last else 0
    at_ticks = np.arange(-n_last, forces.shape[1])
    discontinuities = (motion.discontinuity_sample - 1 - motion.first) + motion.discontinuity_offset / tick
    time_order = np.argsort(np.concatenate([at_ticks, discontinuities]), kind="stable")
    times = np.concatenate([at_ticks, discontinuities])[time_order]
    displacements, velocities, accelerations = ([*last[k : k + 1], row] for k, row in enumerate(_motion_rows(motion)))
    displacement = np.concatenate([*displacements, motion.discontinuity_displacement], axis=1)[:, time_order]
    # Limits from the left and from the right at each tick and discontinuity.
    (v_before, v_after), (a_before, a_after) = (
        [np.concatenate([*rows, side], axis=1)[:, time_order] for side in sides]
        for rows, sides in (
            (velocities, motion.discontinuity_velocity),
            (accelerations, motion.discontinuity_acceleration),
        )
    )
    left = np.searchsorted(times, instants, side="right") - 1
    right = left + 1
    # In each interval of duration dt, the acceleration is a cubic of u from 0 to 1, with the end values a0 and a1. Its
    # mean and first moment follow from the velocities and displacements at the ends.
    dt = (times[right] - times[left]) * tick
    u = (instants - times[left]) / (times[right] - times[left])
    a0, a1, v0 = a_after[:, left], a_before[:, right], v_after[:, left]
    mean = (v_before[:, right] - v0) / dt
    moment = ((displacement[:, right] - displacement[:, left]) / dt - v0) / dt
    moment = np.where(dt < MIN_CUBIC_FRACTION * tick, parabola_moment(a0, a1, mean), moment)
    c1, c2, c3 = cubic_coefficients(a0, a1, mean, moment)
    acceleration = a0 + u * (c1 + u * (c2 + u * c3))
    velocity = v0 + dt * u * (a0 + u * (c1 / 2 + u * (c2 / 3 + u * c3 / 4)))
    increment = dt * u * (v0 + dt * u * (a0 / 2 + u * (c1 / 6 + u * (c2 / 12 + u * c3 / 20))))
    drives = np.concatenate([*last[3:], forces], axis=1)
    tick_index = np.floor(instants).astype(np.int64) + n_last
    force = drives[:, tick_index] + (instants - np.floor(instants)) * (
        drives[:, tick_index + 1] - drives[:, tick_index]
    )
    return displacement[:, left] + increment, velocity, acceleration, force
