"""Designed dampers are optimal, achieve the predicted effect on the rig, and can be reproduced.

The objective is what a design optimizes: structures, force levels and band. A choice is the dampers of a candidate
design (bodies, masses in kg, clearances in m); a trial is a choice with its peaks (compliance |X| / F, m/N). The
table is a file of computed trials, from which an interrupted design continues.
"""

import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

import analysis
import daq
import rig
from rig.core.base.errors import SceneError
from rig.core.base.figure_style import new_figure
from rig.core.base.workers import Workers
from rig.core.orbits.problem import OrbitProblem
from rig.core.scene.damper import Damper
from rig.core.system.open_loop_drive import level_of, with_ideal_force
from rig.core.system.structural_model import receptance
from rig.studies.design.check import Expected
from rig.studies.design.check_text import describe_check
from rig.studies.design.choice import FINE_DENSITY, INSTANTANEOUS, Choice
from rig.studies.design.design import chart_levels
from rig.studies.design.evaluator import Evaluator
from rig.studies.design.figure import _draw_responses, clearance_label, level_style, write
from rig.studies.design.grain_check import grain_check
from rig.studies.design.request import mass_limit, parse_request
from rig.studies.design.summary import summary
from rig.studies.design.worst_peak import Peak, response_at_level
from tests.rig.this_process import pieces_in_this_process, reduce_chart_and_check


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("design") / "table.csv"


def _design_with_small_chart(table: Path) -> rig.Design:
    with pieces_in_this_process() as patch:
        reduce_chart_and_check(patch, points_per_peak=13)
        return rig.design("fig9", bodies=[2], levels=[3.3], watched=[2], table=table)


@pytest.fixture(scope="module")
def design(table: Path) -> rig.Design:
    return _design_with_small_chart(table)


@pytest.mark.thorough
def test_design_matches_a_fine_clearance_grid(design: rig.Design) -> None:
    objective = replace(design.question, density=FINE_DENSITY)
    clearances = np.geomspace(0.5, 2.0, 13) * design.best.choice.clearances[0]
    trial_peaks = [objective.worst(replace(design.best.choice, clearances=(c,))).magnitude for c in clearances]
    assert design.best.peak.magnitude < 1.01 * min(trial_peaks)


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore:.*steady state:daq.RunWarning")
def test_recorded_design_moves_as_predicted(design: rig.Design, tmp_path: Path) -> None:
    daq.record(design.scene, tmp_path / "check.mcap")
    with daq.open(tmp_path / "check.mcap") as recording:
        measured = analysis.compliance(recording, "body2")
    problem = OrbitProblem(with_ideal_force(design.scene.replace(channels=None)))
    predicted = response_at_level(problem, design.best.peak.level, measured.frequency).compliance[1]
    assert measured.unsteady is not None and measured.unsteady.mean() < 0.3
    decibels = 20 * np.log10(np.abs(measured.value / predicted))[~measured.unsteady]
    assert np.abs(decibels).max() < 0.3
    for expectation in design.expected:
        if expectation.magnitudes is not None:
            peak_index = int(np.argmin(abs(measured.frequency - expectation.peak.frequency)))
            measured_peak, bound = abs(measured.value[peak_index]), measured.bound()[peak_index]
            assert expectation.magnitudes[0] - bound < measured_peak < expectation.compliances[2] + bound


@pytest.mark.thorough
def test_second_design_reads_all_trials_from_table(design: rig.Design, table: Path) -> None:
    written = table.read_bytes()
    # A process that is killed during writing may leave a partial row like this.
    table.write_bytes(written + b"3dfa,2,0.1")
    second_design = _design_with_small_chart(table)
    assert second_design.best == design.best and second_design.chart == design.chart
    assert second_design.trials == design.trials and table.read_bytes() == written


