"""How kernels are compiled: decorators around numba's `njit`.

All keep the machine code on disk, release the GIL, let multiplications and additions fuse (never reorder), and
leave out numba's reference counting. The kernel allocates nothing, and counting the references to its arrays
took longer than its arithmetic did; in exchange, compiled functions cannot create arrays, only fill them.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

import numba

F = TypeVar("F", bound=Callable[..., object])

_OPTIONS = {"cache": True, "nogil": True, "fastmath": {"contract"}, "_nrt": False}


@functools.cache
def _forget_outdated(folder: Path) -> None:
    """Remove machine code that is older than a source in which other functions of it are.

    numba looks only at the file of the function that is called, not at those that were compiled into it.
    """
    code: dict[Path, float] = {}
    for path in (folder / "__pycache__").glob("*.nbi"):
        with suppress(FileNotFoundError):  # another process may be renewing it
            code[path] = path.stat().st_mtime
    oldest = min(code.values(), default=float("inf"))
    sources = {*folder.parent.rglob("*.py"), *Path(__file__).parent.glob("*.py")}
    newer = {path: path.stat().st_mtime for path in sources if path.stat().st_mtime > oldest}
    changed = max(
        (time for path, time in newer.items() if "rig.numerics.jit" in path.read_text()), default=0.0
    )
    for path, time in code.items():
        if time < changed:
            with suppress(OSError):
                path.unlink()


def _options(function: Callable[..., object]) -> dict[str, object]:
    _forget_outdated(Path(function.__code__.co_filename).parent)
    return _OPTIONS


def compiled(function: F) -> F:
    """Compile a function of the kernel."""
    return numba.njit(**_options(function))(function)  # type: ignore[call-overload]


def inlined(function: F) -> F:
    """Compile a function of the kernel into each of its callers: handing it hundreds of arrays takes longer."""
    return numba.njit(forceinline=True, **_options(function))(function)  # type: ignore[call-overload]


def unfused(function: F) -> F:
    """Compile a function in which multiplications and additions stay apart.

    For loops over samples: a processor works them off several at a time and what is left one by one, and both have
    to give the same bits, however samples come in blocks.
    """
    options = {**_options(function), "fastmath": False}
    return numba.njit(**options)(function)  # type: ignore[call-overload]
