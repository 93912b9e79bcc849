"""`daq.foresee` predicts a test: maxima against closed form and recordings, limits, suitable levels, flights, noise."""

import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import daq
import rig
from daq.core.excitation.tones.steady_tone import Tone
from daq.core.prediction import rehearsal_plan
from daq.core.prediction.force_difference import unresolved_force
from daq.core.prediction.linear import channel_readings
from daq.core.prediction.linear_waits import _RidingModes, linear_waits
from daq.core.prediction.rehearsal import Rehearsal
from daq.core.virtual_bench.bench import Bench
from rig.core.base.errors import SceneError
from rig.core.system.assembly import assemble
from rig.core.system.structural_model import receptance
from tests.gauntlet.predicted_maxima import KINDS, compare, with_long_test
from tests.gauntlet.scenes import draw
from tests.peak_memory import peak_memory

TONE = {"kind": "sine", "frequency": "30 Hz", "force": "2 N", "duration": "3 s"}
VOLTS_PER_UNIT = 0.1 / 9.80665  # sensitivity of the accelerometer, V per m/s^2
STEPS = {"kind": "stepped_sine", "from": "10 Hz", "to": "40 Hz", "points": 150, "force": "1 N"}


HEAVY_DAMPER = {"body": 1, "mass_ratio": "5 %", "clearance": ".inf"}
V203_SPRING = 6600.0  # N/m


def one_body(test: dict[str, Any], **changes: Any) -> rig.Scene:
    """Return a body of 1 kg at 20 Hz with 2 % damping and ideal sensors, excited by a force."""
    scene = rig.loads(
        "structure: {masses: [1 kg], springs: [15.79 kN/m], damping: {modal: 2 %}}\n"
        "shaker: {kind: force, body: 1}\nconverter: {rate: 1024 Hz}"
    )
    return scene.replace(test=test, **changes)


def accelerometer(**changes: Any) -> list[dict[str, Any]]:
    """Return the channels of a scene with one accelerometer, a1 on body 1."""
    return [{"name": "a1", "at": "body 1", "accelerometer": {"sensitivity": "100 mV/g"}, **changes}]


def steady_acceleration(scene: rig.Scene, frequencies: np.ndarray) -> float:
    """Return the largest steady acceleration of body 1 for 1 N in m/s^2, in closed form."""
    return float(np.max((2 * np.pi * frequencies) ** 2 * abs(receptance(scene, frequencies)[0])))


@pytest.fixture
def short_rehearsals(monkeypatch: pytest.MonkeyPatch) -> None:
    """Limit rehearsals to a quarter of their usual length."""
    monkeypatch.setattr(rehearsal_plan, "_CPU_BUDGET_S", rehearsal_plan._CPU_BUDGET_S / 4)


def test_transient_maximum_states_its_steady_value() -> None:
    # After each change of the drive, the force exceeds its steady value until the motion has built up.
    scene = rig.loads(
        """
        structure: {masses: [2 kg], springs: [80 kN/m], damping: {dashpots: [8 N s/m]}}
        shaker: {kind: electrodynamic, preset: LDS V203, body: 1, spring: 200 kN/m}
        test: {kind: phase_resonance, frequency: 31 Hz, from: 28 Hz, to: 36 Hz, at: body 1, force: [1 N, 5 N]}
        channels:
          - {name: m, at: body 1, accelerometer: {sensitivity: 100 mV/g}}
          - {name: force, at: shaker, hammer: {preset: PCB 208C02}}
        converter: {rate: 2048 Hz, bits: 24, range: 5 V}
        """
    )
    foresight = daq.foresee(scene)

    force = foresight["force"]
    assert force.largest > 1.3 * force.steady and force.steady == pytest.approx(5.0, rel=0.01)
    assert force.place == "31.83 Hz, transient (5 N in steady state)"
    assert foresight["m"].place == "31.83 Hz"


@pytest.mark.thorough
@pytest.mark.usefixtures("short_rehearsals")
def test_long_stepped_test_has_steady_maximum() -> None:
    scene = one_body(STEPS, channels=accelerometer())
    foresight = daq.foresee(scene.replace(test={**STEPS, "points": 300, "measure": {"periods": 60}}))
    assert foresight.rehearsed
    expected = steady_acceleration(scene, np.linspace(10.0, 40.0, 300))
    assert foresight["a1"].largest == pytest.approx(expected, rel=0.03)
    assert foresight["a1"].frequency == pytest.approx(20.0, abs=0.2)  # the resonance


