"""Settings of a task by NI's names of the properties, with their defaults."""

from collections.abc import Mapping
from enum import IntEnum
from math import isfinite
from typing import Any

from daq.extras.ni_device.errors import invalid_value, unsupported
from daq.extras.ni_device.values import (
    Coupling,
    LoggingMode,
    LoggingOperation,
    Overwrite,
    Regeneration,
    RelativeTo,
    SampleMode,
    Slope,
    TimingType,
    TriggerType,
    WindowCondition,
    enum_member,
)

# NI's numbers of values that the instrument reports without using them.
_WAIT_FOR_INTERRUPT, _POLL = 12523, 12524
_USE_HOST, _USE_DEVICE = 16126, 16127
_PULSE, _ACTIVE_HIGH = 10265, 10095
_SECONDS, _SAMPLE_CLOCK_PERIODS = 10364, 10286
_PATTERN_MATCHES = 10254

TIMING: dict[str, Any] = {
    "samp_timing_type": TimingType.ON_DEMAND,
    "samp_clk_rate": 1000.0,
    "samp_clk_src": "",
    "samp_clk_active_edge": Slope.RISING,
    "samp_quant_samp_mode": SampleMode.CONTINUOUS,
    "samp_quant_samp_per_chan": 1000,
    "samp_clk_timebase_src": "",
    "samp_clk_timebase_active_edge": Slope.RISING,
    "ref_clk_src": "",
    "ref_clk_rate": 10e6,
    "sync_pulse_src": "",
    "sync_pulse_min_delay_to_start": 0.0,
    "on_demand_simultaneous_ao_enable": False,
    "delay_from_samp_clk_delay": 0.0,
    "delay_from_samp_clk_delay_units": _SECONDS,
    "first_samp_timestamp_enable": False,
    "first_samp_timestamp_timescale": _USE_HOST,
}
READ: dict[str, Any] = {
    "overwrite": Overwrite.ALLOWED,
    "read_all_avail_samp": False,
    "channels_to_read": "",
    "auto_start": True,
    "relative_to": RelativeTo.CURRENT_READ_POSITION,
    "offset": 0,
    "wait_mode": _WAIT_FOR_INTERRUPT,
    "sleep_time": 0.001,
    "logging_file_path": "",
    "logging_mode": LoggingMode.OFF,
    "logging_tdms_group_name": "",
    "logging_tdms_operation": LoggingOperation.OPEN_OR_CREATE,
    "logging_file_write_size": 0,
    "logging_file_preallocation_size": 0,
    "logging_pause": False,
    "logging_samps_per_file": 0,
}
WRITE: dict[str, Any] = {
    "regen_mode": Regeneration.ALLOWED,
    "relative_to": RelativeTo.CURRENT_WRITE_POSITION,
    "offset": 0,
    "wait_mode": _POLL,
    "sleep_time": 0.001,
    "next_write_is_last": False,
}
BUFFER: dict[str, Any] = {"input_buf_size": 0, "output_buf_size": 0}

# Settings of the digital filter of a trigger.
_FILTER = {
    "dig_fltr_enable": False,
    "dig_fltr_min_pulse_width": 0.0,
    "dig_fltr_timebase_src": "",
    "dig_fltr_timebase_rate": 0.0,
    "dig_sync_enable": False,
}


