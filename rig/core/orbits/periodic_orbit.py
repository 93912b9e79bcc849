"""Exact periodic motions (orbits) of a scene with all its modes and dampers, stable or not.

The motion is simulated until it almost repeats, and is then refined by Newton's iteration for the equations of
`rig.core.orbits.shooting`. The motion repeats after a *cycle* of one or more periods of the drive. A *plan* is the
sequence of contact events in a cycle. A *setting* is an operating point: frequency, force, clearance, mass ratio.
"""

import numpy as np

from rig.core.base.arrays import Array
from rig.core.base.errors import RunError
from rig.core.engine.propagator import Propagator, tone_propagator
from rig.core.engine.state import CONFIGURATION
from rig.core.engine.trajectory import Trajectory
from rig.core.laws.events import CONTACT_EVENTS
from rig.core.orbits.event_sequence import (
    Plan,
    configuration_of,
    derive_plan,
    make_plan,
    regimes_from_walls,
    walls_from_regimes,
)
from rig.core.orbits.newton import IterationLimits
from rig.core.orbits.orbit import CONTACT_KINDS, LIMITS, Orbit, solve
from rig.core.orbits.problem import OperatingPoint, OrbitProblem
from rig.core.scene.loading import SceneLike, scene_of
from rig.core.settings.quantities import FREQUENCY, positive_value
from rig.core.steady_response.steady_state import MAX_REPETITION, settle

# Number of simulated periods after which a search ends without an orbit; irregular motion never repeats.
MAX_PERIODS = 4000
# Numbers of simulated periods after each of which a search attempts Newton's iteration before the motion is steady.
EARLY_PERIODS = (16, 64, 256)
# Limits of Newton's iteration in an early attempt. The values were tuned on designs of dampers for the bundled scenes.
# Iterations from a motion that settles to an orbit needed at most 5 corrections. The first correction was at most 0.5
# scales of the unknowns, and each further correction less than half of the previous correction. An iteration that does
# not converge is expensive.
EARLY_LIMITS = IterationLimits(corrections=8, first_size=0.5, growth=0.5)
# An early attempt is made if the motion changes by at most this fraction over a cycle. A motion that settles to an
# orbit within `MAX_ORBIT_DISTANCE` changes less: by at most 0.15 in designs of dampers for the bundled scenes.
MAX_EARLY_CHANGE = 0.2
# A motion is in steady state if it changes by at most this fraction from period to period.
MAX_STEADY_CHANGE = 1e-7
# If no repetition is detected, Newton's method is tried with each number of periods, provided that the motion changes
# by at most this fraction per period.
MAX_ALMOST_PERIODIC_CHANGE = 1e-6
# A motion settles to an orbit if its relative distance from the orbit is at most this.
MAX_ORBIT_DISTANCE = 0.05
# The distance from the orbit must decrease over this number of periods: the distance may grow for a few periods before
# it decays.
CONFIRMATION_PERIODS = 16
# The motion has reached the orbit if the relative distance is below this; the distance need not decrease further.
CLOSE_DISTANCE = 1e-6


def periodic_orbit(scene: SceneLike, frequency: float | str, start: Orbit | None = None) -> Orbit:
    """Compute a periodic motion of a scene at a frequency.

    Parameters
    ----------
    scene : Scene, str, Path or mapping
        A scene, or an argument of `rig.load`, with a shaker and a test that gives a level. If the test controls the
        amplitude of the spring force, this force acts on the driven body as a pure tone, as with an ideal controller.
    frequency : float or str
        Hz, or text with a unit, such as ``"49 Hz"``.
    start : Orbit, optional
        A nearby orbit of this scene with the same events. Without it, the motion is simulated from rest until it
        repeats, and is then refined by Newton's iteration.

    Returns
    -------
    Orbit
        The motion, with its events and stability.

    Raises
    ------
    SceneError
        If the frequency is not positive, the scene has no excitation, or its impacts are not supported by the
        method.
    RunError
        If the motion does not repeat, or Newton's iteration does not converge. The message gives the frequency.

    Examples
    --------
    >>> import rig
    >>> orbit = rig.periodic_orbit(rig.load("fig9"), 49.6)
    >>> orbit.motion_type, orbit.stable, len(orbit.events)
    ('II', True, 4)
    """
    problem = OrbitProblem(scene_of(scene))
    setting = problem.setting(positive_value(frequency, FREQUENCY, "frequency"))
    if start is not None:
        return solve(problem, start.plan, setting, start.unknowns)
    return search_orbit(problem, setting)


