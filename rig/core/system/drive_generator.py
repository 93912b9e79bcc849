"""Generators of the inputs of a system within a time segment: a tone, or linearly interpolated samples."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class DriveGenerator:
    """Generator of the inputs u within a time segment: p' = generator p, u = output p.

    The drive states p are, for example, the cosine and the sine of a tone.
    `max_rate`: angular frequency of a tone [rad/s]; 0 for a sampled drive.
    """

    generator: np.ndarray
    output: np.ndarray
    max_rate: float

    @property
    def states(self) -> int:
        """Number of drive states p."""
        return self.generator.shape[0]


def pure_tone(amplitudes: np.ndarray, angular_frequency: float) -> DriveGenerator:
    """Return the drive u(t) = Re(U e^{i w t}) of a tone, p = (cos w t, sin w t), with `amplitudes` U of inputs."""
    generator = np.array([[0.0, -angular_frequency], [angular_frequency, 0.0]])
    amplitudes = np.asarray(amplitudes, dtype=complex)
    return DriveGenerator(generator, np.column_stack([amplitudes.real, -amplitudes.imag]), angular_frequency)


def first_order_hold(inputs: int, interval: float) -> DriveGenerator:
    """Return the drive of linearly interpolated samples: p = (u, change of u over the sample `interval` [s])."""
    generator = np.zeros((2 * inputs, 2 * inputs))
    generator[:inputs, inputs:] = np.eye(inputs) / interval
    return DriveGenerator(generator, np.hstack([np.eye(inputs), np.zeros((inputs, inputs))]), 0.0)
