"""Recording of a complete test with `daq.record` and `daq record`: files, limits, interruptions and errors."""

import os
import shutil
import signal
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import daq
import rig
from daq.commands.cli import main
from daq.core.measurement.impact_remedy import instantaneous_impact_remedy
from daq.core.measurement.limits import FlaggedIntervals
from daq.core.measurement.run_report import summary
from daq.core.recording.committed_file import CommittedFile
from daq.core.recording.recorder import Recorder
from daq.core.signal_chain.channel import ChannelInfo
from rig.core.base.errors import RecordingError, RunError, SceneError

HIT = {"kind": "impulse", "body": 1, "peak": "200 N", "width": "4 ms", "repeats": 1, "interval": "0.5 s"}
STEPS = {
    "kind": "stepped_sine", "frequencies": [48.0, 49.6], "force": "2.6 N", "measure": {"periods": 10},
}  # fmt: skip


def hit_scene(**changes: Any) -> rig.Scene:
    """Return a structure with three dampers that a hammer hits once, after 0.25 s, with these changes."""
    return rig.load("fig10b-three-dampers").replace(test=HIT, **changes)


def steps_scene(**changes: Any) -> rig.Scene:
    """Return a structure with three dampers and a stepped sine of two frequencies, with these changes."""
    return rig.load("fig8-three-dampers").replace(test=STEPS, **changes)


def limited_scene(**limits: str) -> rig.Scene:
    """Return a hit on a structure with one channel, on body 1, which has alarm or abort limits."""
    return hit_scene(channels=[{"name": "b1", "at": "body 1", **limits}], converter={"rate": "5120 Hz"})


@pytest.mark.thorough
@pytest.mark.parametrize(
    "scene", [hit_scene(), steps_scene(), hit_scene(recording={"truth": True})], ids=["hit", "steps", "truth"]
)
def test_block_size_does_not_change_file(scene: rig.Scene, tmp_path: Path) -> None:
    files = [
        daq.record(scene, tmp_path / f"{number}.mcap", block=block).read_bytes()
        for number, block in enumerate((None, 101, None))
    ]
    assert files[0] == files[1] == files[2]


def test_recording_with_removed_delay_starts_at_zero(tmp_path: Path) -> None:
    scene = hit_scene(converter={"rate": "250 Hz", "filter": "delta_sigma", "remove_delay": True})
    scene = scene.replace(test=scene.test.replace(width=0.02))
    with daq.open(daq.record(scene, tmp_path / "slow.mcap")) as recording:
        assert recording.samples > 0 and not recording.gaps
        assert np.isfinite(recording.read("body1")).all()


def test_seed_determines_noise(tmp_path: Path) -> None:
    paths = [daq.record(hit_scene(seed=seed), tmp_path / f"{seed}.mcap") for seed in (1, 2)]
    with daq.open(paths[0]) as first, daq.open(paths[1]) as second:
        assert not np.array_equal(first.read("body1"), second.read("body1"))


def test_markers_describe_every_point(tmp_path: Path) -> None:
    reports: list[tuple[float, str]] = []
    path = daq.record(steps_scene(), tmp_path / "new" / "s.mcap", progress=lambda *report: reports.append(report))
    with daq.open(path) as rec:
        points = [mark for mark in rec.markers if mark.kind == "measure"]
        assert [mark.fields["frequency"] for mark in points] == STEPS["frequencies"]
        for mark in points:
            assert mark.last_sample is not None
            assert mark.last_sample - mark.first_sample + 1 == round(10 * rec.rate / mark.fields["frequency"])
            assert mark.fields["settled"] and mark.fields["force"] == pytest.approx(2.6, rel=0.02)
            assert mark.fields["drive"] > 0
        assert rec.samples > points[-1].last_sample
        assert rec.scene == steps_scene()
    assert [fraction for fraction, _ in reports] == [0.0, 0.5, 1.0]


def test_existing_file_needs_overwrite(tmp_path: Path) -> None:
    path = daq.record(hit_scene(), tmp_path / "a.mcap")
    before = path.read_bytes()
    with pytest.raises(RecordingError, match="exists"):
        daq.record(steps_scene(), path)
    assert path.read_bytes() == before
    daq.record(steps_scene(), path, overwrite=True)
    assert path.read_bytes() != before


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        ("fig8-three-dampers", {"test": None}, "has no test"),
        ("fig10b-three-dampers", {"test": {**HIT, "width": "0.1 ms"}}, r"raise the sample rate \(converter\.rate\)"),
        ("fig8-three-dampers", {"channels": [{"name": "b", "at": "body 1"}]}, "requires a motion channel at the table"),
    ],
)
def test_impossible_test_leaves_no_file(name: str, changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=message):
        daq.record(rig.load(name).replace(**changes), tmp_path / "new" / "a.mcap")
    assert list(tmp_path.iterdir()) == []