@pytest.mark.thorough
def test_written_scene_loads_and_summary_matches(design: rig.Design, tmp_path: Path) -> None:
    scene, picture, drawing = write(design, tmp_path)
    assert rig.load(str(scene)).dampers == design.scene.dampers
    assert picture.stat().st_size > 10_000 and drawing.stat().st_size > 10_000
    assert repr(design).startswith("<Design: ") and design.plot().get_legend() is not None
    assert f"clearance {1e3 * design.best.choice.clearances[0]:.3g} mm" in summary(design)
    commands = [shlex.split(line) for line in describe_check(design, scene).splitlines() if line.startswith("daq")]
    assert [command[:3] for command in commands] == [["daq", "record", str(scene)]] * 2
    assert "dampers=null" in commands[0] and "dampers=null" not in commands[1]
    unsteady = replace(design, expected=tuple(replace(expectation, magnitudes=None) for expectation in design.expected))
    assert "no steady state, so measured values scatter" in describe_check(unsteady, scene)


@pytest.mark.thorough
def test_large_peaks_have_separate_columns(design: rig.Design) -> None:
    modes = [
        replace(
            mode,
            undamped=replace(mode.undamped, magnitude=0.51234),
            damped=tuple(replace(peak, magnitude=0.41234) for peak in mode.damped),
        )
        for mode in design.modes
    ]
    lines = summary(replace(design, modes=tuple(modes))).splitlines()
    [row] = [line for line in lines if line.lstrip().startswith(f"{modes[0].frequency:.2f}")]
    assert row.split()[1:3] == ["5.123e+05", "4.123e+05"]


def test_lower_expected_peak_is_explained(design: rig.Design, tmp_path: Path) -> None:
    expected = tuple(replace(expectation, magnitudes=(1e-6, 1.1e-6, 1.2e-6)) for expectation in design.expected)
    explanation = "several steady-state motions may exist"
    assert explanation in describe_check(replace(design, expected=expected), tmp_path / "scene.yaml")
    assert explanation not in describe_check(design, tmp_path / "scene.yaml")


@pytest.mark.thorough
def test_summary_has_a_column_per_level(design: rig.Design) -> None:
    two_levels = replace(design.question, levels=(3.3, 6.6))
    trials = tuple(replace(trial, peaks=(trial.peak, replace(trial.peak, magnitude=1e-5))) for trial in design.trials)
    lines = summary(replace(design, question=two_levels, trials=trials, best=trials[0])).splitlines()
    heading = next(line for line in lines if "added mass" in line)
    assert heading.split()[3:7] == ["3.3", "N", "6.6", "N"]


def test_damaged_table_loses_no_trial(tmp_path: Path) -> None:
    table = tmp_path / "table.csv"
    objective, _ = parse_request(rig.load("fig9"), bodies=[2], levels=[0.5], band=(49.0, 50.0), watched=[2])
    choices = [Choice((2,), (0.05,), (clearance,)) for clearance in (1e-3, 2e-3)]
    with Workers() as workers:
        first_trials = Evaluator(workers, table, None, 1).compute(objective, choices[:1])
        with table.open("a") as file:
            # An open quote ends with its line, and lines that are too long are not read.
            file.write('"' + "x" * 200_000 + "\n" + '"torn,2,0.1')
        second_trials = Evaluator(workers, table, None, 1).compute(objective, choices[1:])
        evaluator = Evaluator(workers, table, None, 1)
    assert [evaluator.trial(objective, choice) for choice in choices] == first_trials + second_trials


def test_drawing_shows_clearance_of_heaviest_damper() -> None:
    assert "in body 4 / mm" in clearance_label(Choice((3, 4), (0.01, 0.06), (8e-3, 7e-3)))


def test_levels_have_different_styles() -> None:
    assert len({level_style(number) for number in range(60)}) == 60


@pytest.mark.thorough
def test_drawn_response_with_dampers_reaches_the_peak(design: rig.Design) -> None:
    with new_figure(3.0) as figure:
        axes = figure.subplots()
        _draw_responses(axes, design)
    _, response, peak, *_ = axes.lines
    assert max(response.get_ydata()) == pytest.approx(max(peak.get_ydata()), rel=0.02)


