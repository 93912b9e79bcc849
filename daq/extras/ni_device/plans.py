"""Plan of an acquisition (inputs) or generation (outputs), from the checked settings of a task.

A plan has all settings of a run, including its triggers.
"""

import re
from typing import Any

import numpy as np

from daq.core.virtual_bench.bench import Bench, samples_per_tick
from daq.extras.ni_device.chassis import Chassis
from daq.extras.ni_device.devices.names import unflatten
from daq.extras.ni_device.engines.acquisition import InputPlan
from daq.extras.ni_device.engines.generation import OutputPlan
from daq.extras.ni_device.engines.triggers import (
    AnalogSource,
    AtTime,
    Condition,
    OtherTask,
    Pulses,
    Source,
    edge,
    window,
)
from daq.extras.ni_device.errors import Code, DaqError, invalid_value, unsupported
from daq.extras.ni_device.settings.task_settings import TaskSettings
from daq.extras.ni_device.values import Overwrite, Slope, TriggerType, WindowCondition, enum_member

# Names of the bench's own sample clock as a source, among them the empty string.
_OWN_CLOCK = re.compile(r"|OnboardClock|.*/OnboardClock|/?([^/]+/)?(a[io]/)?SampleClock(Timebase)?", re.IGNORECASE)

# Sample clock of the inputs of a device.
_INPUT_CLOCK = re.compile(r"/?(?:([^/]+)/)?ai/SampleClock", re.IGNORECASE)
# Terminals with a digital signal: device and signal.
_SIGNAL = re.compile(r"/?(?:([^/]+)/)?(PFI\d+|a[io]/StartTrigger|ai/ReferenceTrigger)", re.IGNORECASE)


def check_timing(task: TaskSettings) -> None:
    """Check that the settings of channels and timing are complete and consistent.

    Raises `DaqError` -201087 for channels that require a sample clock, -89136 for a clock that does not exist, -200081
    for a rate that is too high for the number of channels, -200077 for invalid rates and numbers of samples, -89121 for
    a signal that is exported to an invalid terminal, and the errors of `Channel.check_complete`.
    """
    timing = task.groups["timing"]
    for direction, attribute, problem in (
        ("ai", "on_demand", "cannot be read without a sample clock"),
        ("ao", "output_on_demand", "cannot be written without a sample clock"),
    ):
        if (
            task.direction == direction
            and not task.has_sample_clock
            and not all(getattr(channel.module, attribute) for channel in task.channels)
        ):
            raise DaqError(
                f"{task.channels[0].module.product_type} {problem}. Call timing.cfg_samp_clk_timing first.",
                Code.SAMP_CLK_RATE_MUST_BE_SPECD,
            )
    for channel in task.channels:
        channel.check_complete()
    if task.has_sample_clock:
        if not _OWN_CLOCK.fullmatch(timing["samp_clk_src"]):
            raise DaqError(
                f"sample clock source {timing['samp_clk_src']!r}: the bench has only one sample clock. Leave the "
                "source empty, or give OnboardClock or another task's ai/SampleClock.",
                Code.ROUTE_NOT_SUPPORTED_BY_HW_ROUTING,
            )
        rates = {
            channel.module: channel.module.coerced_rate(timing["samp_clk_rate"], task.direction == "ao")
            for channel in task.channels
        }
        clock_rates = {rates[module] for module in task.clock_modules}
        if len(clock_rates) > 1:
            raise invalid_value(
                f"the task's modules coerce {timing['samp_clk_rate']:g} S/s to different rates, "
                f"{', '.join(f'{rate:g}' for rate in sorted(clock_rates))} S/s. Use several tasks, or a rate "
                "that all modules support."
            )
        if task.direction == "ai" and task.rate > task.max_rate * (1 + 1e-6):
            modules = [channel.module for channel in task.channels]
            slowest = min(modules, key=lambda module: module.max_rate(modules.count(module), output=False))
            raise DaqError(
                f"the converter of {slowest.name} converts one channel after the other, at {task.max_rate:g} S/s at "
                f"most with {modules.count(slowest)} channels; {timing['samp_clk_rate']:g} S/s were requested. "
                "Reduce the sample rate or the number of channels.",
                Code.SAMPLE_RATE_NUM_CHANS_CONVERT_PERIOD_COMBO,
            )
        _ = task.samples_per_channel  # The property raises an error for fewer than 2 samples.
        if task.direction == "ai" and task.input_buffer_size < 1:
            raise invalid_value("in_stream.input_buf_size is 0. Give 1 or more samples.")
    for name in ("start_trig_output_term", "ref_trig_output_term", "samp_clk_output_term"):
        terminal = task.groups["exported_signal"][name]
        if terminal and not re.fullmatch(r"(/?[^/]+/)?PFI\d+", terminal, re.IGNORECASE):
            raise DaqError(
                f"{name} {terminal!r} is not a terminal for exported signals. Give a name such as /cDAQ1/PFI0.",
                Code.INVALID_ROUTING_DESTINATION_TERMINAL_NAME_ROUTING,
            )


