"""Random tests with profile control: control law, profile and limits on the bench, and messages."""

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
from daq.core.excitation.profiles.spectrum_control import AveragedSpectra, NoiseSource, updated
from daq.core.excitation.profiles.spectrum_shaping import lines_between
from daq.core.excitation.random_control import PROCEDURE
from daq.core.virtual_bench.bench import Bench
from rig.core.base.arrays import Array
from rig.core.base.errors import RecordingError, SceneError
from tests.daq.excitation.virtual_device import run_device
from tests.daq.measurement.bench_run import run

PROFILE = {"frequencies": ["5 Hz", "60 Hz"], "density": ["0.002 g^2/Hz", "0.002 g^2/Hz"]}
LIMIT = {"channel": "unit", "frequencies": ["8 Hz", "30 Hz"], "density": ["0.01 g^2/Hz", "0.01 g^2/Hz"]}

# The unit requires a wide range of drives, which is not reached because clipping spreads the largest over all lines.
WIDE: dict[str, Any] = {
    "shaker": {"kind": "base"},
    "profile": {"frequencies": ["5 Hz", "220 Hz"], "density": ["0.002 g^2/Hz", "0.002 g^2/Hz"]},
    "control": {"channels": ["unit"]},
    "clip": 1.01,
    "speed": 0.01,
}


def scene(shaker: Any = None, dampers: Any = (), noise: str = "50 ug/sqrt(Hz)", **test: Any) -> rig.Scene:
    """Return a rack on a shaker table with modes at 13 and 39 Hz."""
    settings = {"kind": "random_control", "profile": PROFILE, "control": {"channels": ["table"]}, "lines": 110}
    sensor = {"sensitivity": "50 mV/g", "noise": noise}
    places = {"table": "table", "frame": "body 1", "unit": "body 2"}
    return rig.load({
        "structure": {"masses": [2.0, 1.0], "springs": [8e4, 8e3], "damping": {"modal": 0.03}},
        "shaker": shaker or {"kind": "base", "output": {"range": "10 V", "bits": 16}},
        "dampers": dampers,
        "channels": [{"name": name, "at": at, "accelerometer": sensor} for name, at in places.items()],
        "converter": {"rate": 512, "bits": 24, "range": 5.0},
        "recording": {"display": False},
        "test": settings | {"ramp": [-6.0], "hold": "4 s", "duration": "40 s"} | test,
    })  # fmt: skip


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return daq.record(scene(limits=[LIMIT], lines=140), tmp_path_factory.mktemp("random") / "random.mcap")


def test_noise_has_requested_density_and_is_gaussian() -> None:
    lines, rate, period = lines_between(10.0, 100.0, 512, 512.0), 512.0, 512
    density = np.geomspace(1.0, 1e3, lines.size)
    source = NoiseSource(np.random.default_rng(1), lines, period, rate)
    spectra = AveragedSpectra(np.ones((1, lines.size)), lines, period, rate)
    waves = [source.next_half(density) for _ in range(2000)]
    for wave in waves:
        spectra.add(wave[None])
    assert 10 * np.log10(spectra.density[0] / density)[2:-2] == pytest.approx(0.0, abs=0.6)
    samples = np.concatenate(waves)
    assert np.mean(samples**4) / np.mean(samples**2) ** 2 == pytest.approx(3.0, abs=0.05)


@pytest.mark.parametrize("slope", [0.3, 1.0, 3.0])
def test_update_converges_on_nonlinear_plant(slope: float) -> None:
    drive: Array = np.array([1e-3, 1.0, 50.0])
    for _ in range(60):
        drive = updated(drive, 2.0 / (5.0 * drive**slope), speed=0.5)
    assert 5.0 * drive**slope == pytest.approx(2.0, rel=1e-3)


def test_deviation_within_noise_is_corrected_less() -> None:
    small, large = updated(np.ones(2), np.array([1.05, 4.0]), speed=0.5, averages=20)
    assert small < 1.01 and large == pytest.approx(2.0**0.93, rel=0.1)