@pytest.mark.parametrize(("seed", "number"), [(3601, 1), (3601, 2), (3601, 5), (3602, 7), (3601, 9)])
def test_random_scene_confirms_prediction(seed: int, number: int, tmp_path: Path) -> None:
    kind = KINDS[number]
    comparison = compare(draw(seed, number, kind), kind, tmp_path)
    assert comparison.is_accurate, comparison
    assert abs(comparison.duration_error) < (1e-3 if comparison.fully_rehearsed else 0.1)


@pytest.mark.thorough
@pytest.mark.usefixtures("short_rehearsals")
@pytest.mark.parametrize(("seed", "number"), [(3602, 3), (3604, 6)])
def test_long_random_scene_confirms_prediction(seed: int, number: int, tmp_path: Path) -> None:
    kind = KINDS[number]
    scene = with_long_test(draw(seed, number, kind))
    comparison = compare(scene.replace(test=scene.test.replace(points=20)), kind, tmp_path)
    assert comparison.is_accurate and not comparison.fully_rehearsed, comparison


def test_peaks_with_dampers_are_ranked_first(monkeypatch: pytest.MonkeyPatch) -> None:
    # For each scene, the response with dampers is computed first, then the response without dampers.
    has_dampers = []

    def constant_readings(scene: rig.Scene, channels: Any, rising: np.ndarray) -> np.ndarray:
        has_dampers.append(len(scene.dampers) > 0)
        return np.ones((1, rising.size))

    monkeypatch.setattr(rehearsal_plan, "channel_readings", constant_readings)
    names = ("fig5-single-damper", "fig5-three-dampers", "fig8-two-dampers", "fig8-three-dampers", "fig9", "fig10a")
    for scene in map(rig.load, names):
        rehearsal_plan.plan_about_peaks(scene, (), 10.0)
    assert has_dampers == [True, False] * len(names)


def test_largest_level_is_the_limit() -> None:
    scene = one_body(STEPS | {"points": 12}, channels=accelerometer(), converter={"rate": 1024, "range": "0.1 V"})
    level = daq.foresee(scene).largest_level
    below, above = (
        daq.foresee(scene.replace(test={**STEPS, "points": 12, "force": factor * level})) for factor in (0.99, 1.01)
    )
    assert below.fits
    assert not above.fits
    assert "input range 0.1 V" in above.summary()


def test_overloaded_input_has_true_maximum() -> None:
    scene = one_body(TONE, channels=accelerometer())
    maximum = daq.foresee(scene)["a1"].largest
    clipped = daq.foresee(scene.replace(converter={"rate": 1024, "range": maximum * VOLTS_PER_UNIT / 2}))["a1"]
    assert clipped.overloaded
    assert clipped.largest == pytest.approx(maximum, rel=1e-6)
    assert clipped.recorded == pytest.approx(maximum / 2, rel=1e-6)


def test_every_exceeded_limit_is_named() -> None:
    sensor = {"sensitivity": "100 mV/g", "saturation": "0.2 g"}
    scene = one_body(TONE, channels=accelerometer(accelerometer=sensor), converter={"rate": 1024, "range": "10 mV"})
    exceeded = [entry.name for entry in daq.foresee(scene).expectations if entry.share >= 1.0]
    assert exceeded == ["a1", "a1 sensor"]
    assert "also over their limits: a1" in daq.foresee(scene).summary()


def test_sensor_limit_is_compared_with_acceleration() -> None:
    scene = one_body(TONE)
    maximum = daq.foresee(scene.replace(channels=accelerometer()))["a1"].largest
    sensor = {"sensitivity": "100 mV/g", "saturation": 2 * maximum}
    foresight = daq.foresee(
        scene.replace(channels=accelerometer(accelerometer=sensor, integrator={"order": 2, "corner": "1 Hz"}))
    )
    assert foresight["a1 sensor"].share == pytest.approx(0.5, rel=0.02)


