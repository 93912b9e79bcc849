"""Handlers of the calls that configure timing, triggers, buffers and logging of tasks, scales, and saved tasks."""

from daq.extras.ni_device.errors import invalid_value, unsupported
from daq.extras.ni_device.settings.scales import LINEAR, MAP_RANGES, POLYNOMIAL, TABLE, Scale, reverse_polynomial
from daq.extras.ni_device.task_properties import get_value, set_value, set_values, time_of
from daq.extras.ni_device.values import Signal, TimestampEvent, TimingType, TriggerType, enum_member
from daq.extras.ni_server.calls.call import Call, Handler, ResponseFields, plain_value, task_action

# Types of triggers that calls configure, by the prefix of their settings in NI's driver.
_TRIGGER_TYPES = {
    "anlg_edge": TriggerType.ANALOG_EDGE,
    "anlg_win": TriggerType.ANALOG_WINDOW,
    "anlg_multi_edge": TriggerType.ANALOG_MULTI_EDGE,
    "dig_edge": TriggerType.DIGITAL_EDGE,
}


def _trigger(role: str, prefix: str, **names: str) -> Handler:
    """Return the handler that configures a start or reference trigger (`role`); `names`: setting suffixes by field."""

    def configure(call: Call) -> None:
        settings = {
            f"{prefix}_{role}_trig_{key}": plain_value(call.fields[field_name]) for field_name, key in names.items()
        }
        if "pretrigger_samples" in call.fields:
            settings["ref_trig_pretrig_samples"] = call.fields["pretrigger_samples"]
        set_values(call.task, "trig", **settings, **{f"{role}_trig_type": _TRIGGER_TYPES[prefix]})

    return configure


def _triggers(role: str) -> dict[str, Handler]:
    """Return the handlers of the calls that configure the start trigger ("start") or the reference trigger ("ref")."""
    name = role.capitalize()
    source = {"trigger_source": "src"}
    edge = {"trigger_slope": "slope", "trigger_level": "lvl"}
    window = {"trigger_when": "when", "window_top": "top", "window_bottom": "btm"}
    multi_edge = {"trigger_sources": "srcs", "trigger_slope_array": "slopes", "trigger_level_array": "lvls"}
    return {
        f"CfgAnlgEdge{name}Trig": _trigger(role, "anlg_edge", **source, **edge),
        f"CfgAnlgWindow{name}Trig": _trigger(role, "anlg_win", **source, **window),
        f"CfgAnlgMultiEdge{name}Trig": _trigger(role, "anlg_multi_edge", **multi_edge),
        f"CfgDigEdge{name}Trig": _trigger(role, "dig_edge", **source, trigger_edge="edge"),
        f"Disable{name}Trig": task_action(
            lambda task, fields: set_value(task, "trig", f"{role}_trig_type", TriggerType.NONE)
        ),
    }


def _export_signal(call: Call) -> None:
    names = {
        Signal.SAMPLE_CLOCK: "samp_clk_output_term",
        Signal.START_TRIGGER: "start_trig_output_term",
        Signal.REFERENCE_TRIGGER: "ref_trig_output_term",
    }
    if call.fields["signal_id"] not in names:
        raise unsupported(f"exporting signal {call.fields['signal_id']}")
    set_value(call.task, "exported_signal", names[call.fields["signal_id"]], call.fields["output_terminal"])


def _timestamp(event: TimestampEvent | None) -> Handler:
    """Return the handler that waits for an event (None: the event in the call) and returns its time."""

    def get_time(call: Call) -> ResponseFields:
        requested_event = event
        if requested_event is None:
            requested_event = enum_member(TimestampEvent, call.fields["timestamp_event"], "timestamp_event")
        seconds = time_of(call.task, requested_event, call.fields.get("timeout", 0.0)) * 1e-9
        return {"data" if event is not None else "timestamp": seconds}

    return get_time


def _create_scale(scale_type: int, *names: tuple[str, str]) -> Handler:
    """Return the handler that creates a custom scale; `names` are pairs: field of the call, parameter of the scale."""

    def create(call: Call) -> None:
        fields = call.fields
        settings = {key: plain_value(fields[name]) for name, key in names}
        units = {key: fields[key] for key in ("pre_scaled_units", "scaled_units")}
        storage = call.instrument.storage
        storage.store(storage.scales, fields["name"], Scale(scale_type, settings | units))

    return create


