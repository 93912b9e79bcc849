"""The work-precision study (`rig cost`): exact reference, convergence of other methods, and written results."""

import csv
from decimal import Decimal
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from mpmath import mp, mpf

import rig
from rig.core.base.errors import RunError, SceneError
from rig.core.system.assembly import assemble
from rig.core.system.open_loop_drive import tone_drive, with_ideal_force
from rig.core.system.structural_model import receptance
from rig.studies.cost.adaptive_solvers import GUARD_PAUSE_S, integrate, penalty, scipy_solver
from rig.studies.cost.compiled_runge_kutta import DormandPrince
from rig.studies.cost.cost import Cost
from rig.studies.cost.first_order_form import SAMPLES_PER_PERIOD, FirstOrderForm
from rig.studies.cost.high_precision import ExactOrbit, exact_motion, exact_orbit
from rig.studies.cost.moreau_jean import moreau_jean
from rig.studies.cost.motion_study import MotionStudy, Point, _compiled, default_frequency, failure_reason, motion_study
from rig.studies.cost.steady_study import SteadyStudy, _approximate, steady_study
from tests.rig.engine.exact import Segment

PERIODS = 12
#: Reference case B: the problem, its exact displacements, and the simulation by the engine.
CaseB = tuple[FirstOrderForm, np.ndarray, rig.Run]


@pytest.fixture(autouse=True)
def each_method_is_measured_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rig.studies.cost.motion_study.MIN_MEASURED_CPU_S", 0.0)


@pytest.fixture(scope="module")
def case() -> CaseB:
    """Compute reference case B by the engine and exactly."""
    scene = rig.load("reference-B")
    system = assemble(scene)
    tone = tone_drive(scene, system)
    run = rig.simulate(scene, PERIODS / tone.frequency, SAMPLES_PER_PERIOD * tone.frequency)
    exact = exact_motion(system, tone, run, SAMPLES_PER_PERIOD)
    assert exact.agreement < 1e-20
    return FirstOrderForm(system, tone, PERIODS), exact.displacement, run


def error(outcome: object, exact: np.ndarray) -> float:
    """Return the largest error of the displacements, relative to the largest displacement."""
    true = exact.astype(float)
    return float(np.abs(outcome.displacement - true).max() / np.abs(true).max())


def test_reference_agrees_to_thirty_digits(case: CaseB) -> None:
    _, exact, run = case
    scene = run.scene
    on_floor = Segment(scene, (0,))
    # Replace the rounded w of the segment with the exact 2 pi f of the reference.
    omega = 2 * mp.pi * mpf(scene.test.frequency)
    size = 2 * on_floor.n
    on_floor.generator[size, size + 1], on_floor.generator[size + 1, size] = -omega, omega
    sample = int(np.searchsorted(run.time, run.events["time"][0])) - 1
    state = on_floor.propagate(on_floor.initial_state(), mpf(sample) / (SAMPLES_PER_PERIOD * mpf(scene.test.frequency)))
    for body in range(3):
        assert abs(mpf(str(exact[body, sample])) / state[body] - 1) < mpf("1e-30")


def test_engine_is_exact_to_rounding(case: CaseB) -> None:
    _, exact, run = case
    values = np.vectorize(Decimal, otypes=[object])(run.displacement)
    assert np.abs(values - exact).max() / np.abs(exact).max() < 1e-13


@pytest.mark.parametrize(("scheme", "settings"), [(penalty, (30, 600)), (moreau_jean, (320, 6400))])
def test_error_decreases_with_the_step(scheme: object, settings: tuple[int, int], case: CaseB) -> None:
    problem, exact, _ = case
    coarse, fine = (error(scheme(problem, steps), exact) for steps in settings)
    assert fine < 0.2 * coarse
    assert fine < 2e-3


def test_scipy_locates_events_at_its_tolerance(case: CaseB) -> None:
    problem, exact, run = case
    outcome = integrate(problem, scipy_solver("DOP853", 1e-9, np.inf), GUARD_PAUSE_S, 60.0)
    assert [kind for _, _, kind in outcome.events] == list(run.events["kind"])
    assert error(outcome, exact) < 1e-6