@pytest.mark.thorough
def test_drawn_responses_are_those_of_watched_bodies(design: rig.Design) -> None:
    watched = replace(design.question, bodies=(1,))
    with new_figure(3.0) as figure:
        axes = figure.subplots()
        _draw_responses(axes, replace(design, question=watched))
    bare, *_ = axes.lines
    assert max(bare.get_ydata()) == pytest.approx(1e6 * watched.bare_peak.magnitude, rel=1e-3)


@given(levels=st.lists(st.floats(0.1, 50.0), min_size=1, max_size=5, unique=True).map(sorted))
def test_charted_levels_extend_beyond_requested_levels(levels: list[float]) -> None:
    charted = chart_levels(levels)
    assert set(levels) <= set(charted.tolist())
    assert charted[0] <= levels[0] / 2 * (1 + 1e-12) and charted[-1] >= levels[-1] * 2 * (1 - 1e-12)
    assert np.all(charted[1:] / charted[:-1] < 2.0**0.76)


def test_drive_test_uses_forces_as_levels() -> None:
    drive = {"kind": "stepped_sine", "from": "46 Hz", "to": "54 Hz", "points": 9, "drive": "1 mm"}
    changes = {"shaker": {"kind": "table", "body": 1, "spring": "6.6 kN/m"}, "test": drive}
    driven_scene, requested = rig.load("fig9", changes), {"bodies": [2], "levels": ["3.3 N"]}
    objective, _ = parse_request(driven_scene, **requested)
    choice = Choice((2,), (0.1,), (1e-3,))
    assert objective.worst(choice) == parse_request(rig.load("fig9"), **requested)[0].worst(choice)
    with pytest.raises(SceneError, match="levels: not given, and the scene's test specifies a drive instead"):
        parse_request(driven_scene)


def test_worst_peak_without_dampers_is_the_receptance() -> None:
    objective, _ = parse_request(rig.load("fig9"))
    frequencies = np.linspace(49.4, 49.9, 2001)
    exact = np.abs(receptance(rig.load("fig9"), frequencies)).max()
    assert objective.bare_peak.magnitude == pytest.approx(exact, rel=1e-5)


def test_least_damped_variant_determines_the_peak() -> None:
    # The damping ratios are uncertain by 20 %: the variants have 80 % and 120 %.
    objective, _ = parse_request(rig.load("fig9"), uncertain=(0.2, 0.0))
    certain_objective, _ = parse_request(rig.load("fig9"))
    assert len(objective.scenes) == 3
    assert objective.bare_peak.magnitude == pytest.approx(certain_objective.bare_peak.magnitude / 0.8, rel=1e-2)


def test_body_named_twice_has_two_dampers() -> None:
    objective, space = parse_request(rig.load("fig9"), bodies=[2, 1, 2], dampers=2, levels=[3.3], watched=[2, 2])
    assert (space.locations, objective.bodies) == (((1,), (2,), (1, 2), (2, 2)), (2,))


def test_peak_of_two_dampers_equals_simulation() -> None:
    objective, _ = parse_request(rig.load("fig9"), levels=[3.3], band=(48.5, 50.5), watched=[2])
    choice = Choice((2, 3), (0.06, 0.04), (1e-3, 1.1e-3))
    peak = objective.worst(choice)
    scene = objective.scenes[0].replace(dampers=choice.dampers(INSTANTANEOUS))
    compliance = np.abs(rig.frequency_response(scene, np.linspace(48.5, 50.5, 31)).compliance[1])
    assert peak.magnitude == pytest.approx(compliance.max(), rel=0.01)


