"""Handlers of the calls that create channels."""

from __future__ import annotations

from typing import Any

from daq.instrument.devices.measurements import Measurement
from daq.instrument.devices.names import numbered, parse_port, unflatten
from daq.instrument.devices.teds import sensitivity
from daq.instrument.errors import Code, DaqError
from daq.server.calls.call import Call, Handler, plain_value


def create_input(kind: Measurement, teds: bool) -> Handler:
    """Return the handler that creates inputs; with `teds`, electronic data sheets of sensors give the sensitivities."""

    def create(call: Call) -> None:
        call.task.check_idle("adding channels")
        arguments = {key: plain_value(value) for key, value in call.fields.items() if key != "task"}
        physical, name = arguments.pop("physical_channel"), arguments.pop("name_to_assign_to_channel")
        settings = kind.settings(arguments)
        if not teds:
            call.task.settings.add(physical, name, kind, settings)
            return
        terminals = unflatten(physical)
        names = numbered(name, len(terminals)) if name else [""] * len(terminals)
        for terminal, virtual in zip(terminals, names, strict=True):
            sensor_settings = _settings_of_sensor(call, terminal, kind)
            call.task.settings.add(terminal, virtual, kind, settings | sensor_settings | {"ai_is_teds": True})

    return create


def _settings_of_sensor(call: Call, physical: str, kind: Measurement) -> dict[str, Any]:
    """Return the settings of a channel from the electronic data sheet (TEDS) of its sensor.

    Raises `DaqError` -200709 for a sensor without TEDS, -200826 for a sensor of another kind.
    """
    port = parse_port(physical)
    volts = sensitivity(call.instrument.teds.sheet(port))
    if volts is None or not kind.sensitivity:
        raise DaqError(
            f"{port.name}: the electronic data sheet states no sensitivity of this measurement. Choose another kind.",
            Code.TEDS_SENSOR_DATA_ERROR,
        )
    return kind.sensitivity_settings(volts)


def _create_output(call: Call) -> None:
    fields = call.fields
    call.task.check_idle("adding channels")
    settings = {
        "ao_min": fields["min_val"],
        "ao_max": fields["max_val"],
        "ao_voltage_units": fields["units"],
        "ao_custom_scale_name": fields["custom_scale_name"],
    }
    call.task.settings.add(fields["physical_channel"], fields["name_to_assign_to_channel"], None, settings)


def _add_saved_channels(call: Call) -> None:
    """Add copies of saved channels to a task."""
    call.task.check_idle("adding channels")
    saved = [call.instrument.storage.channel(name) for name in unflatten(call.fields["channel_names"])]
    call.task.settings.channels += saved


CALLS: dict[str, Handler] = {"AddGlobalChansToTask": _add_saved_channels, "CreateAOVoltageChan": _create_output}
