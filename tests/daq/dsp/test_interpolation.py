"""The cubic of a segment has the four numbers that describe it."""

import numpy as np
import pytest

from daq.core.dsp.interpolation import cubic_coefficients, cubic_coefficients_kernel, parabola_moment


def test_cubic_has_its_ends_mean_and_moment() -> None:
    start, end, mean, moment = 0.3, -1.2, 0.7, 0.4
    c1, c2, c3 = cubic_coefficients(start, end, mean, moment)
    assert start + c1 + c2 + c3 == pytest.approx(end)
    assert start + c1 / 2 + c2 / 3 + c3 / 4 == pytest.approx(mean)
    assert start / 2 + c1 / 6 + c2 / 12 + c3 / 20 == pytest.approx(moment)


def test_parabola_has_no_cubic_term() -> None:
    start, end, mean = 0.3, -1.2, 0.7
    assert cubic_coefficients(start, end, mean, parabola_moment(start, end, mean))[2] == pytest.approx(0.0, abs=1e-12)


def test_kernel_and_arrays_give_the_same_bits() -> None:
    numbers = np.random.default_rng(1).normal(size=(4, 1000))
    rows = cubic_coefficients(*numbers)
    assert [cubic_coefficients_kernel(*column) for column in numbers.T.tolist()] == list(zip(*rows, strict=True))
