"""Motion of a system under declared contact laws, with dense matrices in Python: an oracle for the engine.

It reads the declarations (`rig.core.laws.law`) and shares with the engine only the isolation of roots. The state is
X = (coordinates, velocities, drive, 1), where every gap is a coordinate, so that X' = A X in each combination of
regimes. Impulses and holding forces that act on several elements are found by enumeration.
"""

from itertools import product
from math import isfinite
from typing import NamedTuple

import numpy as np

from rig.core.base.arrays import Array
from rig.core.laws.events import NO_EVENT
from rig.core.laws.law import SPEED, Law, Regime, Row, Transition
from rig.core.numerics.bernstein import BERNSTEIN, MAX_HALVINGS, N_COEFFICIENTS, NO_CROSSING, first_crossing
from rig.core.numerics.simd import aligned_zeros
from rig.core.system.drive_generator import DriveGenerator
from rig.core.system.hybrid_system import HybridSystem

#: The product of step and largest rate: the power series then has converged to rounding.
MAX_RATE_TIMES_STEP = 0.5
#: Rounding error of a signal, relative to the sum of the magnitudes of its terms.
ROUNDING = 16 * 2.3e-16
#: A signal is at its limit if it differs by less than this fraction of its terms.
AT_LIMIT = 1e-12
#: A regime ends at its own zero of the holding force, not by another event, if the force is below this fraction.
OWN_ZERO = 1e-9
MAX_EVENTS = 10_000


class Guard(NamedTuple):
    """One end of a signal's interval: the regime is left where side * (row - limit) falls to zero."""

    row: Row
    side: int
    limit: float
    leave: Transition


def guards(regime: Regime) -> list[Guard]:
    """Return the ends of all intervals of a regime."""
    return [
        Guard(signal.row, side, limit, leave)
        for signal in regime.signals
        for side, (limit, leave) in zip((1, -1), signal.ends, strict=True)
        if leave is not None
    ]


class Event(NamedTuple):
    """A logged change of regime; `damper` from 0, time in s, closing speed in m/s."""

    time: float
    damper: int
    kind: int
    speed: float


class Departure:
    """The end of a regime: the guard that ended it, the known zeros of the speed, and the events (kind, speed)."""

    def __init__(self, left: Guard, zeros: int, *events: tuple[int, float]) -> None:
        self.left, self.zeros, self.events = left, zeros, events