def search_orbit(
    problem: OrbitProblem, setting: OperatingPoint, start: Propagator | None = None, max_periods: int = MAX_PERIODS
) -> Orbit:
    """Simulate until the motion repeats, for at most `max_periods` periods, and refine it to an exact orbit."""
    propagator, steps = start_propagator(problem, setting) if start is None else (start, period_steps(start, setting))
    propagator.start_period(1.0)
    for periods in EARLY_PERIODS:
        propagator.propagate_periods(steps, periods)
        orbit = _nearby_orbit(problem, setting, propagator, steps, 1)
        if orbit is not None:
            return orbit
    steady = settle(propagator, steps, 1.0, MAX_STEADY_CHANGE, max_periods)
    if steady.repetition:
        orbit = refine_orbit(problem, setting, propagator, steps, steady.repetition)
        if orbit.flaw:
            raise RunError(
                f"the motion at {setting.frequency:.6g} Hz repeats after {steady.repetition} periods, but the orbit "
                f"computed with its events [{orbit.plan.label}] is not a possible motion: {orbit.flaw}. Use "
                "rig.frequency_response."
            )
        return orbit
    if steady.residual < MAX_ALMOST_PERIODIC_CHANGE:
        # The motion repeats, but a slowly decaying transient hides the number of periods.
        for repetition in range(1, MAX_REPETITION + 1):
            orbit = _nearby_orbit(problem, setting, propagator, steps, repetition)
            if orbit is not None:
                return orbit
    raise RunError(
        f"no periodic motion at {setting.frequency:.6g} Hz: after {max_periods} periods, the motion still does not "
        f"repeat (relative change {steady.residual:.1e}). Use rig.frequency_response."
    )


def _nearby_orbit(
    problem: OrbitProblem, setting: OperatingPoint, propagator: Propagator, steps: float, repetition: int
) -> Orbit | None:
    """Return the stable orbit to which a motion settles, if Newton's iteration converges to a nearby orbit."""
    try:
        plan, unknowns = simulate_cycle(propagator, steps, repetition)
        if not _almost_repeats(propagator, plan, unknowns, setting.frequency):
            return None
        orbit = _refine_cycle(problem, plan, setting, unknowns, EARLY_LIMITS)
    except RunError:
        return None
    distance = _distance(propagator, orbit)
    if orbit.flaw or distance > MAX_ORBIT_DISTANCE or not orbit.stable:
        return None
    # An irregular motion may pass close to an orbit without settling to it, so check that the distance decreases.
    trajectory = _simulate(propagator, steps, CONFIRMATION_PERIODS * repetition)
    n_impacts = sum(map(trajectory.event_kind.tolist().count, CONTACT_EVENTS)) // repetition
    n_orbit_impacts = sum(kind in CONTACT_KINDS for kind in orbit.plan.sequence.kind.tolist())
    same_impacts = n_impacts == CONFIRMATION_PERIODS * n_orbit_impacts // orbit.repetition
    return orbit if same_impacts and _distance(propagator, orbit) < max(distance, CLOSE_DISTANCE) else None


def _almost_repeats(propagator: Propagator, plan: Plan, unknowns: Array, frequency: float) -> bool:
    """Return whether a propagator's state is similar to the state at the start of the last cycle (`simulate_cycle`)."""
    walls, change = plan.sequence.wall, _largest_difference(propagator, unknowns, frequency)
    largest = _largest_difference(propagator, np.zeros_like(unknowns), frequency)
    return np.array_equal(walls[0], walls[-1]) and change <= MAX_EARLY_CHANGE * largest


def _distance(propagator: Propagator, orbit: Orbit) -> float:
    """Return the relative distance of a propagator's state from an orbit at the start of a period."""
    return _largest_difference(propagator, orbit.unknowns, orbit.frequency) / float(orbit.peak.max())


def _largest_difference(propagator: Propagator, unknowns: Array, frequency: float) -> float:
    """Return the largest deviation [m] of displacement, or of velocity over omega, from the start of an orbit."""
    nq = propagator.system.coordinates
    difference = propagator.state.z[: 2 * nq] - unknowns[: 2 * nq]
    difference[nq:] /= 2 * np.pi * frequency
    return float(np.abs(difference).max())


def _simulate(propagator: Propagator, steps: float, periods: int) -> Trajectory:
    """Simulate a number of periods of the drive; `steps`: propagator steps in a period."""
    return propagator.propagate_tone(np.array([steps]), np.full(periods, -1), np.ones(1, dtype=bool))


