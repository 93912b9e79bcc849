"""Kinds of measurement: the settings of their channels, and their sensitivities in volts per unit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from daq.instrument.errors import invalid_value
from daq.instrument.values import FROM_CUSTOM_SCALE, FROM_TEDS
from rig.scene.scene import STANDARD_GRAVITY

VOLTAGE, ACCELERATION, FORCE, VELOCITY, MICROPHONE = 10322, 10356, 15895, 15966, 10354

_G, _POUND, _INCH = STANDARD_GRAVITY, 4.4482216152605, 0.0254

# SI factors and names of the units of the readings.
UNITS: dict[int, tuple[float, str]] = {
    10348: (1.0, "V"),
    10186: (_G, "g"),
    12470: (1.0, "m/s^2"),
    12471: (_INCH, "in/s^2"),
    15875: (1.0, "N"),
    15876: (_POUND, "lb"),
    15877: (_G, "kgf"),
    15959: (1.0, "m/s"),
    15960: (_INCH, "in/s"),
    10081: (1.0, "Pa"),
    FROM_CUSTOM_SCALE: (1.0, ""),
    FROM_TEDS: (1.0, ""),
}
# Volts per SI unit of the units of sensitivities.
SENSITIVITY_UNITS: dict[int, float] = {
    12509: 1e-3 / _G,
    12510: 1.0 / _G,
    15891: 1e-3,
    15892: 1e-3 / _POUND,
    15963: 1.0,
    15964: 1e-3 / _INCH,
}


@dataclass(frozen=True)
class Measurement:
    """A kind of measurement.

    `sensitivity`: setting with the sensitivity of the sensor; the setting of the same name plus `_units` has its
    units.
    """

    type: int  # the driver's number
    units: str  # setting with the units of the readings
    sensitivity: str = ""

    def settings(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """Convert the arguments of a script for a channel to the driver's names of the settings."""
        defaults = {
            "units": self.units,
            "sensitivity": self.sensitivity,
            "sensitivity_units": f"{self.sensitivity}_units",
        }
        return {defaults.get(name) or _SETTINGS[name]: value for name, value in given.items()}

    @property
    def takes_volts(self) -> bool:
        """Whether the readings can be computed from volts at the terminal."""
        return self.type in (VOLTAGE, 10323, 10350, ACCELERATION, FORCE, VELOCITY, MICROPHONE)

    def volts_per_unit(self, settings: Mapping[str, Any]) -> float:
        """Volts per unit of the readings."""
        size = UNITS.get(settings[self.units], (1.0, ""))[0]
        if not self.sensitivity:
            return 1.0
        volts = SENSITIVITY_UNITS.get(settings.get(f"{self.sensitivity}_units", 0))
        if self.type == MICROPHONE:
            volts = 1e-3  # mV/Pa always
        return 1.0 if volts is None else float(settings[self.sensitivity] * volts * size)

    def check_units(self, settings: Mapping[str, Any]) -> None:
        """Reject units that do not belong to this kind, with -200077."""
        units = settings[self.units]
        supported = _UNITS_OF.get(self.units)
        if supported is not None and units not in (*supported, FROM_CUSTOM_SCALE, FROM_TEDS):
            raise invalid_value(
                f"{self.units} is {units}: expected "
                + ", ".join(f"{UNITS[each][1]} ({each})" for each in supported)
                + f" or those of a custom scale ({FROM_CUSTOM_SCALE})"
            )

    def sensitivity_settings(self, volts_per_unit: float) -> dict[str, Any]:
        """Convert a sensitivity [V per SI unit] to the units of a data sheet: V/g, mV/N, V s/m or mV/Pa."""
        size, units = {ACCELERATION: (_G, 12510), FORCE: (1e3, 15891), VELOCITY: (1.0, 15963), MICROPHONE: (1e3, 0)}[
            self.type
        ]
        settings = {self.sensitivity: volts_per_unit * size}
        return settings | ({f"{self.sensitivity}_units": units} if units else {})

    def unit(self, settings: Mapping[str, Any]) -> str:
        """Return the name of the unit of the readings."""
        return UNITS.get(settings[self.units], (1.0, ""))[1]


# Units of the readings by kind of measurement.
_UNITS_OF = {
    "ai_voltage_units": (10348,),
    "ai_accel_units": (10186, 12470, 12471),
    "ai_force_units": (15875, 15876, 15877),
    "ai_velocity_units": (15959, 15960),
    "ai_sound_pressure_units": (10081,),
}

