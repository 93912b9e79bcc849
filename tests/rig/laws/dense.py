"""Motion of a system under declared contact laws, with dense matrices in Python: an oracle for the engine.

It reads the declarations (`rig.core.laws.law`) and shares with the engine only the isolation of roots. The state is
X = (coordinates, velocities, drive, 1), where every gap is a coordinate, so that X' = A X in each combination of modes.
Impacts that act on other held elements through a common body are not covered.
"""

from __future__ import annotations

from math import isfinite
from typing import NamedTuple

import numpy as np

from rig.core.base.arrays import Array
from rig.core.laws.events import NO_EVENT
from rig.core.laws.law import Exit, Law, Mode, Row
from rig.core.numerics.bernstein import BERNSTEIN, MAX_HALVINGS, N_COEFFICIENTS, NO_CROSSING, first_crossing
from rig.core.numerics.simd import aligned_zeros
from rig.core.system.hybrid_system import Drive, HybridSystem

#: The product of step and largest rate: the power series then has converged to rounding.
MAX_RATE_TIMES_STEP = 0.5
#: Rounding error of a signal, relative to the sum of the magnitudes of its terms.
ROUNDING = 16 * 2.3e-16
#: A signal is at its limit if it differs by less than this fraction of its terms.
AT_LIMIT = 1e-12
#: A mode ends at its own zero of the holding force, not by another event, if the force is below this fraction.
OWN_ZERO = 1e-9
MAX_EVENTS = 10_000


class Guard(NamedTuple):
    """One end of a signal's interval: the mode is left where side * (row - limit) falls to zero."""

    row: Row
    side: int
    limit: float
    leave: Exit


def guards(mode: Mode) -> list[Guard]:
    """Return the ends of all intervals of a mode."""
    return [
        Guard(signal.row, side, limit, leave)
        for signal in mode.signals
        for side, (limit, leave) in zip((1, -1), signal.ends, strict=True)
        if leave is not None
    ]


class Event(NamedTuple):
    """A logged change of mode; `damper` from 0, time in s, closing speed in m/s."""

    time: float
    damper: int
    kind: int
    speed: float


class Equations(NamedTuple):
    """X' = generator X, rows that give the holding forces, step, and terms of the exponential of a step."""

    generator: Array
    hold: Array
    step: float
    powers: Array


