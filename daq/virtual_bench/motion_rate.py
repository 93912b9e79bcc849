"""The plant's motion at the instants at which a converter takes its samples, whatever the ticks of the plant."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.dsp.interpolation import MIN_CUBIC_SHARE
from rig.arrays import Array
from rig.simulation.motion import Motion


class MotionAtRate:
    """Resamples a motion and its drive at instant n / rate ticks after power-on, in complete groups.

    Instants that coincide with ticks get the motion of the tick. Between ticks and breaks, the acceleration is
    the cubic of `daq.dsp.interpolation`, integrated once and twice; straight lines join the drive.
    """

    def __init__(self, rate: Fraction, group: int, tick: float, first: int) -> None:
        self._rate, self._group, self._tick = rate, group, tick
        self._first = self._next = self._output_stop = first
        # Instants of an incomplete group, and breaks after the last instant returned, with the instant after each.
        self._pending: list[NDArray[Any]] = []
        self._breaks: list[NDArray[Any]] = []
        # Displacement, velocity, acceleration and drive at the last tick.
        self._last: list[Array] = []

    def take(self, motion: Motion, forces: Array) -> tuple[Motion, Array]:
        """Take the next ticks, drive of shape (inputs, ticks); return the complete groups of instants."""
        stop = motion.first + forces.shape[1]
        is_group_end = (stop - 1) % self._group == 0
        if self._rate == 1 and self._first == 0 and self._output_stop == motion.first and is_group_end:
            # The instants are the ticks, and none is pending: nothing needs to be copied.
            self._next = self._output_stop = stop
            return motion, forces
        earliest, values = self._next, self._resampled(motion, forces)
        if self._pending:
            values = [np.concatenate(pair, axis=1) for pair in zip(self._pending, values, strict=True)]
        first, past = self._output_stop, (self._next - 1 - self._first) // self._group
        self._output_stop = max(first, self._first + past * self._group + 1)
        count = self._output_stop - first
        self._pending = [each[:, count:] for each in values]
        displacement, velocity, acceleration, force, gap, contact = (each[:, :count] for each in values)
        number, offset, *broken = self._breaks_due(motion, earliest)
        resampled = replace(
            motion, first=first - self._first, displacement=displacement, velocity=velocity, acceleration=acceleration,
            gap=gap, contact=contact, break_sample=number - self._first, break_offset=offset,
            break_displacement=broken[0], break_velocity=broken[1], break_acceleration=broken[2],
        )  # fmt: skip
        return resampled, force

    def _resampled(self, motion: Motion, forces: Array) -> list[NDArray[Any]]:
        """Return displacement, velocity, acceleration, drive, gap and contact at the instants of a block."""
        ratio, begin = self._rate, self._next
        last_tick = motion.first + forces.shape[1] - 1
        self._next = max(begin, last_tick * ratio.numerator // ratio.denominator + 1)
        ticks, rest = np.divmod(np.arange(begin, self._next) * ratio.denominator, ratio.numerator)
        share = rest / ratio.numerator
        # Instants before the first tick of the block lie between ticks and are replaced below.
        at, tick = np.maximum(ticks - motion.first, 0), ticks - motion.first
        resampled = [each[:, at] for each in (*_motion_rows(motion), forces, motion.gap, motion.contact)]
        if rest.any():
            between = rest > 0
            new = _between_ticks(motion, forces, self._last, self._tick, tick[between] + share[between])
            for values, now in zip(resampled, new, strict=False):
                values[:, between] = now
        self._last = [each[:, -1:] for each in (*_motion_rows(motion), forces)]
        return resampled

    def _breaks_due(self, motion: Motion, earliest: int) -> list[NDArray[Any]]:
        """Return the breaks before `_output_stop`, as in `Motion`, each with the instant that ends its interval."""
        interval = self._tick / float(self._rate)
        if self._rate == 1:
            new = [motion.break_sample, motion.break_offset]
        else:
            time = (motion.break_sample - 1) * self._tick + motion.break_offset
            number = np.maximum(np.ceil(time / interval).astype(np.int64), earliest)
            new = [number, np.clip(time - (number - 1) * interval, 0.0, interval)]
        new += [motion.break_displacement, motion.break_velocity, motion.break_acceleration]
        if self._breaks:
            new = [np.concatenate(pair, axis=-1) for pair in zip(self._breaks, new, strict=True)]
        due = new[0] < self._output_stop
        self._breaks = [each[..., ~due] for each in new]
        return [each[..., due] for each in new]


def _motion_rows(motion: Motion) -> tuple[Array, Array, Array]:
    return motion.displacement, motion.velocity, motion.acceleration


def _between_ticks(
    motion: Motion, forces: Array, last: list[Array], tick: float, when: Array
) -> tuple[Array, Array, Array, Array]:
    """Interpolate displacement, velocity, acceleration and forces at instants, in ticks after a block's first tick."""
    lead = 1 if last else 0
    at_ticks = np.arange(-lead, forces.shape[1])
    breaks = (motion.break_sample - 1 - motion.first) + motion.break_offset / tick
    order = np.argsort(np.concatenate([at_ticks, breaks]), kind="stable")
    times = np.concatenate([at_ticks, breaks])[order]
    x, v, a = ([*last[k : k + 1], each] for k, each in enumerate(_motion_rows(motion)))
    displacement = np.concatenate([*x, motion.break_displacement], axis=1)[:, order]
    # One-sided limits at each node.
    (v_before, v_after), (a_before, a_after) = (
        [np.concatenate([*rows, side], axis=1)[:, order] for side in sides]
        for rows, sides in ((v, motion.break_velocity), (a, motion.break_acceleration))
    )
    left = np.searchsorted(times, when, side="right") - 1
    right = left + 1
    length = (times[right] - times[left]) * tick
    u = (when - times[left]) / (times[right] - times[left])
    start, end, speed = a_after[:, left], a_before[:, right], v_after[:, left]
    mean = (v_before[:, right] - speed) / length
    moment = ((displacement[:, right] - displacement[:, left]) / length - speed) / length
    moment = np.where(length < MIN_CUBIC_SHARE * tick, (start - end) / 12.0 + 0.5 * mean, moment)
    c1 = -9.0 * start + 3.0 * end - 24.0 * mean + 60.0 * moment
    c2 = 18.0 * start - 12.0 * end + 84.0 * mean - 180.0 * moment
    c3 = -10.0 * start + 10.0 * end - 60.0 * mean + 120.0 * moment
    acceleration = start + u * (c1 + u * (c2 + u * c3))
    velocity = speed + length * u * (start + u * (c1 / 2 + u * (c2 / 3 + u * c3 / 4)))
    increment = length * u * (speed + length * u * (start / 2 + u * (c1 / 6 + u * (c2 / 12 + u * c3 / 20))))
    lines = np.concatenate([*last[3:], forces], axis=1)
    tick_index = np.floor(when).astype(np.int64) + lead
    force = lines[:, tick_index] + (when - np.floor(when)) * (lines[:, tick_index + 1] - lines[:, tick_index])
    return displacement[:, left] + increment, velocity, acceleration, force
