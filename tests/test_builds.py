"""The matrices, the system and the bench of a scene are built once for a command, and a recording's scene is read once.

A bench at rest is built for each run: the rehearsal of a test and its recording are two.
"""

import gc
from collections import Counter
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from daq.core.virtual_bench.bench import Bench
from daq.extras.ni_device.connecting import connect_scene
from rig.core.base.once import once_per_object
from rig.core.scene import loading
from rig.core.system import assembly, structural_model

SHORT = "fig9 --set test.points=2 --set test.settle.longest=2s"


def run(command: str) -> None:
    package, *words = command.split()
    result = CliRunner().invoke(import_module(f"{package}.commands.cli").app, words, catch_exceptions=False)
    assert result.exit_code == 0, result.output


@pytest.fixture
def builds(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """Counts of matrices, systems, benches and scenes of recordings since the start of the test."""
    counts: Counter[str] = Counter()

    def count(owner: Any, name: str) -> None:
        function = getattr(owner, name)

        def counted(*args: Any, **options: Any) -> Any:
            counts[name] += 1
            return function(*args, **options)

        monkeypatch.setattr(owner, name, counted)

    count(structural_model, "structure_matrices")
    count(assembly, "_system")
    count(Bench, "__init__")
    count(loading, "loads_si")
    return counts


def test_explanation_builds_once(builds: Counter[str]) -> None:
    run(f"rig explain {SHORT}")
    assert builds == {"structure_matrices": 1, "_system": 1, "__init__": 1}


def test_recording_builds_once(builds: Counter[str], tmp_path: Path) -> None:
    run(f"daq record {SHORT} -o {tmp_path / 'steps.mcap'}")
    assert builds == {"structure_matrices": 1, "_system": 1, "__init__": 2}


@pytest.mark.parametrize("command", ["simulate", "response"])
def test_simulation_builds_once(command: str, builds: Counter[str], tmp_path: Path) -> None:
    run(f"rig {command} reference-A -o {tmp_path / 'motion.csv'}")
    assert builds == {"structure_matrices": 1, "_system": 1}


def test_device_builds_once(builds: Counter[str]) -> None:
    connect_scene("fig9", "manual")
    assert builds == {"structure_matrices": 1, "_system": 1, "__init__": 1}


@pytest.mark.parametrize("command", ["frf", "dampers", "report"])
def test_scene_of_recording_is_read_once(command: str, builds: Counter[str], tmp_path: Path) -> None:
    recording = tmp_path / "steps.mcap"
    run(f"daq record {SHORT} -o {recording}")
    builds.clear()
    run(f"analysis {command} {recording} -o {tmp_path / 'out'}")
    assert builds["loads_si"] == 1 and builds["structure_matrices"] <= 1


def test_result_lives_as_long_as_its_object() -> None:
    class Settings:
        pass

    calls: list[int] = []

    @once_per_object
    def compute(settings: Settings) -> int:
        calls.append(id(settings))
        return len(calls)

    first, second = Settings(), Settings()
    assert [compute(first), compute(first), compute(second)] == [1, 1, 2]
    del first
    gc.collect()
    assert compute(Settings()) == 3
