"""Equations of motion in first-order form z' = M z, with one matrix M for each combination of damper contacts.

`rig cost` solves them by methods that an engineer could use instead of the engine (scipy, SUNDIALS, time stepping), and
compares error and computing time. The engine itself does not use this form.
"""

import math
from collections.abc import Callable, MutableSequence, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.core.base.arrays import Array
from rig.core.base.errors import SceneError
from rig.core.laws.law import Regime, Row, Transition
from rig.core.system.hybrid_system import Element, HybridSystem
from rig.core.system.open_loop_drive import ToneDrive

#: Regime of each element, by its number in the law.
Regimes = Sequence[int]

#: Number of samples per period at which methods are compared.
SAMPLES_PER_PERIOD = 16
#: Regimes of a bed with instantaneous contact, and the kind of the event that starts each of them.
FLIGHT, FLOOR, CEILING = 0, 1, 2
EVENT_KINDS = ("separation", "floor", "ceiling")


@dataclass(frozen=True)
class ComputedMotion:
    """Motion computed by a method."""

    displacement: Array  # m, at `SAMPLES_PER_PERIOD` samples per period; shape (points, samples)
    events: list[tuple[float, int, str]]  # time [s], element (from 0), kind


class End(NamedTuple):
    """An end of a regime: the regime lasts while the product of the row with z is positive."""

    row: NDArray[Any]
    limit: float  # limit of the signal
    transition: Transition


