"""Calls about timing, triggers, buffers and logs of a task."""

from __future__ import annotations

from collections.abc import Callable

from daq.instrument.errors import unsupported
from daq.instrument.task_properties import get_value, set_value, set_values, time_of
from daq.instrument.values import Signal, TimestampEvent, TimingType, TriggerType, named
from daq.server.calls.call import Answer, Call, does, plain


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
    """Return the handler that configures a trigger; `names` maps fields to settings."""
    prefix = {
        TriggerType.ANALOG_EDGE: "anlg_edge",
        TriggerType.ANALOG_WINDOW: "anlg_win",
        TriggerType.ANALOG_MULTI_EDGE: "anlg_multi_edge",
        TriggerType.DIGITAL_EDGE: "dig_edge",
        TriggerType.DIGITAL_PATTERN: "dig_pattern",
    }[kind]

    def configure(call: Call) -> Answer:
        settings = {
            f"{prefix}_{which}_trig_{key}": plain(call.fields[field_name])
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
        chosen = (
            event
            if event is not None
            else named(TimestampEvent, call.fields["timestamp_event"], "timestamp_event")
        )
        seconds = time_of(call.task, chosen, call.fields.get("timeout", 0.0)) * 1e-9
        return {"data" if event is not None else "timestamp": seconds}

    return ask


CALLS: dict[str, Callable[[Call], Answer]] = {
    "CfgSampClkTiming": _sample_clock,
    **_triggers("start"),
    **_triggers("ref"),
    "CfgTimeStartTrig": _start_at,
    "GetStartTrigTrigWhen": lambda call: {"data": get_value(call.task, "trig", "start_trig_trig_when")},
    "SetStartTrigTrigWhen": does(
        lambda task, given: set_value(task, "trig", "start_trig_trig_when", given["data"])
    ),
    "GetStartTrigTimestampVal": _timestamp(TimestampEvent.START_TRIGGER),
    "GetRefTrigTimestampVal": _timestamp(TimestampEvent.REFERENCE_TRIGGER),
    "GetFirstSampTimestampVal": _timestamp(TimestampEvent.FIRST_SAMPLE),
    "WaitForValidTimestamp": _timestamp(None),
    "ExportSignal": _export_signal,
    "CfgInputBuffer": does(
        lambda task, given: set_value(task, "buffer", "input_buf_size", given["num_samps_per_chan"])
    ),
    "CfgOutputBuffer": does(
        lambda task, given: set_value(task, "buffer", "output_buf_size", given["num_samps_per_chan"])
    ),
    "ConfigureLogging": does(
        lambda task, given: set_values(
            task,
            "read",
            logging_file_path=given["file_path"],
            logging_mode=given["logging_mode"],
            logging_tdms_group_name=given["group_name"],
            logging_tdms_operation=given["operation"],
        )
    ),
    "StartNewFile": does(lambda task, given: task.start_new_file(given["file_path"])),
}
