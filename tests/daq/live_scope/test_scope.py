"""The live scope: frequency and force that the operator enters take effect in output, display and recording.

The operator types lines such as `f 12` (Hz), `F 1.5` (N) and `q` (quit).
"""

from __future__ import annotations

import gc
import os
import re
import signal
import subprocess
import sys

import numpy as np
import pytest
from rerun.chunk import RrdReader

import daq
import daq.viewing.outputs
import rig
from analysis.responses.frequency_responses import frequency_responses
from daq.cli import main
from daq.excitation.manual_tone import ToneControls
from daq.live_scope.scope import initial_controls, record_live
from daq.viewing.outputs import recording_stream
from rig.errors import SceneError
from rig.system.structural_model import receptance

# High damping, so that the steady state is reached within seconds.
SCENE = rig.loads("""
name: scoped
structure: {masses: [1 kg, 1 kg], springs: [20 kN/m, 20 kN/m], damping: {modal: 5 %}}
dampers: [{body: 2, mass: 80 g, clearance: .inf}]
shaker: {kind: table, body: 1, spring: 5 kN/m}
""")


def run_scope(scene, folder, line_at_time, **options):
    """Run a scope faster than real time; enter the lines at their times in s.

    Returns the path of the recording and the lines that the scope reports.
    """
    controls, lines, remaining_lines = initial_controls(scene, None, 0.0), [], sorted(line_at_time.items())
    rate = float(scene.converter.rate)

    def enter_lines(position):
        while remaining_lines and position >= remaining_lines[0][0] * rate:
            controls.execute(remaining_lines.pop(0)[1])

    with recording_stream() as stream:
        stream.save(folder / "scope.rrd")
        path = record_live(scene, folder / "scope.mcap", stream, controls, lines.append, enter_lines, **options)
        stream.flush()
    return path, lines


@pytest.fixture(scope="module")
def scope_run(tmp_path_factory):
    """Return folder, recording and reported lines of a run with three settings."""
    folder = tmp_path_factory.mktemp("scope")
    line_at_time = {0.3: "f 20.5", 0.5: "F 1.5", 6.2: "F 3", 8.7: "f 25", 13.2: "q"}
    path, lines = run_scope(SCENE, folder, line_at_time)
    return folder, path, lines


def test_entered_settings_are_reached_and_marked(scope_run):
    _, path, lines = scope_run
    with daq.open(path) as recording:
        steady_marks = [mark for mark in recording.markers if mark.kind == "measure" and mark.fields["settled"]]
        settings = [(mark.fields["frequency"], mark.fields["level"]) for mark in steady_marks]
        assert settings == [(20.5, 1.5), (20.5, 3.0), (25.0, 3.0)]
        for mark, (frequency, level) in zip(steady_marks, settings, strict=True):
            n_periods = int((mark.last_sample + 1 - mark.first_sample) * frequency / recording.rate)
            stop = mark.first_sample + round(n_periods * recording.rate / frequency)
            demodulation = np.exp(-2j * np.pi * frequency * np.arange(mark.first_sample, stop) / recording.rate)
            table, body = (
                2 * np.mean(recording.read(name, mark.first_sample, stop) * demodulation) for name in ("table", "body1")
            )
            force = SCENE.shaker.spring * (table - body) / (2j * np.pi * frequency) ** 2
            assert abs(force) == pytest.approx(level, rel=0.03)
    assert [line.split(" held")[0].split(" Hz")[0] for line in lines] == ["20.5", "20.5", "25"]


def test_displayed_curves_and_rig_match_recording(scope_run):
    folder, path, _ = scope_run
    curve_blocks, n_frames, pages = [], 0, []
    for chunk in RrdReader(folder / "scope.rrd").stream():
        batch = chunk.to_record_batch()
        if chunk.entity_path == "/channels/acceleration/body2" and not chunk.is_static:
            curve_blocks.append(batch.column("Scalars:scalars").flatten().to_numpy())
        if chunk.entity_path == "/rig/body_2" and not chunk.is_static:
            n_frames += batch.num_rows
        if chunk.entity_path == "/reading":
            pages += [text for (text,) in batch.column("TextDocument:text").to_pylist()]
    with daq.open(path) as recording:
        recorded = recording.read("body2")
        displayed = np.concatenate(curve_blocks)
        assert displayed.size == recorded.size == recording.samples
        np.testing.assert_allclose(np.sort(displayed), np.sort(recorded), rtol=0, atol=1e-12)
        # The rig is drawn 200 times per second.
        assert n_frames == pytest.approx(recording.samples / recording.rate * 200, rel=0.05)
    assert any("25.00 Hz, 3 N: held" in page for page in pages)
    assert any("silent" in page for page in pages)


def interrupt(*ignored):
    signal.raise_signal(signal.SIGINT)


