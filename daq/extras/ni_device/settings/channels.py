"""Channels of a task: their settings and the validation of these settings."""

import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, Self

from daq.extras.ni_device.devices.measurements import MICROPHONE, VOLTAGE, Measurement
from daq.extras.ni_device.devices.modules import Module
from daq.extras.ni_device.devices.names import Port
from daq.extras.ni_device.errors import Code, DaqError, invalid_value, unsupported
from daq.extras.ni_device.settings.properties import coerce
from daq.extras.ni_device.values import FROM_CUSTOM_SCALE, Coupling, Excitation, TerminalConfiguration

# Values of read-only properties, with the numbers of NI-DAQmx.
_ANALOG_INPUT, _ANALOG_OUTPUT = 10100, 10102
_RIGHT_JUSTIFIED, _BITS = 10279, 10109
# Numbers in NI-DAQmx of settings that only this module uses.
_CURRENT, _DC, _SECONDS, _VOLTS, _MAINTAIN_EXISTING_VALUE = 10134, 10050, 10364, 10348, 12528
# Error codes for reading a limit after it was reset: limits have no default.
_LIMIT_ERRORS = {"ai_max": Code.AI_MAX_NOT_SPECIFIED, "ai_min": Code.AI_MIN_NOT_SPECIFIED}

# Settings of every input, with their defaults; the numbers of named values are those of NI-DAQmx.
_INPUT: dict[str, Any] = {
    "ai_min": -5.0,
    "ai_max": 5.0,
    "ai_coupling": Coupling.DC,
    "ai_term_cfg": TerminalConfiguration.DEFAULT,
    "ai_custom_scale_name": "",
    "ai_excit_src": Excitation.NONE,
    "ai_excit_val": 0.0,
    "ai_excit_voltage_or_current": _CURRENT,
    "ai_excit_d_cor_ac": _DC,
    "ai_excit_use_for_scaling": False,
    "ai_excit_use_multiplexed": False,
    "ai_is_teds": False,
    "ai_dither_enable": False,
    "ai_lossy_lsb_removal_compressed_samp_size": 16,
    "ai_enhanced_alias_rejection_enable": False,
    "ai_lowpass_enable": False,
    "ai_chan_cal_enable_cal": False,
    "ai_chan_cal_has_valid_cal_info": False,
    "ai_filter_delay_adjustment": 0.0,
    "ai_filter_delay_units": _SECONDS,
    "ai_dc_offset": 0.0,
    "chan_descr": "",
    "chan_is_global": False,
}
# Settings of every output, with their defaults.
_OUTPUT: dict[str, Any] = {
    "ao_min": -10.0,
    "ao_max": 10.0,
    "ao_voltage_units": _VOLTS,
    "ao_custom_scale_name": "",
    "ao_term_cfg": TerminalConfiguration.DEFAULT,
    "ao_output_type": VOLTAGE,
    "ao_resolution_units": _BITS,
    "ao_idle_output_behavior": _MAINTAIN_EXISTING_VALUE,
    "ao_dac_ref_allow_conn_to_gnd": False,
    "ao_use_only_on_brd_mem": False,
    "chan_descr": "",
    "chan_is_global": False,
}