class DenseMotion:
    """The motion of a system from its start; `advance` continues it.

    The energy that the elements lost (`lost`) and the work of all other forces (`work`) are integrated, J, and the
    magnitude of their power (`exchanged`), to which rounding errors are proportional.
    """

    def __init__(self, system: HybridSystem, drive: Drive, state: Array) -> None:
        """`state`: coordinates, velocities and drive; every element is in the mode at its start."""
        bodies, inputs = system.coordinates, drive.output
        assert system.states == 2 * bodies, "no further states"
        detached = [element for element in system.elements if element.gap < 0]
        n = bodies + len(detached)
        self.n, self.size, self.generator = n, 2 * n + drive.states + 1, drive.generator
        self.mass, self.force = np.zeros((n, n)), np.zeros((n, self.size))
        self.mass[:bodies, :bodies] = system.mass
        self.force[:bodies, :bodies] = system.force_state[:, :bodies]
        self.force[:bodies, n : n + bodies] = system.force_state[:, bodies:]
        self.force[:bodies, 2 * n : -1] = system.force_drive @ inputs
        self.force[:bodies, -1] = system.force_constant
        gap_of_detached = iter(range(bodies, n))
        self.laws: list[Law] = [element.law for element in system.elements]
        self.gaps = [element.gap if element.gap >= 0 else next(gap_of_detached) for element in system.elements]
        for element, gap in zip(system.elements, self.gaps, strict=True):
            if element.gap < 0:
                pair = np.ix_([element.body, gap], [element.body, gap])
                self.mass[pair] += element.mass
                self.force[[element.body, gap], -1] -= element.mass * system.gravity
        self.inverse_mass = np.linalg.inv(self.mass)
        self.modes, self.time, self.lost = [law.start for law in self.laws], 0.0, 0.0
        self.work = self.exchanged = 0.0
        self.events: list[Event] = []
        self.state = np.concatenate(
            [state[:bodies], np.zeros(n - bodies), state[bodies : 2 * bodies], np.zeros(n - bodies),
             state[2 * bodies : 2 * bodies + drive.states], [1.0]]
        )  # fmt: skip
        self._zeros: dict[tuple[int, int], int] = {}  # known zeros of guards at this instant, by element and guard
        self._cache: dict[tuple[str, ...], Equations] = {}
        self._work_space = aligned_zeros(MAX_HALVINGS + 3, N_COEFFICIENTS), np.zeros((MAX_HALVINGS + 3, 2))

    def advance(self, end: float) -> None:
        """Continue the motion to a time, s."""
        while self.time < end:
            equations = self._equations(self.modes)
            step = min(equations.step, end - self.time)
            terms = (equations.powers @ self.state) * _powers(step / equations.step)[:, None]
            crossings = [
                (self._crossing(self._row(j, guard, equations.hold), terms, self._zeros.get((j, k), 0)), j, k)
                for j, mode in self._present_modes()
                for k, guard in enumerate(guards(mode))
            ]
            first = min(crossings, default=(NO_CROSSING, 0, 0))
            tau = min(first[0], 1.0)
            self._integrate_energy(terms, tau, step, equations)
            self.state, self.time = _powers(tau) @ terms, self.time + tau * step
            if tau > 0.0:
                self._zeros = {}
            if first[0] != NO_CROSSING:
                assert len(self.events) < MAX_EVENTS
                self._leave(first[1], guards(self.laws[first[1]].modes[self.modes[first[1]]])[first[2]])

    def stored_energy(self) -> float:
        """Return the kinetic energy and the energy in the springs of the elements, J."""
        velocity = self.state[self.n : 2 * self.n]
        energy = 0.5 * float(velocity @ self.mass @ velocity)
        return energy + sum(self._spring_energy(j, mode) for j, mode in self._present_modes())

    def _spring_energy(self, j: int, mode: Mode) -> float:
        """Return the energy in the spring of an element in a mode, J."""
        force = mode.force or Row()
        return -0.5 * force.gap * float(self.state[self.gaps[j]] - force.rest) ** 2

    def _present_modes(self) -> list[tuple[int, Mode]]:
        """Return number and mode of every element."""
        return [(j, law.modes[name]) for j, (law, name) in enumerate(zip(self.laws, self.modes, strict=True))]

    def _equations(self, modes: list[str]) -> Equations:
        """Return the equations of motion in a combination of modes."""
        key = tuple(modes)
        if key not in self._cache:
            self._cache[key] = self._new_equations(modes)
        return self._cache[key]

    def _new_equations(self, modes: list[str]) -> Equations:
        n, force = self.n, self.force.copy()
        generator = np.zeros((self.size, self.size))
        generator[:n, n : 2 * n] = np.eye(n)
        generator[2 * n : -1, 2 * n : -1] = self.generator
        forces = [law.modes[name].force for law, name in zip(self.laws, modes, strict=True)]
        for j, row in enumerate(forces):
            if row is not None:
                force[self.gaps[j]] += self._plain_row(j, row)
        held = [j for j, row in enumerate(forces) if row is None]
        hold = np.zeros((len(forces), self.size))
        if held:
            rows = [self.gaps[j] for j in held]
            hold[held] = -np.linalg.solve(self.inverse_mass[np.ix_(rows, rows)], self.inverse_mass[rows] @ force)
            force[rows] += hold[held]
            generator[n : 2 * n] = self.inverse_mass @ force
            generator[n + np.array(rows)] = 0.0  # exactly, so that a held gap remains at rest
        else:
            generator[n : 2 * n] = self.inverse_mass @ force
        step = MAX_RATE_TIMES_STEP / max(float(np.abs(np.linalg.eigvals(generator)).max()), 1.0)
        powers = [np.eye(self.size)]
        for k in range(1, N_COEFFICIENTS + 1):
            powers.append(powers[-1] @ generator * (step / k))
        return Equations(generator, hold, step, np.array(powers))

    def _plain_row(self, j: int, row: Row) -> Array:
        """Return a row without holding force as a row of the state."""
        values = np.zeros(self.size)
        values[self.gaps[j]], values[self.n + self.gaps[j]], values[-1] = row.gap, row.speed, -row.gap * row.rest
        return values

    def _row(self, j: int, guard: Guard, hold: Array) -> Array:
        """Return a guard as a row of the state."""
        row = guard.side * (self._plain_row(j, guard.row) + guard.row.hold * hold[j])
        row[-1] -= guard.side * guard.limit
        return row

    def _crossing(self, row: Array, terms: Array, zeros: int) -> float:
        """Return the first fraction of a step at which a guard falls to zero, or `NO_CROSSING`."""
        series = aligned_zeros(N_COEFFICIENTS)
        series[:] = terms[:N_COEFFICIENTS] @ row
        magnitude = float((np.abs(terms[:N_COEFFICIENTS]) @ np.abs(row)).sum())
        return float(first_crossing(series, zeros, ROUNDING * magnitude, *self._work_space, BERNSTEIN)[0])

    def _integrate_energy(self, terms: Array, tau: float, step: float, equations: Equations) -> None:
        """Add the work of all forces outside the elements, and the loss in dashpots, over a part of a step."""
        nodes, weights = np.polynomial.legendre.leggauss(8)
        for node, weight in zip((nodes + 1) / 2, weights / 2, strict=True):
            state = _powers(node * tau) @ terms
            velocity = state[self.n : 2 * self.n]
            power = float(velocity @ self.force @ state)
            self.work += weight * tau * step * power
            self.exchanged += weight * tau * step * abs(power)
            for j, mode in self._present_modes():
                speed = velocity[self.gaps[j]]
                self.lost -= weight * tau * step * (mode.force or Row()).speed * float(speed) ** 2

    def _leave(self, j: int, guard: Guard) -> None:
        """Apply an exit of element j: jump of velocities, next mode, known zeros of its guards, and the event."""
        n, gap, energy = self.n, self.gaps[j], self.stored_energy()
        before, was_held = self._equations(self.modes), self.laws[j].modes[self.modes[j]].force is None
        left_row = self._row(j, guard, before.hold)
        is_own_zero = abs(left_row @ self.state) <= OWN_ZERO * (np.abs(left_row) @ np.abs(self.state))
        speed = abs(float(self.state[n + gap]))
        if guard.leave.restitution is not None:
            self._reject_coupled_impact(j)
            self.state[gap] = guard.limit
            self._set_speed(j, -guard.leave.restitution * self.state[n + gap])
        candidates = guard.leave.to
        if guard.leave.restitution and len(candidates) > 1 and self._is_negligible(j, guard):
            candidates = candidates[1:]
        for name in candidates:
            trial = [*self.modes[:j], name, *self.modes[j + 1 :]]
            mode, state = self.laws[j].modes[name], self.state.copy()
            if mode.force is None and guard.leave.restitution:
                self._set_speed(j, 0.0)
            zeros = self._known_zeros(j, trial, guard, was_held, bool(is_own_zero))
            if zeros is not None or name == candidates[-1]:
                break
            self.state = state
        self.modes, self._zeros = trial, {key: value for key, value in self._zeros.items() if key[0] != j}
        self._zeros |= {(j, k): value for k, value in enumerate(zeros or ())}
        self.lost += energy - self.stored_energy()
        if guard.leave.event != NO_EVENT:
            self.events.append(Event(self.time, j, guard.leave.event, speed))

    def _set_speed(self, j: int, speed: float) -> None:
        """Set the speed of a gap by an impulse along it; exactly."""
        n, gap = self.n, self.gaps[j]
        change = self.inverse_mass[:, gap] / self.inverse_mass[gap, gap]
        self.state[n : 2 * n] += change * (speed - self.state[n + gap])
        self.state[n + gap] = speed

    def _reject_coupled_impact(self, j: int) -> None:
        for i, mode in self._present_modes():
            if i != j and mode.force is None:
                assert abs(self.inverse_mass[self.gaps[i], self.gaps[j]]) < 1e-14, "coupled impact"

    def _is_negligible(self, j: int, guard: Guard) -> bool:
        """Return whether a rebound is lower than the rounding error of the gap: the end of a Zeno sequence."""
        trial = [*self.modes[:j], guard.leave.to[0], *self.modes[j + 1 :]]
        equations = self._equations(trial)
        row = self._row(j, guard, equations.hold)
        approach = -float(row @ (equations.generator @ (equations.generator @ self.state)))
        height = 2 * float(np.abs(self.state[: self.n]).max()) + (abs(guard.limit) if isfinite(guard.limit) else 0.0)
        return approach > 0.0 and self.state[self.n + self.gaps[j]] ** 2 < 2 * approach * ROUNDING * height

    def _known_zeros(
        self, j: int, modes: list[str], left: Guard, was_held: bool, is_own_zero: bool
    ) -> list[int] | None:
        """Return the number of leading terms of each guard of element j that are zero; None: the mode is impossible."""
        equations, counts = self._equations(modes), []
        terms = equations.powers @ self.state
        for guard in guards(self.laws[j].modes[modes[j]]):
            row = self._row(j, guard, equations.hold)
            series = terms[:N_COEFFICIENTS] @ row
            magnitude = (np.abs(terms[:N_COEFFICIENTS]) @ np.abs(row)).sum()
            is_at_limit, zeros = abs(series[0]) <= AT_LIMIT * magnitude, 0
            if was_held and guard.row.gap and not guard.row.speed:
                zeros = 2 + is_own_zero if is_at_limit else 0
            elif was_held and guard.row.speed:
                zeros = 1 + is_own_zero
            elif (guard.row, guard.limit) == (left.row, left.limit) or (
                guard.row.gap and left.row.gap and is_at_limit and not left.row.hold
            ):
                zeros = 1
            first = next((k for k in range(zeros, N_COEFFICIENTS) if abs(series[k]) > ROUNDING * magnitude), None)
            if first is not None and series[first] < 0.0:
                return None
            counts.append(zeros)
        return counts


def _powers(fraction: float) -> Array:
    """Return the powers of a fraction of a step."""
    return np.asarray(fraction ** np.arange(N_COEFFICIENTS + 1))