def test_empty_block_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="block: got 0 "):
        daq.record(hit_scene(), tmp_path / "a.mcap", block=0)


def test_exceeded_abort_limit_closes_recording(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with pytest.raises(RunError, match=r"channel b1: .* exceeds its abort limit of 20 m/s\^2\. .* contains the"):
        daq.record(limited_scene(abort="20 m/s^2"), path)
    with daq.open(path) as rec:
        # The hit is after 0.25 s; the running block of 0.1 s is completed.
        assert 0.25 * rec.rate < rec.samples < 0.45 * rec.rate
        assert np.abs(rec.read("b1")).max() > 20.0
        abort = rec.markers[-1]
        assert abort.kind == "abort"
        assert "abort limit" in abort.fields["reason"]
        # The marker is at the first sample above the limit.
        exceeding = np.flatnonzero(np.abs(rec.read("b1")) > 20.0)
        assert (abort.first_sample, abort.last_sample) == (exceeding[0], exceeding[0])


def test_abort_ramps_shaker_down(tmp_path: Path) -> None:
    channels = [{"name": "b1", "at": "body 1", "abort": "5 m/s^2"}, {"name": "t", "at": "table"}]
    scene = rig.load("bare-structure").replace(
        test={"kind": "stepped_sine", "frequencies": [13.0], "force": "2.6 N"}, channels=channels
    )
    with pytest.raises(RunError, match="aborted"):
        daq.record(scene, tmp_path / "a.mcap")
    with daq.open(tmp_path / "a.mcap") as rec:
        table = rec.read("t")
        abort = rec.markers[-1]
        assert abort.first_sample == np.flatnonzero(np.abs(rec.read("b1")) > 5.0)[0]
        # A table that stopped at once would have an acceleration of hundreds of m/s^2.
        last_tenth_of_second = table[-512:]
        assert np.abs(last_tenth_of_second).max() < 20.0


def test_block_size_does_not_change_abort(tmp_path: Path) -> None:
    files = []
    for block in (None, 61):
        with pytest.raises(RunError):
            daq.record(limited_scene(abort="20 m/s^2"), tmp_path / "a.mcap", block=block, overwrite=True)
        files.append((tmp_path / "a.mcap").read_bytes())
    assert files[0] == files[1]


def test_alarm_limit_marks_and_continues(tmp_path: Path) -> None:
    path = daq.record(limited_scene(alarm="20 m/s^2"), tmp_path / "a.mcap")
    with daq.open(path) as rec:
        alarms = [mark for mark in rec.markers if mark.kind == "alarm"]
        exceeding = np.flatnonzero(np.abs(rec.read("b1")) > 20.0)
        assert len(alarms) == 1
        assert (alarms[0].first_sample, alarms[0].last_sample) == (exceeding[0], exceeding[-1])
        assert alarms[0].fields["channel"] == "b1"


def test_overloaded_samples_are_marked(tmp_path: Path) -> None:
    scene = limited_scene().replace(converter={"rate": "5120 Hz", "bits": 16, "range": "10 V"})
    path = daq.record(scene, tmp_path / "a.mcap")
    with daq.open(path) as rec:
        marks = [mark for mark in rec.markers if mark.kind == "overload"]
        range_v, count_v = 10.0, 20.0 / 2**16  # 1 V per m/s^2
        at_full_scale = np.flatnonzero(np.abs(rec.read("b1")) >= range_v - count_v)
        assert marks[0].first_sample == at_full_scale[0]
        assert marks[-1].last_sample == at_full_scale[-1]


def test_lost_blocks_leave_gaps(tmp_path: Path) -> None:
    # Samples 512 to 811 at 5120 S/s, and all samples from 3584 on.
    lost = [{"at": "0.1 s", "samples": 300}, {"at": "0.7 s", "samples": 10_000}]
    converter = {"rate": "5120 Hz", "bits": 24, "range": "5 V"}
    without_loss = daq.record(hit_scene(converter=converter), tmp_path / "without_loss.mcap")
    files = [
        daq.record(hit_scene(converter=converter | {"dropped_blocks": lost}), tmp_path / f"{block}.mcap", block=block)
        for block in (None, 100)
    ]
    assert files[0].read_bytes() == files[1].read_bytes()
    with daq.open(without_loss) as expected, daq.open(files[0]) as rec:
        readings = rec.read("body2")
        assert np.all(np.isnan(readings[512:812]))
        acquired = np.r_[0:512, 812:3584]
        np.testing.assert_array_equal(readings[acquired], expected.read("body2")[acquired])
        assert (rec.gaps[0].first_sample, rec.gaps[0].last_sample) == (512, 811)
        assert rec.gaps[1].first_sample == 3584


def test_removed_delay_keeps_times(tmp_path: Path) -> None:
    channels = [{"name": "b1", "at": "body 1", "integrator": {"order": 2}}]
    scene = rig.load("fig10b-no-damper").replace(test={**HIT, "width": "8 ms"}, channels=channels)
    delta_sigma = {"rate": "5120 Hz", "filter": "delta_sigma", "remove_delay": True}
    with (
        daq.open(daq.record(scene.replace(converter={"rate": "5120 Hz"}), tmp_path / "ideal.mcap")) as ideal,
        daq.open(daq.record(scene.replace(converter=delta_sigma), tmp_path / "filtered.mcap")) as filtered,
    ):
        assert ideal.samples == filtered.samples
        expected = ideal.read("b1")
        assert np.abs(filtered.read("b1") - expected).max() < 1e-3 * np.abs(expected).max()


def interrupt_after(calls: int) -> Any:
    """Return a progress callback that sends the signal of Ctrl-C after this number of calls."""
    remaining_calls = iter(range(calls))

    def progress(fraction: float, message: str) -> None:
        if next(remaining_calls, None) is None:
            os.kill(os.getpid(), signal.SIGINT)

    return progress


def test_ctrl_c_leaves_readable_recording(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with pytest.raises(KeyboardInterrupt, match=r"a\.mcap contains the first \d\.\d\d s"):
        daq.record(hit_scene(), path, progress=interrupt_after(2))
    with daq.open(path) as rec:
        # The hit is at 0.25 s; the complete test takes 0.75 s.
        assert 0.3 * rec.rate < rec.samples < 0.75 * rec.rate
        assert [mark.kind for mark in rec.markers][-1] == "abort"
        assert rec.markers[-1].fields["reason"] == "interrupted"
        assert rec.markers[-1].end < rec.samples
        assert (rec.status, rec.metadata["outcome"]["reason"]) == ("interrupted", "interrupted")
        assert np.isfinite(rec.read("body1")).all()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize(("moment", "status"), [("__enter__", "interrupted"), ("close", "complete")])
def test_ctrl_c_at_start_or_end_keeps_file(tmp_path, monkeypatch, moment, status):
    original = getattr(Recorder, moment)

    def interrupt(*arguments: Any) -> Any:
        signal.raise_signal(signal.SIGINT)
        return original(*arguments)

    monkeypatch.setattr(Recorder, moment, interrupt)
    path = tmp_path / "a.mcap"
    with pytest.raises(KeyboardInterrupt, match=r"a\.mcap contains the first \d\.\d\d s"):
        daq.record(hit_scene(), path)
    with daq.open(path) as rec:
        rec.check()
        assert rec.status == status
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_error_names_write_protected_folder(scene_file, monkeypatch, capsys):
    def fail(*_: Any, **__: Any) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.chdir(scene_file.parent)
    monkeypatch.setattr(Path, "mkdir", fail)
    assert run_command(monkeypatch, "record", "hit.yaml") == 2
    *_, message = capsys.readouterr().err.splitlines()
    folder = scene_file.parent / "recordings"
    assert f"{folder} cannot be written (Permission denied)" in message


def test_file_instead_of_folder_is_reported(tmp_path: Path) -> None:
    (tmp_path / "new").write_text("a file")
    with pytest.raises(RecordingError, match="a file has this name"):
        daq.record(hit_scene(), tmp_path / "new" / "a.mcap")


def test_full_disk_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(CommittedFile, "free", lambda _: 1 << 20)
    with pytest.raises(RunError, match="disk is full") as error:
        daq.record(hit_scene().replace(test={**HIT, "interval": "2 s"}), tmp_path / "a.mcap")
    with daq.open(tmp_path / "a.mcap") as rec:
        assert str(error.value).count("contains") == 1
        assert f"contains the first {rec.samples / rec.rate:.2f} s" in str(error.value)
        assert rec.status == "failed"
        assert "disk is full" in rec.metadata["outcome"]["reason"]


def test_progress_warns_of_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    messages: list[str] = []
    # The recorder keeps 1 MB free; 60 kB remain for the recording.
    monkeypatch.setattr(CommittedFile, "free", lambda _: (1 << 20) + 60_000)
    scene = hit_scene().replace(test={**HIT, "repeats": 20})
    with pytest.raises(RunError, match="disk is full"):
        daq.record(scene, tmp_path / "a.mcap", progress=lambda _, message: messages.append(message))
    assert any("the disk will be full before the end" in message for message in messages)


def test_full_disk_is_reported_before_test(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=1 << 19))
    with pytest.raises(SceneError, match=r"0\.5 MB are free"):
        daq.record(hit_scene(), tmp_path / "a.mcap")
    assert not list(tmp_path.iterdir())


def run_command(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    """Run the daq command; return its exit code."""
    monkeypatch.setattr(sys, "argv", ["daq", *arguments])
    with pytest.raises(SystemExit) as exit_request:
        main()
    return int(exit_request.value.code or 0)


@pytest.fixture
def scene_file(tmp_path: Path) -> Path:
    path = tmp_path / "hit.yaml"
    path.write_text(hit_scene().to_yaml())
    return path


def test_command_names_file_and_next_step(scene_file, monkeypatch, capsys):
    monkeypatch.chdir(scene_file.parent)
    assert run_command(monkeypatch, "record", "hit.yaml") == 0
    out = capsys.readouterr().out
    assert out.startswith("recordings/hit.mcap: 3840 samples of 4 channels, 0.75 s at 5120 Hz, ")
    assert "overloads: " in out
    assert "next: analysis decay recordings/hit.mcap   or: analysis frf recordings/hit.mcap   or: " in out
    assert run_command(monkeypatch, "record", "hit.yaml") == 0
    out = capsys.readouterr().out
    assert "hit.mcap: already contains the complete test of this scene" in out and "--overwrite" in out
    assert run_command(monkeypatch, "record", "hit.yaml", "--overwrite", "--block", "100") == 0


def test_each_scene_has_a_separate_file(scene_file, monkeypatch, capsys):
    folder = scene_file.parent
    (folder / "other.yaml").write_text(steps_scene().to_yaml())
    scenes, output = [str(scene_file), str(folder / "other.yaml")], ["-o", str(folder)]
    assert run_command(monkeypatch, "record", *scenes, *output, "--set", "seed=7") == 0
    for name, commands in (("hit", ["decay", "frf", "modes"]), ("other", ["frf", "dampers"])):
        path = folder / f"{name}.mcap"
        with daq.open(path) as recording:
            assert recording.scene.seed == 7
        capsys.readouterr()
        assert run_command(monkeypatch, "info", str(path)) == 0
        next_steps = capsys.readouterr().out.splitlines()[-len(commands) - 1 : -1]
        assert [line.split()[-3:] for line in next_steps] == [["analysis", command, str(path)] for command in commands]
    assert run_command(monkeypatch, "record", *scenes, *output) == 2
    assert run_command(monkeypatch, "record", scenes[0], scenes[0], *output, "--overwrite") == 2


def test_too_long_name_is_reported(tmp_path, monkeypatch, capsys):
    name = tmp_path / f"{'a' * 300}.mcap"
    assert run_command(monkeypatch, "record", "fig8-no-damper", "-o", str(name)) == 2
    (message,) = capsys.readouterr().err.splitlines()
    assert message.startswith(f"error: cannot create {name}: File name too long")


@pytest.mark.parametrize("scene", ["no-such-scene", "missing.yaml"])
def test_missing_scene_exits_with_2(scene, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run_command(monkeypatch, "record", scene) == 2
    assert "error: " in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_abort_exits_with_1(tmp_path, monkeypatch, capsys):
    (tmp_path / "a.yaml").write_text(limited_scene(abort="20 m/s^2").to_yaml())
    arguments = ["record", "--anyway", str(tmp_path / "a.yaml"), "-o", str(tmp_path / "a.mcap")]
    assert run_command(monkeypatch, *arguments) == 1
    assert "a.mcap contains the" in capsys.readouterr().err


def test_ctrl_c_exits_with_130(scene_file, monkeypatch, capsys):
    from contextlib import contextmanager

    import daq.core.measurement.run_report

    @contextmanager
    def progress_with_interrupt(title: str) -> Any:
        yield interrupt_after(2)

    monkeypatch.setattr(daq.core.measurement.run_report, "progress", progress_with_interrupt)
    output = scene_file.with_suffix(".mcap")
    assert run_command(monkeypatch, "record", str(scene_file), "-o", str(output)) == 130
    printed = capsys.readouterr()
    assert "interrupted" in printed.err
    assert f"{output}: " in printed.out and "aborted: interrupted" in printed.out


@pytest.mark.parametrize(
    ("longest", "warning", "count"),
    [
        ("2 s", "warning: 1 of 1 dwells did not reach steady state", "\nsteady state reached: 0 of 1"),
        ("60 s", "", "\nsteady state reached: 1 of 1"),
    ],
)
def test_dwells_in_steady_state_are_counted(longest, warning, count, tmp_path, monkeypatch, capsys):
    scene = rig.load("bare-structure").replace(
        test={"kind": "stepped_sine", "frequencies": [13.0], "force": "2.6 N", "settle": {"longest": longest}}
    )
    (tmp_path / "a.yaml").write_text(scene.to_yaml())
    assert run_command(monkeypatch, "record", str(tmp_path / "a.yaml"), "-o", str(tmp_path / "a.mcap")) == 0
    printed = capsys.readouterr()
    assert warning in printed.err and f"{count} measurements" in printed.out
    assert ("did not reach steady state" in printed.err) is bool(warning)


@pytest.mark.parametrize("block", [1, 3, 50])
def test_block_size_does_not_change_flagged_intervals(block: int) -> None:
    info = [ChannelInfo(name, "body 1", "acceleration", sensitivity=1.0, rate=10.0) for name in ("a", "b")]
    flags = np.zeros((2, 50), dtype=bool)
    flags[0, [3, 5, 9, 20, 21]] = True
    flags[1, 48] = True
    marks: list[tuple[Any, ...]] = []
    intervals = FlaggedIntervals("overload", info, lambda *mark, **fields: marks.append((*mark, fields["channel"])))
    for start in range(0, 50, block):
        intervals.add(start, flags[:, start : start + block])
    intervals.close()
    # Samples with a gap of up to half a second (5 samples) are merged.
    expected = [("overload", 3, 10, "a"), ("overload", 20, 22, "a"), ("overload", 48, 49, "b")]
    assert sorted(marks, key=lambda mark: mark[1]) == expected


@pytest.mark.filterwarnings("ignore::daq.RunWarning")
@pytest.mark.parametrize(("contact", "is_reported"), [("", True), (", contact: {duration: 2 ms}", False)])
def test_overload_of_instant_contacts_names_remedy(contact: str, is_reported: bool, tmp_path: Path) -> None:
    scene = rig.loads(f"""
structure: {{masses: [1 kg], springs: [40 kN/m], damping: {{modal: 1 %}}}}
dampers: [{{body: 1, mass_ratio: 10 %, clearance: 1 mm{contact}}}]
shaker: {{kind: force, body: 1}}
test: {{kind: sine, frequency: 30 Hz, force: 10 N, duration: 1 s}}
channels:
  - {{name: body1, at: body 1, accelerometer: {{preset: PCB 352C33}}}}
  - {{name: force, at: shaker, hammer: {{sensitivity: 10 mV/N}}}}
""")
    daq.record(scene, tmp_path / "r.mcap")
    assert ("zero duration" in summary(tmp_path / "r.mcap")) is is_reported
    assert ("zero duration" in str(daq.foresee(scene))) is is_reported


@pytest.mark.parametrize("clearance", ["1 mm", ".inf"])
def test_sliding_masses_have_no_contact_remedy(clearance: str) -> None:
    damper = {"body": 1, "mass": "50 g", "friction": 0.3, "clearance": clearance}
    assert not instantaneous_impact_remedy(hit_scene(dampers=[damper]))


@pytest.mark.parametrize(("drive", "limit"), [("2.5 V", "amplifier.limit"), ("2.5 V", "output.range"), ("1 V", "")])
def test_clipped_drive_is_marked_and_reported(drive: str, limit: str, tmp_path: Path) -> None:
    test = {"kind": "sine", "frequency": "30 Hz", "drive": drive, "duration": "1 s"}
    limits = {f"shaker.{key}": "1.2 V" for key in (limit or "amplifier.limit", "amplifier.limit")}
    path = daq.record(rig.load("fig8-no-damper", {"test": test, **limits}), tmp_path / "a.mcap")
    with daq.open(path) as recording:
        clipped = [marker for marker in recording.markers if marker.kind == "clipped"]
    assert bool(clipped) == bool(limit) and all(marker.fields["channel"] == "shaker" for marker in clipped)
    assert ("clipped the drive for 0.9" in summary(path)) == bool(limit)
