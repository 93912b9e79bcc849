"""Motion of the rig's points over a block of drive samples, and its discontinuities: impacts and separations."""

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from rig.core.base.arrays import Array


@dataclass(frozen=True)
class Motion:
    """Motion of all points at the samples of a block, and at the discontinuities between them.

    A *discontinuity* is a jump of velocity or acceleration.

    Attributes
    ----------
    first : int
        Index of the first sample, counted from the start of the run.
    displacement, velocity, acceleration : ndarray, shape (points, samples)
        m, m/s and m/s²; at a sample that coincides with a discontinuity, the value just after the discontinuity.
    gap : ndarray, shape (dampers, samples)
        Height of each damper of the scene above its lower wall [m]: 0 if it is locked; for a bed of grains, rise of
        its center of mass.
    contact : ndarray of int8, shape (dampers, samples)
        0 in flight, 1 at the lower wall (always, if it is locked), 2 at the upper wall.
    discontinuity_sample : ndarray of int64, shape (discontinuities,)
        Index of the first sample at or after the discontinuity; in ascending order.
    discontinuity_offset : ndarray, shape (discontinuities,)
        Time of the discontinuity after the previous sample [s]: above 0, at most one sample interval.
    discontinuity_displacement : ndarray, shape (points, discontinuities)
        m.
    discontinuity_velocity, discontinuity_acceleration : ndarray, shape (2, points, discontinuities)
        Before and after the discontinuity, m/s and m/s².
    events : structured ndarray
        Impacts and separations, as `rig.simulate` lists them.
    """

    first: int
    displacement: Array
    velocity: Array
    acceleration: Array
    gap: Array
    contact: NDArray[np.int8]
    discontinuity_sample: NDArray[np.int64]
    discontinuity_offset: Array
    discontinuity_displacement: Array
    discontinuity_velocity: Array
    discontinuity_acceleration: Array
    events: NDArray[Any]

    def decimated(self, step: int, interval: float) -> Self:
        """Return the motion at the samples whose numbers are multiples of `step`.

        The block must end at a multiple of `step`. `interval`: sample interval of this motion [s].
        """
        selected = slice(-self.first % step, None, step)
        # Number of the last retained sample before each discontinuity, and the time from it to the last original
        # sample.
        last_before = -(-self.discontinuity_sample // step) - 1  # rounded up
        skipped = (self.discontinuity_sample - 1 - last_before * step) * interval
        return replace(
            self,
            first=-(-self.first // step),  # rounded up
            displacement=self.displacement[:, selected],
            velocity=self.velocity[:, selected],
            acceleration=self.acceleration[:, selected],
            gap=self.gap[:, selected],
            contact=self.contact[:, selected],
            discontinuity_sample=last_before + 1,
            discontinuity_offset=self.discontinuity_offset + skipped,
        )
