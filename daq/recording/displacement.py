"""Displacement estimated from a motion channel, for pictures: integrated, without the drift."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Below this frequency an integrated signal is drift and noise rather than motion.
HIGH_PASS_HZ = 1.0


class DisplacementEstimate:
    """Integrates a sampled signal to a displacement, block by block, high-passed at `HIGH_PASS_HZ`.

    With w the corner, an acceleration goes through ``s^2 / (s^2 + sqrt(2) w s + w^2)^2``, a velocity through
    ``s / (s^2 + sqrt(2) w s + w^2)``, both by bilinear transform; a displacement is left as it is.

    Parameters
    ----------
    quantity : {'acceleration', 'velocity', 'displacement'}
        What the samples are.
    """

    def __init__(self, quantity: str, rate: float) -> None:
        self._sections: NDArray[np.float64] | None = None
        if quantity == "displacement":
            return
        from scipy.signal import bilinear_zpk, zpk2sos

        corner = 2 * np.pi * HIGH_PASS_HZ * np.exp(1j * np.pi * np.array([0.75, -0.75]))
        order = {"velocity": 1, "acceleration": 2}[quantity]
        zeros, poles = np.zeros(order), np.tile(corner, order)
        self._sections = zpk2sos(*bilinear_zpk(zeros, poles, 1.0, fs=rate))
        self._state = np.zeros((self._sections.shape[0], 2))

    def run(self, samples: NDArray[np.float64]) -> NDArray[np.float64]:
        """Give the displacement at the next samples, metres for SI input."""
        if self._sections is None or not samples.size:
            return samples
        from scipy.signal import sosfilt

        result, self._state = sosfilt(self._sections, samples, zi=self._state)
        return np.asarray(result)
