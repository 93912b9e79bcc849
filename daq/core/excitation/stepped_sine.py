"""Stepped sine test: at each frequency, wait for the steady state and measure; then change to the next frequency.

A measurement contains whole periods.
"""

import math
from collections.abc import Generator, Sequence
from typing import Any, TypeVar

import numpy as np

from daq.core.excitation.controlled import controlled
from daq.core.excitation.lock_in import snr_gain
from daq.core.excitation.procedure import FormValues, Procedure
from daq.core.excitation.station import Excitation, Station
from daq.core.excitation.tones.steady_tone import SteadyTone, listed
from rig.core.base.arrays import Array
from rig.core.results.text import format_decimals
from rig.core.scene.excitation import Continuation, PhaseResonance, SteppedSine
from rig.core.scene.excitation.kind import KindOfTest
from rig.core.scene.excitation.stepped_sine import SteppedTest
from rig.core.scene.scene import Scene
from rig.core.system.structural_model import structural_model

SteadyT = TypeVar("SteadyT", bound="SteppedTest | PhaseResonance | Continuation")

# An extrapolated drive is used if the logarithm of its ratio to the last drive is at most this value. Otherwise the
# last drive is used again.
_MAX_LOG_CHANGE = 0.2
# The wait of a dwell has this fixed part [s], measured with the bundled scenes.
_FIXED_WAIT_S = 1.4
# Decay in the remaining part of the wait, in time constants of the slowest mode: exp(-2) = 14 %.
_STEP_TIME_CONSTANTS = 2.0


def excite(station: Station, test: SteppedTest, tone: SteadyTone) -> Generator[Array, Array, int]:
    """Run a tone through all dwells at each level; return the number of dwells in steady state.

    The wait (`settle`) and the measurement (`measure`) of each dwell are marked.
    """
    dwells = list(test.order)
    up_dwells = len(dwells) // 2 if test.direction == "both" else len(dwells)
    total, completed = len(test.levels) * len(dwells), 0
    unsettled: list[str] = []
    limited: list[str] = []
    for level in test.levels:
        drive = tone.start(level)
        last_drives: list[tuple[float, float]] = []  # frequency in Hz and drive amplitude
        tone.frequency = dwells[0]
        at_level = station.level_text(level)
        for index, frequency in enumerate(dwells):
            direction = "down" if test.direction == "down" or index >= up_dwells else "up"
            station.report(completed / total, f"{format_decimals(frequency, 2)} Hz {direction}, {at_level}")
            if station.is_controlled and last_drives:
                drive = min(extrapolate_drive(last_drives, frequency), station.drive_limit)
            fields = {"frequency": frequency, "level": level, "direction": direction}
            settled = yield from tone.settle_and_mark(
                {frequency: drive}, test.settle.tolerance, test.settle.longest, fields
            )
            yield from tone.measure(round(test.measure.periods * station.rate / frequency), settled, fields)
            if not settled:
                dwells_of_cause = limited if tone.control and tone.amplitude >= station.drive_limit else unsettled
                dwells_of_cause.append(f"{frequency:.4g} Hz {direction} at {at_level}")
            drive = tone.amplitude
            last_drives = [*last_drives[-2:], (frequency, drive)]
            completed += 1
        yield tone.end()
    if limited:
        shaker = station.scene.driven_shaker
        limit = f"{station.drive_limit:g} {'' if shaker is None else shaker.drive_unit}"
        station.warn(
            f"{len(limited)} of {total} dwells did not reach the required level, because the drive is at the limit of "
            f"the amplifier, {limit} ({listed(limited)}). Lower the level, or raise shaker.amplifier.limit."
        )
    if unsettled:
        station.warn(
            f"{len(unsettled)} of {total} dwells did not reach steady state at the required level within "
            f"{test.settle.longest:g} s ({listed(unsettled)}). Their points are marked; increase "
            "test.settle.longest to wait longer."
        )
    station.report(1.0, "done")
    return total - len(unsettled) - len(limited)


def expected_wait(scene: Scene, longest: float) -> float:
    """Return the expected time from one measurement to the next [s] from the slowest mode; `longest`: limit [s]."""
    modes = structural_model(scene).modes
    longest_time_constant = float(1.0 / max(modes.decay_rate[modes.omega > 0.0].min(initial=np.inf), 1e-3))
    return _FIXED_WAIT_S + min(_STEP_TIME_CONSTANTS * longest_time_constant, longest)


def extrapolate_drive(last_drives: Sequence[tuple[float, float]], frequency: float) -> float:
    """Extrapolate the drive to a frequency in Hz by a parabola through the logarithms of the last three drives.

    `last_drives`: pairs of frequency [Hz] and drive. Returns the last drive if the extrapolated change is large.

    >>> round(extrapolate_drive([(10.0, 1.0), (11.0, 1.1), (12.0, 1.2)], 13.0), 3)
    1.298
    >>> extrapolate_drive([(12.0, 1.0), (13.0, 2.0), (14.0, 40.0)], 15.0)
    40.0
    """
    frequencies, drives = [point[0] for point in last_drives], np.log([point[1] for point in last_drives])
    if len(last_drives) < 3 or len(set(frequencies)) < 3:
        return float(np.exp(drives[-1]))
    # Weights of Lagrange interpolation.
    weights = [
        math.prod((frequency - other) / (node - other) for other in frequencies if other != node)
        for node in frequencies
    ]
    change = float(np.dot(weights, drives) - drives[-1])
    return float(np.exp(drives[-1] + (change if abs(change) < _MAX_LOG_CHANGE else 0.0)))


class SteadyTonesProcedure(Procedure[SteadyT]):
    """Tones that are measured in steady state, over `test.measure` periods."""

    detection = "dwells"

    def snr_gain(self, test: SteadyT, frequency: Array) -> Array:
        """Return the signal-to-noise ratio over the measured periods [sqrt(s)]; see `Procedure.snr_gain`."""
        return snr_gain(test.measure.periods, frequency)

    def waits(self, test: SteadyT, scene: Scene) -> float:
        """Return the expected time of the waits before all measurements [s]."""
        return _tones_of(test) * expected_wait(scene, test.settle.longest)

    def from_form(self, values: FormValues, test: KindOfTest | None) -> dict[str, Any]:
        """Return the settings of the form; a motion is controlled at the body of the scene's test, or at body 1."""
        return {**super().from_form(values, test), "at": getattr(test, "at", "body 1")}

    def part(self, test: SteadyT, seconds: float, scene: Scene) -> SteadyT:
        """Return the test at its highest level only."""
        return KindOfTest.at_level(test, max(test.levels))

    def seconds(self, test: SteadyT, part: SteadyT, part_seconds: float) -> float:
        """Return the expected duration of all levels and tones [s]."""
        return part_seconds * _tones_of(test) / _tones_of(part)

    def periods_of_step(self, test: SteadyT) -> int:
        """Return the number of measured periods of each dwell."""
        return int(test.measure.periods)


def _tones_of(test: KindOfTest) -> int:
    """Return the number of tones of all levels."""
    return len(test.levels) * len(test.dwells or test.given_frequencies)


class SteppedSineProcedure(SteadyTonesProcedure["SteppedSine"]):
    """Tones of constant force or drive."""

    rehearsal = "peaks"

    def excite(self, station: Station, test: SteppedSine) -> Excitation:
        """Yield the drive of the test block by block, and mark the measured intervals."""
        yield from excite(station, test, SteadyTone(station, test.order[0], controlled(station)))


PROCEDURE = SteppedSineProcedure()
