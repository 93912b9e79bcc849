"""The best tuned mass damper of a given mass, as a comparison for particle dampers.

Natural frequency and damping minimize the worst peak of the linear response (H-infinity optimum). A tuned mass damper
splits a resonance into two, of which one may lie outside a narrow band. The peak is therefore searched in a wider band:
up to the geometric mean of the outermost mode in the band and the mode next to it, but at most a factor of 2 beyond the
outermost mode. The search starts from Den Hartog's rule for the modes in the band, and continues with the method of
Nelder and Mead. A tuned mass damper is linear: its peak does not depend on the level.

References
----------
Den Hartog, J. P., "Mechanical Vibrations", 4th ed., McGraw-Hill 1956, section 3.3.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from math import log, pi, sqrt

import numpy as np
import scipy.optimize

from rig.core.base.arrays import Array
from rig.core.scene.damper import Damper
from rig.core.scene.scene import Scene
from rig.core.system.reference import linear_response
from rig.core.system.structural_model import structural_model
from rig.studies.design.choice import Objective
from rig.studies.design.worst_peak import Peak, linear_peak

#: Number of frequencies in the band for each peak: several for each half-power width.
FREQUENCIES = 600
#: Number of dampers by Den Hartog's rule from which the search starts: those with the lowest peaks.
STARTS = 3
#: A mode is damped in a body if the damper's mass is at most this ratio of the modal mass there.
MAX_MASS_RATIO = 1.0


@dataclass(frozen=True)
class TunedMass:
    """A tuned mass damper and its peak; `frequency`: natural frequency on a body at rest [Hz]."""

    damper: Damper
    frequency: float
    damping_ratio: float
    peak: Peak

    def __str__(self) -> str:
        damper = self.damper
        return (
            f"tuned mass damper in body {damper.body}: {self.frequency:.4g} Hz, damping ratio "
            f"{100.0 * self.damping_ratio:.3g} % ({damper.spring:.4g} N/m, {damper.dashpot:.3g} N s/m)"
        )


def _damper(body: int, mass: float, frequency: float, damping_ratio: float) -> Damper:
    """Return the settings of a damper with a natural frequency [Hz] and a damping ratio."""
    omega = 2.0 * pi * frequency
    return Damper(body=body, mass=mass, spring=mass * omega**2, damping=2.0 * damping_ratio * mass * omega)


def _starts(objective: Objective, bodies: Iterable[int], mass: float) -> Iterator[tuple[int, float, float]]:
    """Yield body, natural frequency [Hz] and damping ratio by Den Hartog's rule, for each mode in the band."""
    modes = structural_model(objective.scenes[0]).modes
    low, high = objective.band
    for body in bodies:
        for k, frequency in enumerate(modes.frequency.tolist()):
            ratio = mass * float(modes.shapes[body - 1, k]) ** 2 / float(modes.mass[k])
            if low <= frequency <= high and 0.0 < ratio <= MAX_MASS_RATIO:
                yield body, frequency / (1.0 + ratio), sqrt(3.0 * ratio / (8.0 * (1.0 + ratio) ** 3))


def _searched_band(objective: Objective) -> tuple[float, float]:
    """Return the band of the objective [Hz], extended as described above."""
    low, high = objective.band
    natural = structural_model(objective.scenes[0]).modes.frequency
    inside = natural[(natural >= low) & (natural <= high)]
    if not inside.size:
        return low, high
    below, above = natural[natural < low].max(initial=0.0), natural[natural > high].min(initial=np.inf)
    lowest, highest = max(below, 0.25 * inside[0]), min(above, 4.0 * inside[-1])
    return min(low, sqrt(inside[0] * lowest)), max(high, sqrt(inside[-1] * highest))


def best_tuned_mass(objective: Objective, bodies: Iterable[int], mass: float) -> TunedMass | None:
    """Return the tuned mass damper with the lowest worst peak.

    `bodies`: bodies that can carry the damper, from 1; `mass`: kg. None if no mode in the band moves these bodies.
    """
    frequencies: Array = np.geomspace(*_searched_band(objective), FREQUENCIES)
    rows = [body - 1 for body in objective.bodies]

    def damped(damper: Damper) -> list[Scene]:
        return [scene.with_valid(dampers=(damper,)) for scene in objective.scenes]

    def worst(body: int, frequency: float, damping_ratio: float) -> float:
        scenes = damped(_damper(body, mass, frequency, damping_ratio))
        return max(float(abs(linear_response(scene, frequencies)[rows]).max()) for scene in scenes)

    starts = sorted(_starts(objective, bodies, mass), key=lambda start: worst(*start))[:STARTS]
    candidates: list[TunedMass] = []
    for body, frequency, damping_ratio in starts:
        optimum = scipy.optimize.minimize(
            lambda x, body=body: log(worst(body, float(np.exp(x[0])), float(np.exp(x[1])))),
            [log(frequency), log(damping_ratio)],
            method="Nelder-Mead",
            options={"xatol": 1e-4, "fatol": 1e-6, "maxfev": 200},
        )
        tuned, ratio = (float(value) for value in np.exp(optimum.x))
        damper = _damper(body, mass, tuned, ratio)
        peak = max(linear_peak(scene, objective.levels[0], frequencies, objective.bodies) for scene in damped(damper))
        candidates.append(TunedMass(damper, tuned, ratio, peak))
    return min(candidates, key=lambda candidate: candidate.peak, default=None)
