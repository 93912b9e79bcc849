"""General adaptive solvers with event detection, restarted at every contact change, as their users use them."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.errors import RunError
from rig.work_precision.first_order_form import CEILING, FLIGHT, FLOOR, WALLS, Array, FirstOrderForm, Outcome

#: After a separation its guard is at rounding level; a careful user lets it sleep this long, s.
BLIND = 2e-5
#: A solver that takes off and lands for ever at one instant is stopped after so many events a period.
LIVELOCK = 400

Guard = Callable[[float, Array], float]
#: From (rhs, guards, t, z, sample times ahead) to (t, z, index of the guard that fell or -1, states at samples).
Leg = Callable[
    [Callable[[float, Array], Array], list[Guard], float, Array, Array], tuple[float, Array, int, Array]
]


@dataclass
class _Contacts:
    """Which wall each damper rides on, and which guards sleep until when."""

    mode: NDArray[np.int64]
    blind: dict[tuple[int, int], float]


def follow(problem: FirstOrderForm, leg: Leg, blind: float, limit: float) -> Outcome:
    """Follow the motion with an adaptive solver.

    Parameters
    ----------
    leg : callable
        The solver, from one contact change to the next.
    blind : float
        Time for which a guard sleeps after its separation, s.
    limit : float
        CPU time after which to give up, s.

    Raises
    ------
    RunError
        If the solver locks up or takes too long.
    """
    n = problem.system.coordinates
    contacts = _Contacts(np.full(len(problem.rows), FLOOR), {})
    state, now = problem.start.copy(), 0.0
    samples, times = [state[:n].copy()], problem.times
    events: list[tuple[float, int, str]] = []
    _release(problem, contacts, state, now, blind, events)
    begun = time.process_time()
    while len(samples) < problem.samples:
        ahead = times[len(samples) :]
        walls, guards = _guards(problem, contacts)
        now, state, which, seen = leg(_slope(problem, contacts.mode), guards, now, state, ahead)
        samples += [row[:n].copy() for row in seen]
        if which < 0:
            break
        _change(problem, contacts, state, now, walls[which], blind, events)
        if len(events) > LIVELOCK * problem.periods:
            raise RunError("takes off and lands for ever at one instant")
        if time.process_time() - begun > limit:
            raise RunError(f"not done after {limit:.0f} s")
    return Outcome(np.array(samples).T, events)


def _slope(problem: FirstOrderForm, mode: NDArray[np.int64]) -> Callable[[float, Array], Array]:
    matrix, constant = problem.configuration(mode)
    cosine, sine = problem.drive(mode)
    omega = problem.omega
    return lambda t, z: matrix @ z + constant + cosine * np.cos(omega * t) + sine * np.sin(omega * t)


def _guards(problem: FirstOrderForm, contacts: _Contacts) -> tuple[list[tuple[int, int]], list[Guard]]:
    system, mode = problem.system, contacts.mode
    n, ns = system.coordinates, system.states
    matrix, constant = problem.configuration(mode)
    cosine, sine = problem.drive(mode)
    walls: list[tuple[int, int]] = []
    guards: list[Guard] = []

    def gap(j: int, row: int, wall: int) -> Guard:
        awake = contacts.blind.get((j, wall), -1.0)
        clearance = float(system.clearance[j])
        if wall == FLOOR:
            return lambda t, z: float(z[ns + j] - z[row]) if t > awake else 1.0
        return lambda t, z: float(clearance - z[ns + j] + z[row]) if t > awake else 1.0

    def force(row: int, sign: float) -> Guard:
        omega, line = problem.omega, matrix[n + row]
        c0, cc, cs = float(constant[n + row]) + system.gravity, float(cosine[n + row]), float(sine[n + row])
        return lambda t, z: sign * float(line @ z + c0 + cc * np.cos(omega * t) + cs * np.sin(omega * t))

    for j, row in enumerate(problem.rows):
        if mode[j] != FLIGHT:
            walls.append((j, FLIGHT))
            guards.append(force(int(row), 1.0 if mode[j] == FLOOR else -1.0))
            continue
        for wall in (FLOOR, CEILING) if np.isfinite(system.clearance[j]) else (FLOOR,):
            walls.append((j, wall))
            guards.append(gap(j, int(row), wall))
    return walls, guards


def _change(
    problem: FirstOrderForm, contacts: _Contacts, state: Array, now: float, event: tuple[int, int], blind: float,
    events: list[tuple[float, int, str]],
) -> None:  # fmt: skip
    j, wall = event
    system = problem.system
    n, ns, nd = system.coordinates, system.states, system.dampers
    events.append((now, j, WALLS[wall]))
    if wall == FLIGHT:
        _leave(problem, contacts, state, now, j, blind)
        return
    row = problem.rows[j]
    closing = state[ns + nd + j] - state[n + row]
    restitution = float(system.restitution[j])
    impulse = (1.0 + restitution) * closing / (problem.inverse_mass[j] + 1.0 / system.damper_mass[j])
    state[n + row] += impulse * problem.inverse_mass[j]
    contacts.mode[j] = wall
    state[ns + nd + j] = state[n + row] - restitution * closing
    if restitution > 0.0:
        speed = state[ns + nd + j]
        _leave(problem, contacts, state, now, j, blind)
        state[ns + nd + j] = speed
    _release(problem, contacts, state, now, blind, events)


def _release(
    problem: FirstOrderForm, contacts: _Contacts, state: Array, now: float, blind: float,
    events: list[tuple[float, int, str]],
) -> None:  # fmt: skip
    """Let go of dampers whose contact would pull."""
    changed = True
    while changed:
        changed = False
        walls, guards = _guards(problem, contacts)
        for (j, wall), guard in zip(walls, guards, strict=True):
            if wall == FLIGHT and guard(now, state) < 0.0:
                _leave(problem, contacts, state, now, j, blind)
                events.append((now, j, WALLS[FLIGHT]))
                changed = True
                break


def _leave(
    problem: FirstOrderForm, contacts: _Contacts, state: Array, now: float, j: int, blind: float
) -> None:
    system, row, wall = problem.system, problem.rows[j], int(contacts.mode[j])
    n, ns, nd = system.coordinates, system.states, system.dampers
    state[ns + j] = state[row] + (system.clearance[j] if wall == CEILING else 0.0)
    state[ns + nd + j] = state[n + row]
    contacts.mode[j] = FLIGHT
    contacts.blind[(j, wall)] = now + blind


def scipy_leg(method: str, rtol: float, longest: float) -> Leg:
    """One of scipy's solvers with its event detection."""
    from scipy.integrate import solve_ivp

    def leg(
        rhs: Callable[[float, Array], Array], guards: list[Guard], t: float, z: Array, ahead: Array
    ) -> tuple[float, Array, int, Array]:
        falling = [_falling(guard) for guard in guards]
        try:
            solution = solve_ivp(
                rhs, (t, ahead[-1]), z, method=method, rtol=rtol, atol=1e-3 * rtol, max_step=longest,
                t_eval=ahead, events=falling,
            )  # fmt: skip
        except ValueError as error:
            # Its search for an event's instant may find the sign changed in the step but not in the dense output.
            raise RunError(f"scipy stops with: {error}") from None
        if solution.status < 0:
            raise RunError(str(solution.message))
        seen = solution.y.T if len(solution.t) else np.zeros((0, len(z)))
        for k, hits in enumerate(solution.t_events):
            if len(hits):
                return float(hits[0]), solution.y_events[k][0].copy(), k, seen[solution.t <= hits[0]]
        return float(ahead[-1]), z, -1, seen

    return leg


