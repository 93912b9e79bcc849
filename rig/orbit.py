"""Exact periodic motions of a scene with all its modes and dampers, stable or not."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rig import continuation
from rig.assembly import spring_force_row
from rig.contact import CEILING_IMPACT, FLIGHT, FLOOR_IMPACT
from rig.contact import SEPARATION as SEPARATED
from rig.course import EVENT, KINDS
from rig.errors import RunError, SceneError
from rig.march import March, tone_march
from rig.motion_type import overall
from rig.orbit_checks import flaw, lowest
from rig.orbit_problem import Parameter, Plan, Problem, Setting, make_plan, plan_from, vary
from rig.scene import Scene
from rig.shaker_settings import ForceShaker
from rig.shooting import CEILING, CEILING_BOUNCE, FLOOR, FLOOR_BOUNCE, Equations, sample, shoot
from rig.steady_state import settle

Array = NDArray[np.float64]

# Intervals in each stretch between events, for checks and harmonics: Simpson's rule and cubics on these are
# good to 1e-9 of the motion.
POINTS = 48
# Periods that a search follows the motion for before it takes the motion for irregular.
LONGEST = 4000


@dataclass(frozen=True)
class Orbit:
    """A periodic motion.

    Attributes
    ----------
    setting : Setting
        Frequency [Hz], level of the drive, and clearance and mass ratio where they were varied.
    repetition : int
        Length in periods of the drive.
    events : structured ndarray
        `time` [s] from the start of a period of the drive, `damper` (from 1), `kind` (separation, floor,
        ceiling) and closing `speed` [m/s], as in `rig.simulate`.
    motion_type : str
        Types of the dampers, as in `rig.frequency_response`.
    compliance : ndarray of complex, shape (bodies,)
        First harmonic of each displacement over that of the force [m/N].
    peak : ndarray, shape (bodies,)
        Half the range of each displacement [m].
    multipliers : ndarray of complex
        Floquet multipliers: one for each state and two for each damper in flight at the start.
    flaw : str
        What makes the orbit impossible as a motion ("" if nothing); only orbits that were continued past a
        border have one.
    residual : float
        Distance by which the orbit misses its start after a period, relative to the motion.
    unknowns : ndarray
        State at the start, heights and velocities of dampers in flight, and instants, see `rig.shooting`.
    plan : Plan
        The sequence of events.
    """

    setting: Setting
    repetition: int
    events: NDArray[np.void]
    motion_type: str
    damper_motion: tuple[str, ...]
    compliance: NDArray[np.complex128]
    peak: Array
    multipliers: NDArray[np.complex128]
    flaw: str
    residual: float
    unknowns: Array = field(repr=False)
    plan: Plan = field(repr=False)

    @property
    def frequency(self) -> float:
        """Frequency of the drive [Hz]."""
        return self.setting.frequency

    @property
    def stable(self) -> bool:
        """Whether every Floquet multiplier lies inside the unit circle."""
        return bool((np.abs(self.multipliers) < 1).all())


def periodic_orbit(scene: Scene, frequency: float, start: Orbit | None = None) -> Orbit:
    """Find a periodic motion of a scene at a frequency.

    Parameters
    ----------
    scene : Scene
        With a shaker and a test that gives a level. Where the test holds the amplitude of the spring force,
        that force is put on the driven body as a pure tone, which is what an ideal controller holds.
    frequency : float
        Hz.
    start : Orbit, optional
        An orbit of this scene near by, with the same events; without one the motion is simulated from rest
        until it repeats, and made exact from there.

    Returns
    -------
    Orbit

    Raises
    ------
    SceneError
        If the frequency is not positive, nothing drives the scene, or it has impacts that the method does not
        cover.
    RunError
        If the motion does not repeat, or Newton's iteration does not settle; the message says where.

    Examples
    --------
    >>> import rig
    >>> orbit = rig.periodic_orbit(rig.load("fig9"), 49.6)
    >>> orbit.motion_type, orbit.stable, len(orbit.events)
    ('II', True, 4)
    """
    if not (np.isfinite(frequency) and frequency > 0):
        raise SceneError(f"frequency {frequency!r}: expected a positive number of hertz")
    problem = Problem(scene)
    setting = problem.setting(frequency)
    if start is not None:
        return solve(problem, start.plan, setting, start.unknowns)
    return search(problem, setting)


def search(problem: Problem, setting: Setting, start: March | None = None) -> Orbit:
    """Simulate until the motion repeats, and make it exact."""
    march, steps = start_march(problem, setting) if start is None else (start, period_steps(start, setting))
    march.start_period(1.0)
    steady = settle(march, steps, 1.0, 1e-7, LONGEST)
    repetition = steady.repetition or (1 if steady.residual < 1e-6 else 0)
    if not repetition:
        raise RunError(
            f"no periodic motion found at {setting.frequency:.6g} Hz: after {LONGEST} periods the motion "
            f"still changes by {steady.residual:.1e} of itself from period to period"
        )
    return refine(problem, setting, march, steps, repetition)


def start_march(problem: Problem, setting: Setting, moving: bool = False) -> tuple[March, float]:
    """March with all dampers on their floors, at the start of a period; and the steps in a period.

    At rest, or, `moving`, in the steady motion that the structure would have were the dampers to stay on
    their floors.
    """
    system = problem.changed(setting)
    march, steps = tone_march(system, problem.amplitudes(setting), 2 * np.pi * setting.frequency)
    state = system.initial.copy()
    if moving:
        equations = problem.equations(setting, ((1 << system.dampers) - 1,))
        a, n = equations.generator[0], system.states
        # x = X (cos wt, sin wt): the first column of X is the state at the start.
        drive = (a[:n, n] - 1j * a[:n, n + 1]).astype(np.complex128)
        state += np.linalg.solve(1j * equations.omega * np.eye(n) - a[:n, :n], drive).real
    march.place(state, np.array([1.0, 0.0]))
    return march, steps


def period_steps(march: March, setting: Setting) -> float:
    """Step lengths of a march in a period."""
    return float(np.round(1 / (setting.frequency * march.tables.step)))


def refine(problem: Problem, setting: Setting, march: March, steps: float, repetition: int) -> Orbit:
    """Make the motion that a march is on (at the start of a period) an exact orbit."""
    plan, unknowns = read_cycle(march, steps, repetition)
    orbit = solve(problem, plan, setting, unknowns)
    shorter = first_part(orbit)
    return orbit if shorter is None else solve(problem, *shorter)


def first_part(orbit: Orbit) -> tuple[Plan, Setting, Array] | None:
    """Cut an orbit that goes several times round the same cycle to one round; None if it does not."""
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


def read_cycle(march: March, steps: float, repetition: int) -> tuple[Plan, Array]:
    """Run one cycle and take down its events and the unknowns at its start."""
    system, state = march.system, march.state
    start = state.mode.astype(np.int8)
    heights, speeds = state.height.copy(), state.speed.copy()
    z = state.z[: system.states].copy()
    course = march.over_marks(
        np.full(repetition, steps), np.full(repetition, -1), np.ones(repetition, dtype=bool), 1.0
    )
    plan, order = plan_from(course, start, repetition)
    instants = course.event_segment[order] * steps * march.tables.step + course.event_offset[order]
    flights = np.array([[heights[j], speeds[j]] for j in np.flatnonzero(start == FLIGHT)]).ravel()
    return plan, np.concatenate([z, flights, instants])


def solve(problem: Problem, plan: Plan, setting: Setting, unknowns: Array) -> Orbit:
    """Solve the equations of an orbit for one setting by Newton's iteration.

    Raises
    ------
    RunError
        If the iteration does not settle.
    """
    curve = Following(problem, plan, setting, "frequency", unknowns)
    x = np.append(unknowns, setting.frequency)
    try:
        x = continuation.solve_at(curve, x, setting.frequency, curve.scale, continuation.Steps(iterations=25))
    except continuation.NoConvergence as failure:
        raise RunError(
            f"no orbit with events [{plan.label}] near {setting.frequency:.6g} Hz: {failure}"
        ) from None
    return curve.orbit(x)


class Following:
    """The equations of an orbit with one parameter free, as `rig.continuation` takes them.

    Parameters
    ----------
    problem : Problem
    plan : Plan
        Events of the orbit.
    setting : Setting
        Everything but the parameter.
    parameter : {'frequency', 'force', 'clearance', 'mass_ratio'}
    unknowns : ndarray
        A first guess; sets the scales.
    """

    def __init__(
        self, problem: Problem, plan: Plan, setting: Setting, parameter: Parameter, unknowns: Array
    ) -> None:
        self.problem, self.plan, self.parameter = problem, plan, parameter
        self.at = vary(setting, parameter)
        system = problem.system
        omega, nq = 2 * np.pi * setting.frequency, system.coordinates
        state = unknowns[: system.states]
        size = np.abs(state[:nq]).max(initial=0.0) + np.abs(state[nq : 2 * nq]).max(initial=0.0) / omega
        size += system.gravity / omega**2
        further = np.abs(state[2 * nq :]) + 1e-3
        flights = np.tile([size, omega * size], len(plan.flying))
        times = np.full(len(plan.sequence.kind), 1 / omega)
        start = np.concatenate([np.full(nq, size), np.full(nq, omega * size), further, flights])
        value = getattr(setting, parameter)
        self.scale = np.concatenate(
            [start, times, [abs(value) * (0.02 if parameter == "frequency" else 0.2)]]
        )
        guards = [1 / omega if k == 5 else (system.gravity if k == 0 else size) for k in plan.sequence.kind]
        self.rows = np.concatenate([start, guards])

    def tables(self, value: float) -> tuple[Equations, float]:
        """Equations and length of the orbit at a value of the parameter."""
        setting = self.at(value)
        return self.problem.equations(
            setting, self.plan.configurations
        ), self.plan.repetition / setting.frequency

    def __call__(self, x: Array) -> tuple[Array, Array]:
        """Scaled residual and jacobian; the parameter's column by a central difference."""
        value = float(x[-1])
        equations, period = self.tables(value)
        residual, jacobian, _, _ = shoot(equations, self.plan.sequence, period, x[:-1], True)
        # The residual is smooth in the parameter: a step of 1e-6 leaves an error of some 1e-10 in the column.
        step = 1e-6 * value
        sides = []
        for shifted in (value + step, value - step):
            equations, period = self.tables(shifted)
            sides.append(shoot(equations, self.plan.sequence, period, x[:-1], False)[0])
        column = (sides[0] - sides[1]) / (2 * step)
        full = np.column_stack([jacobian, column]) / self.rows[:, None]
        return residual / self.rows, full

    def multipliers(self, x: Array) -> NDArray[np.complex128]:
        """Floquet multipliers: the events' rows are solved for the instants, which leaves the period map."""
        equations, period = self.tables(float(x[-1]))
        _, jacobian, _, _ = shoot(equations, self.plan.sequence, period, x[:-1], True)
        events = len(self.plan.sequence.kind)
        cut = len(jacobian) - events
        jacobian = jacobian / self.rows[:, None] * self.scale[:-1]
        period_map = jacobian[:cut, :cut] + np.eye(cut)
        if events:
            period_map -= jacobian[:cut, cut:] @ np.linalg.solve(jacobian[cut:, cut:], jacobian[cut:, :cut])
        return np.asarray(np.linalg.eigvals(period_map), dtype=np.complex128)

    def flaw(self, x: Array) -> str:
        """Say what makes the orbit impossible as a motion."""
        equations, period = self.tables(float(x[-1]))
        _, _, states, closing = shoot(equations, self.plan.sequence, period, x[:-1], False)
        instants = self._instants(x)
        times, _, guards, _ = sample(equations, self.plan.sequence, period, instants, states, POINTS)
        return flaw(self.plan, equations, instants, times, guards, closing)

    def _instants(self, x: Array) -> Array:
        events = len(self.plan.sequence.kind)
        return x[len(x) - 1 - events : len(x) - 1]

    def orbit(self, x: Array) -> Orbit:
        """Describe the orbit at a solution."""
        problem, plan, setting = self.problem, self.plan, self.at(float(x[-1]))
        equations, period = self.tables(float(x[-1]))
        residual, _, states, closing = shoot(equations, plan.sequence, period, x[:-1], False)
        instants = self._instants(x)
        times, motion, guards, integral = sample(equations, plan.sequence, period, instants, states, POINTS)
        bodies, nq = problem.scene.structure.bodies, problem.system.coordinates
        harmonic = 2 / period * integral
        if isinstance(problem.scene.shaker, ForceShaker):
            force = -1j * setting.force
        else:
            force = complex(spring_force_row(problem.scene, problem.system) @ harmonic)
        types = tuple(_type(plan, j) for j in range(problem.system.dampers))
        return Orbit(
            setting=setting,
            repetition=plan.repetition,
            events=_event_table(problem, plan, instants, closing),
            motion_type=overall(list(types)),
            damper_motion=types,
            compliance=harmonic[:bodies] / force,
            peak=_half_range(times, motion, nq)[:bodies],
            multipliers=self.multipliers(x),
            flaw=flaw(plan, equations, instants, times, guards, closing),
            residual=float(np.abs(residual / self.rows).max()),
            unknowns=x[:-1].copy(),
            plan=plan,
        )


