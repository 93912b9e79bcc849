"""The force sensor in an impulse hammer, or between a shaker and its body."""

from __future__ import annotations

from daq.accelerometer import drawn
from daq.circuit import high_pass
from daq.stage import Stage, data_sheet
from rig.sensor_settings import Hammer


def force_sensor(settings: Hammer, seed: int, channel: str) -> Stage:
    """Describe a force sensor, ideal where nothing is given.

    Parameters and what is returned are those of `daq.accelerometer.accelerometer`.
    """
    sensitivity = 1.0 if settings.sensitivity is None else settings.sensitivity
    tolerance = settings.sensitivity_tolerance
    return Stage(
        "hammer",
        () if settings.low_cutoff is None else (high_pass(settings.low_cutoff, "low cut-off"),),
        nominal=sensitivity,
        deviation=0.0 if tolerance is None else tolerance * drawn(seed, channel, "tolerance"),
        noise=None if settings.noise is None else settings.noise * sensitivity,
        limit=None if settings.saturation is None else settings.saturation * sensitivity,
        data=data_sheet("hammer", settings),
    )
