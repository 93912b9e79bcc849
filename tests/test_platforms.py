"""Emulated differences between operating systems: Windows rules for open files, consoles with few characters."""

import errno
import io
import os
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

import analysis
import daq
import rig
from rig.commands import command_line
from rig.core.base.output_files import atomic_write

SCENE = {
    "test": {"kind": "free", "mode": 1, "amplitude": "1 mm", "duration": "0.7 s"},
    "shaker": None,
    "converter": None,
    "channels": [{"name": "body3", "at": "body 3"}],
}


@pytest.fixture
def windows_files(monkeypatch: pytest.MonkeyPatch) -> None:
    """Emulate Windows: open files cannot be renamed, replaced or removed; files open for reading cannot be synced."""

    def reject_open_file(path: Path) -> None:
        if str(path.resolve()) in {file.path for file in psutil.Process().open_files()}:
            raise PermissionError(errno.EACCES, "The process cannot access the file", str(path))

    fcntl = pytest.importorskip("fcntl")
    replace, unlink, sync = Path.replace, Path.unlink, os.fsync

    def windows_replace(self: Path, target: Path) -> Path:
        reject_open_file(self)
        reject_open_file(Path(target))
        return replace(self, target)

    def windows_unlink(self: Path, missing_ok: bool = False) -> None:
        reject_open_file(self)
        unlink(self, missing_ok)

    def windows_sync(number: int) -> None:
        if fcntl.fcntl(number, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
            raise OSError(errno.EBADF, "Bad file descriptor")
        sync(number)

    monkeypatch.setattr(Path, "replace", windows_replace)
    monkeypatch.setattr(Path, "rename", windows_replace)
    monkeypatch.setattr(Path, "unlink", windows_unlink)
    monkeypatch.setattr(os, "fsync", windows_sync)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has these rules itself")
def test_files_are_written_under_windows_rules(windows_files: None, tmp_path: Path) -> None:
    scene, path = rig.load("fig10b-no-damper", SCENE), tmp_path / "run.mcap"
    daq.record(scene, path)
    first = path.read_bytes()
    daq.record(scene.replace(seed=2), path, overwrite=True)
    assert path.read_bytes() != first
    with daq.open(path) as recording:
        assert recording.read("body3", 0, 10).size == 10
    assert "closed" in repr(recording)
    with atomic_write(tmp_path / "table.csv", overwrite=True) as part:
        part.write_text("1", encoding="utf-8")
    with atomic_write(tmp_path / "table.csv", overwrite=True) as part:
        part.write_text("2", encoding="utf-8")
    assert (tmp_path / "table.csv").read_text(encoding="utf-8") == "2"
    with daq.open(path) as recording:
        analysis.decay(recording).plot().figure.savefig(tmp_path / "decay.png")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["decay.png", "run.mcap", "table.csv"]


@pytest.mark.thorough
def test_program_runs_without_names_of_unix(tmp_path: Path) -> None:
    script = f"""
import os, signal, sys
for module in ("fcntl", "resource", "termios", "pwd", "grp"):
    sys.modules[module] = None
for owner, names in ((os, ("sched_getaffinity", "setpriority", "getuid")), (signal, ("SIGHUP", "SIGALRM"))):
    for name in names:
        if hasattr(owner, name):
            delattr(owner, name)
import daq, rig
from daq.extras.pytest_plugin.bench import open_bench
from rig.core.base.workers import cores
assert cores() == os.cpu_count()
daq.record(rig.load("fig10b-no-damper", {SCENE}), "run.mcap")
assert daq.open("run.mcap").read("body3", 0, 10).size == 10
open_bench(clock="real").close()
"""
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])}
    subprocess.run([sys.executable, "-c", script], cwd=tmp_path, env=environment, check=True)


@pytest.mark.parametrize("encoding", ["cp1252", "cp437", "ascii"])
@pytest.mark.parametrize(
    "command",
    [
        "rig presets",
        "rig explain fig9",
        "rig schema --explain",
        "rig scenes fe-beam",
        "daq info recordings/demo-sweep-no-damper.mcap",
        "analysis compare recordings/demo-sweep-no-damper.mcap recordings/demo-sweep-three-dampers.mcap -o {folder}",
    ],
)
def test_commands_print_on_consoles_with_few_characters(command, encoding, tmp_path, monkeypatch):
    console = io.TextIOWrapper(io.BytesIO(), encoding=encoding, errors="strict")
    monkeypatch.setattr(sys, "argv", command.format(folder=tmp_path).split())
    monkeypatch.setattr(sys, "stdout", console)
    with pytest.raises(SystemExit) as end:
        command_line.run_command(f"{sys.argv[0]}.commands.cli")
    console.flush()
    assert (end.value.code, len(console.buffer.getvalue()) > 100) == (0, True)
