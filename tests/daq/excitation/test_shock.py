"""Shock tests: pulses within their tolerance, messages of tests that abort, and a device with a queue."""

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
from analysis.core.signals.shock_spectrum import prescribed_spectrum
from daq.core.excitation.profiles.spectrum_shaping import lines_between
from daq.core.excitation.profiles.wave_replication import HalfSinePulse, Replication, SpectrumPulse
from rig.core.base.errors import RecordingError, SceneError
from rig.core.scene.excitation.shock import HalfSine, ShockProfile
from tests.daq.excitation.virtual_device import run_device
from tests.daq.measurement.bench_run import run

RATE = 2048.0
HALF_SINE = {"peak": "5 g", "width": "11 ms"}
LIMITED = {"kind": "base", "output": {"range": "10 mV"}}
SPECTRUM = {"frequencies": ["20 Hz", "200 Hz"], "acceleration": ["1 g", "5 g"]}


def scene(noise: str = "50 ug/sqrt(Hz)", shaker: Any = None, **test: Any) -> rig.Scene:
    """Return a rack on a shaker table with a noisy accelerometer at the table."""
    settings = {"kind": "shock", "control": "table", "repeats": 1, "interval": "2 s"} | test
    if "spectrum" not in settings:
        settings.setdefault("half_sine", HALF_SINE)
    sensor = {"sensitivity": "50 mV/g", "noise": noise}
    channels = [{"name": "table", "at": "table", "accelerometer": sensor}]
    channels.append({"name": "unit", "at": "body 2", "accelerometer": sensor})
    return rig.load({
        "structure": {"masses": [2.0, 1.0], "springs": [8e4, 2e4], "damping": {"modal": 0.02}},
        "shaker": shaker or {"kind": "base"},
        "channels": channels,
        "converter": {"rate": RATE, "bits": 24, "range": 5.0},
        "recording": {"display": False},
        "test": settings,
    })  # fmt: skip


@pytest.fixture(scope="module")
def shock(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return daq.record(scene(), tmp_path_factory.mktemp("shock") / "shock.mcap")


def test_compensated_pulse_ends_at_rest() -> None:
    rate = 1e5
    time = (np.arange(int(rate)) - 40000) / rate
    wave = HalfSine(peak="5 g", width="11 ms").wave(time)
    velocity = np.cumsum(wave) / rate
    displacement = np.cumsum(velocity) / rate
    assert abs(velocity[-1]) < 1e-4 * abs(velocity).max()
    assert abs(displacement[-1]) < 1e-3 * abs(displacement).max()


def test_wavelets_have_prescribed_spectrum() -> None:
    pulse = SpectrumPulse(ShockProfile(**SPECTRUM), 4096, RATE)
    assert pulse.deviation(pulse.target)[0] < 0.5


def test_replication_converges_with_wrong_gain() -> None:
    pulse = HalfSinePulse(HalfSine(**HALF_SINE), 4096, RATE)
    lines = lines_between(2.0, 800.0, 4096, RATE)
    true_gain = 1.0 / (1.0 + 2j * np.pi * lines * 0.5 * 1e-4)
    replication = Replication(pulse.target, lines, 1.4 * true_gain)
    deviations = []
    for level in (0.25, 0.5, 1.0, 1.0):
        response = np.fft.rfft(replication.drive(level))[lines] * (2.0 / 4096) * true_gain
        deviations.append(pulse.deviation(replication.to_wave(response) / level)[0])
        replication.correct(response, level)
    assert deviations[0] > 0.2 > 0.05 > deviations[-1]


@pytest.mark.parametrize("pulse", [{"half_sine": HALF_SINE}, {"spectrum": SPECTRUM}])
def test_shock_is_within_tolerance(pulse: dict[str, Any]) -> None:
    result = run(scene(**pulse))
    assert [fields["level"] for fields in result.fields_of("practice")] == [-12.0, -6.0]
    (fields,) = result.fields_of("shock")
    assert fields["deviation"] < 0.3 * fields["tolerance"]


def test_shock_is_replicated_at_body_of_coil_spring() -> None:
    shaker = {"kind": "table", "body": 1, "spring": "100 kN/m"}
    result = run(scene(shaker=shaker, half_sine={"peak": "2 g", "width": "20 ms"}, control="unit"))
    assert result.fields_of("shock")[0]["deviation"] < 0.2


def test_shock_is_replicated_despite_filter_delay() -> None:
    settings = scene()
    filtered = settings.replace(converter=settings.converter.replace(filter="delta_sigma", remove_delay=True))
    assert run(filtered).fields_of("shock")[0]["deviation"] < 0.2


@pytest.mark.parametrize("queued", [0, 100])
def test_device_with_queue_gives_same_markers(queued: int) -> None:
    settings = scene()
    expected = run(settings).marks
    markers = run_device(settings, queued)
    assert [kind for kind, *_ in markers] == [kind for kind, *_ in expected]
    for (_, _, _, fields), (_, _, _, others) in zip(markers, expected, strict=True):
        assert fields.get("peak", 0.0) == pytest.approx(others.get("peak", 0.0), rel=0.02)


def test_too_large_pulse_leaves_zero_drive(tmp_path: Path) -> None:
    small = {"kind": "base", "output": {"range": "2 V"}}
    with pytest.raises(rig.RunError, match=r"requires a drive of 48.9 m/s\^2; the output gives 20 m/s\^2. Shorten"):
        daq.record(scene(shaker=small), tmp_path / "shock.mcap")
    result = run(scene(shaker=small))
    assert result.reason and not result.drives[-1][:, -1].any()
    assert sum(drive.shape[1] for drive in result.drives[-1:]) < 0.1 * RATE


def test_noisy_sensor_is_named() -> None:
    assert (
        "table does not follow the drive"
        in run(scene(noise="2 mg/sqrt(Hz)", half_sine={"peak": "5 mg", "width": "11 ms"}, shaker=LIMITED)).reason
    )


def test_too_short_interval_is_named() -> None:
    # The drive of a body at its antiresonance lasts longer than the interval.
    test = {"kind": "shock", "half_sine": HALF_SINE, "control": "frame", "interval": "1 s"}
    settings = rig.load({
        "structure": {"masses": [1.0, 1.0], "springs": [3e4, 3e4], "damping": {"modal": 0.005}},
        "shaker": {"kind": "force", "body": 1},
        "channels": [{"name": "frame", "at": "body 1"}],
        "converter": {"rate": RATE, "bits": 24, "range": 200.0},
        "test": test,
    })  # fmt: skip
    result = run(settings)
    assert "Give a longer interval" in result.reason and not result.drives[-1][:, -1].any()


def test_practice_outside_tolerance_ends_test() -> None:
    result = run(scene(half_sine=HALF_SINE | {"tolerance": "0.01 %"}))
    assert "after 3 practice pulses the pulse deviates by" in result.reason and not result.fields_of("shock")


def test_incoherent_lines_of_pulse_are_named() -> None:
    # The springs isolate the unit from the upper lines, so practice does not reduce the deviation.
    result = run(scene(control="unit", half_sine=HALF_SINE | {"tolerance": "5 %"}))
    assert "Lines with a coherence below 0.9 are missing in the pulse." in result.reason


def test_lines_outside_band_are_not_incoherent() -> None:
    # The spectrum of a pulse of 3 ms exceeds the band of this sample rate: without it, 2.4 % of the peak is missing.
    result = run(scene(noise="1 ug/sqrt(Hz)", half_sine={"peak": "5 g", "width": "3 ms", "tolerance": "2 %"}))
    assert "the pulse deviates by" in result.reason and "coherence" not in result.reason


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"control": "tabel"}, "test.control: no motion channel 'tabel'. Did you mean 'table'"),
        ({"interval": "0.1 s"}, "test.interval: got 0.1 s, which is too short for the pulse. Give at least 0.22 s"),
        ({"spectrum": SPECTRUM, "half_sine": HALF_SINE}, "expected exactly one of half_sine or spectrum"),
        ({"spectrum": SPECTRUM | {"acceleration": ["1 g"]}}, "got 1 values; expected 2, one for each frequency"),
        ({"spectrum": SPECTRUM | {"frequencies": ["200 Hz", "20 Hz"]}}, "not ascending"),
    ],
)
def test_wrong_setting_is_named(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(SceneError) as error:
        scene(**changes)
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"half_sine": {"peak": "5 g", "width": "2 ms"}}, "test.half_sine.width: a pulse of 2 ms has fewer than 6"),
        (
            {"spectrum": {"frequencies": ["20 Hz", "80 Hz"], "acceleration": ["50 g", "1 g"]}},
            "test.spectrum: no sum of wavelets has this spectrum",
        ),
    ],
)
def test_impossible_pulse_is_named(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=message):
        daq.record(scene(**changes), tmp_path / "shock.mcap")
    assert not (tmp_path / "shock.mcap").exists()


