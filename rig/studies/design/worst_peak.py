"""The worst peak of a structure with dampers at one force level: the maximum over all frequencies and bodies."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from rig.core.base.arrays import Array
from rig.core.base.errors import RunError
from rig.core.orbits.orbit import solve
from rig.core.orbits.problem import OperatingPoint, OrbitProblem
from rig.core.orbits.sweep import OrbitResponse, sweep
from rig.core.scene.scene import Scene
from rig.core.system.reference import linear_response, reference_per_level

#: A body's peak is refined if its compliance on the grid is at least this fraction of the largest refined peak.
MIN_REFINED_RATIO = 0.7


@dataclass(frozen=True, order=True)
class Peak:
    """A peak of displacement over the reference; peaks are ordered by their magnitude."""

    magnitude: float  # largest |X| / F [m/N]; if the table carries the structure, largest |X| / |X_table|
    frequency: float  # frequency of the peak [Hz]
    level: float  # force amplitude [N], or drive
    body: int  # number of the body, from 1
    acceleration: float  # amplitude of the body's acceleration at the peak [m/s²]
    irregular_share: float  # share of the band's frequencies with irregular motion, which is simulated and averaged

    def reduction_from(self, bare: "Peak") -> float:
        """Return the reduction relative to the peak without dampers [dB]."""
        return 20.0 * float(np.log10(bare.magnitude / self.magnitude))


def response_at_level(problem: OrbitProblem, level: float, frequencies: Array) -> OrbitResponse:
    """Compute the steady-state motion at each frequency, starting from the motion at the previous frequency."""
    return sweep(problem, OperatingPoint(float(frequencies[0]), level), problem.axis("frequency"), frequencies)


def refined_peak(problem: OrbitProblem, response: OrbitResponse, body: int) -> tuple[float, float]:
    """Compute the largest response of a body at any frequency (as `Peak.magnitude`), and its frequency [Hz].

    If the largest point is a periodic orbit, the maximum between its neighbors is computed over orbits with the same
    events, so it does not depend on the grid. If this point and both neighbors are irregular motion, a parabola is
    fitted to their 1 / magnitude^2, as at a linear resonance.
    """
    magnitude = np.abs(response.frf[body - 1])
    i = int(magnitude.argmax())
    largest, frequency = float(magnitude[i]), float(response.value[i])
    orbit = response.orbits[i]
    if i in (0, magnitude.size - 1):
        return largest, frequency
    three_points = slice(i - 1, i + 2)
    if response.simulated[three_points].all():
        curvature, slope, value_at_center = np.polyfit(
            response.value[three_points] - frequency, magnitude[three_points] ** -2.0, 2
        ).tolist()
        minimum = value_at_center - slope**2 / (4 * curvature) if curvature > 0.0 else 0.0
        if minimum > 0.0:
            return minimum**-0.5, frequency - slope / (2 * curvature)
    if orbit is None:
        return largest, frequency

    def negative_magnitude(trial_frequency: float) -> float:
        operating_point = OperatingPoint(float(trial_frequency), orbit.operating_point.level)
        try:
            solution = solve(problem, orbit.plan, operating_point, orbit.unknowns)
        except RunError:
            return 0.0
        return 0.0 if solution.flaw or not solution.stable else -abs(solution.frf[body - 1])

    bounds = (float(response.value[i - 1]), float(response.value[i + 1]))
    optimum = minimize_scalar(negative_magnitude, bounds=bounds, method="bounded", options={"xatol": 1e-3})
    return (float(-optimum.fun), float(optimum.x)) if -optimum.fun > largest else (largest, frequency)


def _reference_acceleration(scene: Scene, level: float, frequency: float) -> float:
    """Return the factor from `Peak.magnitude` to acceleration of the body, for a reference of one unit."""
    return level * reference_per_level(scene, frequency) * (2 * np.pi * frequency) ** 2


def linear_peak(scene: Scene, level: float, frequencies: Array, bodies: Sequence[int]) -> Peak:
    """Compute the largest peak of the given bodies of a scene without dampers."""
    rows = [body - 1 for body in bodies]

    def largest_magnitude(trial_frequency: float) -> float:
        return float(abs(linear_response(scene, [trial_frequency])[rows]).max())

    magnitude = abs(linear_response(scene, frequencies)[rows]).max(axis=0)
    i = int(magnitude.argmax())
    bounds = frequencies[max(i - 1, 0)], frequencies[min(i + 1, magnitude.size - 1)]
    optimum = minimize_scalar(lambda f: -largest_magnitude(f), bounds=bounds, method="bounded", options={"xatol": 1e-6})
    frequency = max(float(optimum.x), float(frequencies[i]), key=largest_magnitude)
    magnitudes = abs(linear_response(scene, [frequency])[rows, 0])
    body, largest = bodies[int(magnitudes.argmax())], float(magnitudes.max())
    return Peak(largest, frequency, level, body, largest * _reference_acceleration(scene, level, frequency), 0.0)


def peak_at(problem: OrbitProblem, level: float, frequencies: Array, bodies: Iterable[int]) -> Peak:
    """Compute the largest peak of the given bodies at one level."""
    response = response_at_level(problem, level, frequencies)
    on_grid = {body: float(np.abs(response.frf[body - 1]).max()) for body in bodies}
    peaks: list[Peak] = []
    for body in sorted(on_grid, key=lambda body: -on_grid[body]):
        if peaks and on_grid[body] < MIN_REFINED_RATIO * max(peaks).magnitude:
            continue
        magnitude, frequency = refined_peak(problem, response, body)
        acceleration = magnitude * _reference_acceleration(problem.scene, level, frequency)
        peaks.append(Peak(magnitude, frequency, level, body, acceleration, float(response.simulated.mean())))
    return max(peaks)
