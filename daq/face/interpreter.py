"""The rig's instrument as the driver behind the real package nidaqmx.

That package sends every call through one interpreter object, chosen in `nidaqmx.utils`; `plug_in` makes it
choose the one made here, which hands the calls to `daq.face.task` and what belongs to it. The seam is private,
hence the package's version is pinned. Properties come through it as numbers; which number means which
property is read out of the package's own code, and as the properties here go by the same names, no table of
them is needed.

Whatever the instrument does not have raises `nidaqmx.errors.DaqError` naming the call.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable
from typing import Any

import nidaqmx.errors as driver_errors
import numpy as np
from nidaqmx import utils
from nidaqmx._base_interpreter import BaseEventHandler, BaseInterpreter
from nidaqmx.constants import FillMode, WaveformAttributeMode
from nidaqmx.types import DriverVersion
from numpy.typing import NDArray

from daq.face import driver_properties as properties
from daq.face.constants import EveryNSamplesEventType
from daq.face.devices import System
from daq.face.task import Task
from daq.face.virtual_channels import Channel
from daq.instrument import errors

VERSION = "1.7.0"


class _EventHandler(BaseEventHandler):
    """What a registration gives back; there is nothing to release."""

    def close(self) -> None:
        """Do nothing."""


class _RigDriver:
    """The calls of the seam that the instrument has, by the package's names for them.

    A task's handle is the `daq.face.task.Task` itself.
    """

    def __init__(self) -> None:
        self._last_created = ""

    @property
    def driver_version(self) -> DriverVersion:
        """Version of the driver this stands for."""
        return DriverVersion(*System.local().driver_version)

    # Tasks

    def create_task(self, name: str) -> tuple[Task, bool]:
        task = Task(name)
        task.warning_type = driver_errors.DaqWarning
        return task, True

    def clear_task(self, task: Task) -> None:
        task.close()

    def start_task(self, task: Task) -> None:
        task.start()

    def stop_task(self, task: Task) -> None:
        task.stop()

    def task_control(self, task: Task, action: Any) -> None:
        task.control(action)

    def is_task_done(self, task: Task) -> bool:
        return task.is_task_done()

    def wait_until_task_done(self, task: Task, time_to_wait: float) -> None:
        task.wait_until_done(time_to_wait)

    def hash_task_handle(self, task: Task) -> int:
        return hash(task)

    # Channels

    def internal_get_last_created_chan(self) -> str:
        return self._last_created

    def _created(self, channel: Channel) -> None:
        self._last_created = channel.name

    def create_ai_voltage_chan(self, task: Task, physical: str, name: str, *settings: Any) -> None:
        self._created(task.ai_channels.add_ai_voltage_chan(physical, name, *settings))

    def create_ai_accel_chan(self, task: Task, physical: str, name: str, *settings: Any) -> None:
        self._created(task.ai_channels.add_ai_accel_chan(physical, name, *settings))

    def create_ai_force_iepe_chan(self, task: Task, physical: str, name: str, *settings: Any) -> None:
        self._created(task.ai_channels.add_ai_force_iepe_chan(physical, name, *settings))

    def create_ai_velocity_iepe_chan(self, task: Task, physical: str, name: str, *settings: Any) -> None:
        self._created(task.ai_channels.add_ai_velocity_iepe_chan(physical, name, *settings))

    def create_ao_voltage_chan(self, task: Task, physical: str, name: str, *settings: Any) -> None:
        self._created(task.ao_channels.add_ao_voltage_chan(physical, name, *settings))

    # Timing and triggers

    def cfg_samp_clk_timing(
        self, task: Task, rate: float, source: str, edge: Any, mode: Any, samples: int
    ) -> None:
        task.timing.cfg_samp_clk_timing(rate, source, edge, mode, samples)

    def cfg_anlg_edge_start_trig(self, task: Task, source: str, slope: Any, level: float) -> None:
        task.triggers.start_trigger.cfg_anlg_edge_start_trig(source, slope, level)

    def cfg_dig_edge_start_trig(self, task: Task, source: str, edge: Any) -> None:
        task.triggers.start_trigger.cfg_dig_edge_start_trig(source, edge)

    def disable_start_trig(self, task: Task) -> None:
        task.triggers.start_trigger.disable_start_trig()

    def cfg_anlg_edge_ref_trig(self, task: Task, source: str, before: int, slope: Any, level: float) -> None:
        task.triggers.reference_trigger.cfg_anlg_edge_ref_trig(source, before, slope, level)

    def cfg_dig_edge_ref_trig(self, task: Task, source: str, before: int, edge: Any) -> None:
        task.triggers.reference_trigger.cfg_dig_edge_ref_trig(source, before, edge)

    def disable_ref_trig(self, task: Task) -> None:
        task.triggers.reference_trigger.disable_ref_trig()

    # Reading and writing

    def read_analog_f64(
        self, task: Task, samples: int, timeout: float, fill_mode: int, out: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], int]:
        return out, self._read(task, samples, timeout, fill_mode, out, raw=False)

    def read_analog_scalar_f64(self, task: Task, timeout: float) -> float:
        return float(task.read(timeout=timeout))

    def read_binary_i32(
        self, task: Task, samples: int, timeout: float, fill_mode: int, out: NDArray[np.int32]
    ) -> tuple[NDArray[np.int32], int]:
        task.in_stream.check_counts()
        return out, self._read(task, samples, timeout, fill_mode, out, raw=True)

    def read_raw(
        self, task: Task, samples: int, timeout: float, out: NDArray[Any]
    ) -> tuple[NDArray[Any], int, int]:
        task.in_stream.check_counts()
        counts = out.view(np.int32)
        got = self._read(task, samples, timeout, FillMode.GROUP_BY_SCAN_NUMBER.value, counts, raw=True)
        return out, got, 4 * task.in_stream.num_chans

    def _read(
        self, task: Task, samples: int, timeout: float, fill_mode: int, out: NDArray[Any], raw: bool
    ) -> int:
        channels = task.in_stream.num_chans
        needed = channels * samples
        if out.size < needed:
            raise errors.DaqError(
                f"the array has room for {out.size} samples, {needed} are to be read: make it larger",
                errors.DAQmxErrors.READ_BUFFER_TOO_SMALL,
            )
        flat = out.reshape(-1)[:needed]
        if fill_mode == FillMode.GROUP_BY_CHANNEL.value:
            return task.in_stream.fill(flat.reshape(channels, samples), timeout, raw)
        return task.in_stream.fill(flat.reshape(samples, channels).T, timeout, raw)

    def read_analog_waveform(
        self, task: Task, samples: int, timeout: float, waveform: Any, mode: WaveformAttributeMode
    ) -> int:
        return self.read_analog_waveforms(task, samples, timeout, [waveform], mode)

    def read_analog_waveforms(
        self, task: Task, samples: int, timeout: float, waveforms: list[Any], mode: WaveformAttributeMode
    ) -> int:
        from datetime import UTC

        from hightime import datetime, timedelta
        from nitypes.waveform import Timing as WaveformTiming

        out = np.zeros((len(waveforms), samples))
        got = 0
        try:
            got = task.in_stream.fill(out, timeout)
        except errors.DaqReadError as error:
            got = error.samps_per_chan_read
            raise
        finally:
            _, start_ns = task.run.last_read(got)
            start = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(
                seconds=start_ns // 10**9, nanoseconds=start_ns % 10**9
            )
            interval = timedelta(seconds=1 / task.chassis.rate)
            terminals = task.in_stream.channels_to_read.terminals
            for waveform, row, terminal in zip(waveforms, out, terminals, strict=True):
                waveform.sample_count = got
                waveform.raw_data[:] = row[:got]
                if WaveformAttributeMode.TIMING in mode:
                    waveform.timing = WaveformTiming.create_with_regular_interval(interval, start)
                if WaveformAttributeMode.EXTENDED_PROPERTIES in mode:
                    waveform.channel_name = terminal.name
                    waveform.units = "Volts" if terminal.unit == "V" else terminal.unit
        return got

    def write_analog_f64(
        self,
        task: Task,
        samples: int,
        auto_start: bool,
        timeout: float,
        layout: int,
        data: NDArray[np.float64],
    ) -> int:
        task.require_outputs()
        flat = data.reshape(-1)
        rows = (
            flat.reshape(-1, samples)
            if layout == FillMode.GROUP_BY_CHANNEL.value
            else flat.reshape(samples, -1).T
        )
        return task.out_stream.put(rows, auto_start, timeout)

    def write_analog_scalar_f64(self, task: Task, auto_start: bool, timeout: float, value: float) -> None:
        task.write(value, auto_start, timeout)

    def write_analog_waveform(self, task: Task, waveform: Any, auto_start: bool, timeout: float) -> int:
        return self.write_analog_waveforms(task, [waveform], auto_start, timeout)

    def write_analog_waveforms(
        self, task: Task, waveforms: list[Any], auto_start: bool, timeout: float
    ) -> int:
        return task.write(np.stack([each.scaled_data for each in waveforms]), auto_start, timeout)

    def configure_logging(self, task: Task, path: str, mode: Any, group: str, operation: Any) -> None:
        task.in_stream.configure_logging(path, mode, group, operation)

    # Events

    def register_every_n_samples_event(
        self, task: Task, kind: int, samples: int, options: int, callback: Callable[..., Any], data: Any
    ) -> _EventHandler:
        task.events.register_every(EveryNSamplesEventType(kind), samples, callback, data)
        return _EventHandler()

    def unregister_every_n_samples_event(self, task: Task, kind: int) -> None:
        task.events.register_every(EveryNSamplesEventType(kind), 0, None)

    def register_done_event(
        self, task: Task, options: int, callback: Callable[..., Any], data: Any
    ) -> _EventHandler:
        task.events.register_done(callback, data)
        return _EventHandler()

    def unregister_done_event(self, task: Task) -> None:
        task.events.register_done(None)


_TYPES = (
    *("bool", "double", "double_array", "int32", "int32_array", "string", "timestamp", "uint32", "uint64"),
    *("uint32_array", "bytes"),
)


def _translated(call: Callable[..., Any], answer: Callable[[Any], Any] | None = None) -> Callable[..., Any]:
    """Make a call raise the package's own errors, and give its result in the form of the seam."""

    @functools.wraps(call)
    def translate(*given: Any, **named: Any) -> Any:
        try:
            result = call(*given, **named)
            return result if answer is None else answer(result)
        except errors.DaqReadError as error:
            raise driver_errors.DaqReadError(
                error.bare_message, error.error_code, error.samps_per_chan_read, error.task_name
            ) from None
        except errors.DaqWriteError as error:
            raise driver_errors.DaqWriteError(
                error.bare_message, error.error_code, error.samps_per_chan_written, error.task_name
            ) from None
        except errors.DaqError as error:
            raise driver_errors.DaqError(error.bare_message, error.error_code, error.task_name) from None

    return translate


