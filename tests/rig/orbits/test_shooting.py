"""The shooting equations of an orbit: exact derivatives, and the underlying matrix exponential."""

import numpy as np
import pytest
from scipy.linalg import expm

import rig
from rig.orbits.matrix_exponential import exponential
from rig.orbits.orbit import OrbitFamily
from rig.orbits.periodic_orbit import periodic_orbit
from rig.orbits.problem import PARAMETERS, OperatingPoint, OrbitProblem, Parameter, vary


@pytest.mark.parametrize("parameter", PARAMETERS)
@pytest.mark.parametrize(
    ("name", "frequency"), [("fig9", 49.1), ("fig5-three-dampers", 49.5), ("fig5-single-damper", 48.5)]
)
def test_shooting_jacobian_equals_finite_differences(
    name: str, frequency: float, parameter: Parameter
) -> None:
    problem = OrbitProblem(rig.load(name))
    orbit = periodic_orbit(rig.load(name), frequency)
    clearance = float(problem.system.clearance[0])
    setting = OperatingPoint(frequency, problem.level, clearance, 1.0)
    family = OrbitFamily(problem, orbit.plan, setting, parameter, orbit.unknowns)
    assert vary(setting, parameter)(getattr(setting, parameter)) == setting
    x = np.append(orbit.unknowns, getattr(setting, parameter))

    residual, jacobian = family(x)

    assert np.abs(residual).max() < 1e-12
    for column, unit in enumerate(np.diag(1e-6 * family.scale)):
        slope = (family(x + unit)[0] - family(x - unit)[0]) / 2e-6
        # The differences are good to the square of the step plus rounding over it.
        np.testing.assert_allclose(jacobian[:, column] * family.scale[column], slope, atol=2e-8)


def test_drive_of_a_table_changes_with_frequency() -> None:
    scene = rig.load("fig9").replace(
        shaker={"kind": "table", "body": 1, "spring": 6600.0},
        test={"kind": "stepped_sine", "frequencies": [51.0], "drive": 1.0e-3},
    )
    problem = OrbitProblem(scene)
    orbit = periodic_orbit(scene, 51.0)
    family = OrbitFamily(problem, orbit.plan, orbit.setting, "frequency", orbit.unknowns)
    x = np.append(orbit.unknowns, 51.0)

    _, jacobian = family(x)

    step = np.zeros(x.size)
    step[-1] = 1e-6 * family.scale[-1]
    slope = (family(x + step)[0] - family(x - step)[0]) / 2e-6
    np.testing.assert_allclose(jacobian[:, -1] * family.scale[-1], slope, atol=1e-8)


@pytest.mark.parametrize("time", [1e-9, 1e-3, 0.02, 0.3])
def test_unbalanced_matrix_exponential_equals_another_method(time: float) -> None:
    stiff, soft = 6.1e4, 1.0e3
    matrix = np.array([[0, 0, 1, 0], [0, 0, 0, 1], [-stiff, soft, -2.0, 0.5], [soft, -stiff, 0.5, -3.0]])

    computed = exponential(matrix, time, 260.0)

    expected = expm(matrix * time)
    balance = np.array([1, 1, 250.0, 250.0])
    assert np.abs((computed - expected) / balance[:, None] * balance).max() < 1e-12
