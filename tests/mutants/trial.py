"""Trials of the mutations of one group: make each in a copy of the checkout, and run the tests of its module."""

from __future__ import annotations

import logging
import os
import random
import shutil
import sys
import tempfile
import time
from contextlib import chdir
from dataclasses import dataclass
from pathlib import Path

from cosmic_ray.commands.init import init
from cosmic_ray.mutating import mutate_and_test
from cosmic_ray.testing import run_tests
from cosmic_ray.work_db import use_db
from cosmic_ray.work_item import MutationSpec, TestOutcome

from rig.core.numerics.jit import machine_code_root
from tests.mutants.groups import EQUIVALENT, GROUPS

ROOT = Path(__file__).parents[2]
# Operators of Cosmic Ray whose mutations have no effect: those of types (`|`), compiling decorators, and `is`.
EXCLUDED_OPERATORS = ("BitOr", "BitAnd", "BitXor", "LShift", "RShift", "FloorDiv", "RemoveDecorator", "Unary_Invert")


@dataclass(frozen=True)
class Trial:
    """Result of one mutation."""

    group: str
    module: str
    detected: bool
    equivalent: str
    """Why no test can detect the mutation; "" if unknown."""
    change: str
    """The changed lines."""


def choose_mutations(group: str, count: int, seed: int) -> dict[str, list[MutationSpec]]:
    """Choose mutations in the modules of a group, at different positions as far as possible."""
    positions: dict[tuple[str, object], list[MutationSpec]] = {}
    for module in GROUPS[group]:
        with use_db(":memory:") as work:
            init([Path(module)], work, {})
            for item in work.work_items:
                for mutation in item.mutations:
                    if _is_applicable(mutation.operator_name):
                        positions.setdefault((module, mutation.start_pos), []).append(mutation)
    rng = random.Random(f"{seed} {group}")
    chosen: dict[str, list[MutationSpec]] = {}
    for module, position in rng.sample(sorted(positions), min(count, len(positions))):
        chosen.setdefault(module, []).append(rng.choice(positions[module, position]))
    return chosen


def _is_applicable(operator: str) -> bool:
    return not any(name in operator for name in EXCLUDED_OPERATORS) and not operator.endswith(("_Is", "_IsNot"))


def try_group(group: str, count: int, seed: int) -> list[Trial]:
    """Mutate the modules of a group in a copy of the checkout, one mutation at a time, and run their tests."""
    logging.disable(logging.CRITICAL)
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder, chdir(_copy(Path(folder))):
        # Use the cached machine code of modules without a mutation.
        shutil.copytree(machine_code_root(), Path(folder) / "machine-code")
        os.environ |= {"NUMBA_CACHE_DIR": folder, "PYTHONPATH": str(Path.cwd()), "OPENBLAS_NUM_THREADS": "1"}
        trials = []
        for module, chosen in choose_mutations(group, count, seed).items():
            for compiled in (Path(module).parent / "__pycache__").glob(f"{Path(module).stem}.*"):
                compiled.unlink()
            command = (
                f"{sys.executable} -m pytest -x -q -n 0 -m 'not thorough' -p no:cacheprovider "
                f"-p tests.mutants.fast_failure {module} {GROUPS[group][module]}"
            )
            # Without numba: it would compile the engine's kernels for minutes with each mutation.
            os.environ["NUMBA_DISABLE_JIT"] = str(int(module.startswith("rig/core/engine/")))
            start = time.monotonic()
            outcome, output = run_tests(command, 3600.0)
            if outcome is not TestOutcome.SURVIVED:
                raise RuntimeError(f"{module}: its tests fail without a mutation:\n{output[-3000:]}")
            timeout = 30.0 + 2.0 * (time.monotonic() - start)
            trials += [_try_mutation(group, module, mutation, command, timeout) for mutation in chosen]
    return trials


def _try_mutation(group: str, module: str, mutation: MutationSpec, command: str, timeout: float) -> Trial:
    """Make a mutation, run the tests of its module for at most `timeout` s, and undo the mutation."""
    result = mutate_and_test([mutation], command, timeout)
    if result.test_outcome not in (TestOutcome.KILLED, TestOutcome.SURVIVED):
        raise RuntimeError(f"{module}: {mutation} could not be tried:\n{result.output}")
    lines = [line for line in result.diff.splitlines() if line.startswith(("@@", "-", "+"))]
    changed_lines = [line for line in lines if line[:3] not in ("---", "+++")]
    reason = next((EQUIVALENT[text] for line in changed_lines if (text := line[1:].strip()) in EQUIVALENT), "")
    return Trial(group, module, result.test_outcome is TestOutcome.KILLED, reason, "\n".join(changed_lines))


def _copy(folder: Path) -> Path:
    """Copy the parts of the checkout that the tests need."""
    copy = folder / "checkout"
    copy.mkdir()
    for name in ("rig", "daq", "analysis", "tests", "recordings"):
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("*.mcap"))
    for name in ("pyproject.toml", "README.md", "Makefile", "LICENSE"):
        shutil.copy(ROOT / name, copy)
    return copy
