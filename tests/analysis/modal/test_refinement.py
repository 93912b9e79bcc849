"""Refinement of modal parameters: normal equations and reduced problem, compared with full matrices."""

import numpy as np
import pytest

from analysis.core.modal import refinement
from analysis.core.modal.pole_errors import refined_pole_errors
from analysis.core.modal.refinement import Likelihood, take_step
from analysis.core.modal_models.pole_residue import Curves, Projection, fit
from rig.core.results.uncertainty import LineCovariance

RESPONSES, LINES = 3, 60


@pytest.fixture
def curves() -> Curves:
    """Return three responses with two modes and noise."""
    random = np.random.default_rng(7)
    frequency = np.linspace(8.0, 30.0, LINES)
    s = 2j * np.pi * frequency
    poles = 2 * np.pi * np.array([12.0, 21.0]) * (-0.02 + 1j)
    residues = random.standard_normal((RESPONSES, 2)) * 1e-2
    value = sum(
        r[:, None] * 1j / (s - p) - r[:, None] * 1j / (s - p.conjugate())
        for r, p in zip(residues.T, poles, strict=True)
    )
    noise = 1e-6 * (random.standard_normal(value.shape) + 1j * random.standard_normal(value.shape))
    return Curves(frequency, value + noise, np.full(value.shape, 1e6))


def test_normal_equations_equal_products_of_derivatives(curves: Curves, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(refinement, "_MAX_ELEMENTS", 100)
    model = fit(curves, 2 * np.pi * np.array([12.1, 20.8]) * (-0.03 + 1j))
    random = np.random.default_rng(3)
    # Factor of a positive definite covariance matrix of the responses at each line.
    root = random.standard_normal((LINES, RESPONSES, 5)) + 1j * random.standard_normal((LINES, RESPONSES, 5))
    problem = Likelihood(curves, LineCovariance(root @ root.conj().swapaxes(1, 2), 1.0), np.zeros((RESPONSES, LINES)))
    matrix, right_hand_side = problem.equations(model)
    # Derivatives of the residual with respect to each parameter, by central differences.
    steps = 1e-7 / np.sqrt(np.diag(matrix))
    derivatives = np.stack(
        [
            (problem.residual(take_step(curves, model, -step)) - problem.residual(take_step(curves, model, step)))
            / (2 * size)
            for step, size in zip(np.diag(steps), steps, strict=True)
        ],
        axis=2,
    )
    weighted = problem.information @ derivatives
    expected_matrix = np.einsum("kap,kaq->pq", weighted.conj(), derivatives).real
    scale = np.sqrt(np.outer(np.diag(expected_matrix), np.diag(expected_matrix)))
    np.testing.assert_allclose(matrix / scale, expected_matrix / scale, atol=1e-6)
    expected_right_hand_side = np.einsum("kap,ka->p", weighted.conj(), problem.residual(model)).real
    tolerance = 1e-6 * abs(right_hand_side * steps).max()
    np.testing.assert_allclose(right_hand_side * steps, expected_right_hand_side * steps, atol=tolerance)
    rows = random.standard_normal((len(right_hand_side), 2))
    np.testing.assert_allclose(problem.weights(model, rows / scale[0, 0]), weighted @ rows / scale[0, 0], rtol=1e-4)


def test_reduced_jacobian_has_the_same_normal_matrix(curves: Curves) -> None:
    problem = Projection(curves, 2 * np.pi * np.array([12.1, 20.8]) * (-0.03 + 1j))
    x = np.array([0.1, -0.05, 0.02, 0.03])
    # Jacobian of the four parameters, and the residuals.
    rows = np.column_stack([problem.jacobian(x).reshape(-1, 4), problem.residual(x).ravel()])
    reduced = np.column_stack([problem.reduced_jacobian(x), problem.reduced_residual(x)])
    assert reduced.shape == (5, 5)
    expected = rows.T @ rows
    np.testing.assert_allclose(reduced.T @ reduced, expected, rtol=1e-9, atol=1e-12 * abs(expected).max())


def test_fit_from_conjugate_poles_returns_the_same_modes(curves: Curves) -> None:
    start = 2 * np.pi * np.array([12.1, 20.8]) * (-0.03 + 1j)
    expected, model = fit(curves, start), fit(curves, start.conj())
    np.testing.assert_allclose(model.poles, expected.poles, rtol=1e-6)
    np.testing.assert_allclose(model.residue, expected.residue, rtol=1e-4)


def test_undetermined_pole_does_not_affect_other_uncertainties() -> None:
    poles = 2 * np.pi * np.array([20.0, 90.0]) * (-0.01 + 1j)
    # Decay rates of both poles, then their frequencies; the decay rate of the second pole is undetermined.
    correlation = np.eye(4) + 0.5 * (np.ones((4, 4)) - np.eye(4))
    deviation = np.array([1e-3, 1.0, 1e-3, 1e-3])
    errors = [
        refined_pole_errors(poles, correlation * np.outer(scale, scale))
        for scale in (deviation, deviation * [1.0, 1e12, 1.0, 1.0])
    ]
    np.testing.assert_allclose([error[0] for error in errors[0]], [error[0] for error in errors[1]], rtol=1e-6)


def test_fit_with_unknowns_for_every_value_is_exact() -> None:
    frequency = np.linspace(10.0, 17.0, 8)
    value = np.exp(1j * frequency)[None]
    # Seven residues and two residual terms have 16 real unknowns.
    start = 2 * np.pi * np.linspace(10.5, 16.5, 7) * (-0.02 + 1j)
    model = fit(Curves(frequency, value, np.ones(value.shape)), start)
    np.testing.assert_allclose(model.poles, start)
    assert model.misfit < 1e-12
