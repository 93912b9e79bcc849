"""One module and its faults: made in a copy of the checkout, one at a time, its tests run on each."""

from __future__ import annotations

import logging
import os
import random
import shutil
import sys
import tempfile
import time
from collections import defaultdict
from contextlib import chdir
from dataclasses import dataclass
from pathlib import Path

from cosmic_ray.commands.init import init
from cosmic_ray.mutating import mutate_and_test
from cosmic_ray.testing import run_tests
from cosmic_ray.work_db import use_db
from cosmic_ray.work_item import MutationSpec, TestOutcome

ROOT = Path(__file__).parents[2]
# Types are not run, and which decorator compiles a function changes no result.
UNTRIED = ("BitOr", "BitAnd", "BitXor", "LShift", "RShift", "FloorDiv", "RemoveDecorator", "Unary_Invert")


@dataclass(frozen=True)
class Found:
    """What came of one fault: whether the tests noticed, and the changed lines."""

    place: str
    module: str
    noticed: bool
    change: str


def faults(module: str, most: int, seed: int) -> list[MutationSpec]:
    """Choose faults of a module, at different positions as far as there are."""
    with use_db(":memory:") as work:
        init([Path(module)], work, {})
        every = [fault for item in work.work_items for fault in item.mutations]
    chance = random.Random(f"{seed} {module}")
    places = defaultdict(list)
    for fault in every:
        if not any(name in fault.operator_name for name in UNTRIED):
            places[fault.start_pos].append(fault)
    positions = chance.sample(list(places), min(most, len(places)))
    return [chance.choice(places[position]) for position in positions]


def try_module(place: str, module: str, tests: str, most: int, seed: int) -> list[Found]:
    """Put faults into a module of a copy of the checkout, one at a time, and run its tests."""
    logging.disable(logging.CRITICAL)
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder, chdir(_copy(Path(folder))):
        # What is compiled from a faulty module stays here; what is compiled already need not be again.
        os.environ["NUMBA_CACHE_DIR"] = str(Path(folder) / "machine-code")
        command = (
            f"{sys.executable} -m pytest -x -q -n 0 -m 'not thorough' -p no:cacheprovider {module} {tests}"
        )
        started = time.monotonic()
        outcome, output = run_tests(command, 3600.0)
        if outcome is not TestOutcome.SURVIVED:
            raise RuntimeError(f"{module}: its tests fail as it is:\n{output[-3000:]}")
        patience = 60.0 + 5.0 * (time.monotonic() - started)
        found = []
        for fault in faults(module, most, seed):
            result = mutate_and_test([fault], command, patience)
            found.append(Found(place, module, result.is_killed, _changed(result.diff or result.output or "")))
    return found


def _copy(folder: Path) -> Path:
    """Copy what the tests need of the checkout, and the machine code that is there."""
    copy = folder / "checkout"
    copy.mkdir()
    for name in ("rig", "daq", "analysis", "tests", "recordings"):
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__", "*.mcap"))
    for name in ("pyproject.toml", "README.md", "Makefile", "LICENSE"):
        shutil.copy(ROOT / name, copy)
    kept = Path(os.environ.get("NUMBA_CACHE_DIR", Path.home() / ".cache/shotrig/machine-code"))
    if kept.is_dir():
        shutil.copytree(kept, folder / "machine-code")
    return copy


def _changed(diff: str) -> str:
    lines = diff.splitlines()
    return "\n".join(
        line for line in lines if line.startswith(("@@", "-", "+")) and line[:3] not in ("---", "+++")
    )
