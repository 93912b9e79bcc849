"""Equations of motion in first-order form z' = M z, with one matrix M for each combination of damper contacts.

`rig cost` solves them by methods that an engineer could use instead of the engine (scipy, SUNDIALS, time stepping), and
compares error and computing time. The engine itself does not use this form.
"""

from __future__ import annotations

import math
from collections.abc import Callable, MutableSequence, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.core.base.arrays import Array
from rig.core.base.errors import SceneError
from rig.core.system.hybrid_system import HybridSystem
from rig.core.system.open_loop_drive import ToneDrive

#: Contact state of each damper: `FLIGHT`, `FLOOR` or `CEILING`.
ContactStates = Sequence[int]

#: Number of samples per period at which methods are compared.
SAMPLES_PER_PERIOD = 16
FLIGHT, FLOOR, CEILING = 0, 1, 2
#: Kind of the event that starts each contact state; index: `FLIGHT`, `FLOOR` or `CEILING`.
EVENT_KINDS = ("separation", "floor", "ceiling")


@dataclass(frozen=True)
class ComputedMotion:
    """Motion computed by a method."""

    displacement: Array  # m, at `SAMPLES_PER_PERIOD` samples per period; shape (coordinates, samples)
    events: list[tuple[float, int, str]]  # time [s], damper (from 0), kind


