"""Reads, sets and resets the properties of a task by NI's names; some are stored settings, others are computed."""

import re
from collections.abc import Callable
from functools import partial
from typing import Any

from daq.extras.ni_device.clock import normalize_timeout
from daq.extras.ni_device.devices.modules import Module
from daq.extras.ni_device.errors import Code, DaqError, invalid_value
from daq.extras.ni_device.settings.properties import WHILE_RUNNING, coerce
from daq.extras.ni_device.task import Task
from daq.extras.ni_device.values import TimestampEvent

# Names of the terminals of NI's devices, without the name of the device.
_TERMINAL = re.compile(r"A?PFI\d+|RTSI\d+|(a[io]/)?\w*(Clock|Timebase|Trigger)\w*|Ctr\d\w*", re.IGNORECASE)


def get_channel_property(task: Task, names: str, name: str) -> Any:
    """Return the common value of a property of the channels with the given names; no names select all channels.

    Raises `DaqError` -200077 if the channels have different values, -200478 if the task has no channels.
    """
    channels = task.settings.find(names)
    if not channels:
        raise DaqError(
            f"{name}: the task has no channels. Add a channel first.", Code.CAN_NOT_PERFORM_OP_WHEN_NO_CHANS_IN_TASK
        )
    if name in ("ai_filter_delay", "ai_remove_filter_delay"):
        return task.chassis.terminals.filter_properties(
            channels[0].bench_index, task.settings.rate if task.settings.has_sample_clock else None
        )[name]
    values = [channel.get(name) for channel in channels]
    if any(value != values[0] for value in values):
        raise invalid_value(
            f"{name} differs among {', '.join(channel.name for channel in channels)}. Query one channel at a time."
        )
    return values[0]


def set_channel_property(task: Task, names: str, name: str, value: Any) -> None:
    """Set a property of the channels with the given names; no names select all channels."""
    task.check_idle(f"setting {name}", Code.CANNOT_SET_PROPERTY_WHEN_TASK_RUNNING)
    for channel in task.settings.find(names):
        channel.set(name, value)


def reset_channel_property(task: Task, names: str, name: str) -> None:
    """Reset a property of the channels with the given names to its default."""
    task.check_idle(f"resetting {name}", Code.CANNOT_SET_PROPERTY_WHEN_TASK_RUNNING)
    for channel in task.settings.find(names):
        channel.reset(name)


def get_value(task: Task, group: str, name: str) -> Any:
    """Return a setting or a computed value of a group. Raises `DaqError` -200452 if there is no such property."""
    computed = _COMPUTED.get((group, name))
    with task.chassis.changed:
        return task.settings.groups[group][name] if computed is None else computed(task)


def set_value(task: Task, group: str, name: str, value: Any) -> None:
    """Change a setting of a group. Raises `DaqError` -200557 while the task runs, -200077 for an invalid value."""
    if name not in WHILE_RUNNING.get(group, ()):
        task.check_idle(f"setting {name}", Code.CANNOT_SET_PROPERTY_WHEN_TASK_RUNNING)
    if name == "samp_clk_timebase_div":
        divisor = coerce(name, value, 1.0)
        if divisor <= 0.0:
            raise invalid_value(f"{name} is {divisor:g}. Give a positive number.")
        name, value = "samp_clk_rate", _timebase(task) / divisor
    settings = task.settings.groups[group]
    value = coerce(name, value, settings[name])
    if name == "samp_clk_rate":
        for channel in task.settings.channels:
            # The call raises an error for an impossible rate.
            channel.module.coerced_rate(value, output=channel.direction == "ao")
    if name == "channels_to_read":
        task.settings.find(value)  # The call raises an error for a missing channel.
    if name.endswith("_buf_size") and value < 0:
        raise invalid_value(f"{name} is {value}. Give 0 or more samples.")
    settings[name] = value
    if name == "output_buf_size":
        task.output.buffer = None


