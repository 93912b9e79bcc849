"""Motion types and energy balance of dampers, estimated from recordings and compared with the truth.

Types of Inoue, Yokomichi, Hiraki (2011): I, impacts on the floor; II, on floor and ceiling; III, on both and sticking
at the ceiling.
"""

import csv
import re
import warnings
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

import analysis
import daq
import rig
from analysis.commands.cli import app
from analysis.commands.presentation.damper_findings import describe_motions, present_dampers
from analysis.core.damper_motion import energy_balance
from analysis.core.damper_motion.energy_balance import energy_per_period
from analysis.core.damper_motion.free_flight import BodyMotion, restitution
from analysis.core.damper_motion.impact_energy import impact_energy_per_period
from analysis.core.damper_motion.motion_types import DamperMotion, damper_motion
from analysis.core.responses.checks.curve_checks import find_jumps
from analysis.core.responses.errors.systematic import ASSUMED_TOLERANCE
from analysis.core.responses.stepped_sine import sweeps
from daq.core.signal_chain.channel import ChannelInfo
from rig.core.base.errors import RecordingError
from tests.analysis.responses import synthetic


def test_linear_structure_dissipates_supplied_energy(tmp_path):
    with daq.open(synthetic.stepped_sine(tmp_path / "a.mcap", [12.0, 13.04, 30.0, 34.8, 49.7])) as rec:
        [sweep] = sweeps(rec)
        energy = energy_per_period(rec, sweep)
    np.testing.assert_allclose(energy.structure, energy.supplied, rtol=1e-6)
    assert np.all(abs(energy.dampers) < 1e-5 * energy.supplied)


@pytest.mark.parametrize("bodies", [[2], [1, 3]])
def test_energy_of_force_on_listed_bodies_balances(tmp_path, bodies):
    scene = rig.loads(
        f"""
        structure: {{masses: [0.74, 0.71, 0.64], springs: [24300, 21800, 19800], damping: {{modal: 0.01}}}}
        shaker: {{kind: force, body: {bodies}}}
        test: {{kind: stepped_sine, frequencies: [12, 34], force: 1 N}}
        channels:
        - {{name: a1, at: body 1}}
        - {{name: a2, at: body 2}}
        - {{name: a3, at: body 3}}
        - {{name: f, at: shaker}}
        """
    )
    with daq.open(daq.record(scene, tmp_path / "a.mcap")) as rec:
        [sweep] = sweeps(rec)
        energy = energy_per_period(rec, sweep)
    np.testing.assert_allclose(energy.structure, energy.supplied, rtol=0.01)


def test_only_driven_shaker_supplies_energy(tmp_path):
    scene = rig.loads(
        """
        structure: {masses: [0.74, 0.71, 0.64], springs: [24300, 21800, 19800], damping: {modal: 0.01}}
        shaker:
        - {kind: electrodynamic, body: 1, spring: 6600}
        - {kind: electrodynamic, body: 3, spring: 5000}
        test: {kind: stepped_sine, frequencies: [12, 34], drive: 1 V, shaker: 2}
        """
    )
    with daq.open(daq.record(scene, tmp_path / "a.mcap")) as rec:
        [sweep] = sweeps(rec)
        assert np.all(energy_per_period(rec, sweep).supplied > 0.0)


def test_sensor_tolerances_bound_energy_balance(tmp_path, monkeypatch):
    # Aliasing of point samples is another error, which is excluded here.
    monkeypatch.setattr(energy_balance, "aliased_ratios", lambda *_: (0.0, 0.0))
    infos = synthetic.channels(sensor={"accelerometer.sensitivity_tolerance": "1 %"})
    path = synthetic.stepped_sine(tmp_path / "a.mcap", [12.0, 13.04, 20.0, 34.8, 49.7], infos=infos)
    with daq.open(path) as rec:
        [sweep] = sweeps(rec)
        errors = []
        for deviations in np.random.default_rng(1).uniform(-0.01, 0.01, (300, 4)):
            tones = tuple(replace(tone, amplitude=(1.0 + deviations[:, None]) * tone.amplitude) for tone in sweep.tones)
            errors.append(abs(energy_per_period(rec, replace(sweep, tones=tones)).dampers))
        inside = np.mean(errors <= energy_per_period(rec, sweep).expanded, axis=0)
    assert np.all((inside > 0.93) & (inside < 0.99))