def _refusing(name: str) -> Callable[..., Any]:
    """Make the call that says that there is no such call."""

    def refuse(self: Any, *given: Any, **named: Any) -> Any:
        raise errors.unsupported(f"the driver call {name}")

    return refuse


def _calls(wanted: Iterable[str]) -> dict[str, Any]:
    """Give every call of the seam what answers it."""
    calls: dict[str, Any] = {}
    for name in wanted:
        own = getattr(_RigDriver, name, None)
        if isinstance(own, property):
            calls[name] = own
            continue
        base = next((name.removesuffix(f"_{kind}") for kind in _TYPES if name.endswith(f"_{kind}")), name)
        asked = properties.CALLS.get(name) or properties.CALLS.get(base)
        if own is None and asked is not None:
            answer = properties.as_text if name.endswith("_string") else properties.as_number
            calls[name] = _translated(asked, answer)
        else:
            calls[name] = _translated(own or _refusing(name))
    return calls


_Interpreter: Any = type(
    "RigInterpreter", (_RigDriver, BaseInterpreter), _calls(BaseInterpreter.__abstractmethods__)
)


def interpreter() -> BaseInterpreter:
    """Make an interpreter for the package's tasks, devices and system.

    Examples
    --------
    >>> type(interpreter()).__name__
    'RigInterpreter'
    """
    made: BaseInterpreter = _Interpreter()
    return made


def plug_in() -> None:
    """Let the package nidaqmx run on the rig, in this process, from now on.

    Raises
    ------
    DaqError
        If the package has another version than the one this was made for.
    """
    import nidaqmx

    if nidaqmx.__version__ != VERSION:
        raise errors.DaqError(
            f"the package nidaqmx has version {nidaqmx.__version__}, but the rig fits into {VERSION} only: "
            f"pip install nidaqmx=={VERSION}",
            errors.DAQmxErrors.UNKNOWN,
        )
    shared = interpreter()
    utils._select_interpreter = lambda *given, **named: shared
