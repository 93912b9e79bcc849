"""An input on the bench's ticks: every n-th of them where it is slower than the clock."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from daq.instrument.engines.acquisition import Acquisition, InputPlan
from daq.instrument.engines.rate_divider import RateDivider
from daq.instrument.engines.triggers import OtherTask

if TYPE_CHECKING:
    from daq.instrument.bench.sample_source import SampleSource


class InputEngine:
    """Runs an acquisition from the bench's ticks.

    Parameters
    ----------
    plan : InputPlan
        What to acquire.
    source : SampleSource
        The bench.
    tick : int
        The bench's position.
    """

    def __init__(self, plan: InputPlan, source: SampleSource, tick: int) -> None:
        self.divisor = max(1, round(source.rate / plan.rate))
        self.acquisition = Acquisition(plan, -(-tick // self.divisor), source.dtype)
        self._divider = None
        if self.divisor > 1:
            channels = len(source.channels)
            self._divider = RateDivider(channels, self.divisor, source.sampling, source.delay)

    def take(
        self,
        first: int,
        samples: NDArray[Any],
        overload: NDArray[np.bool_],
        moment: Callable[..., int | None],
    ) -> None:
        """Take a block of the bench."""
        if self._divider is None:
            self.acquisition.take(first, samples, overload, moment)
            return

        def divided(source: OtherTask) -> int | None:
            found = moment(source)
            return None if found is None else -(-found // self.divisor)

        first, samples, overload = self._divider.take(first, samples, overload)
        if samples.shape[1]:
            self.acquisition.take(first, samples, overload, divided)

    def start_tick(self, reference: bool, position: int) -> int | None:
        """Tell others at which tick of the bench it started (was triggered), or will be."""
        found = self.acquisition.start_tick(reference, -(-position // self.divisor))
        return None if found is None else found * self.divisor
