"""Whether dampers fly at a level, how high, and at which levels they serve."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from rig.damper_design.choice import COARSE, Question, Trial
from rig.damper_design.ranking import ALIKE
from rig.damper_design.worst_peak import Peak, curve
from rig.motion_map.grid import columns, natural_frequencies, take_off
from rig.orbits.problem import OrbitProblem
from rig.results import plainly

#: A level at which dampers serve reduces the peak by this much, dB.
SERVES = 1.0
#: Acceleration of the body of a damper at rest on its floor from which on dampers usually serve, g.
_LIVELY = 3.0


@dataclass(frozen=True)
class Flight:
    """What makes the dampers of a choice fly.

    Attributes
    ----------
    take_off : float
        Level from which on a damper flies somewhere in the band, N.
    body : int
        Its body, from 1.
    height : float
        How far a damper without ceiling rises above its floor in the band at the levels of the question, m; NaN where
        part of the motion is irregular, or the dampers have a ceiling that they reach.
    """

    take_off: float
    body: int
    height: float

    def reach(self, level: float) -> float:
        """Largest acceleration of a damper's body at a level, all dampers at rest on their floors, g."""
        return level / self.take_off


def flight(question: Question, trial: Trial, unreached: bool) -> Flight:
    """Compute where the dampers of a trial take off, and how high they fly.

    Parameters
    ----------
    unreached : bool
        Whether the height is wanted.
    """
    choice = trial.choice
    bare = question.scenes[0]
    levels = []
    for body, damper in zip(choice.bodies, choice.dampers(question.landings), strict=True):
        alone = bare.replace(dampers=[damper])
        levels.append((float(take_off(alone, _frequencies(question, trial)).min()), body))
    first, body = min(levels)
    return Flight(first, body, height(question, trial) if unreached else np.nan)


def height(question: Question, trial: Trial) -> float:
    """How far dampers without ceilings rise above their floors, m; NaN where part of the motion is irregular."""
    dampers = trial.choice.without_ceiling().dampers(question.landings)
    highest = 0.0
    for scene in question.scenes:
        problem = OrbitProblem(scene.replace(dampers=dampers))
        for level in question.levels:
            for orbit in curve(problem, level, _frequencies(question, trial)).orbits:
                if orbit is None:
                    return np.nan
                gaps = [values.max() for name, values in orbit.columns().items() if name.startswith("gap")]
                highest = max(highest, *map(float, gaps))
    return highest


def _frequencies(question: Question, trial: Trial) -> np.ndarray:
    scene = question.scenes[0].replace(dampers=trial.choice.dampers(question.landings))
    low, high = question.band
    natural = natural_frequencies(scene, low, high)
    peaks = [peak.frequency for peak in trial.peaks]
    return np.unique(np.concatenate([columns(scene, low, high, COARSE), natural, peaks]))


def idle_levels(trial: Trial, bare: Peak, flight_: Flight) -> list[float]:
    """Give the levels at which the dampers of a trial do not fly, or reduce the peak by no more than is resolved."""
    return sorted(
        peak.level
        for peak in trial.peaks
        if _reduction(bare, peak) <= ALIKE or flight_.reach(peak.level) <= 1.0
    )


def shortfall(
    trial: Trial, bare: Peak, flight_: Flight, charted: Mapping[float, Peak], trials: Iterable[Trial]
) -> list[str]:
    """Say at which levels the dampers do not serve, why, and at which some do; nothing if they serve everywhere.

    Parameters
    ----------
    charted : mapping of float to Peak
        Peak of these dampers by level, N.
    trials : iterable of Trial
        All that were tried.
    """
    idle = idle_levels(trial, bare, flight_)
    if not idle:
        return []
    reached = {peak.level: _reduction(bare, peak) for peak in trial.peaks}
    lines = []
    for level in idle:
        reach = flight_.reach(level)
        does = "cannot fly" if reach <= 1.0 else "hardly fly"
        lines.append(
            f"at {plainly(level)} N the dampers {does}: that needs more than 1 g, and body {flight_.body} reaches "
            f"{plainly(reach)} g; they change the peak by {-reached[level]:+.1f} dB"
        )
    most = {
        level: max(
            (_reduction(bare, p) for each in trials for p in each.peaks if p.level == level), default=0.0
        )
        for level in sorted(reached)
        if level > max(idle)
    }
    served = [level for level in most if most[level] >= SERVES]
    later = [
        level
        for level in charted
        if level > max(idle) and flight_.reach(level) > 1.0 and _reduction(bare, charted[level]) >= SERVES
    ]
    if served:
        forces = ",".join(f"{plainly(level)}N" for level in served)
        by = ", ".join(f"{most[level]:.1f} dB" for level in served)
        lines.append(
            f"--levels {forces} gives levels at which dampers serve: each alone reduced by up to {by}"
        )
    elif later:
        lines.append(
            f"these dampers reduce the peak by {SERVES:g} dB from {plainly(min(later))} N on (--levels)"
        )
    else:
        lively = plainly(_LIVELY * flight_.take_off)
        lines.append(
            f"dampers usually serve from {_LIVELY:g} g on: give levels from {lively} N on (--levels)"
        )
    return lines


def _reduction(bare: Peak, peak: Peak) -> float:
    return 20.0 * float(np.log10(bare.size / peak.size))
