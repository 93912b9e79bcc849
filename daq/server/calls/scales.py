"""Calls about custom scales, and about saved tasks, channels and scales."""

from __future__ import annotations

from collections.abc import Callable

from daq.instrument.errors import bad
from daq.instrument.settings.scales import LINEAR, MAP_RANGES, POLYNOMIAL, TABLE, Scale, reverse_polynomial
from daq.server.calls.call import Answer, Call, plain


def _create_scale(kind: int, *names: tuple[str, str]) -> Callable[[Call], Answer]:
    def create(call: Call) -> Answer:
        given = call.fields
        settings = {key: plain(given[name]) for name, key in names}
        common = {key: given[key] for key in ("pre_scaled_units", "scaled_units")}
        storage = call.instrument.storage
        storage.store(storage.scales, given["name"], Scale(kind, settings | common))
        return {}

    return create


def _reverse(call: Call) -> Answer:
    given = call.fields
    order = ("forward_coeffs", "min_val_x", "max_val_x", "num_points_to_compute", "reverse_poly_order")
    return {"reverse_coeffs": reverse_polynomial(*(plain(given[name]) for name in order))}


def _save_task(call: Call) -> Answer:
    task = call.task
    call.instrument.storage.save_task(
        task.settings, call.fields["save_as"] or task.name, call.fields["author"]
    )
    return {}


def _save_channel(call: Call) -> Answer:
    found = call.task.settings.find(call.fields["channel_name"])
    if not found:
        raise bad("there is no channel to save: add one, and name it")
    channel = found[0]
    name = call.fields["save_as"] or channel.name
    call.instrument.storage.save_channel(channel, name, call.fields["author"])
    return {}


def _save_scale(call: Call) -> Answer:
    storage, given = call.instrument.storage, call.fields
    name = given["save_as"] or given["scale_name"]
    storage.store(storage.scales, name, storage.scale(given["scale_name"]))
    storage.authors[name] = given["author"]
    return {}


def _forget(kept: str, field_name: str) -> Callable[[Call], Answer]:
    def forget(call: Call) -> Answer:
        for each in (getattr(call.instrument.storage, kept), call.instrument.storage.authors):
            each.pop(call.fields[field_name], None)
        return {}

    return forget


CALLS: dict[str, Callable[[Call], Answer]] = {
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
}