# Arguments of scripts that create a channel, and the settings that they become; for units and sensitivity see above.
_SETTINGS = {
    "min_val": "ai_min",
    "max_val": "ai_max",
    "terminal_config": "ai_term_cfg",
    "custom_scale_name": "ai_custom_scale_name",
    "current_excit_source": "ai_excit_src",
    "current_excit_val": "ai_excit_val",
    "voltage_excit_source": "ai_excit_src",
    "voltage_excit_val": "ai_excit_val",
    "voltage_excit_freq": "ai_ac_excit_freq",
    "ac_excit_wire_mode": "ai_ac_excit_wire_mode",
    "use_excit_for_scaling": "ai_excit_use_for_scaling",
    "bridge_config": "ai_bridge_cfg",
    "nominal_bridge_resistance": "ai_bridge_nom_resistance",
    "initial_bridge_voltage": "ai_bridge_initial_voltage",
    "nominal_gage_resistance": "ai_bridge_nom_resistance",
    "forward_coeffs": "ai_bridge_poly_forward_coeff",
    "reverse_coeffs": "ai_bridge_poly_reverse_coeff",
    "electrical_vals": "ai_bridge_table_electrical_vals",
    "physical_vals": "ai_bridge_table_physical_vals",
    "electrical_units": "ai_bridge_electrical_units",
    "physical_units": "ai_bridge_physical_units",
    "first_electrical_val": "ai_bridge_two_point_lin_first_electrical_val",
    "second_electrical_val": "ai_bridge_two_point_lin_second_electrical_val",
    "first_physical_val": "ai_bridge_two_point_lin_first_physical_val",
    "second_physical_val": "ai_bridge_two_point_lin_second_physical_val",
    "strain_config": "ai_strain_gage_cfg",
    "gage_factor": "ai_strain_gage_gage_factor",
    "poisson_ratio": "ai_strain_gage_poisson_ratio",
    "lead_wire_resistance": "ai_lead_wire_resistance",
    "shunt_resistor_loc": "ai_current_shunt_loc",
    "ext_shunt_resistor_val": "ai_current_shunt_resistance",
    "mic_sensitivity": "ai_microphone_sensitivity",
    "max_snd_press_level": "ai_sound_pressure_max_sound_pressure_lvl",
}

# Keys are from the names of the driver's calls: "Accel" for create_ai_accel_chan.
MEASUREMENTS: dict[str, Measurement] = {
    "Voltage": Measurement(VOLTAGE, "ai_voltage_units"),
    "VoltageWithExcit": Measurement(10323, "ai_voltage_units"),
    "VoltageRMS": Measurement(10350, "ai_voltage_acrms_units"),
    "Current": Measurement(10134, "ai_current_units"),
    "CurrentRMS": Measurement(10351, "ai_current_acrms_units"),
    "Accel": Measurement(ACCELERATION, "ai_accel_units", "ai_accel_sensitivity"),
    "Accel4WireDCVoltage": Measurement(16106, "ai_accel_units", "ai_accel_4_wire_dc_voltage_sensitivity"),
    "AccelCharge": Measurement(16104, "ai_accel_units", "ai_accel_charge_sensitivity"),
    "Charge": Measurement(16105, "ai_charge_units"),
    "ForceIEPE": Measurement(FORCE, "ai_force_units", "ai_force_iepe_sensor_sensitivity"),
    "VelocityIEPE": Measurement(VELOCITY, "ai_velocity_units", "ai_velocity_iepe_sensor_sensitivity"),
    "Microphone": Measurement(MICROPHONE, "ai_sound_pressure_units", "ai_microphone_sensitivity"),
    "Bridge": Measurement(15908, "ai_bridge_units"),
    "ForceBridge": Measurement(15899, "ai_force_units"),
    "PressureBridge": Measurement(15902, "ai_pressure_units"),
    "TorqueBridge": Measurement(15905, "ai_torque_units"),
    "StrainGage": Measurement(10300, "ai_strain_units"),
    "PosLVDT": Measurement(10352, "ai_lvdt_units", "ai_lvdt_sensitivity"),
    "PosRVDT": Measurement(10353, "ai_rvdt_units", "ai_rvdt_sensitivity"),
    "PosEddyCurrProxProbe": Measurement(
        14835, "ai_eddy_current_prox_probe_units", "ai_eddy_current_prox_probe_sensitivity"
    ),
}
_BRIDGE_SCALES = {"TwoPointLin": 15898, "Table": 10450, "Polynomial": 10449}


def measurement(name: str) -> tuple[Measurement, dict[str, Any]]:
    """Return a kind of measurement by its name in the driver's calls, with the settings that the name implies.

    Raises `KeyError` if the instrument has no measurement of that name.

    >>> measurement("ForceBridgeTable")[1]
    {'ai_bridge_scale_type': 10450}
    """
    for suffix, scale in _BRIDGE_SCALES.items():
        if name.endswith(f"Bridge{suffix}"):
            return MEASUREMENTS[name.removesuffix(suffix)], {"ai_bridge_scale_type": scale}
    return MEASUREMENTS[name], {}
