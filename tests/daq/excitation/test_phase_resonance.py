"""Phase resonance: the law of its loop, runs on the bench, and backbones compared with exact orbits."""

import math
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
from analysis.commands.report_page.report import write_report
from daq.core.excitation.tones.phase_loop import LoopSettings, PhaseLoop, loop_settings
from rig.core.base.errors import RecordingError, RunError, SceneError
from rig.core.system.structural_model import structural_model
from tests.daq.excitation.virtual_device import run_device
from tests.daq.measurement.bench_run import run

TEST = {
    "kind": "phase_resonance", "frequency": "49 Hz", "from": "46 Hz", "to": "53 Hz", "at": "body 1", "force": [0.5, 2.0]
}  # fmt: skip


@pytest.mark.parametrize("damping", [0.001, 0.005, 0.02])
@pytest.mark.parametrize("expected", [0.0, 1.0])  # decay rate, relative to the exact one
@pytest.mark.parametrize("latency", [0.0, 0.2])
def test_law_locks_shifted_resonance(damping: float, latency: float, expected: float) -> None:
    omega0, window = 2.0 * math.pi * 13.0, 0.15
    decay, late = damping * omega0, round(latency / window)
    loop, frequency, error = (
        PhaseLoop(13.0, 10.0, 16.0, -math.pi / 2, 0.02, LoopSettings(expected * decay, 1.0, 1.0)),
        13.0,
        0.0,
    )
    omega0 += 3.0 * decay  # the level has changed
    errors = [0.0] * (late + 1)
    for _ in range(600):
        total = 0.0
        for _ in range(50):
            error += window / 50 * (-decay * math.sin(error) - (2.0 * math.pi * frequency - omega0))
            total += error / 50
        errors.append(total)
        frequency = loop.next_frequency(errors[-1 - late] - math.pi / 2, window, 1.5 * window + latency)
    assert frequency == pytest.approx(omega0 / (2.0 * math.pi), abs=1e-4)
    assert abs(error) < 1e-3


def test_damped_resonance_is_locked_quickly() -> None:
    omega0, decay, window = 2.0 * math.pi * 79.0, 10.0, 0.1
    loop, frequency, error = PhaseLoop(78.0, 70.0, 90.0, -math.pi / 2, 0.02, LoopSettings(decay, 1.0, 1.0)), 78.0, 0.0
    for _ in range(40):
        for _ in range(50):
            error += window / 50 * (-decay * math.sin(error) - (2.0 * math.pi * frequency - omega0))
        frequency = loop.next_frequency(error - math.pi / 2, window, 1.5 * window)
    assert abs(error) < 0.005


def test_law_stays_within_limits() -> None:
    loop = PhaseLoop(13.0, 12.0, 14.0, -math.pi / 2, 0.02, LoopSettings(0.4, 1.0, 1.0))
    assert max(loop.next_frequency(0.0, 0.1, 0.15) for _ in range(90)) == 14.0


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    scene = rig.load("held-response").replace(test=TEST)
    return daq.record(scene, tmp_path_factory.mktemp("phase") / "phase.mcap")


def test_points_are_exact_orbits(recording: Path) -> None:
    measured = analysis.backbone(recording)
    assert measured.settled.all()
    for level, frequency, bound, amplitude, amplitude_expanded in zip(
        *(measured.level, measured.frequency, measured.frequency_expanded),
        *(measured.amplitude, measured.amplitude_expanded),
        strict=True,
    ):
        test = {"kind": "sine", "frequency": frequency, "force": level}
        theory = rig.load("held-response").replace(test=test, channels=None)
        [(exact, exact_amplitude)] = resonances(theory, frequency, 0)
        assert abs(frequency - exact) < bound < 0.02
        assert frequency == pytest.approx(exact, rel=2e-4)
        assert abs(amplitude - exact_amplitude) < amplitude_expanded


def resonances(theory: rig.Scene, frequency: float, body: int) -> list[tuple[float, float]]:
    """Return frequency (Hz) and amplitude (m) of the stable orbits at which a body lags the force by 90 degrees."""
    found = []
    for branch in rig.follow_orbits(theory, "frequency", (0.98 * frequency, 1.02 * frequency)).branches:
        phase = np.angle(1j * branch.frf[body])
        amplitude = abs(branch.frf[body] * [orbit.reference_amplitude for orbit in branch.orbits])
        for k in np.flatnonzero((phase[1:] * phase[:-1] <= 0.0) & (abs(np.diff(phase)) < 1.0) & branch.stable[1:]):
            share = phase[k] / (phase[k] - phase[k + 1])
            found.append(tuple(values[k] + share * (values[k + 1] - values[k]) for values in (branch.value, amplitude)))
    return found


