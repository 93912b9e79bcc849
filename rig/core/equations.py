"""The linear equations of motion of a structure and its shakers during their assembly, M q'' + C q' + K q = f.

The coordinates are the bodies of the structure, and the tables (heads) of shakers. M, C and K are symmetric and in
SI units. Springs and dashpots to ground act on x - r z, with the motion z of the ground and the *influence vector* r,
the displacement of each body per static displacement of the ground. By default the ground is at rest; a shaker can
replace it with a coordinate.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rig.core.base.arrays import Array
from rig.core.base.errors import SceneError


class Ground(NamedTuple):
    """Connection of the bodies with the ground."""

    influence: Array  # r, shape (bodies,)
    damping: Array  # C r [N s/m], shape (bodies,)
    stiffness: Array  # K r [N/m], shape (bodies,)


class Current(NamedTuple):
    """The state of a coil driven by a voltage amplifier, L i' + R i + force factor * velocity = gain * drive."""

    row: int  # coordinate on which the coil acts
    column: int  # input that is the drive
    resistance: float  # ohm
    inductance: float  # H
    force_factor: float  # N/A
    gain: float  # V/V


class Equations:
    """The equations of motion of a structure and its shakers, in SI units.

    `mass`, `damping`, `stiffness`: matrices of the structure, shape (bodies, bodies); `weight`: constant force on each
    body [N]; `ground`: computes the connection of the bodies with the ground, which only a base excitation needs.
    """

    def __init__(
        self, mass: Array, damping: Array, stiffness: Array, weight: Array, ground: Callable[[], Ground]
    ) -> None:
        # names of the coordinates
        self.points = [f"body {j + 1}" for j in range(len(mass))]
        self.mass, self.damping, self.stiffness, self.weight = mass.copy(), damping.copy(), stiffness.copy(), weight
        self.inputs: list[str] = []
        self.units: list[str] = []  # of the inputs
        # force of each input on coordinates by their row, N per unit of the input
        self.input_forces: list[dict[int, float]] = []
        self.drive_limit: list[float] = []  # largest drive of each input, in its unit
        self.currents: list[Current] = []  # further states
        self._ground = ground
        self._servo_rate: dict[int, float] = {}  # corner of the servo of each prescribed row [rad/s]

    @property
    def prescribed(self) -> list[int]:
        """Rows with prescribed motion."""
        return list(self._servo_rate)

    def add_point(self, name: str, mass: float) -> int:
        """Add a coordinate for a point of a mass [kg] without support; return its row."""
        self.points.append(name)
        return self.add_coordinate(mass)

    def add_coordinate(self, mass: float) -> int:
        """Add a coordinate with a mass [kg] and no other elements; return its row."""
        row = len(self.mass)
        enlarged = np.zeros((3, row + 1, row + 1))
        enlarged[:, :row, :row] = self.mass, self.damping, self.stiffness
        self.mass, self.damping, self.stiffness = enlarged
        self.mass[row, row] = mass
        self.weight = np.append(self.weight, 0.0)
        return row

    def add_spring(self, first: int, second: int, stiffness: float) -> None:
        """Add a spring of a stiffness [N/m] between two coordinates."""
        self.stiffness[[first, second], [first, second]] += stiffness
        self.stiffness[[first, second], [second, first]] -= stiffness

    def support(self, row: int, stiffness: float, damping: float) -> None:
        """Add a spring [N/m] and a dashpot [N s/m] between a coordinate and the laboratory floor, which never moves."""
        self.stiffness[row, row] += stiffness
        self.damping[row, row] += damping

    def add_input(self, name: str, unit: str, forces: dict[int, float], limit: float = np.inf) -> int:
        """Add an input; return its column.

        `forces`: force of the input on coordinates by their row, N per unit of the input; `limit`: largest drive, in
        the unit of the input.
        """
        self.inputs.append(name)
        self.units.append(unit)
        self.input_forces.append(forces)
        self.drive_limit.append(limit)
        return len(self.inputs) - 1

    def prescribe(self, row: int, corner: float) -> None:
        """Prescribe the motion of a coordinate by an ideally stiff position servo that depends only on its inputs.

        The servo is critically damped and has a unit mass, so its input is an acceleration; `corner`: corner frequency
        of the servo [Hz].
        """
        self._servo_rate[row] = 2.0 * np.pi * corner

    def move_ground(self, row: int) -> None:
        """Replace the ground with a coordinate, such as that of a table that carries the structure."""
        influence, damping, stiffness = self._ground()
        pairs = ((damping, self.damping), (stiffness, self.stiffness))
        if not any((abs(column) > 1e-12 * abs(matrix).max()).any() for column, matrix in pairs):
            raise SceneError(
                "structure: nothing connects the structure to the ground, so the table does not move it. Give the "
                "spring of body 1, or matrices with a support."
            )
        bodies = len(influence)
        for matrix, column in ((self.damping, damping), (self.stiffness, stiffness)):
            matrix[:bodies, row] -= column
            matrix[row, :bodies] -= column
            matrix[row, row] += influence @ column

    def add_current(self, current: Current) -> None:
        """Add the current of a coil as a further state."""
        self.currents.append(current)

    def matrices(self) -> tuple[Array, Array, Array]:
        """Return mass [kg], damping [N s/m], stiffness [N/m]; rows of prescribed coordinates are those of the servo."""
        mass, damping, stiffness = self.mass.copy(), self.damping.copy(), self.stiffness.copy()
        for row, rate in self._servo_rate.items():
            mass[row], damping[row], stiffness[row] = 0.0, 0.0, 0.0
            mass[row, row], damping[row, row], stiffness[row, row] = 1.0, 2.0 * rate, rate**2
        return mass, damping, stiffness

    def reaction(self) -> Array:
        """Return the matrix that gives the reaction force at each prescribed coordinate [N] from the state.

        Shape (prescribed, states).
        """
        rows = self.prescribed
        further = np.zeros((len(rows), len(self.currents)))
        return np.hstack([self.stiffness[rows], self.damping[rows], further])
