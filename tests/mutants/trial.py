"""One place and its faults: made in a copy of the checkout, one at a time, the tests of their module run on each."""

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

from rig.numerics.jit import machine_code_root
from tests.mutants.places import EQUIVALENT, PLACES

ROOT = Path(__file__).parents[2]
# Types are not run; which decorator compiles a function changes no result; small numbers that are equal are identical.
UNTRIED = ("BitOr", "BitAnd", "BitXor", "LShift", "RShift", "FloorDiv", "RemoveDecorator", "Unary_Invert")


@dataclass(frozen=True)
class Found:
    """What came of one fault: whether the tests noticed, why none could, and the changed lines."""

    place: str
    module: str
    noticed: bool
    equivalent: str
    change: str


def faults(place: str, most: int, seed: int) -> dict[str, list[MutationSpec]]:
    """Choose faults in the modules of a place, at different positions as far as there are."""
    positions: dict[tuple[str, object], list[MutationSpec]] = {}
    for module in PLACES[place]:
        with use_db(":memory:") as work:
            init([Path(module)], work, {})
            for item in work.work_items:
                for fault in item.mutations:
                    if _is_tried(fault.operator_name):
                        positions.setdefault((module, fault.start_pos), []).append(fault)
    chance = random.Random(f"{seed} {place}")
    chosen: dict[str, list[MutationSpec]] = {}
    for module, position in chance.sample(sorted(positions), min(most, len(positions))):
        chosen.setdefault(module, []).append(chance.choice(positions[module, position]))
    return chosen


def _is_tried(operator: str) -> bool:
    return not any(name in operator for name in UNTRIED) and not operator.endswith(("_Is", "_IsNot"))


def try_place(place: str, most: int, seed: int) -> list[Found]:
    """Put faults into the modules of a place in a copy of the checkout, one at a time, and run their tests."""
    logging.disable(logging.CRITICAL)
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder, chdir(_copy(Path(folder))):
        # What is compiled from a faulty module stays here; what is compiled already need not be again.
        shutil.copytree(machine_code_root(), Path(folder) / "machine-code")
        os.environ |= {"NUMBA_CACHE_DIR": folder, "PYTHONPATH": str(Path.cwd()), "OPENBLAS_NUM_THREADS": "1"}
        found = []
        for module, chosen in faults(place, most, seed).items():
            for stale in (Path(module).parent / "__pycache__").glob(f"{Path(module).stem}.*"):
                stale.unlink()
            command = (
                f"{sys.executable} -m pytest -x -q -n 0 -m 'not thorough' -p no:cacheprovider "
                f"-p tests.mutants.quickly {module} {PLACES[place][module]}"
            )
            # Its kernels would be compiled anew with every fault, for minutes.
            os.environ["NUMBA_DISABLE_JIT"] = str(int(module.startswith("rig/engine/")))
            started = time.monotonic()
            outcome, output = run_tests(command, 3600.0)
            if outcome is not TestOutcome.SURVIVED:
                raise RuntimeError(f"{module}: its tests fail as it is:\n{output[-3000:]}")
            patience = 30.0 + 2.0 * (time.monotonic() - started)
            found += [_try(place, module, fault, command, patience) for fault in chosen]
    return found


def _try(place: str, module: str, fault: MutationSpec, command: str, patience: float) -> Found:
    result = mutate_and_test([fault], command, patience)
    if result.test_outcome not in (TestOutcome.KILLED, TestOutcome.SURVIVED):
        raise RuntimeError(f"{module}: no trial of {fault}:\n{result.output}")
    lines = [line for line in result.diff.splitlines() if line.startswith(("@@", "-", "+"))]
    change = [line for line in lines if line[:3] not in ("---", "+++")]
    why = next((EQUIVALENT[text] for line in change if (text := line[1:].strip()) in EQUIVALENT), "")
    return Found(place, module, result.test_outcome is TestOutcome.KILLED, why, "\n".join(change))


def _copy(folder: Path) -> Path:
    """Copy what the tests need of the checkout."""
    copy = folder / "checkout"
    copy.mkdir()
    for name in ("rig", "daq", "analysis", "tests", "recordings"):
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("*.mcap"))
    for name in ("pyproject.toml", "README.md", "Makefile", "LICENSE"):
        shutil.copy(ROOT / name, copy)
    return copy
