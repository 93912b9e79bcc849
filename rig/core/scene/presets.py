"""Completion of settings from the data sheet that the scene names as `preset`."""

from typing import TypeVar

from pydantic import ValidationError

from rig.core.base.errors import SceneError
from rig.core.data_sheets.data_sheets import data_sheet
from rig.core.data_sheets.modules import module
from rig.core.scene.measurement_chain import Accelerometer, Channel, Converter, Hammer
from rig.core.scene.shaker import Output

Device = TypeVar("Device", Accelerometer, Hammer, Converter, Output)


def complete_from_preset(settings: Device) -> Device:
    """Complete settings with the values of their preset, if any.

    Raises `SceneError` if no data sheet has the preset's name, or the given settings are incompatible with it.

    >>> converter = complete_from_preset(Converter(preset="NI 9234", range=10.0))
    >>> converter.bits, converter.range
    (24, 10.0)
    """
    if settings.preset is None:
        return settings
    kind = type(settings).__name__.lower()
    sheet = data_sheet(settings.preset, kind)
    given_values = {
        name: value for name in type(settings).model_fields if (value := getattr(settings, name)) is not None
    }
    try:
        return type(settings).model_validate({**sheet.settings[kind], **given_values})
    except ValidationError as error:
        reasons = "; ".join(f"{'.'.join(map(str, item['loc']))}: {item['msg']}" for item in error.errors())
        raise SceneError(
            f"{kind}: does not fit the preset {sheet.name!r} ({reasons}). Change these keys, or remove preset."
        ) from None


def preset_note(settings: Accelerometer | Hammer | None, key: str) -> str:
    """Return the name of the preset that supplies a value, and whether the value has no source; empty for given values.

    >>> preset_note(Accelerometer(preset="PCB 352C33"), "sensitivity")
    ' from preset PCB 352C33'
    >>> preset_note(Accelerometer(preset="PCB 352C33"), "saturation")
    ' from preset PCB 352C33, without a source'
    >>> preset_note(Accelerometer(preset="PCB 352C33", saturation=500.0), "saturation")
    ''
    """
    if settings is None or settings.preset is None or getattr(settings, key) is not None:
        return ""
    sheet = data_sheet(settings.preset)
    return f" from preset {sheet.name}{', without a source' if key in sheet.unsourced else ''}"


def needs_supply(channel: Channel) -> bool:
    """Return whether the sensor of a channel needs a supply current from its input (IEPE).

    >>> needs_supply(Channel(name="body1", at="body 1", accelerometer={"preset": "PCB 352C33"}))
    True
    >>> needs_supply(Channel(name="body1", at="body 1", accelerometer={"sensitivity": "100 mV/g"}))
    False
    """
    if channel.measures_force:
        return channel.hammer is not None and bool(complete_from_preset(channel.hammer).iepe)
    return channel.accelerometer is not None and bool(complete_from_preset(channel.accelerometer).iepe)


def input_settings(converter: Converter, channel: Channel) -> Converter:
    """Return the converter settings of one channel, completed from the preset.

    The channel's coupling and supply current, if given, replace those of the converter. If a module supplies sensors
    only through AC-coupled inputs, DC coupling turns the supply off.

    >>> channel = Channel(name="body1", at="body 1", coupling="DC")
    >>> input_settings(Converter(preset="NI 9234"), channel).excitation
    0.0
    >>> input_settings(Converter(preset="USB-4431"), channel).excitation
    0.0021
    """
    channel_values = {key: value for key in ("coupling", "excitation") if (value := getattr(channel, key)) is not None}
    completed = complete_from_preset(converter).model_copy(update=channel_values)
    if converter.preset is None or completed.coupling != "DC":
        return completed
    inputs = module(converter.preset).inputs
    if inputs is not None and inputs.supply_coupling == "AC":
        completed = completed.model_copy(update={"excitation": 0.0})
    return completed
