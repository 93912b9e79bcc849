"""The scene as a piecewise linear first-order system, the basis of every alternative method.

The alternatives are used by `rig cost` only; they represent methods that an engineer could use instead of the engine.
"""

from __future__ import annotations

import math
from collections.abc import Callable, MutableSequence, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.arrays import Array
from rig.errors import SceneError
from rig.system.hybrid_system import HybridSystem
from rig.system.open_loop_drive import ToneDrive

#: Contact state of each damper: `FLIGHT`, `FLOOR` or `CEILING`.
Mode = Sequence[int]

#: Samples per period at which methods are compared.
SAMPLES_PER_PERIOD = 16
FLIGHT, FLOOR, CEILING = 0, 1, 2
#: Kind of event that starts each contact state.
WALLS = ("separation", "floor", "ceiling")


@dataclass(frozen=True)
class Outcome:
    """Motion computed by a method."""

    displacement: Array  # m, at `SAMPLES_PER_PERIOD` samples per period; shape (coordinates, samples)
    events: list[tuple[float, int, str]]  # Time [s], damper (from 0), kind


class FirstOrderForm:
    """z' = M z with z = (states, damper heights, damper speeds, 1, cos w t, sin w t, integrals) under a tone.

    `periods`: length of the motion; `number`: converts a float to the number type of the computation, such as
    `Decimal`; `pi`: value in that type; `integrals`: whether to append real and imaginary part of the integral of each
    coordinate times exp(-i w t), which is exact after whole periods; `first`: position of the first damper's height in
    z; `constant_index`: position of the constant 1; cosine and sine follow; `size`: length of z; `inverse_mass`, shape
    (dampers,): mobility of each damper's coordinate, 1/kg. Raises `SceneError` if an impact would accelerate other
    coordinates as well.
    """

    def __init__(
        self, system: HybridSystem, tone: ToneDrive, periods: int, number: Callable[[float], Any] = float,
        pi: Any = math.pi, integrals: bool = False,
    ) -> None:  # fmt: skip
        if system.coupled:
            raise SceneError(
                "the compared methods treat contacts one by one. Use a structure with a diagonal mass matrix."
            )
        self.system, self.tone, self.periods = system, tone, periods
        n, ns, nd = system.coordinates, system.states, system.dampers
        self.first, self.constant_index = ns, ns + 2 * nd
        self._integrals = n if integrals else 0
        self.size = ns + 2 * nd + 3 + 2 * self._integrals
        self.omega = 2 * pi * number(tone.frequency)
        self.samples = periods * SAMPLES_PER_PERIOD + 1
        self.rows = np.asarray(system.damper_coordinate, dtype=np.int64)
        exact = np.vectorize(lambda value: number(float(value)), otypes=[float if number is float else object])
        self.mass, self.damper_mass, self.clearance = map(exact, (system.mass, system.damper_mass, system.clearance))
        self.inverse_mass = 1.0 / np.diag(system.mass)[self.rows]
        self.gravity, self._zero, self._unit = number(system.gravity), number(0.0), number(1.0)
        self._walls = exact(system.wall_stiffness), exact(system.wall_damping)
        drive_columns = exact(np.column_stack([tone.amplitudes.real, -tone.amplitudes.imag]))
        self._force, self._rate = (
            np.hstack([exact(state), exact(constant)[:, None], exact(drive) @ drive_columns])
            for state, constant, drive in (
                (system.force_state, system.force_constant, system.force_drive),
                (system.rate_state, np.zeros(ns - 2 * n), system.rate_drive),
            )
        )
        self.start = [number(float(value)) for value in tone.state]
        self.start += [self.start[row] for row in self.rows] + [self.start[n + row] for row in self.rows]
        self.start += [self._unit, self._unit] + [self._zero] * (1 + 2 * self._integrals)

    @property
    def times(self) -> Array:
        """Return the sample times, s."""
        return np.arange(self.samples) / (SAMPLES_PER_PERIOD * self.tone.frequency)

    def lift(self, j: int, wall: int) -> Any:
        """Return the height of a wall above the floor, m."""
        return self.clearance[j] if wall == CEILING else self._zero

    def matrix(self, mode: Mode) -> NDArray[Any]:
        """Compute M; dampers at a wall rest on it, or load its spring in finite-duration contact."""
        n, ns, nd = self.system.coordinates, self.system.states, self.system.dampers
        mass, force = self.mass.copy(), self._force.copy()
        matrix = np.full((self.size, self.size), self._zero)
        one = self.constant_index  # column of the constant 1
        for j, wall in enumerate(mode):
            row = self.rows[j]
            if self.system.finite_contact[j]:
                if wall != FLIGHT:
                    gap = int(self.system.bed[j])
                    stiffness, damping = (values[j, wall - FLOOR] for values in self._walls)
                    force[gap, gap] -= stiffness
                    force[gap, n + gap] -= damping
                    force[gap, ns] += stiffness * self.lift(j, wall)
            elif wall == FLIGHT:
                matrix[ns + j, ns + nd + j] = self._unit
                matrix[ns + nd + j, one] = -self.gravity
            else:
                mass[row, row] += self.damper_mass[j]
                force[row, ns] -= self.damper_mass[j] * self.gravity
        driven_columns = [*range(ns), one, one + 1, one + 2]
        matrix[range(n), range(n, 2 * n)] = self._unit
        matrix[n : 2 * n, driven_columns] = solve(mass, force)
        matrix[2 * n : ns, driven_columns] = self._rate
        matrix[one + 1, one + 2], matrix[one + 2, one + 1] = -self.omega, self.omega
        real_column = one + 3
        for k in range(self._integrals):
            imaginary_column = real_column + self._integrals + k
            matrix[real_column + k, k] = self._unit
            matrix[real_column + k, imaginary_column], matrix[imaginary_column, real_column + k] = (
                -self.omega,
                self.omega,
            )
        return matrix

    def gap(self, j: int, wall: int) -> NDArray[Any]:
        """Return the row vector whose product with z is the distance of a damper from a wall, m."""
        row = np.full(self.size, self._zero)
        if self.system.finite_contact[j]:
            row[int(self.system.bed[j])] = self._unit
        else:
            row[self.first + j], row[self.rows[j]] = self._unit, -self._unit
        if wall == CEILING:
            row = -row
            row[self.constant_index] = self.clearance[j]
        return row

    def pressing(self, j: int, wall: int, matrix: NDArray[Any]) -> NDArray[Any]:
        """Return the row vector of wall force over damper mass, m/s^2; of wall force, N, in finite-duration contact."""
        n = self.system.coordinates
        if self.system.finite_contact[j]:
            gap = int(self.system.bed[j])
            stiffness, damping = (values[j, wall - FLOOR] for values in self._walls)
            row = stiffness * self.gap(j, wall)
            row[n + gap] = damping if wall == FLOOR else -damping
            return -row
        row = matrix[n + self.rows[j]].copy()
        row[self.constant_index] += self.gravity
        return row if wall == FLOOR else -row

    def separate(self, z: MutableSequence[Any] | Array, j: int, wall: int, speed: Any) -> None:
        """Start a damper's flight at a wall."""
        z[self.first + j] = z[self.rows[j]] + self.lift(j, wall)
        z[self.first + self.system.dampers + j] = speed

    def impact(self, z: MutableSequence[Any] | Array, j: int, wall: int, restitution: Any) -> bool:
        """Apply an impact by Newton's law; return whether the damper stays at the wall."""
        body, speed = self.system.coordinates + self.rows[j], self.first + self.system.dampers + j
        closing, row = z[speed] - z[body], self.rows[j]
        z[body] += (1 + restitution) * closing * self.damper_mass[j] / (self.mass[row, row] + self.damper_mass[j])
        self.separate(z, j, wall, z[body] - restitution * closing)
        return not restitution


def solve(matrix: NDArray[Any], right: NDArray[Any]) -> NDArray[Any]:
    """Solve linear equations; by Gauss-Jordan elimination for number types other than float.

    >>> solve(np.array([[0, 2], [4, 2]], dtype=object), np.array([[6], [10]], dtype=object)).tolist()
    [[1.0], [3.0]]
    """
    if matrix.dtype != object:
        return np.linalg.solve(matrix, right)
    rows, count = np.hstack([matrix, right]), len(matrix)
    for i in range(count):
        pivot = i + int(np.argmax(np.abs(rows[i:, i])))
        rows[[i, pivot]] = rows[[pivot, i]]
        rows[i] = rows[i] / rows[i, i]
        for r in range(count):
            if r != i and rows[r, i]:
                rows[r] = rows[r] - rows[r, i] * rows[i]
    return rows[:, count:]
