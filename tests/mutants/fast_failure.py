"""A pytest plugin that detects a mutation quickly: a test fails at its first failing example, or after a time limit.

With NUMBA_DISABLE_JIT=1 kernels run as plain Python, but the functions of `rig.core.numerics.simd` exist only as
machine code. This plugin replaces them with equal functions in numpy.
"""

import signal
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import Phase, settings
from numba import config

from rig.core.numerics import simd

Array = np.ndarray
#: Time limit of a test. The tests used here take less than a tenth of it.
TIME_LIMIT_S = 60


@pytest.hookimpl(tryfirst=True)
def pytest_configure() -> None:
    """Do not simplify a failing example."""
    settings.register_profile("fast failure", settings.get_profile("project"), phases=[Phase.explicit, Phase.generate])
    settings.load_profile("fast failure")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call() -> Iterator[None]:
    """Fail a test after the time limit."""
    signal.signal(signal.SIGALRM, _too_long)
    signal.alarm(TIME_LIMIT_S)
    try:
        return (yield)
    finally:
        signal.alarm(0)


def _too_long(*_: object) -> None:
    raise TimeoutError(f"more than {TIME_LIMIT_S} s")


def _affine_product(matrix: Array, constant: Array, index: int, vector: Array, columns: int, out: Array) -> None:
    out.reshape(-1)[: constant.shape[1]] = constant[index] + vector[:columns] @ matrix[index, :columns]


def _multiply(matrix: Array, index: int, vector: Array, constant: Array, out: Array) -> None:
    out[:] = constant + vector @ matrix[index]


def _negatives(vector: Array) -> int:
    """Return a bit mask of the negative elements."""
    return sum(1 << i for i in np.flatnonzero(vector < 0.0).tolist())


def _copy(source: Array, target: Array) -> None:
    target[: source.size] = source


def _exceeds(vector: Array, bound: Array) -> bool:
    return not (abs(vector[: bound.size]) <= bound).all()


def _transpose(window: Array, rows: Array, column: int) -> None:
    rows[:, column : column + simd.LANES] = window.T


if config.DISABLE_JIT:
    for name, function in {
        "affine_product": _affine_product,
        "affine_product_many": _affine_product,
        "multiply": _multiply,
        "negative_bits": _negatives,
        "minimum": np.min,
        "copy": _copy,
        "exceeds": _exceeds,
        "transpose": _transpose,
    }.items():
        setattr(simd, name, function)