def test_one_clipped_hit_among_good_ones_is_predicted(short_rehearsals) -> None:
    hits = {"kind": "impulse", "body": 1, "peak": ["600 N", "2.6 kN", "700 N"], "width": "4 ms", "repeats": 3}
    channels = [{"name": "h", "at": "hammer", "hammer": {"sensitivity": "2.25 mV/N"}}]
    scene = one_body({**hits, "interval": "2 s"}, channels=channels, converter={"rate": "5120 Hz", "range": "5 V"})
    foresight = daq.foresee(scene)
    assert foresight["h"].largest == pytest.approx(2600.0, rel=0.01) and not foresight.fits
    # At the largest level, the highest peak is within 5 V.
    assert foresight.largest_level == pytest.approx(5.0 / 2.25e-3, rel=0.02)


def test_duration_contains_wait_for_sensors(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(rehearsal_plan, "_CPU_BUDGET_S", 3e-4)
    hits = {"kind": "impulse", "body": 1, "peak": "50 N", "width": "4 ms", "repeats": 5, "interval": "2 s"}
    sensor = {"sensitivity": "100 mV/g", "bias": "9 V", "bias_settling": "1 s", "noise": "1 mg/sqrt(Hz)"}
    scene = one_body(hits, channels=accelerometer(accelerometer=sensor))
    foresight = daq.foresee(scene)
    assert re.search(r", of which [\d.]+ s until the bias of the sensors has settled; its recording", str(foresight))
    with daq.open(daq.record(scene, tmp_path / "hits.mcap")) as recording:
        assert foresight.seconds == pytest.approx(recording.samples / recording.rate, rel=0.02)


@pytest.mark.parametrize("shaker", [{"kind": "force", "body": 1}, {"kind": "table", "body": 1, "spring": "3 kN/m"}])
def test_duration_is_predicted_with_long_waits(shaker, monkeypatch) -> None:
    monkeypatch.setattr(rehearsal_plan, "_CPU_BUDGET_S", 0.1)
    structure = {"masses": ["1 kg", "0.8 kg"], "springs": ["20 kN/m", "15 kN/m"], "damping": {"modal": "0.1 %"}}
    steps = {"kind": "stepped_sine", "from": "10 Hz", "to": "40 Hz", "points": 30, "force": "1 N"}
    scene = one_body(TONE).replace(structure=structure, shaker=shaker, test=steps)
    foresight, complete = daq.foresee(scene), Rehearsal(scene).run(np.inf)
    assert foresight.rehearsed and complete.seconds > 300.0
    assert foresight.seconds == pytest.approx(complete.seconds, rel=0.1)


STEEL_ROD = {"kind": "electrodynamic", "body": 1, "spring": "10 MN/m"}


@pytest.mark.parametrize("sensor", [{"sensitivity_tolerance": "1 %"}, {"noise": "1 mg/sqrt(Hz)"}])
def test_stiff_stinger_without_measurable_force_is_named(sensor) -> None:
    sensor = {"sensitivity": "100 mV/g", **sensor}
    channels = [{"name": "t", "at": "table"}, {"name": "b", "at": "body 1"}]
    scene = one_body(STEPS, shaker=STEEL_ROD, channels=[{**channel, "accelerometer": sensor} for channel in channels])

    def warnings_of(scene: rig.Scene) -> list[str]:
        return list(unresolved_force(scene, assemble(scene), Bench(scene).channels))

    (warning,) = warnings_of(scene)
    assert "coil spring: at 20 Hz (every resonance of the test), the spring is so stiff" in warning
    softer = float(warning.split("at most ")[1].split(" N/m")[0])
    assert not warnings_of(scene.replace(shaker={**STEEL_ROD, "spring": 0.9 * softer}))


def test_force_cell_needs_no_resolved_spring_force() -> None:
    sensor = {"sensitivity": "100 mV/g", "sensitivity_tolerance": "1 %"}
    channels = [{"name": "t", "at": "table"}, {"name": "b", "at": "body 1"}]
    channels = [{**channel, "accelerometer": sensor} for channel in channels]
    scene = one_body(STEPS, shaker=STEEL_ROD, channels=[*channels, {"name": "f", "at": "shaker"}])
    assert not list(unresolved_force(scene, assemble(scene), Bench(scene).channels))


SWEEP = {"kind": "swept_sine", "from": "10 Hz", "to": "30 Hz", "duration": "20 s", "force": "1 N"}


def test_unresolved_control_of_sweep_is_named_with_cell() -> None:
    sensor = {"sensitivity": "100 mV/g", "sensitivity_tolerance": "1 %"}
    ends = [{"name": name, "at": at, "accelerometer": sensor} for name, at in (("t", "table"), ("b", "body 1"))]
    scene = one_body(SWEEP, shaker=STEEL_ROD, channels=[*ends, {"name": "f", "at": "shaker"}])
    (warning,) = unresolved_force(scene, assemble(scene), Bench(scene).channels)
    assert "Use a stepped sine, which is controlled by a force sensor (that is at the shaker)" in warning


def test_sweep_without_both_spring_ends_is_refused() -> None:
    cell = {"name": "f", "at": "shaker"}
    scene = one_body(SWEEP, shaker=V203, channels=[{"name": "b", "at": "body 1"}, cell])
    with pytest.raises(rig.SceneError, match="motion channel at the table"):
        daq.foresee(scene)


def test_unresolved_spring_force_is_in_the_prediction() -> None:
    sensor = {"sensitivity": "100 mV/g", "sensitivity_tolerance": "10 %"}
    channels = [{"name": name, "at": at, "accelerometer": sensor} for name, at in (("t", "table"), ("b", "body 1"))]
    steps = {"kind": "stepped_sine", "frequencies": ["19 Hz", "21 Hz"], "force": "1 N"}
    scene = one_body(steps, shaker={**STEEL_ROD, "spring": "1 MN/m"}, channels=channels)
    assert "the spring is so stiff" in str(daq.foresee(scene))


V203 = {"kind": "electrodynamic", "preset": "LDS V203", "body": 1, "spring": "6.6 kN/m"}


def test_current_of_preset_limits_the_force() -> None:
    foresight = daq.foresee(one_body({**TONE, "force": "2 N"}, shaker=V203))
    current = foresight["coil current"]
    # The coil's voltage is R i + L i' + force factor * velocity of the table.
    omega = 2 * np.pi * 30.0
    table_receptance = 1.0 / V203_SPRING + receptance(one_body(TONE), np.array([30.0]))[0, 0]
    armature = 2897.0 + 6.846j * omega - 0.03118 * omega**2
    assert current.largest == pytest.approx(2.0 * abs(1.0 + armature * table_receptance) / 3.744, rel=0.02)
    assert foresight.largest_level == pytest.approx(2.0 * 5.2 / current.largest, rel=0.02)
    assert foresight.limited_by is not None and foresight.limited_by.name == "coil current"


def test_coil_current_equals_that_of_current_amplifier() -> None:
    shaker = {**V203, "amplifier": {"mode": "current", "gain": "2 A/V"}, "limits": {"force": "10 N"}}
    foresight = daq.foresee(one_body({**TONE, "force": "2 N"}, shaker=shaker))
    current = foresight["amplifier"].largest
    assert foresight["coil current"].largest == pytest.approx(current, rel=1e-3)
    assert foresight["coil force"].largest == pytest.approx(3.744 * current, rel=1e-3)


@pytest.mark.parametrize(("limits", "name"), [({"travel": "1 um"}, "travel"), ({"velocity": "1 um/s"}, "velocity")])
def test_travel_and_velocity_of_table_are_limited(limits, name) -> None:
    shaker = {**V203, "limits": {"current": "1 kA", "force": "1 kN", **limits}}
    foresight = daq.foresee(one_body(TONE, shaker=shaker))
    assert not foresight.fits and f"overloads table {name}" in foresight.summary()


def test_required_drive_exceeds_weak_amplifier() -> None:
    test = {"kind": "stepped_sine", "frequencies": [30.0, 34.7], "force": "2.6 N"}
    scene = rig.load("fig8-no-damper").replace(test=test)
    required = daq.foresee(scene)["amplifier"].largest
    with_weak_amplifier = daq.foresee(scene.replace(shaker=scene.shaker.replace(amplifier={"limit": required / 2})))
    assert with_weak_amplifier["amplifier"].share == pytest.approx(2.0, rel=0.05)
    assert with_weak_amplifier.largest_level == pytest.approx(2.6 / 2, rel=0.05)
    assert "within all limits (amplifier)" in str(with_weak_amplifier)


@pytest.mark.parametrize("level", [{"drive": "1 V"}, {"force": "30 N"}])
def test_random_level_within_weak_amplifier_is_not_clipped(level, tmp_path: Path) -> None:
    shaker = {"kind": "electrodynamic", "body": 1, "spring": "6.6 kN/m", "amplifier": {"limit": "2 V"}}
    scene = one_body({"kind": "random", "from": "5 Hz", "to": "30 Hz", "duration": "20 s", **level}, shaker=shaker)
    largest = daq.foresee(scene).largest_level
    for ratio, is_clipped in ((0.98, False), (1.05, True)):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", daq.RunWarning)
            daq.record(scene.replace(test=scene.test.at_level(ratio * largest)), tmp_path / f"{ratio}.mcap")
        assert any("amplifier" in str(each.message) for each in caught) == is_clipped


def test_damper_flies_where_its_body_exceeds_gravity() -> None:
    test = {"kind": "stepped_sine", "from": "10 Hz", "to": "40 Hz", "points": 16, "force": "3 N"}
    scene = one_body(test, dampers=[HEAVY_DAMPER])
    frequencies = np.array(scene.test.order)
    response = abs(receptance(scene, frequencies, riding=[1])[0])
    above_gravity = frequencies[3.0 * (2 * np.pi * frequencies) ** 2 * response > scene.gravity]
    (line,) = daq.foresee(scene).flights
    assert line.split(";")[0] == f"damper 1 (body 1) flies at {above_gravity[0]:g} to {above_gravity[-1]:g} Hz"
    (line,) = daq.foresee(scene.replace(structure=scene.structure.replace(names=["arm"]))).flights
    assert line.startswith("damper 1 (arm) flies at")
    (line,) = daq.foresee(scene.replace(test={**test, "force": "0.2 N"})).flights
    assert "stays on its floor" in line


def test_flight_before_steady_state_is_no_steady_flight() -> None:
    scene = one_body({**TONE, "frequency": "17 Hz", "force": "1 N"}, dampers=[HEAVY_DAMPER])
    onset = 1.0 / np.abs(receptance(scene, np.array([17.0]), riding=[1])[0, 0]) / (2 * np.pi * 17) ** 2 * scene.gravity
    # The transient of a tone that starts at its full amplitude adds to the steady motion.
    test = {"kind": "sine", "frequency": "17 Hz", "duration": "8 s", "force": 0.9 * onset}
    assert daq.foresee(scene.replace(test=test)).flights == (
        "damper 1 (body 1) flies only before the steady state at 17 Hz",
    )
    (line,) = daq.foresee(scene.replace(test={**test, "force": 1.1 * onset})).flights
    assert line == "damper 1 (body 1) flies at 17 Hz"


@pytest.mark.parametrize(
    "points", [{"frequencies": [15, 18, 21, 24]}, {"from": "15 Hz", "to": "24 Hz", "points": 4}], ids=["list", "range"]
)
def test_flight_between_points_names_points_to_add(points) -> None:
    scene = one_body({"kind": "stepped_sine", **points, "force": "0.8 N"}, dampers=[HEAVY_DAMPER])
    grid = np.arange(18.0, 21.0, 0.001)
    accelerations = 0.8 * (2 * np.pi * grid) ** 2 * abs(receptance(scene, grid, riding=[1])[0])
    flying = grid[accelerations > scene.gravity]
    (line,) = daq.foresee(scene).flights
    low, high = map(float, re.search(r"between points at ([\d.]+) to ([\d.]+) Hz", line).groups())
    np.testing.assert_allclose([low, high], [flying[0], flying[-1]], atol=0.03)
    if "points" in points:
        added = {**points, "points": int(re.search(r"test.points: (\d+)", line)[1])}
    else:
        listed = re.search(r"Add (.*) Hz to test.frequencies", line)[1].split(", ")
        added = {"frequencies": sorted([*points["frequencies"], *map(float, listed)])}
    scene = scene.replace(test={"kind": "stepped_sine", **added, "force": "0.8 N"})
    tones = np.array(scene.test.order)
    assert ((tones > flying[0] - 0.03) & (tones < flying[-1] + 0.03)).sum() >= 3
    (line,) = daq.foresee(scene).flights
    assert "between" not in line and line.startswith("damper 1 (body 1) flies at")


@pytest.mark.parametrize(
    ("joint", "limit", "action"),
    [
        ({"gap": "0.2 mm", "stiffness": "5 kN/m"}, 0.2e-3, "closes"),
        ({"slip_force": "0.4 N", "stiffness": "5 kN/m"}, 0.4 / 5e3, "slips"),
    ],
)
def test_joint_acts_where_its_limit_is_exceeded(joint, limit, action) -> None:
    test = {"kind": "stepped_sine", "from": "10 Hz", "to": "40 Hz", "points": 16, "force": "0.3 N"}
    scene = one_body(test, joints=[{"between": ["ground", 1], **joint}])
    frequencies = np.array(scene.test.order)
    # A joint with friction is a spring below its limit.
    springs = (15790.0 + 5e3 * (action == "slips"),)
    linear = scene.replace(joints=(), structure=scene.structure.replace(springs=springs))
    exceeding = frequencies[0.3 * abs(receptance(linear, frequencies)[0]) > limit]
    (line,) = daq.foresee(scene).flights
    assert line.split(";")[0] == f"joint 1 (between ground and body 1) {action} at " + (
        f"{exceeding[0]:g} Hz" if exceeding.size == 1 else f"{exceeding[0]:g} to {exceeding[-1]:g} Hz"
    )
    (line,) = daq.foresee(scene.replace(test={**test, "force": "0.01 N"})).flights
    assert line.endswith("stays open" if action == "closes" else "sticks")


def test_controlled_sweep_states_frequency_of_first_flight() -> None:
    profile = {"frequencies": ["10 Hz", "30 Hz"], "acceleration": ["0.3 g", "0.3 g"]}
    test = {"kind": "sine_control", "from": "10 Hz", "to": "30 Hz", "duration": "20 s", "profile": profile}
    channels = [{"name": "table", "at": "table", "accelerometer": {"sensitivity": "100 mV/g"}}]
    scene = one_body(
        {**test, "control": {"channels": ["table"]}}, shaker={"kind": "base"}, dampers=[HEAVY_DAMPER], channels=channels
    )
    (line,) = daq.foresee(scene).flights
    # The mode at 19.5 Hz amplifies 0.3 g to above 1 g from 16.3 Hz.
    frequency = float(re.fullmatch(r"damper 1 \(body 1\) flies first at (.*) Hz", line)[1])
    assert frequency == pytest.approx(19.5 * np.sqrt(1.0 - 0.3), rel=0.03)


def test_smallest_signal_is_that_of_weakest_tone() -> None:
    sensor = {"sensitivity": "100 mV/g", "noise": "1 mg/sqrt(Hz)"}
    test = {"kind": "stepped_sine", "frequencies": [5.0, 20.0], "force": "1 N", "measure": {"periods": 20}}
    scene = one_body(test, channels=accelerometer(accelerometer=sensor))
    signal = daq.foresee(scene).signals["a1"]
    density = 1e-3 * 9.80665  # m/s^2/sqrt(Hz)
    noise = density * np.sqrt(2.0 / 4.0)  # of an amplitude that is measured for 4 s, 20 periods at 5 Hz
    assert signal.frequency == 5.0
    assert signal.ratio == pytest.approx(steady_acceleration(scene, np.array([5.0])) / noise, rel=0.02)


def test_channel_below_its_noise_is_named() -> None:
    noisy = accelerometer(accelerometer={"sensitivity": "100 mV/g", "noise": "1 g/sqrt(Hz)"})
    (line,) = daq.foresee(one_body(TONE | {"force": "0.1 N"}, channels=noisy)).hidden
    assert line.startswith("a1: at 30 Hz, the signal is")
    assert daq.foresee(one_body(TONE | {"force": "1 kN"}, channels=noisy)).hidden == ()


def test_channel_below_two_counts_is_named() -> None:
    converter = {"rate": 1024, "bits": 8, "range": "10 V"}
    (line,) = daq.foresee(one_body(TONE, channels=accelerometer(), converter=converter)).hidden
    assert line.startswith("a1: the largest reading is below two counts")
    with_24_bits = daq.foresee(one_body(TONE, channels=accelerometer(), converter=converter | {"bits": 24}))
    assert with_24_bits.hidden == ()


def test_modes_outside_the_band_are_listed() -> None:
    scene = rig.load("bare-structure")
    test = {"kind": "random", "from": "20 Hz", "to": "60 Hz", "duration": "2 s", "force": "1 N"}
    (line,) = daq.foresee(scene.replace(test=test)).outside
    assert "mode 1 at 13.04 Hz" in line


def test_scene_without_test_is_rejected() -> None:
    with pytest.raises(SceneError, match="has no test"):
        daq.foresee(rig.load("bare-structure").replace(test=None))


def test_table_has_a_row_for_each_maximum() -> None:
    foresight = daq.foresee(one_body(TONE, channels=accelerometer()))
    table = foresight.columns()
    assert table["name"].tolist() == ["a1", "ao0"]
    assert {len(column) for column in table.values()} == {2}
    assert str(foresight).splitlines()[0] == foresight.summary()


@pytest.mark.parametrize("truth", [False, True])
@pytest.mark.parametrize("name", ["fig10b-three-dampers", "reference-B"])
def test_size_of_recording_is_predicted(name, truth, tmp_path):
    scene = rig.load(name, {"recording.truth": truth})
    path = daq.record(scene, tmp_path / "a.mcap")
    assert daq.foresee(scene).disk == pytest.approx(path.stat().st_size, rel=0.2)


@pytest.mark.parametrize(("kind", "volts"), [("table", 2.0), ("electrodynamic", 2e-3)])
def test_linear_reading_of_the_drive_is_its_voltage(kind: str, volts: float) -> None:
    # The drive is 2 mm or 2 mV. 1 V at the output moves the table by 1 mm, or drives the coil's amplifier with 1 V.
    shaker = {"kind": "table", "body": 1, "spring": "6.6 kN/m", "bandwidth": "100 kHz"}
    scene = rig.load("fig9").replace(
        shaker=shaker if kind == "table" else rig.load("fig9").shaker,
        test={"kind": "sine", "frequency": "30 Hz", "drive": 2e-3, "duration": "3 s"},
        channels=[{"name": "output", "at": "drive"}],
        converter={"rate": "5120 Hz", "sampling": "point"},
    )
    readings = channel_readings(scene, Bench(scene).channels, np.array([30.0]))
    assert 2e-3 * readings[0, 0] == pytest.approx(volts, rel=1e-6)


def test_power_on_transient_does_not_limit_the_level() -> None:
    hit = {"kind": "impulse", "body": 1, "peak": "10 N", "width": "5 ms", "repeats": 1, "interval": "2 s"}
    scene = one_body(hit, channels=accelerometer(accelerometer={"preset": "PCB 352C33"}), shaker=None)
    prediction = daq.foresee(scene.replace(converter={"preset": "NI 9234", "rate": "2048 Hz"}))
    assert prediction["a1"].place.endswith(" in the test)") and prediction["a1"].largest > 50.0
    # The acceleration of the hit is at most 10 N / 1 kg, 1.02 g, and the limit of the sensor 50 g.
    assert 400.0 < prediction.largest_level < 600.0


def test_waits_include_averages_of_noise() -> None:
    steps = {"kind": "stepped_sine", "from": "10 Hz", "to": "40 Hz", "points": 10, "force": "10 mN"}
    sensor = {"sensitivity": "100 mV/g", "noise": "50 ug/sqrt(Hz)"}
    waits = []
    for noisy in (sensor, {**sensor, "noise": "0 ug/sqrt(Hz)"}):
        scene = one_body(steps, channels=[{"name": "a1", "at": "body 1", "accelerometer": noisy}])
        waits.append(linear_waits(scene, assemble(scene), Bench(scene).channels).expected)
    assert waits[0].sum() > waits[1].sum() + 1.0


@pytest.mark.parametrize(("noise", "tolerance"), [("0 ug/sqrt(Hz)", 0.03), ("5 ug/sqrt(Hz)", 0.06)])
def test_predicted_waits_are_those_of_the_procedure(noise: str, tolerance: float) -> None:
    steps = {"kind": "stepped_sine", "from": "10 Hz", "to": "40 Hz", "points": 40, "force": "10 mN"}
    channels = [
        {"name": name, "at": at, "accelerometer": {"sensitivity": "100 mV/g", "noise": noise}}
        for name, at in (("a1", "body 1"), ("table", "table"))
    ]
    scene = one_body(steps, channels=channels, shaker={"kind": "table", "body": 1, "spring": "5 kN/m"})
    rehearsal = Rehearsal(scene).run(np.inf)
    taken = sum(step.stop - step.first for step in rehearsal.steps[::2]) / rehearsal.rate
    waits = linear_waits(scene, assemble(scene), Bench(scene).channels)
    assert waits.expected.sum() == pytest.approx(taken, rel=tolerance)


@pytest.mark.parametrize(
    ("shaker", "places"),
    [
        ({"kind": "force"}, ["shaker", "body 1"]),
        ({"kind": "force"}, ["drive"]),
        ({"kind": "table", "spring": "5 kN/m"}, ["drive", "shaker"]),
        ({"kind": "electrodynamic", "preset": "LDS V203", "spring": "500 kN/m"}, ["body 1", "shaker", "table"]),
        ({"kind": "electrodynamic", "preset": "LDS V203", "spring": "500 kN/m"}, ["table", "body 1", "drive"]),
    ],
)
def test_waits_are_predicted_for_each_sensor_place(shaker: dict[str, Any], places: list[str]) -> None:
    steps = {"kind": "stepped_sine", "from": "10 Hz", "to": "40 Hz", "points": 31, "force": "10 mN"}
    channels = [{"name": f"c{number}", "at": place} for number, place in enumerate(places)]
    scene = one_body(steps, shaker={"body": 1, **shaker}, channels=channels)
    rehearsal = Rehearsal(scene).run(np.inf)
    taken = sum(step.stop - step.first for step in rehearsal.steps[::2]) / rehearsal.rate
    waits = linear_waits(scene, assemble(scene), Bench(scene).channels)
    assert waits.expected.sum() == pytest.approx(taken, rel=0.1)


def test_complete_rehearsal_gives_exact_duration() -> None:
    scene = rig.load("held-response")
    foresight = daq.foresee(scene, cpu_seconds=20.0)
    assert foresight.seconds == Rehearsal(scene).run(np.inf).seconds
    assert foresight.seconds_range == (foresight.seconds, foresight.seconds) and not foresight.rehearsed


@pytest.mark.parametrize(("end_hz", "end_drive"), [(20.0, 1.0), (20.1, 4.0), (60.0, 0.0)])
def test_predicted_transition_equals_integrated_response(end_hz: float, end_drive: float) -> None:
    scene = one_body(STEPS, shaker={"kind": "table", "body": 1, "spring": "5 kN/m"})
    modes = _RidingModes.of(scene, assemble(scene), np.array([20.0]))
    assert modes is not None
    start, seconds, points = 1e-3 * (np.arange(modes.poles.size) + 1j), 0.4, 500_000
    tone = Tone(points / seconds, 20.0)
    tone.amplitude, tone.phase = 2.0, 0.7
    computed = modes.after_transition(start, tone, seconds, end_hz, end_drive)
    drive = tone.transition(points, end_hz, end_drive)
    drive = np.append(drive, end_drive * np.sin(tone.phase))
    # The integral of participation exp(pole (seconds - t)) drive(t), by the trapezoidal rule.
    decay = np.exp(np.outer(np.linspace(seconds, 0.0, points + 1), modes.poles))
    driven = np.trapezoid(decay * drive[:, None], dx=seconds / points, axis=0) * modes.participation
    np.testing.assert_allclose(computed, decay[0] * start + driven, rtol=1e-6)


def test_memory_of_one_more_step_is_small() -> None:
    peaks = []
    # The first test includes imports.
    for points in (10, 1000, 3000):
        scene = one_body(STEPS | {"points": points})
        peaks.append(peak_memory(linear_waits, scene, assemble(scene), Bench(scene).channels)[0])
    # It was 5 kB with the transients of all steps at once.
    assert peaks[2] - peaks[1] < 2000 * 1000


def test_range_of_duration_contains_steps_that_do_not_settle() -> None:
    foresight = daq.foresee("fig8-one-damper")
    shortest, longest = foresight.seconds_range
    # The recording takes 1225 s; several steps at the resonances do not become steady in 60 s.
    assert shortest < 1225.0 < longest and foresight.seconds == pytest.approx(1225.0, rel=0.1)
    assert f"{shortest / 60:.1f} min to {longest / 60:.1f} min, about" in str(foresight)
    assert "(waits with moving dampers or joints are uncertain)" in str(foresight)


def test_duration_of_levels_is_proportional_to_a_rehearsed_level() -> None:
    foresight = daq.foresee("held-response")
    part = float(foresight.rehearsed.split()[0])
    assert foresight.seconds == pytest.approx(4.0 * part, rel=0.02)
    assert foresight.seconds_range == pytest.approx((foresight.seconds / 1.5, foresight.seconds * 1.5))
