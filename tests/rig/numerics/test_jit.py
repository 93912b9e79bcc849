"""Kernels are compiled again if any of their sources changes, and are otherwise read from the cache.

The tests compile the small modules below, which form a package `kernels`.
"""

from __future__ import annotations

import copy
import os
import pickle
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from rig.core.numerics import bernstein, jit

ROOT = Path(__file__).parents[3]
# Modules of the package.
OUTER = """
from kernels.constant import CONSTANT
from kernels.inner import inner
from kernels.pair import Pair
from rig.core.numerics.jit import kernel

@kernel
def outer(pair: Pair) -> float:
    return inner(pair.x) + CONSTANT + pair.y
"""
INNER = """
from rig.core.numerics.jit import inlined_kernel

@inlined_kernel
def inner(x: float) -> float:
    return {factor} * x
"""
# A kernel that calls another kernel twice.
TWICE = """
from rig.core.numerics.jit import kernel

@kernel
def inner(x: float, factor: int) -> float:
    return factor * x

@kernel
def outer(x: float) -> float:
    return inner(x, 2) + inner(x, 3)
"""
# Script that prints two results, then the names of the kernels that were compiled.
PRINT_COMPILED = """
from kernels.twice import inner, outer
from numba.core.event import install_recorder

with install_recorder("numba:compile") as recorder:
    print(outer(1.0), inner(1.0, 4))
print(*(event.data["dispatcher"].py_func.__name__ for _, event in recorder.buffer if event.is_start))
"""
PAIR = """
from typing import NamedTuple

class Pair(NamedTuple):
    {0}: float
    {1}: float
"""
# Script that prints all bits of the zero of a guard, and of a matrix product in vector registers. With `plain`, the
# script hides `rig.core.numerics.callees`, so that only the public options of numba are used.
BITS = """
import sys
if {plain}:
    sys.modules["rig.core.numerics.callees"] = None
import numpy as np
from rig.core.numerics import bernstein, jit
from rig.core.numerics.bernstein import BERNSTEIN, MAX_HALVINGS, N_COEFFICIENTS, first_crossing
from rig.core.numerics.simd import aligned_zeros, multiply

assert (jit.callees is None) == {plain}
series, out, matrix = aligned_zeros(N_COEFFICIENTS), aligned_zeros(8), aligned_zeros(1, 5, 8)
series[:4], matrix[0] = (1.0, -0.7, -0.9, 0.2), np.linspace(-1.0, 3.0, 40).reshape(5, 8) ** 3
work, spans = aligned_zeros(MAX_HALVINGS + 3, N_COEFFICIENTS), np.zeros((MAX_HALVINGS + 3, 2))
tau, _ = first_crossing(series, 0, 1e-16, work, spans, BERNSTEIN)
multiply(matrix, 0, np.sqrt(np.arange(5.0)), np.ones(8), out)
print(float(tau).hex(), *(float(x).hex() for x in out))
"""
CALL = "from kernels.outer import Pair, outer; print(outer(Pair(1.0, 100.0)))"
# Script that calls the function `outer` of several packages `kernels`; its arguments are their parent folders.
CALL_ALL = """
import sys
for folder in sys.argv[1:]:
    for name in [name for name in sys.modules if name.startswith("kernels")]:
        del sys.modules[name]
    sys.path.insert(0, folder)
    from kernels.outer import Pair, outer
    print(outer(Pair(1.0, 100.0)))
"""


@pytest.fixture
def kernels(tmp_path: Path) -> Path:
    return write_kernels(tmp_path)


def write_kernels(folder: Path) -> Path:
    """Write a package whose function `outer` returns 2 x + CONSTANT + y; `CALL` prints 2 * 1 + 10 + 100."""
    package = folder / "kernels"
    package.mkdir(parents=True)
    for name, text in {
        "__init__": "",
        "outer": OUTER,
        "inner": INNER.format(factor=2),
        "constant": "CONSTANT = 10.0",
        "pair": PAIR.format("x", "y"),
    }.items():
        (package / f"{name}.py").write_text(text)
    return package


