"""Limit of the threads of BLAS, the library that multiplies and decomposes matrices for numpy and scipy.

For matrices of some tens of rows, its threads take longer to synchronize than to compute: the identification of modes
takes five times as long with two threads as with one.
"""

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

from threadpoolctl import threadpool_limits

P = ParamSpec("P")
R = TypeVar("R")


def with_one_blas_thread(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate a function that computes with many small matrices: while it runs, BLAS uses one thread."""

    @wraps(function)
    def limited(*args: P.args, **kwargs: P.kwargs) -> R:
        with threadpool_limits(1, user_api="blas"):
            return function(*args, **kwargs)

    return limited