@pytest.mark.parametrize(("rtol", "allowed"), [(1e-6, 1e-3), (1e-9, 1e-6), (1e-12, 1e-9)])
def test_compiled_solver_locates_events_at_its_tolerance(case: CaseB, rtol: float, allowed: float) -> None:
    problem, exact, run = case
    outcome = DormandPrince(problem).integrate(rtol, GUARD_PAUSE_S, np.inf)
    assert [kind for _, _, kind in outcome.events] == list(run.events["kind"])
    np.testing.assert_allclose([t for t, _, _ in outcome.events], run.events["time"], rtol=0, atol=allowed)
    assert error(outcome, exact) < allowed


@pytest.mark.thorough
def test_simulation_converges_to_the_orbit(monkeypatch: pytest.MonkeyPatch) -> None:
    def reject(*_: object, **__: object) -> None:
        raise SceneError("not computed")

    # Without the approximate method, which takes most of the time.
    monkeypatch.setattr("rig.studies.cost.steady_study.approximate_response", reject)
    study = steady_study(rig.load("fig9").replace(converter={}, channels=None), 49.6)
    errors = [point.error for point in study.points if point.method == "time integration"]
    assert study.motion_type == "II"
    assert errors[0] > errors[2] > errors[-1]
    assert errors[-1] < 1e-9


def test_engine_is_exact_with_mixed_contacts() -> None:
    scene = rig.load("fig8-two-dampers")
    dampers = [scene.dampers[0], scene.dampers[1].replace(contact={"duration": 3e-3}), *scene.dampers[2:]]
    study = motion_study(scene.replace(dampers=dampers), 34.5, periods=4)
    assert study.points[0].is_correct
    assert study.points[0].error < 1e-12


def test_exact_motion_contains_rebounds_that_end_in_rest() -> None:
    scene = rig.load("reference-B")
    scene = scene.replace(dampers=[damper.replace(restitution=0.4) for damper in scene.dampers])
    system = assemble(scene)
    tone = tone_drive(scene, system)
    run = rig.simulate(scene, 8 / tone.frequency, SAMPLES_PER_PERIOD * tone.frequency)
    exact = exact_motion(system, tone, run, SAMPLES_PER_PERIOD)
    rebounds = np.flatnonzero(run.events["kind"] == "floor")
    assert run.events["speed"][rebounds].min() < 1e-8 and run.events["kind"][-1] != "separation"
    np.testing.assert_allclose(run.events["time"], exact.event_time.astype(float), rtol=0.0, atol=1e-14)


def test_masses_on_springs_are_not_computed_as_beds() -> None:
    study = motion_study(rig.load("impact-damper-on-spring"), 13.2, periods=1)
    assert {point.method for point in study.points} >= {"engine, tone", "scipy DOP853"}
    assert all(point.is_correct for point in study.points if point.method.startswith("engine, tone"))


@pytest.mark.parametrize(
    ("name", "frequency", "kinds"),
    [
        ("stop", 13.2, {"touch", "release"}),
        ("friction-joint", 13.2, {"slip", "stop"}),
        ("friction-damper", 13.2, {"slip", "stop"}),
        ("impact-damper-on-spring", 13.2, {"floor", "ceiling"}),
    ],
)
def test_general_solver_locates_events_of_each_law(name: str, frequency: float, kinds: set[str]) -> None:
    scene, periods = rig.load(name), 22
    system = assemble(scene)
    tone = tone_drive(scene, system, frequency)
    run = rig.simulate(scene, periods / frequency, SAMPLES_PER_PERIOD * frequency, frequency=frequency)
    exact = exact_motion(system, tone, run, SAMPLES_PER_PERIOD)
    assert exact.agreement < 1e-20 and set(run.events["kind"]) == kinds
    assert error(run, exact.displacement) < 1e-13
    problem = FirstOrderForm(system, tone, periods)
    outcome = integrate(problem, scipy_solver("DOP853", 1e-12, np.inf), GUARD_PAUSE_S, 60.0)
    assert [kind for _, _, kind in outcome.events] == list(run.events["kind"])
    assert error(outcome, exact.displacement) < 1e-9


