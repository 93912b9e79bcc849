"""Roots in a bracket."""

import math
from collections.abc import Callable

import pytest
from scipy.optimize import brentq

from rig.core.base.roots import bracketed_root


@pytest.mark.parametrize(
    ("function", "low", "high"),
    [
        (lambda x: x**3 - 2.0, 0.0, 2.0),
        (lambda x: x**3 + 0.01 * x, -1.0, 0.7),
        (lambda x: math.exp(20.0 * x) - 3.0, -5.0, 5.0),
        (lambda x: math.copysign(abs(x - 0.3) ** 0.5, x - 0.3), 0.0, 4.0),
        (lambda x: -1.0 if x < 1.0 else 1.0, -3.0, 2.0),
        (lambda x: x, 0.0, 1.0),
        (lambda x: x - 1.0, 0.0, 1.0),
    ],
)
def test_root_is_that_of_scipy(function: Callable[[float], float], low: float, high: float) -> None:
    assert bracketed_root(function, low, high, 1e-13) == brentq(function, low, high, xtol=1e-13)


def test_bracket_without_root_is_rejected() -> None:
    with pytest.raises(ValueError, match="same sign at 1 and 2"):
        bracketed_root(lambda x: x, 1.0, 2.0, 1e-13)
