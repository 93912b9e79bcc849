"""Triggers: what starts an acquisition or an output, and what an acquisition is cut out around.

Which sample an analog edge is found at: for a rising edge the first sample *above* the level after one at or
below it (at or below ``level - hysteresis`` where a hysteresis is given); for a falling edge the mirror
image; for a window the first sample inside after one outside, or the other way round. That sample is number 0
after a start trigger, and has index `pretrigger_samples` in what a reference trigger cuts out.

Digital edges come from terminals. Every PFI line of the chassis carries the bench's sync output, one pulse a
second: it rises at 1 s, 2 s, ... of bench time and falls half a second later. `ai/StartTrigger`,
`ao/StartTrigger` and `ai/ReferenceTrigger` are the moments at which other tasks start or are triggered.
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

# Tells for samples which of them are beyond what is waited for, and which arm the trigger.
Condition = Callable[[NDArray[np.float64]], tuple[NDArray[np.bool_], NDArray[np.bool_]]]


def edge(slope: Slope, level: float, hysteresis: float = 0.0) -> Condition:
    """Make the condition of a crossing of a level.

    Parameters
    ----------
    slope : Slope
        Direction of the crossing.
    level : float
        Level, in the units of the samples.
    hysteresis : float
        How far beyond the level, on the side it comes from, the signal must have been.
    """
    sign = 1.0 if slope == Slope.RISING else -1.0
    return lambda x: (sign * x > sign * level, sign * x <= sign * level - hysteresis)


def window(condition: WindowCondition, bottom: float, top: float) -> Condition:
    """Make the condition of entering or leaving a window, whose limits belong to it."""

    def classify(x: NDArray[np.float64]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        inside = (x >= bottom) & (x <= top)
        return (inside, ~inside) if condition == WindowCondition.ENTERING else (~inside, inside)

    return classify


class CrossingFinder:
    """Finds where a signal meets a condition.

    Parameters
    ----------
    condition : callable
        See `edge` and `window`.

    Examples
    --------
    >>> finder = CrossingFinder(edge(Slope.RISING, 1.0))
    >>> finder.find(np.array([2.0, 1.0, 1.5, 3.0]))
    2
    """

    def __init__(self, condition: Condition) -> None:
        self._condition = condition
        self._armed = False

    def find(self, samples: NDArray[np.float64], skip: int = 0) -> int | None:
        """Look for the first crossing in the samples that follow those of the last call.

        Parameters
        ----------
        samples : ndarray, shape (n,)
            Samples.
        skip : int
            Samples at the beginning in which a crossing does not count; they still arm the trigger.

        Returns
        -------
        int or None
            Index of the first sample beyond; None if there is none.
        """
        beyond, before = self._condition(samples)
        if skip:
            self._observe(beyond[:skip], before[:skip])
        start = skip
        if not self._armed:
            arming = np.flatnonzero(before[start:])
            if arming.size == 0:
                return None
            start += int(arming[0])
        hits = np.flatnonzero(beyond[start:])
        self._observe(beyond[skip:], before[skip:])
        return start + int(hits[0]) if hits.size else None

    def _observe(self, beyond: NDArray[np.bool_], before: NDArray[np.bool_]) -> None:
        last_beyond, last_before = (
            int(np.flatnonzero(each)[-1]) if each.any() else -1 for each in (beyond, before)
        )
        if last_beyond != last_before:
            self._armed = last_before > last_beyond


@dataclass(frozen=True)
class AnalogSource:
    """Analog triggers on channels of a task, by their positions in it; the first that comes counts."""

    conditions: tuple[tuple[int, Condition], ...]

    def finders(self) -> list[tuple[int, CrossingFinder]]:
        """Make finders that have seen no sample yet."""
        return [(row, CrossingFinder(condition)) for row, condition in self.conditions]


@dataclass(frozen=True)
class SyncPulse:
    """Digital edges of the sync output: one a second."""

    edge: Slope

    def next_tick(self, tick: int, rate: float) -> int:
        """Give the sample at which the first edge comes that is not before a given sample."""
        phase = 0.0 if self.edge == Slope.RISING else 0.5
        # The edge at 0 s belongs to power-on; the first one that can trigger comes at 1 s, or falls at 1.5 s.
        second = max(1, math.ceil(tick / rate - phase - 1e-9))
        return math.ceil((second + phase) * rate - 1e-6)


@dataclass(frozen=True)
class AtTime:
    """A moment that is known beforehand: a start by the clock on the wall."""

    seconds: float

    def next_tick(self, tick: int, rate: float) -> int:
        """Give the moment; see `SyncPulse.next_tick`."""
        return max(math.ceil(self.seconds * rate - 1e-6), tick)


@dataclass(frozen=True)
class OtherTask:
    """The moment at which another task starts or meets its reference trigger."""

    device: str
    kind: str
    reference: bool


Scheduled = SyncPulse | AtTime
Source = AnalogSource | SyncPulse | AtTime | OtherTask


def digital_source(source: str, slope: Slope) -> SyncPulse | OtherTask:
    """Find what a terminal carries.

    Raises
    ------
    DaqError
        With -89136, if there is no such terminal.
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
