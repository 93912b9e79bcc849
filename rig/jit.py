"""How kernels are compiled: decorators around numba's `njit`.

All keep the machine code on disk, release the GIL, let multiplications and additions fuse (never reorder), and
leave out numba's reference counting. The kernel allocates nothing, and counting the references to its arrays
took longer than its arithmetic did; in exchange, compiled functions cannot create arrays, only fill them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numba

F = TypeVar("F", bound=Callable[..., object])

_OPTIONS = {"cache": True, "nogil": True, "fastmath": {"contract"}, "_nrt": False}


def compiled(function: F) -> F:
    """Compile a function of the kernel."""
    return numba.njit(**_OPTIONS)(function)  # type: ignore[call-overload]


def inlined(function: F) -> F:
    """Compile a function of the kernel into each of its callers: handing it hundreds of arrays takes longer."""
    return numba.njit(forceinline=True, **_OPTIONS)(function)  # type: ignore[call-overload]


def unfused(function: F) -> F:
    """Compile a function in which multiplications and additions stay apart.

    For loops over samples: a processor works them off several at a time and what is left one by one, and both have
    to give the same bits, however samples come in blocks.
    """
    options = {**_OPTIONS, "fastmath": False}
    return numba.njit(**options)(function)  # type: ignore[call-overload]
