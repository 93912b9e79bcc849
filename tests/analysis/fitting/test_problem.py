"""Derivatives of the residuals against finite differences, and detection of undetermined parameter combinations."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import analysis
import daq
import rig
from analysis.core.fitting.estimate import Estimate
from analysis.core.fitting.identifiability import describe_coupled_values
from analysis.core.fitting.measured import measured_curves
from analysis.core.fitting.parameters import free_parameters, with_ratio_per_mode
from analysis.core.fitting.problem import Problem

SWEEP = Path(__file__).parents[3] / "recordings" / "demo-sweep-no-damper.mcap"
FORCE_TOLERANCE = 0.05


def test_residual_derivatives_agree_with_differences():
    model = with_ratio_per_mode(rig.load("bare-structure"))
    with daq.open(SWEEP) as recording:
        problem = Problem(model, free_parameters(model), measured_curves(recording, "sweep"))
    x, step = problem.start + np.linspace(0.002, 0.01, problem.size), 1e-7
    exact = problem.jacobian(x, problem.groups)
    for k, unit in enumerate(np.eye(problem.size)):
        forward, backward = (problem.residual(x + sign * step * unit, problem.groups) for sign in (1.0, -1.0))
        assert exact[:, k] == pytest.approx((forward - backward) / (2.0 * step), abs=1e-5 * abs(exact[:, k]).max())


@pytest.mark.parametrize("damping", [0.0005, 0.01])
def test_force_tolerance_limits_masses(tmp_path, damping):
    scene = rig.loads(f"""
structure: {{masses: [0.21 kg], springs: [72 kN/m], damping: {{modal: {damping}}}}}
shaker: {{kind: force, body: 1}}
test: {{kind: stepped_sine, from: 80 Hz, to: 110 Hz, points: 15, force: 0.7 N}}
channels:
- {{name: b1, at: body 1, accelerometer: {{sensitivity: 10 mV/g}}}}
- {{name: F, at: shaker, hammer: {{sensitivity: 100 mV/N, sensitivity_tolerance: {FORCE_TOLERANCE}}}}}
converter: {{rate: 2048 Hz}}
""")
    mass = analysis.fit(daq.record(scene, tmp_path / "a.mcap"), scene)["structure.masses[1]"]
    assert mass.low < 0.21 < mass.high
    # 1.96 standard deviations of a uniform distribution within the tolerance.
    assert mass.half_width == pytest.approx(1.96 * FORCE_TOLERANCE / 3**0.5, rel=0.1)


def test_expanded_uncertainty_is_within_limits_of_error():
    # Two unknowns: of random errors alone, and of a tolerance of 1 % with a much smaller random error.
    factor = np.array([[0.001, 0.0], [1e-5, 0.01 / np.sqrt(3.0)]])
    expanded = Estimate(np.zeros(2), factor, 1.0, 1).expanded()
    np.testing.assert_allclose(expanded, [0.002, 0.01 + 2e-5])


def test_combination_of_few_parameters_is_reported():
    # The largest singular value belongs to a change of all nine parameters, but of each by less than 2 %.
    common_axis, opposite_axis = np.full(9, 1.0 / 3.0), np.append([0.5**0.5, -(0.5**0.5)], np.zeros(7))
    estimate = Estimate(np.zeros(9), np.stack([0.03 * common_axis, 0.029 * opposite_axis], axis=1), 1.0, 2)
    parameters = [SimpleNamespace(key=f"mass {k}", damper=None) for k in range(9)]
    problem = SimpleNamespace(parameters=parameters, groups=[], sensors=[])
    [text] = describe_coupled_values(problem, estimate, ["determined"] * 9, {})  # type: ignore[arg-type]
    assert text.startswith("mass 0, mass 1 can change in opposite directions")