def test_interrupted_tone_is_marked_up_to_the_ramp(tmp_path, monkeypatch):
    unraisable = []
    monkeypatch.setattr(sys, "unraisablehook", unraisable.append)
    scene = SCENE.replace(test={"kind": "sine", "frequency": 12.0, "force": 1.5}, dampers=[])
    controls = initial_controls(scene, None, 1.5)
    with recording_stream() as stream, pytest.raises(KeyboardInterrupt, match="contains the"):
        stream.save(tmp_path / "scope.rrd")
        record_live(scene, tmp_path / "scope.mcap", stream, controls, interrupt, lambda position: None)
    gc.collect()
    assert unraisable == []
    with daq.open(tmp_path / "scope.mcap") as recording:
        assert recording.status == "interrupted"
        *_, steady_mark, abort = recording.markers
        assert (steady_mark.kind, steady_mark.fields["level"], steady_mark.fields["settled"]) == ("measure", 1.5, True)
        assert abort.kind == "abort"
        volts = recording.read("table", steady_mark.first_sample, steady_mark.last_sample + 1)
        half = len(volts) // 2
        # A ramp in the marked samples would be visible at the end.
        assert np.std(volts[half:]) == pytest.approx(np.std(volts[:half]), rel=0.05)
        ((curve,),) = frequency_responses(recording, ["body1"])
        assert curve.frequency.tolist() == [12.0]


def test_existing_file_is_rejected_before_output(tmp_path, monkeypatch):
    unraisable = []
    monkeypatch.setattr(sys, "unraisablehook", unraisable.append)
    (tmp_path / "scope.mcap").write_bytes(b"precious")
    with recording_stream() as stream, pytest.raises(rig.errors.RecordingError, match="exists"):
        controls = initial_controls(SCENE, None, 2.0)
        record_live(SCENE, tmp_path / "scope.mcap", stream, controls, str, lambda position: None)
    gc.collect()
    assert unraisable == []
    assert (tmp_path / "scope.mcap").read_bytes() == b"precious"


def test_drive_of_force_shaker_is_force(tmp_path):
    scene = SCENE.replace(shaker={"kind": "force", "body": 1})
    path, _ = run_scope(scene, tmp_path, {0.1: "F 2", 4.0: "q"})
    with daq.open(path) as recording:
        (steady_mark,) = (mark for mark in recording.markers if mark.kind == "measure")
        assert steady_mark.fields["level"] == steady_mark.fields["drive"] == 2.0


def test_scope_without_shaker_writes_no_file(tmp_path):
    with pytest.raises(SceneError, match="no drive input"):
        run_scope(SCENE.replace(shaker=None), tmp_path, {0.1: "q"})
    assert not (tmp_path / "scope.mcap").exists()


def test_scope_command_rejects_existing_file_before_viewer(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(daq.viewing.outputs, "viewer", lambda *options: pytest.fail("the viewer was started"))
    (tmp_path / "scope.mcap").write_bytes(b"precious")
    arguments = ["daq", "scope", "bare-structure", "--web", "-o", str(tmp_path / "scope.mcap")]
    monkeypatch.setattr(sys, "argv", arguments)
    with pytest.raises(SystemExit) as exit_request:
        main()
    assert exit_request.value.code == 2
    assert "exists. Choose another name, or pass --overwrite" in capsys.readouterr().err
    assert (tmp_path / "scope.mcap").read_bytes() == b"precious"


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("f", "not a number"),
        ("f twelve", "not a number"),
        ("f 0", "above 0"),
        ("f 1e6", "up to 100 Hz"),
        ("F -1", "0 N or more"),
        ("F nan", "0 N or more"),
        ("louder", "unknown command"),
        ("q now", "unknown command"),
    ],
)
def test_invalid_line_keeps_the_setting(line, message):
    controls = ToneControls(10.0, 1.0, highest=100.0)
    with pytest.raises(SceneError, match=message):
        controls.execute(line)
    assert controls.settings == (10.0, 1.0)
    assert not controls.quit


def test_controls_start_at_the_frequency_of_the_test():
    assert initial_controls(rig.load("fig8-three-dampers"), None, 0.0).settings == (8.0, 0.0)
    # The scene has no test: the lowest natural frequency, 0.618 sqrt(k / m) / (2 pi) without spring and damper.
    assert initial_controls(SCENE, None, 0.0).settings[0] == pytest.approx(13.9, abs=0.1)
    assert initial_controls(SCENE, 33.0, 1.0).settings == (33.0, 1.0)


@pytest.mark.thorough
def test_end_of_input_closes_the_scope_recording(tmp_path):
    (tmp_path / "mine.yaml").write_text(SCENE.to_yaml())
    code = "from daq.cli import main; main()"
    command = [sys.executable, "-c", code, "scope", "mine.yaml", "--web", "-o", "live.mcap"]
    environment = {key: value for key, value in os.environ.items() if key not in ("DISPLAY", "WAYLAND_DISPLAY")}
    result = subprocess.run(
        command, input="F 1\nwhat\n", capture_output=True, text=True, timeout=120, cwd=tmp_path, env=environment
    )
    assert result.returncode == 0, result.stderr
    assert "http://127.0.0.1:" in result.stderr
    assert "'what'" in result.stderr
    assert "live.mcap:" in result.stdout
    with daq.open(tmp_path / "live.mcap") as recording:
        assert recording.samples > 0


@pytest.mark.parametrize("remove_delay", [False, True])
def test_force_with_a_filter_has_receptance_phases(tmp_path, remove_delay):
    converter = {"rate": "5.12 kHz", "filter": "delta_sigma", "remove_delay": remove_delay}
    scene = SCENE.replace(shaker={"kind": "force", "body": 1}, dampers=[], converter=converter)
    _, lines = run_scope(scene, tmp_path, {0.3: "f 20", 0.5: "F 1.5", 4.0: "q"})
    exact = np.degrees(np.angle(receptance(scene, [20.0])[:, 0]))
    phases = [float(degrees) for degrees in re.findall(r"\((-?\d+)°\)", lines[-1])]
    np.testing.assert_allclose(phases, exact, atol=1.0)
