"""A pytest plugin for trials: the first example that fails is enough, as is a test that takes far too long.

Without numba, kernels run as plain Python. Their products in vector registers are machine code from the start: here
are the same sums in numpy.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import Phase, settings
from numba import config

from rig.numerics import simd

Array = np.ndarray
#: Time that a test may take, s.
LONGEST = 60


@pytest.hookimpl(tryfirst=True)
def pytest_configure() -> None:
    """Leave out the search for a simpler example."""
    settings.register_profile("quickly", settings.get_profile("project"), phases=[Phase.explicit, Phase.generate])
    settings.load_profile("quickly")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call() -> Iterator[None]:
    """Let no test go on for ever: none that serves here takes a tenth of that."""
    signal.signal(signal.SIGALRM, _too_long)
    signal.alarm(LONGEST)
    try:
        return (yield)
    finally:
        signal.alarm(0)


def _too_long(*_: object) -> None:
    raise TimeoutError(f"more than {LONGEST} s")


def _combine(matrix: Array, constant: Array, slot: int, vector: Array, columns: int, out: Array) -> None:
    out.reshape(-1)[: constant.shape[1]] = constant[slot] + vector[:columns] @ matrix[slot, :columns]


def _multiply(matrix: Array, slot: int, vector: Array, constant: Array, out: Array) -> None:
    out[:] = constant + vector @ matrix[slot]


def _negatives(vector: Array) -> int:
    return sum(1 << i for i in np.flatnonzero(vector < 0.0).tolist())


def _copy(source: Array, target: Array) -> None:
    target[: source.size] = source


def _exceeds(vector: Array, bound: Array) -> bool:
    return not (abs(vector[: bound.size]) <= bound).all()


def _transpose(window: Array, rows: Array, column: int) -> None:
    rows[:, column : column + simd.LANES] = window.T


if config.DISABLE_JIT:
    for name, function in {
        "combine": _combine,
        "combine_many": _combine,
        "multiply": _multiply,
        "negatives": _negatives,
        "lowest": np.min,
        "copy": _copy,
        "exceeds": _exceeds,
        "transpose": _transpose,
    }.items():
        setattr(simd, name, function)
