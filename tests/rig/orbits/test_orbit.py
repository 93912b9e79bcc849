"""Periodic orbits, compared with the engine, finite differences, steady simulation and the single-mode method.

An orbit is the exact periodic motion at a frequency, from shooting. Its attributes:

- `repetition`: periods of the drive in a cycle; `plan`: sequence of contact events in a cycle;
- `unknowns`: state at the start of the cycle, heights and velocities of dampers in flight, and event times;
- `multipliers` (Floquet): factors by which disturbances change over a cycle;
- `flaw`: reason why the motion is impossible, or empty.

A branch is a curve of orbits with the same plan. At a border the plan becomes impossible; `margin` is the distance of
an orbit from the nearest border.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import rig
from rig.core.base.errors import RunError, SceneError
from rig.core.engine.propagator import Propagator
from rig.core.laws.events import CEILING_IMPACT, FLOOR_IMPACT, SEPARATION
from rig.core.orbits.branches import OrbitCurve, follow_orbits
from rig.core.orbits.orbit import Orbit
from rig.core.orbits.periodic_orbit import period_steps, periodic_orbit, set_to_orbit, simulate_cycle, start_propagator
from rig.core.orbits.problem import OrbitProblem, Parameter
from rig.core.scene.scene import Scene
from rig.core.system.open_loop_drive import with_ideal_force
from rig.core.system.structural_model import structure_matrices
from rig.studies.cost.high_precision import exact_orbit
from rig.studies.single_mode.approximate_response import Approximation, follow_mode
from rig.studies.single_mode.reduction import SingleMode, single_mode
from tests.rig.orbits.scenes import driven_table_scene, finite_contact_scene, scene_with


@cache
def fig9_curve() -> OrbitCurve:
    return follow_orbits(rig.load("fig9"), "frequency", (48.5, 51.3), searches=2)


def propagator_on_orbit(scene: Scene, orbit: Orbit) -> tuple[Propagator, float]:
    """Return the engine in the state of an orbit, and the number of its time steps in a period."""
    propagator, steps = start_propagator(OrbitProblem(scene), orbit.operating_point)
    set_to_orbit(propagator, orbit)
    return propagator, steps


def coupled_scene(coupling: float) -> Scene:
    """Return a scene with two dampers; `coupling`: mass matrix element between neighboring bodies, kg."""
    mass, damping, stiffness = structure_matrices(rig.load("fig9").structure)
    mass[[0, 1, 1, 2], [1, 0, 2, 1]] = coupling
    matrices = {"mass": mass.tolist(), "stiffness": stiffness.tolist(), "damping": damping.tolist()}
    dampers = [{"body": body, "mass_ratio": 0.1, "clearance": 1e-3} for body in (1, 2)]
    scene = scene_with("fig9", 10.0, 0.1, 1e-3)
    return scene.replace(structure={"matrices": matrices}, dampers=dampers)


DIFFERENT_WALLS = {"floor": {"stiffness": 1e5, "damping": 300.0}, "ceiling": {"stiffness": 4e4, "damping": 60.0}}
# Name: scene and frequency, Hz.
CASES = {
    "fig9": (rig.load("fig9"), 49.7),
    "fig9, stay at the ceiling": (rig.load("fig9"), 49.1),
    "fig9, at rest": (rig.load("fig9"), 46.5),
    "fig8 three": (rig.load("fig8-three-dampers"), 34.5),
    "fig5 three": (rig.load("fig5-three-dampers"), 49.5),
    "light damper": (scene_with("fig9", 5.0, 0.02, 1.6e-3), 50.0),
    "heavy damper": (scene_with("fig9", 12.0, 0.25, 0.6e-3), 48.5),
    "two dampers": (scene_with("fig8-two-dampers", 5.0, 0.07, 1.2e-3), 48.0),
    "one rebound": (scene_with("fig5-single-damper", 5.0, 0.1, 1.5e-3, 0.6), 49.5),
    "several rebounds": (scene_with("fig5-single-damper", 20.0, 0.1, 4e-3, 0.3), 47.5),
    "no gravity": (scene_with("fig5-single-damper", 20.0, 0.1, 4e-3, 0.1).replace(gravity=0.0), 49.5),
    "no gravity, no rebound": (scene_with("fig9", 20.0, 0.1, 4e-4).replace(gravity=0.0), 49.5),
    "driven table": (driven_table_scene(), 51.0),
    "coupled mass matrix": (coupled_scene(-0.05), 46.5),
    "finite contact": (finite_contact_scene("fig9", {"duration": 1e-3}), 49.1),
    "long contact": (finite_contact_scene("fig9", {"duration": 8e-3}), 49.7),
    "finite contact with rebound": (finite_contact_scene("fig9", {"duration": 3e-3}, restitution=0.5), 49.7),
    "different walls": (finite_contact_scene("fig9", DIFFERENT_WALLS), 49.7),
    "three finite contacts": (finite_contact_scene("fig8-three-dampers", {"duration": 2e-3}), 34.5),
    "one of two contacts finite": (finite_contact_scene("fig8-two-dampers", {"duration": 2e-3}, only_last=True), 48.0),
}
each_case = pytest.mark.parametrize(("scene", "frequency"), CASES.values(), ids=CASES)


@each_case
def test_engine_returns_to_the_orbit_after_a_period(scene: Scene, frequency: float) -> None:
    orbit = periodic_orbit(scene, frequency)

    propagator, steps = propagator_on_orbit(scene, orbit)
    plan, unknowns = simulate_cycle(propagator, steps, orbit.repetition)

    coordinates, states = propagator.system.coordinates, propagator.system.states
    end = propagator.state.z[:states]
    error = np.abs(end[: 2 * coordinates] - orbit.unknowns[: 2 * coordinates])
    largest_displacement = np.abs(orbit.unknowns[:coordinates]).max()
    assert plan.label == orbit.plan.label
    assert error[:coordinates].max() < 1e-11 * largest_displacement
    assert error[coordinates:].max() < 1e-11 * largest_displacement * 2 * np.pi * frequency
    events = len(orbit.plan.sequence.kind)
    np.testing.assert_allclose(unknowns[-events:], orbit.unknowns[-events:], atol=1e-13)
    assert orbit.residual < 1e-12
    assert orbit.flaw == ""


@each_case
def test_multipliers_equal_finite_differences(scene: Scene, frequency: float) -> None:
    orbit = periodic_orbit(scene, frequency)
    system = OrbitProblem(scene).system
    coordinates, omega = system.coordinates, 2 * np.pi * frequency
    # Units of displacements, velocities, and of height and velocity of each damper in flight.
    units = np.concatenate(
        [
            np.full(coordinates, 1e-3),
            np.full(coordinates, 1e-3 * omega),
            np.tile([1e-3, 1e-3 * omega], len(orbit.plan.flying)),
        ]
    )

    def state_after_a_cycle(change: np.ndarray) -> np.ndarray:
        unknowns = orbit.unknowns.copy()
        unknowns[: len(change)] += change
        propagator, steps = propagator_on_orbit(scene, replace(orbit, unknowns=unknowns))
        # Simulate the cycle, period by period.
        propagator.propagate_tone(
            np.full(orbit.repetition, steps), np.full(orbit.repetition, -1), np.ones(orbit.repetition, dtype=bool)
        )
        flights = [[propagator.state.height[j], propagator.state.velocity[j]] for j in orbit.plan.flying]
        return np.concatenate([propagator.state.z[: system.states], np.ravel(flights)])

    step = 1e-6
    columns = [
        (state_after_a_cycle(step * unit) - state_after_a_cycle(-step * unit)) / (2 * step) for unit in np.diag(units)
    ]
    numerical = np.linalg.eigvals(np.array(columns).T / units[:, None])

    # Compare each multiplier with the nearest: close multipliers may be in a different order.
    distance = np.abs(numerical[:, None] - orbit.multipliers)
    assert distance.min(axis=0).max() < 1e-5
    assert distance.min(axis=1).max() < 1e-5


def test_stable_branches_equal_steady_simulation() -> None:
    scene = with_ideal_force(rig.load("fig9"))
    frequencies = np.array([48.3, 49.0, 49.9, 50.6, 51.2])

    response = rig.frequency_response(scene, frequencies, tolerance=1e-10)

    for i, frequency in enumerate(frequencies):
        orbit = periodic_orbit(scene, float(frequency))
        assert orbit.stable
        assert orbit.motion_type == response.motion_type[i]
        largest_compliance = np.abs(orbit.compliance).max()
        assert np.abs(orbit.compliance - response.compliance[:, i]).max() < 1e-7 * largest_compliance
        np.testing.assert_allclose(orbit.peak, response.peak[:, i], rtol=1e-3)


@pytest.mark.thorough
def test_stable_branches_of_fig_9_cover_the_band() -> None:
    curve = fig9_curve()

    intervals = sorted(
        (branch.value[branch.stable].min(), branch.value[branch.stable].max(), branch.motion_type)
        for branch in curve.branches
        if branch.stable.any()
    )
    # The stable parts cover the band from 48.5 Hz to 51.3 Hz, except for gaps narrower than 0.03 Hz.
    covered = 48.5
    for low, high, _ in intervals:
        assert low < covered + 0.03
        covered = max(covered, high)
    assert covered == pytest.approx(51.3, abs=1e-9)
    assert {"I", "II", "III"} <= {motion_type for _, _, motion_type in intervals}
    # A missing orbit must be reported; here the motion is not periodic.
    assert all("no periodic motion at" in failure for failure in curve.failures)


def test_undetermined_event_is_a_failure_of_its_branch(monkeypatch: pytest.MonkeyPatch) -> None:
    def singular(*_: object) -> None:
        raise np.linalg.LinAlgError("Matrix is singular to machine precision.")

    monkeypatch.setattr("rig.core.orbits.orbit.monodromy", singular)
    curve = follow_orbits(rig.load("fig9"), "frequency", (49.0, 49.1), searches=1)
    assert not curve.branches
    assert "an event touches its threshold without crossing it" in " ".join(curve.failures)
    assert "at frequency 49.05" in repr(curve)


def test_multiplier_is_minus_one_at_a_period_doubling() -> None:
    scene = rig.load("fig9")
    (branch,) = [
        branch for branch in fig9_curve().branches if branch.motion_type == "II" and 50 < branch.value.mean() < 50.9
    ]

    (doubling,) = branch.doublings

    nearest = branch.orbits[int(np.abs(branch.value - doubling).argmin())]
    orbit = periodic_orbit(scene, float(doubling), start=nearest)
    assert np.abs(orbit.multipliers + 1).min() < 1e-7
    assert any(len(branch.doublings) and not branch.stable.all() for branch in fig9_curve().branches)


def test_multiplier_passes_one_at_a_fold() -> None:
    folded = [branch for branch in fig9_curve().branches if len(branch.folds) and branch.plan.repetition == 1]
    assert folded

    for branch in folded:
        (fold,) = branch.folds
        (i,) = branch.curve.folds
        # The product of 1 - multiplier changes its sign where a real multiplier passes 1.
        before, after = (np.prod(1 - branch.orbits[k].multipliers).real for k in (i, i + 1))
        assert before * after < 0
        assert np.abs(branch.value[i : i + 2] - fold).max() < 0.05


def test_curves_over_other_parameters_contain_the_same_orbit() -> None:
    scene = rig.load("fig9")
    orbit = periodic_orbit(scene, 49.7)
    ranges = {"force": (3.0, 3.6), "clearance": (0.95e-3, 1.0e-3), "mass_ratio": (0.95, 1.05)}
    scene_values = {"force": 3.3, "clearance": 0.98e-3, "mass_ratio": 1.0}
    for parameter, bounds in ranges.items():
        curve = follow_orbits(scene, parameter, bounds, frequency=49.7, searches=1)

        branch = curve.branches[0]
        order = np.argsort(branch.value)
        interpolated = np.interp(scene_values[parameter], branch.value[order], np.abs(branch.compliance[1])[order])
        assert branch.motion_type == "II"
        assert interpolated == pytest.approx(abs(orbit.compliance[1]), rel=2e-3)
        assert len(branch.value) > 5


# Scene, parameter, its range (Hz, N, m or 1), and the frequency, Hz, unless it is the parameter.
CURVES: list[tuple[Scene, Parameter, tuple[float, float], float | None]] = [
    (scene_with("fig9", 5.0, 0.15, 0.5e-3), "frequency", (46.0, 50.0), None),
    (scene_with("fig8-two-dampers", 3.0, 0.1, np.inf), "mass_ratio", (0.2, 2.0), 48.3),
    (scene_with("fig5-three-dampers", 6.0, 0.04, 1e-3), "force", (3.0, 9.0), 50.2),
    (scene_with("fig8-two-dampers", 4.0, 0.05, 0.8e-3), "clearance", (0.3e-3, 1.0e-3), 48.7),
]


@pytest.mark.parametrize(("scene", "parameter", "bounds", "frequency"), CURVES, ids=[case[1] for case in CURVES])
def test_stable_branches_cover_range_and_end_at_borders(scene, parameter, bounds, frequency):
    curve = follow_orbits(scene, parameter, bounds, frequency=frequency, searches=1)

    # The whole range is covered by stable orbits, from border to border.
    stable_values = [branch.value[branch.stable] for branch in curve.branches if branch.stable.any()]
    intervals = sorted((values.min(), values.max()) for values in stable_values)
    covered = bounds[0]
    for low, high in intervals:
        assert low < covered + 1e-3 * bounds[1]
        covered = max(covered, high)
    assert covered == pytest.approx(bounds[1], rel=1e-9)
    for branch in curve.branches:
        assert all(orbit.residual < 1e-11 and not orbit.flaw for orbit in branch.orbits)
        for end, orbit in zip(branch.ends, (branch.orbits[0], branch.orbits[-1]), strict=True):
            assert end in ("range", "closed") or (end in orbit.plan.borders and orbit.margin < 1e-5)


@cache
def approximation(force: float, mass_ratio: float, clearance: float) -> Approximation:
    """Return the response near mode 3 by the single-mode method; force in N, clearance in m."""
    mode = single_mode(scene_with("fig5-single-damper", force, mass_ratio, clearance), 3)
    return follow_mode(mode, (46.0, 53.0), searches=4)


def one_mode_scene(mode: SingleMode) -> Scene:
    """Return the scene of a single body with the modal properties and the damper of a mode."""
    stiffness = mode.mass * mode.omega**2
    lines = [
        "name: one mode",
        f"structure: {{masses: [{mode.mass!r}], springs: [{stiffness!r}],",
        f"  damping: {{modal: {mode.damping_ratio!r}}}}}",
        f"dampers: [{{body: 1, mass: {mode.mass * mode.mass_ratio!r}, clearance: {mode.clearance!r}}}]",
        "shaker: {kind: force, body: 1}",
        f"test: {{kind: sine, frequency: 49 Hz, force: {abs(mode.participation) * mode.force!r}}}",
    ]
    return rig.loads("\n".join(lines))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("kind", "force", "mass_ratio", "clearance"),
    [
        ("I", 5.0, 0.1, 1e-3),
        ("II", 5.0, 0.1, 1e-3),
        ("III", 5.0, 0.1, 1e-3),
        ("I", 3.0, 0.04, 2e-3),
        ("II", 8.0, 0.2, 1.5e-3),
        ("III", 6.0, 0.1, 0.8e-3),
    ],
)
def test_single_mode_motion_repeats_in_the_engine(kind: str, force: float, mass_ratio: float, clearance: float) -> None:
    approximate = approximation(force, mass_ratio, clearance)
    mode, scene = approximate.mode, one_mode_scene(approximate.mode)
    assert any(branch.motion_type == kind for branch in approximate.branches)
    for branch in [branch for branch in approximate.branches if branch.motion_type == kind]:
        valid_points = np.flatnonzero(branch.valid)
        i = int(valid_points[len(valid_points) // 2])
        omega = 2 * np.pi * branch.frequency[i]
        # The single-mode method scales displacements by g / w^2 and velocities by g / w.
        length = mode.gravity / omega**2
        problem = OrbitProblem(scene)
        propagator, steps = start_propagator(problem, problem.setting(float(branch.frequency[i])))
        # Modal displacement and velocity, and the sine and cosine parts of the force.
        displacement, velocity, sine, cosine = branch.unknowns[:4, i] * length * np.array([1, omega, 1, 1])
        # The cycle starts at the floor impact: start the tone at its phase.
        phase = np.arctan2(cosine, sine)
        start = np.array([displacement, velocity])
        propagator.set_state(start, np.array([np.cos(phase), np.sin(phase)]))
        trajectory = propagator.propagate_tone(np.array([steps]), np.array([0]), np.zeros(1, dtype=bool))

        # Phases (w t) of the first events. In type II the damper leaves the ceiling at the impact.
        instants = [branch.tau_0[i], branch.tau_1[i], *([branch.tau_2[i]] if kind == "III" else [branch.tau_1[i]])]
        events = trajectory.event_offset * omega
        kinds = [SEPARATION] if kind == "I" else [SEPARATION, CEILING_IMPACT, SEPARATION]
        np.testing.assert_array_equal(trajectory.event_kind[: len(kinds)], kinds)
        np.testing.assert_allclose(events[: len(kinds)], instants[: len(kinds)], atol=1e-9)
        amplitude = branch.peak[i] * mode.force
        # The impact at the end of the period may be before or after the end, because of rounding.
        change = propagator.state.z[:2] - start
        assert abs(change[0]) < 1e-10 * amplitude
        if trajectory.event_kind[-1] == FLOOR_IMPACT:
            assert abs(change[1]) < 1e-10 * amplitude * omega


def test_error_names_an_invalid_frequency_or_range() -> None:
    with pytest.raises(SceneError, match=r"frequency: got -1\.0; expected one or more positive"):
        periodic_orbit(rig.load("fig9"), -1.0)
    with pytest.raises(SceneError, match="frequency: got 2 values; expected one"):
        periodic_orbit(rig.load("fig9"), [49.0, 50.0])
    with pytest.raises(SceneError, match="two ascending values"):
        follow_orbits(rig.load("fig9"), "frequency", (50.0, 40.0))
    with pytest.raises(SceneError, match="Give the frequency at which the force is varied"):
        follow_orbits(rig.load("fig9"), "force", (1.0, 2.0))


def test_motion_without_event_sequence_is_rejected() -> None:
    with pytest.raises(RunError, match="at the same instant") as raised:
        periodic_orbit(coupled_scene(0.05), 51.2)
    assert str(raised.value).count("rig.frequency_response") == 1


@pytest.mark.parametrize(("restitution", "impacts"), [(0.2, 10), (0.6, 31)])
def test_rebounds_that_end_in_rest_have_an_orbit(restitution: float, impacts: int) -> None:
    scene = with_ideal_force(rig.load("fig9", {"dampers[1].restitution": restitution, "test.force": "0.7 N"}))
    orbit, response = periodic_orbit(scene, 49.6), rig.frequency_response(scene, [49.6])
    assert orbit.stable and orbit.motion_type == response.motion_type[0] == f"{impacts} per 1"
    assert list(orbit.events["kind"]).count("separation") == 1
    np.testing.assert_allclose(orbit.compliance, response.compliance[:, 0], rtol=1e-8)
    assert exact_orbit(scene, orbit).error(orbit.compliance) < 1e-12


def test_error_after_a_distant_start_names_the_frequency() -> None:
    scene = rig.load("fig9")
    start = periodic_orbit(scene, 49.7)

    with pytest.raises(RunError, match="near 20 Hz"):
        periodic_orbit(scene, 20.0, start=start)


def test_period_is_a_whole_number_of_steps() -> None:
    problem = OrbitProblem(rig.load("fig9"))
    setting = problem.setting(49.0)

    propagator, steps = start_propagator(problem, setting)

    assert period_steps(propagator, setting) == steps
