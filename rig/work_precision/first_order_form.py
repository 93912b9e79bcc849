"""What every alternative to the engine starts from: the scene as one first-order system with its dampers in it.

The alternatives are for `rig cost` only: honest versions of what one would write or call instead of the engine.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rig.errors import SceneError
from rig.system.hybrid_system import HybridSystem
from rig.system.open_loop_drive import ToneDrive

Array = NDArray[np.float64]

#: Samples a period at which methods are compared.
PER_PERIOD = 16
FLIGHT, FLOOR, CEILING = 0, 1, 2
WALLS = ("separation", "floor", "ceiling")


@dataclass(frozen=True)
class Outcome:
    """What a method made of a motion."""

    displacement: Array
    """m, at `PER_PERIOD` samples a period; shape (coordinates, samples)."""
    events: list[tuple[float, int, str]]
    """Time [s], damper (from 0), kind."""


class FirstOrderForm:
    """z = (coordinates, velocities, further states, heights and velocities of the dampers) under a tone.

    Attributes
    ----------
    flight : ndarray, shape (size, size)
        A of z' = A z + constant + cosine cos(w t) + sine sin(w t) with every damper in flight.
    constant, cosine, sine : ndarray, shape (size,)
    push : ndarray, shape (size, dampers)
        What a unit force between damper and floor does to the velocities' rates.
    closing : ndarray, shape (dampers, size)
        Rows that give v - q' of each damper.
    """

    def __init__(self, system: HybridSystem, tone: ToneDrive, periods: int) -> None:
        if system.coupled:
            raise SceneError("the alternatives decide contacts one by one; expected a diagonal mass matrix")
        self.system, self.tone, self.periods = system, tone, periods
        n, ns, nd = system.coordinates, system.states, system.dampers
        self.omega = tone.omega
        self.samples = periods * PER_PERIOD + 1
        self.size = ns + 2 * nd
        self.rows = np.asarray(system.damper_coordinate, dtype=np.int64)
        self.inverse_mass = 1.0 / np.diag(system.mass)[self.rows]
        self.flight, self.constant = self.configuration(np.zeros(nd, dtype=np.int64))
        self.cosine, self.sine = self.drive(np.zeros(nd, dtype=np.int64))
        self.push = np.zeros((self.size, nd))
        self.closing = np.zeros((nd, self.size))
        for j, row in enumerate(self.rows):
            self.push[n + row, j] = -self.inverse_mass[j]
            self.push[ns + nd + j, j] = 1.0 / system.damper_mass[j]
            self.closing[j, n + row], self.closing[j, ns + nd + j] = -1.0, 1.0
        self.start = np.zeros(self.size)
        self.start[:ns] = tone.state
        self.start[ns : ns + nd] = tone.state[self.rows]
        self.start[ns + nd :] = tone.state[n + self.rows]

    @property
    def times(self) -> Array:
        """Instants of the samples, s."""
        return np.arange(self.samples) / (PER_PERIOD * self.tone.frequency)

    def _mass(self, mode: NDArray[np.int64]) -> Array:
        mass = self.system.mass.copy()
        riding = mode != FLIGHT
        mass[self.rows[riding], self.rows[riding]] += self.system.damper_mass[riding]
        return mass

    def configuration(self, mode: NDArray[np.int64]) -> tuple[Array, Array]:
        """Make A and the constant while the dampers with a wall as their mode ride on it."""
        system = self.system
        n, ns, nd = system.coordinates, system.states, system.dampers
        matrix, constant = np.zeros((self.size, self.size)), np.zeros(self.size)
        load = system.force_constant.copy()
        riding = mode != FLIGHT
        load[self.rows[riding]] -= system.damper_mass[riding] * system.gravity
        matrix[:n, n : 2 * n] = np.eye(n)
        matrix[n : 2 * n, :ns] = np.linalg.solve(self._mass(mode), system.force_state)
        constant[n : 2 * n] = np.linalg.solve(self._mass(mode), load)
        matrix[2 * n : ns, :ns] = system.rate_state
        for j, row in enumerate(self.rows):
            if mode[j] == FLIGHT:
                matrix[ns + j, ns + nd + j] = 1.0
                constant[ns + nd + j] = -system.gravity
            else:
                matrix[ns + j] = matrix[row]
                matrix[ns + nd + j] = matrix[n + row]
                constant[ns + nd + j] = constant[n + row]
        return matrix, constant

    def drive(self, mode: NDArray[np.int64]) -> tuple[Array, Array]:
        """Make the columns of cos(w t) and sin(w t)."""
        system = self.system
        n, ns, nd = system.coordinates, system.states, system.dampers
        columns = np.zeros((self.size, len(system.inputs)))
        columns[n : 2 * n] = np.linalg.solve(self._mass(mode), system.force_drive)
        columns[2 * n : ns] = system.rate_drive
        for j, row in enumerate(self.rows):
            if mode[j] != FLIGHT:
                columns[ns + nd + j] = columns[n + row]
        return columns @ self.tone.amplitudes.real, -columns @ self.tone.amplitudes.imag
