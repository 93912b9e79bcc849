"""Exact linear frequency response of the structure, without dampers or with dampers that ride.

Convention: x(t) = Re(X e^{i w t}), so that a phase lag is negative.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rig.errors import SceneError
from rig.scene.scene import Scene
from rig.system.structure import Array, damper_bodies, damper_masses, structure_matrices

# Dynamic stiffnesses solved at once: enough to keep LAPACK busy, little enough for any machine's memory.
_ELEMENTS_AT_ONCE = 1_000_000


def receptance(
    scene: Scene, frequencies_hz: ArrayLike, attached: bool = False, riding: Iterable[int] = ()
) -> NDArray[np.complex128]:
    """Compute the linear frequency response of a scene's structure.

    Parameters
    ----------
    scene : Scene
        Its shaker says where the force acts (without a shaker, its impulse test does).
    frequencies_hz : array_like, shape (frequencies,)
        Frequencies [Hz].
    attached : bool
        False: response to the force on the driven body, X / F_1. True: response to the displacement of the
        table, X / X_0, with the coil spring between table and body.
    riding : iterable of int
        Dampers that ride, by their position from 1 in the scene: their masses move with their bodies. Dampers
        that are locked or have no clearance always do.

    Returns
    -------
    ndarray, shape (bodies, frequencies)
        Complex response of each body [m/N, or m/m].

    Raises
    ------
    SceneError
        If a frequency is negative or not finite, a damper does not exist, nothing drives the structure, the
        scene has no coil spring to attach, or an undamped structure is asked for exactly at resonance.

    Examples
    --------
    >>> import rig
    >>> scene = rig.load("bare-structure")
    >>> static = receptance(scene, [0.0])[0, 0]
    >>> print(f"{static.real:.4g} m/N")  # 1 / (24.3 kN/m)
    4.115e-05 m/N
    """
    frequencies = np.asarray(frequencies_hz, dtype=np.float64)
    if frequencies.ndim != 1 or not np.isfinite(frequencies).all() or (frequencies < 0.0).any():
        raise SceneError("frequencies: expected a list of finite frequencies in Hz, none negative")
    mass, damping, stiffness = loaded_matrices(scene, attached, riding)
    force = np.zeros(len(mass))
    force[driven_bodies(scene)] = _coil_spring(scene) if attached else 1.0
    response = np.empty((len(mass), frequencies.size), dtype=np.complex128)
    step = max(1, _ELEMENTS_AT_ONCE // mass.size)
    for first in range(0, frequencies.size, step):
        block = slice(first, first + step)
        omega = 2.0 * np.pi * frequencies[block, None, None]
        dynamic_stiffness = stiffness + 1j * omega * damping - omega**2 * mass
        try:
            response[:, block] = np.linalg.solve(dynamic_stiffness, force[:, None])[:, :, 0].T
        except np.linalg.LinAlgError:
            raise SceneError(
                "the response is infinite at one of the frequencies: undamped and exactly at "
                "resonance (or free at 0 Hz); expected structure.damping, or other frequencies"
            ) from None
    return response


def loaded_matrices(
    scene: Scene, attached: bool = False, riding: Iterable[int] = ()
) -> tuple[Array, Array, Array]:
    """Assemble the matrices with riding dampers and, if attached, the coil spring to a table at rest.

    Parameters
    ----------
    scene, attached, riding
        As in `receptance`.

    Returns
    -------
    mass, damping, stiffness : ndarray, shape (bodies, bodies)
        In kg, N s/m and N/m.
    """
    mass, damping, stiffness = structure_matrices(scene.structure)
    mass, stiffness = mass.copy(), stiffness.copy()
    always = [k for k, damper in enumerate(scene.dampers) if not damper.moves]
    positions = sorted({*always, *(_position(scene, number) for number in riding)})
    bodies = damper_bodies(scene)[positions]
    mass[bodies, bodies] += damper_masses(scene)[positions]
    if attached:
        body = driven_bodies(scene)
        stiffness[body, body] += _coil_spring(scene)
    return mass, damping, stiffness


def driven_bodies(scene: Scene) -> list[int]:
    """List the positions (from 0) of the bodies on which the force acts."""
    if len(scene.shakers) > 1 and any(shaker.kind != "force" for shaker in scene.shakers):
        raise SceneError(
            f"scene {scene.name!r} has several shakers, and those on coil springs load the structure as well; expected "
            "one shaker, several of kind force, or rig.frequency_response, which knows them all"
        )
    if scene.driven_shaker is not None:
        return [body - 1 for body in scene.driven_shaker.bodies]
    if scene.test is not None and scene.test.kind == "impulse":
        return [scene.test.body - 1]
    raise SceneError(f"scene {scene.name!r} has neither shaker nor hammer to say where the force acts")


def _position(scene: Scene, number: int) -> int:
    if not 1 <= number <= len(scene.dampers):
        raise SceneError(
            f"riding: damper {number} of {len(scene.dampers)}; expected 1 to {len(scene.dampers)}"
        )
    return number - 1


def _coil_spring(scene: Scene) -> float:
    if scene.driven_shaker is None or scene.driven_shaker.spring is None:
        raise SceneError(
            f"scene {scene.name!r} has no coil spring; expected a shaker of kind table or electrodynamic"
        )
    return scene.driven_shaker.spring
