"""Separation level and flight height of dampers, and the levels at which they reduce the peak of the response."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from rig.core.orbits.problem import OrbitProblem
from rig.core.results import format_number
from rig.core.scene.scene import Scene
from rig.core.system.assembly import assemble
from rig.core.system.open_loop_drive import damper_accelerations
from rig.studies.design.choice import Objective, Trial
from rig.studies.design.ranking import EQUAL_DB
from rig.studies.design.worst_peak import Peak, response_at_level
from rig.studies.motion_map.grid import natural_frequencies, select_frequencies

#: Dampers are effective if they reduce the peak by at least this value [dB].
EFFECTIVE_DB = 1.0
#: Number of frequencies over the band, in addition to natural frequencies and peaks, where the acceleration is largest.
_BAND_POINTS = 20
#: Acceleration of the body [g], with resting dampers, above which dampers are usually effective.
_EFFECTIVE_G = 3.0


@dataclass(frozen=True)
class Flight:
    """Take-off and flight height of the dampers of a design.

    `height`: largest height above the floor without a ceiling, over the band and the levels of the objective [m]; NaN
    if the motion at some frequency is irregular, or if the dampers reach their ceiling.
    """

    take_off: float  # lowest level at which a damper separates in the band, N or drive
    body: int  # body of this damper, from 1
    height: float

    def acceleration_g(self, level: float) -> float:
        """Return the largest acceleration [g] of a damper's body at a level while all dampers rest."""
        return level / self.take_off


def compute_flight(objective: Objective, trial: Trial, is_ceiling_unreached: bool) -> Flight:
    """Compute the separation level of a trial's dampers, and their flight height if they do not reach the ceiling."""
    scene = _damped_scene(objective, trial)
    omega = 2.0 * np.pi * _frequencies(objective, trial)
    accelerations = damper_accelerations(scene, assemble(scene), omega).max(axis=1)
    # The damper that takes off at the lowest level.
    first = int(accelerations.argmax())
    take_off = float(scene.gravity / accelerations[first])
    return Flight(take_off, trial.choice.bodies[first], _height(objective, trial) if is_ceiling_unreached else np.nan)


def _damped_scene(objective: Objective, trial: Trial) -> Scene:
    return objective.scenes[0].replace(dampers=trial.choice.dampers(objective.impact_law))


def _height(objective: Objective, trial: Trial) -> float:
    """Compute the largest height of dampers without ceilings [m]; NaN if the motion at some frequency is irregular."""
    dampers = trial.choice.without_ceiling().dampers(objective.impact_law)
    highest = 0.0
    for scene in objective.scenes:
        problem = OrbitProblem(scene.replace(dampers=dampers))
        for level in objective.levels:
            for orbit in response_at_level(problem, level, _frequencies(objective, trial)).orbits:
                if orbit is None:
                    return np.nan
                gaps = [values.max() for name, values in orbit.columns().items() if name.startswith("gap")]
                highest = max(highest, *map(float, gaps))
    return highest


def _frequencies(objective: Objective, trial: Trial) -> np.ndarray:
    scene = _damped_scene(objective, trial)
    low, high = objective.band
    natural = natural_frequencies(scene, low, high)
    peaks = [peak.frequency for peak in trial.peaks]
    return np.unique(np.concatenate([select_frequencies(scene, low, high, _BAND_POINTS), natural, peaks]))


def ineffective_levels(trial: Trial, bare: Peak, flight: Flight) -> list[float]:
    """Return the levels at which dampers do not fly, or change the peak by less than the resolution of the search."""
    return sorted(
        peak.level
        for peak in trial.peaks
        if peak.reduction_from(bare) <= EQUAL_DB or flight.acceleration_g(peak.level) <= 1.0
    )


def describe_shortfall(
    trial: Trial, bare: Peak, flight: Flight, charted: Mapping[float, Peak], trials: Iterable[Trial], unit: str
) -> list[str]:
    """Report ineffective levels, the reason, and effective levels; empty if the dampers are effective at all levels.

    `charted`: peak of these dampers at each level of the chart; `trials`: all designs computed; `unit`: of the levels.
    """
    ineffective = ineffective_levels(trial, bare, flight)
    if not ineffective:
        return []
    reductions_db = {peak.level: peak.reduction_from(bare) for peak in trial.peaks}
    lines = []
    for level in ineffective:
        acceleration = flight.acceleration_g(level)
        state, reason = "are not effective", "above 1 g, at which they take off"
        if acceleration <= 1.0:
            state, reason = "cannot fly", "take-off needs more than 1 g"
        lines.append(
            f"at {format_number(level)} {unit} the dampers {state} and change the peak by {-reductions_db[level]:+.1f} "
            f"dB: body {flight.body} reaches {format_number(acceleration)} g, {reason}"
        )
    largest_reductions_db = {
        level: max((p.reduction_from(bare) for other in trials for p in other.peaks if p.level == level), default=0.0)
        for level in sorted(reductions_db)
        if level > max(ineffective)
    }
    effective_levels = [level for level in largest_reductions_db if largest_reductions_db[level] >= EFFECTIVE_DB]
    charted_levels = [
        level
        for level in charted
        if level > max(ineffective)
        and flight.acceleration_g(level) > 1.0
        and charted[level].reduction_from(bare) >= EFFECTIVE_DB
    ]
    if effective_levels:
        levels = ",".join(f"{format_number(level)}{unit}" for level in effective_levels)
        reductions_text = ", ".join(
            f"{largest_reductions_db[level]:.1f} dB at {format_number(level)} {unit}" for level in effective_levels
        )
        lines.append(f"dampers can reduce the peak by up to {reductions_text}. Give `levels` {levels}.")
    elif charted_levels:
        lines.append(
            f"at levels of {format_number(min(charted_levels))} {unit} and more, these dampers reduce the peak by "
            f"{EFFECTIVE_DB:g} dB or more. Give such levels with `levels`."
        )
    else:
        suggested = format_number(_EFFECTIVE_G * flight.take_off)
        lines.append(
            f"dampers are usually effective if their body exceeds {_EFFECTIVE_G:g} g. Give levels above {suggested} "
            f"{unit} with `levels`."
        )
    return lines
