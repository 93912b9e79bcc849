"""A frequency curve as exact orbits and by simulation to steady state: `python -m tests.benchmarks.orbits`."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import TypeVar

import numpy as np

import rig
from rig.system.open_loop_drive import with_ideal_force

T = TypeVar("T")

# Scene, band [Hz], points: resonances of the scenes of Figs 5, 8 and 9 where the motion is regular; and, last, a
# band where some of it is not, which both have to wait for.
CURVES = (
    ("fig9", (47.0, 50.85), 200),
    ("fig5-single-damper", (46.0, 51.0), 200),
    ("fig8-two-dampers", (46.0, 52.0), 200),
    ("fig8-three-dampers", (46.0, 52.0), 200),
    ("fig8-three-dampers", (8.0, 32.0), 240),
)
REPEATS = 3


def measure() -> Iterator[str]:
    """Yield a line for every curve."""
    yield (
        f"{'curve':38} {'points':>6} {'simulated':>12} {'orbits':>10} {'ratio':>6} {'differ':>8} "
        f"{'residual':>8} {'irregular':>9}"
    )
    for name, band, points in CURVES:
        scene = with_ideal_force(rig.load(name))
        frequencies = np.linspace(*band, points)
        # What is compiled is loaded here; the rest is run in turns and the best kept.
        rig.frequency_response(scene, frequencies[:2])
        rig.orbit_response(scene, frequencies[:2])
        waited, settled = _best(lambda: rig.frequency_response(scene, frequencies))  # noqa: B023
        took, swept = _best(lambda: rig.orbit_response(scene, frequencies))  # noqa: B023
        both = settled.converged & ~swept.simulated
        size = np.abs(settled.compliance).max(axis=0)
        differ = np.median((np.abs(swept.compliance - settled.compliance).max(axis=0) / size)[both])
        residual = max(orbit.residual for orbit in swept.orbits if orbit is not None)
        yield (
            f"{name + f', {band[0]:g} to {band[1]:g} Hz':38} {points:6} {1e3 * waited:9.0f} ms {1e3 * took:7.0f} ms "
            f"{waited / took:6.1f} {differ:8.0e} {residual:8.0e} {int(swept.simulated.sum()):9}"
        )


def _best(run: Callable[[], T]) -> tuple[float, T]:
    """CPU time of the quickest of some runs, and what came of it."""
    times = []
    for _ in range(REPEATS):
        began = time.process_time()
        result = run()
        times.append(time.process_time() - began)
    return min(times), result


if __name__ == "__main__":
    print(*measure(), sep="\n")