def test_table_follows_profile_and_unit_its_limit(recording: Path) -> None:
    check = analysis.profile(recording)
    assert check.within > 0.98
    (unit,) = check.limited
    assert np.nanmax(10 * np.log10(unit.values / unit.limit)) < 1.5
    ((name, low, high), *_) = check.notches()
    assert name == "unit" and low < 13.0 < high
    assert check.channels[0].kurtosis == pytest.approx(3.0, abs=0.3)


def test_body_is_held_through_anti_resonance() -> None:
    result = run(scene(control={"channels": ["frame"]}, duration="60 s"))
    assert not result.reason and result.fields_of("tolerance")[-1]["outside"] == 0


@pytest.mark.parametrize("combine", ["average", "maximum", "minimum"])
def test_several_channels_are_combined(combine: str) -> None:
    result = run(scene(control={"channels": ["table", "frame"], "combine": combine}, duration="20 s"))
    assert not result.reason and result.fields_of("measure")


def test_profile_is_held_with_dampers_in_flight(tmp_path: Path) -> None:
    dampers = [{"body": 2, "mass_ratio": 0.06, "clearance": "1 mm", "contact": {"duration": "4 ms"}}]
    settings = scene(dampers=dampers, control={"channels": ["frame"]}, duration="60 s")
    # The lines do not resolve the antiresonance of the frame.
    with pytest.warns(daq.RunWarning, match="from line to line"):
        recording = daq.record(settings, tmp_path / "random.mcap")
    assert analysis.profile(recording).within > 0.9


def test_random_runs_with_electrodynamic_shaker() -> None:
    shaker = {"kind": "electrodynamic", "body": 1, "spring": "6.6 kN/m"}
    result = run(scene(shaker=shaker, control={"channels": ["frame"]}, duration="20 s"))
    assert not result.reason and result.fields_of("tolerance")[-1]["outside"] < 5


@pytest.mark.parametrize("queued", [0, 64])
def test_device_gives_same_markers(queued: int) -> None:
    expected, markers = run(scene()).marks, run_device(scene(), queued)
    assert [(kind, first, stop) for kind, first, stop, _ in markers] == [marker[:3] for marker in expected]


def test_short_test_without_ramp_is_measured() -> None:
    # Its spectra are too few for an update of the drive.
    result = run(scene(ramp=[], duration="2 s"))
    assert not result.reason and result.fields_of("measure") and not result.fields_of("tolerance")


def test_check_without_ramp_names_no_levels() -> None:
    short = scene(ramp=[], duration="2 s")
    assert [*PROCEDURE.check(short.test, short, Bench(short).channels)][-1] == (
        "2 s at full level, after the identification"
    )


def test_too_high_profile_leaves_zero_drive() -> None:
    result = run(scene(shaker={"kind": "base", "output": {"range": "0.5 V"}}))
    assert "% of the drive samples are clipped by the output. Lower the profile" in result.reason
    assert not result.drives[-1][:, -1].any() and result.drives[-1].shape[1] < 51


def test_excess_aborts_with_zero_drive() -> None:
    # Most of the drive is above the resonance; clipping spreads it over all lines.
    result = run(scene(**WIDE))
    assert "of the lines exceed the profile by more than 6 dB plus twice the scatter" in result.reason
    assert not result.drives[-1][:, -1].any() and result.drives[-1].shape[1] < 51


def test_notched_lines_are_not_outside() -> None:
    # With 20 averages the limited channel scatters by more than the tolerance about its limit.
    result = run(scene(limits=[LIMIT], averages=20, tolerance="1.5 dB"))
    assert [fields["outside"] for kind, _, _, fields in result.marks if kind == "tolerance"] == [0, 0]


