"""Triggers: start triggers of acquisitions and outputs, and reference triggers of acquisitions.

A rising analog edge is at the first sample *above* the level after a sample at or below it (at or below
``level - hysteresis`` with a hysteresis); a falling edge is the mirror image. A window trigger is at the first sample
inside the window after a sample outside, or the reverse. That sample has number 0 after a start trigger, and index
`pretrigger_samples` in the record of a reference trigger.

Digital edges are signals at terminals. Every PFI line of the chassis has the sync output of the bench, one pulse per
second: it rises at 1 s, 2 s, ... of bench time and falls half a second later. `ai/StartTrigger`,
`ao/StartTrigger` and `ai/ReferenceTrigger` are the times at which other tasks start or are triggered.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from daq.instrument.errors import Code, DaqError
from daq.instrument.values import Slope, WindowCondition

_SIGNAL = re.compile(r"/?(?:([^/]+)/)?(PFI\d+|a[io]/(?:StartTrigger|ReferenceTrigger))", re.IGNORECASE)

# A function that returns, for each sample, whether it meets the condition and whether it arms the trigger.
Condition = Callable[[NDArray[np.float64]], tuple[NDArray[np.bool_], NDArray[np.bool_]]]


def edge(slope: Slope, level: float, hysteresis: float = 0.0) -> Condition:
    """Return the condition of a level crossing.

    `slope`: direction of the crossing; `level`: level, in the units of the samples; `hysteresis`: distance from the
    level that the signal must have had before the crossing, on the opposite side.
    """
    sign = 1.0 if slope == Slope.RISING else -1.0
    return lambda x: (sign * x > sign * level, sign * x <= sign * level - hysteresis)


def window(condition: WindowCondition, bottom: float, top: float) -> Condition:
    """Return the condition of entering or leaving a window, limits included."""

    def classify(x: NDArray[np.float64]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        inside = (x >= bottom) & (x <= top)
        return (inside, ~inside) if condition == WindowCondition.ENTERING else (~inside, inside)

    return classify


class CrossingFinder:
    """Finds the first sample at which a signal meets a condition.

    `condition`: see `edge` and `window`.

    >>> finder = CrossingFinder(edge(Slope.RISING, 1.0))
    >>> finder.find(np.array([2.0, 1.0, 1.5, 3.0]))
    2
    """

    def __init__(self, condition: Condition) -> None:
        self._condition = condition
        self._armed = False

    def find(self, samples: NDArray[np.float64], skip: int = 0) -> int | None:
        """Return the first crossing in samples that directly follow those of the last call.

        `samples` has the shape (n,); `skip`: number of first samples in which crossings are ignored; they still arm
        the trigger. Returns index of the first sample after the crossing; None without a crossing.
        """
        fires, arms = self._condition(samples)
        if skip:
            self._observe(fires[:skip], arms[:skip])
        start = skip
        if not self._armed:
            arming = np.flatnonzero(arms[start:])
            if arming.size == 0:
                return None
            start += int(arming[0])
        hits = np.flatnonzero(fires[start:])
        self._observe(fires[skip:], arms[skip:])
        return start + int(hits[0]) if hits.size else None

    def _observe(self, fires: NDArray[np.bool_], arms: NDArray[np.bool_]) -> None:
        last_beyond, last_before = (int(np.flatnonzero(each)[-1]) if each.any() else -1 for each in (fires, arms))
        if last_beyond != last_before:
            self._armed = last_before > last_beyond


@dataclass(frozen=True)
class AnalogSource:
    """Analog triggers on channels of a task, by the positions of the channels; the earliest trigger is used."""

    conditions: tuple[tuple[int, Condition], ...]

    def finders(self) -> list[tuple[int, CrossingFinder]]:
        """Return new finders."""
        return [(row, CrossingFinder(condition)) for row, condition in self.conditions]


@dataclass(frozen=True)
class SyncPulse:
    """Digital edges of the sync output, one per second."""

    edge: Slope

    def next_tick(self, tick: int, rate: float) -> int:
        """Return the tick of the first edge at or after a given tick."""
        phase = 0.0 if self.edge == Slope.RISING else 0.5
        # The edge at 0 s is power-on; the first rising edge that can trigger is at 1 s, the first falling edge at
        # 1.5 s.
        second = max(1, math.ceil(tick / rate - phase - 1e-9))
        return math.ceil((second + phase) * rate - 1e-6)


@dataclass(frozen=True)
class AtTime:
    """A time that is known in advance: a start at a wall-clock time."""

    seconds: float

    def next_tick(self, tick: int, rate: float) -> int:
        """Return the tick of that time; see `SyncPulse.next_tick`."""
        return max(math.ceil(self.seconds * rate - 1e-6), tick)


@dataclass(frozen=True)
class OtherTask:
    """The time at which another task starts or detects its reference trigger."""

    device: str
    kind: str
    reference: bool


Source = AnalogSource | SyncPulse | AtTime | OtherTask


def digital_source(source: str, slope: Slope) -> SyncPulse | OtherTask:
    """Return the signal at a terminal.

    Raises `DaqError` with -89136, if the terminal does not exist.
    """
    match = _SIGNAL.fullmatch(source.strip())
    if not match:
        raise DaqError(
            f"there is no trigger signal on terminal {source!r}: expected /Dev1/PFI0 (one pulse a second), "
            "/Dev1/ai/StartTrigger, /Dev1/ao/StartTrigger or /Dev1/ai/ReferenceTrigger",
            Code.ROUTE_NOT_SUPPORTED_BY_HW_ROUTING,
        )
    device, signal = match[1] or "", match[2].lower()
    if signal.startswith("pfi"):
        return SyncPulse(slope)
    return OtherTask(device, signal[:2], signal.endswith("referencetrigger"))