class FirstOrderForm:
    """z' = M z with z = (states, damper heights, damper speeds, 1, cos w t, sin w t, integrals) under a tone.

    Parameters
    ----------
    periods : int
        Length of the motion, in periods of the drive.
    number_type : callable
        Converts a float to the number type of the computation, such as `Decimal`.
    pi
        Value of pi in that type.
    integrals : bool
        Whether z ends with real and imaginary part of the integral of each coordinate times exp(-i w t).

    Attributes
    ----------
    size : int
        Length of z.
    first_height, constant_index : int
        Positions in z of the first damper's height and of the constant 1; cosine and sine follow the constant.
    damper_coordinate : ndarray of int, shape (dampers,)
        Coordinate of the body that carries each damper.
    inverse_mass : ndarray, shape (dampers,)
        Inverse mass of that body, 1/kg.

    Raises
    ------
    SceneError
        If an impact would change the velocity of other coordinates as well.
    """

    def __init__(
        self, system: HybridSystem, tone: ToneDrive, periods: int, number_type: Callable[[float], Any] = float,
        pi: Any = math.pi, integrals: bool = False,
    ) -> None:  # fmt: skip
        if not (system.detached | system.finite_contact).all() or np.isinf(system.take_off_acceleration).any():
            raise SceneError(
                "dampers: the compared methods require dampers with a floor, but one is a mass on a spring or a "
                "sliding mass. Remove it."
            )
        if system.coupled:
            raise SceneError(
                "structure: the compared methods require a diagonal mass matrix and at most one damper in a body. "
                "Choose a scene without these couplings."
            )
        self.system, self.tone, self.periods = system, tone, periods
        n, ns, nd = system.coordinates, system.states, system.dampers
        self.first_height, self.constant_index = ns, ns + 2 * nd
        self._integrals = n if integrals else 0
        self.size = ns + 2 * nd + 3 + 2 * self._integrals
        self.omega = 2 * pi * number_type(tone.frequency)
        self.samples = periods * SAMPLES_PER_PERIOD + 1
        self.damper_coordinate = np.asarray(system.damper_coordinate, dtype=np.int64)
        exact = np.vectorize(
            lambda value: number_type(float(value)), otypes=[float if number_type is float else object]
        )
        self.mass, self.damper_mass, self.clearance = map(exact, (system.mass, system.damper_mass, system.clearance))
        self.inverse_mass = 1.0 / np.diag(system.mass)[self.damper_coordinate]
        self.gravity, self._zero, self._unit = number_type(system.gravity), number_type(0.0), number_type(1.0)
        self._wall_parameters = exact(system.wall_stiffness), exact(system.wall_damping)
        drive_columns = exact(np.column_stack([tone.amplitudes.real, -tone.amplitudes.imag]))
        self._force, self._rate = (
            np.hstack([exact(state), exact(constant)[:, None], exact(drive) @ drive_columns])
            for state, constant, drive in (
                (system.force_state, system.force_constant, system.force_drive),
                (system.rate_state, np.zeros(ns - 2 * n), system.rate_drive),
            )
        )
        self.start = [number_type(float(value)) for value in tone.state]
        self.start += [self.start[row] for row in self.damper_coordinate] + [
            self.start[n + row] for row in self.damper_coordinate
        ]
        self.start += [self._unit, self._unit] + [self._zero] * (1 + 2 * self._integrals)

    @property
    def times(self) -> Array:
        """Return the sample times, s."""
        return np.arange(self.samples) / (SAMPLES_PER_PERIOD * self.tone.frequency)

    def wall_height(self, j: int, wall: int) -> Any:
        """Return the height of a wall above the floor, m."""
        return self.clearance[j] if wall == CEILING else self._zero

    def matrix(self, contact_states: ContactStates) -> NDArray[Any]:
        """Compute M (size, size); a damper on a wall moves with it, or loads its spring in finite-duration contact."""
        n, ns, nd = self.system.coordinates, self.system.states, self.system.dampers
        mass, force = self.mass.copy(), self._force.copy()
        matrix = np.full((self.size, self.size), self._zero)
        constant = self.constant_index
        for j, wall in enumerate(contact_states):
            row = self.damper_coordinate[j]
            if self.system.finite_contact[j]:
                if wall != FLIGHT:
                    bed = int(self.system.gap_coordinate[j])
                    stiffness, damping = (values[j, wall - FLOOR] for values in self._wall_parameters)
                    force[bed, bed] -= stiffness
                    force[bed, n + bed] -= damping
                    force[bed, ns] += stiffness * self.wall_height(j, wall)
            elif wall == FLIGHT:
                matrix[ns + j, ns + nd + j] = self._unit
                matrix[ns + nd + j, constant] = -self.gravity
            else:
                mass[row, row] += self.damper_mass[j]
                force[row, ns] -= self.damper_mass[j] * self.gravity
        driven_columns = [*range(ns), constant, constant + 1, constant + 2]
        matrix[range(n), range(n, 2 * n)] = self._unit
        matrix[n : 2 * n, driven_columns] = solve(mass, force)
        matrix[2 * n : ns, driven_columns] = self._rate
        cosine, sine, real_column = constant + 1, constant + 2, constant + 3
        matrix[cosine, sine], matrix[sine, cosine] = -self.omega, self.omega
        for k in range(self._integrals):
            imaginary_column = real_column + self._integrals + k
            matrix[real_column + k, k] = self._unit
            matrix[real_column + k, imaginary_column], matrix[imaginary_column, real_column + k] = (
                -self.omega,
                self.omega,
            )
        return matrix

    def gap_row(self, j: int, wall: int) -> NDArray[Any]:
        """Return the row vector whose product with z is the distance of a damper from a wall, m."""
        row = np.full(self.size, self._zero)
        if self.system.finite_contact[j]:
            row[int(self.system.gap_coordinate[j])] = self._unit
        else:
            row[self.first_height + j], row[self.damper_coordinate[j]] = self._unit, -self._unit
        if wall == CEILING:
            row = -row
            row[self.constant_index] = self.clearance[j]
        return row

    def contact_force_row(self, j: int, wall: int, matrix: NDArray[Any]) -> NDArray[Any]:
        """Return the row vector whose product with z is the wall force over the damper mass, m/s^2.

        In finite-duration contact, the product is the wall force, N.
        """
        n = self.system.coordinates
        if self.system.finite_contact[j]:
            bed = int(self.system.gap_coordinate[j])
            stiffness, damping = (values[j, wall - FLOOR] for values in self._wall_parameters)
            row = stiffness * self.gap_row(j, wall)
            row[n + bed] = damping if wall == FLOOR else -damping
            return -row
        row = matrix[n + self.damper_coordinate[j]].copy()
        row[self.constant_index] += self.gravity
        return row if wall == FLOOR else -row

    def separate(self, z: MutableSequence[Any] | Array, j: int, wall: int, speed: Any) -> None:
        """Start a damper's flight at a wall, with a given speed, m/s."""
        z[self.first_height + j] = z[self.damper_coordinate[j]] + self.wall_height(j, wall)
        z[self.first_height + self.system.dampers + j] = speed

    def impact(self, z: MutableSequence[Any] | Array, j: int, wall: int, restitution: Any) -> bool:
        """Apply an impact by Newton's impact law; return whether the damper stays on the wall."""
        coordinate = self.damper_coordinate[j]
        body_speed, damper_speed = self.system.coordinates + coordinate, self.first_height + self.system.dampers + j
        closing_speed = z[damper_speed] - z[body_speed]
        total_mass = self.mass[coordinate, coordinate] + self.damper_mass[j]
        z[body_speed] += (1 + restitution) * closing_speed * self.damper_mass[j] / total_mass
        self.separate(z, j, wall, z[body_speed] - restitution * closing_speed)
        return not restitution


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
