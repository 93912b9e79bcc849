"""Detects triggers: start triggers of acquisitions and outputs, and reference triggers of acquisitions.

A rising analog edge is at the first sample *above* the level after a sample at or below ``level - hysteresis``. A
falling edge is the mirror image. A window trigger is at the first sample inside the window after a sample outside, or
the reverse. The sample of a start trigger is the first sample of the record. The sample of a reference trigger has the
index `pretrigger_samples` in the record.

Digital edges are signals at terminals. A PFI line carries the pulses that the bench connects to it, if any. Those of a
scene carry the sync output of the bench, one pulse per second: it rises at 1 s, 2 s, ... of bench time and falls half a
second later. `ai/StartTrigger`, `ao/StartTrigger` and `ai/ReferenceTrigger` are the start and the reference trigger of
other tasks.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from daq.extras.ni_device.values import Slope, WindowCondition

# Rounding error of a time [s].
_TIME_ROUNDING_S = 1e-9
# Rounding error of the position of a sample [samples].
_SAMPLE_ROUNDING = 1e-6
# Function that returns two flags for each sample: whether it fires an armed trigger, and whether it arms the trigger.
Condition = Callable[[NDArray[np.float64]], tuple[NDArray[np.bool_], NDArray[np.bool_]]]


def edge(slope: Slope, level: float, hysteresis: float = 0.0) -> Condition:
    """Return the condition of a level crossing.

    A sample at least `hysteresis` before the level arms the trigger; hysteresis and level are in the unit of the
    samples.
    """
    sign = 1.0 if slope == Slope.RISING else -1.0
    return lambda x: (sign * x > sign * level, sign * x <= sign * level - hysteresis)


def window(condition: WindowCondition, bottom: float, top: float) -> Condition:
    """Return the condition of entering or leaving a window of values, which includes its limits."""

    def classify(x: NDArray[np.float64]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        inside = (x >= bottom) & (x <= top)
        return (inside, ~inside) if condition == WindowCondition.ENTERING else (~inside, inside)

    return classify


class CrossingFinder:
    """Finds the sample that fires a trigger: the first such sample after the trigger was armed.

    >>> finder = CrossingFinder(edge(Slope.RISING, 1.0))
    >>> finder.find(np.array([2.0, 1.0, 1.5, 3.0]))
    2
    """

    def __init__(self, condition: Condition) -> None:
        self._condition = condition
        self._armed = False

    def find(self, samples: NDArray[np.float64], skip: int = 0) -> int | None:
        """Return the index of the first sample of a block that fires the trigger; None if no sample does.

        Blocks are contiguous. The first `skip` samples can arm the trigger but not fire it.
        """
        fires, arms = self._condition(samples)
        if skip:
            self._update_armed(fires[:skip], arms[:skip])
        start = skip
        if not self._armed:
            arming = np.flatnonzero(arms[start:])
            if arming.size == 0:
                return None
            start += int(arming[0])
        firing = np.flatnonzero(fires[start:])
        self._update_armed(fires[skip:], arms[skip:])
        return start + int(firing[0]) if firing.size else None

    def _update_armed(self, fires: NDArray[np.bool_], arms: NDArray[np.bool_]) -> None:
        """Update the state: the trigger is armed if the last arming sample is later than the last firing sample."""
        last_firing, last_arming = (int(np.flatnonzero(flags)[-1]) if flags.any() else -1 for flags in (fires, arms))
        if last_firing != last_arming:
            self._armed = last_arming > last_firing


@dataclass(frozen=True)
class AnalogSource:
    """Analog triggers on channels of a task; the first trigger to fire is used."""

    conditions: tuple[tuple[int, Condition], ...]  # index of the channel in the task, and its condition

    def finders(self) -> list[tuple[int, CrossingFinder]]:
        """Return a new finder for each channel, with the index of the channel."""
        return [(channel, CrossingFinder(condition)) for channel, condition in self.conditions]


@dataclass(frozen=True)
class Pulses:
    """Rising or falling edges of the pulses at a terminal."""

    edge: Slope
    frequency: float = 1.0  # pulses per second; 0 if nothing is connected to the terminal
    terminal: str = ""  # name for messages

    def next_instant(self, earliest: int, rate: float) -> int | None:
        """Return the index of the first sample at a rate in Hz, at least `earliest`, at or after an edge, if any."""
        if not self.frequency:
            return None
        phase, period = (0.0 if self.edge == Slope.RISING else 0.5), 1.0 / self.frequency
        # The first rising edge that can trigger is after one period, the first falling edge half a period later.
        number = max(1, math.ceil((earliest / rate - _TIME_ROUNDING_S) / period - phase))
        return math.ceil((number + phase) * period * rate - _SAMPLE_ROUNDING)


@dataclass(frozen=True)
class AtTime:
    """A start trigger at a given time of the bench."""

    seconds: float  # time on the bench since power-on [s]

    def next_instant(self, earliest: int, rate: float) -> int:
        """Return the index of the first sample at or after the time, at least `earliest`; see `Pulses`."""
        return max(math.ceil(self.seconds * rate - _SAMPLE_ROUNDING), earliest)


@dataclass(frozen=True)
class OtherTask:
    """The start of another task or, with `reference`, its reference trigger."""

    owner: str  # chassis or separate device with the terminal, in lower case; empty: any
    direction: str  # "ai" or "ao"
    reference: bool


Source = AnalogSource | Pulses | AtTime | OtherTask