class Touch(NamedTuple):
    """An element that touches a wall, which pushes to one side; `guard`: it ends the regime there."""

    element: int
    guard: Guard
    side: int
    restitution: float


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

    def __init__(self, system: HybridSystem, drive: DriveGenerator, state: Array) -> None:
        """`state`: coordinates, velocities and drive; every element is in the regime at its start."""
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
        # Rows whose product with the coordinates is the gap: a joint between two bodies has two entries.
        self.directions = np.zeros((len(self.gaps), n))
        self.directions[np.arange(len(self.gaps)), self.gaps] = 1.0
        self.sliders = [element.slider for element in system.elements]
        for direction, element in zip(self.directions, system.elements, strict=True):
            if element.base >= 0:
                direction[element.base] = -1.0
        for element, gap in zip(system.elements, self.gaps, strict=True):
            if element.gap < 0:
                pair = np.ix_([element.body, gap], [element.body, gap])
                self.mass[pair] += element.mass
                self.force[[element.body, gap], -1] -= element.mass * system.gravity
        self.inverse_mass = np.linalg.inv(self.mass)
        self.regimes, self.time, self.lost = [law.start for law in self.laws], 0.0, 0.0
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
            equations = self._equations(self.regimes)
            step = min(equations.step, end - self.time)
            terms = (equations.powers @ self.state) * _powers(step / equations.step)[:, None]
            crossings = [
                (self._crossing(self._row(j, guard, equations.hold), terms, self._zeros.get((j, k), 0)), j, k)
                for j, regime in self._present_regimes()
                for k, guard in enumerate(guards(regime))
            ]
            first = min(crossings, default=(NO_CROSSING, 0, 0))
            tau = min(first[0], 1.0)
            self._integrate_energy(terms, tau, step, equations)
            self.state, self.time = _powers(tau) @ terms, self.time + tau * step
            if tau > 0.0:
                self._zeros = {}
            if first[0] != NO_CROSSING:
                assert len(self.events) < MAX_EVENTS
                self._leave(first[1], guards(self.laws[first[1]].regimes[self.regimes[first[1]]])[first[2]])

    def stored_energy(self) -> float:
        """Return the kinetic energy and the energy in the springs of the elements, J."""
        velocity = self.state[self.n : 2 * self.n]
        energy = 0.5 * float(velocity @ self.mass @ velocity)
        return energy + sum(self._spring_energy(j, regime) for j, regime in self._present_regimes())

    def _spring_energy(self, j: int, regime: Regime) -> float:
        """Return the energy in the spring of an element in a regime, J."""
        force = regime.force or Row()
        if self.sliders[j] >= 0:
            stiffness = max(-each.force.gap for each in self.laws[j].regimes.values() if each.force is not None)
            return 0.5 * float(self._plain_row(j, force) @ self.state) ** 2 / stiffness
        return -0.5 * force.gap * float(self.directions[j] @ self.state[: self.n] - force.rest) ** 2

    def _present_regimes(self) -> list[tuple[int, Regime]]:
        """Return number and regime of every element."""
        return [(j, law.regimes[name]) for j, (law, name) in enumerate(zip(self.laws, self.regimes, strict=True))]

    def _equations(self, regimes: list[str]) -> Equations:
        """Return the equations of motion in a combination of regimes."""
        key = tuple(regimes)
        if key not in self._cache:
            self._cache[key] = self._new_equations(regimes)
        return self._cache[key]

    def _new_equations(self, regimes: list[str]) -> Equations:
        n, force = self.n, self.force.copy()
        generator = np.zeros((self.size, self.size))
        generator[:n, n : 2 * n] = np.eye(n)
        generator[2 * n : -1, 2 * n : -1] = self.generator
        forces = [law.regimes[name].force for law, name in zip(self.laws, regimes, strict=True)]
        for j, row in enumerate(forces):
            if row is not None:
                force += np.outer(self.directions[j], self._plain_row(j, row))
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
        values[: self.n], values[self.n : 2 * self.n] = row.gap * self.directions[j], row.speed * self.directions[j]
        if self.sliders[j] >= 0:
            values[self.sliders[j]] = row.slider
        values[-1] = row.constant - row.gap * row.rest
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
            for j, regime in self._present_regimes():
                speed, force = float(self.directions[j] @ velocity), regime.force or Row()
                self.lost -= weight * tau * step * (force.speed * speed + force.constant) * speed

    def _leave(self, j: int, guard: Guard) -> None:
        """Apply a transition of element j: jump of velocities, next regime, zeros of its guards, and the events."""
        energy, hold = self.stored_energy(), self._equations(self.regimes).hold
        departures: dict[int, Departure] = {}
        row = self._row(j, guard, hold)
        is_own_zero = bool(abs(row @ self.state) <= OWN_ZERO * (np.abs(row) @ np.abs(self.state)))
        if guard.leave.restitution is not None:
            self._collide(j, guard, departures)
        elif self._regime(j).force is None:
            # Gap and speed are zero, and their accelerations if the force that holds the element is at its limit.
            departures[j] = Departure(guard, 1 + is_own_zero, (guard.leave.event, 0.0))
            self._enter(j, guard.leave.to[0])
        else:
            departures[j] = Departure(guard, 0, (guard.leave.event, abs(self._speed(j))))
            possible = [name for name in guard.leave.to if self._is_possible(j, name, guard)]
            self._enter(j, [*possible, guard.leave.to[-1]][0])
            for i, regime in self._present_regimes():
                stops = [
                    item for k, item in enumerate(guards(regime)) if item.row == SPEED and not self._zeros.get((i, k))
                ]
                if guard.row == SPEED and stops and abs(self._speed(i)) <= self._speed_rounding():
                    departures[i] = Departure(stops[0], 0, (stops[0].leave.event, 0.0))
                    self._enter(i, stops[0].leave.to[0])
        self._release(departures)
        self.lost += energy - self.stored_energy()
        self._zeros = {key: value for key, value in self._zeros.items() if key[0] not in departures}
        for i, departure in sorted(departures.items()):
            self._zeros |= {(i, k): value for k, value in enumerate(self._known_zeros(i, departure))}
            self.events += [Event(self.time, i, kind, speed) for kind, speed in departure.events if kind != NO_EVENT]

    def _regime(self, j: int) -> Regime:
        """Return the present regime of an element."""
        return self.laws[j].regimes[self.regimes[j]]

    def _speed(self, j: int) -> float:
        """Return the rate of change of a gap, m/s."""
        return float(self.directions[j] @ self.state[self.n : 2 * self.n])

    def _speed_rounding(self) -> float:
        """Return the largest speed of a gap that may be a rounding error of zero, m/s."""
        magnitude = np.abs(self.state[: 2 * self.n]).reshape(2, -1).max(axis=1)
        # A displacement changes the velocity by its ratio to the step, within a step.
        return ROUNDING * float(magnitude[1] + magnitude[0] / self._equations(self.regimes).step)

    def _enter(self, j: int, name: str) -> None:
        """Change the regime of an element; the speed of a held element is exactly zero; a slider keeps the force."""
        before, after = self._regime(j).force, self.laws[j].regimes[name].force
        self.regimes[j] = name
        if before is not None and after is not None and after.slider:
            self.state[self.sliders[j]] = 0.0
            change = self._plain_row(j, before) - self._plain_row(j, after)
            self.state[self.sliders[j]] = float(change @ self.state) / after.slider
        if self._regime(j).force is None:
            self.state[self.n + self.gaps[j]] = 0.0

    def _collide(self, j: int, guard: Guard, departures: dict[int, Departure]) -> None:
        """Solve for the impulses of all walls that are touched, by enumeration of those that act."""
        n, touched = self.n, [Touch(j, guard, guard.side, guard.leave.restitution or 0.0)]
        self.state[self.gaps[j]] = guard.limit
        touched += [touch for i in range(len(self.laws)) if i != j and (touch := self._touch(i)) is not None]
        before = {i: self._speed(i) for i in range(len(self.laws))}
        sticks = [i for i, regime in self._present_regimes() if regime.force is None]
        direction = np.zeros((len(touched), n))
        direction[np.arange(len(touched)), [self.gaps[touch.element] for touch in touched]] = [t.side for t in touched]
        matrix, approach = direction @ self.inverse_mass @ direction.T, direction @ self.state[n : 2 * n]
        rebounds = np.array([0.0 if self._is_negligible(touch) else -touch.restitution for touch in touched]) * approach
        for active in product((True, False), repeat=len(touched)):
            on = np.flatnonzero(active)
            impulse = np.zeros(len(touched))
            impulse[on] = np.linalg.solve(matrix[np.ix_(on, on)], (rebounds - approach)[on])
            opening, scale = matrix @ impulse + approach - rebounds, np.abs(matrix) @ np.abs(impulse) + np.abs(approach)
            if (impulse >= 0.0).all() and (opening >= -ROUNDING * scale).all():
                break
        self.state[n : 2 * n] += self.inverse_mass @ direction.T @ impulse
        for touch, acts, pushed, rebound in zip(touched, active, impulse > 0.0, rebounds, strict=True):
            i, leave = touch.element, touch.guard.leave
            if touch.guard.row.hold:
                if acts:
                    self.state[n + self.gaps[i]] = 0.0
            elif pushed or i == j:
                departures[i] = Departure(touch.guard, 0, (leave.event, abs(before[i])))
                moves_away = rebound > 0.0 if acts else touch.side * self._speed(i) > self._speed_rounding()
                self._enter(i, leave.to[0] if moves_away else leave.to[-1])
        velocity = np.abs(self.state[n : 2 * n]).max() + np.abs(list(before.values())).max()
        for i, regime in self._present_regimes():
            for guard in guards(regime):
                # A joint with a slider has no mass: its speed is outside the interval at the next step.
                if guard.row == SPEED and self.sliders[i] < 0 and guard.side * self._speed(i) < 0.0:
                    # Friction is finite, so that the impact has reversed the motion.
                    departures[i] = Departure(guard, 0, (guard.leave.event, 0.0))
                    self.regimes[i] = guard.leave.to[0]
                    sticks.append(i)
        for i in sticks:
            if abs(self._speed(i)) <= ROUNDING * velocity:
                self.state[n + self.gaps[i]] = 0.0
                continue
            away = next(item for item in guards(self._regime(i)) if item.side * self._speed(i) > 0.0)
            events = departures[i].events if i in departures else ()
            departures[i] = Departure(away, 0, *events, (away.leave.event, 0.0))
            self._enter(i, away.leave.to[0])

    def _touch(self, i: int) -> Touch | None:
        """Return the wall that element i touches: it rests on the wall, or its gap is at the limit and closing."""
        for guard in guards(self._regime(i)):
            distance, largest = abs(self.state[self.gaps[i]] - guard.limit), np.abs(self.state[: self.n]).max()
            closes = guard.side * self._speed(i) < 0.0 and distance <= AT_LIMIT * largest
            if guard.row.hold and len(guards(self._regime(i))) == 1:
                return Touch(i, guard, guard.side, 0.0)
            if guard.leave.restitution is not None and closes:
                return Touch(i, guard, guard.side, guard.leave.restitution)
        return None

    def _release(self, departures: dict[int, Departure]) -> None:
        """Release the elements whose holding forces are outside their intervals, by enumeration of those released."""
        held = [(j, guards(regime)) for j, regime in self._present_regimes() if regime.force is None]
        choices = [[None, *ends] for _, ends in held]
        for choice in sorted(product(*choices), key=lambda ends: sum(end is not None for end in ends)):
            regimes = list(self.regimes)
            for (j, _), end in zip(held, choice, strict=True):
                regimes[j] = regimes[j] if end is None else end.leave.to[0]
            equations = self._equations(regimes)
            rate = equations.generator @ self.state
            tolerance = ROUNDING * (np.abs(equations.generator) @ np.abs(self.state))
            if all(
                end.side * rate[self.n + self.gaps[j]] > tolerance[self.n + self.gaps[j]]
                if end is not None
                else all(self._is_inside(self._row(j, guard, equations.hold)) for guard in ends)
                for (j, ends), end in zip(held, choice, strict=True)
            ):
                break
        else:
            raise AssertionError("no consistent holding forces")
        for (j, _), end in zip(held, choice, strict=True):
            if end is not None:
                event = (end.leave.event, 0.0)
                departures[j] = Departure(end, 1, *(departures[j].events if j in departures else ()), event)
                self._enter(j, end.leave.to[0])

    def _is_inside(self, row: Array) -> bool:
        """Return whether a guard is not negative by more than rounding."""
        return bool(row @ self.state >= -ROUNDING * (np.abs(row) @ np.abs(self.state)))

    def _is_negligible(self, touch: Touch) -> bool:
        """Return whether a rebound is lower than the rounding error of the gap: the end of a Zeno sequence."""
        if not touch.restitution or len(touch.guard.leave.to) < 2:
            return False
        j, guard = touch.element, touch.guard
        if touch.restitution * abs(self._speed(j)) <= self._speed_rounding():
            return True
        trial = [*self.regimes[:j], guard.leave.to[0], *self.regimes[j + 1 :]]
        equations = self._equations(trial)
        row = self._row(j, guard, equations.hold)
        approach = -float(row @ (equations.generator @ (equations.generator @ self.state)))
        height = 2 * float(np.abs(self.state[: self.n]).max()) + (abs(guard.limit) if isfinite(guard.limit) else 0.0)
        return approach > 0.0 and (touch.restitution * self._speed(j)) ** 2 < 2 * approach * ROUNDING * height

    def _is_possible(self, j: int, name: str, left: Guard) -> bool:
        """Return whether the first term of every guard that is not zero is positive in a regime."""
        equations = self._equations([*self.regimes[:j], name, *self.regimes[j + 1 :]])
        terms = equations.powers @ self.state
        for guard in guards(self.laws[j].regimes[name]):
            row = self._row(j, guard, equations.hold)
            series = terms[:N_COEFFICIENTS] @ row
            magnitude = (np.abs(terms[:N_COEFFICIENTS]) @ np.abs(row)).sum()
            zeros = self._zeros_of_change(guard, left, bool(abs(series[0]) <= AT_LIMIT * magnitude))
            first = next((k for k in range(zeros, N_COEFFICIENTS) if abs(series[k]) > ROUNDING * magnitude), None)
            if first is not None and series[first] < 0.0:
                return False
        return True

    def _zeros_of_change(self, guard: Guard, left: Guard, is_at_limit: bool) -> int:
        """Return the known zeros of a guard after a transition from a regime that is not held."""
        is_same = (guard.row, guard.limit) == (left.row, left.limit)
        is_touched = bool(guard.row.gap and left.row.gap) and not left.row.hold
        return int(is_at_limit and (is_same or is_touched))

    def _known_zeros(self, j: int, departure: Departure) -> list[int]:
        """Return the number of leading terms of each guard of element j that are zero, after it changed its regime."""
        hold, counts = self._equations(self.regimes).hold, []
        for guard in guards(self._regime(j)):
            row = self._row(j, guard, hold)
            # A gap whose limit is 0 has no other terms than itself, so that the largest coordinate counts.
            scale = np.abs(self.state)
            scale[: 2 * self.n] = np.repeat(scale[: 2 * self.n].reshape(2, -1).max(axis=1), self.n)
            is_at_limit = bool(abs(row @ self.state) <= AT_LIMIT * (np.abs(row) @ scale))
            if not departure.left.row.hold:
                counts.append(self._zeros_of_change(guard, departure.left, is_at_limit))
            elif guard.row.speed and not guard.row.gap:
                counts.append(departure.zeros)
            else:
                # The gap of an element at rest on a wall is exactly that of the wall.
                is_at_wall = guard.row.gap and self.state[self.gaps[j]] == guard.limit
                counts.append(1 + departure.zeros if is_at_wall else 0)
        return counts


def _powers(fraction: float) -> Array:
    """Return the powers of a fraction of a step."""
    return np.asarray(fraction ** np.arange(N_COEFFICIENTS + 1))
