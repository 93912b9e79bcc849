"""The shooting equations of a periodic orbit: their Jacobian, and the matrix exponential.

The variables x are the unknowns of the orbit (state, flights, event times) and one parameter, such as the force. An
orbit's plan is its sequence of events; `setting` is its operating point (frequency, level, clearance, mass ratio).
"""

import numpy as np
import pytest
from scipy.linalg import expm

import rig
from rig.core.orbits.matrix_exponential import exponential
from rig.core.orbits.orbit import OrbitFamily
from rig.core.orbits.periodic_orbit import periodic_orbit
from rig.core.orbits.problem import OperatingPoint, OrbitProblem, vary
from tests.rig.orbits.scenes import driven_table_scene, finite_contact_scene

# Scene, frequency [Hz], tolerance of the derivatives.
JACOBIANS = [
    (rig.load("fig9"), 49.1, 2e-8),
    (rig.load("fig5-three-dampers"), 49.5, 2e-8),
    (rig.load("fig5-single-damper"), 48.5, 2e-8),
    (finite_contact_scene("fig9", {"duration": 4e-3}), 49.7, 5e-8),
    (finite_contact_scene("fig9", {"stiffness": 1e5, "damping": 300.0}), 49.7, 5e-8),
    (driven_table_scene(), 51.0, 1e-8),
]


@pytest.mark.parametrize("parameter", ["frequency", "level", "clearance", "mass_ratio"])
@pytest.mark.parametrize(("scene", "frequency", "tolerance"), JACOBIANS)
def test_shooting_jacobian_equals_finite_differences(scene, frequency, tolerance, parameter):
    problem, orbit = OrbitProblem(scene), periodic_orbit(scene, frequency)
    setting = OperatingPoint(frequency, problem.level, float(problem.system.clearance[0]), 1.0)
    family = OrbitFamily(problem, orbit.plan, setting, parameter, orbit.unknowns)
    # `vary` returns a function from a parameter value to the setting with this value.
    assert vary(setting, parameter)(getattr(setting, parameter)) == setting
    x = np.append(orbit.unknowns, getattr(setting, parameter))

    residual, jacobian = family(x)

    assert np.abs(residual).max() < 1e-12
    for column, unit in enumerate(np.diag(1e-6 * family.scale)):
        slope = (family(x + unit)[0] - family(x - unit)[0]) / 2e-6
        # The error of a central difference is the square of the step plus the rounding error over the step.
        np.testing.assert_allclose(jacobian[:, column] * family.scale[column], slope, atol=tolerance)


@pytest.mark.parametrize("time", [1e-9, 1e-3, 0.02, 0.3])
def test_unbalanced_matrix_exponential_equals_scipy(time: float) -> None:
    stiff, soft = 6.1e4, 1.0e3
    matrix = np.array([[0, 0, 1, 0], [0, 0, 0, 1], [-stiff, soft, -2.0, 0.5], [soft, -stiff, 0.5, -3.0]])

    computed = exponential(matrix, time, 260.0)

    expected = expm(matrix * time)
    # Velocities are about sqrt(stiff) = 250 rad/s times displacements: compare in these units.
    balance = np.array([1, 1, 250.0, 250.0])
    assert np.abs((computed - expected) / balance[:, None] * balance).max() < 1e-12