def start_propagator(
    problem: OrbitProblem, setting: OperatingPoint, from_linear_response: bool = False
) -> tuple[Propagator, float]:
    """Return a propagator at the start of a period, with resting dampers, and its steps per period.

    The initial state is that of the scene; `from_linear_response` adds the steady vibration of the linear structure
    with all dampers at rest.
    """
    system = problem.varied_system(setting)
    propagator, steps = tone_propagator(system, problem.amplitudes(setting), 2 * np.pi * setting.frequency)
    state = system.initial.copy()
    if from_linear_response:
        plan = make_plan([], [], walls_from_regimes(system.start_regimes, system), 1, system)
        equations, _ = problem.equations(setting, plan)
        a, n = equations.generator[0], system.states
        # x = X (cos wt, sin wt): the first column of X is the state at the start.
        forcing = (a[:n, n] - 1j * a[:n, n + 1]).astype(np.complex128)
        state += np.linalg.solve(1j * equations.omega * np.eye(n) - a[:n, :n], forcing).real
    propagator.set_state(state, np.array([1.0, 0.0]))
    return propagator, steps


def period_steps(propagator: Propagator, setting: OperatingPoint) -> float:
    """Return the number of propagator steps in a period."""
    return float(np.round(1 / (setting.frequency * propagator.tables.step)))


def refine_orbit(
    problem: OrbitProblem, setting: OperatingPoint, propagator: Propagator, steps: float, repetition: int
) -> Orbit:
    """Refine the motion of a propagator at the start of a period to an exact orbit.

    `steps`: propagator steps in a period of the drive; `repetition`: periods in a cycle.
    """
    plan, unknowns = simulate_cycle(propagator, steps, repetition)
    return _refine_cycle(problem, plan, setting, unknowns, LIMITS)


def _refine_cycle(
    problem: OrbitProblem, plan: Plan, setting: OperatingPoint, unknowns: Array, limits: IterationLimits
) -> Orbit:
    """Refine a simulated cycle to an exact orbit, and reduce it to its shortest cycle."""
    orbit = solve(problem, plan, setting, unknowns, limits)
    cycle = shortest_cycle(orbit)
    return orbit if cycle is None else solve(problem, *cycle)


def shortest_cycle(orbit: Orbit) -> tuple[Plan, OperatingPoint, Array] | None:
    """Reduce an orbit whose cycle consists of equal parts to one part; return None if it has no equal parts."""
    sequence, events = orbit.plan.sequence, len(orbit.plan.sequence.kind)
    instants = orbit.plan.instants(orbit.unknowns)
    for cycles in range(orbit.repetition, 1, -1):
        if orbit.repetition % cycles or events % cycles:
            continue
        cycle_events = events // cycles
        cycle_duration = orbit.repetition // cycles / orbit.frequency
        cycle_start = np.arange(events) // max(cycle_events, 1) * cycle_duration
        table = np.stack([sequence.kind, sequence.damper, (instants - cycle_start) * orbit.frequency])
        repeated = np.tile(table[:, :cycle_events], cycles)
        # Equal events, at equal instants within 1e-9 periods of the drive.
        if events and (not np.array_equal(table[:2], repeated[:2]) or np.abs(table[2] - repeated[2]).max() > 1e-9):
            continue
        plan = make_plan(
            sequence.kind[:cycle_events].tolist(), sequence.damper[:cycle_events].tolist(), sequence.wall[0],
            orbit.repetition // cycles, orbit.problem.system,
        )  # fmt: skip
        return plan, orbit.operating_point, orbit.unknowns[: len(orbit.unknowns) - events + cycle_events]
    return None


def simulate_cycle(propagator: Propagator, steps: float, repetition: int) -> tuple[Plan, Array]:
    """Simulate one cycle; return the plan of its events, and the orbit's unknowns (see `rig.core.orbits.shooting`)."""
    system, state = propagator.system, propagator.state
    regimes = state.regime.copy()
    heights, velocities = state.height.copy(), state.velocity.copy()
    initial_state = state.z[: system.states].copy()
    trajectory = _simulate(propagator, steps, repetition)
    plan, order = derive_plan(trajectory, regimes, state.regime, repetition, system)
    instants = trajectory.event_segment[order] * steps * propagator.tables.step + trajectory.event_offset[order]
    flights = np.array([[heights[j], velocities[j]] for j in plan.flying]).ravel()
    return plan, np.concatenate([initial_state, flights, instants])


def set_to_orbit(propagator: Propagator, orbit: Orbit) -> None:
    """Set the state of a propagator to that of an orbit at the start of a period."""
    system, state = propagator.system, propagator.state
    n, walls = system.states, orbit.plan.sequence.wall[0]
    state.z[:n] = orbit.unknowns[:n]
    propagator.start_period(1.0)
    state.regime[:], state.multiplicity[:] = regimes_from_walls(walls, state.z, system), 0
    flights = orbit.unknowns[n : n + 2 * len(orbit.plan.flying)].reshape(-1, 2)
    state.height[orbit.plan.flying], state.velocity[orbit.plan.flying] = flights.T
    state.counters[CONFIGURATION] = configuration_of(walls.tolist(), system)
    propagator.resume(propagator.snapshot())  # looks up the tables of the configuration
