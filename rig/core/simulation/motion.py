"""Motion of the rig's points over a block of drive samples, and its discontinuities: impacts and separations."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from rig.core.base.arrays import Array


@dataclass(frozen=True)
class Motion:
    """Motion of all points at the samples of a block, and at the breaks between them.

    A *break* is a discontinuity of velocity or acceleration.

    Attributes
    ----------
    first : int
        Index of the first sample, counted from the start of the run.
    displacement, velocity, acceleration : ndarray, shape (points, samples)
        m, m/s and m/s²; at a sample that coincides with a break, the value just after the break.
    gap : ndarray, shape (dampers, samples)
        Height of each damper of the scene above its lower wall [m]: 0 if it is locked; for a bed of grains, rise of
        its center of mass.
    contact : ndarray of int8, shape (dampers, samples)
        0 in flight, 1 at the lower wall (always, if it is locked), 2 at the upper wall.
    break_sample : ndarray of int64, shape (breaks,)
        Index of the first sample at or after the break; in ascending order.
    break_offset : ndarray, shape (breaks,)
        Time of the break after the previous sample [s]: above 0, at most one sample interval.
    break_displacement : ndarray, shape (points, breaks)
        m.
    break_velocity, break_acceleration : ndarray, shape (2, points, breaks)
        Before and after the break, m/s and m/s².
    events : structured ndarray
        Impacts and separations, as `rig.simulate` lists them.
    """

    first: int
    displacement: Array
    velocity: Array
    acceleration: Array
    gap: Array
    contact: NDArray[np.int8]
    break_sample: NDArray[np.int64]
    break_offset: Array
    break_displacement: Array
    break_velocity: Array
    break_acceleration: Array
    events: NDArray[Any]

    def decimated(self, step: int, interval: float) -> Self:
        """Return the motion at the samples whose numbers are multiples of `step`.

        The block must end at a multiple of `step`. `interval`: sample interval of this motion [s].
        """
        selected = slice(-self.first % step, None, step)
        # Number of the last retained sample before each break, and the time from it to the last original sample.
        last_before = -(-self.break_sample // step) - 1  # rounded up
        skipped = (self.break_sample - 1 - last_before * step) * interval
        return replace(
            self,
            first=-(-self.first // step),  # rounded up
            displacement=self.displacement[:, selected],
            velocity=self.velocity[:, selected],
            acceleration=self.acceleration[:, selected],
            gap=self.gap[:, selected],
            contact=self.contact[:, selected],
            break_sample=last_before + 1,
            break_offset=self.break_offset + skipped,
        )
