"""CPU time of response curves from periodic orbits, compared with simulation to steady state.

python -m tests.benchmarks.orbits
"""

import time
from collections.abc import Callable, Iterator
from typing import TypeVar

import numpy as np

import rig
from rig.core.system.open_loop_drive import with_ideal_force

T = TypeVar("T")

# Scene, frequency band [Hz], number of points. The motion is periodic near the resonances of the first four curves. The
# last curve has some non-periodic motion, which `orbit_response` simulates too.
CURVES = (
    ("fig9", (47.0, 50.85), 200),
    ("fig5-single-damper", (46.0, 51.0), 200),
    ("fig8-two-dampers", (46.0, 52.0), 200),
    ("fig8-three-dampers", (46.0, 52.0), 200),
    ("fig8-three-dampers", (8.0, 32.0), 240),
)
REPEATS = 3


def measure() -> Iterator[str]:
    """Yield a header, and a line for each curve: times of both methods, and errors of the orbits.

    The deviation from simulation is the median over the points where both methods converge. The residual is the
    largest deviation of an orbit from periodicity. At non-periodic points the motion is simulated instead.
    """
    yield (
        f"{'curve':38} {'points':>6} {'simulated':>12} {'orbits':>10} {'ratio':>6} {'deviation':>9} "
        f"{'residual':>8} {'non-periodic':>12}"
    )
    for name, band, points in CURVES:
        scene = with_ideal_force(rig.load(name))
        frequencies = np.linspace(*band, points)
        # Load compiled code before the measurement.
        rig.frequency_response(scene, frequencies[:2])
        rig.orbit_response(scene, frequencies[:2])
        simulation_time, reference = _shortest_time(lambda: rig.frequency_response(scene, frequencies))  # noqa: B023
        orbit_time, orbits = _shortest_time(lambda: rig.orbit_response(scene, frequencies))  # noqa: B023
        both_converged = reference.converged & ~orbits.simulated
        magnitude = np.abs(reference.compliance).max(axis=0)
        deviation = np.median(
            (np.abs(orbits.compliance - reference.compliance).max(axis=0) / magnitude)[both_converged]
        )
        residual = max(orbit.residual for orbit in orbits.orbits if orbit is not None)
        yield (
            f"{name + f', {band[0]:g} to {band[1]:g} Hz':38} {points:6} {1e3 * simulation_time:9.0f} ms "
            f"{1e3 * orbit_time:7.0f} ms {simulation_time / orbit_time:6.1f} "
            f"{deviation:9.0e} {residual:8.0e} {int(orbits.simulated.sum()):12}"
        )


def _shortest_time(run: Callable[[], T]) -> tuple[float, T]:
    """Return the shortest CPU time of `REPEATS` runs, and the last result."""
    times = []
    for _ in range(REPEATS):
        start = time.process_time()
        result = run()
        times.append(time.process_time() - start)
    return min(times), result


if __name__ == "__main__":
    print(*measure(), sep="\n")
