"""No command replaces a file that it did not write, and each command can be repeated."""

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


def run_command(*words: object) -> Result:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", daq.RunWarning)
        command, *arguments = map(str, words)
        return CliRunner().invoke(import_module(f"{command}.cli").app, arguments)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for file in (SWEEP, HIT):
        shutil.copy(file, tmp_path / file.name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("words", "output"),
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
def test_a_command_renews_its_own_output_only(folder: Path, words: str, output: str) -> None:
    for _ in range(2):
        result = run_command(*words.split())
        assert result.exit_code == 0, (result.output, result.exception)
    written = (folder / output).read_bytes()
    (folder / output).write_bytes(b"mine")
    refused = run_command(*words.split())
    assert isinstance(refused.exception, ShotrigError) and f"{output} exists" in str(refused.exception)
    assert (folder / output).read_bytes() == b"mine"
    assert run_command(*words.split(), "--overwrite").exit_code == 0
    assert (folder / output).read_bytes() == written


def test_other_options_renew_an_output(folder: Path) -> None:
    for motion in ("displacement", "velocity"):
        assert run_command("analysis", "frf", SWEEP.name, "--response", "body3", "--motion", motion).exit_code == 0
    assert "m/(N s)" in (folder / f"{SWEEP.stem}-frf.csv").read_text(encoding="utf-8")


def test_another_scene_does_not_replace_a_response(folder: Path) -> None:
    words = ("--from", "20Hz", "--to", "21Hz", "--points", "2", "-o", "response.csv")
    assert run_command("rig", "response", "fig9", *words).exit_code == 0
    refused = run_command("rig", "response", "fig9", "--set", "test.force=5N", *words)
    assert isinstance(refused.exception, ShotrigError) and "another source" in str(refused.exception)


def test_a_test_already_recorded_is_kept(folder: Path) -> None:
    words = ("daq", "record", "fig10b-no-damper", "--set", "test.repeats=1", "--set", "test.interval=0.3s")
    assert run_command(*words, "-o", "hit.mcap").exit_code == 0
    before = (folder / "hit.mcap").stat()
    repeated = run_command(*words, "-o", "hit.mcap")
    assert repeated.exit_code == 0 and "already contains the complete test" in repeated.output
    assert (folder / "hit.mcap").stat().st_mtime_ns == before.st_mtime_ns
    other_seed = run_command(*words, "--set", "seed=2", "-o", "hit.mcap")
    assert isinstance(other_seed.exception, ShotrigError) and "exists" in str(other_seed.exception)