def trigger_sources(task: TaskSettings, chassis: Chassis) -> tuple[Source | None, Source | None]:
    """Return the sources of the start trigger and of the reference trigger; None for an absent trigger.

    Raises `DaqError` -200262 for a trigger without a sample clock, -200358 for a reference trigger of a continuous
    task, -200213 for more pretrigger samples than the record has, -200265 for a source that does not exist.
    """
    settings = task.groups["trig"]
    types = [settings[f"{name}_trig_type"] for name in ("start", "ref")]
    if any(trigger_type != TriggerType.NONE for trigger_type in types) and not task.has_sample_clock:
        raise DaqError(
            "a trigger requires a sample clock. Call timing.cfg_samp_clk_timing.", Code.TRIG_WHEN_ON_DEMAND_SAMP_TIMING
        )
    for name in ("start", "ref"):
        if settings[f"{name}_trig_delay"]:
            raise unsupported(f"a delay of the {name} trigger")
    start, reference = _trigger_source(task, "start", chassis), _trigger_source(task, "ref", chassis)
    if reference is None:
        return start, reference
    pretrigger, samples = settings["ref_trig_pretrig_samples"], task.samples_per_channel
    if not task.is_finite or task.direction == "ao":
        raise DaqError(
            "a reference trigger requires a finite acquisition. Use AcquisitionType.FINITE; samps_per_chan is the "
            "total number of samples before and after the trigger.",
            Code.REF_TRIG_WHEN_CONTINUOUS,
        )
    if not 0 <= pretrigger < samples:
        raise DaqError(
            f"pretrigger_samples: got {pretrigger}; expected 0 to {samples - 1}, because at least one of the {samples} "
            "samples must follow the trigger.",
            Code.TOO_MANY_PRETRIG_PLUS_MIN_POST_TRIG_SAMPS,
        )
    return start, reference


def _trigger_source(task: TaskSettings, role: str, chassis: Chassis) -> Source | None:
    """Return the source of the start trigger (`role` "start") or reference trigger ("ref"); None without a trigger."""
    settings = task.groups["trig"]
    trigger_type = settings[f"{role}_trig_type"]

    def setting(key: str) -> Any:
        return settings[f"{prefix}_{role}_trig_{key}"]

    def condition_on_channel(source: str, condition: Condition) -> tuple[int, Condition]:
        terminal = source.lower().lstrip("/")
        for index, channel in enumerate(task.channels):
            if terminal in (channel.name.lower(), channel.port.name.lower()):
                return index, condition
        names = ", ".join(channel.name for channel in task.channels)
        remedy = f"Give one of {names}." if names else "Add an input channel first."
        raise DaqError(
            f"analog trigger source {source!r} is not an input channel of the task. {remedy}",
            Code.INVALID_ANALOG_TRIG_SRC,
        )

    if trigger_type == TriggerType.NONE:
        return None
    if trigger_type == TriggerType.TIME:
        start_delay_s = settings["start_trig_trig_when"] - chassis.time_ns(chassis.position) * 1e-9
        return AtTime(chassis.elapsed + max(0.0, start_delay_s))
    if trigger_type == TriggerType.DIGITAL_EDGE:
        prefix = "dig_edge"
        return _digital_source(setting("src"), Slope(setting("edge")), task, chassis)
    if without := next((channel.module for channel in task.channels if not channel.module.analog_trigger), None):
        raise invalid_value(
            f"{without.product_type} has no analog trigger. Choose a digital trigger, or search the samples."
        )
    if trigger_type == TriggerType.ANALOG_EDGE:
        prefix = "anlg_edge"
        return AnalogSource(
            (condition_on_channel(setting("src"), edge(Slope(setting("slope")), setting("lvl"), setting("hyst"))),)
        )
    if trigger_type == TriggerType.ANALOG_WINDOW:
        prefix = "anlg_win"
        condition = window(WindowCondition(setting("when")), setting("btm"), setting("top"))
        return AnalogSource((condition_on_channel(setting("src"), condition),))
    if trigger_type == TriggerType.ANALOG_MULTI_EDGE:
        prefix = "anlg_multi_edge"
        names, slopes, levels = unflatten(setting("srcs")), setting("slopes"), setting("lvls")
        if not len(names) == len(slopes) == len(levels):
            raise DaqError(
                f"the trigger has {len(names)} sources, {len(slopes)} slopes and {len(levels)} levels. Give the "
                "same number of each.",
                Code.MISMATCHED_INPUT_ARRAY_SIZES,
            )
        conditions = [
            edge(enum_member(Slope, slope, "trigger_slope"), level) for slope, level in zip(slopes, levels, strict=True)
        ]
        return AnalogSource(tuple(map(condition_on_channel, names, conditions)))
    raise unsupported(f"a {role} trigger of type {trigger_type}")


