"""Sine tests with profile control: control law, profile and limits on the bench, and messages."""

import re
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import analysis
import daq
import rig
from analysis.commands.cli import app
from daq.core.excitation.profiles.profile_checks import loop_gain
from daq.core.excitation.sine_control import Caution, Observation, check_control, limited_error
from daq.core.excitation.station import AbortedTest
from rig.core.base.errors import SceneError
from tests.daq.excitation.virtual_device import run_device
from tests.daq.measurement.bench_run import run

PROFILE = {"frequencies": ["5 Hz", "30 Hz"], "acceleration": ["0.1 g", "0.2 g"]}
LIMIT = {"channel": "unit", "frequencies": ["5 Hz", "30 Hz"], "acceleration": ["1 g", "1 g"]}


def scene(shaker: Any = None, dampers: Any = (), **test: Any) -> rig.Scene:
    """Return a rack on a shaker table with modes at 13 and 39 Hz."""
    settings = {"kind": "sine_control", "from": "5 Hz", "to": "30 Hz", "control": {"channels": ["table"]}}
    sensor = {"sensitivity": "50 mV/g", "noise": "50 ug/sqrt(Hz)"}
    places = {"table": "table", "frame": "body 1", "unit": "body 2"}
    return rig.load({
        "structure": {"masses": [2.0, 1.0], "springs": [8e4, 8e3], "damping": {"modal": 0.03}},
        "shaker": shaker or {"kind": "base", "output": {"range": "10 V", "bits": 16}},
        "dampers": dampers,
        "channels": [{"name": name, "at": at, "accelerometer": sensor} for name, at in places.items()],
        "converter": {"rate": 512, "bits": 24, "range": 5.0},
        "recording": {"display": False},
        "test": {"profile": PROFILE, **settings, "duration": "60 s"} | test,
    })  # fmt: skip


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return daq.record(scene(limits=[LIMIT], duration="240 s"), tmp_path_factory.mktemp("sine") / "sine.mcap")


@pytest.mark.parametrize("delay", [1, 2, 3, 5])
@pytest.mark.parametrize(("speed", "is_stable"), [(0.3, True), (0.95, True), (1.1, False)])
def test_loop_is_stable_below_its_limit(delay: int, speed: float, is_stable: bool) -> None:
    drives = [1.0] * (delay + 1)
    for _ in range(600):
        drives.append(drives[-1] * np.exp(loop_gain(speed, delay) * limited_error(1.01 / drives[-1 - delay])))
    errors = abs(np.log(np.array(drives) / 1.01))
    assert (errors[-20:].max() < errors[:20].max()) == is_stable


def test_gain_recovers_after_one_overshoot() -> None:
    caution = Caution()
    caution.factor(0.7)
    assert [caution.factor(-0.06) for _ in range(30)][-1] > 0.9


def test_oscillation_reduces_the_gain() -> None:
    caution = Caution()
    assert [caution.factor(0.1 * (-1) ** k) for k in range(12)][-1] < 0.05


def test_steps_down_are_larger_than_steps_up() -> None:
    assert np.exp([limited_error(100.0), limited_error(0.01)]) == pytest.approx([1.5, 0.25])


def test_table_follows_profile_and_unit_its_limit(recording: Path) -> None:
    check = analysis.profile(recording)
    (unit,) = check.limited
    assert check.within == 1.0
    assert np.max(20 * np.log10(unit.values / unit.limit)) < 1.0
    ((name, low, high), *_) = check.notches()
    assert name == "unit" and low < 13.0 < high
    with daq.open(recording) as rec:
        notches = [mark.fields for mark in rec.markers if mark.kind == "notch"]
    assert notches and notches[0]["channel"] == "unit"


@pytest.mark.parametrize("quantity", ["velocity", "displacement"])
def test_profile_of_other_motion_is_held(quantity: str) -> None:
    value = {"velocity": "20 mm/s", "displacement": "0.5 mm"}[quantity]
    profile = {"frequencies": ["5 Hz", "30 Hz"], quantity: [value, value]}
    result = run(scene(profile=profile, shaker={"kind": "base"}))
    assert not result.reason and result.fields_of("measure")[0]["outside"] == 0.0


@pytest.mark.parametrize(("first", "last"), [("5 Hz", "30 Hz"), ("30 Hz", "5 Hz")])
def test_body_is_held_through_resonance(first: str, last: str) -> None:
    settings = scene(control={"channels": ["unit"]}, duration="240 s", **{"from": first, "to": last})
    result = run(settings)
    assert not result.reason and not result.fields_of("tolerance")


def test_drive_falls_as_tone() -> None:
    # A falling constant would push the table out of its travel: 0.2 g for 0.25 s move it by 10 mm.
    result = run(scene())
    ((_, stop, _),) = result.marks_of("measure")
    fall = result.drive[0, stop:]
    assert abs(fall.mean()) < 0.05 * abs(fall).max()


def test_dampers_in_flight_are_controlled() -> None:
    dampers = [{"body": 2, "mass_ratio": 0.06, "clearance": "1 mm", "contact": {"duration": "4 ms"}}]
    profile = {"frequencies": ["5 Hz", "30 Hz"], "acceleration": ["0.2 g", "0.2 g"]}
    result = run(scene(dampers=dampers, profile=profile, limits=[LIMIT | {"acceleration": ["1.3 g", "1.3 g"]}]))
    assert not result.reason and result.fields_of("notch")


