"""Exact periodic motions of a scene with all its modes and dampers, stable or not."""

from __future__ import annotations

import numpy as np

from rig.arrays import Array
from rig.engine.propagator import Propagator, tone_propagator
from rig.engine.state import CEILING, CONFIGURATION, FLIGHT, FLOOR
from rig.engine.trajectory import STRIKES, Trajectory
from rig.errors import RunError
from rig.orbits.event_sequence import Plan, configuration_of, make_plan, mode_of, plan_from, walls_of
from rig.orbits.orbit import Orbit, solve
from rig.orbits.orbit_equations import FORCELESS
from rig.orbits.problem import OperatingPoint, OrbitProblem
from rig.scene.loading import SceneLike, scene_of
from rig.scene.quantities import FREQUENCY, positives
from rig.steady_response.steady_state import LONGEST_REPETITION, settle

# Largest number of simulated periods before a search classifies the motion as irregular.
LONGEST = 4000
# Numbers of periods after which a search tries Newton's iteration for a nearby orbit.
EARLY = (16, 64, 256)
# Relative change from period to period below which a motion almost repeats.
ALMOST = 1e-6
# Largest relative distance of a motion from the orbit to which it settles.
NEAR = 0.05
# Periods over which the distance must decrease, unless it is already below `CLOSE`.
CONFIRMED, CLOSE = 16, 1e-6


def periodic_orbit(scene: SceneLike, frequency: float | str, start: Orbit | None = None) -> Orbit:
    """Compute a periodic motion of a scene at a frequency.

    Parameters
    ----------
    scene : Scene, str, Path or mapping
        A scene, or what `rig.load` takes; with a shaker and a test that gives a level. Where the test holds
        the amplitude of the spring force, that force acts on the driven body as a pure tone, as with an ideal
        controller.
    frequency : float or str
        Hz, or text with a unit, such as ``"49 Hz"``.
    start : Orbit, optional
        A nearby orbit of this scene with the same events. By default the motion is simulated from rest until it
        repeats, and is then refined by Newton's iteration.

    Raises
    ------
    SceneError
        If the frequency is not positive, the scene has no excitation, or its impacts are not supported by the
        method.
    RunError
        If the motion does not repeat, or Newton's iteration does not converge; the message states where.

    Examples
    --------
    >>> import rig
    >>> orbit = rig.periodic_orbit(rig.load("fig9"), 49.6)
    >>> orbit.motion_type, orbit.stable, len(orbit.events)
    ('II', True, 4)
    """
    problem = OrbitProblem(scene_of(scene))
    setting = problem.setting(float(positives(frequency, FREQUENCY, "frequency")[0]))
    if start is not None:
        return solve(problem, start.plan, setting, start.unknowns)
    return search(problem, setting)


def search(
    problem: OrbitProblem, setting: OperatingPoint, start: Propagator | None = None, longest: int = LONGEST
) -> Orbit:
    """Simulate until the motion repeats, for at most `longest` periods, and refine it to an exact orbit."""
    propagator, steps = (
        start_march(problem, setting) if start is None else (start, period_steps(start, setting))
    )
    propagator.start_period(1.0)
    for periods in EARLY:
        _run(propagator, steps, periods)
        found = _near(problem, setting, propagator, steps, 1)
        if found is not None:
            return found
    steady = settle(propagator, steps, 1.0, 1e-7, longest)
    if steady.repetition:
        orbit = refine(problem, setting, propagator, steps, steady.repetition)
        if orbit.flaw:
            raise RunError(
                f"the motion at {setting.frequency:.6g} Hz repeats after {steady.repetition} periods, but the orbit "
                f"with its events [{orbit.plan.label}] is impossible: {orbit.flaw}"
            )
        return orbit
    if steady.residual < ALMOST:
        # The motion repeats, but its slow decay does not determine the number of periods.
        for repetition in range(1, LONGEST_REPETITION + 1):
            found = _near(problem, setting, propagator, steps, repetition)
            if found is not None:
                return found
    raise RunError(
        f"no periodic motion found at {setting.frequency:.6g} Hz: after {longest} periods the motion "
        f"still changes by {steady.residual:.1e} of itself from period to period"
    )


def _near(
    problem: OrbitProblem, setting: OperatingPoint, propagator: Propagator, steps: float, repetition: int
) -> Orbit | None:
    """Return the stable orbit to which a motion settles, if Newton's iteration converges nearby."""
    try:
        orbit = refine(problem, setting, propagator, steps, repetition)
    except RunError:
        return None
    if orbit.flaw or not orbit.stable:
        return None
    away = _distance(propagator, orbit)
    if away > NEAR:
        return None
    # An irregular motion may pass close to an orbit without settling, so check that the distance decreases.
    trajectory = _run(propagator, steps, CONFIRMED * repetition)
    struck = np.count_nonzero(np.isin(trajectory.event_kind, STRIKES)) // repetition
    same = (
        struck
        == CONFIRMED
        * np.count_nonzero(~np.isin(orbit.events["kind"], ("separation", "release")))
        // orbit.repetition
    )
    return orbit if same and _distance(propagator, orbit) < max(away, CLOSE) else None