def _reverse_polynomial(call: Call) -> ResponseFields:
    """Return the coefficients of an inverse polynomial; see `reverse_polynomial`."""
    fields = call.fields
    names = ("forward_coeffs", "min_val_x", "max_val_x", "num_points_to_compute", "reverse_poly_order")
    return {"reverse_coeffs": reverse_polynomial(*(plain_value(fields[name]) for name in names))}


def _save_task(call: Call) -> None:
    name = call.fields["save_as"] or call.task.name
    call.instrument.storage.save_task(call.task.settings, name, call.fields["author"])


def _save_channel(call: Call) -> None:
    channels = call.task.settings.find(call.fields["channel_name"])
    if not channels:
        raise invalid_value("the task has no channel to save. Add a channel, and save it by its name.")
    name = call.fields["save_as"] or channels[0].name
    call.instrument.storage.save_channel(channels[0], name, call.fields["author"])


def _save_scale(call: Call) -> None:
    storage, fields = call.instrument.storage, call.fields
    name = fields["save_as"] or fields["scale_name"]
    storage.store(storage.scales, name, storage.scale(fields["scale_name"]))
    storage.authors[name] = fields["author"]


def _delete(group: str, field_name: str) -> Handler:
    """Return the handler that deletes a saved item; `group` is the attribute of `Storage` with such items."""

    def delete(call: Call) -> None:
        storage, name = call.instrument.storage, call.fields[field_name]
        getattr(storage, group).pop(name, None)
        storage.authors.pop(name, None)

    return delete


CALLS: dict[str, Handler] = {
    "CfgSampClkTiming": task_action(
        lambda task, fields: set_values(
            task,
            "timing",
            samp_clk_rate=fields["rate"],
            samp_clk_src=fields["source"],
            samp_clk_active_edge=fields["active_edge"],
            samp_quant_samp_mode=fields["sample_mode"],
            samp_quant_samp_per_chan=fields["samps_per_chan"],
            samp_timing_type=TimingType.SAMPLE_CLOCK,
        )
    ),
    **_triggers("start"),
    **_triggers("ref"),
    "CfgTimeStartTrig": task_action(
        lambda task, fields: set_values(
            task,
            "trig",
            start_trig_type=TriggerType.TIME,
            start_trig_trig_when=fields["when"],
            start_trig_timescale=fields["timescale"],
        )
    ),
    "GetStartTrigTrigWhen": lambda call: {"data": get_value(call.task, "trig", "start_trig_trig_when")},
    "SetStartTrigTrigWhen": task_action(
        lambda task, fields: set_value(task, "trig", "start_trig_trig_when", fields["data"])
    ),
    "GetStartTrigTimestampVal": _timestamp(TimestampEvent.START_TRIGGER),
    "GetRefTrigTimestampVal": _timestamp(TimestampEvent.REFERENCE_TRIGGER),
    "GetFirstSampTimestampVal": _timestamp(TimestampEvent.FIRST_SAMPLE),
    "WaitForValidTimestamp": _timestamp(None),
    "ExportSignal": _export_signal,
    "CfgInputBuffer": task_action(
        lambda task, fields: set_value(task, "buffer", "input_buf_size", fields["num_samps_per_chan"])
    ),
    "CfgOutputBuffer": task_action(
        lambda task, fields: set_value(task, "buffer", "output_buf_size", fields["num_samps_per_chan"])
    ),
    "ConfigureLogging": task_action(
        lambda task, fields: set_values(
            task,
            "read",
            logging_file_path=fields["file_path"],
            logging_mode=fields["logging_mode"],
            logging_tdms_group_name=fields["group_name"],
            logging_tdms_operation=fields["operation"],
        )
    ),
    "StartNewFile": task_action(lambda task, fields: task.start_new_file(fields["file_path"])),
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
    "CalculateReversePolyCoeff": _reverse_polynomial,
    "SaveTask": _save_task,
    "SaveGlobalChan": _save_channel,
    "SaveScale": _save_scale,
    "DeleteSavedTask": _delete("tasks", "task_name"),
    "DeleteSavedGlobalChan": _delete("channels", "channel_name"),
    "DeleteSavedScale": _delete("scales", "scale_name"),
}
