"""The structure's matrices and natural modes."""

from __future__ import annotations

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from rig.errors import SceneError
from rig.scene.scene import Scene
from rig.scene.structure import Dashpots, ModalDamping, RayleighDamping, Structure

Array = NDArray[np.float64]


def structure_matrices(structure: Structure) -> tuple[Array, Array, Array]:
    """Assemble the matrices of the structure without dampers and coil spring.

    Parameters
    ----------
    structure : Structure
        A chain, or matrices.

    Returns
    -------
    mass, damping, stiffness : ndarray, shape (bodies, bodies)
        M [kg], C [N s/m] and K [N/m] of M x'' + C x' + K x = f.
    """
    if structure.matrices is not None:
        mass = _symmetric(np.array(structure.matrices.mass))
        stiffness = _symmetric(np.array(structure.matrices.stiffness))
    else:
        mass = np.diag(np.array(structure.masses or ()))
        stiffness = chain(structure.springs or ())
    return mass, _damping(structure, mass, stiffness), stiffness


def chain(elements: tuple[float, ...]) -> Array:
    """Assemble a chain: element j acts between body j and body j-1, ground for j = 1.

    >>> chain((3.0, 1.0))
    array([[ 4., -1.],
           [-1.,  1.]])
    """
    values = np.array(elements)
    return np.diag(values + np.append(values[1:], 0.0)) - np.diag(values[1:], 1) - np.diag(values[1:], -1)


def natural_modes(mass: Array, stiffness: Array) -> tuple[Array, Array]:
    """Find natural frequencies and shapes of the undamped structure.

    Parameters
    ----------
    mass, stiffness : ndarray, shape (bodies, bodies)
        Symmetric; mass positive definite, stiffness positive semidefinite.

    Returns
    -------
    frequencies : ndarray, shape (bodies,)
        Rising, in rad/s; 0 for a rigid-body motion.
    shapes : ndarray, shape (bodies, bodies)
        Column i is the shape of mode i, its largest element +1.

    Raises
    ------
    SceneError
        If the stiffness lets the structure run away (a negative eigenvalue beyond rounding).
    """
    squares, shapes = scipy.linalg.eigh(stiffness, mass)
    rounding = 10 * len(squares) * np.finfo(float).eps * np.abs(squares).max(initial=0.0)
    if squares[0] < -rounding:
        raise SceneError(
            f"structure: stiffness not positive semidefinite (squared frequency {squares[0]:.3g} 1/s^2), "
            "so that there are no natural modes; expected springs that hold it"
        )
    # A rigid-body motion comes out as a square of either sign at rounding level.
    frequencies = np.sqrt(np.where(np.abs(squares) <= rounding, 0.0, squares))
    largest = np.take_along_axis(shapes, np.argmax(np.abs(shapes), axis=0)[None, :], axis=0)
    return frequencies, shapes / largest


def _damping(structure: Structure, mass: Array, stiffness: Array) -> Array:
    damping = structure.damping
    if structure.matrices is not None and structure.matrices.damping is not None:
        return np.array(structure.matrices.damping)
    if isinstance(damping, RayleighDamping):
        return damping.rayleigh.alpha * mass + damping.rayleigh.beta * stiffness
    if isinstance(damping, Dashpots):
        return chain(damping.dashpots)
    if isinstance(damping, ModalDamping):
        frequencies, shapes = natural_modes(mass, stiffness)
        ratios = np.broadcast_to(np.array(damping.modal), frequencies.shape)
        modal_masses = np.einsum("ji,jk,ki->i", shapes, mass, shapes)
        weighted = mass @ shapes
        return _symmetric((weighted * (2.0 * ratios * frequencies / modal_masses)) @ weighted.T)
    return np.zeros_like(mass)


def _symmetric(matrix: Array) -> Array:
    return (matrix + matrix.T) / 2.0


def damper_masses(scene: Scene) -> NDArray[np.float64]:
    """Give the mass of each damper of a scene.

    Parameters
    ----------
    scene : Scene
        A mass ratio refers to the body's mass, with matrices to the diagonal element of the mass matrix.

    Returns
    -------
    ndarray, shape (dampers,)
        Masses [kg] in the scene's order.
    """
    if not scene.dampers:
        return np.zeros(0)
    body_masses = np.diag(structure_matrices(scene.structure)[0])
    return np.array(
        [
            damper.mass
            if damper.mass is not None
            else (damper.mass_ratio or 0.0) * body_masses[damper.body - 1]
            for damper in scene.dampers
        ]
    )


def damper_bodies(scene: Scene) -> NDArray[np.intp]:
    """Give the position (from 0) of the body of each damper, shape (dampers,)."""
    return np.array([damper.body - 1 for damper in scene.dampers], dtype=np.intp)