@dataclass
class Channel:
    """One channel of a task."""

    name: str  # name in the task, which the script may choose ("virtual name" in NI-DAQmx)
    port: Port  # the physical channel (terminal), by its name in the script
    module: Module
    bench_index: int  # index of the bench's channel or output at the terminal
    measurement: Measurement | None  # None for an output
    defaults: dict[str, Any]  # default values by NI-DAQmx property name
    settings: dict[str, Any]  # present values by NI-DAQmx property name
    unset_limits: set[str] = field(default_factory=set)  # limits that a script has reset and must set again

    @classmethod
    def declare(
        cls, name: str, port: Port, module: Module, measurement: Measurement | None, given: Mapping[str, Any]
    ) -> Self:
        """Create an input, or an output if `measurement` is None, with the given settings.

        Raises `DaqError` -200170 if the terminal does not exist, and the errors of `check`.
        """
        bench_index, defaults = module.bench_index("ao" if measurement is None else "ai", port.number), dict(_OUTPUT)
        if measurement is not None:
            defaults = _INPUT | measurement.defaults()
            # AC coupling is the default if the module provides IEPE excitation, which requires AC coupling.
            requires_ac = given.get("ai_excit_src") == Excitation.INTERNAL and module.supply_coupling == "AC"
            defaults["ai_coupling"] = Coupling.AC if requires_ac else module.couplings[0]
        if measurement is not None and measurement.type == MICROPHONE:
            level_db = given["ai_sound_pressure_max_sound_pressure_lvl"]
            if not -1000.0 < level_db < 1000.0:
                raise invalid_value(
                    f"channel {name}: the sound pressure level is {level_db:g} dB. Give less than 1000 dB."
                )
            # Peak of a sine with this RMS level; the reference is 20 uPa.
            limit = 20e-6 * 10 ** (level_db / 20) * math.sqrt(2)
            given = {"ai_min": -limit, "ai_max": limit, **given}
        channel = cls(name, port, module, bench_index, measurement, defaults, defaults | dict(given))
        channel.check()
        return channel

    @property
    def direction(self) -> str:
        """Direction of the channel: "ai" for an input, "ao" for an output."""
        return "ao" if self.measurement is None else "ai"

    @property
    def volts_per_unit(self) -> float:
        """Volts per unit of the readings."""
        return 1.0 if self.measurement is None else self.measurement.volts_per_unit(self.settings)

    @property
    def unit(self) -> str:
        """Unit of the readings."""
        return "V" if self.measurement is None else self.measurement.unit(self.settings)

    @property
    def range(self) -> float:
        """Range of the module that the limits select, ± V; infinite if the inputs are not limited."""
        if self.measurement is None:
            return self.module.output_range
        if "rng" in self.settings:
            return float(self.settings["rng"])
        if self.has_custom_scale:
            return self.module.ranges[-1] if self.module.ranges else math.inf
        return self.module.range_for(self._largest_volts())

    @property
    def has_custom_scale(self) -> bool:
        """Whether a custom scale converts the readings."""
        units = self.settings["ao_voltage_units" if self.measurement is None else self.measurement.units_setting]
        return bool(units == FROM_CUSTOM_SCALE)

    @property
    def scale_name(self) -> str:
        """Name of the custom scale; empty without a custom scale."""
        return str(self.settings[f"{self.direction}_custom_scale_name"])

    def _largest_volts(self) -> float:
        """Return the larger magnitude of both limits [V]."""
        limits = (abs(self.settings[f"{self.direction}_{bound}"]) for bound in ("min", "max"))
        return max(limits) * self.volts_per_unit

    def check_complete(self) -> None:
        """Check the settings together, when a task starts.

        Raises `DaqError` -200695 or -200694 for missing limits, -200082 for a lower limit that is not below the upper,
        -200077 for a supply that requires AC coupling.
        """
        settings, module = self.settings, self.module
        for name in self.unset_limits:
            self.get(name)  # Access to the limit raises the error for a missing limit.
        low, high = settings[f"{self.direction}_min"], settings[f"{self.direction}_max"]
        if not low < high:
            raise DaqError(
                f"channel {self.name}: the lower limit {low:g} is not below the upper limit {high:g}. Change one.",
                Code.MIN_NOT_LESS_THAN_MAX,
            )
        supplies = settings.get("ai_excit_src") == Excitation.INTERNAL
        if supplies and module.supply_coupling == "AC" and settings["ai_coupling"] != Coupling.AC:
            raise invalid_value(
                f"channel {self.name}: {module.product_type} supplies sensors with AC coupling only. Set "
                "ai_coupling to AC, or ai_excit_src to NONE."
            )

    def check(self) -> None:
        """Raise `DaqError` unless the settings are consistent and the module supports them."""
        settings = self.settings
        if self.measurement is not None:
            self.measurement.check_units(settings)
        low, high = settings[f"{self.direction}_min"], settings[f"{self.direction}_max"]
        if not (math.isfinite(low) and math.isfinite(high)):
            raise invalid_value(f"channel {self.name}: limits {low:g} to {high:g} are not finite. Give finite limits.")
        if not sys.float_info.min <= self.volts_per_unit < math.inf:
            raise invalid_value(
                f"channel {self.name}: the sensitivity, {self.volts_per_unit:g} V per {self.unit}, is not positive and "
                "finite. Give the sensitivity from the sensor's data sheet."
            )
        full_scale = self.module.output_range if self.measurement is None else (self.module.ranges or (math.inf,))[-1]
        if self._largest_volts() > full_scale * (1 + 1e-9) and not self.has_custom_scale:
            limit = full_scale / self.volts_per_unit
            raise invalid_value(
                f"channel {self.name}: limits {low:g} to {high:g} {self.unit} exceed the range of "
                f"{self.module.product_type}, {-limit:g} to {limit:g} {self.unit} (±{full_scale:g} V). "
                "Give limits within this range."
            )
        if self.measurement is None:
            return
        # Name and value of a setting, all named values of this setting, and the values that the module supports.
        choices: tuple[tuple[str, int, type[IntEnum], tuple[IntEnum, ...]], ...] = (
            (
                "terminal configuration",
                settings["ai_term_cfg"],
                TerminalConfiguration,
                (*self.module.terminal_configurations_at(self.port.number), TerminalConfiguration.DEFAULT),
            ),
            ("coupling", settings["ai_coupling"], Coupling, self.module.couplings),
            (
                "excitation",
                settings["ai_excit_src"],
                Excitation,
                tuple(source for source in Excitation if self.module.currents or source != Excitation.INTERNAL),
            ),
        )
        for setting, value, names, supported in choices:
            if value not in supported:
                name = names(value).name if value in list(names) else value
                choice = ", ".join(member.name for member in supported if member != TerminalConfiguration.DEFAULT)
                raise invalid_value(
                    f"channel {self.name}: {self.port.name} of {self.module.product_type} does not support {setting} "
                    f"{name}. "
                    f"Choose {choice}."
                )

    def get(self, name: str) -> Any:
        """Return a property by NI's name.

        Raises `DaqError` -200452 if channels of this direction do not have the property, -200694 or -200695 for a reset
        limit.
        """
        if name in self.unset_limits:
            raise DaqError(
                f"channel {self.name}: {name} was reset and has no default. Set {name}.", _LIMIT_ERRORS[name]
            )
        computed = _INPUT_COMPUTED if self.measurement is not None else _OUTPUT_COMPUTED
        if name in computed:
            return computed[name](self)
        if name not in self.settings:
            raise unsupported(f"property {name} of channel {self.name}")
        return self.settings[name]

    def set(self, name: str, value: Any) -> None:
        """Set a property. Raises `DaqError` -200452 if it does not exist, otherwise the errors of `check`."""
        if name in ("ai_rng_high", "ai_rng_low"):
            self.settings["rng"] = self.module.range_for(abs(coerce(name, value, 0.0)))
            return
        if name not in self.defaults:
            raise unsupported(f"setting property {name} of channel {self.name}")
        previous = self.settings
        self.settings = previous | {name: coerce(name, value, self.defaults[name])}
        try:
            self.check()
        except DaqError:
            self.settings = previous
            raise
        self.unset_limits.discard(name)

    def reset(self, name: str) -> None:
        """Reset a property to its default; limits must then be set again."""
        if name in ("ai_rng_high", "ai_rng_low"):
            self.settings.pop("rng", None)
            return
        self.get(name)
        self.set(name, self.defaults[name])
        if name in _LIMIT_ERRORS:
            self.unset_limits.add(name)


