"""The tests under other settings of processor and libraries: `make matrix`; what a machine lacks is said, not run.

A result must not rest on vector width, BLAS kernel, threads, locale, time zone, place of the checkout or rights.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
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
# What CI runs: examples in docstrings, where digits are printed, and the engine against its references.
SHORT = ["rig", "daq", "analysis", "tests/rig/engine", "tests/rig/numerics"]


def features() -> str:
    """Name the groups of instructions that numpy uses here beyond its baseline, so that they can be forbidden."""
    code = (
        "from numpy._core._multiarray_umath import __cpu_features__ as f, __cpu_dispatch__ as d;"
        "print(' '.join(name for name in d if f[name]))"
    )
    return subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True
    ).stdout.strip()


def main() -> int:
    """Run the tests under each setting; say which failed."""
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("--short", action="store_true", help="the part that CI runs, under the first setting")
    words.add_argument("tests", nargs="*", help="what to run; default everything")
    told = words.parse_args()
    chosen = dict(list(SETTINGS.items())[:1]) if told.short else SETTINGS
    tests = told.tests or (SHORT if told.short else [])
    failed = []
    for name, setting in chosen.items():
        filled = {key: value.format(features=features()) for key, value in setting.items()}
        print(f"== {name}: {' '.join(f'{key}={value}' for key, value in filled.items())}", flush=True)
        command = [sys.executable, "-m", "pytest", "-q", "-n", "2", *tests]
        if subprocess.run(command, cwd=ROOT, env={**os.environ, **filled}).returncode:
            failed.append(name)
    print(f"failed under: {', '.join(failed)}" if failed else f"all {len(chosen)} settings pass")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
