"""The first zero of a guard that is given as a power series in tau from 0 to 1, compared with known roots."""

from itertools import pairwise

import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.core.numerics.bernstein import BERNSTEIN, MAX_HALVINGS, N_COEFFICIENTS, NO_CROSSING, first_crossing

# Rounding error of the guard.
ROUNDING = 1e-15


def crossing(series: np.ndarray, start: int = 0, rounding: float = ROUNDING) -> tuple[float, int]:
    """Return tau of the first zero and the number of ambiguous minima; `start`: multiplicity of the zero at 0."""
    work, spans = np.zeros((MAX_HALVINGS + 3, N_COEFFICIENTS)), np.zeros((MAX_HALVINGS + 3, 2))
    return first_crossing(np.asarray(series, dtype=float), start, rounding, work, spans, BERNSTEIN)


def power_series(*coefficients: float) -> np.ndarray:
    """Return the coefficients of a series, lowest power first, padded with zeros."""
    series = np.zeros(N_COEFFICIENTS)
    series[: len(coefficients)] = coefficients
    return series


def test_positive_guard_has_no_crossing() -> None:
    assert crossing(power_series(1.0, -0.5, 0.2)) == (NO_CROSSING, 0)


def test_first_of_two_roots_is_returned() -> None:
    # (tau - 0.3) (tau - 0.7)
    tau, ambiguous = crossing(power_series(0.3 * 0.7, -1.0, 1.0))

    assert tau == pytest.approx(0.3, abs=1e-15)
    assert ambiguous == 0


@pytest.mark.parametrize("depth", [1e-3, 1e-6, 1e-9, 1e-12, 1e-13])
def test_minimum_below_zero_is_detected(depth: float) -> None:
    # (tau - 0.5)^2 - depth
    tau, ambiguous = crossing(power_series(0.25 - depth, -1.0, 1.0))

    assert tau == pytest.approx(0.5 - np.sqrt(depth), abs=1e-7)
    assert ambiguous == 0


@pytest.mark.parametrize("height", [1e-3, 1e-9, 1e-13])
def test_minimum_above_zero_is_not_detected(height: float) -> None:
    assert crossing(power_series(0.25 + height, -1.0, 1.0)) == (NO_CROSSING, 0)


def test_double_root_is_ambiguous() -> None:
    tau, ambiguous = crossing(power_series(0.25, -1.0, 1.0))

    assert tau == NO_CROSSING
    assert ambiguous == 1


def test_falling_guard_at_zero_crosses_immediately() -> None:
    assert crossing(power_series(1e-17, -0.3, 0.1))[0] == 0.0


def test_rising_guard_at_zero_crosses_later() -> None:
    tau, _ = crossing(power_series(0.0, 0.4, -1.0))

    assert tau == pytest.approx(0.4, abs=1e-15)


def test_triple_zero_at_start_is_ignored() -> None:
    # The gap after a separation: tau^3 (0.6 - tau), with rounding errors in the low coefficients.
    series = power_series(3e-18, -2e-18, 1e-18, 0.6, -1.0)

    assert crossing(series, start=3)[0] == pytest.approx(0.6, abs=1e-14)
    assert crossing(series)[0] == pytest.approx(0.6, abs=1e-14)


@given(st.lists(st.floats(-1.5, 2.5), min_size=2, max_size=8), st.integers(0, 3))
def test_first_of_random_roots_is_located(roots: list[float], multiplicity: int) -> None:
    roots = [root for root in roots if abs(root) > 1e-2]
    inside = sorted(root for root in roots if 0.0 < root <= 1.0)
    # Nearly double roots and roots at the end of the step may be ambiguous.
    if any(b - a < 1e-3 for a, b in pairwise(inside)) or any(abs(root - 1) < 1e-6 for root in inside):
        return
    coefficients = [mpmath.mpf(1)]
    for root in roots:
        coefficients = [
            a - root * b for a, b in zip([mpmath.mpf(0), *coefficients], [*coefficients, mpmath.mpf(0)], strict=True)
        ]
    if coefficients[0] < 0:
        coefficients = [-c for c in coefficients]
    series = power_series(*([0.0] * multiplicity), *(float(c) for c in coefficients))

    tau, _ = crossing(series, start=multiplicity, rounding=1e-16)

    assert tau == (pytest.approx(inside[0], abs=1e-9) if inside else NO_CROSSING)