def test_imported_sensors_widen_energy_and_motion(tmp_path, monkeypatch):
    path = synthetic.stepped_sine(tmp_path / "a.mcap", [12.0, 13.04, 20.0])
    expanded, tolerances = [], []
    for source in ("", "another instrument"):
        monkeypatch.setattr(daq.Recording, "source", source)
        with daq.open(path) as rec:
            [sweep] = sweeps(rec)
            expanded.append(energy_per_period(rec, sweep).expanded)
            tolerances.append(BodyMotion(rec, "body1", 0, 100).tolerance)
    assert np.all(expanded[1] > expanded[0]) and tolerances == [0.0, ASSUMED_TOLERANCE]


def test_missing_channel_is_named(tmp_path):
    infos = [info for info in synthetic.channels() if info.name != "body2"]
    marks = [("measure", 0, 2559, {"frequency": 20.0, "level": 1.0, "direction": "up"})]
    samples = np.tile(np.sin(2 * np.pi * 20 / synthetic.RATE * np.arange(2560)), (3, 1))
    with daq.open(synthetic.write(tmp_path / "a.mcap", synthetic.scene(), infos, samples, marks)) as rec:
        [sweep] = sweeps(rec)
        with pytest.raises(RecordingError, match="no channel on body 2"):
            energy_per_period(rec, sweep)


def test_linear_resonance_is_not_a_jump(tmp_path):
    with daq.open(synthetic.stepped_sine(tmp_path / "a.mcap", np.linspace(8.0, 60.0, 105))) as rec:
        for [*curves] in analysis.frequency_responses(rec):
            assert [find_jumps(curve) for curve in curves] == [[], [], []]


def motion_with(floor, ceiling, **fields):
    """Return a motion with these numbers of impacts per period."""
    defaults = {"stays_at_ceiling": False, "detection_limit": 1e-3, "stays_on_floor": False}
    return DamperMotion(**{"frequency": 30.0, "channel": "body2", **defaults, **fields}, floor=floor, ceiling=ceiling)


@pytest.mark.parametrize(
    ("floor", "ceiling", "stays_at_ceiling", "name"),
    [
        (0, 0, False, "riding"),
        (1, 0, False, "I"),
        (1, 1, False, "II"),
        (1, 1, True, "III"),
        (1, 1, None, "other: 1 floor and 1 ceiling impacts per period, Type II or III"),
        (2, 1, False, "other: 2 floor and 1 ceiling impacts per period"),
    ],
)
def test_type_follows_from_impacts_per_period(floor, ceiling, stays_at_ceiling, name):
    assert motion_with(floor, ceiling, stays_at_ceiling=stays_at_ceiling, stays_on_floor=True).name == name


@pytest.fixture(scope="module")
def fig9(tmp_path_factory):
    test = {"kind": "stepped_sine", "frequencies": (47.5, 48.6, 49.0), "force": 3.3}
    test |= {"settle": {"longest": 3.0}, "measure": {"periods": 25}}
    scene = rig.load("fig9")
    scene = scene.replace(
        shaker={"kind": "table", "body": 1, "spring": 6600.0}, test=test, recording={"truth": True, "display": False}
    )
    path = tmp_path_factory.mktemp("fig9") / "fig9.mcap"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", daq.RunWarning)
        return daq.record(scene, path)


def types_from_truth(rec, sweep):
    """Return the true motion types of a single damper, from its events and contacts."""
    events, contact = rec.events, rec.truth("contact")[0]
    types = []
    for first, stop in sweep.windows:
        in_window = (events["time"] > first / rec.rate) & (events["time"] < stop / rec.rate)
        hits_ceiling = np.any(events["kind"][in_window] == "ceiling")
        sticks_at_ceiling = np.any(contact[first:stop] == 2)
        types.append("III" if hits_ceiling and sticks_at_ceiling else "II" if hits_ceiling else "I")
    return types


def test_possible_flight_is_not_called_riding() -> None:
    motion = motion_with(0, 0, stays_on_floor=False)
    assert motion.name == "unseen"
    assert "may fly" in describe_motions([[motion]])[1]


@pytest.mark.parametrize(("floor", "ceiling"), [(1.1, 0), (1, 1), (0.48, 0.31)])
def test_irregular_impacts_have_no_type(floor, ceiling) -> None:
    motion_type = motion_with(floor, ceiling, cycle_periods=0).name
    assert motion_type == "uncertain: irregular, or impacts missed"