def _digital_source(source: str, slope: Slope, task: TaskSettings, chassis: Chassis) -> Pulses | OtherTask:
    """Return the trigger at a terminal such as /cDAQ1/PFI0. Raises `DaqError` -89136 for an unknown terminal."""
    match = _SIGNAL.fullmatch(source.strip())
    if not match:
        raise DaqError(
            f"terminal {source!r} has no trigger signal. Give /Dev1/PFI0, /Dev1/ai/StartTrigger, /Dev1/ao/StartTrigger "
            "or /Dev1/ai/ReferenceTrigger.",
            Code.ROUTE_NOT_SUPPORTED_BY_HW_ROUTING,
        )
    owner, signal = chassis.terminal_owner(chassis.devices.module(match[1] or task.device)), match[2].lower()
    if signal.startswith("pfi"):
        return Pulses(slope, chassis.terminals.pulse_frequency(owner, signal), source)
    return OtherTask(owner, signal[:2], signal.endswith("referencetrigger"))


def input_plan(
    task: TaskSettings, bench: Bench, start: Source | None, reference: Source | None, on_demand: int | None = None
) -> InputPlan:
    """Return the plan of an acquisition with its triggers, or of `on_demand` samples without the task's clock."""
    samples, buffer_size, rate = on_demand, on_demand or 1, bench.rate
    if on_demand is None:
        samples = task.samples_per_channel if task.is_finite else None
        buffer_size, rate = task.input_buffer_size, task.rate
    volts_per_count = [bench.channels[channel.bench_index].volts_per_count or 1.0 for channel in task.channels]
    return InputPlan(
        bench_indices=tuple(channel.bench_index for channel in task.channels),
        factors=np.array(volts_per_count) / [channel.volts_per_unit for channel in task.channels],
        scales=tuple(task.scale_of(channel) for channel in task.channels),
        rate=rate,
        samples=samples,
        buffer_size=max(buffer_size, samples or 0) if reference is not None else buffer_size,
        stops_when_full=task.groups["read"]["overwrite"] == Overwrite.NOT_ALLOWED,
        start=start,
        reference=reference,
        pretrigger=task.groups["trig"]["ref_trig_pretrig_samples"] if reference is not None else 0,
        is_retriggerable=bool(
            task.groups["trig"]["start_trig_retriggerable"] and start is not None and samples is not None
        ),
    )


def output_plan(task: TaskSettings, chassis: Chassis, start: Source | None) -> tuple[OutputPlan, OtherTask | None]:
    """Return the plan of a generation, and the start of the task whose sample clock it uses, if any.

    An output on the sample clock of the inputs of a device starts with these inputs, and has their coerced rate.
    """
    if isinstance(start, AnalogSource):
        raise unsupported("an analog start trigger of an output", "Start the output by ai/StartTrigger.")
    clock_task, rate = None, task.rate
    clock_source = _INPUT_CLOCK.fullmatch(task.groups["timing"]["samp_clk_src"])
    if clock_source:
        device = chassis.devices.module(clock_source[1] or task.device)
        clock = OtherTask(chassis.terminal_owner(device), "ai", reference=False)
        input_rates = [
            other.sample_rate
            for other in chassis.tasks.values()
            if other.sample_rate is not None and other.provides(clock)
        ]
        rate = min(input_rates, key=lambda input_rate: abs(input_rate - rate), default=rate)
        if start is None:
            start = clock_task = clock
    plan = OutputPlan(
        bench_indices=tuple(channel.bench_index for channel in task.channels),
        tick_rate=chassis.rate,
        per_tick=samples_per_tick(rate, chassis.rate),
        samples=task.samples_per_channel if task.is_finite else None,
        regenerates=task.regenerates,
        start=start,
    )
    return plan, clock_task
