"""Fits of a scene to recordings: 95 % intervals of the parameters, misfits, and diagnosis of faulty channels."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import analysis
import daq
import rig
from analysis.commands.figures.fit_figure import fit_figure
from analysis.commands.presentation.fit_findings import describe
from analysis.core.fitting.diagnosis import _solve_from_both, _start_from_modes, _try_channels, find_cause
from analysis.core.fitting.estimate import Estimate, estimate_structure
from analysis.core.fitting.fit import Comparison, Fit, Fitted, Mode, _misfit, _missing_clock_tolerance
from analysis.core.fitting.identifiability import LevelDamping, describe_coupled_values
from analysis.core.fitting.measured import measured_curves
from analysis.core.fitting.parameters import free_parameters, with_ratio_per_mode, with_values
from analysis.core.fitting.problem import Problem
from rig.core.base.errors import RecordingError, SceneError
from tests.analysis.responses import synthetic

DEMO = Path(__file__).parents[3] / "recordings" / "demo-sweep-three-dampers.mcap"
FREQUENCIES = np.geomspace(9.0, 60.0, 60)


@cache
def curves_of_demo():
    with daq.open(DEMO) as recording:
        [curves] = measured_curves(recording, "demo")
    return curves


@pytest.fixture
def one_random_start(monkeypatch):
    """Search the structure from a single initial value if its modes lead to no solution, as with a faulty channel."""
    monkeypatch.setattr("analysis.core.fitting.estimate._RANDOM_STARTS", 1)


@pytest.fixture(scope="module")
def noisy_sweep(tmp_path_factory):
    """Return a function that records a sweep by sensors with this tolerance of their sensitivity, once for each."""

    @cache
    def record(tolerance="0"):
        infos = synthetic.channels(sensor={"accelerometer.sensitivity_tolerance": tolerance})
        path = tmp_path_factory.mktemp("sweep") / "a.mcap"
        return synthetic.stepped_sine(path, FREQUENCIES, noise=2e-7, infos=infos if tolerance != "0" else None)

    return record


def initial_scene(**changes):
    """Return the structure of the synthetic recordings, with errors of about 20 %."""
    structure = {
        "masses": [0.62, 0.83, 0.7], "springs": [28e3, 19e3, 21e3], "damping": {"modal": [0.004, 0.006, 0.007]},
    }  # fmt: skip
    return synthetic.scene().replace(structure=structure | changes, shaker=None, test=None)


def true_values():
    structure = with_ratio_per_mode(synthetic.scene()).structure
    return {"masses": structure.masses, "springs": structure.springs, "modal": structure.damping.modal}


def scene_with_wrong_masses():
    """Return the structure of the synthetic recordings with errors of about 20 % in the masses only."""
    return initial_scene(springs=true_values()["springs"], damping={"modal": true_values()["modal"]})


def relative_errors(result):
    """Return the relative error of each fitted parameter, by its key, such as structure.masses[1]."""
    errors = {}
    for parameter in result.parameters:
        quantity, index = parameter.key.split(".")[-1].rstrip("]").split("[")
        errors[parameter.key] = parameter.value / true_values()[quantity][int(index) - 1] - 1
    return errors


def test_every_fitted_value_lies_in_interval(noisy_sweep):
    result = analysis.fit(noisy_sweep(), initial_scene())
    assert not result.misfit
    assert {parameter.status for parameter in result.parameters} == {"determined"}
    for key, relative_error in relative_errors(result).items():
        assert abs(relative_error) <= result[key].half_width
        assert abs(relative_error) < 2e-3
    loaded = rig.loads(result.scene.to_yaml(), where="the fitted scene")
    assert loaded.structure == result.scene.structure


@pytest.mark.parametrize("masses", [[0.5, 1.0, 0.9], [0.45, 0.45, 0.9]])
def test_two_of_three_modes_determine_structure(masses, tmp_path):
    sparse_frequencies = [9.0, 10.0, 18.0, 22.0, 26.0, 42.0, 44.0, 58.0, 60.0]
    path = synthetic.stepped_sine(tmp_path / "a.mcap", sparse_frequencies, noise=2e-7)
    with daq.open(path) as recording:
        assert analysis.identify(analysis.frfs(recording), 3).frequency.size == 2
    result = analysis.fit(path, initial_scene(masses=masses))
    assert not result.misfit
    for key, relative_error in relative_errors(result).items():
        assert abs(relative_error) <= result[key].half_width


def test_sensor_tolerances_widen_masses(noisy_sweep):
    result = analysis.fit(noisy_sweep("0.05"), initial_scene())
    # The force is a difference of two readings: its error scales all masses and springs equally, and not the damping.
    assert 0.01 < result["structure.masses[1]"].half_width < 0.12
    assert result["structure.damping.modal[1]"].half_width < 0.005
    assert any("by the same factor" in line for line in result.together)


@pytest.mark.thorough
@pytest.mark.usefixtures("one_random_start")
def test_wrong_fixed_masses_give_misfit(noisy_sweep):
    with daq.open(noisy_sweep()) as recording:
        del recording.channels["body2"], recording.channels["body3"]
        result = analysis.fit(recording, initial_scene(), free=["structure.damping"])
    assert "leaves a residual of" in result.misfit
    assert "determined" not in {parameter.status for parameter in result.parameters}


@pytest.mark.thorough
@pytest.mark.usefixtures("one_random_start")
def test_reversed_channel_is_named_as_cause_of_misfit(noisy_sweep):
    with daq.open(noisy_sweep("0.02")) as recording:
        recording.channels["body2"] = replace(recording.channels["body2"], gain=-1.0)
        result = analysis.fit(recording, initial_scene())
    assert result.misfit == "The sign of body2 is reversed. If this is corrected, the scene fits."


@pytest.mark.thorough
@pytest.mark.usefixtures("one_random_start")
def test_error_above_tolerance_gives_misfit(noisy_sweep):
    # This error would explain the curves, but exceeds the tolerance of any sensor.
    with daq.open(noisy_sweep("0.01")) as recording:
        del recording.channels["body3"]
        recording.channels["body2"] = replace(recording.channels["body2"], gain=1 / 1.3)
        result = analysis.fit(recording, scene_with_wrong_masses(), free=["structure.masses"])
    assert {parameter.status for parameter in result.parameters} == {"roughly"}
    for text in (
        "would need an error of", "its tolerance is 1 %", "body2 reads 1.3 times", "may also differ from the scene"
    ):  # fmt: skip
        assert text in result.misfit


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("tolerance", "faults", "causes"),
    [
        ("0", {"body2": {"at": "body 3"}, "body3": {"at": "body 2"}}, ["body2 and body3 are swapped"]),
        # The analysis divides by the gain, so that the signal becomes too small by this factor.
        ("0.02", {"body2": {"gain": 9.80665}}, ["body2 reads 0.102 times", "(g read as m/s²)"]),
        ("0.02", {"body3": {"gain": 1 / 9.80665}}, ["body3 reads 9.807 times", "(m/s² read as g)"]),
        ("0", {"body1": {"gain": 2**0.5}}, ["body1 reads 0.7071 times", "(rms values, declared as amplitudes)"]),
        ("0.02", {"body2": {"quantity": "velocity"}}, ["body2: it is the integral of the stated quantity"]),
        ("0.02", {"body2": {"delay": 4e-3}}, ["body2 reads 4000 µs early"]),
        ("0.02", {"body2": {"delay": 9e-3}}, ["body2 contradicts the other channels"]),
    ],
    ids=["swapped", "g read as SI unit", "SI unit read as g", "rms value", "integral", "delayed", "far delayed"],
)
def test_faulty_channel_is_named(tolerance, faults, causes, noisy_sweep):
    with daq.open(noisy_sweep(tolerance)) as recording:
        for name, fault in faults.items():
            recording.channels[name] = replace(recording.channels[name], **fault)
        curves = measured_curves(recording, "a")
    model = scene_with_wrong_masses()
    problem = Problem(model, free_parameters(model, ["structure.masses"]), curves)
    is_explained, text = find_cause(problem, estimate_structure(problem, problem.groups))
    assert is_explained
    for cause in causes:
        assert cause in text


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["body1", "body2"])
def test_factor_is_named_among_two_responses(name, noisy_sweep):
    # Neither response alone determines the structure, so that no other sensors predict the readings of one.
    with daq.open(noisy_sweep("0.02")) as recording:
        del recording.channels["body3"]
        recording.channels[name] = replace(recording.channels[name], gain=1 / 9.80665)
        curves = measured_curves(recording, "a")
    model = initial_scene()
    problem = Problem(model, free_parameters(model), curves)
    _, text = find_cause(problem, estimate_structure(problem, problem.groups))
    assert f"{name} reads 9.807 times what the scene predicts (m/s² read as g)" in text


def test_better_fit_counts_not_smaller_initial_cost(monkeypatch):
    # The uncorrected fit starts nearer, but leads to a local minimum.
    local, best = SimpleNamespace(square=9.0), SimpleNamespace(square=1.0)
    restarted = SimpleNamespace(problem=None, cost=2.0, solved=lambda: local)
    monkeypatch.setattr(
        "analysis.core.fitting.diagnosis._start_from_modes",
        lambda problem: SimpleNamespace(cost=3.0, solved=lambda: best),
    )
    assert _solve_from_both(SimpleNamespace(with_curves=lambda curves: restarted), []) is best


def test_unit_of_force_is_named(tmp_path):
    with daq.open(synthetic.impulses(tmp_path / "a.mcap", noise=0.5)) as recording:
        # The analysis divides by the gain: the reading is in pounds, but is taken for newtons.
        recording.channels["hammer"] = replace(recording.channels["hammer"], gain=4.44822)
        curves = measured_curves(recording, "a")
    model = with_ratio_per_mode(synthetic.scene().replace(shaker=None, test=None))
    problem = Problem(model, free_parameters(model, ["structure.springs", "structure.damping"]), curves)
    explained = min(_try_channels(_start_from_modes(problem), curves), key=lambda explanation: explanation.square)
    assert explained.text == "hammer reads 0.2248 times what the scene predicts (values in pounds-force, declared as N)"


def test_failed_channel_is_omitted(tmp_path):
    force = synthetic.band_noise(20.0, 5.0, 60.0)
    marks = [("measure", 0, round(20.0 * synthetic.RATE) - 1, {"from": 5.0, "to": 60.0})]
    test = "{kind: random, from: 5 Hz, to: 60 Hz, duration: 20 s, force: 1 N}"
    path = synthetic.record_response(tmp_path / "a.mcap", force, test, marks, noise=1e-4)
    with daq.open(path) as recording:
        samples = {name: recording.read(name) for name in recording.channels}
        infos, scene = list(recording.channels.values()), recording.scene
    for failed_channels, expected_names in {"body2": ["body1", "body3"], "body1 body2 body3": []}.items():
        rows = np.stack([0.0 * row if name in failed_channels else row for name, row in samples.items()])
        synthetic.write(tmp_path / "b.mcap", scene, infos, rows, marks)
        with daq.open(tmp_path / "b.mcap") as recording:
            if expected_names:
                (curves,) = measured_curves(recording, "b")
                assert [sensor.name for sensor in curves.sensors] == expected_names
                assert "body2 is omitted: it reads zero throughout" in curves.warnings[0]
                continue
            with pytest.raises(RecordingError, match="responses are zero throughout"):
                measured_curves(recording, "b")


def test_channel_that_changes_during_sweep_is_named(tmp_path):
    with daq.open(synthetic.stepped_sine(tmp_path / "a.mcap", FREQUENCIES, noise=1e-8)) as recording:
        samples = recording.read("body2")
        samples[recording.samples // 2 :] *= 0.5
        read = recording.read
        recording.read = lambda name, *bounds: samples[slice(*bounds)] if name == "body2" else read(name, *bounds)
        (curves,) = measured_curves(recording, "a")
    assert any(text.startswith("body2: its gain changes by a factor of 0.5") for text in curves.warnings)


@pytest.mark.parametrize(
    ("level", "label"), [({"force": 2.6}, "a, 2.6 N up"), ({"drive": 2.6}, "a, level 2.6 up")], ids=["force", "drive"]
)
def test_only_force_levels_are_in_newtons(level, label, tmp_path):
    with daq.open(synthetic.stepped_sine(tmp_path / "a.mcap", FREQUENCIES)) as recording:
        for marker in recording.markers[::2]:
            marker.fields["direction"] = "down"
        test = {"kind": "stepped_sine", "from": 9.0, "to": 60.0, "points": 60, "direction": "both", **level}
        recording.scene = recording.scene.replace(test=test)
        assert label in [curves.label for curves in measured_curves(recording, "a")]


def test_dampers_with_hits_are_rejected(tmp_path):
    path = synthetic.impulses(tmp_path / "a.mcap")
    with daq.open(path) as recording:
        recording.scene = recording.scene.replace(dampers=({"body": 3, "mass_ratio": 0.1, "clearance": 1e-3},))
        with pytest.raises(RecordingError, match="stepped_sine"):
            analysis.fit(recording, initial_scene())


def test_scene_of_other_bodies_is_rejected(tmp_path):
    path = synthetic.stepped_sine(tmp_path / "a.mcap", FREQUENCIES[:9])
    two_bodies = initial_scene(masses=[0.7, 0.7], springs=[2e4, 2e4], damping={"modal": 0.01})
    with pytest.raises(SceneError, match="3 bodies; the scene to fit has 2"):
        analysis.fit(path, two_bodies)


def test_error_of_unknown_parameter_names_others():
    with pytest.raises(SceneError, match=r"dampers\.clearance.*structure\.masses"):
        free_parameters(initial_scene(), ["dampers.clearance"])


def test_inserted_values_leave_other_values_unchanged():
    scene = with_ratio_per_mode(rig.load("fig9"))
    parameters = free_parameters(scene)
    changed = with_values(
        scene, {parameter.key_path: 2.0 * parameter.start for parameter in parameters if parameter.quantity != "modal"}
    )
    assert changed.structure.masses == tuple(2.0 * m for m in scene.structure.masses)
    assert changed.dampers[0].clearance == 2.0 * scene.dampers[0].clearance
    assert changed.structure.damping == scene.structure.damping
    assert changed.shaker == scene.shaker


@pytest.mark.parametrize(("irregular", "regular", "is_misfit"), [(9, 2, False), (0, 6, True), (12, 0, True)])
def test_omitted_irregular_points_are_not_a_misfit(irregular, regular, is_misfit):
    curves = curves_of_demo()
    predicted, is_fitted = np.ones((3, 20), dtype=complex), np.ones(20, dtype=bool)
    predicted[:, :irregular], is_fitted[: irregular + regular] = np.nan, False
    compared = Comparison(curves, predicted, is_fitted, np.zeros((3, 20)), 0.0)
    misfit = _misfit(Estimate(np.zeros(1), np.eye(1), 1.0, 1), [compared])
    assert misfit == (
        f"demo: the scene does not reproduce the measured motion at {irregular + regular} of 20 points."
        if is_misfit
        else ""
    )


def test_missing_clock_tolerance_is_reported():
    modes = [Mode(30.5, 5e-6, 0.006, 1e-6)]
    [note] = _missing_clock_tolerance(SimpleNamespace(clock_tolerance=0.0), modes)  # type: ignore[arg-type]
    assert "±0.16 ppm" in note and "converter.clock_error" in note
    assert not _missing_clock_tolerance(SimpleNamespace(clock_tolerance=2e-5), modes)  # type: ignore[arg-type]


def test_omitted_points_are_drawn_as_crosses():
    is_fitted = np.array([True, True, False, True])
    value = np.full((1, 4), 1e-5 + 0j)
    demo = curves_of_demo()
    curves = replace(demo, frequency=np.arange(10.0, 14.0), value=value, sensors=demo.sensors[:1])
    result = SimpleNamespace(
        compared=[Comparison(curves, value, is_fitted, np.ones((1, 4)), 1.0)], scene=demo.scene, modes=()
    )
    axes = fit_figure(result).axes  # type: ignore[arg-type]
    assert axes[0].get_title(loc="left").startswith("Fit: Fig 8, dampers in all three bodies")
    assert axes[1].get_title(loc="left") == "Residual 100 % of the curve, rms, 1 point omitted"
    for ax in axes:
        crosses = [line for line in ax.lines if line.get_marker() == "x"]
        assert [np.isfinite(line.get_ydata()).tolist() for line in crosses] == [(~is_fitted).tolist()]


def test_fitted_curve_is_drawn_between_the_points():
    demo = curves_of_demo()
    linear = demo.scene.replace(dampers=())
    compared = Comparison(
        replace(demo, scene=linear), demo.value, np.ones(demo.frequency.size, bool), np.ones(demo.value.shape), 1.0
    )
    axes = fit_figure(SimpleNamespace(compared=[compared], scene=linear, modes=())).axes  # type: ignore[arg-type]
    assert axes[0].lines[-1].get_xdata().size > 1000


def test_undetermined_damping_is_described():
    level = LevelDamping("a.mcap", False, 1.0, ("x", "y"), np.array([0.01, np.nan]), np.array([1e-4, np.nan]))
    parameter = Fitted("structure.damping.modal[1]", "", 0.01, 0.01, 0.0099, 0.0101, "determined")
    result = Fit(
        rig.load("fig9"), (parameter,), np.eye(1), {}, (), (level,), (), 1.0, "", (), ()
    )  # fmt: skip
    [row] = [line for line in describe(result) if "a.mcap" in line]
    assert row.endswith("0.01000 ± 0.00010, undetermined")


def test_mass_of_named_body_has_name_and_number():
    structure = {"masses": {"base": 4.2, "arm": 1.1}, "springs": [8e5, 9e5], "damping": {"modal": 0.01}}
    scene = rig.load("fig9").replace(structure=structure, dampers=(), shaker=None, test=None, channels=None)
    parameter = Fitted("structure.masses.arm", "kg", 1.1, 1.1, 1.0, 1.2, "determined")
    result = Fit(scene, (parameter,), np.eye(1), {}, (), (), (), 1.0, "", (), ())
    assert result["structure.masses[2]"] is result["structure.masses.arm"] is parameter
    for number in (1, 4):
        with pytest.raises(SceneError, match=rf"masses\[{number}\]' in the fit. Give one of structure\.masses\[2\]\."):
            result[f"structure.masses[{number}]"]


def test_clearance_without_ceiling_impacts_has_one_line():
    clearances = [SimpleNamespace(key=f"dampers[{k}].clearance", damper=k) for k in range(2)]
    problem = SimpleNamespace(parameters=clearances, groups=[SimpleNamespace(orbits=object())])
    limited, unlimited = describe_coupled_values(problem, None, ["undetermined"] * 2, {0: 1.5e-3})
    assert "dampers[0].clearance is at least 1.5 mm" in limited
    assert "dampers[1].clearance is not determined" in unlimited
