"""What each remote call does on the instrument."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from daq.instrument.errors import Code, DaqError, bad, unsupported
from daq.instrument.measurements import MEASUREMENTS, Measurement, measurement
from daq.instrument.names import numbered, parse_port, unflatten
from daq.instrument.reading import Reading
from daq.instrument.scales import LINEAR, MAP_RANGES, POLYNOMIAL, TABLE, Scale, reverse_polynomial
from daq.instrument.task import Task
from daq.instrument.task_properties import get_value, set_value, set_values
from daq.instrument.teds import sensitivity
from daq.instrument.values import Signal, TimestampEvent, TimingType, TriggerType
from daq.server.attributes import attribute_call
from daq.server.protocol import timestamp

if TYPE_CHECKING:
    from daq.server.service import Server

Answer = dict[str, Any]
_BY_CHANNEL = 0


@dataclass
class Call:
    """A remote call.

    Attributes
    ----------
    server : Server
        Who answers it.
    peer : str
        Who calls.
    message : Message
        The request.
    fields : dict
        What it holds, see `daq.server.protocol.decode`.
    strict : bool
        Whether the client wants a name that is taken told as the driver does, not as the network does.
    """

    server: Server
    peer: str
    message: Any
    fields: dict[str, Any] = field(default_factory=dict)
    strict: bool = False

    @property
    def task(self) -> Task:
        """The task it is about; with -200088, if there is none of that name."""
        return self.server.sessions.find(self.fields["task"], self.peer)


# Sessions


def _create_task(call: Call) -> Answer:
    return _session(call, call.fields["session_name"])


def _load_task(call: Call) -> Answer:
    name = call.fields["session_name"]
    if name not in call.server.storage.tasks:
        raise DaqError(f"there is no saved task {name!r}", Code.TASK_NOT_IN_DATA_NEIGHBORHOOD)
    answer = _session(call, name)
    if answer["new_session_initialized"]:
        task = call.server.sessions.find(answer["task"], call.peer)
        call.server.storage.load_task(task.settings, name)
    return answer


def _session(call: Call, name: str) -> Answer:
    behavior = call.fields.get("initialization_behavior", 0)
    if call.strict and name:
        call.server.sessions.check_free(name)
    session, new = call.server.sessions.open(name, behavior, call.peer)
    return {"task": session, "new_session_initialized": new}


def _clear_task(call: Call) -> Answer:
    call.server.sessions.close(call.fields["task"], call.peer)
    return {}


# Channels


def _create_input(kind: str) -> Callable[[Call], Answer]:
    chosen, implied = measurement(kind)

    def create(call: Call) -> Answer:
        given = dict(call.fields)
        task = call.server.sessions.find(given.pop("task"), call.peer)
        task.check_idle("adding channels")
        physical, name = given.pop("physical_channel"), given.pop("name_to_assign_to_channel")
        settings = chosen.settings({key: _plain(value) for key, value in given.items()}) | implied
        task.settings.add_inputs(physical, name, chosen, settings)
        return {}

    return create


def _create_teds_input(kind: str) -> Callable[[Call], Answer]:
    chosen, implied = measurement(kind)

    def create(call: Call) -> Answer:
        given = dict(call.fields)
        task = call.server.sessions.find(given.pop("task"), call.peer)
        task.check_idle("adding channels")
        physical, name = given.pop("physical_channel"), given.pop("name_to_assign_to_channel")
        settings = chosen.settings({key: _plain(value) for key, value in given.items()}) | implied
        terminals = unflatten(physical)
        names = numbered(name, len(terminals)) if name else [""] * len(terminals)
        for each, virtual in zip(terminals, names, strict=True):
            own = settings | _told_by_sensor(call, each, chosen) | {"ai_is_teds": True}
            task.settings.add_inputs(each, virtual, chosen, own)
        return {}

    return create


def _told_by_sensor(call: Call, physical: str, kind: Measurement) -> dict[str, Any]:
    """Give the settings that a sensor's own data sheet makes for a channel on its terminal.

    Raises
    ------
    DaqError
        With -200709 where no sensor says what it is, -200826 where it is none of that kind.
    """
    port = parse_port(physical)
    volts = sensitivity(call.server.teds.sheet(port))
    if volts is None or not kind.sensitivity:
        raise DaqError(
            f"{port.name}: the electronic data sheet there states no sensitivity of such a sensor",
            Code.TEDS_SENSOR_DATA_ERROR,
        )
    return kind.sensitivity_settings(volts)


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else value


def _create_output(call: Call) -> Answer:
    given = call.fields
    call.task.check_idle("adding channels")
    settings = {
        "ao_min": given["min_val"],
        "ao_max": given["max_val"],
        "ao_voltage_units": given["units"],
        "ao_custom_scale_name": given["custom_scale_name"],
    }
    call.task.settings.add_outputs(given["physical_channel"], given["name_to_assign_to_channel"], settings)
    return {}


def _add_saved_channels(call: Call) -> Answer:
    task = call.task
    task.check_idle("adding channels")
    for name in unflatten(call.fields["channel_names"]):
        task.settings.channels.append(call.server.storage.channel(name))
    return {}


# Timing and triggers


def _sample_clock(call: Call) -> Answer:
    given = call.fields
    set_values(
        call.task,
        "timing",
        samp_clk_rate=given["rate"],
        samp_clk_src=given["source"],
        samp_clk_active_edge=given["active_edge"],
        samp_quant_samp_mode=given["sample_mode"],
        samp_quant_samp_per_chan=given["samps_per_chan"],
        samp_timing_type=TimingType.SAMPLE_CLOCK,
    )
    return {}


def _trigger(which: str, kind: TriggerType, **names: str) -> Callable[[Call], Answer]:
    """Make the call that sets a trigger up; `names` tells which field is which of its settings."""
    prefix = {
        TriggerType.ANALOG_EDGE: "anlg_edge",
        TriggerType.ANALOG_WINDOW: "anlg_win",
        TriggerType.ANALOG_MULTI_EDGE: "anlg_multi_edge",
        TriggerType.DIGITAL_EDGE: "dig_edge",
        TriggerType.DIGITAL_PATTERN: "dig_pattern",
    }[kind]

    def configure(call: Call) -> Answer:
        settings = {
            f"{prefix}_{which}_trig_{key}": _plain(call.fields[field_name])
            for field_name, key in names.items()
        }
        if "pretrigger_samples" in call.fields:
            settings["ref_trig_pretrig_samples"] = call.fields["pretrigger_samples"]
        set_values(call.task, "trig", **settings, **{f"{which}_trig_type": kind})
        return {}

    return configure


def _triggers(which: str) -> dict[str, Callable[[Call], Answer]]:
    name = which.capitalize()
    source, when = {"trigger_source": "src"}, {"trigger_when": "when"}
    slope = {"trigger_slope": "slope", "trigger_level": "lvl"}
    window = {"window_top": "top", "window_bottom": "btm"}
    several = {"trigger_sources": "srcs", "trigger_slope_array": "slopes", "trigger_level_array": "lvls"}
    return {
        f"CfgAnlgEdge{name}Trig": _trigger(which, TriggerType.ANALOG_EDGE, **source, **slope),
        f"CfgAnlgWindow{name}Trig": _trigger(which, TriggerType.ANALOG_WINDOW, **source, **when, **window),
        f"CfgAnlgMultiEdge{name}Trig": _trigger(which, TriggerType.ANALOG_MULTI_EDGE, **several),
        f"CfgDigEdge{name}Trig": _trigger(which, TriggerType.DIGITAL_EDGE, **source, trigger_edge="edge"),
        f"Disable{name}Trig": _disable(which),
    }


def _disable(which: str) -> Callable[[Call], Answer]:
    def disable(call: Call) -> Answer:
        set_value(call.task, "trig", f"{which}_trig_type", TriggerType.NONE)
        return {}

    return disable


def _start_at(call: Call) -> Answer:
    set_values(
        call.task,
        "trig",
        start_trig_type=TriggerType.TIME,
        start_trig_trig_when=call.fields["when"],
        start_trig_timescale=call.fields["timescale"],
    )
    return {}


def _export_signal(call: Call) -> Answer:
    names = {
        Signal.SAMPLE_CLOCK: "samp_clk_output_term",
        Signal.START_TRIGGER: "start_trig_output_term",
        Signal.REFERENCE_TRIGGER: "ref_trig_output_term",
    }
    if call.fields["signal_id"] not in names:
        raise unsupported(f"exporting signal {call.fields['signal_id']}")
    set_value(call.task, "exported_signal", names[call.fields["signal_id"]], call.fields["output_terminal"])
    return {}


def _timestamp(event: TimestampEvent | None) -> Callable[[Call], Answer]:
    def ask(call: Call) -> Answer:
        chosen = event if event is not None else TimestampEvent(call.fields["timestamp_event"])
        seconds = call.task.time_of(chosen, call.fields.get("timeout", 0.0)) * 1e-9
        return {"data" if event is not None else "timestamp": seconds}

    return ask


# Reading and writing


def _read(raw: bool = False, name: str = "read_array") -> Callable[[Call], Answer]:
    def read(call: Call) -> Answer:
        given = call.fields
        samples, size = given["num_samps_per_chan"], given.get("array_size_in_samps", 0)
        task = call.task
        if samples > 0 and samples * len(task.settings.rows_to_read()) > size:
            raise DaqError(
                f"the array has room for {size} samples, {samples} of {len(task.settings.rows_to_read())} channels are "
                "to be read: make it larger",
                Code.READ_BUFFER_TOO_SMALL,
                done=0,
            )
        call.server.check_size(max(samples, 0) * len(task.settings.rows_to_read()) * 8)
        reading = task.read(samples, given["timeout"], raw)
        by_channel, values = given["fill_mode"] == _BY_CHANNEL, reading.samples
        if by_channel and reading.error is None and values.shape[1] < samples:
            # All that a finite task had left: each channel keeps its place in the array.
            values = np.pad(values, ((0, 0), (0, samples - values.shape[1])))
        values = values if by_channel else values.T
        return _told(call, reading, {name: values, "samps_per_chan_read": reading.samples.shape[1]})

    return read


def _told(call: Call, reading: Reading, answer: Answer) -> Answer:
    """Give what was read with the reason why there is no more, if there should be."""
    error = reading.error
    if error is None:
        return answer
    done = reading.samples.shape[1]
    if not done:
        raise DaqError(str(error), error.code, done=0)
    call.server.remember(call.peer, error, call.task.name)
    return answer | {"status": error.code}


def _read_scalar(call: Call) -> Answer:
    reading = call.task.read(1, call.fields["timeout"])
    if reading.error is not None:
        raise reading.error
    return {"value": float(reading.samples[0, 0])}


def _read_raw(call: Call) -> Answer:
    given, task = call.fields, call.task
    width = task.raw_width
    channels = len(task.settings.rows_to_read())
    samples = given["num_samps_per_chan"]
    if samples > 0 and samples * channels * width > given["array_size_in_bytes"]:
        raise DaqError(
            f"the array has room for {given['array_size_in_bytes']} bytes, {samples * channels * width} are to be "
            "read: make it larger",
            Code.READ_BUFFER_TOO_SMALL,
            done=0,
        )
    reading = task.read(samples, given["timeout"], raw=True)
    kind = np.int16 if width == 2 else np.int32
    data = reading.samples.T.astype(kind).tobytes().ljust(given["array_size_in_bytes"], b"\0")
    count = reading.samples.shape[1]
    return _told(
        call, reading, {"read_array": data, "samps_read": count, "num_bytes_per_samp": channels * width}
    )


def _read_waveforms(call: Call) -> Answer:
    from ni.protobuf.types import waveform_conversion
    from ni.protobuf.types.waveform_pb2 import DoubleAnalogWaveform, WaveformAttributeValue

    task, mode = call.task, call.fields.get("waveform_attribute_mode", 0)
    reading = task.read(call.fields["num_samps_per_chan"], call.fields["timeout"])
    assert waveform_conversion is not None
    found = []
    for row, samples in zip(task.settings.rows_to_read(), reading.samples, strict=True):
        channel = task.settings.channels[row]
        waveform = DoubleAnalogWaveform(y_data=samples.tolist())
        if mode & 1:
            start = task.time_of_sample(reading.first)
            # The waveform's time counts from 1904, in seconds and 2^-64 of one.
            seconds, rest = divmod(start, 10**9)
            waveform.t0.seconds = seconds + 2_082_844_800
            waveform.t0.fractional_seconds = rest * 2**64 // 10**9
            waveform.dt = 1.0 / task.settings.rate
        if mode & 2:
            waveform.attributes["NI_ChannelName"].CopyFrom(WaveformAttributeValue(string_value=channel.name))
            unit = "Volts" if channel.unit == "V" else channel.unit
            waveform.attributes["NI_UnitDescription"].CopyFrom(WaveformAttributeValue(string_value=unit))
        found.append(waveform)
    return _told(call, reading, {"waveforms": found, "samps_per_chan_read": reading.samples.shape[1]})


def _table(task: Task, data: NDArray[np.float64], samples: int, by_channel: bool) -> NDArray[np.float64]:
    """Put samples into rows, one for each channel."""
    channels = len(task.settings.channels) or 1
    if data.size != channels * samples:
        raise DaqError(
            f"the data have {data.size} samples, {samples} for each of the task's {channels} channels were "
            "announced",
            Code.WRITE_NUM_CHANS_MISMATCH,
            done=0,
        )
    return data.reshape(channels, samples) if by_channel else data.reshape(samples, channels).T


def _write(
    scale: Callable[[Task, NDArray[Any]], NDArray[np.float64]] | None = None,
) -> Callable[[Call], Answer]:
    def write(call: Call) -> Answer:
        given, task = call.fields, call.task
        data = np.asarray(given["write_array"], dtype=np.float64)
        table = _table(task, data, given["num_samps_per_chan"], given["data_layout"] == _BY_CHANNEL)
        volts = table if scale is None else scale(task, table)
        return {"samps_per_chan_written": task.write(volts, given["auto_start"], given["timeout"])}

    return write


def _from_counts(task: Task, counts: NDArray[Any]) -> NDArray[np.float64]:
    """Turn converter counts into volts."""
    bits = task.settings.channels[0].module.output_bits if task.settings.channels else None
    if bits is None:
        raise unsupported("an unscaled write", "The rig's output has no counts: write volts.")
    return counts * (task.settings.channels[0].module.output_range / 2.0 ** (bits - 1))


def _write_scalar(call: Call) -> Answer:
    given = call.fields
    call.task.write(np.array([[given["value"]]]), given["auto_start"], given["timeout"])
    return {}


def _write_raw(call: Call) -> Answer:
    given, task = call.fields, call.task
    task.settings.require("ao")
    kind = np.int16 if (task.settings.channels[0].module.output_bits or 32) <= 16 else np.int32
    # What is left over of an array that is no whole number of samples is not put out.
    whole = given["num_samps"] * len(task.settings.channels)
    data = np.frombuffer(given["write_array"], dtype=kind)[:whole]
    table = _table(task, data.astype(float), given["num_samps"], by_channel=False)
    written = task.write(_from_counts(task, table), given["auto_start"], given["timeout"])
    return {"samps_per_chan_written": written}


def _write_waveforms(call: Call) -> Answer:
    given = call.fields
    rows = [np.array(each.y_data) for each in given["waveforms"]]
    if len({row.size for row in rows}) > 1:
        raise DaqError("the waveforms differ in length: write as many samples for each channel", -200101, 0)
    volts = np.stack(rows) if rows else np.zeros((0, 0))
    return {"samps_per_chan_written": call.task.write(volts, given["auto_start"], given["timeout"])}


# Scales and what is saved


def _create_scale(kind: int, *names: tuple[str, str]) -> Callable[[Call], Answer]:
    def create(call: Call) -> Answer:
        given = call.fields
        settings = {key: _plain(given[name]) for name, key in names}
        common = {key: given[key] for key in ("pre_scaled_units", "scaled_units")}
        call.server.storage.scales[given["name"]] = Scale(kind, settings | common)
        return {}

    return create


def _reverse(call: Call) -> Answer:
    given = call.fields
    order = ("forward_coeffs", "min_val_x", "max_val_x", "num_points_to_compute", "reverse_poly_order")
    return {"reverse_coeffs": reverse_polynomial(*(_plain(given[name]) for name in order))}


def _save_task(call: Call) -> Answer:
    task = call.task
    call.server.storage.save_task(task.settings, call.fields["save_as"] or task.name, call.fields["author"])
    return {}


def _save_channel(call: Call) -> Answer:
    channel = call.task.settings.find(call.fields["channel_name"])[0]
    name = call.fields["save_as"] or channel.name
    call.server.storage.save_channel(channel, name, call.fields["author"])
    return {}


def _save_scale(call: Call) -> Answer:
    storage, given = call.server.storage, call.fields
    name = given["save_as"] or given["scale_name"]
    storage.scales[name] = storage.scale(given["scale_name"])
    storage.authors[name] = given["author"]
    return {}


def _forget(kept: str, field_name: str) -> Callable[[Call], Answer]:
    def forget(call: Call) -> Answer:
        getattr(call.server.storage, kept).pop(call.fields[field_name], None)
        return {}

    return forget


# Devices


def _on_device(call: Call) -> Answer:
    call.server.chassis.module(call.fields["device_name"])
    return {}


def _reset_device(call: Call) -> Answer:
    module = call.server.chassis.module(call.fields["device_name"])
    call.server.sessions.end_on(module.name, call.peer)
    return {}


def _teds(action: str) -> Callable[[Call], Answer]:
    def act(call: Call) -> Answer:
        teds, port = call.server.teds, parse_port(call.fields["physical_channel"])
        call.server.chassis.module(port.device).row(port.kind, port.number)
        if action == "configure":
            teds.configure(port, call.fields["file_path"])
        elif action == "clear":
            teds.clear(port)
        elif action == "write_file":
            path = call.fields["file_path"]
            teds.write(port, b"" if not path else _file(path))
        else:
            teds.write(port, call.fields["bit_stream"])
        return {}

    return act


def _file(path: str) -> bytes:
    from pathlib import Path

    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise DaqError(f"{path}: {error.strerror}", Code.VIRTUAL_TEDS_FILE_NOT_FOUND) from None


def _nth(values: Callable[[Task], list[str]]) -> Callable[[Call], Answer]:
    def ask(call: Call) -> Answer:
        found, index = values(call.task), call.fields["index"]
        if not 1 <= index <= len(found):
            raise bad(f"number {index}: expected 1 to {len(found)}")
        return {"buffer": found[index - 1]}

    return ask


def _channels_read(task: Task) -> list[str]:
    return [task.settings.channels[row].name for row in task.settings.rows_to_read()]


def _error_string(call: Call) -> Answer:
    return {"error_string": call.server.recall(call.peer, call.fields["error_code"])}


def _does(action: Callable[[Task, dict[str, Any]], Any]) -> Callable[[Call], Answer]:
    """Make a call of something that a task does; a number it gives back is the status."""

    def act(call: Call) -> Answer:
        status = action(call.task, call.fields)
        return {"status": status} if isinstance(status, int) else {}

    return act


_CALLS: dict[str, Callable[[Call], Answer]] = {
    "CreateTask": _create_task,
    "LoadTask": _load_task,
    "ClearTask": _clear_task,
    "StartTask": _does(lambda task, given: task.start()),
    "StopTask": _does(lambda task, given: task.stop()),
    "TaskControl": _does(lambda task, given: task.control(given["action"])),
    "IsTaskDone": lambda call: {"is_task_done": call.task.is_done()},
    "WaitUntilTaskDone": _does(lambda task, given: task.wait_until_done(given["time_to_wait"])),
    "GetNthTaskChannel": _nth(lambda task: [each.name for each in task.settings.channels]),
    "GetNthTaskDevice": _nth(lambda task: task.settings.device_names),
    "GetNthTaskReadChannel": _nth(
        lambda task: [task.settings.channels[row].name for row in task.settings.rows_to_read()]
    ),
    "AddGlobalChansToTask": _add_saved_channels,
    "CreateAOVoltageChan": _create_output,
    "CfgSampClkTiming": _sample_clock,
    **_triggers("start"),
    **_triggers("ref"),
    "CfgTimeStartTrig": _start_at,
    "GetStartTrigTrigWhen": lambda call: {"data": get_value(call.task, "trig", "start_trig_trig_when")},
    "SetStartTrigTrigWhen": _does(
        lambda task, given: set_value(task, "trig", "start_trig_trig_when", given["data"])
    ),
    "GetStartTrigTimestampVal": _timestamp(TimestampEvent.START_TRIGGER),
    "GetRefTrigTimestampVal": _timestamp(TimestampEvent.REFERENCE_TRIGGER),
    "GetFirstSampTimestampVal": _timestamp(TimestampEvent.FIRST_SAMPLE),
    "WaitForValidTimestamp": _timestamp(None),
    "ExportSignal": _export_signal,
    "CfgInputBuffer": _does(
        lambda task, given: set_value(task, "buffer", "input_buf_size", given["num_samps_per_chan"])
    ),
    "CfgOutputBuffer": _does(
        lambda task, given: set_value(task, "buffer", "output_buf_size", given["num_samps_per_chan"])
    ),
    "ConfigureLogging": _does(
        lambda task, given: set_values(
            task,
            "read",
            logging_file_path=given["file_path"],
            logging_mode=given["logging_mode"],
            logging_tdms_group_name=given["group_name"],
            logging_tdms_operation=given["operation"],
        )
    ),
    "StartNewFile": _does(lambda task, given: task.start_new_file(given["file_path"])),
    "ReadAnalogF64": _read(),
    "ReadAnalogScalarF64": _read_scalar,
    **{f"ReadBinary{kind}": _read(raw=True) for kind in ("I16", "I32", "U16", "U32")},
    "ReadRaw": _read_raw,
    "ReadAnalogWaveforms": _read_waveforms,
    "WriteAnalogF64": _write(),
    "WriteAnalogScalarF64": _write_scalar,
    **{f"WriteBinary{kind}": _write(_from_counts) for kind in ("I16", "I32", "U16", "U32")},
    "WriteRaw": _write_raw,
    "WriteAnalogWaveforms": _write_waveforms,
    "CreateLinScale": _create_scale(LINEAR, ("slope", "lin_slope"), ("y_intercept", "lin_y_intercept")),
    "CreateMapScale": _create_scale(
        MAP_RANGES,
        ("prescaled_min", "map_pre_scaled_min"),
        ("prescaled_max", "map_pre_scaled_max"),
        ("scaled_min", "map_scaled_min"),
        ("scaled_max", "map_scaled_max"),
    ),
    "CreatePolynomialScale": _create_scale(
        POLYNOMIAL, ("forward_coeffs", "poly_forward_coeff"), ("reverse_coeffs", "poly_reverse_coeff")
    ),
    "CreateTableScale": _create_scale(
        TABLE, ("prescaled_vals", "table_pre_scaled_vals"), ("scaled_vals", "table_scaled_vals")
    ),
    "CalculateReversePolyCoeff": _reverse,
    "SaveTask": _save_task,
    "SaveGlobalChan": _save_channel,
    "SaveScale": _save_scale,
    "DeleteSavedTask": _forget("tasks", "task_name"),
    "DeleteSavedGlobalChan": _forget("channels", "channel_name"),
    "DeleteSavedScale": _forget("scales", "scale_name"),
    "SelfTestDevice": _on_device,
    "SelfCal": _on_device,
    "RestoreLastExtCalConst": _on_device,
    "ResetDevice": _reset_device,
    "UnreserveNetworkDevice": _on_device,
    "ReserveNetworkDevice": _on_device,
    "DeviceSupportsCal": lambda call: _on_device(call) | {"cal_supported": False},
    "ConfigureTEDS": _teds("configure"),
    "ClearTEDS": _teds("clear"),
    "WriteToTEDSFromArray": _teds("write"),
    "WriteToTEDSFromFile": _teds("write_file"),
    "GetErrorString": _error_string,
    "UnregisterEveryNSamplesEvent": _does(
        lambda task, given: task.listen_every(given["every_n_samples_event_type"], 0, None)
    ),
    "UnregisterDoneEvent": _does(lambda task, given: task.listen_done(None)),
    "UnregisterSignalEvent": _does(lambda task, given: task.listen_signal(given["signal_id"], None)),
}


def answer_to(name: str) -> Callable[[Call], Answer] | None:
    """Find what answers a call of the service; None if the instrument has no answer to it."""
    if name in _CALLS:
        return _CALLS[name]
    kind = name.replace("ChanWithExcit", "WithExcitChan").removesuffix("Chan")
    for prefix, make in (("CreateTEDSAI", _create_teds_input), ("CreateAI", _create_input)):
        wanted = kind.removeprefix(prefix)
        if kind.startswith(prefix) and (wanted in MEASUREMENTS or "Bridge" in wanted):
            return make(wanted)
    return attribute_call(name)


__all__ = ["Call", "answer_to", "timestamp"]
