"""The tests under other settings of processor, libraries and Pythons: `make matrix`.

Results must not depend on vector width, BLAS kernel, threads, locale, time zone, folder or user rights, nor on the
versions of Python and of the dependencies that `pyproject.toml` allows. Settings that this machine lacks are named.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterable, Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
# Environment variables that emulate another machine.
SETTINGS: dict[str, dict[str, str]] = {
    "narrow vectors": {
        "NPY_DISABLE_CPU_FEATURES": "{features}",
        "NUMBA_CPU_NAME": "haswell",
        "OPENBLAS_CORETYPE": "Haswell",
    },
    "baseline processor": {
        "NPY_DISABLE_CPU_FEATURES": "{features}",
        "NUMBA_CPU_NAME": "x86-64",
        "OPENBLAS_CORETYPE": "Prescott",
    },
    "one thread, another locale and zone": {
        **dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"),
        "LC_ALL": "C",
        "TZ": "Pacific/Chatham",
        "PYTHONUTF8": "0",
    },
}
# Kernels of OpenBLAS, each with its own rounding, and the instructions that they need.
KERNELS = {
    "Prescott": "SSE3",
    "Nehalem": "SSE42",
    "Sandybridge": "AVX",
    "Haswell": "AVX2",
    "Zen": "AVX2",
    "SkylakeX": "AVX512_SKX",
    "Cooperlake": "AVX512BF16",
    "Sapphirerapids": "AVX512_SPR",
}
QUICK = ["-m", "not thorough"]
# What CI runs: examples in docstrings, where digits are printed, and the engine against its references; and the quick
# tests of the analysis under a narrow and a wide kernel.
SHORT = ["rig", "daq", "analysis", "tests/rig/engine", "tests/rig/numerics"]
SHORT_KERNELS = ("Nehalem", "SkylakeX")

OLDEST = "oldest dependencies"
# Pythons that the product is made for.
PYTHONS = ("3.11", "3.12", "3.13", "3.14")


def features() -> str:
    """Name the groups of instructions that numpy uses here beyond its baseline, so that they can be forbidden."""
    code = (
        "from numpy._core._multiarray_umath import __cpu_features__ as f, __cpu_dispatch__ as d;"
        "print(' '.join(name for name in d if f[name]))"
    )
    return subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True
    ).stdout.strip()


def supported(kernels: Iterable[str]) -> list[str]:
    """Keep the kernels that this processor can run; name the others."""
    code = "from numpy._core._multiarray_umath import __cpu_features__ as f; print(*(name for name in f if f[name]))"
    known = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout
    kept = [kernel for kernel in kernels if KERNELS[kernel] in known.split()]
    for kernel in kernels:
        if kernel not in kept:
            print(f"== OpenBLAS kernel {kernel}: not here (no {KERNELS[kernel]})", flush=True)
    return kept


def pythons() -> Iterator[tuple[str, str]]:
    """Find the other Pythons on the path."""
    for version in PYTHONS:
        if version == f"{sys.version_info.major}.{sys.version_info.minor}":
            continue
        found = shutil.which(f"python{version}")
        if found and not subprocess.run([found, "--version"], capture_output=True).returncode:
            yield f"Python {version}", found
        else:
            print(f"== Python {version}: not here (no python{version} on the path)", flush=True)


def lower_bounds() -> str:
    """Write the lowest versions that `pyproject.toml` allows as what pip may install."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    named = [each for extra in ("export", "tdms", "tables", "cluster") for each in extras[extra]]
    bounds = [re.match(r"([\w-]+)(?:\[.*])?>=([\d.]+)", each) for each in (*project["dependencies"], *named)]
    return "".join(f"{bound[1]}=={bound[2]}\n" for bound in bounds if bound)


def environment(python: str, folder: Path, constraints: str) -> str:
    """Install the product with another Python, or with other versions of its dependencies."""
    subprocess.run([python, "-m", "venv", str(folder / "venv")], check=True)
    made = str(folder / "venv" / "bin" / "python")
    (folder / "constraints.txt").write_text(constraints, encoding="utf-8")
    words = ["-m", "pip", "install", "--quiet", "--disable-pip-version-check", "-e", f"{ROOT}[dev]"]
    subprocess.run([made, *words, "-c", str(folder / "constraints.txt")], check=True)
    return made


def passes(python: str, tests: list[str], setting: dict[str, str]) -> bool:
    """Run tests."""
    command = [python, "-m", "pytest", "-q", "-n", "2", *tests]
    return not subprocess.run(command, cwd=ROOT, env={**os.environ, **setting}).returncode


def main() -> int:
    """Run the tests under each setting and in each environment; say where they failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--short", action="store_true", help="the part that CI runs, under the first setting and two kernels"
    )
    parser.add_argument("tests", nargs="*", help="tests to run (default: all)")
    options = parser.parse_args()
    chosen = dict(list(SETTINGS.items())[:1]) if options.short else SETTINGS
    tests = options.tests or (SHORT if options.short else [])
    failed = []
    for name, setting in chosen.items():
        filled = {key: value.format(features=features()) for key, value in setting.items()}
        print(f"== {name}: {' '.join(f'{key}={value}' for key, value in filled.items())}", flush=True)
        if not passes(sys.executable, tests, filled):
            failed.append(name)
    kernels = supported(SHORT_KERNELS if options.short else KERNELS)
    for kernel in kernels:
        chosen_tests = options.tests or (["tests/analysis"] if options.short else [])
        print(f"== quick tests, OPENBLAS_CORETYPE={kernel}", flush=True)
        if not passes(sys.executable, [*QUICK, *chosen_tests], {"OPENBLAS_CORETYPE": kernel}):
            failed.append(f"OpenBLAS kernel {kernel}")
    others = {} if options.short else {OLDEST: sys.executable, **dict(pythons())}
    for name, python in others.items():
        print(f"== {name}", flush=True)
        with tempfile.TemporaryDirectory(prefix="matrix-") as folder:
            made = environment(python, Path(folder), lower_bounds() if name == OLDEST else "")
            if not passes(made, tests, {}):
                failed.append(name)
    tried = len(chosen) + len(kernels) + len(others)
    print(f"failed under: {', '.join(failed)}" if failed else f"all {tried} settings pass")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
