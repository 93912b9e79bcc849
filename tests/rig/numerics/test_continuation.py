"""Numerical continuation: solution curves are followed through folds, and the reason for each end is reported."""

import numpy as np
import pytest

from rig.core.numerics.continuation import NoConvergence, Steps, Vector, locate_folds, solve_at, trace


def circle(x: Vector) -> tuple[Vector, Vector]:
    """Return the residual of the unit circle and its Jacobian; the last element of x is the parameter."""
    return np.array([x @ x - 1]), 2 * x[None, :]


def test_circle_closes_with_folds_at_unit_radius() -> None:
    curve = trace(circle, np.array([1.0, 0.0]), (-2, 2), np.ones(2))

    assert curve.ends == ("closed", "closed")
    assert np.abs(np.hypot(*curve.points.T) - 1).max() < 1e-12
    np.testing.assert_allclose(sorted(locate_folds(circle, curve)[:, 1]), [-1, 1], atol=1e-12)


def test_curve_ends_on_its_bound_exactly() -> None:
    curve = trace(circle, np.array([1.0, 0.0]), (-0.5, 0.75), np.ones(2))

    assert curve.ends == ("range", "range")
    assert curve.points[0, -1] == -0.5
    assert curve.points[-1, -1] == 0.75
    assert np.abs(np.hypot(*curve.points.T) - 1).max() < 1e-12


def test_curve_ends_at_a_border() -> None:
    curve = trace(
        circle, np.array([1.0, 0.0]), (-2, 2), np.ones(2), margins=lambda x: (np.array([0.3 - x[1]]), ["too high"])
    )

    assert curve.ends == ("too high", "too high")
    assert 0.3 - 1e-9 < curve.points[-1, 1] <= 0.3


def test_border_off_the_chord_is_approached_again() -> None:
    calls = iter([1.0, 1.0, -1.0])
    curve = trace(
        circle, np.array([1.0, 0.0]), (-2, 2), np.ones(2), margins=lambda x: (np.array([next(calls, 1.0)]), ["once"])
    )

    assert curve.ends == ("closed", "closed")


def test_failed_convergence_reports_the_last_point() -> None:
    # The curve x = 1 + p^1.5 ends at p = 0.
    def semicubical_parabola(x: Vector) -> tuple[Vector, Vector]:
        with np.errstate(invalid="ignore"):
            root = np.sqrt(x[1]) if x[1] >= 0 else np.nan
        return np.array([x[0] - 1 - root * x[1]]), np.array([[1.0, -1.5 * root]])

    curve = trace(semicubical_parabola, np.array([2.0, 1.0]), (-1, 1.5), np.ones(2))

    assert curve.ends[1] == "range"
    assert curve.ends[0].startswith("no convergence: the equations have values that are not finite at parameter ")
    assert float(curve.ends[0].split()[-1]) == pytest.approx(curve.points[0, -1], rel=1e-6)
    assert 0 <= curve.points[0, -1] < 1e-6


def test_parameter_without_solution_is_reported() -> None:
    # The unit circle has no point at 2.
    with pytest.raises(NoConvergence):
        solve_at(circle, np.array([0.1, 0.0]), 2.0, np.ones(2), Steps())