def _falling(guard: Guard) -> Any:
    def event(t: float, z: Array) -> float:
        return guard(t, z)

    event.terminal = True  # type: ignore[attr-defined]
    event.direction = -1  # type: ignore[attr-defined]
    return event


def cvode_leg(rtol: float, longest: float) -> Leg:
    """SUNDIALS CVODE (Adams) through scikit-sundae."""
    from sksundae.cvode import CVODE

    def leg(
        rhs: Callable[[float, Array], Array], guards: list[Guard], t: float, z: Array, ahead: Array
    ) -> tuple[float, Array, int, Array]:
        def slope(t: float, y: Array, yp: Array) -> None:
            yp[:] = rhs(t, y)

        def events(t: float, y: Array, e: Array) -> None:
            e[:] = [guard(t, y) for guard in guards]

        events.terminal = [True] * len(guards)  # type: ignore[attr-defined]
        events.direction = [-1] * len(guards)  # type: ignore[attr-defined]
        solver = CVODE(
            slope, method="Adams", rtol=rtol, atol=1e-3 * rtol, max_step=longest, max_num_steps=100_000,
            eventsfn=events if guards else None, num_events=len(guards),
        )  # fmt: skip
        solution = solver.solve(np.concatenate([[t], ahead]), z)
        if not solution.success:
            raise RunError(str(solution.message))
        # Between two instants only, the solver returns its own steps, too.
        asked = np.isin(solution.t, ahead)
        if solution.t_events is None or not len(solution.t_events):
            return float(ahead[-1]), z, -1, solution.y[asked]
        at = float(solution.t_events[0])
        which = int(np.flatnonzero(np.asarray(solution.i_events[0]))[0])
        return at, np.array(solution.y_events[0]), which, solution.y[asked & (solution.t <= at)]

    return leg
