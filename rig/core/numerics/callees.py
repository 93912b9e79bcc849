"""Variant of `numba.njit` that uses internals of numba to compile and load kernels in less time; see `jit`.

A *callee* is a function that a kernel calls. A callee is compiled without wrappers for Python, and optimized only in
its callers. A callee is compiled once per argument type, not again for each literal value (`types.unliteral`). Kernels
create no arrays: they need no numba runtime (`_nrt`), and can be loaded from the cache without refreshing numba's
registries.

An *entry* is a function that Python calls. An entry is never compiled into another function. Its file in the cache
therefore needs no bitcode, which takes longer to load than the machine code.
"""

import functools
from collections.abc import Callable
from typing import Any

import llvmlite.binding
import numba
from numba.core import types
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler

from rig.core.base.ending_signals import delayed_interrupt
from rig.core.numerics.code_cache import CodeCache

# If numba lacks these internals, the import fails with AttributeError, and `rig.core.numerics.jit` uses public options.
getattr(JITCodeLibrary, "_optimize_final_module")  # noqa: B009


class _EntryLibrary(JITCodeLibrary):
    """Machine code that is not linked to other functions; only the names of its symbols are stored as bitcode."""

    def _get_module_for_linking(self) -> Any:
        symbols = (*self._final_module.functions, *self._final_module.global_variables)
        names = [symbol.name for symbol in symbols if not symbol.is_declaration]
        return llvmlite.binding.parse_assembly("\n".join(f'@"{name}" = global i8 0' for name in names))

    def _finalize_specific(self) -> None:
        # As in `CodeCache.load_overload`: a callback of LLVM cannot raise an interrupt.
        with delayed_interrupt():
            super()._finalize_specific()


class _EntryCompiler(Compiler):
    """Compiler of entries."""

    def define_pipelines(self) -> Any:
        self.state.library = _EntryLibrary(self.state.targetctx.codegen(), self.state.func_id.func_qualname)
        self.state.library.enable_object_caching()
        return super().define_pipelines()


class _CalleeLibrary(JITCodeLibrary):
    """Machine code that is not optimized separately, but as part of its callers."""

    def _optimize_final_module(self) -> None: ...

    def _finalize_final_module(self) -> None:
        self._finalized = True


class _CalleeCompiler(Compiler):
    """Compiler of callees, without wrappers for Python and C."""

    def define_pipelines(self) -> Any:
        state, flags = self.state, self.state.flags
        flags.no_compile = flags.no_cpython_wrapper = flags.no_cfunc_wrapper = True
        state.library = _CalleeLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        return super().define_pipelines()


def _callee(function: Callable[..., object], options: dict[str, Any]) -> Any:
    """Return the numba dispatcher that compiles a function as a callee."""
    dispatcher: Any = numba.njit(**options, pipeline_class=_CalleeCompiler)(function)

    def add_overload(result: Any) -> None:
        dispatcher.overloads[tuple(result.signature.args)] = result
        result.target_context.insert_user_function(result.fndesc, result.fndesc, [result.library])

    dispatcher.add_overload = add_overload
    return dispatcher


def njit(function: Callable[..., object], cache: bool, **options: Any) -> Any:
    """Compile a function as `numba.njit` does; a kernel has the option `_nrt` False, because it creates no arrays."""
    dispatcher: Any = numba.njit(pipeline_class=_EntryCompiler, **options)(function)
    callee = functools.cache(lambda: _callee(function, options))

    def get_call_template(args: tuple[Any, ...], kws: dict[str, Any]) -> Any:
        return callee().get_call_template(tuple(map(types.unliteral, args)), kws)

    dispatcher.get_call_template = get_call_template
    dispatcher.get_overload = lambda args: callee().overloads[args].fndesc
    if cache:
        dispatcher._cache = CodeCache(function, refreshes=options.get("_nrt", True))  # noqa: SLF001
    return dispatcher