def test_electrodynamic_shaker_is_controlled() -> None:
    shaker = {"kind": "electrodynamic", "body": 1, "spring": "6.6 kN/m"}
    result = run(scene(shaker=shaker, control={"channels": ["table"]}, duration="120 s", abort="20 dB"))
    assert not result.reason and result.fields_of("measure")


def test_loop_is_stable_at_antiresonance() -> None:
    # The structure amplifies the sidebands of a changing drive up to 60 times more than the tone.
    shaker = {"kind": "electrodynamic", "body": 1, "spring": "6.6 kN/m"}
    band = {"from": "13.3 Hz", "to": "14.6 Hz", "duration": "100 s"}
    settings = scene(shaker=shaker, control={"channels": ["frame"]}, abort="20 dB", **band)
    structure = settings.structure.replace(damping=settings.structure.damping.replace(modal=0.006))
    result = run(settings.replace(structure=structure))
    assert not result.reason and len(result.fields_of("tolerance")) <= 3


@pytest.mark.parametrize(("spring", "first", "last"), [(10e3, 13.7, 14.5), (30e3, 14.1, 15.0)], ids=["above", "below"])
def test_loop_is_stable_beside_resonance_outside_band(spring: float, first: float, last: float) -> None:
    # The antiresonance is at 14.2 Hz; the resonance lies outside the band, 4 % above or 2 % below it.
    settings = scene(control={"channels": ["frame"]}, abort="20 dB", duration="100 s", **{"from": first, "to": last})
    structure = settings.structure.replace(masses=[2.0, 0.1], springs=[spring, 800.0], damping={"modal": 0.006})
    result = run(settings.replace(structure=structure))
    assert not result.reason and len(result.fields_of("tolerance")) <= 3


@pytest.mark.parametrize("queued", [0, 20])
def test_device_gives_same_markers(queued: int) -> None:
    expected, markers = run(scene()).marks, run_device(scene(), queued)
    assert [kind for kind, *_ in markers] == [marker[0] for marker in expected]
    assert markers[-1][3] == pytest.approx(expected[-1][3])


def test_fast_sweep_is_named_before_the_test() -> None:
    result = run(scene(control={"channels": ["unit"]}, duration="20 s", abort="30 dB"))
    warning = result.warnings[0]
    assert "(damping 2.8 %)" in warning and "the sweep exceeds the tolerance of 3 dB above" in warning
    assert not any("oct/min" in text for text in run(scene()).warnings)


def test_explain_states_deviation_and_limited_band() -> None:
    text = str(daq.foresee(scene(limits=[LIMIT], duration="240 s")))
    low, high = map(float, re.search(r"unit limits the drive from ([\d.]+) to ([\d.]+) Hz", text).groups())
    assert low < 13.0 < high
    assert "expected deviation of the control channels from the profile: at most " in text


def test_explain_warns_of_fast_sweep() -> None:
    text = str(daq.foresee(scene(control={"channels": ["unit"]}, duration="20 s", abort="30 dB")))
    assert "(damping 2.8 %) the sweep exceeds the tolerance" in text


def test_excess_aborts_with_zero_drive() -> None:
    result = run(scene(control={"channels": ["unit"]}, duration="5 s"))
    assert "aborted at" in result.reason and "dB above the profile. Sweep more slowly, or add a limit" in result.reason
    assert not result.drives[-1][:, -1].any() and result.drives[-1].shape[1] < 51


@pytest.mark.parametrize(("deviation", "limiting", "aborts"), [(-240, -1, True), (-7, 0, False), (-5, -1, False)])
def test_control_far_below_profile_aborts(deviation: float, limiting: int, aborts: bool) -> None:
    """At -240 dB, the readings of the control channel are below half a count."""
    with pytest.raises(AbortedTest, match="table is more than 6 dB below") if aborts else nullcontext():
        check_control(scene().test, Observation(0, 100, 5.0, deviation, limiting))


def test_too_high_profile_leaves_zero_drive() -> None:
    result = run(scene(shaker={"kind": "base", "output": {"range": "0.15 V"}}))
    assert "the profile requires a drive of" in result.reason and not result.drives[-1][:, -1].any()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"control": {"channels": ["tabel"]}}, "test.control.channels[1]: no motion channel 'tabel'"),
        ({"to": "40 Hz"}, "the profile from 5 to 30 Hz does not contain the sweep"),
        ({"to": "5 Hz"}, "test.to: got 5 Hz, the same as `from`"),
        ({"abort": "2 dB"}, "test.abort: got 2 dB, which is not above the tolerance, 3 dB"),
        ({"profile": PROFILE | {"velocity": [1.0, 1.0]}}, "expected exactly one of acceleration or velocity or"),
        ({"profile": {"frequencies": ["5 Hz", "30 Hz"]}}, "expected exactly one of acceleration or velocity or"),
    ],
)
def test_wrong_setting_is_named(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(SceneError) as error:
        scene(**changes)
    assert message in str(error.value)


def test_foresight_states_duration() -> None:
    assert daq.foresee(scene()).seconds == pytest.approx(run(scene()).station.now / 512.0, rel=0.2)


def test_profile_and_responses_are_evaluated(recording: Path, tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["profile", str(recording), "-o", str(tmp_path)])
    assert "unit limits the drive from" in result.output and (tmp_path / "sine-profile.csv").exists()
    assert "analysis profile" in str(daq.info(recording))
    peak = np.max(abs(analysis.frfs(recording)["unit"].value))
    assert peak == pytest.approx(1.0 / (2 * 0.03), rel=0.35)
    page = analysis.report(recording, tmp_path / "report.html").read_text(encoding="utf-8")
    assert "Control channel with profile and tolerance of" in page
