"""Control-based continuation: runs on the bench, and curves with folds compared with exact orbits."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import analysis
import daq
import rig
from analysis.commands.cli import app
from rig.core.base.arrays import Array
from rig.core.base.errors import RecordingError, RunError, SceneError
from tests.daq.excitation.virtual_device import run_device
from tests.daq.measurement.bench_run import BenchRun, run

# The lower, stable part of the curve at 1.2 N, its fold at 50.52 Hz, and the unstable part up to 51 Hz.
FOLDED = {"force": 1.2, "from": "51 Hz", "to": "50 Hz"}
#: Channels of random scenes: an accelerometer on body 1 and a force cell.
BODY_1_AND_FORCE = {
    "channels": [
        {"name": "a1", "at": "body 1", "accelerometer": {"sensitivity": "10 mV/g", "noise": "20 ug/sqrt(Hz)"}},
        {"name": "force", "at": "shaker", "hammer": {"sensitivity": "100 mV/N"}},
    ],
    "converter": {"rate": 5120.0, "bits": 24, "range": 10.0},
}


def scene_with(**changes: Any) -> rig.Scene:
    """Return the bundled scene with changed keys of its test."""
    return rig.load("continuation", {f"test.{key}": value for key, value in changes.items()})


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    with pytest.warns(daq.RunWarning, match=r"leaves the band at 51\S* Hz, where the test began"):
        return daq.record(scene_with(**FOLDED), tmp_path_factory.mktemp("curve") / "curve.mcap")


@pytest.fixture(scope="module")
def exact() -> list[tuple[Any, Any]]:
    theory = rig.load("continuation").replace(test={"kind": "sine", "frequency": 51.0, "force": 1.2}, channels=None)
    curve = rig.follow_orbits(theory, "frequency", (50.3, 51.2))
    reference = [np.array([orbit.reference_amplitude for orbit in branch.orbits]) for branch in curve.branches]
    return [(b, abs(b.frf[0]) * amplitude) for b, amplitude in zip(curve.branches, reference, strict=True)]


def test_unstable_points_are_exact_orbits(recording: Path, exact: list[tuple[Any, Any]]) -> None:
    measured = analysis.continuation(recording)
    unstable = np.flatnonzero(~measured.stable & measured.settled & (measured.frequency > 50.55))
    assert unstable.size >= 6 and measured.frequency[unstable].max() > 51.0
    for k in unstable:
        errors = []
        for branch, amplitude in exact:
            offset = branch.value - measured.frequency[k]
            for i in np.flatnonzero((offset[1:] * offset[:-1] <= 0.0) & ~branch.stable[1:]):
                share = offset[i] / (offset[i] - offset[i + 1])
                errors.append(abs(measured.amplitude[k] / (amplitude[i] + share * np.diff(amplitude)[i]) - 1.0))
        assert min(errors) < 0.01


def test_fold_is_exact(recording: Path, exact: list[tuple[Any, Any]]) -> None:
    [fold] = analysis.continuation(recording).folds
    [exact_fold] = [value for branch, _ in exact for value in branch.folds if 50.4 < value < 50.7]
    assert abs(fold.frequency - exact_fold) < fold.expanded < 0.02


def test_steps_name_the_resolved_distance(recording: Path) -> None:
    result = CliRunner().invoke(app, ["continuation", str(recording)])
    steps = abs(np.diff(analysis.continuation(recording).frequency))
    [distance] = re.findall(r"do not resolve folds closer than (\S+) Hz at 1\.2 N", result.stdout)
    assert 0.3 * steps.max() < float(distance) <= 1.01 * steps.max()


def test_curve_continues_behind_a_corner(tmp_path: Path) -> None:
    # At 48.67 Hz the damper begins to hit the ceiling, so that no feedback of the envelope holds its motion.
    scene = rig.load({
        "structure": {"masses": [0.57804], "springs": [53051.78], "damping": {"modal": 0.0032672}},
        "dampers": [{"body": 1, "mass_ratio": 0.05692, "clearance": 0.000526314}],
        "shaker": {"kind": "force", "body": 1},
        "test": {"kind": "continuation", "from": 48.9, "to": 48.5, "at": "body 1", "force": 0.8629473},
        **BODY_1_AND_FORCE,
    })  # fmt: skip
    with pytest.warns(daq.RunWarning) as warned:
        path = daq.record(scene, tmp_path / "corner.mcap")
    assert re.search(r"no points from 48\.\d+ to 48\.\d+", " ".join(str(warning.message) for warning in warned))
    measured = analysis.continuation(path)
    theory = scene.replace(test={"kind": "sine", "frequency": 48.5, "force": 0.8629473}, channels=None)
    [branch] = [b for b in rig.follow_orbits(theory, "frequency", (48.45, 48.55)).branches if b.stable.any()]
    reference = np.array([orbit.reference_amplitude for orbit in branch.orbits])
    order = np.argsort(branch.value)
    exact = np.interp(measured.frequency[-1], branch.value[order], (abs(branch.frf[0]) * reference)[order])
    assert measured.frequency[-1] <= 48.5 and measured.amplitude[-1] == pytest.approx(exact, rel=0.01)
    shortest, longest = daq.foresee(scene).seconds_range
    with daq.open(path) as recording:
        assert shortest < recording.samples / recording.rate < longest


def test_control_does_not_change_motion(recording: Path) -> None:
    with daq.open(recording) as rec:
        marks = [mark.fields for mark in rec.markers if mark.kind == "measure"]
    assert all(fields["invasive"] < 0.01 for fields in marks if fields["settled"])
    assert sum(fields["invasive"] > 0.0 for fields in marks) >= 3  # on the unstable part, feedback stays on


def test_linear_curve_is_exact(tmp_path: Path) -> None:
    scene = scene_with(force=0.5, **{"from": "49 Hz", "to": "51.5 Hz"}).replace(dampers=[])
    measured = analysis.continuation(daq.record(scene, tmp_path / "linear.mcap"))
    theory = scene.replace(test={"kind": "sine", "frequency": 50.0, "force": 0.5})
    linear = 0.5 * abs(rig.frequency_response(theory, measured.frequency).compliance[0])
    assert abs(measured.amplitude / linear - 1.0).max() < 0.005
    assert measured.stable.all() and not measured.folds and measured.frequency.max() >= 51.4


def test_coil_shaker_is_followed() -> None:
    test = {"kind": "continuation", "from": "50.4 Hz", "to": "50 Hz", "at": "body 2", "force": 1.0}
    bench_run = run(rig.load("fig9").replace(test=test))
    weights = [bench_run.force_weights(fields["frequency"]) for *_, fields in bench_run.marks_of("measure")]
    forces = [
        abs(bench_run.amplitudes(first, stop, fields["frequency"]) @ weight)
        for (first, stop, fields), weight in zip(bench_run.marks_of("measure"), weights, strict=True)
    ]
    assert forces == pytest.approx([1.0] * len(forces), rel=0.006) and len(forces) >= 4


def test_short_transients_do_not_bias_the_force() -> None:
    # The mode decays within some of the windows from which the force is averaged.
    scene = rig.load({
        "structure": {"masses": [1.9287, 2.7045], "springs": [123835.0, 232666.0], "damping": {"modal": 0.009}},
        "shaker": {"kind": "electrodynamic", "body": 2, "spring": "24.77 kN/m"},
        "channels": [{"name": at.replace(" ", ""), "at": at, "accelerometer": {}} for at in ("body 2", "table")],
        "converter": {"rate": 2560.0},
        "test": {"kind": "continuation", "from": 24.9, "to": 24.0, "at": "body 2", "force": 2.63, "step": 0.4},
    })  # fmt: skip
    bench_run = run(scene)
    forces = [
        abs(bench_run.amplitudes(first, stop, fields["frequency"]) @ bench_run.force_weights(fields["frequency"]))
        for first, stop, fields in bench_run.marks_of("measure")
    ]
    assert bench_run.marks_of("measure")[-1][2]["frequency"] <= 24.0
    assert forces == pytest.approx([2.63] * len(forces), rel=0.005)


def test_unsteady_point_is_measured_with_a_shorter_step() -> None:
    # At 78.46 Hz the impacts change during the measurement, after the motion has appeared steady.
    scene = rig.load({
        "structure": {
            "masses": [0.65217, 1.7305],
            "springs": [33892.45217969787, 89931.90195342805],
            "damping": {"modal": 0.0031404},
        },
        "dampers": [{"body": 1, "mass_ratio": 0.052264, "clearance": 0.0003738184849685581}],
        "shaker": {"kind": "force", "body": 1},
        "test": {"kind": "continuation", "at": "body 1", "force": 0.9731671836943548}
        | {"from": 78.63434701857639, "to": 71.76338465772992, "points": 3},
        **BODY_1_AND_FORCE,
        "seed": 819552,
    })  # fmt: skip
    points = [fields for *_, fields in run(scene).marks_of("measure")]
    assert sum(fields["settled"] for fields in points) == 3


def test_force_cell_replaces_the_table_channel() -> None:
    test = {"kind": "continuation", "from": "50.4 Hz", "to": "50.3 Hz", "at": "body 2", "force": 1.0}
    scene = rig.load("fig9")
    channels = [channel for channel in scene.channels if channel.at != "table"]
    bench_run = run(scene.replace(test=test, channels=[*channels, {"name": "cell", "at": "shaker"}]))
    assert all(fields["settled"] for *_, fields in bench_run.marks_of("measure"))


def test_device_gives_equal_markers() -> None:
    scene = scene_with(force=0.9, **{"from": "50.6 Hz", "to": "50.2 Hz"})
    assert run_device(scene, 0) == run(scene).marks
    delayed = [fields for kind, *_, fields in run_device(scene, 128) if kind == "measure"]
    assert delayed[-1]["settled"] and delayed[-1]["frequency"] <= 50.2


def test_long_delay_leaves_zero_drive() -> None:
    played = list[Array]()
    with pytest.raises(RunError, match=r"at 50.* Hz requires a dead time below 0\.44 s; it is 0\.46 s"):
        run_device(scene_with(**FOLDED), 2048, played)
    # The zeros that fill the queue follow the ramp.
    ramp, zeros = played[-2:]
    assert ramp[0, 0] and not ramp[0, -1] and ramp.shape[1] <= 0.1 * 5120 and zeros.shape[1] == 2048


def test_limited_amplifier_gives_up() -> None:
    test = {"kind": "continuation", "from": "50.4 Hz", "to": "50 Hz", "at": "body 2", "force": 1.0}
    scene = rig.load("fig9")
    assert scene.shaker is not None
    limited = scene.replace(test=test, shaker=scene.shaker.replace(amplifier={"limit": 0.01}))
    bench_run = run(limited)
    assert "the amplifier is at its limit at 50.4 Hz" in bench_run.reason and not bench_run.drive[:, -1].any()


def test_unsettled_start_gives_up(tmp_path: Path) -> None:
    scene = scene_with(**FOLDED, settle={"longest": "0.2 s"})
    with pytest.raises(RunError, match=r"within 0\.2 s from 51 to 50\.\d+ Hz"):
        daq.record(scene, tmp_path / "curve.mcap")
    with daq.open(tmp_path / "curve.mcap") as rec:
        assert rec.markers[-1].kind == "abort"
        assert np.isfinite(rec.read("body1")).all()


def test_curve_begins_where_motion_repeats() -> None:
    # From 17.39 to 17.44 Hz, the exact orbits are unstable, and the motion does not repeat.
    scene = rig.load({
        "structure": {
            "masses": [0.52426, 1.1001], "springs": [22770.43, 47781.16], "damping": {"modal": 0.0047103}
        },
        "dampers": [{"body": 1, "mass_ratio": 0.069502, "clearance": 0.0147404}],
        "shaker": {"kind": "force", "body": 1},
        "test": {"kind": "continuation", "from": 17.43923, "to": 17.1, "at": "body 1", "force": 8.540843},
        **BODY_1_AND_FORCE,
        "seed": 436797,
    })  # fmt: skip
    bench_run = run(scene)
    settled = [fields["settled"] for *_, fields in bench_run.marks_of("measure")]
    assert not settled[0] and settled[-1]
    assert "no points from 17.439 to 17.3" in " ".join(bench_run.warnings)


def test_chaotic_motion_next_to_corner_is_omitted() -> None:
    # Below 39.42 Hz the envelope at the frequency is constant within 0.5 %, but the motion does not repeat: forces were
    # 1 to 2 % above those of the orbits.
    scene = rig.load({
        "structure": {
            "masses": [0.77192, 0.55862], "springs": [19902.9654, 14403.2990], "damping": {"modal": 0.002156}
        },
        "dampers": [{"body": 2, "mass_ratio": 0.056807, "clearance": 0.00429155}],
        "shaker": {"kind": "force", "body": 2},
        "test": {"kind": "continuation", "from": 39.6, "to": 39.3, "at": "body 2", "force": 2.296015},
        "channels": [
            {"name": "a2", "at": "body 2", "accelerometer": {"sensitivity": "10 mV/g", "noise": "20 ug/sqrt(Hz)"}},
            BODY_1_AND_FORCE["channels"][1],
        ],
        "converter": BODY_1_AND_FORCE["converter"],
        "seed": 953133,
    })  # fmt: skip
    bench_run = run(scene)
    settled = [fields["frequency"] for *_, fields in bench_run.marks_of("measure") if fields["settled"]]
    assert min(settled) > 39.415
    # Which points next to the corner at 39.43 Hz are irregular depends on the last bits.
    [warning] = [text for text in bench_run.warnings if "the motion is irregular at" in text]
    irregular = [float(text) for text in re.findall(r"39\.\d+", warning)]
    assert warning.startswith("level 2.29602 N: ") and min(irregular) < 39.38 and 39.41 < max(irregular) < 39.45


def test_irregular_motion_leaves_zero_drive() -> None:
    # Below 71.58 Hz the motion is chaotic: successive periods differ by 0.3 % and more.
    scene = rig.load({
        "structure": {
            "masses": [1.9774, 1.12], "springs": [180708.73316201, 102353.48495067], "damping": {"modal": 0.0027407}
        },
        "dampers": [{"body": 1, "mass_ratio": 0.04663, "clearance": 0.00036654548474}],
        "shaker": {"kind": "force", "body": 1},
        "test": {"kind": "continuation", "at": "body 1", "force": 5.3957514054}
        | {"from": 71.596828901735, "to": 65.34079530838, "settle": {"longest": 10.0}},
        **BODY_1_AND_FORCE,
        "seed": 469970,
    })  # fmt: skip
    bench_run = run(scene)
    settled = [fields["frequency"] for *_, fields in bench_run.marks_of("measure") if fields["settled"]]
    assert min(settled) > 71.58 and "was not reached" in bench_run.reason
    assert abs(bench_run.drive[0]).max() > 5.0 and not bench_run.drive[:, -1].any()


def run_past_doublings(first: float, last: float) -> BenchRun:
    """Run a test in a band in which motions repeat after several periods, or not at all."""
    return run(rig.load({
        "structure": {"masses": [0.89973], "springs": [85335.54219696348], "damping": {"modal": 0.0044327}},
        "dampers": [{"body": 1, "mass_ratio": 0.044105, "clearance": 0.0014164190450585282}],
        "shaker": {"kind": "force", "body": 1},
        "test": {"kind": "continuation", "at": "body 1", "force": 1.5500553489433753}
        | {"from": first, "to": last, "points": 3},
        **BODY_1_AND_FORCE,
        "seed": 316449,
    }))  # fmt: skip


def test_irregular_start_requires_another_level() -> None:
    reason = run_past_doublings(49.9, 49.75).reason
    assert "the motion is irregular from 49.9 to 49.87 Hz." in reason and "choose another level" in reason


def test_motion_with_several_periods_is_named() -> None:
    bench_run = run_past_doublings(49.82, 49.7)
    assert [fields["repetition"] for *_, fields in bench_run.marks_of("measure")] == [4, 4, 4]
    [warning] = [text for text in bench_run.warnings if "motions repeat" in text]
    assert warning.startswith("level 1.55006 N: motions repeat after 4 periods of the tone at 49.")
    assert " to 49.82 Hz." in warning


def test_noise_is_measured_with_settled_sensors() -> None:
    sensor = {"sensitivity": "100 mV/g", "noise": "20 ug/sqrt(Hz)", "bias": "2 V", "bias_settling": "0.2 s"}
    channels = [
        {"name": "a1", "at": "body 1", "accelerometer": {**sensor, "low_cutoff": "0.5 Hz"}},
        {"name": "force", "at": "shaker", "hammer": {"sensitivity": "100 mV/N"}},
    ]
    scene = scene_with(force=0.5, **{"from": "49 Hz", "to": "49.2 Hz"}).replace(dampers=[], channels=channels)
    kind, first, end, fields = run(scene).marks[0]
    assert (kind, first, fields) == ("settle", 0, {"settled": True}) and end > 5120 * 0.5


def test_noise_is_no_irregular_motion() -> None:
    # At 49 Hz, the noise of a window is 0.8 % of the motion.
    channels = [
        {"name": "a1", "at": "body 1", "accelerometer": {"sensitivity": "100 mV/g", "noise": "1 mg/sqrt(Hz)"}},
        {"name": "force", "at": "shaker", "hammer": {"sensitivity": "100 mV/N"}},
    ]
    scene = scene_with(force=0.5, **{"from": "49 Hz", "to": "51.5 Hz"}).replace(dampers=[], channels=channels)
    points = [fields for *_, fields in run(scene).marks_of("measure")]
    assert points[-1]["frequency"] > 51.4 and all(fields["settled"] for fields in points)


@pytest.mark.parametrize(
    ("change", "message"), [({"at": "body 7"}, "body 7 does not exist"), ({"to": "53 Hz"}, "the same as `from`")]
)
def test_mistake_is_named(change: dict[str, Any], message: str) -> None:
    with pytest.raises(SceneError, match=message):
        scene_with(**change)


def test_test_is_foreseen() -> None:
    assert "test.force" in str(daq.foresee(scene_with(force=0.9)))


def test_command_prints_folds(recording: Path, tmp_path: Path) -> None:
    assert f"next      analysis continuation {recording}" in str(daq.info(recording))
    result = CliRunner().invoke(app, ["continuation", str(recording), "--theory", "-o", str(tmp_path)])
    assert result.exit_code == 0 and "1 fold, body 1" in result.stdout and "50.525" in result.stdout
    assert len(list(tmp_path.iterdir())) == 3


def test_report_contains_the_curve(recording: Path, tmp_path: Path) -> None:
    analysis.report([recording], tmp_path / "report.html")
    assert "1.2 N, unstable" in (tmp_path / "report.html").read_text()


def test_other_test_has_no_curve(tmp_path: Path) -> None:
    scene = rig.load("continuation").replace(test={"kind": "sine", "frequency": 20.0, "force": 0.5, "duration": 1.0})
    with pytest.raises(RecordingError, match="no continuation test"):
        analysis.continuation(daq.record(scene, tmp_path / "sine.mcap"))
