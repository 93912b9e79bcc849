"""Decorators that compile kernels with numba, and store the machine code on disk.

A kernel is a compiled function with the decorator `kernel`, `inlined_kernel` or `unfused_kernel`. Kernels release the
GIL, may fuse multiplications with additions (but never reorder them), and create no arrays.

The name of the folder of machine code contains a digest of all source files that a kernel may contain. numba itself
checks only the file of the function that is called, not the files of its callees; after a change of a callee it would
run outdated code.
"""

from __future__ import annotations

import functools
import gc
import hashlib
import inspect
import os
import re
import shutil
import threading
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, Generic, TypeVar, TypeVarTuple, cast

import llvmlite.binding
import numba
import platformdirs
from numba.core.event import Event, Listener, register

from rig.core.base.console import warn_of_compilation

F = TypeVar("F", bound=Callable[..., object])
ArgumentTs = TypeVarTuple("ArgumentTs")
ResultT = TypeVar("ResultT")

_CONFIG: Any = numba.config
_ROOT = Path(__file__).parents[3]
# A newline instead of `^`, because the search for a constant prefix is ten times as fast.
_IMPORTS = re.compile(rb"\nfrom ((?:rig|daq)(?:\.\w+)+) import")
# Number of allocations between runs of the cyclic garbage collector while numba compiles (Python default 700). The
# compiler creates little garbage; more frequent runs would take a fifteenth of the compile time.
_GC_THRESHOLD = 100_000
#: Machine code that was not used for this time is removed; older code may still be in use by other checkouts.
_MAX_UNUSED_S = 30 * 86400.0

try:
    from rig.core.numerics import callees
except (ImportError, AttributeError):
    # With another version of numba, `numba.njit` itself is used; it gives bit-identical results, but compiles twice as
    # long.
    callees = None  # type: ignore[assignment]


@functools.cache
def _digest(folder: Path) -> str:
    """Return a digest of the compiler and of all source files that a kernel of a folder may contain.

    These are the files of the folder, and of the folders with kernels from which it imports.
    """
    digest = hashlib.sha256(repr((numba.__version__, callees is None)).encode())
    digest.update(repr((llvmlite.binding.get_host_cpu_name(), llvmlite.binding.get_host_cpu_features())).encode())
    pending, visited = [folder], {folder}
    while pending:
        texts, names = _sources(pending.pop())
        for text in texts:
            digest.update(text)
        for name in names:
            module = _ROOT / name.decode().replace(".", "/")
            imported = module if module.is_dir() else module.parent
            if imported not in visited and _has_kernels(imported):
                pending.append(imported)
            visited.add(imported)
    return digest.hexdigest()[:16]


@functools.cache
def _sources(folder: Path) -> tuple[list[bytes], list[bytes]]:
    """Return the source texts of a folder, and the names of the modules of this project that they import."""
    texts = [file.read_bytes() for file in sorted(folder.glob("*.py"))]
    return texts, sorted({name for text in texts for name in _IMPORTS.findall(text)})


def _has_kernels(folder: Path) -> bool:
    """Return whether a module of a folder defines compiled functions."""
    return any(b"from rig.core.numerics.jit import" in text for text in _sources(folder)[0])


def machine_code_root() -> Path:
    """Return the folder of all machine code."""
    cache = os.environ.get("NUMBA_CACHE_DIR") or platformdirs.user_cache_dir("shotrig", appauthor=False)
    return Path(cache) / "machine-code"


@functools.cache
def code_folder(source: Path) -> Path | None:
    """Create the folder for the machine code of the kernels in a source folder; None if it cannot be written."""
    folder = machine_code_root() / f"{source.name}-{_digest(source)}"
    is_new = not folder.is_dir()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        TemporaryFile(dir=folder).close()
        os.utime(folder)
        # Old code is looked for when code is added, not at each start.
        for other in folder.parent.iterdir() if is_new else ():
            if time.time() - other.stat().st_mtime > _MAX_UNUSED_S:
                shutil.rmtree(other, ignore_errors=True)
    except OSError:
        warn_of_compilation(
            f"the folder {folder} for machine code cannot be written, so every start compiles it again (up to a "
            "minute). Set the environment variable NUMBA_CACHE_DIR to a folder that can be written."
        )
        return None
    return folder


class CodeFolder:
    """Location of a function's machine code for numba (`NUMBA_CACHE_LOCATOR_CLASSES`), common to all checkouts."""

    def __init__(self, function: Callable[..., object]) -> None:
        self._folder, self._line = code_folder(_source_folder(function)), function.__code__.co_firstlineno

    @classmethod
    def from_function(cls, function: Callable[..., object], file: str) -> CodeFolder:
        """Locate the code of a function."""
        return cls(function)

    def ensure_cache_path(self) -> None:
        """Do nothing: the folder exists."""

    def get_cache_path(self) -> str:
        """Return the folder."""
        return str(self._folder)

    def get_source_stamp(self) -> str:
        """Return a constant: changed source code has its own folder (`_digest`)."""
        return ""

    def get_disambiguator(self) -> str:
        """Return the line of the function, to distinguish functions of the same name."""
        return str(self._line)


