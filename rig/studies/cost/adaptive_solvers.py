"""General solvers of scipy and SUNDIALS, as alternatives to the engine in `rig cost`.

Contact events are events: the solver locates the root of a guard, a function that is negative after the change.
`penalty` needs no events, because it replaces the walls with stiff springs.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any, Protocol

import numpy as np

from rig.core.base.arrays import Array
from rig.core.base.errors import RunError
from rig.studies.cost.first_order_form import CEILING, EVENT_KINDS, FLIGHT, FLOOR, ComputedMotion, FirstOrderForm

#: Event detection at a wall is suspended for this time after a damper leaves it, s: its guard is at rounding level.
GUARD_PAUSE_S = 2e-5
#: A solver is stopped after this number of events in a period: a damper leaves its wall and lands endlessly
#: (chattering).
MAX_EVENTS_PER_PERIOD = 400
#: Relative tolerance for motion on penalty springs; the springs themselves cause larger errors.
PENALTY_TOLERANCE = 1e-8
#: Message about a solver with endless events at one instant.
ENDLESS_EVENTS = "a damper leaves its wall and lands endlessly at {:.6g} s, which a guard pause prevents"
#: Message about a solver that stops before the end.
SOLVER_STOPPED = "{} stops with the message: {}"

Guard = Callable[[float, Array], float]


class SegmentSolver(Protocol):
    """Integrates z' = M z up to the first root of a guard, or to the last sample time."""

    def __call__(
        self, matrix: Array, guards: list[Guard], t: float, z: Array, times: Array
    ) -> tuple[float, Array, int, Array]:
        """Return time and state at the end, index of the guard (-1: none), and the states at the `times` until then."""


class _Contacts:
    """Contact state of each damper, and the guards of the contact events that are possible from it."""

    def __init__(self, problem: FirstOrderForm, guard_pause: float) -> None:
        self.problem, self.guard_pause = problem, guard_pause
        self.contact_states = [FLOOR] * len(problem.damper_coordinate)
        self.events: list[tuple[float, int, str]] = []
        self._disabled_until: dict[tuple[int, int], float] = {}
        self._update()

    def _update(self) -> None:
        problem = self.problem
        self.matrix: Array = problem.matrix(self.contact_states)
        self.changes: list[tuple[int, int]] = []  # damper and new contact state at the root of each guard
        self.guards: list[Guard] = []
        for j, wall in enumerate(self.contact_states):
            if wall != FLIGHT:
                self._add_guard(j, FLIGHT, problem.contact_force_row(j, wall, self.matrix))
                continue
            for new_wall in (FLOOR, CEILING) if np.isfinite(problem.clearance[j]) else (FLOOR,):
                disabled_until = self._disabled_until.get((j, new_wall), -np.inf)
                self._add_guard(j, new_wall, problem.gap_row(j, new_wall), disabled_until)

    def _add_guard(self, j: int, new_state: int, row: Array, disabled_until: float = -np.inf) -> None:
        """Add a guard with the value row @ z. While disabled, it has a positive value and therefore no root."""
        self.changes.append((j, new_state))
        self.guards.append(lambda t, z: float(row @ z) if t > disabled_until else 1.0)

    def change(self, z: Array, now: float, j: int, wall: int) -> None:
        """Separate a damper from its wall if `wall` is `FLIGHT`; otherwise apply an impact on this wall."""
        problem, wall_before = self.problem, self.contact_states[j]
        self.events.append((now, j, EVENT_KINDS[wall]))
        if wall == FLIGHT:
            problem.separate(z, j, wall_before, z[problem.system.coordinates + problem.damper_coordinate[j]])
            self._disabled_until[j, wall_before] = now + self.guard_pause
            self.contact_states[j] = FLIGHT
        elif problem.impact(z, j, wall, float(problem.system.restitution[j])):
            self.contact_states[j] = wall
        else:
            self._disabled_until[j, wall] = now + self.guard_pause
        self._update()

    def release(self, z: Array, now: float) -> None:
        """Separate dampers with a tensile contact force, one after another."""
        while tensile := [
            j
            for (j, wall), guard in zip(self.changes, self.guards, strict=True)
            if wall == FLIGHT and guard(now, z) < 0.0
        ]:
            self.change(z, now, tensile[0], FLIGHT)


