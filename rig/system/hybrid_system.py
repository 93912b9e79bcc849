"""A compiled scene: the linear system between contact changes, its dampers, and its drive."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class HybridSystem:
    """The hybrid linear system of a scene, in SI units.

    The state is (coordinates q, velocities q', further states such as the coil current). In every contact
    configuration (M + riding damper masses) q'' = F_q state + F_u u + F_1 - (riding dampers' weight), and the
    further states obey r' = R_q state + R_u u.

    Attributes
    ----------
    points : tuple of str
        Names of the coordinates: "body 1" ... "body n", then "table" if the scene has one.
    inputs, drive_units : tuple of str
        What can be driven, and its unit.
    mass : float64 (coordinates, coordinates)
        Mass matrix without the free dampers; locked ones are in it.
    force_state, force_drive, force_constant : float64
        F_q (coordinates, states), F_u (coordinates, inputs) and F_1 (coordinates,).
    rate_state, rate_drive : float64
        R_q (further states, states) and R_u (further states, inputs).
    damper_coordinate, damper_mass, clearance, restitution, damper_number : arrays (dampers,)
        The free dampers; `damper_number` is the 1-based position in the scene's list.
    fastest : float
        Bound on the fastest rate in any configuration, rad/s.
    """

    points: tuple[str, ...]
    inputs: tuple[str, ...]
    drive_units: tuple[str, ...]
    gravity: float
    mass: np.ndarray
    force_state: np.ndarray
    force_drive: np.ndarray
    force_constant: np.ndarray
    rate_state: np.ndarray
    rate_drive: np.ndarray
    damper_coordinate: np.ndarray
    damper_mass: np.ndarray
    clearance: np.ndarray
    restitution: np.ndarray
    damper_number: np.ndarray
    initial: np.ndarray = field(repr=False)

    @property
    def coordinates(self) -> int:
        """Number of mechanical coordinates."""
        return self.mass.shape[0]

    @property
    def states(self) -> int:
        """Number of states without drive and dampers in flight."""
        return 2 * self.coordinates + self.rate_state.shape[0]

    @property
    def dampers(self) -> int:
        """Number of dampers that can move in their cavities."""
        return self.damper_mass.shape[0]

    @property
    def coupled(self) -> bool:
        """Whether an impact at one damper's body is felt at once by another coordinate."""
        rows = self.mass[self.damper_coordinate]
        return bool(np.count_nonzero(rows) > self.dampers)

    @property
    def poles(self) -> np.ndarray:
        """Poles while no damper rides, rad/s; shape (states,), complex."""
        n, ns = self.coordinates, self.states
        matrix = np.zeros((ns, ns))
        matrix[:n, n : 2 * n] = np.eye(n)
        matrix[n : 2 * n] = np.linalg.solve(self.mass, self.force_state)
        matrix[2 * n :] = self.rate_state
        return np.asarray(np.linalg.eigvals(matrix), dtype=complex)

    @property
    def fastest(self) -> float:
        """Fastest rate of the system, rad/s; riding dampers only slow it down."""
        return float(np.abs(self.poles).max(initial=0.0))


@dataclass(frozen=True)
class Drive:
    """How the inputs evolve inside a segment: p' = generator p, u = output p."""

    generator: np.ndarray
    output: np.ndarray
    fastest: float

    @property
    def states(self) -> int:
        """Number of drive states p."""
        return self.generator.shape[0]


def tone(amplitudes: np.ndarray, angular_frequency: float) -> Drive:
    """Pure tone u(t) = Re(U e^{i w t}), with p = (cos w t, sin w t).

    Parameters
    ----------
    amplitudes : complex (inputs,)
        U of each input.
    angular_frequency : float
        w in rad/s.
    """
    generator = np.array([[0.0, -angular_frequency], [angular_frequency, 0.0]])
    amplitudes = np.asarray(amplitudes, dtype=complex)
    return Drive(generator, np.column_stack([amplitudes.real, -amplitudes.imag]), angular_frequency)


def sampled(inputs: int, interval: float) -> Drive:
    """First-order hold: p = (u, change of u over the sample interval)."""
    generator = np.zeros((2 * inputs, 2 * inputs))
    generator[:inputs, inputs:] = np.eye(inputs) / interval
    return Drive(generator, np.hstack([np.eye(inputs), np.zeros((inputs, inputs))]), 0.0)
