"""Timing of a task: on demand, or so many samples at the sample clock's rate."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

from daq.face import argument
from daq.face.constants import AcquisitionType, Edge, SampleTimingType
from daq.instrument.errors import DaqError, DAQmxErrors, unsupported

if TYPE_CHECKING:
    from daq.face.task import Task

_SETTINGS = (
    *("samp_timing_type", "samp_clk_rate", "samp_clk_src", "samp_clk_active_edge"),
    *("samp_quant_samp_mode", "samp_quant_samp_per_chan", "ref_clk_src", "ref_clk_rate"),
)
_OWN_CLOCK = re.compile(
    r"|OnboardClock|.*/OnboardClock|/?([^/]+/)?(a[io]/)?SampleClock(Timebase)?", re.IGNORECASE
)


class Timing:
    """What paces a task; names are those of the driver's properties, frozen while the task runs.

    The sample clock divides 51.2 kHz by whole numbers up to 31: `samp_clk_rate` reads back what becomes of a
    request, and every time axis must use that.

    Parameters
    ----------
    task : Task
        The task.
    """

    samp_timing_type: SampleTimingType
    samp_clk_src: str
    samp_clk_active_edge: Edge
    samp_quant_samp_mode: AcquisitionType
    samp_quant_samp_per_chan: int
    # Kept for scripts that lock several devices to one clock; the bench has only one.
    ref_clk_src: str
    ref_clk_rate: float

    def __init__(self, task: Task) -> None:
        store = self.__dict__
        store["_task"] = task
        store["_rate"] = None
        store["samp_timing_type"] = SampleTimingType.ON_DEMAND
        store["samp_clk_src"], store["samp_clk_active_edge"] = "", Edge.RISING
        store["samp_quant_samp_mode"], store["samp_quant_samp_per_chan"] = AcquisitionType.FINITE, 1000
        store["ref_clk_src"], store["ref_clk_rate"] = "", 10e6

    @property
    def clocked(self) -> bool:
        """Whether the sample clock paces the task."""
        return self.samp_timing_type is SampleTimingType.SAMPLE_CLOCK

    @property
    def finite(self) -> bool:
        """Whether the task ends by itself."""
        return self.samp_quant_samp_mode is AcquisitionType.FINITE

    @property
    def samp_clk_rate(self) -> float:
        """Samples per second, as the clock makes them."""
        chassis = self._task.chassis
        return float(chassis.rate if self._rate is None else chassis.coerce_rate(self._rate))

    @samp_clk_rate.setter
    def samp_clk_rate(self, rate: float) -> None:
        wanted = argument.number(rate, "timing.samp_clk_rate")
        self._task.chassis.coerce_rate(wanted)
        self.__dict__["_rate"] = wanted

    @property
    def samp_clk_max_rate(self) -> float:
        """Fastest rate of the clock."""
        from daq.instrument.sample_rates import FASTEST_RATE

        return FASTEST_RATE

    @property
    def waits_for_input_clock(self) -> bool:
        """Whether an output runs on the clock of the inputs, and thus begins with them."""
        return self._task.kind == "ao" and self.samp_clk_src.lower().endswith("ai/sampleclock")

    def __setattr__(self, name: str, value: Any) -> None:
        if name not in _SETTINGS:
            raise unsupported(f"setting timing.{name}")
        self._task.check_idle(f"timing.{name}")
        if name == "samp_clk_rate":
            object.__setattr__(self, name, value)
            return
        if name == "samp_clk_src" and not _OWN_CLOCK.fullmatch(value):
            raise DaqError(
                f"sample clock source {value!r}: the bench has one sample clock; leave the source empty, "
                "or name "
                "OnboardClock or another task's ai/SampleClock",
                DAQmxErrors.ROUTE_NOT_SUPPORTED_BY_HW_ROUTING,
                self._task.name,
            )
        kinds: dict[str, Any] = {
            "samp_timing_type": SampleTimingType,
            "samp_clk_active_edge": Edge,
            "samp_quant_samp_mode": AcquisitionType,
        }
        if name in kinds:
            value = argument.choice(kinds[name], value, f"timing.{name}")
        elif name == "samp_quant_samp_per_chan":
            value = argument.whole(value, f"timing.{name}")
        if value is AcquisitionType.HW_TIMED_SINGLE_POINT:
            raise unsupported("hardware-timed single point", "Use CONTINUOUS and read one sample at a time.")
        if name == "samp_quant_samp_per_chan" and value < 1:
            raise DaqError(
                f"{value} samples per channel: expected 1 at least",
                DAQmxErrors.INVALID_ATTRIBUTE_VALUE,
                self._task.name,
            )
        self.__dict__[name] = value

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        raise unsupported(f"timing.{name}")

    def cfg_samp_clk_timing(
        self,
        rate: float,
        source: str = "",
        active_edge: Edge = Edge.RISING,
        sample_mode: AcquisitionType = AcquisitionType.FINITE,
        samps_per_chan: int = 1000,
    ) -> None:
        """Pace the task by the sample clock.

        Parameters
        ----------
        rate : float
            Samples per second asked for; see `samp_clk_rate` for what becomes of it.
        source : str
            Clock terminal; there is only one clock.
        active_edge : Edge
            Of no consequence here.
        sample_mode : AcquisitionType
            FINITE or CONTINUOUS.
        samps_per_chan : int
            Samples of a finite task; a hint for the buffer of a continuous one.

        Raises
        ------
        DaqError
            With -200077 for a bad value, -89136 for a clock that is not there, -200479 while the task runs.
        """
        self.samp_clk_rate = rate
        self.samp_clk_src, self.samp_clk_active_edge = source, active_edge
        self.samp_quant_samp_mode, self.samp_quant_samp_per_chan = sample_mode, samps_per_chan
        self.samp_timing_type = SampleTimingType.SAMPLE_CLOCK
