"""Exact periodic orbits of the full structure: against the engine, finite differences and known limits."""

from functools import cache

import numpy as np
import pytest

import rig
from rig.approximate import follow_mode
from rig.errors import RunError, SceneError
from rig.march import March
from rig.orbit import enter, period_steps, periodic_orbit, read_cycle, start_march
from rig.orbit_curve import OrbitCurve, follow_orbits
from rig.orbit_following import Orbit
from rig.orbit_problem import Problem, pure_force
from rig.receptance import receptance
from rig.scene import Scene
from rig.single_mode import SingleMode, single_mode


@cache
def fig9_curve() -> OrbitCurve:
    return follow_orbits(rig.load("fig9"), "frequency", (48.5, 51.3), searches=2)


def on_orbit(scene: Scene, orbit: Orbit) -> tuple[March, float]:
    """Put the engine on an orbit."""
    march, steps = start_march(Problem(scene), orbit.setting)
    enter(march, orbit)
    return march, steps


CASES = [
    ("fig9", 49.7),
    ("fig9", 49.1),
    ("fig8-three-dampers", 34.5),
    ("fig5-three-dampers", 49.5),
    ("fig9", 46.5),
]


@pytest.mark.parametrize(("name", "frequency"), CASES)
def test_given_an_orbit_when_the_engine_runs_it_then_it_returns_after_a_period(
    name: str, frequency: float
) -> None:
    scene = rig.load(name)
    orbit = periodic_orbit(scene, frequency)

    march, steps = on_orbit(scene, orbit)
    plan, unknowns = read_cycle(march, steps, orbit.repetition)

    ns = march.system.states
    end = march.state.z[:ns]
    size = np.abs(orbit.unknowns[:3]).max()
    assert plan.label == orbit.plan.label
    assert np.abs(end[:3] - orbit.unknowns[:3]).max() < 1e-11 * size
    assert np.abs(end[3:6] - orbit.unknowns[3:6]).max() < 1e-11 * size * 2 * np.pi * frequency
    events = len(orbit.plan.sequence.kind)
    np.testing.assert_allclose(unknowns[-events:], orbit.unknowns[-events:], atol=1e-13)
    assert orbit.residual < 1e-12
    assert orbit.flaw == ""


