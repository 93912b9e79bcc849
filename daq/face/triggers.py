"""Triggers: what starts an acquisition or an output, and what an acquisition is cut out around.

Which sample an analog edge is found at: for a rising edge the first sample *above* the level after one at or
below it (at or below ``level - hysteresis`` where a hysteresis is given); for a falling edge the mirror
image. That sample is number 0 after a start trigger, and has index `pretrigger_samples` in what a reference
trigger cuts out.

Digital edges come from terminals. Every PFI line of the chassis carries the bench's sync output, one pulse a
second: it rises at 1 s, 2 s, ... of bench time and falls half a second later. `ai/StartTrigger`,
`ao/StartTrigger` and `ai/ReferenceTrigger` are the moments at which other tasks start or are triggered.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from daq.face import argument
from daq.face.constants import Edge, Slope, SyncType, TriggerType
from daq.instrument.errors import DaqError, DAQmxErrors, unsupported

if TYPE_CHECKING:
    from daq.face.task import Task

_SIGNAL = re.compile(r"/?(?:([^/]+)/)?(PFI\d+|a[io]/(?:StartTrigger|ReferenceTrigger))", re.IGNORECASE)


class AnalogEdge:
    """Finds where a signal crosses a level.

    Parameters
    ----------
    slope : Slope
        Direction of the crossing.
    level : float
        Level, in the units of the samples.
    hysteresis : float
        How far beyond the level, on the side it comes from, the signal must have been.

    Examples
    --------
    >>> edge = AnalogEdge(Slope.RISING, 1.0)
    >>> edge.find(np.array([2.0, 1.0, 1.5, 3.0]))
    2
    """

    def __init__(self, slope: Slope, level: float, hysteresis: float = 0.0) -> None:
        self._sign = 1.0 if slope is Slope.RISING else -1.0
        self._level = self._sign * level
        self._hysteresis = hysteresis
        self._armed = False

    def find(self, samples: NDArray[np.float64], skip: int = 0) -> int | None:
        """Look for the first edge in the samples that follow those of the last call.

        Parameters
        ----------
        samples : ndarray, shape (n,)
            Samples.
        skip : int
            Samples at the beginning in which an edge does not count; they still arm the trigger.

        Returns
        -------
        int or None
            Index of the first sample beyond the level; None if there is none.
        """
        x = self._sign * samples
        beyond, before = x > self._level, x <= self._level - self._hysteresis
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
class SyncPulse:
    """Digital edges of the sync output: one a second."""

    edge: Edge

    def next_tick(self, tick: int, rate: float) -> int:
        """Give the sample at or after a given one at which the next edge comes."""
        phase = 0.0 if self.edge is Edge.RISING else 0.5
        # The edge at 0 s belongs to power-on; the first one that can trigger comes at 1 s, or falls at 1.5 s.
        second = max(1, math.ceil(tick / rate - phase - 1e-9))
        found = math.ceil((second + phase) * rate - 1e-6)
        return found if found >= tick else math.ceil((second + 1 + phase) * rate - 1e-6)


@dataclass(frozen=True)
class OtherTask:
    """The moment at which another task starts or meets its reference trigger."""

    device: str
    kind: str
    reference: bool


def digital_source(source: str, edge: Edge) -> SyncPulse | OtherTask:
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
            DAQmxErrors.ROUTE_NOT_SUPPORTED_BY_HW_ROUTING,
        )
    device, signal = match[1] or "", match[2].lower()
    if signal.startswith("pfi"):
        return SyncPulse(edge)
    return OtherTask(device, signal[:2], signal.endswith("referencetrigger"))


class _Settings:
    """Settings of one trigger of a task, frozen while the task runs.

    The names are those of the driver's properties.
    """

    _NAMES: tuple[str, ...] = (
        *("trig_type", "anlg_edge_src", "anlg_edge_slope", "anlg_edge_lvl", "anlg_edge_hyst"),
        *("dig_edge_src", "dig_edge_edge"),
    )
    _task: Task
    _called: str

    trig_type: TriggerType
    anlg_edge_src: str
    anlg_edge_slope: Slope
    anlg_edge_lvl: float
    anlg_edge_hyst: float
    dig_edge_src: str
    dig_edge_edge: Edge

    def __init__(self, task: Task, called: str) -> None:
        object.__setattr__(self, "_task", task)
        object.__setattr__(self, "_called", called)
        self._off()

    def __setattr__(self, name: str, value: Any) -> None:
        if name not in self._NAMES:
            raise unsupported(f"triggers.{self._called}.{name}")
        self._task.check_idle(f"triggers.{self._called}.{name}")
        what = f"triggers.{self._called}.{name}"
        kinds: dict[str, Any] = {"trig_type": TriggerType, "anlg_edge_slope": Slope, "dig_edge_edge": Edge}
        if name in kinds:
            value = argument.choice(kinds[name], value, what)
        elif name in ("anlg_edge_lvl", "anlg_edge_hyst"):
            value = argument.number(value, what)
        elif name == "pretrig_samples":
            value = argument.whole(value, what)
        object.__setattr__(self, name, value)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        raise unsupported(f"triggers.{self._called}.{name}")

    def _off(self) -> None:
        self.trig_type = TriggerType.NONE
        self.anlg_edge_src = self.dig_edge_src = ""
        self.anlg_edge_slope, self.dig_edge_edge = Slope.RISING, Edge.RISING
        self.anlg_edge_lvl = self.anlg_edge_hyst = 0.0

    def _analog(self, source: str, slope: Slope, level: float) -> None:
        self.anlg_edge_src, self.anlg_edge_slope, self.anlg_edge_lvl = source, slope, level
        self.trig_type = TriggerType.ANALOG_EDGE

    def _digital(self, source: str, edge: Edge) -> None:
        digital_source(source, edge)
        self.dig_edge_src, self.dig_edge_edge = source, edge
        self.trig_type = TriggerType.DIGITAL_EDGE


class StartTrigger(_Settings):
    """What starts the task once it has been told to start."""

    _NAMES = (*_Settings._NAMES, "retriggerable")
    retriggerable: bool

    def __init__(self, task: Task) -> None:
        super().__init__(task, "start_trigger")
        self.retriggerable = False

    @property
    def term(self) -> str:
        """Terminal on which this task's own start can be had by others."""
        kind = "ao" if self._task.kind == "ao" else "ai"
        return f"/{self._task.device}/{kind}/StartTrigger"

    def cfg_anlg_edge_start_trig(
        self, trigger_source: str = "", trigger_slope: Slope = Slope.RISING, trigger_level: float = 0.0
    ) -> None:
        """Start when a channel of the task crosses a level, in the channel's units."""
        self._analog(trigger_source, trigger_slope, trigger_level)

    def cfg_dig_edge_start_trig(self, trigger_source: str, trigger_edge: Edge = Edge.RISING) -> None:
        """Start on an edge at a terminal."""
        self._digital(trigger_source, trigger_edge)

    def disable_start_trig(self) -> None:
        """Start at once."""
        self._off()