@pytest.mark.parametrize(
    ("requested", "message"),
    [
        ({"budget": 5.0}, "less than the structure.s mass, 2.09 kg"),
        ({"budget": "0.12"}, "expected a mass such as .50 g., or a percentage"),
        ({"bodies": ["1", "7"]}, "bodies: body 7 does not exist; expected 1 to 3"),
        ({"dampers": 4}, "expected 1 to 3, at most one for each body listed in bodies"),
        ({"band": (2.0, 3.0)}, "expected a band that contains a natural frequency"),
        ({"levels": [-1.0]}, r"levels: got -1\.0; expected one or more positive"),
        ({"clearance": (2e-3, 1e-3)}, "the smaller value first"),
        ({"band": 49.0}, "band: got 49 Hz; expected two values"),
        ({"uncertain": (2.0, 0.0)}, "relative uncertainties, of damping and stiffness"),
        ({"cluster": "nonsense://"}, "no Dask scheduler answers"),
    ],
)
def test_invalid_requests_are_rejected(requested: dict, message: str) -> None:
    with pytest.raises(SceneError, match=message):
        rig.design("fig9", **requested)


def test_structures_with_joints_are_rejected() -> None:
    with pytest.raises(SceneError, match=r"joints: .* depends on the level"):
        parse_request(rig.load("stop"))


def test_quantities_with_units_are_accepted() -> None:
    scene = rig.load("fig9")
    objective, space = parse_request(
        scene, budget="5 %", bodies=["1", "3"], clearance=["1 mm", 2e-3], levels=["3 N", "1 N"], uncertain=["20 %", 0.0]
    )
    assert space.max_mass == pytest.approx(0.1045) and mass_limit("50 g", scene) == pytest.approx(0.05)
    assert (space.locations, space.clearance, objective.levels) == (((1,), (3,)), (1e-3, 2e-3), (1.0, 3.0))
    with pytest.raises(SceneError, match="band: got '40 Hz'; expected two"):
        parse_request(scene, band=["40 Hz"])


def test_grain_command_has_dampers_of_the_design() -> None:
    # The printed command simulates the design with beds of grains instead of masses, at the highest level.
    dampers = [
        Damper(body=2, mass=0.04, clearance=1e-3, contact={"duration": "2 ms"}),
        Damper(body=3, mass=0.5, clearance=2e-3, restitution=0.3),
    ]
    peaks = [
        Expected(Peak(compliance, 49.0, level, 2, 1.0, 0.0), None, ())
        for compliance, level in ((1e-4, 2.0), (2e-4, 4.0))
    ]
    *_, command = grain_check(dampers, peaks, Path("a folder/check.yaml"))
    arguments = shlex.split(command)
    assert arguments[:3] == ["rig", "grains", "a folder/check.yaml"]
    changes = [arguments[k + 1].split("=", 1) for k, argument in enumerate(arguments) if argument == "--set"]
    grain_scene = rig.load("fig9", {key: yaml.safe_load(value) for key, value in changes})
    for damper, grain_damper in zip(dampers, grain_scene.dampers, strict=True):
        assert (grain_damper.body, grain_damper.mass, grain_damper.clearance) == pytest.approx(
            (damper.body, damper.mass, damper.clearance)
        )
        assert grain_damper.grains is not None and grain_damper.grains.diameter == 2e-3
    assert grain_scene.test is not None and level_of(grain_scene) == 4.0


def test_design_on_shaker_table_lowers_transmissibility() -> None:
    with pieces_in_this_process() as patch:
        reduce_chart_and_check(patch, points_per_peak=3)
        design = rig.design("shaker-table", bodies=[3], watched=[3], levels=["3 m/s^2"])
    (expectation,), peak = design.expected, design.best.peak

    measured = rig.frequency_response(design.scene, [peak.frequency])

    assert design.bare.magnitude > 2.0 * peak.magnitude
    assert abs(measured.frf[2, 0]) == pytest.approx(peak.magnitude, rel=2e-3)
    assert peak.acceleration == pytest.approx(3.0 * peak.magnitude, rel=5e-3)
    assert "m/m" in summary(design) and "test.drive=3m/s^2" in describe_check(design, Path("rack.yaml"))
    assert expectation.magnitudes is not None and expectation.magnitudes[1] == pytest.approx(peak.magnitude, rel=2e-3)