@pytest.mark.parametrize(("name", "frequency"), CASES)
def test_given_an_orbit_when_disturbed_in_the_engine_then_it_answers_by_its_multipliers(
    name: str, frequency: float
) -> None:
    scene = rig.load(name)
    orbit = periodic_orbit(scene, frequency)
    ns = Problem(scene).system.states
    flying = len(orbit.plan.flying)
    omega = 2 * np.pi * frequency
    units = np.concatenate(
        [np.full(ns // 2, 1e-3), np.full(ns // 2, 1e-3 * omega), np.tile([1e-3, 1e-3 * omega], flying)]
    )

    def after_a_period(change: np.ndarray) -> np.ndarray:
        unknowns = orbit.unknowns.copy()
        unknowns[: len(change)] += change
        march, steps = on_orbit(scene, Orbit(**{**vars(orbit), "unknowns": unknowns}))
        march.over_marks(
            np.full(orbit.repetition, steps),
            np.full(orbit.repetition, -1),
            np.ones(orbit.repetition, dtype=bool),
        )
        flights = [[march.state.height[j], march.state.speed[j]] for j in orbit.plan.flying]
        return np.concatenate([march.state.z[:ns], np.ravel(flights)])

    step = 1e-6
    columns = [(after_a_period(step * u) - after_a_period(-step * u)) / (2 * step) for u in np.diag(units)]
    measured = np.linalg.eigvals(np.array(columns).T / units[:, None])

    by_size = lambda values: values[np.lexsort((values.imag, values.real))]  # noqa: E731
    np.testing.assert_allclose(by_size(measured), by_size(orbit.multipliers), atol=1e-5)


def test_given_stable_branches_when_simulated_to_steady_state_then_the_responses_agree() -> None:
    scene = pure_force(rig.load("fig9"))
    frequencies = np.array([48.3, 49.0, 49.9, 50.6, 51.2])

    response = rig.frequency_response(scene, frequencies, tolerance=1e-10)

    for i, frequency in enumerate(frequencies):
        orbit = periodic_orbit(scene, float(frequency))
        assert orbit.stable
        assert orbit.motion_type == response.motion_type[i]
        size = np.abs(orbit.compliance).max()
        assert np.abs(orbit.compliance - response.compliance[:, i]).max() < 1e-7 * size
        np.testing.assert_allclose(orbit.peak, response.peak[:, i], rtol=1e-3)


def test_given_fig_9_when_followed_over_frequency_then_types_follow_one_another_without_a_gap() -> None:
    curve = fig9_curve()

    spans = sorted(
        (branch.value[branch.stable].min(), branch.value[branch.stable].max(), branch.motion_type)
        for branch in curve.branches
        if branch.stable.any()
    )
    reached = 48.5
    for low, high, _ in spans:
        assert low < reached + 0.03
        reached = max(reached, high)
    assert reached == pytest.approx(51.3, abs=1e-9)
    assert {"I", "II", "III"} <= {kind for _, _, kind in spans}
    # What is not found must be said, and here it is motion that does not repeat.
    assert all("no periodic motion found" in failure for failure in curve.failures)


def test_given_a_period_doubling_when_located_then_a_multiplier_is_minus_one_there() -> None:
    scene = rig.load("fig9")
    (branch,) = [b for b in fig9_curve().branches if b.motion_type == "II" and 50 < b.value.mean() < 50.9]

    (doubling,) = branch.doublings

    nearest = branch.orbits[int(np.abs(branch.value - doubling).argmin())]
    orbit = periodic_orbit(scene, float(doubling), start=nearest)
    assert np.abs(orbit.multipliers + 1).min() < 1e-7
    assert any(len(b.doublings) and not b.stable.all() for b in fig9_curve().branches)


def test_given_a_fold_when_passed_then_a_multiplier_passes_one() -> None:
    folded = [b for b in fig9_curve().branches if len(b.folds) and b.plan.repetition == 1]
    assert folded

    for branch in folded:
        (fold,) = branch.folds
        (i,) = branch.curve.folds
        # The product of 1 - multiplier changes its sign with each real multiplier that passes 1.
        before, after = (np.prod(1 - branch.orbits[k].multipliers).real for k in (i, i + 1))
        assert before * after < 0
        assert np.abs(branch.value[i : i + 2] - fold).max() < 0.05


def test_given_other_parameters_when_followed_then_the_curve_passes_through_the_same_orbit() -> None:
    scene = rig.load("fig9")
    orbit = periodic_orbit(scene, 49.7)
    ranges = {"force": (3.0, 3.6), "clearance": (0.95e-3, 1.0e-3), "mass_ratio": (0.95, 1.05)}
    own = {"force": 3.3, "clearance": 0.98e-3, "mass_ratio": 1.0}
    for parameter, bounds in ranges.items():
        curve = follow_orbits(scene, parameter, bounds, frequency=49.7, searches=1)

        branch = curve.branches[0]
        order = np.argsort(branch.value)
        here = np.interp(own[parameter], branch.value[order], np.abs(branch.compliance[1])[order])
        assert branch.motion_type == "II"
        assert here == pytest.approx(abs(orbit.compliance[1]), rel=2e-3)
        assert len(branch.value) > 5


def test_given_a_locked_damper_when_solved_then_the_orbit_is_the_exact_linear_response() -> None:
    scene = rig.load("fig9")
    locked = scene.replace(dampers=[scene.dampers[0].replace(locked=True)])

    orbit = periodic_orbit(locked, 48.9)

    exact = receptance(locked, [48.9])[:, 0]
    assert np.abs(orbit.compliance - exact).max() < 1e-8 * np.abs(exact).max()
    assert orbit.motion_type == "linear"


def one_mode_scene(mode: SingleMode) -> Scene:
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


@pytest.mark.parametrize(("kind", "force"), [("I", 5.0), ("II", 5.0), ("III", 5.0), ("II", 3.3)])
def test_given_an_approximate_motion_when_run_by_the_engine_with_one_mode_then_it_repeats_to_1e_10(
    kind: str, force: float
) -> None:
    mode = single_mode(rig.load("fig5-single-damper"), 3, force=force)
    found = follow_mode(mode, (45.0, 55.0), searches=5)
    scene = one_mode_scene(mode)
    for branch in [b for b in found.branches if b.motion_type == kind]:
        possible = np.flatnonzero(branch.valid)
        i = int(possible[len(possible) // 2])
        omega = 2 * np.pi * branch.frequency[i]
        length = mode.gravity / omega**2
        problem = Problem(scene)
        march, steps = start_march(problem, problem.setting(float(branch.frequency[i])))
        q, u, a, b = branch.unknowns[:4, i] * length * np.array([1, omega, 1, 1])
        # The floor impact is tau = 0, where the force is F sin(-phi) = b: start the tone at that phase.
        phase = np.arctan2(b, a)
        march.place(np.array([q, u]), np.array([np.cos(phase), np.sin(phase)]))
        course = march.over_marks(np.array([steps]), np.array([0]), np.zeros(1, dtype=bool))

        instants = [
            branch.tau_0[i],
            branch.tau_1[i],
            *([branch.tau_2[i]] if kind == "III" else [branch.tau_1[i]]),
        ]
        events = course.event_offset * omega
        kinds = {"I": [0], "II": [0, 2, 0], "III": [0, 2, 0]}[kind]
        np.testing.assert_array_equal(course.event_kind[: len(kinds)], kinds)
        np.testing.assert_allclose(events[: len(kinds)], instants[: len(kinds)], atol=1e-9)
        size = branch.peak[i] * mode.force
        # The landing that ends the period may fall to either side of its end by rounding.
        end = march.state.z[:2] - np.array([q, u])
        assert abs(end[0]) < 1e-10 * size
        if course.event_kind[-1] == 1:
            assert abs(end[1]) < 1e-10 * size * omega


def test_given_a_frequency_that_is_none_when_asked_for_an_orbit_then_it_says_what_is_expected() -> None:
    with pytest.raises(SceneError, match="positive number of hertz"):
        periodic_orbit(rig.load("fig9"), -1.0)
    with pytest.raises(SceneError, match="two rising values"):
        follow_orbits(rig.load("fig9"), "frequency", (50.0, 40.0))
    with pytest.raises(SceneError, match="needs a frequency"):
        follow_orbits(rig.load("fig9"), "force", (1.0, 2.0))


def test_given_rebounds_without_end_when_asked_for_an_orbit_then_it_says_so_and_what_to_do() -> None:
    scene = rig.load("fig9")
    bouncy = scene.replace(dampers=[scene.dampers[0].replace(restitution=0.3)])

    with pytest.raises(RunError, match="rebounds ever lower until it rests"):
        periodic_orbit(bouncy, 49.0)


def test_given_a_start_far_from_any_orbit_when_solved_then_it_says_where_it_failed() -> None:
    scene = rig.load("fig9")
    near = periodic_orbit(scene, 49.7)

    with pytest.raises(RunError, match="near 20 Hz"):
        periodic_orbit(scene, 20.0, start=near)


def test_given_a_march_when_asked_for_its_steps_then_a_period_is_a_whole_number_of_them() -> None:
    problem = Problem(rig.load("fig9"))
    setting = problem.setting(49.0)

    march, steps = start_march(problem, setting)

    assert period_steps(march, setting) == steps
