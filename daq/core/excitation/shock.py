"""Shock test: the response to the drive is identified, and the pulse replicated with practice pulses before the shocks.

IEC 60068-2-27 (half sine), IEC 60068-2-81 (shock response spectrum).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from daq.core.excitation.procedure import Form, Procedure
from daq.core.excitation.profiles.identification import EXPECTED_PERIODS, MIN_COHERENCE, accelerations, identify
from daq.core.excitation.profiles.spectrum_shaping import lines_between
from daq.core.excitation.profiles.wave_replication import Pulse, Replication, pulse_of
from daq.core.excitation.station import AbortedTest, Excitation, Station
from rig.core.numerics.decibels import from_decibels
from rig.core.scene.excitation import Shock
from rig.core.scene.excitation.shock import PULSE_POSITION
from rig.core.scene.scene import Scene

# Maximum number of practice pulses before the test aborts, unless the scene specifies more; convergent corrections need
# fewer.
_MAX_PRACTICE = 3
# Highest frequency of the drive relative to the sample rate, below the transition band of the converter.
_BAND_RATIO = 0.4
# Deviations that grow by this factor do not converge: the drive does not compensate vibration of earlier pulses.
_MIN_DIVERGENCE_RATIO = 1.2
# Time without drive after the last pulse, as a fraction of the interval between pulses.
_REST_PER_INTERVAL = 0.25


def _remedy(deviations: Sequence[float], is_coherent: bool) -> str:
    """Return the remedy for pulses with these deviations, in their order.

    `is_coherent`: whether the pulse without its incoherent lines is within its tolerance.
    """
    if deviations[-1] > _MIN_DIVERGENCE_RATIO * deviations[0]:
        return (
            "The deviation grows from pulse to pulse: the structure vibrates longer than test.interval. Give a longer "
            "interval."
        )
    if not is_coherent:
        return (
            f"Lines with a coherence below {MIN_COHERENCE:g} are missing in the pulse. Use a more sensitive sensor, a "
            "smaller converter.range, a higher level, or a longer pulse."
        )
    return "Add practice pulses at higher levels (test.practice), or widen the tolerance."


def _run_pulse(
    station: Station, test: Shock, replication: Replication, pulse: Pulse, level: float, kind: str, number: int
) -> Any:
    """Run a pulse at a level in dB, mark it, correct the drive, and return the deviation with its description."""
    first, ratio = station.now, from_decibels(level)
    period = pulse.target.size
    readings = yield station.drive(replication.drive(ratio))
    response = accelerations(station, [station.row_of(test.control)], readings, replication.lines, period)[0]
    wave = replication.to_wave(response) / ratio
    deviation, message = pulse.deviation(wave)
    replication.correct(response, ratio)
    # The readings of the window begin earlier than its drive by the latency.
    start = max(first - station.latency, 0)
    station.mark(
        kind, start, start + period, number=number, level=level, peak=round(float(abs(wave).max()) * ratio, 6),
        deviation=round(deviation, 4), tolerance=pulse.tolerance, unit=pulse.unit,
        center=start + round(PULSE_POSITION * period),
    )  # fmt: skip
    return deviation, message


class ShockProcedure(Procedure["Shock"]):
    """Shocks at a control channel."""

    form = Form("shock of the scene", ())
    waits_for_sensors = True

    def excite(self, station: Station, test: Shock) -> Excitation:
        """Run practice pulses (marked `practice`) and shocks (marked `shock`)."""
        period = station.samples(test.interval)
        pulse = pulse_of(test, period, station.rate)
        lines = lines_between(pulse.band[0], min(pulse.band[1], _BAND_RATIO * station.rate), period, station.rate)
        row = station.row_of(test.control)
        required = np.asarray(abs(np.fft.rfft(pulse.target)[lines]) * (2.0 / period))
        [gain], [coherence] = yield from identify(station, [row], lines, period, required, np.full(1, np.inf), "shock")
        replication = Replication(pulse.target, lines, np.where(coherence >= MIN_COHERENCE, gain, 0.0))
        station.check_output(float(abs(replication.drive(1.0)).max()), "the pulse", pulse.remedy)
        is_coherent = pulse.deviation(pulse.target - replication.unknown_part())[0] <= pulse.tolerance
        levels, n_practice = list(test.practice), max(_MAX_PRACTICE, len(test.practice))
        total, number, is_within, message, deviations = n_practice + test.repeats, 0, False, "", list[float]()
        while levels or not is_within:
            if number == n_practice:
                raise AbortedTest(f"after {number} practice pulses {message}. {_remedy(deviations, is_coherent)}")
            level = levels.pop(0) if levels else test.practice[-1]
            number += 1
            station.report(number / total, f"practice pulse {number} at {level:g} dB")
            deviation, message = yield from _run_pulse(station, test, replication, pulse, level, "practice", number)
            deviations.append(deviation)
            is_within = deviation <= pulse.tolerance
            station.check_output(float(abs(replication.drive(1.0)).max()), "the pulse", pulse.remedy)
        outside = []
        for number in range(1, test.repeats + 1):
            station.report((n_practice + number) / total, f"shock {number} of {test.repeats}")
            deviation, message = yield from _run_pulse(station, test, replication, pulse, 0.0, "shock", number)
            deviations.append(deviation)
            if deviation > pulse.tolerance:
                outside.append(f"shock {number}: {message}")
        yield station.zero_drive(station.samples(_REST_PER_INTERVAL * test.interval))
        if outside:
            station.warn(f"{'; '.join(outside)}. {_remedy(deviations, is_coherent)}")

    def waits(self, test: Shock, scene: Scene) -> float:
        """Return the expected time of the identification, and of the time without drive at the end [s]."""
        return (EXPECTED_PERIODS + _REST_PER_INTERVAL) * test.interval

    def stored(self, test: Shock) -> float:
        """Return the length of a pulse with its interval [s]."""
        return test.interval

    def part(self, test: Shock, seconds: float, scene: Scene) -> Shock:
        """Return the test with one shock: all shocks are equal."""
        return test.replace(repeats=1)


PROCEDURE = ShockProcedure()