def _limit(channel: Channel, sign: float) -> float:
    """Return the upper (sign 1) or lower (sign -1) limit of an input, in the unit of its readings."""
    if channel.has_custom_scale or channel.range == math.inf:
        return float(channel.settings["ai_max" if sign > 0 else "ai_min"])
    # The digits beyond 15 are rounding errors of the conversion of units.
    return float(f"{sign * channel.range / channel.volts_per_unit:.15g}")


def _supply_current(channel: Channel) -> float:
    """Return the current of the sensor's supply [A]; a module coerces a request, such as NI's default of 4 mA."""
    requested = float(channel.settings["ai_excit_val"])
    if channel.settings["ai_excit_src"] != Excitation.INTERNAL:
        return requested
    return min(channel.module.currents, key=lambda current: abs(current - requested))


# Properties that are computed when a script reads them, by NI's names.
_COMMON: dict[str, Any] = {"physical_chan_name": lambda channel: channel.port.name}
_INPUT_COMPUTED: dict[str, Any] = _COMMON | {
    "chan_type": lambda channel: _ANALOG_INPUT,
    "ai_meas_type": lambda channel: channel.measurement.type,
    # A script reads the limits of the range that the module uses.
    "ai_max": lambda channel: _limit(channel, 1.0),
    "ai_min": lambda channel: _limit(channel, -1.0),
    "ai_rng_high": lambda channel: channel.range,
    "ai_rng_low": lambda channel: -channel.range,
    "ai_term_cfg": lambda channel: int(
        channel.module.terminal_configurations_at(channel.port.number)[-1]
        if channel.settings["ai_term_cfg"] == TerminalConfiguration.DEFAULT
        else channel.settings["ai_term_cfg"]
    ),
    "ai_raw_samp_size": lambda channel: 16 if (channel.module.bits or 32) <= 16 else 32,
    "ai_raw_samp_justification": lambda channel: _RIGHT_JUSTIFIED,
    "ai_resolution": lambda channel: float(channel.module.bits or 64),
    "ai_resolution_units": lambda channel: _BITS,
    "ai_excit_val": lambda channel: _supply_current(channel),
    "ai_excit_actual_val": lambda channel: _supply_current(channel),
    "ai_gain": lambda channel: 1.0,
}
_OUTPUT_COMPUTED: dict[str, Any] = _COMMON | {
    "chan_type": lambda channel: _ANALOG_OUTPUT,
    "ao_dac_rng_high": lambda channel: channel.module.output_range,
    "ao_dac_rng_low": lambda channel: -channel.module.output_range,
    "ao_resolution": lambda channel: float(channel.module.output_bits or 64),
}