def integrate(
    problem: FirstOrderForm, solve_segment: SegmentSolver, guard_pause: float, max_cpu: float
) -> ComputedMotion:
    """Compute the motion with an adaptive solver.

    `guard_pause`: time for which a guard is disabled after the damper leaves the wall, s; `max_cpu`: CPU time limit, s.
    Raises `RunError` if events repeat endlessly, or the solver stops or takes too long.
    """
    n, contacts = problem.system.coordinates, _Contacts(problem, guard_pause)
    state, now, times = np.array(problem.start), 0.0, problem.times
    samples = [state[:n]]
    cpu_start = time.process_time()
    contacts.release(state, now)
    while len(samples) < problem.samples:
        now, state, guard, segment_samples = solve_segment(
            contacts.matrix, contacts.guards, now, state, times[len(samples) :]
        )
        samples += list(segment_samples[:, :n])
        if guard < 0:
            break
        contacts.change(state, now, *contacts.changes[guard])
        contacts.release(state, now)
        if len(contacts.events) > MAX_EVENTS_PER_PERIOD * problem.periods:
            raise RunError(ENDLESS_EVENTS.format(now))
        if time.process_time() - cpu_start > max_cpu:
            raise RunError(f"not completed within {max_cpu:.0f} s of CPU time; a larger tolerance takes less time")
    return ComputedMotion(np.array(samples).T, contacts.events)


def scipy_solver(method: str, rtol: float, max_step: float) -> SegmentSolver:
    """Return a solver of scipy, with its event detection; with the arguments of `solve_ivp`."""

    def solve_segment(
        matrix: Array, guards: list[Guard], t: float, z: Array, times: Array
    ) -> tuple[float, Array, int, Array]:
        solution = _solve_ivp(
            lambda _, z: matrix.dot(z), (t, times[-1]), z, method=method, rtol=rtol, max_step=max_step,
            t_eval=times, events=[_event(guard, terminal=True, direction=-1) for guard in guards],
        )  # fmt: skip
        samples = solution.y.T if len(solution.t) else np.zeros((0, len(z)))
        for k, event_times in enumerate(solution.t_events or ()):
            if len(event_times):
                event_state = solution.y_events[k][0].copy()
                return float(event_times[0]), event_state, k, samples[solution.t <= event_times[0]]
        return float(times[-1]), z, -1, samples

    return solve_segment


def _solve_ivp(*arguments: Any, rtol: float, **options: Any) -> Any:
    from scipy.integrate import solve_ivp

    try:
        solution = solve_ivp(*arguments, rtol=rtol, atol=1e-3 * rtol, **options)
    except ValueError as error:
        # A guard may change sign over the step but not in the dense output, so that scipy's root search fails.
        raise RunError(SOLVER_STOPPED.format("scipy", error)) from None
    if solution.status < 0:
        raise RunError(SOLVER_STOPPED.format("scipy", solution.message))
    return solution


def _event(guard: Guard, **attributes: Any) -> Any:
    def event(t: float, z: Array) -> float:
        return guard(t, z)

    vars(event).update(attributes)
    return event


