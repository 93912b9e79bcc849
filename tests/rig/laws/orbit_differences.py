"""Multipliers and derivatives of a computed orbit, compared with differences of simulated motions and of residuals."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rig.core.orbits.orbit import Orbit
from rig.core.orbits.periodic_orbit import set_to_orbit, start_propagator
from rig.core.orbits.problem import OperatingPoint, OrbitProblem
from rig.core.orbits.shooting import shoot


def assert_multipliers_are_those_of_differences(
    orbit: Orbit, free: Sequence[int] | None = None, step: float = 1e-6
) -> None:
    """Compare the multipliers with those of disturbed motions of the engine over a cycle.

    `free`: unknowns of the orbit to disturb, by default the state, and height and velocity of each damper in flight;
    `step`: disturbance in units of 1 mm, or of the largest speed of a motion of this amplitude.
    """
    problem, flying = OrbitProblem(orbit.problem.scene), orbit.plan.flying
    units = 1e-3 * np.array([1.0, 2.0 * np.pi * orbit.frequency])
    units = np.concatenate([np.repeat(units, problem.system.coordinates), np.tile(units, len(flying))])
    indices = np.arange(units.size) if free is None else np.array(free)

    def state_after_a_cycle(unknown: int, disturbance: float) -> NDArray[np.float64]:
        unknowns = orbit.unknowns.copy()
        unknowns[unknown] += disturbance
        propagator, steps = start_propagator(problem, orbit.setting)
        set_to_orbit(propagator, replace(orbit, unknowns=unknowns))
        propagator.propagate_periods(steps, orbit.repetition)
        flights = np.stack([propagator.state.height[flying], propagator.state.velocity[flying]], axis=1)
        return np.concatenate([propagator.state.z[: problem.system.states], flights.ravel()])[indices]

    columns = [
        (state_after_a_cycle(i, step * units[i]) - state_after_a_cycle(i, -step * units[i])) / (2.0 * step * units[i])
        for i in indices.tolist()
    ]
    # Each multiplier is compared with the nearest: close multipliers may be in a different order.
    distance = np.abs(np.linalg.eigvals(columns)[:, None] - orbit.multipliers)
    largest = np.argsort(np.abs(orbit.multipliers))[-2:]
    assert distance.min(axis=1).max() < 1e-5
    assert distance.min(axis=0)[... if free is None else largest].max() < 1e-5


def assert_derivatives_are_those_of_differences(orbit: Orbit, setting: OperatingPoint, field: str) -> None:
    """Compare the derivatives of the equations of an orbit with respect to a field of the setting."""
    value, results = getattr(setting, field), []
    for factor in (1.0, 1.0 + 1e-6, 1.0 - 1e-6):
        equations, derivatives = orbit.problem.equations(replace(setting, **{field: factor * value}), orbit.plan, field)
        results.append(shoot(equations, derivatives, orbit.plan.sequence, orbit.unknowns))
    expected = (results[1].residual - results[2].residual) / (2e-6 * value)
    error = np.abs(results[0].jacobian[:, -1] - expected).max()
    assert error <= 1e-6 * max(np.abs(expected).max(), 1e-9)