def _distance(propagator: Propagator, orbit: Orbit) -> float:
    """Return the relative distance of a propagator's state from an orbit at the start of a period."""
    nq = propagator.system.coordinates
    away = propagator.state.z[: 2 * nq] - orbit.unknowns[: 2 * nq]
    away[nq:] /= 2 * np.pi * orbit.frequency
    return float(np.abs(away).max() / orbit.peak.max())


def _run(propagator: Propagator, steps: float, periods: int) -> Trajectory:
    """Simulate whole periods."""
    rows, anew = np.full(periods, -1), np.ones(periods, dtype=bool)
    return propagator.through_marks(np.full(periods, steps), rows, anew)


def start_march(
    problem: OrbitProblem, setting: OperatingPoint, moving: bool = False
) -> tuple[Propagator, float]:
    """Return a propagator at the start of a period, all dampers on their floors, and its steps per period.

    The initial state is rest or, if `moving`, the steady state of the linear structure with all dampers riding on
    their floors.
    """
    system = problem.changed(setting)
    propagator, steps = tone_propagator(system, problem.amplitudes(setting), 2 * np.pi * setting.frequency)
    state = system.initial.copy()
    if moving:
        riding = make_plan([], [], walls_of(np.full(system.dampers, FLOOR), system), 1)
        equations, _ = problem.equations(setting, riding)
        a, n = equations.generator[0], system.states
        # x = X (cos wt, sin wt): the first column of X is the state at the start.
        drive = (a[:n, n] - 1j * a[:n, n + 1]).astype(np.complex128)
        state += np.linalg.solve(1j * equations.omega * np.eye(n) - a[:n, :n], drive).real
    propagator.place(state, np.array([1.0, 0.0]))
    return propagator, steps


def period_steps(propagator: Propagator, setting: OperatingPoint) -> float:
    """Return the number of propagator steps in a period."""
    return float(np.round(1 / (setting.frequency * propagator.tables.step)))


def refine(
    problem: OrbitProblem, setting: OperatingPoint, propagator: Propagator, steps: float, repetition: int
) -> Orbit:
    """Refine the motion of a propagator at the start of a period to an exact orbit."""
    plan, unknowns = read_cycle(propagator, steps, repetition)
    orbit = solve(problem, plan, setting, unknowns)
    shorter = first_part(orbit)
    return orbit if shorter is None else solve(problem, *shorter)


def first_part(orbit: Orbit) -> tuple[Plan, OperatingPoint, Array] | None:
    """Reduce an orbit that repeats the same cycle to one cycle; None if it does not repeat."""
    sequence, events = orbit.plan.sequence, len(orbit.plan.sequence.kind)
    instants = orbit.unknowns[len(orbit.unknowns) - events :]
    for rounds in range(orbit.repetition, 1, -1):
        if orbit.repetition % rounds or events % rounds:
            continue
        count = events // rounds
        span = orbit.repetition // rounds / orbit.frequency
        shift = np.arange(events) // max(count, 1) * span
        pairs = np.stack([sequence.kind, sequence.damper, (instants - shift) * orbit.frequency])
        again = np.tile(pairs[:, :count], rounds)
        if events and (not np.array_equal(pairs[:2], again[:2]) or np.abs(pairs[2] - again[2]).max() > 1e-9):
            continue
        kinds, dampers = sequence.kind[:count].tolist(), sequence.damper[:count].tolist()
        plan = make_plan(kinds, dampers, sequence.wall[0], orbit.repetition // rounds)
        return plan, orbit.setting, orbit.unknowns[: len(orbit.unknowns) - events + count]
    return None


def read_cycle(propagator: Propagator, steps: float, repetition: int) -> tuple[Plan, Array]:
    """Simulate one cycle and return its events and the unknowns at its start."""
    system, state = propagator.system, propagator.state
    start = state.mode.astype(np.int8)
    heights, speeds = state.height.copy(), state.speed.copy()
    z = state.z[: system.states].copy()
    trajectory = _run(propagator, steps, repetition)
    plan, order = plan_from(trajectory, start, repetition, system)
    instants = (
        trajectory.event_segment[order] * steps * propagator.tables.step + trajectory.event_offset[order]
    )
    flights = np.array([[heights[j], speeds[j]] for j in plan.flying]).ravel()
    return plan, np.concatenate([z, flights, instants])


def enter(propagator: Propagator, orbit: Orbit) -> None:
    """Set a propagator to the state of an orbit at the start of a period."""
    system, state = propagator.system, propagator.state
    n, walls = system.states, orbit.plan.sequence.wall[0]
    state.z[:n] = orbit.unknowns[:n]
    propagator.start_period(1.0)
    state.mode[:], state.multiplicity[:] = mode_of(walls), 0
    flights = orbit.unknowns[n : n + 2 * len(orbit.plan.flying)].reshape(-1, 2)
    state.height[orbit.plan.flying], state.speed[orbit.plan.flying] = flights.T
    state.recovering[:] = FLIGHT
    for j in np.flatnonzero(walls == FORCELESS):
        gap = state.z[system.bed[j]]
        if not 0.0 <= gap <= system.clearance[j]:
            state.recovering[j] = FLOOR if gap < 0.0 else CEILING
    state.counters[CONFIGURATION] = configuration_of(walls)
    propagator.resume(propagator.snapshot())