def test_foresight_states_duration() -> None:
    foresight = daq.foresee(scene())
    assert foresight.seconds == pytest.approx(run(scene()).station.now / RATE, rel=0.25)


def test_shock_is_offered_on_page() -> None:
    from daq.extras.bench_page.live_bench import offered_forms

    assert [*offered_forms(scene())] == ["shock of the scene"]


def test_shock_figure_names_differences_last(tmp_path: Path) -> None:
    path = daq.record(scene(repeats=2), tmp_path / "shock.mcap")
    CliRunner().invoke(app, ["srs", str(path), "--channel", "table", "-o", str(tmp_path)])
    caption = " ".join(re.sub("<[^>]*>", " ", (tmp_path / "shock-srs.svg").read_text(encoding="utf-8")).split())
    assert re.search(r"natural frequencies per octave; the \d+ shocks differ by at most [\d.]+ %\.", caption)


def test_recorded_shock_is_evaluated(shock: Path, tmp_path: Path) -> None:
    assert f"analysis srs {shock}" in str(daq.info(shock))
    result = CliRunner().invoke(app, ["srs", str(shock), "--channel", "table", "-o", str(tmp_path)])
    assert "shock 1" in result.output and "within" in result.output
    spectrum = analysis.srs(shock, "table", highest=300.0)
    assert spectrum.maximax.max() == pytest.approx(1.65 * 49.0, rel=0.1)
    with pytest.raises(RecordingError, match=r"a shock has no frequency responses\. Use `analysis srs"):
        analysis.frfs(shock)


def test_spectrum_follows_prescribed_pulse(shock: Path) -> None:
    with daq.open(shock) as rec:
        # Near 300 Hz, the replicated pulse itself deviates by 5 %.
        spectrum = analysis.srs(rec, "table", highest=250.0)
        prescribed = prescribed_spectrum(rec, 10.0, spectrum.frequency)
    assert prescribed is not None
    assert spectrum.maximax == pytest.approx(prescribed[1], rel=0.05)


def test_report_shows_shock(shock: Path, tmp_path: Path) -> None:
    page = analysis.report(shock, tmp_path / "report.html").read_text(encoding="utf-8")
    assert "First shock at the control channel" in page and "Shock response spectra" in page
