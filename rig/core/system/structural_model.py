"""The structure as matrices M, C, K with its dampers' masses: natural modes and the linear frequency response.

A particle damper is modeled as one mass. A *resting* damper lies in its cavity: an added mass of its body.

Convention: x(t) = Re(X e^{i w t}), so a phase lag is negative.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import SceneError
from rig.core.base.once import once_per_object
from rig.core.equations import Ground
from rig.core.scene.scene import Scene
from rig.core.scene.structure import Dashpots, ModalDamping, RayleighDamping, Structure
from rig.core.system.natural_modes import NaturalModes, natural_modes

# Maximum number of elements in the dynamic stiffness matrices that are solved in one call (16 MB).
_MAX_ELEMENTS = 1_000_000


@dataclass(frozen=True)
class SpringMass:
    """A mass on a spring and a dashpot in a body; SI units. `damper`, `body`: indices from 0."""

    damper: int
    body: int
    mass: float
    stiffness: float
    damping: float

    def dynamic_stiffness(self, omega: Array) -> ComplexArray:
        """Return the force of the body on this mass per displacement of the body [N/m]; `omega`: rad/s."""
        spring = self.stiffness + 1j * omega * self.damping
        inertia = -(omega**2) * self.mass
        return np.asarray(spring * inertia / (spring + inertia))


@dataclass(frozen=True, eq=False)
class StructuralModel:
    """The equation of motion M x'' + C x' + K x = f of the bodies, and the masses of the dampers in them.

    `mass`, `damping`, `stiffness`, shape (bodies, bodies): in kg, N s/m and N/m; without the masses of dampers.
    `damper_mass`: kg, in the scene's order, shape (dampers,); `damper_body`: index of the body of each damper, from 0,
    shape (dampers,); `locked`: whether a damper is locked or has no clearance, shape (dampers,). `tuned`: the masses on
    springs, which `response` includes.
    """

    mass: Array
    damping: Array
    stiffness: Array
    damper_mass: Array = field(default_factory=lambda: np.zeros(0))
    damper_body: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    locked: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))
    tuned: tuple[SpringMass, ...] = ()

    @cached_property
    def modes(self) -> NaturalModes:
        """Natural modes without dampers; raises `SceneError` if the structure is statically unstable."""
        omega, shapes = natural_modes(self.mass, self.stiffness)
        mass, damping = (np.einsum("ji,jk,ki->i", shapes, matrix, shapes) for matrix in (self.mass, self.damping))
        return NaturalModes(omega, shapes, mass, damping)

    def with_damper_masses(self, riding: Iterable[int] = ()) -> Self:
        """Return the model with the masses of the locked and of the resting dampers added to their bodies.

        `riding`: numbers of the dampers that rest, from 1. Raises `SceneError` if a damper does not exist.
        """
        count = self.locked.size
        numbers = list(riding)
        missing = [number for number in numbers if not 1 <= number <= count]
        if missing:
            raise SceneError(f"riding: damper {missing[0]} does not exist. Give numbers of dampers from 1 to {count}.")
        on_springs = {mass.damper for mass in self.tuned}
        resting = sorted({*np.flatnonzero(self.locked).tolist(), *(number - 1 for number in numbers)} - on_springs)
        if not resting:
            return self
        mass = self.mass.copy()
        bodies = self.damper_body[resting]
        np.add.at(mass, (bodies, bodies), self.damper_mass[resting])
        return replace(self, mass=mass)

    def with_ground_springs(self, bodies: Iterable[int], spring: float) -> Self:
        """Return the model with a ground spring [N/m] on each of the given bodies (indices from 0)."""
        stiffness, supported = self.stiffness.copy(), list(bodies)
        stiffness[supported, supported] += spring
        return replace(self, stiffness=stiffness)

    def response(self, frequencies_hz: Array, force: Array | ComplexArray) -> ComplexArray:
        """Compute the complex displacement amplitude of each body under harmonic forces [m], (bodies, frequencies).

        `frequencies_hz`: shape (frequencies,); `force`: amplitudes [N], shape (bodies,) or (bodies, frequencies).
        Raises `SceneError` if a frequency is exactly an undamped resonance, or 0 for a structure without support.
        """
        response = np.empty((len(self.mass), frequencies_hz.size), dtype=np.complex128)
        step = max(1, _MAX_ELEMENTS // self.mass.size)
        for first in range(0, frequencies_hz.size, step):
            block = slice(first, first + step)
            omega = 2.0 * np.pi * frequencies_hz[block, None, None]
            dynamic_stiffness = np.asarray(self.stiffness + 1j * omega * self.damping - omega**2 * self.mass, complex)
            for mass in self.tuned:
                dynamic_stiffness[:, mass.body, mass.body] += mass.dynamic_stiffness(omega[:, 0, 0])
            try:
                right_side = force[:, None] if force.ndim == 1 else force[:, block].T[:, :, None]
                response[:, block] = np.linalg.solve(dynamic_stiffness, right_side)[:, :, 0].T
            except np.linalg.LinAlgError:
                raise SceneError(
                    "frequencies: the response is infinite at one of the frequencies (an undamped resonance, or 0 Hz "
                    "without support). Add structure.damping, or choose other frequencies."
                ) from None
        return response


@once_per_object
def structural_model(scene: Scene) -> StructuralModel:
    """Return the matrices of a scene's structure, without the coil spring, and its dampers.

    A damper's mass ratio is relative to the mass of its body or, if matrices are given, to the diagonal element of M.

    >>> import rig
    >>> model = structural_model(rig.load("fig9"))
    >>> model.modes.frequency.round(2), model.damper_mass
    (array([13.04, 34.78, 49.66]), array([0.0426]))
    """
    mass, damping, stiffness = _shared_matrices(scene.structure)
    body = np.array([damper.body - 1 for damper in scene.dampers], dtype=np.intp)
    locked = np.array([not damper.moves for damper in scene.dampers], dtype=bool)
    masses = damper_masses(scene, mass)
    tuned = tuple(
        SpringMass(k, damper.body - 1, float(masses[k]), damper.spring, damper.dashpot)
        for k, damper in enumerate(scene.dampers)
        if damper.spring is not None and damper.moves
    )
    return StructuralModel(mass, damping, stiffness, masses, body, locked, tuned)


def damper_masses(scene: Scene, mass: Array) -> Array:
    """Return the mass of each damper [kg] in the scene's order; `mass`: mass matrix of the structure."""
    masses = (
        damper.mass if damper.mass is not None else (damper.mass_ratio or 0.0) * mass[damper.body - 1, damper.body - 1]
        for damper in scene.dampers
    )
    return np.fromiter(masses, dtype=np.float64)


