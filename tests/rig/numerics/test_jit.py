"""Machine code on disk is never older than any source that went into it, and is believed only if it is sound."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.numerics.jit import CodeFiles

INNER = """
from rig.numerics.jit import inlined

@inlined
def inner(x: float) -> float:
    return {factor} * x
"""
OUTER = """
from typing import NamedTuple

from kernels.constant import CONSTANT
from kernels.inner import inner
from kernels.pair import Pair
from rig.numerics.jit import compiled

@compiled
def outer(pair: Pair) -> float:
    return inner(pair.x) + CONSTANT + pair.y
"""
TWICE = """
from rig.numerics.jit import compiled

@compiled
def inner(x: float, factor: int) -> float:
    return factor * x

@compiled
def outer(x: float) -> float:
    return inner(x, 2) + inner(x, 3)
"""
COMPILING = """
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


@pytest.fixture
def kernels(tmp_path: Path) -> Path:
    """Make a package whose function `outer` gives 2 x + CONSTANT + y, here 2 * 1 + 10 + 100."""
    package = tmp_path / "kernels"
    package.mkdir()
    for name, text in {
        "__init__": "",
        "outer": OUTER,
        "inner": INNER.format(factor=2),
        "constant": "CONSTANT = 10.0",
        "pair": PAIR.format("x", "y"),
    }.items():
        (package / f"{name}.py").write_text(text)
    return package


def call(package: Path, **environment: str) -> float:
    """Call the outer function in a process of its own."""
    code = "from kernels.outer import Pair, outer; print(outer(Pair(1.0, 100.0)))"
    return float(said_by(package, code, **environment).stdout)


def said_by(package: Path, code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run code in a process of its own."""
    paths = [str(package.parent), str(Path(__file__).parents[3])]
    where = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "NUMBA_CACHE_DIR": str(package / "cache")}
    where |= environment
    return subprocess.run([sys.executable, "-c", code], env=where, check=True, capture_output=True, text=True)


def machine_code(package: Path) -> dict[str, int]:
    """Say when each file of machine code was written."""
    files = (package / "cache" / "machine-code").glob("kernels.outer.outer.*.nbc")
    return {file.name: file.stat().st_mtime_ns for file in files}


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("name", "text", "result"),
    [
        ("inner", INNER.format(factor=3), 113.0),
        ("constant", "CONSTANT = 20.0", 122.0),
        ("pair", PAIR.format("y", "x"), 211.0),
    ],
    ids=["a function", "a constant", "the fields of a tuple"],
)
def test_given_code_on_disk_when_what_went_into_it_changes_then_it_is_compiled_anew(
    kernels: Path, name: str, text: str, result: float
) -> None:
    assert call(kernels) == 112.0
    source = kernels / f"{name}.py"
    # Neither the time nor the size of the file tells that it is another.
    before = source.stat()
    source.write_text(text)
    os.utime(source, ns=(before.st_atime_ns, before.st_mtime_ns))
    # Python itself goes by them.
    for bytecode in (kernels / "__pycache__").glob(f"{name}.*.pyc"):
        bytecode.unlink()
    assert call(kernels) == result


@pytest.mark.thorough
def test_given_code_on_disk_when_only_other_files_change_then_it_is_used_as_it_is(kernels: Path) -> None:
    assert call(kernels) == 112.0
    written = machine_code(kernels)
    (kernels / "unrelated.py").write_text(INNER.format(factor=5))
    (kernels / "constant.py").write_text("CONSTANT = 10.0  # to be sure\nOTHER = 3.0\n")
    assert call(kernels) == 112.0
    assert machine_code(kernels) == written


def test_given_two_constants_when_a_function_is_compiled_into_another_then_once_and_python_has_its_own(
    kernels: Path,
) -> None:
    (kernels / "twice.py").write_text(TWICE)
    assert said_by(kernels, COMPILING).stdout.splitlines() == ["5.0 4.0", "outer inner inner"]


def test_given_code_of_another_checkout_when_called_then_it_is_used_as_it_is(
    kernels: Path, tmp_path: Path
) -> None:
    assert call(kernels) == 112.0
    written = machine_code(kernels)
    other = tmp_path / "other" / "kernels"
    shutil.copytree(kernels, other, ignore=shutil.ignore_patterns("cache", "__pycache__"))
    assert call(other, NUMBA_CACHE_DIR=str(kernels / "cache")) == 112.0
    assert written and machine_code(kernels) == written


@given(st.data())
def test_given_damage_anywhere_in_code_on_disk_when_loaded_then_there_is_none(data: st.DataObject) -> None:
    with TemporaryDirectory() as folder:
        files = CodeFiles(Path(folder), "function")
        files.save(("signature", 1), {"code": b"machine code"})
        assert files.load(("signature", 1)) == {"code": b"machine code"}
        assert files.load(("signature", 2)) is None
        (file,) = Path(folder).iterdir()
        content = bytearray(file.read_bytes())
        place = data.draw(st.integers(0, len(content) - 1))
        if data.draw(st.booleans()):
            content[place] ^= 1 << data.draw(st.integers(0, 7))
        else:
            del content[place:]
        file.write_bytes(content)
        assert files.load(("signature", 1)) is None


def test_given_no_place_for_code_when_called_then_it_works_and_says_why_it_is_slow(kernels: Path) -> None:
    (kernels / "__pycache__").touch()
    nowhere = str(kernels / "__pycache__" / "cache")
    code = (
        "import logging; logging.basicConfig(level=logging.INFO);"
        "from kernels.outer import Pair, outer; print(outer(Pair(1.0, 100.0)))"
    )
    done = said_by(kernels, code, HOME=nowhere, XDG_CACHE_HOME=nowhere, NUMBA_CACHE_DIR="")
    assert float(done.stdout) == 112.0 and "NUMBA_CACHE_DIR" in done.stderr
