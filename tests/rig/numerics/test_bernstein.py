"""The first crossing of a guard, against high-precision roots and against the definition."""

from itertools import pairwise

import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.numerics.bernstein import BERNSTEIN, MAX_HALVINGS, N_COEFFICIENTS, NO_CROSSING, first_crossing

ALLOWANCE = 1e-15


def crossing(series: np.ndarray, start: int = 0, allowance: float = ALLOWANCE) -> tuple[float, int]:
    work, spans = np.zeros((MAX_HALVINGS + 3, N_COEFFICIENTS)), np.zeros((MAX_HALVINGS + 3, 2))
    return first_crossing(np.asarray(series, dtype=float), start, allowance, work, spans, BERNSTEIN)


def padded(*coefficients: float) -> np.ndarray:
    series = np.zeros(N_COEFFICIENTS)
    series[: len(coefficients)] = coefficients
    return series


def test_positive_guard_has_no_crossing() -> None:
    assert crossing(padded(1.0, -0.5, 0.2)) == (NO_CROSSING, 0)


def test_first_of_two_roots_is_returned() -> None:
    tau, ambiguous = crossing(padded(0.3 * 0.7, -1.0, 1.0))

    assert tau == pytest.approx(0.3, abs=1e-15)
    assert ambiguous == 0


@pytest.mark.parametrize("depth", [1e-3, 1e-6, 1e-9, 1e-12, 1e-13])
def test_deep_graze_is_detected(depth: float) -> None:
    tau, ambiguous = crossing(padded(0.25 - depth, -1.0, 1.0))

    assert tau == pytest.approx(0.5 - np.sqrt(depth), abs=1e-7)
    assert ambiguous == 0


@pytest.mark.parametrize("height", [1e-3, 1e-9, 1e-13])
def test_near_miss_is_not_detected(height: float) -> None:
    assert crossing(padded(0.25 + height, -1.0, 1.0)) == (NO_CROSSING, 0)


def test_dip_within_rounding_is_ambiguous() -> None:
    tau, ambiguous = crossing(padded(0.25, -1.0, 1.0))

    assert tau == NO_CROSSING
    assert ambiguous == 1


def test_falling_zero_is_an_event_now() -> None:
    assert crossing(padded(1e-17, -0.3, 0.1))[0] == 0.0


def test_rising_zero_returns_later() -> None:
    tau, _ = crossing(padded(0.0, 0.4, -1.0))

    assert tau == pytest.approx(0.4, abs=1e-15)


def test_deflated_triple_root_lands() -> None:
    # What a damper does after it separates: tau^3 (0.6 - tau), its low coefficients at rounding level.
    series = padded(3e-18, -2e-18, 1e-18, 0.6, -1.0)

    assert crossing(series, start=3)[0] == pytest.approx(0.6, abs=1e-14)
    assert crossing(series)[0] == pytest.approx(0.6, abs=1e-14)


@given(st.lists(st.floats(-1.5, 2.5), min_size=2, max_size=8), st.integers(0, 3))
def test_first_sign_change_of_random_roots(roots: list[float], multiplicity: int) -> None:
    roots = [r for r in roots if abs(r) > 1e-2]
    inside = sorted(r for r in roots if 0.0 < r <= 1.0)
    if any(b - a < 1e-3 for a, b in pairwise(inside)) or any(abs(r - 1) < 1e-6 for r in inside):
        return
    coefficients = [mpmath.mpf(1)]
    for root in roots:
        coefficients = [
            a - root * b for a, b in zip([mpmath.mpf(0), *coefficients], [*coefficients, mpmath.mpf(0)], strict=True)
        ]
    if coefficients[0] < 0:
        coefficients = [-c for c in coefficients]
    series = padded(*([0.0] * multiplicity), *(float(c) for c in coefficients))

    tau, _ = crossing(series, start=multiplicity, allowance=1e-16)

    assert tau == (pytest.approx(inside[0], abs=1e-9) if inside else NO_CROSSING)
