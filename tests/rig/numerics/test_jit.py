"""Machine code on disk is never older than any source that went into it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

INNER = """
from rig.numerics.jit import inlined

@inlined
def inner(x: float) -> float:
    return {factor} * x
"""
OUTER = """
from kernels.inner import inner
from rig.numerics.jit import compiled

@compiled
def outer(x: float) -> float:
    return inner(x)
"""


def call(folder: Path) -> float:
    """Call the outer function in a process of its own."""
    code = "from kernels.outer import outer; print(outer(1.0))"
    where = {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), str(Path(__file__).parents[3])])}
    where.pop("NUMBA_CACHE_DIR", None)
    done = subprocess.run([sys.executable, "-c", code], env=where, check=True, capture_output=True, text=True)
    return float(done.stdout)


def test_given_code_on_disk_when_a_function_inside_it_changes_then_it_is_compiled_anew(
    tmp_path: Path,
) -> None:
    package = tmp_path / "kernels"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "outer.py").write_text(OUTER)
    inner = package / "inner.py"
    inner.write_text(INNER.format(factor=2))
    assert call(tmp_path) == 2.0
    (index,) = (package / "__pycache__").glob("outer.outer-*.nbi")
    written = index.stat().st_mtime_ns
    assert call(tmp_path) == 2.0
    assert index.stat().st_mtime_ns == written
    inner.write_text(INNER.format(factor=3))
    os.utime(inner, ns=(written + 10**9, written + 10**9))
    assert call(tmp_path) == 3.0