def set_values(task: Task, group: str, **settings: Any) -> None:
    """Change several settings of a group."""
    for name, value in settings.items():
        set_value(task, group, name, value)


def reset_value(task: Task, group: str, name: str) -> None:
    """Reset a setting to its default."""
    task.check_idle(f"resetting {name}", Code.CANNOT_SET_PROPERTY_WHEN_TASK_RUNNING)
    task.settings.groups[group].reset("samp_clk_rate" if name == "samp_clk_timebase_div" else name)


def time_of(task: Task, event: TimestampEvent, timeout: float) -> int:
    """Wait for the first sample or a trigger of the task, and return its time [ns]; see `Chassis.time_ns`.

    Raises `DaqError` -209842 if the timestamp of the trigger is disabled, and -200284 if the event does not occur
    before the timeout.
    """
    role = {TimestampEvent.START_TRIGGER: "start", TimestampEvent.REFERENCE_TRIGGER: "ref"}.get(event)
    settings, key = task.settings.groups["trig"], f"{role}_trig_timestamp_enable"
    if role is not None and settings.was_set(key) and not settings[key]:
        raise DaqError(
            f"{event.name.lower()}: its time was not stored. Set timestamp_enable to True before starting the task.",
            Code.TIMESTAMP_NOT_ENABLED,
        )
    if role is None:
        task.settings.groups["timing"]["first_samp_timestamp_enable"] = True

    def tick() -> int | None:
        run = task.input.run
        if run is not None:
            reference = event == TimestampEvent.REFERENCE_TRIGGER and run.plan.reference is not None
            return run.start_tick(reference, task.chassis.position)
        return None if task.output.run is None else task.output.run.first_tick

    with task.chassis.changed:
        polling_ticks = max(1, int(task.chassis.rate / 100))
        if not task.chassis.wait(lambda: tick() is not None, lambda: polling_ticks, normalize_timeout(timeout)):
            raise DaqError(
                f"the task was not started or triggered within {timeout:g} s. Start it, or check its trigger.",
                Code.SAMPLES_NOT_YET_AVAILABLE,
            )
        event_tick = tick()
        assert event_tick is not None
        return task.chassis.time_ns(event_tick)


def full_terminal(task: Task, name: str) -> str:
    """Return NI's full name of a terminal, such as "/cDAQ1/PFI0", or ""; raise `DaqError` -89120 if there is none."""
    if not name or name.startswith("/"):
        return name
    if "/" in name and not name.startswith(("ai/", "ao/")):
        task.chassis.devices.module(name)
        return f"/{name}"
    if not _TERMINAL.fullmatch(name):
        raise DaqError(
            f"{name!r} is not a terminal. Give a name such as PFI0 or /cDAQ1/ai/SampleClock.",
            Code.INVALID_ROUTING_SOURCE_TERMINAL_NAME_ROUTING,
        )
    # The terminals of a module are those of its chassis.
    chassis = task.settings.channels[0].module.chassis if task.settings.channels else ""
    return f"/{chassis or task.settings.device}/{name}"


def _counter(query: str, value: Callable[[Task], int]) -> Callable[[Task], int]:
    """Return a function that returns a count of samples and notes the query; see `Task.note_query`."""

    def read_count(task: Task) -> int:
        task.note_query(query)
        return value(task)

    return read_count


def _seconds_of(task: Task, event: TimestampEvent) -> float:
    """Return the time of an event of the task [s]; wait for the event up to 10 s."""
    return time_of(task, event, 10.0) * 1e-9


def _of_input_run(task: Task, value: Callable[[Any], int]) -> int:
    """Return a value of the current or last acquisition; 0 before the first acquisition."""
    return 0 if task.input.run is None else value(task.input.run)


def _module(task: Task) -> Module:
    """Return the module that provides the sample clock. Raises `DaqError` -200478 if the task has no channels."""
    if not task.settings.channels:
        raise DaqError("the task has no channels. Add a channel first.", Code.CAN_NOT_PERFORM_OP_WHEN_NO_CHANS_IN_TASK)
    return task.settings.clock_modules[0]