@pytest.mark.parametrize(
    ("name", "force", "frequency", "motion", "contact"),
    [
        ("fig9", 3.3, 49.6, "II", {}),
        ("fig5-three-dampers", 8.0, 50.0, "I/II/III", {}),
        ("fig9", 3.3, 49.7, "II", {"duration": 4e-3}),
        ("fig9", 3.3, 49.7, "II", {"stiffness": 1.8e3, "damping": 17.0}),
        ("stop", 2.0, 13.5, "1 per 1", {}),
        ("friction-joint", 1.0, 13.3, "2 slips per 1", {}),
        ("friction-damper", 0.4, 13.0, "2 slips per 1", {}),
        ("impact-damper-on-spring", 2.0, 12.6, "II", {}),
    ],
)
def test_exact_orbit_confirms_each_law(name, force, frequency, motion, contact):
    scene = rig.load(name)
    changed = {"dampers": [each.replace(contact=contact) for each in scene.dampers]} if contact else {}
    scene = with_ideal_force(scene.replace(test=scene.test.replace(force=force), **changed))
    orbit = rig.periodic_orbit(scene, frequency)
    exact = exact_orbit(scene, orbit)
    assert orbit.motion_type == motion and len(orbit.events) > 1
    assert exact.residual < 1e-33 and exact.agreement < 1e-22
    assert exact.error(orbit.compliance) < 1e-12


def test_exact_orbit_without_damper_is_linear() -> None:
    scene = rig.load("fig8-no-damper")
    exact = exact_orbit(with_ideal_force(scene), rig.periodic_orbit(scene, 34.8))
    assert exact.error(receptance(scene, [34.8])[:, 0]) < 1e-12


def test_compliance_of_driven_table_refers_to_spring_force() -> None:
    scene = rig.loads(
        "structure: {masses: [1 kg], springs: [20 kN/m], damping: {modal: 5 %}}\n"
        "dampers: [{body: 1, mass_ratio: 10 %, clearance: .inf}]\n"
        "shaker: {kind: table, body: 1, spring: 5 kN/m}\n"
        "test: {kind: sine, frequency: 24 Hz, drive: 0.5 mm}\n"
    )
    orbit = rig.periodic_orbit(scene, 24.0)
    exact = exact_orbit(scene, orbit)
    assert exact.agreement < 1e-20
    assert exact.error(orbit.compliance) < 1e-12


def test_irregular_motion_uses_a_nearby_frequency() -> None:
    study = steady_study(rig.load("fig8-three-dampers"), 33.1275)
    # Frequencies within 8 % are tried.
    assert 0.0 < abs(study.frequency / 33.1275 - 1.0) < 0.081
    assert study.points and study.motion_type


def test_default_frequency_is_a_resonance() -> None:
    scene = rig.load("fig9")
    assert default_frequency(scene, assemble(scene)) == pytest.approx(49.0, abs=1.0)


def test_cost_without_shaker_is_rejected() -> None:
    scene = rig.load("fig10b-three-dampers")
    without_shaker = scene.replace(shaker=None)
    with pytest.raises(SceneError, match="no shaker"):
        default_frequency(without_shaker, assemble(without_shaker))


def test_failed_solver_is_listed(case: CaseB, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise RunError("too many events at one instant")

    monkeypatch.setattr(DormandPrince, "integrate", fail)
    assert {name for name, _, _ in _compiled(case[0], 0.02)} == {"compiled DP5"}


def test_approximate_method_rejects_restitution() -> None:
    scene = rig.load("fig9", {"dampers[1].restitution": 0.2})
    # The error is raised before any comparison with the exact orbit.
    point = _approximate(scene, 49.7, cast(ExactOrbit, None))
    assert point.note.startswith("not applicable: damper in body 2: restitution 0.2")


def test_table_and_file_report_a_failure(tmp_path: Path) -> None:
    points = (
        Point("engine, tone", "warm", 1e-6, 1e-15, float("nan"), True),
        Point("scipy LSODA", "rtol 1e-09", *[float("nan")] * 3, False, failure_reason(RunError("takes too long"))),
    )
    study = MotionStudy(rig.load("reference-B"), 49.7, 20, 37, points, "forty digits", 1e9)
    steady = SteadyStudy((), 49.7, "", "no steady state")
    cost = Cost(study.scene, study, steady)
    files = cost.write(tmp_path / "new")
    assert [file.suffix for file in files] == [".png", ".svg", ".csv"]
    assert all(file.stat().st_size > 0 for file in files)
    with files[2].open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert rows[1]["note"] == "failed: takes too long" and rows[1]["error"] == "nan"
    assert "failed: takes too long" in str(cost)
    assert "The engine computes a period in 0.001 ms (relative error 1e-15)." in str(cost)
