"""Commands replace their own output files, with the same bytes, but no file of another command or of the user."""

from __future__ import annotations

import shutil
import warnings
from importlib import import_module
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

import daq
from rig.errors import ShotrigError

SWEEP = Path(__file__).parents[3] / "recordings" / "demo-sweep-no-damper.mcap"
HIT = SWEEP.with_name("demo-impulse-no-damper.mcap")


def run_command(package: str, *arguments: str) -> Result:
    """Run a command of rig, daq or analysis."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", daq.RunWarning)
        return CliRunner().invoke(import_module(f"{package}.cli").app, arguments)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for file in (SWEEP, HIT):
        shutil.copy(file, tmp_path / file.name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("command", "output"),
    [
        (f"analysis frf {SWEEP.name} --response body3", f"{SWEEP.stem}-frf.csv"),
        (f"analysis modes {SWEEP.name}", f"{SWEEP.stem}-modes.png"),
        (f"analysis decay {HIT.name}", f"{HIT.stem}-decay-damping.csv"),
        (f"analysis report {HIT.name} -o page.html", "page.html"),
        (f"analysis export {SWEEP.name} -o out.csv --to 0.1", "out.csv"),
        ("rig simulate fig9 --duration 0.05s -o run.npz", "run.npz"),
        ("rig simulate fig9 --duration 0.05s -o run.csv", "run.csv"),
        ("rig response fig9 --from 20Hz --to 21Hz --points 2 -o response.csv", "response.csv"),
    ],
)
def test_command_replaces_only_its_own_output(folder: Path, command: str, output: str) -> None:
    (folder / output).write_bytes(b"mine")
    rejected = run_command(*command.split())
    assert isinstance(rejected.exception, ShotrigError) and f"{output} exists" in str(rejected.exception)
    assert (folder / output).read_bytes() == b"mine"
    assert run_command(*command.split(), "--overwrite").exit_code == 0
    written = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert written[output] != b"mine"
    repeated = run_command(*command.split())
    assert repeated.exit_code == 0, (repeated.output, repeated.exception)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == written


@pytest.mark.usefixtures("no_pictures")
def test_output_is_replaced_with_other_options(folder: Path) -> None:
    for motion in ("displacement", "velocity"):
        assert run_command("analysis", "frf", SWEEP.name, "--response", "body3", "--motion", motion).exit_code == 0
    assert "m/(N s)" in (folder / f"{SWEEP.stem}-frf.csv").read_text(encoding="utf-8")


def test_response_of_another_scene_is_not_replaced(folder: Path) -> None:
    options = ("--from", "20Hz", "--to", "21Hz", "--points", "2", "-o", "response.csv")
    assert run_command("rig", "response", "fig9", *options).exit_code == 0
    rejected = run_command("rig", "response", "fig9", "--set", "test.force=5N", *options)
    assert isinstance(rejected.exception, ShotrigError) and "another source" in str(rejected.exception)


def test_recorded_test_is_not_repeated(folder: Path) -> None:
    command = ("daq", "record", "fig10b-no-damper", "--set", "test.repeats=1", "--set", "test.interval=0.3s")
    assert run_command(*command, "-o", "hit.mcap").exit_code == 0
    before = (folder / "hit.mcap").stat()
    repeated = run_command(*command, "-o", "hit.mcap")
    assert repeated.exit_code == 0 and "already contains the complete test" in repeated.output
    assert (folder / "hit.mcap").stat().st_mtime_ns == before.st_mtime_ns
    other_seed = run_command(*command, "--set", "seed=2", "-o", "hit.mcap")
    assert isinstance(other_seed.exception, ShotrigError) and "exists" in str(other_seed.exception)