def test_linear_backbone_is_the_mode(tmp_path: Path) -> None:
    scene = rig.load("held-response").replace(test={**TEST, "at": "body 1", "force": 0.5}, dampers=[])
    measured = analysis.backbone(daq.record(scene, tmp_path / "linear.mcap"))
    assert measured.frequency[0] == pytest.approx(49.663, abs=0.03)
    assert measured.damping[0] == pytest.approx(0.005, abs=float(measured.damping_expanded[0]))
    # The other modes shift the phase of body 1 by 4 degrees.
    exact = structural_model(scene.replace(dampers=[])).modes.frequency[2]
    assert abs(measured.natural_frequency[0] - exact) < measured.natural_frequency_expanded[0] < 5e-3


def test_damping_by_other_modes_is_in_its_interval(tmp_path: Path) -> None:
    # Near a node of its mode, body 2 moves by other modes, which dissipate 4.6 % of the power.
    structure = {"masses": [0.971, 0.545, 0.362], "springs": [18792.0, 69405.0, 42144.0]}
    structure["damping"] = {"rayleigh": {"alpha": 2.105, "beta": 6.07e-5}}
    scene = rig.load("held-response").replace(structure=structure, dampers=[], shaker={"kind": "force", "body": 2})
    sensor = {"sensitivity": "100 mV/g"}
    channels = [{"name": f"a{body}", "at": f"body {body}", "accelerometer": sensor} for body in (1, 2, 3)]
    test = {"kind": "phase_resonance", "at": "body 2", "frequency": 51.5, "from": 49.0, "to": 54.0, "force": 1.0}
    force = {"name": "force", "at": "shaker", "hammer": {"sensitivity": "100 mV/N"}}
    scene = scene.replace(channels=[*channels, force], test=test)
    measured = analysis.backbone(daq.record(scene, tmp_path / "node.mcap"))
    modes = structural_model(scene).modes
    exact = modes.decay_rate[1] / modes.omega[1]
    assert 0.04 < measured.damping[0] / exact - 1.0 < measured.damping_expanded[0] / exact < 0.15


def test_coil_shaker_is_locked() -> None:
    bench_run = run(rig.load("fig9").replace(test={**TEST, "force": [1.5]}))
    [(*_, fields)] = bench_run.marks_of("measure")
    assert fields["settled"] and math.degrees(fields["phase"]) == pytest.approx(-90.0, abs=1.0)
    assert fields["force"] == pytest.approx(1.5, rel=0.006)


def test_law_knows_the_decay_rate_of_a_mode() -> None:
    scene = rig.load("held-response").replace(test=TEST, dampers=[])
    settings = loop_settings(scene, 0.0)
    assert settings.slope_rate == pytest.approx(structural_model(scene).modes.decay_rate[2], rel=0.01)
    assert settings[1:] == (1.0, 1.0)


def test_first_mode_is_locked_through_a_coil() -> None:
    # The structure resonates on the spring 1 Hz above the mode, with a decay of seconds.
    scene = rig.load("held-response").replace(
        shaker={"kind": "electrodynamic", "body": 1, "spring": "5 kN/m"},
        test={**TEST, "frequency": "13.2 Hz", "from": "12.4 Hz", "to": "13.7 Hz", "force": [0.2]},
        dampers=[],
    )
    assert loop_settings(scene, 0.0).proportional == 0.0
    [(*_, fields)] = run(scene).marks_of("measure")
    assert fields["settled"] and math.degrees(fields["phase"]) == pytest.approx(-90.0, abs=1.0)


NATURAL_FREQUENCY = math.sqrt(26778.0 / 1.4278) / (2.0 * math.pi)


def coil_scene(tolerance: float, *channels: dict[str, Any]) -> rig.Scene:
    """Return a body with the natural frequency `NATURAL_FREQUENCY`, driven through a coil spring."""
    sensor = {"sensitivity": "100 mV/g", "sensitivity_tolerance": tolerance}
    test = {"frequency": "21.8 Hz", "from": "20.7 Hz", "to": "22.9 Hz", "at": "body 1", "force": 0.2}
    return rig.load({
        "structure": {"masses": [1.4278], "springs": [26778.0], "damping": {"modal": 0.006}},
        "shaker": {"kind": "electrodynamic", "body": 1, "spring": "5.4 kN/m"},
        "test": {"kind": "phase_resonance", **test},
        "channels": [
            {"name": "a1", "at": "body 1", "accelerometer": sensor},
            *({"accelerometer": sensor, **channel} if channel["at"] == "table" else channel for channel in channels),
        ],
        "converter": {"rate": 5120, "bits": 24, "range": 10.0},
        "recording": {"display": False},
        "seed": 5,
    })  # fmt: skip