def _source_folder(function: Callable[..., object]) -> Path:
    """Return the folder of the file that defines a function."""
    return Path(inspect.getfile(function)).parent


class _Compiling(Listener):
    """Report compilation in the log, and collect garbage seldom during it."""

    def __init__(self) -> None:
        self._gc_thresholds: list[tuple[int, ...]] = []

    def on_start(self, event: Event) -> None:
        """Report the start; from here on, garbage is collected seldom."""
        young, *older = gc.get_threshold()
        self._gc_thresholds.append((young, *older))
        gc.set_threshold(young and max(young, _GC_THRESHOLD), *older)
        if event.data is None or event.data["dispatcher"].py_func.__module__.startswith(("rig.", "daq.")):
            warn_of_compilation(
                "compiling machine code for this processor, once: about 20 s, or up to a minute if several parts of "
                "the program are needed"
            )

    def on_end(self, event: Event) -> None:
        """Collect garbage as before."""
        gc.set_threshold(*self._gc_thresholds.pop())


register("numba:compile", _Compiling())


class _Kernel:
    """A compiled function whose dispatcher of numba is created at its first use; its arguments are positional.

    Most kernels are used only in the stored code of other kernels. Their dispatchers would take 2 % of the CPU time of
    `rig explain`.
    """

    _lock = threading.RLock()  # for the configuration of numba

    def __init__(self, function: Callable[..., object], options: dict[str, Any]) -> None:
        functools.update_wrapper(self, function)
        self._function, self._options = function, options

    def __call__(self, *arguments: Any) -> Any:
        return self._dispatcher(*arguments)

    def __reduce__(self) -> str:
        # As a function, a kernel is copied and pickled as a reference.
        return self._function.__qualname__

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self._dispatcher, name)

    @functools.cached_property
    def _dispatcher(self) -> Any:
        """Compiler of the function; the machine code is stored in `code_folder` if this can be written."""
        folder = code_folder(_source_folder(self._function))
        compiler = numba.njit if callees is None or _CONFIG.DISABLE_JIT else callees.njit
        with self._lock:
            if "_dispatcher" in vars(self):
                # Another thread has created it.
                return vars(self)["_dispatcher"]
            previous, _CONFIG.CACHE_LOCATOR_CLASSES = _CONFIG.CACHE_LOCATOR_CLASSES, "rig.core.numerics.jit.CodeFolder"
            try:
                dispatcher = compiler(self._function, cache=folder is not None, **self._options)
                return vars(self).setdefault("_dispatcher", dispatcher)
            finally:
                _CONFIG.CACHE_LOCATOR_CLASSES = previous


def _njit(function: F, is_kernel: bool, **options: Any) -> F:
    # Without the numba runtime, kernels do not count references to their arrays, which would take most of their time.
    return cast(F, _Kernel(function, options | ({"_nrt": False} if is_kernel else {})))


def cached_njit(function: F) -> F:
    """Compile a function that is not a kernel; it may create arrays."""
    return _njit(function, is_kernel=False)


def kernel(function: F) -> F:
    """Compile a kernel."""
    return _njit(function, is_kernel=True, nogil=True, fastmath={"contract"})


def inlined_kernel(function: F) -> F:
    """Compile a kernel into each of its callers: a call that passes hundreds of arrays would take longer."""
    return _njit(function, is_kernel=True, forceinline=True, nogil=True, fastmath={"contract"})


class RepeatedCall(Generic[*ArgumentTs, ResultT]):
    """Call of a kernel whose arguments have the same types and memory layouts at each call.

    numba identifies types and layouts of all arguments in every call, which takes 0.1 us for each array, also in
    tuples. From the second call on, this is omitted if the kernel is compiled for one signature. The machine code does
    not check types and layouts.
    """

    def __init__(self, function: Callable[[*ArgumentTs], ResultT]) -> None:
        self._kernel = self._call = function

    def __call__(self, *arguments: *ArgumentTs) -> ResultT:
        """Call the kernel."""
        result = self._call(*arguments)
        if self._call is self._kernel:
            overloads = getattr(self._kernel, "overloads", {})
            if len(overloads) == 1:
                self._call = next(iter(overloads.values())).entry_point
        return result


def unfused_kernel(function: F) -> F:
    """Compile a kernel in which multiplications and additions are not fused.

    Use it for loops over samples. The processor computes most samples in groups and the others individually. Both
    results must be bit-identical, so that they do not depend on the block size.
    """
    return _njit(function, is_kernel=True, nogil=True, fastmath=False)
