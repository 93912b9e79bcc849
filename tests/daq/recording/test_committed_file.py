"""An existing recording stays complete until its replacement is complete.

A replacement is written as `NAME.part`, and renamed to `NAME` when it is complete: this is a committed file.
"""

import os
from pathlib import Path

import numpy as np
import pytest

import daq
from daq.core.recording import committed_file
from daq.core.recording.committed_file import CommittedFile
from daq.core.recording.recorder import Recorder
from daq.core.recording.recovery import recover
from daq.extras.importing.channel_table import Column
from rig.core.base.errors import RecordingError, RunError
from tests.daq.recording.recordings import (
    FLUSH_LENGTH,
    RATE,
    VOLTS_PER_ACCELERATION,
    VOLTS_PER_METER,
    make_scene,
    random_volts,
    two_channels,
    write_recording,
)

# Voltages of two channels, shape (2, samples).
OLD, NEW = random_volts(FLUSH_LENGTH, seed=1), random_volts(2 * FLUSH_LENGTH, seed=2)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return write_recording(tmp_path / "run.mcap", OLD)


def volts(path: Path) -> np.ndarray:
    """Check a recording, and return the voltages of both channels, shape (2, samples)."""
    with daq.open(path) as recording:
        recording.check()
        displacement, acceleration = recording.read("body1"), recording.read("body2")
    return np.array([displacement * VOLTS_PER_METER, acceleration * VOLTS_PER_ACCELERATION])


def names_in_folder_of(path: Path) -> list[str]:
    return sorted(each.name for each in path.parent.iterdir())


def recorder(path: Path, overwrite: bool = True) -> Recorder:
    return Recorder(path, make_scene(), two_channels(), RATE, overwrite=overwrite)


def test_killed_replacement_leaves_both_recordings(path: Path) -> None:
    # The recorder is never closed, as if its process had been killed.
    killed_recorder = recorder(path)
    killed_recorder.write(NEW)
    assert np.allclose(volts(path), OLD, rtol=1e-15)
    fixed = path.with_name("fixed.mcap")
    recover(path.with_name("run.mcap.part"), fixed)
    assert np.allclose(volts(fixed), NEW, rtol=1e-15)
    killed_recorder._disk.close()
    with recorder(path) as another:
        another.write(NEW[:, :FLUSH_LENGTH])
    assert np.allclose(volts(path), NEW[:, :FLUSH_LENGTH], rtol=1e-15)
    # The file of the killed recorder is kept; the other replacement had the name run.mcap.part2.
    assert path.with_name("run.mcap.part").exists() and not path.with_name("run.mcap.part2").exists()


def test_failed_replacement_keeps_the_old_recording(path: Path) -> None:
    with pytest.raises(ZeroDivisionError), recorder(path):
        raise ZeroDivisionError
    assert np.allclose(volts(path), OLD, rtol=1e-15) and names_in_folder_of(path) == ["run.mcap"]