def _timebase(task: Task) -> float:
    """Return the frequency of the clock that the sample clock divides [Hz]."""
    return _module(task).timebase_of(output=task.settings.direction == "ao")


def _trigger_source(task: Task, name: str) -> str:
    """Return the source of a trigger, the setting `name`: the name of a channel, or the full name of a terminal."""
    source = str(task.settings.groups["trig"][name])
    channel_names = {name.lower() for channel in task.settings.channels for name in (channel.name, channel.port.name)}
    return source if source.lower() in channel_names else full_terminal(task, source)


# Properties that are computed when a script reads them, by group and NI's name.
_COMPUTED: dict[tuple[str, str], Callable[[Task], Any]] = {
    ("timing", "samp_clk_rate"): lambda task: task.settings.rate,
    ("timing", "samp_clk_max_rate"): lambda task: task.settings.max_rate,
    ("timing", "samp_clk_src"): lambda task: full_terminal(
        task, task.settings.groups["timing"]["samp_clk_src"] or f"{task.settings.direction}/SampleClockTimebase"
    ),
    ("timing", "samp_clk_term"): lambda task: full_terminal(task, f"{task.settings.direction}/SampleClock"),
    ("timing", "samp_quant_samp_per_chan"): lambda task: task.settings.samples_per_channel,
    ("timing", "samp_clk_timebase_div"): lambda task: round(_timebase(task) / task.settings.rate),
    ("timing", "samp_clk_timebase_rate"): lambda task: _timebase(task),
    ("timing", "first_samp_timestamp_val"): partial(_seconds_of, event=TimestampEvent.FIRST_SAMPLE),
    ("trig", "start_trig_timestamp_val"): partial(_seconds_of, event=TimestampEvent.START_TRIGGER),
    ("trig", "ref_trig_timestamp_val"): partial(_seconds_of, event=TimestampEvent.REFERENCE_TRIGGER),
    ("trig", "start_trig_term"): lambda task: full_terminal(task, f"{task.settings.direction}/StartTrigger"),
    ("trig", "ref_trig_term"): lambda task: full_terminal(task, f"{task.settings.direction}/ReferenceTrigger"),
    ("buffer", "input_buf_size"): lambda task: task.settings.input_buffer_size,
    ("buffer", "output_buf_size"): lambda task: task.output.size,
    # Constant, in samples: the emulated modules have no buffers of their own.
    ("buffer", "input_onbrd_buf_size"): lambda task: 4095,
    ("buffer", "output_onbrd_buf_size"): lambda task: 8191,
    ("read", "num_chans"): lambda task: len(task.settings.indices_to_read()),
    ("read", "raw_data_width"): lambda task: 4 * len(task.settings.indices_to_read()),
    ("read", "avail_samp_per_chan"): _counter(
        "available", lambda task: _of_input_run(task, lambda run: max(0, run.readable_end - run.position))
    ),
    ("read", "total_samp_per_chan_acquired"): _counter("acquired", lambda task: task.input.samples_passed),
    ("read", "curr_read_pos"): lambda task: _of_input_run(task, lambda run: run.position),
    ("read", "default_number_of_samples"): lambda task: task.default_count(),
    ("read", "overloaded_chans_exist"): lambda task: task.input.overloaded_exist(),
    ("read", "overloaded_chans"): lambda task: task.input.overloaded(),
    ("write", "num_chans"): lambda task: len(task.settings.channels),
    ("write", "space_avail"): _counter("space", lambda task: task.output.space),
    ("write", "curr_write_pos"): lambda task: task.output.written,
    ("write", "total_samp_per_chan_generated"): _counter("generated", lambda task: task.output.samples_passed),
    **{
        ("trig", name): partial(_trigger_source, name=name)
        for trigger_type in ("anlg_edge", "anlg_win", "dig_edge")
        for name in (f"{trigger_type}_start_trig_src", f"{trigger_type}_ref_trig_src")
    },
}
