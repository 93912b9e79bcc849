"""Impact test: half-sine hammer impacts on a body with the shaker at rest, and recording of the free decay."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from daq.core.excitation.procedure import Form, FormValues, Procedure
from daq.core.excitation.sensor_settling import BASELINE_S, longest_duration, wait_for_sensors
from daq.core.excitation.station import Excitation, Station
from daq.core.signal_chain.channel import ChannelInfo
from rig.core.scene.excitation.impulse import Impulse
from rig.core.scene.excitation.kind import KindOfTest
from rig.core.scene.scene import Scene

# Length of the windows in which the drive is output [s].
_WINDOW_S = 0.1


def _with_impacts(test: Impulse, repeats: int, interval: float) -> Impulse:
    """Return the test with another number of impacts and interval [s], without later double impacts."""
    # If impacts are missing, all remaining impacts have the highest peak.
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
        yield from wait_for_sensors(station)
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
        """Return the maximum time before the first impact [s]: sensors settle, then offsets and noise are recorded."""
        return BASELINE_S + longest_duration(channels)

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