def test_ramp_without_progress_ends_test() -> None:
    assert "of the lines are within 3 dB after 12 updates" in run(scene(abort_lines=0.99, **WIDE)).reason


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"control": {"channels": ["tabel"]}}, "test.control.channels[1]: no motion channel 'tabel'"),
        ({"limits": [LIMIT | {"channel": "rack"}]}, "test.limits[1].channel: no motion channel 'rack'"),
        ({"abort": "2 dB"}, "test.abort: got 2 dB, which is not above the tolerance, 3 dB"),
        ({"profile": {"frequencies": ["5 Hz", "60 Hz"], "density": ["1 g", "1 g"]}}, "an acceleration density such as"),
        ({"profile": {"frequencies": ["5 Hz", "600 Hz"], "density": [1.0, 1.0]}}, "expected less than half the rate"),
        ({"ramp": [3.0]}, "test.ramp[1]"),
    ],
)
def test_wrong_setting_is_named(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(SceneError) as error:
        scene(**changes)
    assert message in str(error.value)


@pytest.mark.parametrize("count", [11, 55])
def test_coarse_lines_and_early_limit_are_named(count: int) -> None:
    # The half-power width of the mode at 13.44 Hz is 0.8 Hz, the distance of the lines 5 or 1 Hz.
    coarse = scene(lines=count, limits=[LIMIT | {"frequencies": ["8 Hz", "14 Hz"]}])
    channels = Bench(coarse).channels
    lines, limit, duration = PROCEDURE.check(coarse.test, coarse, channels)
    assert "from line to line" in lines and "the limit of unit ends at 14 Hz" in limit
    assert "40 s at full level" in duration
    required = int(re.search(r"lines of (\d+)", lines)[1])
    fine = scene(lines=required, limits=[LIMIT])
    assert len([*PROCEDURE.check(fine.test, fine, channels)]) == 1


BIAS: dict[str, Any] = {"bias": "2 V", "bias_settling": "1 s"}


@pytest.mark.parametrize("sensor", [BIAS, {"noise": "5 mg/sqrt(Hz)"}])
def test_identification_stays_below_full_level(sensor: dict[str, Any]) -> None:
    table = {"name": "table", "at": "table", "accelerometer": {"sensitivity": "50 mV/g", **sensor}}
    bench_run = run(scene().replace(shaker={"kind": "base"}, channels=[table]))
    first, last, _ = bench_run.marks_of("identification")[0]
    start, stop, _ = bench_run.marks_of("measure")[0]
    assert abs(bench_run.drive[0, first:last]).max() < abs(bench_run.drive[0, start:stop]).max()


def test_failed_control_channel_ends_weak_identification() -> None:
    table = {"name": "table", "at": "table", "accelerometer": {"sensitivity": "50 mV/g", "bias": "9 V"}}
    bench_run = run(scene().replace(shaker={"kind": "base"}, channels=[table]))
    assert "readings of table are constant" in bench_run.reason
    # The profile has an rms of 3.25 m/s^2; its peak is at most five times as high.
    assert abs(bench_run.drive[0]).max() < 5.0 * 3.25


def test_foresight_states_duration() -> None:
    assert daq.foresee(scene()).seconds == pytest.approx(run(scene()).station.now / 512.0, rel=0.2)


def test_profile_and_responses_are_evaluated(recording: Path, tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["profile", str(recording), "-o", str(tmp_path)])
    assert "unit limits the drive from" in result.output and (tmp_path / "random-profile.csv").exists()
    assert str(daq.info(recording)).count("analysis profile") == 1
    peak = np.max(abs(analysis.frfs(recording)["unit"].value))
    assert peak == pytest.approx(1.0 / (2 * 0.03), rel=0.25)
    page = analysis.report(recording, tmp_path / "report.html").read_text(encoding="utf-8")
    assert "Control channel with profile and tolerance of" in page


def test_recording_without_profile_is_rejected() -> None:
    with pytest.raises(RecordingError, match="has no profile"):
        analysis.profile(Path(__file__).parents[3] / "recordings" / "demo-impulse-no-damper.mcap")
