"""General solvers of scipy and SUNDIALS, as alternatives to the engine in `rig cost`.

A change of contact is an event of the solver: the root of a guard, a function that is negative after the change.
`penalty` needs no events, because it replaces the walls with stiff springs.
"""

import time
from collections.abc import Callable
from functools import partial
from typing import Any, Protocol

import numpy as np

from rig.core.base.arrays import Array
from rig.core.base.errors import RunError
from rig.core.laws.events import CEILING_IMPACT, EVENT_NAMES, FLOOR_IMPACT, NO_EVENT
from rig.core.laws.law import GAP
from rig.studies.cost.first_order_form import FLIGHT, ComputedMotion, End, FirstOrderForm

#: After a change of regime, detection of an event is suspended for this time, s, if its guard is at rounding level,
#: such as the guard of a wall that a damper has just left.
GUARD_PAUSE_S = 2e-5
#: A guard is at rounding level if its value is at most this fraction of the magnitudes of its terms.
AT_LIMIT = 1e-9
#: Events at which velocities jump.
IMPACTS = (FLOOR_IMPACT, CEILING_IMPACT)
#: A solver is stopped after this number of events in a period: a damper leaves its wall and lands again without
#: end (chattering).
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
    """Regime of each element, and the guards at which it ends."""

    def __init__(self, problem: FirstOrderForm, guard_pause: float) -> None:
        self.problem, self.guard_pause = problem, guard_pause
        self.regimes = list(problem.start_regimes)
        self.events: list[tuple[float, int, str]] = []
        self._disabled_until: dict[tuple[int, int], float] = {}
        self._update()

    def _update(self) -> None:
        self.matrix, ends = self.problem.flow(self.regimes)
        self.ends = [(j, end) for j, own_ends in enumerate(ends) for end in own_ends]
        self.guards: list[Guard] = [
            self._guard(end.row, self._disabled_until.get((j, k), -np.inf))
            for j, own_ends in enumerate(ends)
            for k, end in enumerate(own_ends)
        ]

    @staticmethod
    def _guard(row: Array, disabled_until: float) -> Guard:
        """Return a guard with the value row @ z. While disabled, it has a positive value and therefore no root."""
        return lambda t, z: float(row @ z) if t > disabled_until else 1.0

    def leave(self, z: Array, now: float, j: int, end: End) -> None:
        """Change the regime of an element at the end of its regime."""
        if end.transition.event != NO_EVENT:
            self.events.append((now, j, str(EVENT_NAMES[end.transition.event])))
        candidates = self.problem.numbers(j, end.transition.to)
        target = next(
            (regime for regime in candidates if end.transition.event in IMPACTS or self._is_inside(z, j, regime)), None
        )
        self.problem.leave(z, j, self.regimes, end, candidates[-1] if target is None else target)
        own_ends = self.problem.flow(self.regimes)[1][j]
        for k, end in enumerate(own_ends):
            self._disabled_until[j, k] = now + self.guard_pause if _is_at_limit(end, z) else -np.inf
        self._update()

    def _is_inside(self, z: Array, j: int, regime: int) -> bool:
        """Return whether no signal is beyond its limit in a regime."""
        ends = self.problem.flow([*self.regimes[:j], regime, *self.regimes[j + 1 :]])[1][j]
        return all(end.row @ z >= 0.0 or _is_at_limit(end, z) for end in ends)

    def release(self, z: Array, now: float) -> None:
        """Leave regimes whose signals an event has moved beyond their limits, one after another."""
        while beyond := [
            (j, end)
            for (j, end), guard in zip(self.ends, self.guards, strict=True)
            if end.transition.event not in IMPACTS and guard(now, z) < 0.0
        ]:
            self.leave(z, now, *beyond[0])


def _is_at_limit(end: End, z: Array) -> bool:
    """Return whether a guard is at rounding level."""
    return bool(abs(end.row @ z) <= AT_LIMIT * (np.abs(end.row) @ np.abs(z)))


def integrate(
    problem: FirstOrderForm, solve_segment: SegmentSolver, guard_pause: float, max_cpu: float
) -> ComputedMotion:
    """Compute the motion with an adaptive solver.

    `guard_pause`: time for which a guard at rounding level is disabled [s]; `max_cpu`: CPU time limit [s].
    Raises `RunError` if events repeat endlessly, or the solver stops or takes too long.
    """
    n, contacts = len(problem.system.points), _Contacts(problem, guard_pause)
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
        contacts.leave(state, now, *contacts.ends[guard])
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
        # A guard may change sign over the step but not in the dense output, so scipy's root search fails.
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
    system, dampers = problem.system, problem.system.dampers
    reduced_mass = 1.0 / (problem.inverse_mass + 1.0 / system.damper_mass)
    omega = np.pi * contacts_per_period * problem.tone.frequency  # contact on the spring lasts half a period
    log_restitution = np.log(np.maximum(system.restitution, 1e-300))
    damping_ratio = np.where(system.restitution > 0.0, -log_restitution / np.hypot(np.pi, log_restitution), 1.0)
    stiffness, dashpot = reduced_mass * omega**2, 2.0 * damping_ratio * reduced_mass * omega
    matrix, ends_in_flight = problem.flow([FLIGHT] * dampers)
    gap_rows = np.array([problem.row(j, GAP) for j in range(dampers)]).reshape(dampers, problem.size)
    # One product with z gives z', the gaps and their rates.
    combined_matrix = np.vstack([matrix, gap_rows, gap_rows @ matrix])
    force_response = np.zeros((problem.size, dampers))
    for j, coordinate in enumerate(problem.body):
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

    walls = [
        (j, end.row, str(EVENT_NAMES[end.transition.event])) for j, ends in enumerate(ends_in_flight) for end in ends
    ]
    start = np.array(problem.start)
    start[problem.first_height : problem.first_height + dampers] -= system.damper_mass * system.gravity / stiffness
    solution = _solve_ivp(
        derivative_of, (0.0, problem.times[-1]), start, method="LSODA", rtol=PENALTY_TOLERANCE, t_eval=problem.times,
        events=[_event(partial(_distance, row)) for _, row, _ in walls],
    )  # fmt: skip
    events = [
        # Dampers begin on the floor, so zeros of the gap to the floor are separation and landing in turn.
        (float(instant), j, "separation" if (k % 2 == 0) == (kind == "floor") else kind)
        for (j, _, kind), times in zip(walls, solution.t_events or (), strict=True)
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
