"""How kernels are compiled: decorators around numba's `njit`.

All keep the machine code on disk, under a key of everything that went into it (`KernelCache`). Those of the engine's
kernel also release the GIL, let multiplications and additions fuse (never reorder), and leave out numba's
reference counting. The kernel allocates nothing, and counting the references to its arrays took longer than its
arithmetic did; in exchange, compiled functions cannot create arrays, only fill them.
"""

from __future__ import annotations

import functools
import hashlib
import inspect
import logging
import os
import pickle
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryFile
from threading import get_ident
from types import CodeType, FunctionType
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba.core import types
from numba.core.caching import FunctionCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.event import Event, Listener, register
from numba.core.serialize import dumps
from numba.misc.appdirs import AppDirs

from rig import console

F = TypeVar("F", bound=Callable[..., object])

_KERNEL = {"nogil": True, "fastmath": {"contract"}, "_nrt": False}
# Functions of these do not change but with their version, which numba looks at, or are not compiled in.
_LIBRARIES = {"builtins", "llvmlite", "numba", "numpy", "typing"}
# Bytes of a file's checksum.
_SEAL = 32


class KernelCache(FunctionCache):
    """Machine code on disk that is used only for what it was made of, and only if it is sound.

    numba looks at the file of the function that is called alone, not at what is compiled into it: functions and
    constants of other modules, and the order of the fields of named tuples. As the key says all that counts, one
    folder of the user serves every checkout, environment and version.

    Parameters
    ----------
    function : callable
        What is compiled.
    options : dict
        How, as numba's `njit` takes it.

    Raises
    ------
    OSError
        If no folder can be written to.
    """

    def __init__(self, function: Callable[..., object], options: dict[str, Any]) -> None:
        try:
            super().__init__(function)
        except RuntimeError as error:
            raise OSError(f"no folder for the machine code of {function.__qualname__}") from error
        self._options = repr(sorted(options.items()))
        self._creates_arrays = options.get("_nrt", True)
        # Some systems allow no <locals> in the name of a file.
        name = f"{function.__module__}.{function.__qualname__}".replace("<", "").replace(">", "")
        self._cache_file: Any = CodeFiles(_folder(), name)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Give the machine code for a signature, None if there is none; say so, as compiling takes long."""
        if self._creates_arrays:
            target_context.refresh()
        # The code of other functions needs nothing of what refreshing brings in, which takes longer than loading it.
        code = self._load_overload(sig, target_context)
        if code is None:
            _say_once("compiling machine code for this processor, once: up to a minute")
        return code

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep machine code; on a disk that is full or gone, the next process compiles again."""
        with suppress(OSError):
            super().save_overload(sig, data)

    def _index_key(self, sig: Any, codegen: Any) -> tuple[Any, ...]:
        fields = [getattr(kind, "fields", None) for kind in sig]
        made_of = ingredients(self._py_func), self._options, repr(fields)
        return (sys.implementation.cache_tag, *super()._index_key(sig, codegen), *made_of)


@functools.cache
def _folder() -> Path:
    """Make the folder for machine code: numba's own where one is named, else one of the user's."""
    folder = (
        Path(os.environ.get("NUMBA_CACHE_DIR") or AppDirs("shotrig", appauthor=False).user_cache_dir)
        / "machine-code"
    )
    folder.mkdir(parents=True, exist_ok=True)
    TemporaryFile(dir=folder).close()
    return folder


class CodeFiles:
    """Files with the machine code of one function: one for each key, with a checksum.

    numba's own files are believed whatever they hold, and two processes that compile at once may mix them up.

    Parameters
    ----------
    folder : Path
        Where they lie.
    name : str
        Their names begin with it.
    """

    def __init__(self, folder: Path, name: str) -> None:
        self._folder, self._name = folder, name

    def _path(self, key: object) -> Path:
        digest = hashlib.sha256(f"{numba.__version__} {key!r}".encode()).hexdigest()
        return self._folder / f"{self._name}.{digest[:20]}.nbc"

    def load(self, key: object) -> Any:
        """Give what was saved under a key; None if there is nothing, or nothing that is sound."""
        try:
            content = self._path(key).read_bytes()
        except OSError:
            return None
        seal, data = content[:_SEAL], content[_SEAL:]
        return pickle.loads(data) if seal == hashlib.sha256(data).digest() else None

    def save(self, key: object, code: object) -> None:
        """Save something under a key; two processes may do so at once."""
        path, data = self._path(key), dumps(code)
        part = path.with_suffix(f".{os.getpid()}.{get_ident()}")
        try:
            part.write_bytes(hashlib.sha256(data).digest() + data)
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)

    def flush(self) -> None:
        """Forget all that was saved."""
        for path in self._folder.glob(f"{self._name}.*.nbc"):
            path.unlink(missing_ok=True)


