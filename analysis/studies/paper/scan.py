"""Scans of the peak compliance near a resonance over force, clearance, mass ratio and damping.

Each frequency response consists of exact stable orbits (`rig.orbit_response`). Where the motion is irregular, it is
simulated and averaged, and the share of these frequencies is reported.
"""

import numpy as np
import scipy

from analysis.studies.paper.store import Arrays
from rig.core.base.arrays import Array
from rig.core.orbits.problem import OrbitProblem
from rig.core.scene.scene import Scene
from rig.core.steady_response.motion_type import combined_type
from rig.core.system.structural_model import receptance
from rig.studies.design.worst_peak import refined_peak, response_at_level

# Number, from 1, of the body whose peak compliance is scanned.
REPORTED_BODY = 2
# Force levels relative to the nominal force; the largest peak over these levels is the worst peak.
LEVELS = np.array([0.8, 1.0, 1.25])


def with_dampers(scene: Scene, clearance: float, mass_ratio: float) -> OrbitProblem:
    """Return the orbit problem of a scene with a common clearance and mass ratio for all its dampers."""
    dampers = [d.replace(clearance=float(clearance), mass=None, mass_ratio=mass_ratio) for d in scene.dampers]
    return OrbitProblem(scene.replace(dampers=dampers))


def scan(scene: Scene, forces: Array, clearances: Array, frequencies: Array, mass_ratio: float) -> Arrays:
    """Compute peak compliance and type of motion around a resonance, over force (rows) and clearance (columns).

    Returns `force`, `clearance`, and in shape (forces, clearances): `peak`, largest |X| / F_1 of `REPORTED_BODY` [m/N];
    `peak_frequency` [Hz]; `type_at_peak`, the type of motion there; `types`, all types of motion of the dampers, joined
    by spaces; `orbit_share`, share of the frequencies with an exact stable orbit; `exact`, whether the motion at the
    peak is an exact orbit.
    """
    shape = (len(forces), len(clearances))
    peak, peak_frequency, orbit_share = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    type_at_peak, types = np.empty(shape, dtype="U24"), np.empty(shape, dtype="U400")
    exact = np.zeros(shape, dtype=bool)
    for column, clearance in enumerate(clearances):
        problem = with_dampers(scene, float(clearance), mass_ratio)
        for row, force in enumerate(forces):
            response = response_at_level(problem, float(force), frequencies)
            cell = row, column
            peak[cell], peak_frequency[cell] = refined_peak(problem, response, REPORTED_BODY)
            i = int(np.abs(response.compliance[REPORTED_BODY - 1]).argmax())
            type_at_peak[cell] = combined_type(response.damper_motion[:, i].tolist())
            types[cell] = " ".join(sorted(set(response.damper_motion.ravel().tolist())))
            orbit_share[cell], exact[cell] = 1 - response.simulated.mean(), not response.simulated[i]
    return {
        "force": forces,
        "clearance": clearances,
        "peak": peak,
        "peak_frequency": peak_frequency,
        "type_at_peak": type_at_peak,
        "types": types,
        "orbit_share": orbit_share,
        "exact": exact,
    }


def type_iii_over_damping(scene: Scene, dampings: Array, clearances: Array, frequencies: Array) -> Arrays:
    """Compute whether Type III occurs near the resonance, over damping ratio (rows) and clearance (columns).

    Returns `damping`, `clearance`, and in shape (dampings, clearances): `has_type_iii`, and `peak`, the largest
    compliance of `REPORTED_BODY` [m/N].
    """
    shape = (len(dampings), len(clearances))
    has_type_iii, peak = np.zeros(shape, dtype=bool), np.zeros(shape)
    for row, damping in enumerate(dampings):
        structure = scene.structure.replace(damping={"modal": float(damping)})
        for column, clearance in enumerate(clearances):
            dampers = [d.replace(clearance=float(clearance)) for d in scene.dampers]
            problem = OrbitProblem(scene.replace(structure=structure, dampers=dampers))
            response = response_at_level(problem, problem.level, frequencies)
            has_type_iii[row, column] = bool((response.damper_motion == "III").any())
            peak[row, column] = refined_peak(problem, response, REPORTED_BODY)[0]
    return {"damping": dampings, "clearance": clearances, "has_type_iii": has_type_iii, "peak": peak}


