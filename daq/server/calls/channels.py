"""Calls that create channels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from daq.instrument.devices.measurements import Measurement, measurement
from daq.instrument.devices.names import numbered, parse_port, unflatten
from daq.instrument.devices.teds import sensitivity
from daq.instrument.errors import Code, DaqError
from daq.server.calls.call import Answer, Call, plain


def create_input(kind: str) -> Callable[[Call], Answer]:
    """Return the handler that creates inputs of a kind, by its name in the driver's calls."""
    chosen, implied = measurement(kind)

    def create(call: Call) -> Answer:
        physical, name, settings = _declared(call, chosen)
        call.task.settings.add(physical, name, chosen, settings | implied)
        return {}

    return create


def create_teds_input(kind: str) -> Callable[[Call], Answer]:
    """Return the handler that creates inputs of a kind with the settings of the sensors' TEDS."""
    chosen, implied = measurement(kind)

    def create(call: Call) -> Answer:
        physical, name, settings = _declared(call, chosen)
        terminals = unflatten(physical)
        names = numbered(name, len(terminals)) if name else [""] * len(terminals)
        for each, virtual in zip(terminals, names, strict=True):
            own = settings | implied | _settings_of_sensor(call, each, chosen) | {"ai_is_teds": True}
            call.task.settings.add(each, virtual, chosen, own)
        return {}

    return create


def _declared(call: Call, kind: Measurement) -> tuple[str, str, dict[str, Any]]:
    """Return the terminals, the name and the settings in a call that creates inputs."""
    call.task.check_idle("adding channels")
    given = {key: plain(value) for key, value in call.fields.items() if key != "task"}
    physical, name = given.pop("physical_channel"), given.pop("name_to_assign_to_channel")
    return physical, name, kind.settings(given)


def _settings_of_sensor(call: Call, physical: str, kind: Measurement) -> dict[str, Any]:
    """Return the settings of a channel from its sensor's TEDS.

    Raises `DaqError` with -200709 for a sensor without TEDS, -200826 for a sensor of another kind.
    """
    port = parse_port(physical)
    volts = sensitivity(call.instrument.teds.sheet(port))
    if volts is None or not kind.sensitivity:
        raise DaqError(
            f"{port.name}: the electronic data sheet there states no sensitivity of such a sensor",
            Code.TEDS_SENSOR_DATA_ERROR,
        )
    return kind.sensitivity_settings(volts)


def _create_output(call: Call) -> Answer:
    given = call.fields
    call.task.check_idle("adding channels")
    settings = {
        "ao_min": given["min_val"],
        "ao_max": given["max_val"],
        "ao_voltage_units": given["units"],
        "ao_custom_scale_name": given["custom_scale_name"],
    }
    call.task.settings.add(given["physical_channel"], given["name_to_assign_to_channel"], None, settings)
    return {}


def _add_saved_channels(call: Call) -> Answer:
    task = call.task
    task.check_idle("adding channels")
    for name in unflatten(call.fields["channel_names"]):
        task.settings.channels.append(call.instrument.storage.channel(name))
    return {}


CALLS: dict[str, Callable[[Call], Answer]] = {
    "AddGlobalChansToTask": _add_saved_channels,
    "CreateAOVoltageChan": _create_output,
}