class FirstOrderForm:
    """z' = M z with z = (states, heights and speeds of the elements, 1, cos w t, sin w t, integrals) under a tone.

    An element whose gap is a coordinate has no height and speed: its entries are not used.

    `periods`: length of the motion, in periods of the drive; `number_type`: converts a float to the number type of the
    computation, such as `Decimal`; `pi`: its value in that type; `integrals`: whether z ends with the real and
    imaginary parts of the integral of each coordinate times exp(-i w t). Raises `SceneError` if an impact would change
    the velocity of other bodies or dampers as well.
    """

    def __init__(
        self, system: HybridSystem, tone: ToneDrive, periods: int, number_type: Callable[[float], Any] = float,
        pi: Any = math.pi, integrals: bool = False,
    ) -> None:  # fmt: skip
        if system.impacts_interact:
            raise SceneError(
                "structure: the compared methods require a diagonal mass matrix and at most one damper in a body. "
                "Choose a scene without these couplings."
            )
        self.system, self.tone, self.periods = system, tone, periods
        n, ns, elements = system.coordinates, system.states, len(system.elements)
        # Positions in z of the first element's height, and of the constant 1, which cosine and sine follow.
        self.first_height, self.constant_index = ns, ns + 2 * elements
        self._integrals = n if integrals else 0
        self.size = ns + 2 * elements + 3 + 2 * self._integrals  # length of z
        self.omega = 2 * pi * number_type(tone.frequency)
        self.samples = periods * SAMPLES_PER_PERIOD + 1
        # Coordinate of the body to which the gap of each element is measured, and the inverse mass of that body [1/kg].
        self.body = np.asarray(system.body_coordinate, dtype=np.int64)
        self.inverse_mass = 1.0 / np.diag(system.mass)[self.body]
        self.exact = np.vectorize(
            lambda value: number_type(float(value)), otypes=[float if number_type is float else object]
        )
        self.mass, self.element_mass = self.exact(system.mass), self.exact(system.element_mass)
        self.gravity, self._zero, self._unit = number_type(system.gravity), number_type(0.0), number_type(1.0)
        drive_columns = self.exact(np.column_stack([tone.amplitudes.real, -tone.amplitudes.imag]))
        self._force, self._rate = (
            np.hstack([self.exact(state), self.exact(constant)[:, None], self.exact(drive) @ drive_columns])
            for state, constant, drive in (
                (system.force_state, system.force_constant, system.force_drive),
                (system.rate_state, np.zeros(ns - 2 * n), system.rate_drive),
            )
        )
        self._driven_columns = [*range(ns), *range(self.constant_index, self.constant_index + 3)]
        state = np.array(tone.state, dtype=np.float64)
        joint_regimes = system.joint_regimes(state)
        self.start_regimes = [*system.start_regimes.tolist()[: system.dampers], *joint_regimes]
        self.start = [*self.exact(state), *self.exact(state[self.body]), *self.exact(state[n + self.body])]
        self.start += [self._unit, self._unit] + [self._zero] * (1 + 2 * self._integrals)

    @property
    def times(self) -> Array:
        """Return the sample times [s]."""
        return np.arange(self.samples) / (SAMPLES_PER_PERIOD * self.tone.frequency)

    def regime(self, j: int, regimes: Regimes) -> Regime:
        """Return the current regime of an element."""
        return list(self.system.elements[j].law.regimes.values())[regimes[j]]

    def numbers(self, j: int, names: Sequence[str]) -> list[int]:
        """Return the numbers of regimes of an element."""
        return [list(self.system.elements[j].law.regimes).index(name) for name in names]

    def matrix(self, regimes: Regimes) -> NDArray[Any]:
        """Compute M (size, size) in a combination of regimes."""
        return self._solve(regimes)[0]

    def _solve(self, regimes: Regimes) -> tuple[NDArray[Any], NDArray[Any]]:
        """Compute M (size, size), and rows (elements, size) whose products with z are the holding forces [N]."""
        n, ns, elements = self.system.coordinates, self.system.states, len(self.system.elements)
        mass, force, columns = self.mass.copy(), self._force.copy(), self._driven_columns
        matrix, hold = np.full((self.size, self.size), self._zero), np.full((elements, self.size), self._zero)
        held = []
        for j, element in enumerate(self.system.elements):
            row = self.regime(j, regimes).force
            if row is not None and element.gap >= 0:
                for i, factor in self._direction(element):
                    force[i] += factor * self.row(j, row)[columns]
            elif row is not None:
                # Between contacts only its weight acts on a mass whose position is not a coordinate.
                assert row == Row(), element.name
                matrix[self.first_height + j, self.first_height + elements + j] = self._unit
                matrix[self.first_height + elements + j, self.constant_index] = -self.gravity
            else:
                held.append(j)
                if element.gap < 0:
                    mass[element.body, element.body] += self.element_mass[j]
                    force[element.body, ns] -= self.element_mass[j] * self.gravity
        gaps = [self.system.elements[j].gap for j in held if self.system.elements[j].gap >= 0]
        moving = [i for i in range(n) if i not in gaps]
        matrix[range(n), range(n, 2 * n)] = self._unit
        matrix[np.ix_([n + i for i in moving], columns)] = solve(mass[np.ix_(moving, moving)], force[moving])
        matrix[2 * n : ns, columns] = self._rate
        for j in held:
            i, body = self.system.elements[j].gap, self.body[j]
            if i >= 0:
                hold[j] = mass[i] @ matrix[n : 2 * n]
                hold[j, columns] -= force[i]
            else:
                hold[j] = self.element_mass[j] * matrix[n + body]
                hold[j, self.constant_index] += self.element_mass[j] * self.gravity
        cosine, sine, real_column = self.constant_index + 1, self.constant_index + 2, self.constant_index + 3
        matrix[cosine, sine], matrix[sine, cosine] = -self.omega, self.omega
        for k in range(self._integrals):
            imaginary_column = real_column + self._integrals + k
            matrix[real_column + k, k] = self._unit
            matrix[real_column + k, imaginary_column], matrix[imaginary_column, real_column + k] = (
                -self.omega,
                self.omega,
            )
        return matrix, hold

    def _direction(self, element: Element) -> list[tuple[int, Any]]:
        """Return each coordinate that changes the gap, with its sign: the gap is the sum of signs times coordinates."""
        return [(i, self._unit if factor > 0.0 else -self._unit) for i, factor in element.direction]

    def row(self, j: int, row: Row) -> NDArray[Any]:
        """Return a row of a law without holding force as a row vector, whose product with z is the value of the row."""
        element, n = self.system.elements[j], self.system.coordinates
        gap, speed, constant, rest, slider = self.exact([row.gap, row.speed, row.constant, row.rest, row.slider])
        vector = np.full(self.size, self._zero)
        for i, factor in self._direction(element):
            vector[i] += factor * gap
            vector[n + i] += factor * speed
        if element.gap < 0:
            height = self.first_height + j
            vector[height] += gap
            vector[element.body] -= gap
            vector[height + len(self.system.elements)] += speed
            vector[n + element.body] -= speed
        if element.slider >= 0:
            vector[element.slider] += slider
        vector[self.constant_index] += constant - gap * rest
        return vector

    def flow(self, regimes: Regimes) -> tuple[NDArray[Any], list[list[End]]]:
        """Return M and the ends of the regime of each element, in a combination of regimes."""
        matrix, hold = self._solve(regimes)
        ends = [
            [
                End(side * self._distance(j, signal.row, limit, hold[j]), limit, transition)
                for signal in self.regime(j, regimes).signals
                for side, (limit, transition) in zip((1, -1), signal.ends, strict=True)
                if transition is not None
            ]
            for j in range(len(self.system.elements))
        ]
        return matrix, ends

    def _distance(self, j: int, row: Row, limit: float, hold: NDArray[Any]) -> NDArray[Any]:
        """Return the row vector of a signal minus its limit."""
        vector = self.row(j, row)
        if row.hold:
            vector = vector + self.exact(row.hold)[()] * hold
        vector[self.constant_index] -= self.exact(limit)[()]
        return vector

    def leave(
        self, z: MutableSequence[Any] | Array, j: int, regimes: MutableSequence[int], end: End, target: int
    ) -> None:
        """Change the regime in place: velocities after an impact, held gap and slider of the new regime."""
        element, n, elements = self.system.elements[j], self.system.coordinates, len(self.system.elements)
        before, height, speed = self.regime(j, regimes), self.first_height + j, self.first_height + elements + j
        regimes[j] = target
        after, rebound = self.regime(j, regimes), self._zero
        if end.transition.restitution is not None:
            # A mass that stays at its wall does not rebound: the impulse is that of a plastic impact.
            rebound = self._collide(z, j, 0.0 if after.force is None else end.transition.restitution)
        if element.gap < 0:
            limit = self.exact(before.wall_gap if before.force is None else end.limit)[()]
            z[height], z[speed] = z[element.body] + limit, z[n + element.body] + rebound
        elif after.force is None:
            z[n + element.gap] = self._zero
            if after.wall:
                z[element.gap] = self.exact(after.wall_gap)[()]
        elif end.transition.restitution is not None:
            z[element.gap], z[n + element.gap] = self.exact(end.limit)[()], rebound
        if element.slider >= 0 and before.force is not None and after.force is not None and after.force.slider:
            # The force does not jump.
            z[element.slider] = self._zero
            force = np.dot(self.row(j, before.force) - self.row(j, after.force), z)
            z[element.slider] = force / self.exact(after.force.slider)[()]

    def _collide(self, z: MutableSequence[Any] | Array, j: int, restitution: float) -> Any:
        """Apply an impact by Newton's impact law to the bodies; return the speed of the gap after it."""
        element, n = self.system.elements[j], self.system.coordinates
        speed = np.dot(self.row(j, Row(speed=1.0)), z)
        unit = np.full((n, 1), self._zero)
        unit[element.gap if element.gap >= 0 else element.body, 0] = self._unit
        response = solve(self.mass, unit)[:, 0]
        yielding = response[element.gap] if element.gap >= 0 else response[element.body] + 1 / self.element_mass[j]
        change = (1 + self.exact(restitution)[()]) * speed / yielding
        for i in range(n):
            z[n + i] += (-change if element.gap >= 0 else change) * response[i]
        return -self.exact(restitution)[()] * speed


def solve(matrix: NDArray[Any], right_hand_side: NDArray[Any]) -> NDArray[Any]:
    """Solve linear equations; by Gauss-Jordan elimination for number types other than float.

    >>> solve(np.array([[0, 2], [4, 2]], dtype=object), np.array([[6], [10]], dtype=object)).tolist()
    [[1.0], [3.0]]
    """
    if matrix.dtype != object:
        return np.linalg.solve(matrix, right_hand_side)
    rows, count = np.hstack([matrix, right_hand_side]), len(matrix)
    for i in range(count):
        pivot = i + int(np.argmax(np.abs(rows[i:, i])))
        rows[[i, pivot]] = rows[[pivot, i]]
        rows[i] = rows[i] / rows[i, i]
        for r in range(count):
            if r != i and rows[r, i]:
                rows[r] = rows[r] - rows[r, i] * rows[i]
    return rows[:, count:]