def test_mode_is_locked_by_force_cell(tmp_path: Path) -> None:
    # Near the mode the coil's force nearly vanishes, so that transients dominate its phase.
    cell = {"name": "force", "at": "shaker", "hammer": {"sensitivity": "100 mV/N"}}
    measured = analysis.backbone(daq.record(coil_scene(0.01, cell), tmp_path / "cell.mcap"))
    assert measured.settled[0]
    assert measured.frequency[0] == pytest.approx(NATURAL_FREQUENCY, abs=float(measured.frequency_expanded[0]))
    assert measured.damping[0] == pytest.approx(0.006, abs=float(measured.damping_expanded[0]))


def test_sensitivities_rotate_the_spring_force(tmp_path: Path) -> None:
    path = daq.record(coil_scene(0.01, {"name": "table", "at": "table"}), tmp_path / "spring.mcap")
    measured = analysis.backbone(path)
    assert abs(measured.frequency[0] - NATURAL_FREQUENCY) < measured.frequency_expanded[0]


def test_undetermined_spring_force_is_named(tmp_path: Path) -> None:
    path = daq.record(coil_scene(0.2, {"name": "table", "at": "table"}), tmp_path / "spring.mcap")
    result = CliRunner().invoke(app, ["backbone", str(path), "-o", str(tmp_path)])
    [row] = [line for line in result.stdout.splitlines() if line.lstrip().startswith("0.2 N")]
    assert row.count("not determined") == 5


def test_device_gives_equal_markers() -> None:
    scene = rig.load("held-response").replace(test={**TEST, "force": 0.5})
    assert run_device(scene, 0) == run(scene).marks
    delayed = [fields for kind, *_, fields in run_device(scene, 256) if kind == "measure"]
    assert delayed[0]["settled"] and delayed[0]["frequency"] == pytest.approx(48.91, abs=0.01)


def test_unsteady_resonance_is_distinguished(tmp_path: Path) -> None:
    test = {**TEST, "force": 0.5, "settle": {"longest": "5 s", "tolerance": 1e-12}}
    scene = rig.load("held-response").replace(test=test)
    with pytest.raises(RunError, match=r"the phase is -90° at 48\.9. Hz; phase, motion or force is not steady"):
        daq.record(scene, tmp_path / "unsteady.mcap")


def test_missing_resonance_gives_up(tmp_path: Path) -> None:
    changes = {"frequency": "20 Hz", "from": "18 Hz", "to": "22 Hz", "force": 0.5, "settle": {"longest": "5 s"}}
    scene = rig.load("held-response").replace(test={**TEST, **changes})
    with pytest.raises(RunError, match=r"no lock within 5 s.*No resonance lies between 18 and 22 Hz"):
        daq.record(scene, tmp_path / "phase.mcap")
    with daq.open(tmp_path / "phase.mcap") as rec:
        assert rec.markers[-1].kind == "abort"


@pytest.mark.parametrize(
    ("change", "message"),
    [({"at": "body 7"}, "body 7 does not exist"), ({"frequency": "60 Hz"}, "expected a frequency from 46 to 53 Hz")],
)
def test_mistake_is_named(change: dict[str, Any], message: str) -> None:
    with pytest.raises(SceneError, match=message):
        rig.load("held-response").replace(test={**TEST, **change})


def test_test_is_foreseen() -> None:
    assert "test.force" in str(daq.foresee(rig.load("held-response").replace(test={**TEST, "force": 0.5})))


def test_command_prints_the_backbone(recording: Path, tmp_path: Path) -> None:
    assert f"next      analysis backbone {recording}" in str(daq.info(recording))
    result = CliRunner().invoke(app, ["backbone", str(recording), "-o", str(tmp_path)])
    assert result.exit_code == 0 and "2 levels, natural frequency (48.9" in result.stdout
    assert " Hz at 0.5 N → (49.6" in result.stdout and " Hz at 2 N" in result.stdout
    assert len(list(tmp_path.iterdir())) == 3


def test_report_states_every_level(recording: Path, tmp_path: Path) -> None:
    measured = analysis.backbone(recording)
    headline = "\n".join(write_report([recording], tmp_path / "page.html").lines)
    for k, level in enumerate(("0.5 N", "2 N")):
        assert re.search(rf"\({measured.natural_frequency[k]:.3f}\S* ± \S+\) Hz at {level}", headline)
    page = (tmp_path / "page.html").read_text("utf-8")
    # All levels share the charts, and no response consists of one point.
    assert "Frequency responses" not in page and "not available" not in page


def test_other_test_has_no_backbone(tmp_path: Path) -> None:
    scene = rig.load("held-response").replace(test={"kind": "sine", "frequency": 20.0, "force": 0.5, "duration": 1.0})
    with pytest.raises(RecordingError, match="no phase-resonance test"):
        analysis.backbone(daq.record(scene, tmp_path / "sine.mcap"))