def penalty(problem: FirstOrderForm, contacts_per_period: int) -> ComputedMotion:
    """Compute the motion with a spring and dashpot at every wall, by scipy's LSODA.

    The damping ratio zeta of the contact follows from the restitution e = exp(-pi zeta / sqrt(1 - zeta^2)). The dashpot
    also acts in tension, at the end of a contact: without tension, contacts for e = 0 would have a restitution of 0.13.

    `contacts_per_period`: contact durations (half periods on the spring) in a period of the drive.
    """
    system, dampers = problem.system, len(problem.damper_coordinate)
    reduced_mass = 1.0 / (problem.inverse_mass + 1.0 / system.damper_mass)
    omega = np.pi * contacts_per_period * problem.tone.frequency  # contact on the spring lasts half a period
    log_restitution = np.log(np.maximum(system.restitution, 1e-300))
    damping_ratio = np.where(system.restitution > 0.0, -log_restitution / np.hypot(np.pi, log_restitution), 1.0)
    stiffness, dashpot = reduced_mass * omega**2, 2.0 * damping_ratio * reduced_mass * omega
    matrix = problem.matrix([FLIGHT] * dampers)
    gap_rows = np.array([problem.gap_row(j, FLOOR) for j in range(dampers)]).reshape(dampers, problem.size)
    # One product with z gives z', the gaps and their rates.
    combined_matrix = np.vstack([matrix, gap_rows, gap_rows @ matrix])
    force_response = np.zeros((problem.size, dampers))
    for j, coordinate in enumerate(problem.damper_coordinate):
        force_response[system.coordinates + coordinate, j] = -problem.inverse_mass[j]
        force_response[problem.first_height + dampers + j, j] = 1.0 / system.damper_mass[j]

    def derivative_of(_: float, z: Array) -> Array:
        product = combined_matrix.dot(z)
        gap, gap_rate = product[problem.size : -dampers], product[-dampers:]
        # Negative at the floor, positive at the ceiling.
        penetration = gap - np.minimum(np.maximum(gap, 0.0), system.clearance)
        derivative = product[: problem.size]
        if penetration.any():
            derivative += force_response.dot(-stiffness * penetration - (penetration != 0.0) * dashpot * gap_rate)
        return derivative

    walls = [(j, FLOOR) for j in range(dampers)]
    walls += [(j, CEILING) for j in range(dampers) if np.isfinite(system.clearance[j])]
    start = np.array(problem.start)
    start[problem.first_height : problem.first_height + dampers] -= system.damper_mass * system.gravity / stiffness
    solution = _solve_ivp(
        derivative_of, (0.0, problem.times[-1]), start, method="LSODA", rtol=PENALTY_TOLERANCE, t_eval=problem.times,
        events=[_event(partial(_distance, problem.gap_row(*wall))) for wall in walls],
    )  # fmt: skip
    events = [
        # Dampers begin on the floor, so that zeros of the gap to the floor are separation and landing in turn.
        (float(instant), j, EVENT_KINDS[FLIGHT if (k % 2 == 0) == (wall == FLOOR) else wall])
        for (j, wall), times in zip(walls, solution.t_events or (), strict=True)
        for k, instant in enumerate(times)
    ]
    return ComputedMotion(solution.y[: system.coordinates], sorted(events))


def _distance(gap_row: Array, _: float, z: Array) -> float:
    return float(gap_row @ z)


def cvode_solver(rtol: float, max_step: float) -> SegmentSolver:
    """Return the solver CVODE (Adams) of SUNDIALS, from the package scikit-sundae."""
    from sksundae.cvode import CVODE

    def solve_segment(
        matrix: Array, guards: list[Guard], t: float, z: Array, times: Array
    ) -> tuple[float, Array, int, Array]:
        def derivative(t: float, y: Array, yp: Array) -> None:
            matrix.dot(y, out=yp)

        def events(t: float, y: Array, values: Array) -> None:
            values[:] = [guard(t, y) for guard in guards]

        vars(events).update(terminal=[True] * len(guards), direction=[-1] * len(guards))
        solver = CVODE(
            derivative, method="Adams", rtol=rtol, atol=1e-3 * rtol, max_step=max_step, max_num_steps=100_000,
            eventsfn=events if guards else None, num_events=len(guards),
        )  # fmt: skip
        solution = solver.solve(np.concatenate([[t], times]), z)
        if not solution.success:
            raise RunError(SOLVER_STOPPED.format("CVODE", solution.message))
        # Between two instants, the solver also returns its internal steps.
        requested = np.isin(solution.t, times)
        if solution.t_events is None or not len(solution.t_events):
            return float(times[-1]), z, -1, solution.y[requested]
        event_time = float(solution.t_events[0])
        guard_index = int(np.flatnonzero(np.asarray(solution.i_events[0]))[0])
        return (
            event_time,
            np.array(solution.y_events[0]),
            guard_index,
            solution.y[requested & (solution.t <= event_time)],
        )

    return solve_segment
