"""Whether dampers fly at a level, how high, and at which levels they serve."""

from __future__ import annotations

from collections.abc import Sequence
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


def shortfall(
    trial: Trial, bare: Peak, flight_: Flight, levels: Sequence[float], charted: Sequence[Peak]
) -> list[str]:
    """Say at which levels the dampers do nothing, why, and at which they serve; nothing if they serve everywhere.

    Parameters
    ----------
    levels, charted
        Levels, N, and the peak of these dampers at each.
    """

    def reduction(peak: Peak) -> float:
        return 20.0 * float(np.log10(bare.size / peak.size))

    idle = [peak.level for peak in trial.peaks if reduction(peak) <= ALIKE]
    asked = dict(zip([peak.level for peak in trial.peaks], trial.peaks, strict=True))
    if not idle:
        return []
    lines = []
    for level in sorted(idle):
        reach = flight_.reach(level)
        does = "cannot fly" if reach <= 1.0 else "hardly fly"
        lines.append(
            f"at {plainly(level)} N the dampers {does}: that needs more than 1 g, and body {flight_.body} reaches "
            f"{plainly(reach)} g; they change the peak by {-reduction(asked[level]):+.1f} dB"
        )
    serving = [level for level, peak in zip(levels, charted, strict=True) if reduction(peak) >= SERVES]
    lasting = [level for level in serving if level > max(idle)]
    if lasting:
        lines.append(
            f"they reduce the peak by {SERVES:g} dB and more from {plainly(min(lasting))} N on: give such levels "
            "(--levels)"
        )
    else:
        lines.append(
            f"dampers usually serve from {_LIVELY:g} g on: give levels from {plainly(_LIVELY * flight_.take_off)} N on "
            "(--levels)"
        )
    return lines