def _trigger_defaults(role: str) -> dict[str, Any]:
    """Return the default settings of the start trigger ("start") or the reference trigger ("ref")."""
    defaults: dict[str, Any] = {
        f"{role}_trig_type": TriggerType.NONE,
        f"{role}_trig_delay": 0.0,
        f"{role}_trig_retriggerable": False,
        f"{role}_trig_max_num_trigs_to_detect": 0,
        f"{role}_trig_timestamp_enable": False,
        f"{role}_trig_timestamp_timescale": _USE_HOST,
    }
    edge = {"src": "", "slope": Slope.RISING, "lvl": 0.0, "hyst": 0.0, "coupling": Coupling.DC}
    window = {"src": "", "when": WindowCondition.ENTERING, "top": 0.0, "btm": 0.0, "coupling": Coupling.DC}
    multi_edge: dict[str, Any] = {"srcs": "", "slopes": [], "lvls": [], "hysts": [], "couplings": []}
    settings_by_type = {
        "anlg_edge": edge | _FILTER,
        "anlg_win": window | _FILTER,
        "anlg_multi_edge": multi_edge,
        "dig_edge": {"src": "", "edge": Slope.RISING} | _FILTER,
        "dig_pattern": {"src": "", "pattern": "", "when": _PATTERN_MATCHES},
    }
    for trigger_type, settings in settings_by_type.items():
        defaults |= {f"{trigger_type}_{role}_trig_{key}": value for key, value in settings.items()}
    return defaults


TRIGGER: dict[str, Any] = {
    **_trigger_defaults("start"),
    **_trigger_defaults("ref"),
    "ref_trig_pretrig_samples": 2,
    "ref_trig_auto_trig_enable": False,
    "start_trig_delay_units": _SAMPLE_CLOCK_PERIODS,
    "start_trig_timescale": _USE_DEVICE,
    # Wall-clock time of a timed start, s since 1970; NI's default is the beginning of 1904.
    "start_trig_trig_when": -2_082_844_800.0,
    "pause_trig_type": TriggerType.NONE,
    "arm_start_trig_type": TriggerType.NONE,
    "trigger_sync_type": TriggerType.NONE,
}
EXPORT: dict[str, Any] = {
    "samp_clk_output_term": "",
    "samp_clk_output_behavior": _PULSE,
    "samp_clk_pulse_polarity": _ACTIVE_HIGH,
    "start_trig_output_term": "",
    "start_trig_output_behavior": _PULSE,
    "start_trig_pulse_polarity": _ACTIVE_HIGH,
    "ref_trig_output_term": "",
    "ref_trig_pulse_polarity": _ACTIVE_HIGH,
}
GROUPS = {"timing": TIMING, "trig": TRIGGER, "read": READ, "write": WRITE, "buffer": BUFFER, "exported_signal": EXPORT}
# Settings that may be changed while a task runs.
WHILE_RUNNING = {
    "read": {*READ} - {"overwrite", "logging_file_path", "logging_mode", "logging_tdms_operation"},
    "write": {"relative_to", "offset", "wait_mode", "sleep_time", "next_write_is_last"},
}


def coerce(name: str, value: Any, default: Any) -> Any:
    """Convert the value of the setting `name` to the type of its default.

    Raises `DaqError` -200077 if the value is not among the named values of the setting, or not a finite number.

    >>> coerce("samp_clk_rate", 5120, 1000.0)
    5120.0
    """
    if isinstance(default, IntEnum):
        return enum_member(type(default), value, name)
    if isinstance(default, float):
        if not isfinite(value):
            raise invalid_value(f"{name} is {value}. Give a finite number.")
        return float(value)
    return list(value) if isinstance(default, list) else value


class Properties:
    """A group of settings with their defaults; `group` is the name of the group in messages.

    >>> timing = Properties("timing", TIMING)
    >>> timing["samp_clk_rate"] = 5120
    >>> timing["samp_clk_rate"], timing.was_set("samp_clk_rate")
    (5120.0, True)
    """

    def __init__(self, group: str, defaults: Mapping[str, Any]) -> None:
        self._group, self._defaults = group, defaults
        self._set: dict[str, Any] = {}

    def __getitem__(self, name: str) -> Any:
        if name not in self._defaults:
            raise unsupported(f"{self._group} property {name}")
        return self._set.get(name, self._defaults[name])

    def __setitem__(self, name: str, value: Any) -> None:
        self._set[name] = coerce(name, value, self[name])

    def reset(self, name: str) -> None:
        """Reset a setting to its default."""
        self[name]  # The lookup raises an error for an unknown name.
        self._set.pop(name, None)

    def was_set(self, name: str) -> bool:
        """Return whether a script has set the value."""
        return name in self._set