def run(package: Path, code: str = CALL, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run code in a new process whose cache is in the package."""
    paths = [str(package.parent), str(Path(__file__).parents[3])]
    variables = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "NUMBA_CACHE_DIR": str(package / "cache")}
    # Python compares only the time and size of a source, so it would use outdated bytecode.
    variables |= {"PYTHONDONTWRITEBYTECODE": "1"} | environment
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.run(command, env=variables, check=True, capture_output=True, text=True)


def machine_code(package: Path) -> dict[str, int]:
    """Return the modification time of each file of machine code, ns."""
    files = (package / "cache" / "machine-code").glob("kernels-*/outer.outer-*")
    return {file.name: file.stat().st_mtime_ns for file in files}


@pytest.mark.thorough
def test_changed_source_compiles_again(tmp_path: Path) -> None:
    # Each package has another change: the callee, the constant, or the order of the fields.
    changes = {
        "inner": (INNER.format(factor=3), "113.0"),
        "constant": ("CONSTANT = 20.0", "122.0"),
        "pair": (PAIR.format("y", "x"), "211.0"),
    }
    packages = {name: write_kernels(tmp_path / name) for name in changes}
    folders, cache = [str(package.parent) for package in packages.values()], str(tmp_path / "cache")
    first = run(packages["inner"], CALL_ALL, *folders, NUMBA_CACHE_DIR=cache)
    assert first.stdout.split() == ["112.0"] * 3
    for name, (text, _) in changes.items():
        source = packages[name] / f"{name}.py"
        # The changed file keeps its size and modification time.
        before = source.stat()
        source.write_text(text)
        os.utime(source, ns=(before.st_atime_ns, before.st_mtime_ns))
    second = run(packages["inner"], CALL_ALL, *folders, NUMBA_CACHE_DIR=cache)
    assert second.stdout.split() == [result for _, result in changes.values()]


def test_kernels_run_without_compilation(kernels: Path) -> None:
    assert run(kernels, NUMBA_DISABLE_JIT="1").stdout == "112.0\n"
    assert machine_code(kernels) == {}


def test_callee_is_compiled_once_per_type(kernels: Path) -> None:
    (kernels / "twice.py").write_text(TWICE)
    assert run(kernels, PRINT_COMPILED).stdout.splitlines() == ["5.0 4.0", "outer inner inner"]


def test_stored_kernel_can_be_called_by_new_kernel(kernels: Path) -> None:
    (kernels / "twice.py").write_text(TWICE)
    run(kernels, "from kernels.twice import inner; inner(1.0, 4)")
    result = run(kernels, "from kernels.twice import inner, outer; print(inner(1.0, 4), outer(1.0))")
    assert result.stdout == "4.0 5.0\n"


def test_other_checkout_uses_the_same_code(kernels: Path, tmp_path: Path) -> None:
    first = run(kernels)
    written = machine_code(kernels)
    copied_package = tmp_path / "other" / "kernels"
    shutil.copytree(kernels, copied_package, ignore=shutil.ignore_patterns("cache", "__pycache__"))
    second = run(copied_package, NUMBA_CACHE_DIR=str(kernels / "cache"))
    assert float(first.stdout) == float(second.stdout) == 112.0
    assert written and machine_code(kernels) == written
    # The log mentions only kernels of the program, and these kernels belong to a test.
    assert "compiling" not in first.stderr


def test_unwritable_cache_is_reported(kernels: Path) -> None:
    (kernels / "__pycache__").touch()
    unwritable = str(kernels / "__pycache__" / "cache")
    result = run(kernels, HOME=unwritable, XDG_CACHE_HOME=unwritable, NUMBA_CACHE_DIR="")
    assert float(result.stdout) == 112.0 and "NUMBA_CACHE_DIR" in result.stderr


def test_compilation_of_program_kernels_is_logged(kernels: Path) -> None:
    code = "from rig.core.numerics.jit import kernel\ndef f(x):\n    return x\nf.__module__ = 'rig.f'\nkernel(f)(1.0)"
    # The interval of the garbage collector is the user's again afterwards.
    code = f"import gc\nthresholds = gc.get_threshold()\n{code}\nassert gc.get_threshold() == thresholds"
    script = kernels / "script.py"
    script.write_text(code)
    assert "compiling machine code" in run(kernels, f"import runpy; runpy.run_path({str(script)!r})").stderr


@pytest.mark.thorough
def test_public_options_give_the_same_bits(kernels: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # Both variants share the cache with the program, because the digest of the machine code includes the options.
    plain = run(kernels, BITS.format(plain=True), NUMBA_CACHE_DIR=os.environ.get("NUMBA_CACHE_DIR", ""))
    exec(BITS.format(plain=False), {})
    assert plain.stdout == capsys.readouterr().out != ""


def test_public_options_count_no_references(kernels: Path) -> None:
    # Counting the references to arrays would make the engine ten times slower.
    hidden = (
        'import sys; sys.modules["rig.core.numerics.callees"] = None; from rig.core.numerics.simd import multiply; '
    )
    assert run(kernels, hidden + 'print(multiply.targetoptions["_nrt"])').stdout == "False\n"


# Script that calls a kernel twice, with one interrupt while LLVM stores or loads its machine code.
CALL_INTERRUPTED = """
import signal
from numba.core.codegen import CPUCodeLibrary

def with_interrupt(hook):
    def interrupted(*arguments):
        if not interrupts and "outer" in arguments[0].name:
            interrupts.append(signal.raise_signal(signal.SIGINT))
        return hook(*arguments)
    return interrupted

interrupts = []
for name in ("_object_compiled_hook", "_object_getbuffer_hook"):
    setattr(CPUCodeLibrary, name, with_interrupt(getattr(CPUCodeLibrary, name)))
from kernels.outer import Pair, outer

for _ in range(2):
    try:
        print(outer(Pair(1.0, 100.0)))
    except KeyboardInterrupt:
        print("interrupted")
"""


@pytest.mark.parametrize("is_stored", [False, True])
def test_interrupt_waits_until_machine_code_is_loaded(kernels: Path, is_stored: bool) -> None:
    if is_stored:
        run(kernels)
    result = run(kernels, CALL_INTERRUPTED)
    assert result.stdout.split() == ["interrupted", "112.0"]
    assert "Exception ignored" not in result.stderr


# Script that calls a kernel, then prints the names of the kernels that were compiled.
CALL_COMPILED = """
from kernels.outer import Pair, outer
from numba.core.event import install_recorder

with install_recorder("numba:compile") as recorder:
    print(outer(Pair(1.0, 100.0)))
print(*(event.data["dispatcher"].py_func.__name__ for _, event in recorder.buffer if event.is_start))
"""


def flip_bit(code: bytes, position: int) -> bytes:
    return code[:position] + bytes([code[position] ^ 4]) + code[position + 1 :]


@pytest.mark.parametrize(
    "damage",
    [
        lambda code: b"",
        lambda code: code[:3],
        lambda code: code[: len(code) // 2],
        lambda code: flip_bit(code, 0),
        lambda code: flip_bit(code, len(code) // 3),
        lambda code: flip_bit(code, len(code) - 9),
    ],
)
def test_damaged_machine_code_is_compiled_again(kernels: Path, damage: Callable[[bytes], bytes]) -> None:
    run(kernels)
    (file,) = (kernels / "cache" / "machine-code").glob("kernels-*/outer.outer-*")
    file.write_bytes(damage(file.read_bytes()))
    second, third = run(kernels, CALL_COMPILED), run(kernels, CALL_COMPILED)
    assert second.stdout.split() == ["112.0", "outer", "inner"] and third.stdout.split() == ["112.0"]
    assert second.stderr.count("is damaged, and is compiled again") == 1 and not third.stderr


def test_full_disk_of_machine_code_is_reported(kernels: Path) -> None:
    full = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100)); "
    result = run(kernels, full + CALL)
    assert result.stdout == "112.0\n" and result.stderr.count("cannot be stored") == 1
    assert not [file for file in kernels.rglob("*.code*") if file.is_file()]


def test_digest_covers_imported_kernels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(ROOT / "rig", tmp_path / "rig", ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(jit, "_ROOT", tmp_path)
    engine = tmp_path / "rig" / "core" / "engine"

    def digest(folder: Path) -> str:
        jit._sources.cache_clear()
        return jit._digest.__wrapped__(folder)

    before = digest(engine)
    for changed in (engine / "kernel.py", engine.parent / "numerics" / "bernstein.py"):
        source = changed.read_bytes()
        changed.write_bytes(source + b"\n")
        assert digest(engine) != before
        changed.write_bytes(source)
    assert digest(engine) == before


def test_kernel_is_copied_and_pickled_as_reference() -> None:
    kernel = bernstein._split
    assert copy.copy(kernel) is copy.deepcopy(kernel) is pickle.loads(pickle.dumps(kernel)) is kernel


def test_kernel_used_by_two_threads_has_one_dispatcher() -> None:
    # In Python 3.12, the second thread computes the property again if it has waited for the first.
    kernel = bernstein._split
    assert jit._Kernel.__dict__["_dispatcher"].func(kernel) is jit._Kernel.__dict__["_dispatcher"].func(kernel)


def test_kernel_of_two_signatures_is_called_itself(kernels: Path) -> None:
    code = """
from kernels.twice import outer
from rig.core.numerics.jit import RepeatedCall
call, other = RepeatedCall(outer), RepeatedCall(outer)
print(call(1.0), call(3.0), call._call is outer, other(1), other(2.5))
"""
    (kernels / "twice.py").write_text(TWICE)
    assert run(kernels, code).stdout.split() == ["5.0", "15.0", "False", "5", "12.5"]