def test_failed_creation_releases_the_old_recording(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patched, pytest.raises(RecordingError, match="cannot be created") as failure:
        patched.setattr(
            committed_file, "_unused_name", lambda final, ending: final.parent / "missing" / "run.mcap.part"
        )
        recorder(path)
    # The traceback of the error refers to the failed recorder, whose open file would keep the lock.
    with recorder(path) as another:
        another.write(NEW)
    assert failure.tb and np.allclose(volts(path), NEW, rtol=1e-15)


@pytest.mark.parametrize("overwrite", [True, False])
def test_second_recorder_of_a_file_is_rejected(tmp_path: Path, overwrite: bool) -> None:
    path = tmp_path / "run.mcap"
    with recorder(path, overwrite=False) as first:
        with pytest.raises(RecordingError, match="another process is recording" if overwrite else "exists"):
            recorder(path, overwrite)
        first.write(NEW)
    assert np.allclose(volts(path), NEW, rtol=1e-15)


def test_failed_recovery_keeps_the_old_file(path: Path) -> None:
    bad = path.with_name("bad.mcap")
    bad.write_bytes(b"no recording at all" * 100)
    with pytest.raises(RecordingError, match="nothing can be recovered"):
        recover(bad, path, overwrite=True)
    assert np.allclose(volts(path), OLD, rtol=1e-15) and names_in_folder_of(path) == ["bad.mcap", "run.mcap"]


def test_device_is_rejected_as_target(path: Path) -> None:
    for open_target in (lambda: recorder(Path(os.devnull)), lambda: recover(path, os.devnull, overwrite=True)):
        with pytest.raises(RecordingError, match="is a folder or a device"):
            open_target()
    assert Path(os.devnull).is_char_device()


def test_recovery_removes_rest_of_killed_recovery(path: Path) -> None:
    target = write_recording(path.with_name("fixed.mcap"), OLD)
    for ending in (".recovering", ".recovering2", ".part"):
        path.with_name(f"fixed.mcap{ending}").write_bytes(b"unfinished")
    recover(path, target, overwrite=True)
    assert names_in_folder_of(path) == ["fixed.mcap", "fixed.mcap.part", "run.mcap"]


def test_recovered_file_is_kept_if_renaming_fails(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = write_recording(path.with_name("fixed.mcap"), OLD)

    def fail(self: Path, other: Path) -> Path:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "replace", fail)
    with pytest.raises(RunError, match=r"Use the new recording .*fixed\.mcap\.recovering"):
        recover(path, target, overwrite=True)
    assert np.allclose(volts(path.with_name("fixed.mcap.recovering")), OLD, rtol=1e-15)


def test_moved_file_is_complete_and_reported(tmp_path: Path) -> None:
    path, moved = tmp_path / "run.mcap", tmp_path / "moved.mcap"
    with pytest.raises(RunError, match=r"run\.mcap: the file was moved"), recorder(path, overwrite=False) as first:
        first.write(NEW[:, :FLUSH_LENGTH])
        path.rename(moved)
        first.write(NEW[:, FLUSH_LENGTH:])
    assert np.allclose(volts(moved), NEW, rtol=1e-15) and names_in_folder_of(path) == ["moved.mcap"]


def test_deleted_file_ends_the_recording(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with pytest.raises(RunError, match=r"run\.mcap: the file was deleted"), recorder(path, overwrite=False) as first:
        path.unlink()
        first.write(NEW)
    assert not names_in_folder_of(path)


def test_full_disk_keeps_the_old_recording(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(RunError, match=r"run\.mcap is unchanged"), recorder(path) as replacement:
        replacement.write(NEW[:, :FLUSH_LENGTH])
        monkeypatch.setattr(CommittedFile, "free", lambda _: committed_file.RESERVE)
        replacement.write(NEW[:, FLUSH_LENGTH:])
    assert np.allclose(volts(path), OLD, rtol=1e-15)
    assert np.allclose(volts(path.with_name("run.mcap.part")), NEW[:, :FLUSH_LENGTH], rtol=1e-15)


def test_another_file_at_the_path_is_kept(path: Path) -> None:
    part = path.with_name("run.mcap.part")
    with pytest.raises(ZeroDivisionError), recorder(path):
        part.rename(path.with_name("moved"))
        part.write_bytes(b"precious")
        raise ZeroDivisionError
    assert part.read_bytes() == b"precious"


def test_import_does_not_replace_a_file_being_recorded(path: Path) -> None:
    source = path.with_name("source.csv")
    time = np.arange(FLUSH_LENGTH) / RATE
    np.savetxt(source, np.column_stack([time, *OLD]), delimiter=",", header="time [s],body1,body2", comments="")
    table = {name: Column(name, unit="m/s^2") for name in ("body1", "body2")}
    target = path.with_name("recorded.mcap")
    with recorder(target, overwrite=False) as running:
        running.write(NEW[:, :FLUSH_LENGTH])
        with pytest.raises(RecordingError, match="another process is recording"):
            daq.import_files(source, make_scene(converter={"rate": RATE}), target, table=table, overwrite=True)
        running.write(NEW[:, FLUSH_LENGTH:])
    assert np.allclose(volts(target), NEW, rtol=1e-15)


def test_file_is_created_by_its_first_commit(tmp_path: Path) -> None:
    file = CommittedFile(tmp_path / "run.mcap", overwrite=False)
    file.write(b"beginning")
    assert not names_in_folder_of(file.path)
    file.commit()
    assert file.path.read_bytes() == b"beginning"
    file.close()
