"""Types of measurement, such as voltage or acceleration: settings of their channels, and volts per unit."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from daq.extras.ni_device.errors import invalid_value
from daq.extras.ni_device.values import FROM_CUSTOM_SCALE, FROM_TEDS
from rig.core.scene.scene import STANDARD_GRAVITY

# NI's numbers of the types of measurement (DAQmx_Val_...).
VOLTAGE, ACCELERATION, FORCE, VELOCITY, MICROPHONE = 10322, 10356, 15895, 15966, 10354

# Standard gravity in m/s², a pound-force in N, an inch in m.
_G, _POUND_FORCE, _INCH = STANDARD_GRAVITY, 4.4482216152605, 0.0254

# Units of readings by NI's numbers: value of one unit in SI, and symbol.
UNITS: dict[int, tuple[float, str]] = {
    10348: (1.0, "V"),
    10186: (_G, "g"),
    12470: (1.0, "m/s^2"),
    12471: (_INCH, "in/s^2"),
    15875: (1.0, "N"),
    15876: (_POUND_FORCE, "lb"),
    15877: (_G, "kgf"),
    15959: (1.0, "m/s"),
    15960: (_INCH, "in/s"),
    10081: (1.0, "Pa"),
    FROM_CUSTOM_SCALE: (1.0, ""),
    FROM_TEDS: (1.0, ""),
}
# Units of sensitivities by NI's numbers: value of one unit in V per SI unit, and symbol.
SENSITIVITY_UNITS: dict[int, tuple[float, str]] = {
    12509: (1e-3 / _G, "mV/g"),
    12510: (1.0 / _G, "V/g"),
    15891: (1e-3, "mV/N"),
    15892: (1e-3 / _POUND_FORCE, "mV/lb"),
    15963: (1.0, "V s/m"),
    15964: (1e-3 / _INCH, "mV s/in"),
}
# NI's numbers of the units that a setting may have: units of readings, and units of sensitivities.
_SUPPORTED_UNITS = {
    "ai_voltage_units": (10348,),
    "ai_accel_units": (10186, 12470, 12471),
    "ai_accel_sensitivity_units": (12509, 12510),
    "ai_force_units": (15875, 15876, 15877),
    "ai_force_iepe_sensor_sensitivity_units": (15891, 15892),
    "ai_velocity_units": (15959, 15960),
    "ai_velocity_iepe_sensor_sensitivity_units": (15963, 15964),
    "ai_sound_pressure_units": (10081,),
}
# The sensitivity of a microphone is always in mV/Pa.
_MICROPHONE_UNIT_V_PER_PA = 1e-3


@dataclass(frozen=True)
class Measurement:
    """A type of measurement: the names of its settings, and conversions of its units."""

    type: int  # NI's number
    units_setting: str  # name of the setting of the units of the readings
    sensitivity_setting: str = ""  # setting of the sensitivity; with the suffix `_units`, that of its unit

    def defaults(self) -> dict[str, Any]:
        """Return the settings of this type with their defaults."""
        defaults: dict[str, Any] = {self.units_setting: _SUPPORTED_UNITS[self.units_setting][0]}
        if self.type == MICROPHONE:
            defaults["ai_sound_pressure_max_sound_pressure_lvl"] = 100.0
        if self.sensitivity_setting:
            units = f"{self.sensitivity_setting}_units"
            defaults |= {self.sensitivity_setting: 1.0, units: _SUPPORTED_UNITS.get(units, (0,))[0]}
            defaults[f"{self.sensitivity_setting.removesuffix('_sensitivity')}_db_ref"] = 1.0
        return defaults

    def settings(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Translate the arguments of a call that creates a channel to settings."""
        names = _SETTINGS | {
            "units": self.units_setting,
            "sensitivity": self.sensitivity_setting,
            "sensitivity_units": f"{self.sensitivity_setting}_units",
        }
        return {names[name]: value for name, value in arguments.items()}

    def volts_per_unit(self, settings: Mapping[str, Any]) -> float:
        """Return the volts per unit of the readings."""
        if not self.sensitivity_setting:
            return 1.0
        volts = _MICROPHONE_UNIT_V_PER_PA
        if self.type != MICROPHONE:
            volts = SENSITIVITY_UNITS[settings[f"{self.sensitivity_setting}_units"]][0]
        return float(settings[self.sensitivity_setting] * volts * UNITS[settings[self.units_setting]][0])

    def check_units(self, settings: Mapping[str, Any]) -> None:
        """Raise `DaqError` -200077 for units that do not belong to this type."""
        units = settings[self.units_setting]
        supported = _SUPPORTED_UNITS[self.units_setting]
        if units not in (*supported, FROM_CUSTOM_SCALE, FROM_TEDS):
            names = ", ".join(f"{UNITS[unit][1]} ({unit})" for unit in supported)
            raise invalid_value(
                f"{self.units_setting} {units} is not a unit of this measurement. "
                f"Choose {names}, or the unit of a custom scale ({FROM_CUSTOM_SCALE})."
            )
        name = f"{self.sensitivity_setting}_units"
        supported = _SUPPORTED_UNITS.get(name, ())
        if supported and settings[name] not in supported:
            names = ", ".join(f"{SENSITIVITY_UNITS[unit][1]} ({unit})" for unit in supported)
            raise invalid_value(f"{name} {settings[name]} is not a unit of this sensitivity. Choose {names}.")

    def settings_of_sensitivity(self, volts_per_unit: float) -> dict[str, Any]:
        """Return the settings for a sensitivity in V per SI unit, in the units of data sheets: V/g, mV/N, mV/Pa."""
        # Factor from V per SI unit, and NI's number of the unit; the unit of a microphone's sensitivity is fixed.
        factor, units = {ACCELERATION: (_G, 12510), FORCE: (1e3, 15891), VELOCITY: (1.0, 15963), MICROPHONE: (1e3, 0)}[
            self.type
        ]
        settings = {self.sensitivity_setting: volts_per_unit * factor}
        return settings | ({f"{self.sensitivity_setting}_units": units} if units else {})

    def unit(self, settings: Mapping[str, Any]) -> str:
        """Return the symbol of the unit of the readings."""
        return UNITS[settings[self.units_setting]][1]


# Arguments of calls that create a channel, and their settings; for units and sensitivity see `Measurement.settings`.
_SETTINGS = {
    "min_val": "ai_min",
    "max_val": "ai_max",
    "terminal_config": "ai_term_cfg",
    "custom_scale_name": "ai_custom_scale_name",
    "current_excit_source": "ai_excit_src",
    "current_excit_val": "ai_excit_val",
    "mic_sensitivity": "ai_microphone_sensitivity",
    "max_snd_press_level": "ai_sound_pressure_max_sound_pressure_lvl",
}

# The measurements of the emulated modules, by the variable part of the DAQmx call: "Accel" in CreateAIAccelChan.
MEASUREMENTS: dict[str, Measurement] = {
    "Voltage": Measurement(VOLTAGE, "ai_voltage_units"),
    "Accel": Measurement(ACCELERATION, "ai_accel_units", "ai_accel_sensitivity"),
    "ForceIEPE": Measurement(FORCE, "ai_force_units", "ai_force_iepe_sensor_sensitivity"),
    "VelocityIEPE": Measurement(VELOCITY, "ai_velocity_units", "ai_velocity_iepe_sensor_sensitivity"),
    "Microphone": Measurement(MICROPHONE, "ai_sound_pressure_units", "ai_microphone_sensitivity"),
}
SUPPORTED_TYPES = sorted(measurement.type for measurement in MEASUREMENTS.values())
