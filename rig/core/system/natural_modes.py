"""Natural frequencies and mode shapes of an undamped structure from its matrices."""

from dataclasses import dataclass

import numpy as np
import scipy

from rig.core.base.arrays import Array
from rig.core.base.errors import SceneError
from rig.core.scene.matrices import is_positive_definite

# A squared frequency below this multiple of its rounding error is computed again, by a more accurate method.
_MAX_AMPLIFIED_ROUNDING = 1e6


@dataclass(frozen=True, eq=False)
class NaturalModes:
    """Modes of the undamped structure; coupling of modes by damping is neglected.

    `mass`, `damping`, shape (modes,): modal mass [kg] and the diagonal of the modal damping matrix [N s/m].
    """

    omega: Array  # natural frequencies, increasing [rad/s]; 0 for a rigid-body motion, shape (modes,)
    shapes: Array  # column i is the shape of mode i, its largest component +1, shape (bodies, modes)
    mass: Array
    damping: Array

    @property
    def frequency(self) -> Array:
        """Natural frequencies [Hz]."""
        return np.asarray(self.omega / (2.0 * np.pi))

    @property
    def decay_rate(self) -> Array:
        """Decay rate of each mode [1/s]; coupling of modes by damping is neglected."""
        return np.asarray(self.damping / (2.0 * self.mass))

    @property
    def damping_ratio(self) -> Array:
        """Damping ratio of each mode; coupling of modes by damping is neglected."""
        return np.asarray(self.decay_rate / np.maximum(self.omega, 1e-9))


def natural_modes(mass: Array, stiffness: Array) -> tuple[Array, Array]:
    """Compute natural frequencies and mode shapes of the undamped structure.

    `mass`, `stiffness`, shape (bodies, bodies): symmetric; mass positive definite, stiffness positive semidefinite.
    Returns `omega`, shape (bodies,): natural frequencies, increasing [rad/s]; 0 for a rigid-body motion; and `shapes`,
    shape (bodies, bodies): column i is the shape of mode i, with largest component +1. Raises `SceneError` if the
    modes cannot be computed, or the structure is statically unstable (a negative eigenvalue larger than rounding
    errors).
    """
    # `scipy.linalg.eigh` calls the same routine in six times the time; a fit makes 10 000 calls.
    squared_omega, shapes, info = scipy.linalg.lapack.dsygvd(stiffness, mass)
    if info:
        raise SceneError(
            "structure: the natural modes cannot be computed. Check that the mass matrix is positive definite, and "
            f"that both matrices are finite (LAPACK dsygvd: info {info})."
        )
    rounding = 10 * len(squared_omega) * np.finfo(float).eps * np.abs(squared_omega).max(initial=0.0)
    if squared_omega[0] < -rounding:
        raise SceneError(
            "structure: the stiffness matrix is not positive semidefinite (squared natural frequency "
            f"{squared_omega[0]:.3g} rad²/s²), so the structure is statically unstable. Add springs that stabilize it."
        )
    if abs(squared_omega[0]) <= _MAX_AMPLIFIED_ROUNDING * rounding and is_positive_definite(stiffness):
        squared_omega, shapes = _modes_of_extreme_masses(mass, stiffness)
        rounding = 0.0
    # The computed eigenvalue of a rigid-body motion is a rounding error of either sign.
    omega = np.sqrt(np.where(np.abs(squared_omega) <= rounding, 0.0, squared_omega))
    largest = np.take_along_axis(shapes, np.argmax(np.abs(shapes), axis=0)[None, :], axis=0)
    return omega, shapes / largest


def _modes_of_extreme_masses(mass: Array, stiffness: Array) -> tuple[Array, Array]:
    """Compute the squared natural frequencies and mode shapes of a supported structure, all with small relative errors.

    With M = R R^T and K = L L^T, the frequencies are the singular values of R^-1 L. Jacobi's method is accurate even if
    they differ by many orders of magnitude (Z. Drmac, K. Veselic, SIAM J. Matrix Anal. Appl. 29 (2008) 1322-1362).
    """
    mass_factor = np.linalg.cholesky(mass)
    reduced = scipy.linalg.solve_triangular(mass_factor, np.linalg.cholesky(stiffness), lower=True)
    values, left, _, scale, _, _ = scipy.linalg.lapack.dgejsv(reduced, joba=2, jobv=3)
    omega = np.sort(values * (scale[0] / scale[1]))
    return omega**2, scipy.linalg.solve_triangular(mass_factor, left[:, np.argsort(values)], lower=True, trans="T")
