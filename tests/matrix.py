"""Run the tests under other settings of processor, libraries and Python versions: `make matrix`.

Results must not depend on vector width, BLAS kernel, threads, locale, time zone, folder or user privileges. Results
must also be independent of the allowed versions of Python and of the dependencies (`pyproject.toml`). Settings that are
unavailable are reported.
"""

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
# Kernels of OpenBLAS, each with different rounding, and the instructions that they require.
KERNEL_INSTRUCTIONS = {
    "Prescott": "SSE3",
    "Nehalem": "SSE42",
    "Sandybridge": "AVX",
    "Haswell": "AVX2",
    "Zen": "AVX2",
    "SkylakeX": "AVX512_SKX",
    "Cooperlake": "AVX512BF16",
    "Sapphirerapids": "AVX512_SPR",
}
QUICK_OPTIONS = ["-m", "not thorough"]
# Tests of `--short`, for CI: examples in docstrings, which print digits, and the engine against its references. The
# quick tests of the analysis run under a kernel with narrow and one with wide vectors.
SHORT_TESTS = ["rig", "daq", "analysis", "tests/rig/engine", "tests/rig/numerics"]
SHORT_KERNELS = ("Nehalem", "SkylakeX")

OLDEST_DEPENDENCIES = "oldest dependencies"
# Supported versions of Python.
PYTHONS = ("3.11", "3.12", "3.13", "3.14")


def dispatched_features() -> str:
    """Return the groups of instructions that numpy uses here beyond its baseline, so that they can be disabled."""
    code = (
        "from numpy._core._multiarray_umath import __cpu_features__ as f, __cpu_dispatch__ as d;"
        "print(' '.join(name for name in d if f[name]))"
    )
    return subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout.strip()


def supported_kernels(kernels: Iterable[str]) -> list[str]:
    """Return the kernels that this processor supports; print the others."""
    code = "from numpy._core._multiarray_umath import __cpu_features__ as f; print(*(name for name in f if f[name]))"
    features = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout
    supported = [kernel for kernel in kernels if KERNEL_INSTRUCTIONS[kernel] in features.split()]
    for kernel in kernels:
        if kernel not in supported:
            print(f"== OpenBLAS kernel {kernel}: unavailable (no {KERNEL_INSTRUCTIONS[kernel]})", flush=True)
    return supported


def other_pythons() -> Iterator[tuple[str, str]]:
    """Yield the other versions of Python on the path."""
    for version in PYTHONS:
        if version == f"{sys.version_info.major}.{sys.version_info.minor}":
            continue
        path = shutil.which(f"python{version}")
        if path and not subprocess.run([path, "--version"], capture_output=True).returncode:
            yield f"Python {version}", path
        else:
            print(f"== Python {version}: unavailable (no python{version} on the path)", flush=True)


def lower_bounds() -> str:
    """Return the lowest versions that `pyproject.toml` allows as constraints for pip."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    requirements = [requirement for extra in ("export", "tdms", "tables", "cluster") for requirement in extras[extra]]
    bounds = [
        re.match(r"([\w-]+)(?:\[.*])?>=([\d.]+)", requirement)
        for requirement in (*project["dependencies"], *requirements)
    ]
    return "".join(f"{bound[1]}=={bound[2]}\n" for bound in bounds if bound)


def create_environment(python: str, folder: Path, constraints: str) -> str:
    """Install the product in a new environment, with constraints on its dependencies; return the path of its Python."""
    subprocess.run([python, "-m", "venv", str(folder / "venv")], check=True)
    python_path = str(folder / "venv" / "bin" / "python")
    (folder / "constraints.txt").write_text(constraints, encoding="utf-8")
    arguments = ["-m", "pip", "install", "--quiet", "--disable-pip-version-check", "-e", f"{ROOT}[dev]"]
    subprocess.run([python_path, *arguments, "-c", str(folder / "constraints.txt")], check=True)
    return python_path


def run_tests(python: str, tests: list[str], setting: dict[str, str]) -> bool:
    """Run tests and return whether they pass."""
    command = [python, "-m", "pytest", "-q", "-n", "2", *tests]
    return not subprocess.run(command, cwd=ROOT, env={**os.environ, **setting}).returncode


def main() -> int:
    """Run the tests under each setting and in each environment, and report the failures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--short", action="store_true", help="the part that CI runs, under the first setting and two kernels"
    )
    parser.add_argument("tests", nargs="*", help="tests to run (default: all)")
    options = parser.parse_args()
    settings = dict(list(SETTINGS.items())[:1]) if options.short else SETTINGS
    tests = options.tests or (SHORT_TESTS if options.short else [])
    failed = []
    for name, setting in settings.items():
        variables = {key: value.format(features=dispatched_features()) for key, value in setting.items()}
        print(f"== {name}: {' '.join(f'{key}={value}' for key, value in variables.items())}", flush=True)
        if not run_tests(sys.executable, tests, variables):
            failed.append(name)
    kernels = supported_kernels(SHORT_KERNELS if options.short else KERNEL_INSTRUCTIONS)
    for kernel in kernels:
        chosen_tests = options.tests or (["tests/analysis"] if options.short else [])
        print(f"== quick tests, OPENBLAS_CORETYPE={kernel}", flush=True)
        if not run_tests(sys.executable, [*QUICK_OPTIONS, *chosen_tests], {"OPENBLAS_CORETYPE": kernel}):
            failed.append(f"OpenBLAS kernel {kernel}")
    environments = {} if options.short else {OLDEST_DEPENDENCIES: sys.executable, **dict(other_pythons())}
    for name, python in environments.items():
        print(f"== {name}", flush=True)
        with tempfile.TemporaryDirectory(prefix="matrix-") as folder:
            python_path = create_environment(
                python, Path(folder), lower_bounds() if name == OLDEST_DEPENDENCIES else ""
            )
            if not run_tests(python_path, tests, {}):
                failed.append(name)
    n_tried = len(settings) + len(kernels) + len(environments)
    print(f"failed under: {', '.join(failed)}" if failed else f"all {n_tried} settings pass")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