def test_pattern_of_two_periods_has_half_impacts() -> None:
    motion_type = motion_with(0.53, 1.47, cycle_periods=2).name
    assert motion_type == "other: 0.5 floor and 1.5 ceiling impacts per period"


def test_reachable_ceiling_excludes_type_i() -> None:
    motion_type = motion_with(1, 0, may_reach_ceiling_unseen=True).name
    assert motion_type == "other: 1 floor and 0 ceiling impacts per period, Type I or weak impacts on the ceiling"


def test_patterns_are_described_with_counts() -> None:
    motions = [motion_with(n, 0, frequency=f) for f, n in ((10.0, 2), (11.0, 3))]
    _, first, second, limit = describe_motions([motions])
    assert "2 floor" in first and "3 floor" in second and "1 mm/s (body2)" in limit


@pytest.mark.parametrize(
    ("fundamental", "third_harmonic", "tolerance", "name"),
    [(0.95, 0.0, 0.0, "riding"), (0.9, 0.15, 0.0, "unseen"), (0.95, 0.0, 0.1, "unseen"), (0.8, 0.0, 0.1, "riding")],
)
def test_riding_requires_acceleration_above_minus_g(tmp_path, fundamental, third_harmonic, tolerance, name):
    """Riding depends on the peak acceleration, including harmonics and the sensor tolerance."""
    sensor = {"accelerometer.sensitivity_tolerance": str(tolerance)}
    infos = [ChannelInfo("body1", "body 1", "acceleration", 1.0, synthetic.RATE, average=True, sensor=sensor)]
    phase = 2 * np.pi * 40.0 / synthetic.RATE * np.arange(20 * 64)
    acceleration = 9.80665 * (fundamental * np.cos(phase) + third_harmonic * np.cos(3 * phase))
    marks = [("measure", 0, acceleration.size - 1, {"frequency": 40.0, "level": 1.0, "direction": "up"})]
    path = synthetic.write(
        tmp_path / "a.mcap", synthetic.scene().replace(gravity=9.80665), infos, acceleration[None], marks
    )
    with daq.open(path) as rec:
        [sweep] = sweeps(rec)
        [motion] = damper_motion(rec, sweep, "body1")
    assert motion.name == name


def test_ranges_end_at_omitted_frequencies() -> None:
    motions = [motion_with(1, 0, frequency=f) for f in (10.0, 11.0, 13.0, 14.0)]
    assert "10 to 11 and 13 to 14 Hz" in describe_motions([motions], [12.0])[1]
    assert "10 to 14 Hz" in describe_motions([motions])[1]


def test_fig_9_types_are_identified(fig9):
    with daq.open(fig9) as rec:
        [sweep] = sweeps(rec)
        motions = damper_motion(rec, sweep, "body2")
        assert [motion.name for motion in motions] == types_from_truth(rec, sweep) == ["I", "II", "III"]
    assert describe_motions([motions])[1].split() == ["body2", "Type", "I", "47.5", "Hz"]