def receptance(scene: Scene, frequencies_hz: ArrayLike, riding: Iterable[int] = ()) -> ComplexArray:
    """Compute the compliance of each body for the force of the shaker or, without shaker, of the hammer.

    `frequencies_hz`: shape (frequencies,); `riding`: numbers of the dampers that rest, from 1. Their masses are added
    to their bodies. The masses of dampers that are locked or have no clearance are always added. Masses on springs are
    included with their springs and dashpots.

    Returns X / F, complex, shape (bodies, frequencies) [m/N]. Raises `SceneError` if a frequency is negative, not
    finite or exactly an undamped resonance, a damper does not exist, or the scene has neither shaker nor hammer.

    >>> import rig
    >>> scene = rig.load("bare-structure")
    >>> static = receptance(scene, [0.0])[0, 0]
    >>> print(f"{static.real:.4g} m/N")  # 1 / (24.3 kN/m)
    4.115e-05 m/N
    """
    frequencies = _validated(frequencies_hz)
    model = structural_model(scene).with_damper_masses(riding)
    force = np.zeros(len(model.mass))
    force[driven_bodies(scene)] = 1.0
    return model.response(frequencies, force)


def transmissibility(scene: Scene, frequencies_hz: ArrayLike, riding: Iterable[int] = ()) -> ComplexArray:
    """Compute the ratio of each body's displacement to the table's.

    The table carries the structure, or there is a coil spring between table and body. `riding`: as in `receptance`.

    Returns X / X_0, complex, shape (bodies, frequencies). Raises the errors of `receptance`, and `SceneError` if the
    scene has no coil spring.
    """
    if scene.reference == "table":
        frequencies, model = _validated(frequencies_hz), structural_model(scene).with_damper_masses(riding)
        ground = ground_connection(scene.structure, model)
        return model.response(
            frequencies, ground.stiffness[:, None] + 2j * np.pi * np.outer(ground.damping, frequencies)
        )
    frequencies, driven, spring = _validated(frequencies_hz), driven_bodies(scene), coil_spring(scene)
    model = structural_model(scene).with_damper_masses(riding).with_ground_springs(driven, spring)
    force = np.zeros(len(model.mass))
    force[driven] = spring
    return model.response(frequencies, force)


def _validated(frequencies_hz: ArrayLike) -> Array:
    """Return frequencies as an array; raise `SceneError` if one is negative or not finite."""
    frequencies = np.asarray(frequencies_hz, dtype=np.float64)
    if frequencies.ndim != 1 or not np.isfinite(frequencies).all() or (frequencies < 0.0).any():
        raise SceneError(
            f"frequencies: got {frequencies_hz!r:.60}; expected a list of finite frequencies of at least 0 Hz"
        )
    return frequencies


