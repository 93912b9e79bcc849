"""Handlers of the calls that create channels. A TEDS is the electronic data sheet in a sensor (IEEE 1451.4)."""

from typing import Any

from daq.extras.ni_device.devices.measurements import Measurement
from daq.extras.ni_device.devices.names import numbered, parse_port, unflatten
from daq.extras.ni_device.devices.teds import sensitivity
from daq.extras.ni_device.errors import Code, DaqError
from daq.extras.ni_server.calls.call import Call, Handler, plain_value


def create_input(measurement: Measurement, has_teds: bool) -> Handler:
    """Return the handler that creates inputs; with `has_teds`, the sensitivities are from the sensors' TEDS."""

    def create(call: Call) -> None:
        call.task.check_idle("adding channels")
        arguments = {key: plain_value(value) for key, value in call.fields.items() if key != "task"}
        physical_channels, name = arguments.pop("physical_channel"), arguments.pop("name_to_assign_to_channel")
        settings = measurement.settings(arguments)
        if not has_teds:
            call.task.settings.add(physical_channels, name, measurement, settings)
            return
        terminals = unflatten(physical_channels)
        names = numbered(name, len(terminals)) if name else [""] * len(terminals)
        for terminal, virtual_name in zip(terminals, names, strict=True):
            sensor_settings = _settings_of_sensor(call, terminal, measurement)
            call.task.settings.add(
                terminal, virtual_name, measurement, settings | sensor_settings | {"ai_is_teds": True}
            )

    return create


def _settings_of_sensor(call: Call, terminal: str, measurement: Measurement) -> dict[str, Any]:
    """Return settings from a sensor's TEDS; `DaqError` -200709 without TEDS, -200826 without a suitable sensitivity."""
    port = parse_port(terminal)
    volts_per_unit = sensitivity(call.instrument.teds.data(port))
    if volts_per_unit is None or not measurement.sensitivity_setting:
        raise DaqError(
            f"{port.name}: the TEDS of the sensor has no sensitivity for this measurement. Choose another measurement.",
            Code.TEDS_SENSOR_DATA_ERROR,
        )
    return measurement.settings_of_sensitivity(volts_per_unit)


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
