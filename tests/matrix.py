"""The tests under other settings of processor, libraries and Pythons: `make matrix`.

A result must not rest on vector width, BLAS kernel, threads, locale, time zone, place of the checkout or rights; nor
on the Python or the versions of dependencies, as far as `pyproject.toml` allows them. What a machine lacks is said,
not run.
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
# Every setting is a second kind of machine, as far as one machine can be another.
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
# Kernels of OpenBLAS by name, each of which rounds in its own way, and the instructions that it needs.
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
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument(
        "--short", action="store_true", help="the part that CI runs, under the first setting and two kernels"
    )
    words.add_argument("tests", nargs="*", help="what to run; default everything")
    told = words.parse_args()
    chosen = dict(list(SETTINGS.items())[:1]) if told.short else SETTINGS
    tests = told.tests or (SHORT if told.short else [])
    failed = []
    for name, setting in chosen.items():
        filled = {key: value.format(features=features()) for key, value in setting.items()}
        print(f"== {name}: {' '.join(f'{key}={value}' for key, value in filled.items())}", flush=True)
        if not passes(sys.executable, tests, filled):
            failed.append(name)
    kernels = supported(SHORT_KERNELS if told.short else KERNELS)
    for kernel in kernels:
        chosen_tests = told.tests or (["tests/analysis"] if told.short else [])
        print(f"== quick tests, OPENBLAS_CORETYPE={kernel}", flush=True)
        if not passes(sys.executable, [*QUICK, *chosen_tests], {"OPENBLAS_CORETYPE": kernel}):
            failed.append(f"OpenBLAS kernel {kernel}")
    others = {} if told.short else {OLDEST: sys.executable, **dict(pythons())}
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