def least_affected(
    scene: Scene,
    dampings: Array,
    mass_ratios: Array,
    forces: Array,
    bands: dict[int, tuple[float, float]],
    points: int = 40,
) -> Arrays:
    """Compute the ratio of the peaks of body 3 with and without dampers, over damping, mass ratio, force and mode.

    `bands`: frequency band [Hz] around each mode. Returns `peak_ratio` (dampings, mass_ratios, forces, modes), and
    `damping`, `mass_ratio` and `force`.
    """
    ratios = np.empty((len(dampings), len(mass_ratios), len(forces), len(bands)))
    for i, damping in enumerate(dampings):
        structure = scene.structure.replace(damping={"modal": float(damping)})
        bare = scene.replace(structure=structure)
        for k, band in enumerate(bands.values()):
            frequency = np.linspace(*band, points)
            without_dampers = receptance(bare, np.linspace(*band, 50 * points))[2]
            for j, ratio in enumerate(mass_ratios):
                problem = with_dampers(bare, np.inf, float(ratio))
                for n, force in enumerate(forces):
                    peak = refined_peak(problem, response_at_level(problem, float(force), frequency), 3)[0]
                    ratios[i, j, n, k] = peak / abs(without_dampers).max()
    return {"peak_ratio": ratios, "damping": dampings, "mass_ratio": mass_ratios, "force": forces}


class _WorstPeak:
    """Function of clearance and mass ratio: the largest peak over `LEVELS` times the force; results are cached."""

    def __init__(self, scene: Scene, force: float, frequencies: Array) -> None:
        self.scene, self.force, self.frequencies = scene, force, frequencies
        self.trials: dict[tuple[float, float], float] = {}  # results by clearance in m and mass ratio
        self.orbit_shares: list[float] = []  # share of the frequencies with an exact stable orbit, for each response

    def __call__(self, clearance: float, mass_ratio: float) -> float:
        key = (float(clearance), float(mass_ratio))
        if key not in self.trials:
            problem = with_dampers(self.scene, *key)
            peaks = []
            for level in LEVELS:
                response = response_at_level(problem, float(self.force * level), self.frequencies)
                peaks.append(refined_peak(problem, response, REPORTED_BODY)[0])
                self.orbit_shares.append(1 - float(response.simulated.mean()))
            self.trials[key] = max(peaks)
        return self.trials[key]

    def arrays(self) -> Arrays:
        """Return trials in the order of the search, and the best of them."""
        best = min(self.trials, key=lambda key: self.trials[key])
        return {
            "clearance": np.array([clearance for clearance, _ in self.trials]),
            "mass_ratios": np.array([ratio for _, ratio in self.trials]),
            "worst": np.array(list(self.trials.values())),
            "best": np.array(best[0]),
            "mass_ratio": np.array(best[1]),
            "peak": np.array(self.trials[best]),
            "orbit_share": np.array(np.mean(self.orbit_shares)),
        }


def best_clearance(scene: Scene, force: float, mass_ratio: float, clearances: Array, frequencies: Array) -> Arrays:
    """Compute the clearance with the smallest peak compliance over a range of forces.

    A grid of the given clearances is refined around the best by Brent's method. The criterion is the worst peak at
    `LEVELS` times the force.

    Returns `clearance`, `mass_ratios` and `worst` (trials,) in the order of the search; `best`, `mass_ratio` and
    `peak`: the best clearance, its mass ratio and worst peak; `orbit_share`: share of all frequencies with an exact
    stable orbit.
    """
    worst = _WorstPeak(scene, force, frequencies)
    grid = np.log(clearances)
    values = [worst(np.exp(x), mass_ratio) for x in grid]
    i = int(np.clip(np.argmin(values), 1, len(grid) - 2))
    scipy.optimize.minimize_scalar(
        lambda x: worst(np.exp(x), mass_ratio),
        bounds=(grid[i - 1], grid[i + 1]),
        method="bounded",
        options={"maxiter": 9},
    )
    return worst.arrays()


def best_damper(
    scene: Scene, force: float, mass_ratios: Array, clearances: Array, frequencies: Array, trials: int = 30
) -> Arrays:
    """Compute the clearance and mass ratio that minimize the largest peak compliance at `LEVELS` times the force.

    Returns the same arrays as `best_clearance`. The best point of a grid is improved by the Nelder-Mead
    simplex method. The mass ratio is limited to the range of the grid.
    """
    worst = _WorstPeak(scene, force, frequencies)
    for ratio in mass_ratios:
        for clearance in clearances:
            worst(float(clearance), float(ratio))
    start = min(worst.trials, key=lambda key: worst.trials[key])
    step = np.array([0.15, 0.2 * (mass_ratios[-1] - mass_ratios[0])])
    first = np.array([np.log(start[0]), start[1]])
    low, high = mass_ratios[0], mass_ratios[-1]
    # The initial simplex lies within the limits of the mass ratio.
    inward = np.array([1.0, -1.0 if first[1] + step[1] > high else 1.0])
    corners = first + np.array([[0, 0], [step[0], 0], [0, step[1]]]) * inward
    scipy.optimize.minimize(
        lambda x: worst(np.exp(x[0]), x[1]),
        first,
        method="Nelder-Mead",
        bounds=[(None, None), (low, high)],
        options={"initial_simplex": corners, "maxfev": trials, "xatol": 1e-3, "fatol": 0.0},
    )
    return worst.arrays()