def test_uncertain_impacts_give_no_false_type(tmp_path):
    """At 46.81 Hz the damper in body 2 has impacts on the ceiling with a tenth of the velocity jump at the floor."""
    sensor = {"sensitivity": 0.0078, "noise": 4.8e-5, "sensitivity_tolerance": 0.03}
    scene = rig.Scene(
        name="weak impacts",
        structure={
            "masses": (81.75, 75.25, 61.21),
            "springs": (1757826.0, 1833557.0, 1771780.0),
            "damping": {"modal": 0.01927},
        },
        dampers=(
            {"body": 3, "mass": 1.2242, "clearance": 0.00020375},
            {"body": 2, "mass": 3.7626, "clearance": 0.00061844},
        ),
        shaker={"kind": "force", "body": 2},
        test={
            "kind": "stepped_sine",
            "frequencies": (46.8148,),
            "force": 408.37,
            "settle": {"longest": 5.0},
            "measure": {"periods": 30},
        },
        channels=(
            *({"name": f"b{n}", "at": f"body {n}", "accelerometer": sensor} for n in (1, 2, 3)),
            {"name": "F", "at": "shaker", "hammer": {"sensitivity": 0.0061}},
        ),
        converter={"rate": 1776.954, "bits": 24, "range": 5.0},
        recording={"display": False},
        seed=111,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", daq.RunWarning)
        path = daq.record(scene, tmp_path / "weak.mcap")
    with daq.open(path) as rec:
        [sweep] = sweeps(rec)
        [motion] = damper_motion(rec, sweep, "b2")
    assert motion.name == "II" or "uncertain" in motion.name or "Type I or weak impacts" in motion.name


def test_impact_energy_agrees_with_truth(fig9):
    with daq.open(fig9) as rec:
        [sweep] = sweeps(rec)
        energy = energy_per_period(rec, sweep)
        true_energy = impact_energy_per_period(rec, sweep)
    assert np.all(abs(energy.dampers - true_energy) <= energy.expanded) and np.all(
        energy.expanded < 0.1 * energy.supplied
    )
    assert np.all(true_energy[1:] > 0.6 * energy.supplied[1:])


def test_finite_duration_motion_and_energy_are_true(tmp_path):
    [damper] = rig.load("fig9").dampers
    scene = rig.load("fig9").replace(
        dampers=[damper.replace(contact={"duration": 2e-3})],
        test={"kind": "stepped_sine", "frequencies": (46.0, 48.0, 55.0), "force": 3.3},
        recording={"truth": True, "display": False},
    )
    with daq.open(daq.record(scene, tmp_path / "finite.mcap")) as rec:
        [sweep] = sweeps(rec)
        names = [motion.name for motion in damper_motion(rec, sweep, "body2")]
        energy, true_energy = energy_per_period(rec, sweep), impact_energy_per_period(rec, sweep)
    assert names[:2] == ["I", "I"] and names[2] in ("riding", "unseen")
    assert rig.frequency_response(scene, [46.0, 48.0]).motion_type.ravel().tolist() == ["I", "I"]
    assert np.all(abs(energy.dampers - true_energy) <= energy.expanded)
    assert np.all(true_energy[:2] > 0.6 * energy.supplied[:2])


def test_command_prints_motion_and_energy(fig9, tmp_path):
    result = CliRunner().invoke(app, ["dampers", str(fig9), "-o", str(tmp_path)])
    assert result.exit_code == 0
    assert re.search(r"Type III +49 Hz", result.output) and "true impact loss" in result.output
    rows = (tmp_path / "fig9-dampers.csv").read_text(encoding="utf-8").splitlines()
    assert len(rows) == 4 and rows[0].startswith("scene,frequency_Hz,supplied_J")
    # A window with its ends omitted contains no whole number of periods, but one impact per wall and period.
    impacts = [(row["floor_per_period"], row["ceiling_per_period"]) for row in csv.DictReader(rows)]
    assert impacts == [("1", "0"), ("1", "1"), ("1", "1")]


def test_scene_without_dampers_is_rejected(tmp_path):
    path = synthetic.stepped_sine(tmp_path / "a.mcap", [12.0])
    with pytest.raises(RecordingError, match="no dampers"):
        present_dampers([path])


@pytest.mark.parametrize(
    ("true_restitution", "clearance"), [(0.0, 1e-3), (0.0, float("inf")), (0.3, 1e-3), (0.6, 1e-3)]
)
def test_restitution_lies_within_its_bounds(tmp_path, true_restitution, clearance):
    sensor = {"sensitivity": 0.0102, "noise": 1.96e-4, "resonance": 30e3, "low_cutoff": 0.5}
    scene = rig.load("fig8-no-damper").replace(
        dampers=[{"body": 2, "mass_ratio": 0.08, "clearance": clearance, "restitution": true_restitution}],
        shaker={"kind": "force", "body": 1},
        test={"kind": "sine", "frequency": 49.5, "force": 2.6, "duration": 1.0},
        channels=[{"name": "body2", "at": "body 2", "accelerometer": sensor}, {"name": "force", "at": "shaker"}],
        recording={"display": False},
    )
    with daq.open(daq.record(scene, tmp_path / "a.mcap")) as rec:
        [window] = [marker for marker in rec.markers if marker.kind == "measure"]
        first, stop = window.first_sample, window.stop
        estimate = restitution(BodyMotion(rec, "body2", first, stop), scene.dampers[0])
    assert estimate is not None and estimate.error < 0.05
    assert abs(estimate.value - true_restitution) < 2.0 * estimate.error