class ReferenceTrigger(_Settings):
    """Where, within a finite acquisition, the pretrigger samples end."""

    _NAMES = (*_Settings._NAMES, "pretrig_samples")
    pretrig_samples: int

    def __init__(self, task: Task) -> None:
        super().__init__(task, "reference_trigger")
        self.pretrig_samples = 0

    def cfg_anlg_edge_ref_trig(
        self,
        trigger_source: str,
        pretrigger_samples: int,
        trigger_slope: Slope = Slope.RISING,
        trigger_level: float = 0.0,
    ) -> None:
        """Trigger when a channel of the task crosses a level, in the channel's units."""
        self.pretrig_samples = pretrigger_samples
        self._analog(trigger_source, trigger_slope, trigger_level)

    def cfg_dig_edge_ref_trig(
        self, trigger_source: str, pretrigger_samples: int, trigger_edge: Edge = Edge.RISING
    ) -> None:
        """Trigger on an edge at a terminal."""
        self.pretrig_samples = pretrigger_samples
        self._digital(trigger_source, trigger_edge)

    def disable_ref_trig(self) -> None:
        """Do without a reference trigger."""
        self._off()


class Triggers:
    """The triggers of a task."""

    def __init__(self, task: Task) -> None:
        self.start_trigger = StartTrigger(task)
        self.reference_trigger = ReferenceTrigger(task)
        # For scripts that synchronise several devices: here all are, by the one clock there is.
        self.sync_type = SyncType.NONE

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        raise unsupported(f"triggers.{name}", "It has start_trigger and reference_trigger.")
