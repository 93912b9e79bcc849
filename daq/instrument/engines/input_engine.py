"""An input on the bench's ticks: its acquisition counts samples, everybody else counts ticks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.bench.stream import samples_per_tick
from daq.instrument.engines.acquisition import Acquisition, InputPlan
from daq.instrument.engines.triggers import OtherTask


class InputEngine:
    """Runs an acquisition from the samples at its rate.

    Parameters
    ----------
    plan : InputPlan
        What to acquire.
    ticks : float
        Ticks of the bench per second.
    tick : int
        The bench's position.
    dtype : dtype_like
        Kind of the converter's samples.
    """

    def __init__(self, plan: InputPlan, ticks: float, tick: int, dtype: Any) -> None:
        self._per_tick = samples_per_tick(plan.rate, ticks)
        self.acquisition = Acquisition(plan, self._sample_at(tick), dtype)

    def take(
        self,
        first: int,
        samples: NDArray[Any],
        overload: NDArray[np.bool_],
        moment: Callable[..., int | None],
    ) -> None:
        """Take samples, the first of which has a number; see `Acquisition.take`."""

        def in_samples(source: OtherTask) -> int | None:
            found = moment(source)
            return None if found is None else self._sample_at(found)

        if samples.shape[1]:
            self.acquisition.take(first, samples, overload, in_samples)

    def start_tick(self, reference: bool, position: int) -> int | None:
        """Return at which tick of the bench it started (was triggered), or will start."""
        found = self.acquisition.start_tick(reference, self._sample_at(position))
        return None if found is None else self.tick_at(found)

    def _sample_at(self, tick: int) -> int:
        """Give the number of the first sample that is not before a tick."""
        return -(-tick * self._per_tick.numerator // self._per_tick.denominator)

    def tick_at(self, sample: int) -> int:
        """Give the first tick that is not before a sample."""
        return -(-sample * self._per_tick.denominator // self._per_tick.numerator)

    def ticks(self, samples: int, position: int) -> int:
        """Count the ticks from a position on until so many samples have been taken, and not a tick more."""
        return max(1, self.tick_at(self._sample_at(position) + samples - 1) - position + 1)
