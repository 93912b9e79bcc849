"""Commands replace existing files only with --overwrite, and write the same bytes again.

They create the folder of their output, and check before they compute that it can be written.
"""

import shutil
import warnings
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

import daq
from rig.core.base.errors import ShotrigError
from tests.analysis.responses import synthetic


def run_command(package: str, *arguments: str) -> Result:
    """Run a command of rig, daq or analysis."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", daq.RunWarning)
        return CliRunner().invoke(import_module(f"{package}.commands.cli").app, arguments)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recordings")
    # Five frequencies at each resonance.
    frequencies = np.ravel([np.linspace(0.994, 1.006, 5) * f for f in synthetic.NATURAL_FREQUENCIES])
    synthetic.stepped_sine(folder / "sweep.mcap", frequencies, noise=1e-6)
    synthetic.impulses(folder / "hit.mcap", interval=1.0)
    return folder


@pytest.fixture
def folder(recordings: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for file in recordings.iterdir():
        shutil.copy(file, tmp_path / file.name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def check_replacement(folder: Path, command: str, output: str) -> None:
    """Check that a command replaces an output file only with --overwrite, with the same bytes each time."""
    (folder / output).write_bytes(b"mine")
    rejected = run_command(*command.split())
    assert isinstance(rejected.exception, ShotrigError) and "pass `overwrite`" in str(rejected.exception)
    assert (folder / output).read_bytes() == b"mine"
    assert run_command(*command.split(), "--overwrite").exit_code == 0
    written = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert written[output] != b"mine"
    repeated = run_command(*command.split(), "--overwrite")
    assert repeated.exit_code == 0, (repeated.output, repeated.exception)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == written


@pytest.mark.parametrize(
    ("command", "output"),
    [
        ("analysis frf sweep.mcap --response body3", "sweep-frf.csv"),
        ("analysis modes sweep.mcap", "sweep-modes.png"),
        ("analysis srs hit.mcap", "hit-srs.csv"),
        ("analysis report hit.mcap -o page.html", "page.html"),
        ("analysis export sweep.mcap -o out.csv --to 0.1", "out.csv"),
        ("rig simulate fig9 --duration 0.05s -o run.npz", "run.npz"),
        ("rig simulate fig9 --duration 0.05s -o run.csv", "run.csv"),
        ("rig response fig9 --from 20Hz --to 21Hz --points 2 -o response.csv", "response.csv"),
    ],
)
def test_command_replaces_files_only_with_overwrite(folder: Path, command: str, output: str) -> None:
    check_replacement(folder, command, output)


@pytest.mark.usefixtures("undrawn_figures")
def test_decay_replaces_tables_only_with_overwrite(folder: Path) -> None:
    check_replacement(folder, "analysis decay hit.mcap", "hit-decay-damping.csv")


def test_recorded_test_is_not_repeated(folder: Path) -> None:
    command = ("daq", "record", "fig10b-no-damper", "--set", "test.repeats=1", "--set", "test.interval=0.3s")
    assert run_command(*command, "-o", "recorded.mcap").exit_code == 0
    before = (folder / "recorded.mcap").stat()
    repeated = run_command(*command, "-o", "recorded.mcap")
    assert repeated.exit_code == 0 and "already contains the complete test" in repeated.output
    assert (folder / "recorded.mcap").stat().st_mtime_ns == before.st_mtime_ns
    other_seed = run_command(*command, "--set", "seed=2", "-o", "recorded.mcap")
    assert isinstance(other_seed.exception, ShotrigError) and "exists" in str(other_seed.exception)


@pytest.mark.parametrize(
    ("command", "output"),
    [
        ("rig scenes --copy fig9 new/mine.yaml", "new/mine.yaml"),
        ("rig simulate fig9 --duration 0.05s -o new/run.npz", "new/run.npz"),
        ("rig response fig9 --from 20Hz --to 21Hz --points 2 -o new/response.csv", "new/response.csv"),
        ("daq recover sweep.mcap -o new/repaired.mcap", "new/repaired.mcap"),
        ("daq replay sweep.mcap --to 0.1 --save new/sweep.rrd", "new/sweep.rrd"),
        ("analysis export sweep.mcap -o new/out.csv --to 0.1", "new/out.csv"),
        ("analysis export sweep.mcap --what frfs -o new/out.uff", "new/out.uff"),
        ("analysis report hit.mcap -o new/page.html", "new/page.html"),
    ],
)
def test_command_creates_the_output_folder(folder: Path, command: str, output: str) -> None:
    result = run_command(*command.split())
    assert result.exit_code == 0, (result.output, result.exception)
    assert (folder / output).is_file()


@pytest.mark.parametrize(
    "command",
    [
        "rig cost fig9 -o sweep.mcap/out",
        "rig design fig9 -o sweep.mcap/out",
        "rig grains fig9 --set dampers[1].grains.diameter=2mm -o sweep.mcap/out.csv",
        "rig map fig9 -o sweep.mcap/out",
        "rig response fig9 -o sweep.mcap/out.csv",
        "rig simulate fig9 -o sweep.mcap/out.csv",
    ],
)
def test_unusable_folder_is_rejected_before_computing(folder, command, monkeypatch):
    def compute(*_: object, **__: object) -> None:
        raise AssertionError

    for function in (
        "rig.cost",
        "rig.response",
        "rig.core.simulation.run_output.simulate",
        "rig.core.base.study.Workers",
    ):
        monkeypatch.setattr(function, compute)
    result = run_command(*command.split())
    assert isinstance(result.exception, ShotrigError) and "a file has this name" in str(result.exception)


@pytest.mark.parametrize("command", ["compare", "dampers", "decay", "frf", "modes", "report"])
def test_missing_recording_creates_no_folder(folder: Path, command: str) -> None:
    result = run_command("analysis", command, "missing/a.mcap", "missing/b.mcap")
    assert isinstance(result.exception, ShotrigError) and "no such file" in str(result.exception)
    assert not (folder / "missing").exists()