class _Compiling(Listener):
    """Lets a command say that it still compiles, wherever it does: `daq serve` otherwise waits in silence."""

    def on_start(self, event: Event) -> None:
        """Take note that numba begins to compile a function; those that it calls come within."""
        console.held_up("compiling machine code for this processor, once")

    def on_end(self, event: Event) -> None:
        """Take note that it is done, or has failed."""
        console.go_on()


register("numba:compile", _Compiling())


@functools.cache
def _say_once(text: str) -> None:
    logging.getLogger("shotrig.compiling").info(text)


def ingredients(function: Callable[..., object]) -> str:
    """Digest the code of a function and of all that it calls, and the constants that they take from their modules.

    >>> ingredients(ingredients) == ingredients(ingredients), ingredients(ingredients) == ingredients(compiled)
    (True, False)
    """
    digest = hashlib.sha256()
    seen: set[FunctionType] = set()
    waiting: list[Any] = [function]
    while waiting:
        item = inspect.unwrap(
            waiting.pop()
        )  # the Python function of a compiled one, or what an intrinsic is made by
        if isinstance(item, FunctionType):
            if item in seen or item.__module__.partition(".")[0] in _LIBRARIES:
                continue
            seen.add(item)
            for code in _codes(item.__code__):
                plain = [
                    sorted(map(repr, c)) if isinstance(c, frozenset) else repr(c) for c in _constants(code)
                ]
                digest.update(repr((code.co_code, code.co_names, code.co_varnames, plain)).encode())
                waiting += [item.__globals__.get(name) for name in code.co_names]
            waiting += [item.__defaults__, *(cell.cell_contents for cell in item.__closure__ or ())]
        elif isinstance(item, tuple | list):
            waiting += item
        elif isinstance(item, np.ndarray | np.generic):
            digest.update(repr((item.dtype, item.shape)).encode() + item.tobytes())
        elif isinstance(item, bool | int | float | complex | str | bytes):
            digest.update(repr(item).encode())
        elif isinstance(item, type):
            digest.update(repr((item.__qualname__, getattr(item, "_fields", None))).encode())
    return digest.hexdigest()


def _codes(code: CodeType) -> Iterator[CodeType]:
    """Yield a code and those of the functions defined inside it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _codes(constant)


def _constants(code: CodeType) -> Iterator[Any]:
    return (constant for constant in code.co_consts if not isinstance(constant, CodeType))


class _Inlined(JITCodeLibrary):
    """Code that is only ever compiled into other functions: optimised and made machine code of there, not by itself."""

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalized = True


class _Inliner(Compiler):
    """Compiles functions for others, without a way in from Python, which would take longer than the function itself."""

    def define_pipelines(self) -> Any:
        state = self.state
        state.flags.no_compile = state.flags.no_cpython_wrapper = state.flags.no_cfunc_wrapper = True
        state.library = _Inlined(state.targetctx.codegen(), state.func_id.func_qualname)
        return super().define_pipelines()


def _callee(function: Callable[..., object], options: dict[str, Any]) -> Any:
    """Make what compiles a function into its callers; each type of its arguments once, not each constant of them."""
    dispatcher: Any = numba.njit(**options, pipeline_class=_Inliner)(function)

    def add_overload(result: Any) -> None:
        dispatcher.overloads[tuple(result.signature.args)] = result
        result.target_context.insert_user_function(result.fndesc, result.fndesc, [result.library])

    dispatcher.add_overload = add_overload
    return dispatcher


def _njit(function: F, **options: Any) -> F:
    dispatcher: Any = numba.njit(**options)(function)
    callee = functools.cache(lambda: _callee(function, options))

    def get_call_template(args: tuple[Any, ...], kws: dict[str, Any]) -> Any:
        named = {name: types.unliteral(kind) for name, kind in kws.items()}
        return callee().get_call_template(tuple(map(types.unliteral, args)), named)

    dispatcher.get_call_template = get_call_template
    dispatcher.get_overload = lambda args: callee().overloads[args].fndesc
    try:
        dispatcher._cache = KernelCache(function, options)  # noqa: SLF001 - what `cache=True` does with numba's own
    except OSError:
        _say_once(
            "machine code is compiled at every start, which takes up to a minute: no folder can be written to that "
            "would keep it; name one in NUMBA_CACHE_DIR"
        )
    return cast(F, dispatcher)


def stored(function: F) -> F:
    """Compile a function as `njit` does; it may create arrays."""
    return _njit(function)


def compiled(function: F) -> F:
    """Compile a function of the kernel."""
    return _njit(function, **_KERNEL)


def inlined(function: F) -> F:
    """Compile a function of the kernel into each of its callers: handing it hundreds of arrays takes longer."""
    return _njit(function, forceinline=True, **_KERNEL)


def unfused(function: F) -> F:
    """Compile a function in which multiplications and additions stay apart.

    For loops over samples: a processor works them off several at a time and what is left one by one, and both have
    to give the same bits, however samples come in blocks.
    """
    return _njit(function, **{**_KERNEL, "fastmath": False})