def _half_range(times: Array, motion: Array, coordinates: int) -> Array:
    """Half the range of each coordinate, from cubics through positions and velocities."""
    q, v = motion[:, :, :coordinates], motion[:, :, coordinates : 2 * coordinates]
    slope = v * ((times[:, 1] - times[:, 0])[:, None, None])
    low = lowest(q[:, :-1], q[:, 1:], slope[:, :-1], slope[:, 1:]).min(axis=(0, 1))
    high = -lowest(-q[:, :-1], -q[:, 1:], -slope[:, :-1], -slope[:, 1:]).min(axis=(0, 1))
    return 0.5 * (high - low)


def _type(plan: Plan, damper: int) -> str:
    """Type of one damper's motion, in the words of `rig.motion_type`."""
    kinds = plan.sequence.kind[plan.sequence.damper == damper]
    floor = int(np.isin(kinds, (FLOOR, FLOOR_BOUNCE)).sum())
    ceiling = int(np.isin(kinds, (CEILING, CEILING_BOUNCE)).sum())
    if floor + ceiling == 0:
        return "riding"
    if plan.repetition == 1 and floor == 1 and ceiling == 0:
        return "I"
    if plan.repetition == 1 and floor == 1 and ceiling == 1:
        return "III" if CEILING in kinds else "II"
    return f"{floor + ceiling} per {plan.repetition}"


def _event_table(problem: Problem, plan: Plan, instants: Array, closing: Array) -> NDArray[np.void]:
    """Events as `rig.simulate` lists them: a bounce is an impact and a separation at one instant."""
    rows = []
    for time, damper, kind, speed in zip(
        instants, plan.sequence.damper, plan.sequence.kind, closing, strict=True
    ):
        number = problem.system.damper_number[damper]
        if kind in (FLOOR, FLOOR_BOUNCE, CEILING, CEILING_BOUNCE):
            wall = FLOOR_IMPACT if kind in (FLOOR, FLOOR_BOUNCE) else CEILING_IMPACT
            rows.append((time, number, KINDS[wall], speed))
        if kind not in (FLOOR, CEILING):
            rows.append((time, number, KINDS[SEPARATED], 0.0))
    return np.array(rows, dtype=EVENT)