def driven_bodies(scene: Scene) -> list[int]:
    """List the indices (from 0) of the bodies on which the force of shaker or hammer acts.

    Raises `SceneError` if the scene has neither, or several shakers that are not all of kind force.
    """
    if len(scene.shakers) > 1 and any(shaker.coil_spring is not None for shaker in scene.shakers):
        raise SceneError(
            f"scene {scene.name!r} has several shakers, whose coil springs add stiffness to the structure. Use one "
            "shaker, several of kind force, or rig.frequency_response, which includes the coil springs."
        )
    if scene.reference == "table":
        raise SceneError(
            f"scene {scene.name!r}: the structure is excited at its base, so no force acts on a body. Use a "
            "shaker of a different kind."
        )
    if scene.driven_shaker is not None and scene.driven_shaker.bodies:
        return [body - 1 for body in scene.driven_shaker.bodies]
    if scene.hammer is not None:
        return [scene.hammer - 1]
    raise SceneError(
        f"scene {scene.name!r} has neither shaker nor hammer, so the location of the force is unknown. Add a shaker."
    )


def coil_spring(scene: Scene) -> float:
    """Return the stiffness of the driven shaker's coil spring [N/m]; raises `SceneError` without a coil spring."""
    spring = None if scene.driven_shaker is None else scene.driven_shaker.coil_spring
    if spring is None:
        raise SceneError(f"scene {scene.name!r} has no coil spring. Use a shaker of kind table or electrodynamic.")
    return spring


@once_per_object
def _shared_matrices(structure: Structure) -> tuple[Array, Array, Array]:
    """Return `structure_matrices` as read-only arrays, for all scenes with this structure."""
    matrices = structure_matrices(structure)
    for matrix in matrices:
        matrix.flags.writeable = False
    return matrices


def structure_matrices(structure: Structure) -> tuple[Array, Array, Array]:
    """Assemble the matrices of the structure without dampers and coil spring.

    `structure`: a chain, or matrices. Returns `mass, damping, stiffness`, shape (bodies, bodies), M [kg], C [N s/m]
    and K [N/m] of M x'' + C x' + K x = f.
    """
    mass = mass_matrix(structure)
    if structure.matrices is not None:
        stiffness = symmetric(np.array(structure.matrices.stiffness))
    else:
        stiffness = chain_matrix(structure.springs or ())
    return mass, _damping(structure, mass, stiffness), stiffness


def ground_connection(structure: Structure, model: StructuralModel) -> Ground:
    """Return the connection of the bodies with the ground, exact for the springs and dashpots of a chain."""
    given = None if structure.matrices is None else structure.matrices.influence
    influence = np.ones(len(model.mass)) if given is None else np.array(given)
    stiffness, damping = model.stiffness @ influence, model.damping @ influence
    if structure.springs is not None:
        stiffness = np.append(structure.springs[0], np.zeros(len(influence) - 1))
    if isinstance(structure.damping, Dashpots):
        damping = np.append(structure.damping.dashpots[0], np.zeros(len(influence) - 1))
    return Ground(influence, damping, stiffness)


def mass_matrix(structure: Structure) -> Array:
    """Return the mass matrix of the structure without dampers [kg], shape (bodies, bodies)."""
    if structure.matrices is not None:
        return symmetric(np.array(structure.matrices.mass))
    return np.diag(np.array(structure.masses or ()))


def chain_matrix(elements: tuple[float, ...]) -> Array:
    """Return the stiffness or damping matrix of a chain: element j connects body j to body j-1, for j = 1 to ground.

    >>> chain_matrix((3.0, 1.0))
    array([[ 4., -1.],
           [-1.,  1.]])
    """
    values, body = np.array(elements, dtype=np.float64), np.arange(len(elements))
    matrix = np.zeros((body.size, body.size))
    matrix[body, body] = values
    matrix[body[:-1], body[:-1]] += values[1:]
    matrix[body[:-1], body[1:]] = matrix[body[1:], body[:-1]] = -values[1:]
    return matrix


def _damping(structure: Structure, mass: Array, stiffness: Array) -> Array:
    """Return the damping matrix [N s/m], shape (bodies, bodies)."""
    damping = structure.damping
    if structure.matrices is not None and structure.matrices.damping is not None:
        return np.array(structure.matrices.damping)
    if isinstance(damping, RayleighDamping):
        return damping.rayleigh.alpha * mass + damping.rayleigh.beta * stiffness
    if isinstance(damping, Dashpots):
        return chain_matrix(damping.dashpots)
    if isinstance(damping, ModalDamping):
        omega, shapes = natural_modes(mass, stiffness)
        ratios = np.broadcast_to(np.array(damping.modal), omega.shape)
        modal_masses = np.einsum("ji,jk,ki->i", shapes, mass, shapes)
        # C = M shapes diag(2 ratio omega / modal mass) shapes^T M
        mass_times_shapes = mass @ shapes
        return symmetric((mass_times_shapes * (2.0 * ratios * omega / modal_masses)) @ mass_times_shapes.T)
    return np.zeros_like(mass)


def symmetric(matrix: Array) -> Array:
    """Return the symmetric part of a matrix: it has the same quadratic form, without asymmetric rounding errors."""
    return (matrix + matrix.T) / 2.0
