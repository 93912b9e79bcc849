"""Multipliers and derivatives of a computed orbit, compared with differences of simulated motions and of residuals."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rig.core.orbits.orbit import Orbit
from rig.core.orbits.periodic_orbit import set_to_orbit, start_propagator
from rig.core.orbits.problem import OperatingPoint, OrbitProblem
from rig.core.orbits.shooting import shoot


def assert_multipliers_are_those_of_differences(orbit, free, change, count=2, rtol=0.0001):
    """Compare the `count` largest multipliers; `free`: states to disturb, `change`: disturbance, SI units."""
    propagator, steps = start_propagator(OrbitProblem(orbit.problem.scene), orbit.operating_point)

    def state_after_a_period(unknown: int, disturbance: float) -> NDArray[np.float64]:
        set_to_orbit(propagator, orbit)
        propagator.state.z[unknown] += disturbance
        propagator.propagate_periods(steps, orbit.repetition)
        return propagator.state.z[free].copy()

    columns = [(state_after_a_period(i, change) - state_after_a_period(i, -change)) / (2.0 * change) for i in free]
    expected, computed = (np.sort(np.abs(each))[-count:] for each in (np.linalg.eigvals(columns), orbit.multipliers))
    np.testing.assert_allclose(computed, expected, rtol=rtol)


def assert_derivatives_are_those_of_differences(orbit: Orbit, setting: OperatingPoint, field: str) -> None:
    """Compare the derivatives of the equations of an orbit with respect to a field of the setting."""
    value, results = getattr(setting, field), []
    for factor in (1.0, 1.0 + 1e-6, 1.0 - 1e-6):
        equations, derivatives = orbit.problem.equations(replace(setting, **{field: factor * value}), orbit.plan, field)
        results.append(shoot(equations, derivatives, orbit.plan.sequence, orbit.unknowns))
    expected = (results[1].residual - results[2].residual) / (2e-6 * value)
    error = np.abs(results[0].jacobian[:, -1] - expected).max()
    assert error <= 1e-6 * max(np.abs(expected).max(), 1e-9)
