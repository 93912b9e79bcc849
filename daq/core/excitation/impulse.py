"""Impact test: half-sine hammer impacts on a body with the shaker at rest, and recording of the free decay."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from daq.core.excitation.procedure import Form, FormValues, Procedure
from daq.core.excitation.station import Excitation, Station
from rig.core.base.arrays import Array
from rig.core.scene.excitation.impulse import Impulse
from rig.core.settings.quantities import TIME, parse

if TYPE_CHECKING:
    from daq.core.signal_chain.channel import ChannelInfo
    from rig.core.scene.excitation.kind import KindOfTest
    from rig.core.scene.scene import Scene


# Recording time before the first impact, s; it shows offsets and noise.
BASELINE_S = 0.25
# Length of the windows in which the drive is output, s.
_WINDOW_S = 0.1
# Longest wait for the settling of sensors, in time constants (to exp(-10)) and in s; the shorter wait applies.
_MAX_TIME_CONSTANTS, _MAX_SETTLING_S = 10.0, 60.0
# Length of the window in which a drift is detected, s.
_DRIFT_WINDOW_S = 0.5
# A drift is detected above this number of standard deviations of its estimate, which noise does not reach by chance.
_DRIFT_SIGMAS = 4.0


def _wait_for_sensors(station: Station) -> Excitation:
    """Wait until the bias of the sensors has settled after power-on so that no reading drifts during an impact."""
    max_samples = round(max((settling_time(info) for info in station.channels), default=0.0) * station.rate)
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
    # The step at power-on decays with the poles of the high-pass filters. These are the slowest poles; their number
    # equals the number of zeros at 0 Hz.
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


def _with_impacts(test: Impulse, repeats: int, interval: float) -> Impulse:
    """Return the test with a different number of impacts and interval [s]; later double impacts are dropped.

    If impacts are missing, all remaining impacts have the highest peak.
    """
    peak = test.peak if repeats == test.repeats else max(test.levels)
    double_hit = test.double_hit
    if double_hit is not None and double_hit.hits is not None:
        impacts = tuple(impact for impact in double_hit.hits if impact <= repeats)
        double_hit = double_hit.replace(hits=impacts) if impacts else None
    return test.replace(peak=peak, repeats=repeats, interval=interval, double_hit=double_hit)


class ImpulseProcedure(Procedure["Impulse"]):
    """Hammer impacts."""

    detection = "hits"
    form = Form("hammer", ("level", "interval", "hits"))

    def excite(self, station: Station, test: Impulse) -> Excitation:
        """Run the impacts of an impact test."""
        pulses = test.pulses(station.rate)
        interval, window = (station.samples(time) for time in (test.interval, _WINDOW_S))
        yield station.zero_drive(station.samples(BASELINE_S))
        yield from _wait_for_sensors(station)
        for hit, (pulse, peak) in enumerate(zip(pulses, test.peaks, strict=True), 1):
            force = np.zeros(interval)
            force[: pulse.size] = pulse
            first = station.now
            # The first window contains the whole pulse, so that the pulse is marked immediately after its end.
            edges = [0, *range(max(window, pulse.size), interval, window), interval]
            for start, stop in pairwise(edges):
                yield station.drive(force[start:stop], "hammer")
                if start == 0:
                    station.mark(
                        "hit", first, first + pulse.size, number=hit, body=test.body, peak=peak, width=test.width,
                        double=test.is_double(hit),
                    )  # fmt: skip
                station.report((hit - 1 + stop / interval) / test.repeats, f"impact {hit} of {test.repeats}")

    def power_on_wait(self, channels: Sequence[ChannelInfo]) -> float:
        """Return the longest wait before the first impact [s]."""
        return BASELINE_S + max((settling_time(info) for info in channels), default=0.0)

    def part(self, test: Impulse, seconds: float, scene: Scene) -> Impulse:
        """Return the test with the impacts that fit into `seconds`; if some are omitted, all have the highest peak."""
        delay = 0.0 if test.double_hit is None else test.double_hit.after
        interval = test.interval if test.interval < seconds else max(seconds, 2.0 * (test.width + delay))
        return _with_impacts(test, max(1, int(seconds / test.interval)), interval)

    def from_form(self, values: FormValues, test: KindOfTest | None) -> Impulse:
        """Return impacts of the given peak at the point of the scene's test."""
        assert isinstance(test, Impulse)
        return _with_impacts(test, int(values.hits), values.interval).at_level(values.level)


PROCEDURE = ImpulseProcedure()
