"""Wait until the bias of the sensors has settled after power-on."""

from collections.abc import Sequence

import numpy as np

from daq.core.excitation.station import Excitation, Station
from daq.core.signal_chain.channel import ChannelInfo
from rig.core.base.arrays import Array
from rig.core.settings.quantities import TIME, parse

# Recording time before the excitation [s]; it shows offsets and noise.
BASELINE_S = 0.25
# Longest wait for the settling of sensors, in time constants (to exp(-10)) and in s; the shorter wait applies.
_MAX_TIME_CONSTANTS, _MAX_SETTLING_S = 10.0, 60.0
# Length of the window in which a drift is detected [s].
_DRIFT_WINDOW_S = 0.5
# A drift is detected above this number of standard deviations of its estimate, which noise does not reach by chance.
_DRIFT_SIGMAS = 4.0


def wait_for_sensors(station: Station) -> Excitation:
    """Wait until the bias of the sensors has settled after power-on: no reading drifts during the measurement."""
    max_samples = round(_longest_settling(station.channels) * station.rate)
    if not max_samples:
        return
    first, end = station.now, station.now + max_samples
    window, is_drifting = station.samples(_DRIFT_WINDOW_S), True
    while is_drifting and station.now < end:
        station.report(0.0, "waiting for the sensors to settle")
        is_drifting = _is_drifting((yield station.zero_drive(min(window, end - station.now))))
    # After ten time constants, unless limited to 60 s, the remaining change is low-frequency noise of the sensors.
    is_settled = not is_drifting or max_samples < round(_MAX_SETTLING_S * station.rate)
    station.mark("settle", first, station.now, settled=is_settled)
    yield station.zero_drive(station.samples(BASELINE_S))


def longest_duration(channels: Sequence[ChannelInfo]) -> float:
    """Return the longest duration of `wait_for_sensors` [s]."""
    settling_s = _longest_settling(channels)
    return settling_s + BASELINE_S if settling_s else 0.0


def _longest_settling(channels: Sequence[ChannelInfo]) -> float:
    return max(map(settling_time, channels), default=0.0)


def settling_time(info: ChannelInfo) -> float:
    """Return the time after power-on in which a bias disappears from a reading, at most 60 s; 0 without a bias.

    >>> from daq.core.signal_chain.channel import ChannelInfo
    >>> data_sheet = {"accelerometer.bias": "9.0 V", "accelerometer.bias_settling": "2.0 s"}
    >>> settling_time(ChannelInfo("a1", "body 1", "acceleration", 1.0, 5120.0, sensor=data_sheet))
    20.0
    """
    if not any(key.endswith(".bias") for key in info.sensor):
        return 0.0
    bias_settling = next(
        (parse(text, TIME) for key, text in info.sensor.items() if key.endswith(".bias_settling")), 0.0
    )
    # The step at power-on decays with the poles of the high-pass filters: the slowest poles, one per zero at 0 Hz.
    high_pass_rates = sorted(abs(pole.real) for pole in info.poles if pole)[: sum(zero == 0 for zero in info.zeros)]
    return min(_MAX_TIME_CONSTANTS * (bias_settling + sum(1.0 / rate for rate in high_pass_rates)), _MAX_SETTLING_S)


def _is_drifting(readings: Array) -> bool:
    """Return whether any reading changes between the two halves of a window by more than its noise."""
    middle = readings.shape[1] // 2
    first_half, second_half = readings[:, :middle], readings[:, middle:]
    if not middle:
        return False
    change = abs(second_half.mean(axis=1) - first_half.mean(axis=1))
    # Differences between successive samples are nearly independent of a drift.
    noise = np.sqrt(np.mean(np.diff(readings, axis=1) ** 2, axis=1) / 2.0)
    return bool(np.any(change > _DRIFT_SIGMAS * noise * np.sqrt(2.0 / middle)))
