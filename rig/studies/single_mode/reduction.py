"""One mode of the structure with one equivalent damper (Eqs 4-13 of Inoue, Yokomichi and Hiraki, 2011).

For mode i, the structure is replaced with a single mass M_i on a spring K_i with a dashpot C_i. The force f_k on body k
acts on this mass as phi_ki f_k, with the mode shape phi. The mass carries one damper of mass mu_i M_i in a cavity with
the scene's clearance. M_i depends on the normalization of the mode shape: the paper sets its largest component to 1, so
the single mass represents the body with the largest displacement.

mu_i is computed with one of two weightings of the masses md_j of the dampers in bodies j. As printed (Eq. 13), mu_i is
the signed sum of phi_ji md_j / M_i. The kinetic energy of riding dampers gives phi_ji^2 instead. The two weightings
agree for a damper in a body with phi_ji = 1. If the body of the damper moves less, both weightings overestimate the
acceleration of the equivalent damper. Normalizing the shape at the damper's own body (`at`) avoids this; it is the
exact one-mode reduction for a single damper.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rig.core.base.errors import SceneError
from rig.core.scene.scene import STANDARD_GRAVITY, Scene
from rig.core.system.natural_modes import natural_modes
from rig.core.system.structural_model import driven_bodies, structural_model

Weighting = Literal["printed", "energy"]


@dataclass(frozen=True)
class SingleMode:
    """A mode with its equivalent damper."""

    mode: int  # Number of the mode, from 1
    shape: NDArray[np.float64]
    """Mode shape; body j moves by shape[j] times the mode's coordinate; shape (bodies,)."""
    mass: float  # M_i [kg]
    omega: float  # Natural angular frequency of the mode without dampers [rad/s]
    damping_ratio: float  # C_i / (2 M_i omega)
    participation: float  # phi_ki, mode shape at the driven body, or its sum over several driven bodies
    force: float  # Amplitude of the force [N]
    mass_ratio: float  # mu_i, the equivalent damper's mass over M_i
    clearance: float  # Clearance of the damper's cavity [m]; inf without a ceiling
    gravity: float  # [m/s²]

    @property
    def frequency(self) -> float:
        """Natural frequency without dampers [Hz]."""
        return self.omega / (2 * np.pi)

    @property
    def riding_frequency(self) -> float:
        """Natural frequency with the damper in permanent contact with the floor [Hz]."""
        return self.frequency / np.sqrt(1 + self.mass_ratio)

    def receptance(self, frequencies: ArrayLike, riding: bool = False) -> NDArray[np.complex128]:
        """Compute the linear compliance of the modal coordinate [m/N], without damper or with it always riding.

        `frequencies`, shape (frequencies,): [Hz]; `riding`: whether the damper's mass is part of the mode. Returns
        shape (frequencies,), ratio of the complex amplitudes of modal coordinate and force.
        """
        omega = 2 * np.pi * np.asarray(frequencies, dtype=float)
        inertia = self.mass * (1 + self.mass_ratio * riding)
        stiffness = self.mass * self.omega**2
        damping = 2 * self.damping_ratio * self.omega * self.mass
        dynamic = stiffness + 1j * omega * damping - omega**2 * inertia
        return np.asarray(self.participation / dynamic, dtype=np.complex128)


def reduce_to_mode(
    matrices: tuple[ArrayLike, ArrayLike, ArrayLike],
    *,
    mode: int,
    driven: tuple[int, ...],
    force: float,
    dampers: dict[int, float],
    clearance: float,
    gravity: float = STANDARD_GRAVITY,
    weighting: Weighting = "printed",
    at: int | None = None,
) -> SingleMode:
    """Reduce a structure to one mode.

    `matrices`: mass [kg], damping [N s/m] and stiffness [N/m]; `mode`: number of the mode, from 1; `driven`: driven
    bodies, from 1; `force`: amplitude of the force [N]; `dampers`: damper mass [kg] by body (from 1); `clearance`:
    common clearance [m]; inf without ceilings; `gravity`: [m/s²], above 0; `weighting`: weighting of the damper masses,
    'printed' (Eq. 13) or 'energy' (squared shape); `at`: body at which the shape is 1; default the body with the
    largest displacement. Raises `SceneError` if the mode does not exist or is not oscillatory, gravity is not positive,
    the clearance is negative, or the printed sum is not positive (dampers in bodies that move in antiphase).

    >>> import numpy as np
    >>> m = np.diag([0.74, 0.71, 0.64])
    >>> k = np.array([[46.1e3, -21.8e3, 0], [-21.8e3, 41.6e3, -19.8e3], [0, -19.8e3, 19.8e3]])
    >>> damper = {"dampers": {2: 0.0426}, "clearance": 1e-3}
    >>> reduced = reduce_to_mode((m, 2e-5 * k, k), mode=3, driven=(1,), force=3.3, **damper)
    >>> reduced.shape.round(3).tolist(), round(reduced.mass, 3), round(reduced.mass_ratio, 4)
    ([-0.84, 1.0, -0.466], 1.371, 0.0311)
    """
    mass, damping, stiffness = (np.asarray(a, dtype=float) for a in matrices)
    bodies = mass.shape[0]
    if not 1 <= mode <= bodies:
        raise SceneError(f"mode: {mode} does not exist. Choose one of the modes 1 to {bodies}.")
    if not gravity > 0:
        raise SceneError(f"gravity: {gravity} m/s² is too low for the approximate method. Set a value above 0.")
    if not clearance >= 0:
        raise SceneError(f"clearance: {clearance} m is negative. Set a clearance of 0 or more.")
    frequencies, shapes = natural_modes(mass, stiffness)
    shape = shapes[:, mode - 1]
    if at is not None:
        shape = shape / shape[at - 1]
    modal_mass, modal_damping, modal_stiffness = (float(shape @ a @ shape) for a in (mass, damping, stiffness))
    if not frequencies[mode - 1] > 0:
        raise SceneError(f"mode: {mode} is a rigid-body mode. Choose a mode with stiffness.")
    omega = float(np.sqrt(modal_stiffness / modal_mass))
    damping_ratio = modal_damping / (2 * modal_mass * omega)
    if not damping_ratio < 1:
        raise SceneError(f"mode: {mode} has the damping ratio {damping_ratio:.3g}. Choose a mode with a ratio below 1.")
    power = {"printed": 1, "energy": 2}[weighting]
    ratio = sum(shape[body - 1] ** power * md for body, md in dampers.items()) / modal_mass
    if dampers and not ratio > 0:
        raise SceneError(
            f"mode: with weighting='printed' (Eq. 13 of the paper), mode {mode} has the mass ratio {ratio:.3g}, "
            "because a damper's body moves in antiphase with the largest displacement. Use weighting='energy', or set "
            "at to the damper's body."
        )
    participation = float(sum(shape[body - 1] for body in driven))
    return SingleMode(
        mode, shape, modal_mass, omega, damping_ratio, participation, force, float(ratio), clearance, gravity
    )


def single_mode(
    scene: Scene, mode: int, *, force: float | None = None, weighting: Weighting = "printed", at: int | None = None
) -> SingleMode:
    """Reduce a scene to one mode; see `reduce_to_mode` for the arguments and errors.

    `force` [N] defaults to the force of the scene's test. Locked dampers belong to the structure. All other dampers
    form one equivalent damper, so they must have the same clearance. The method requires instantaneous contact and
    restitution 0.
    """
    if scene.joints:
        raise SceneError(
            "joints: the reduction to one mode requires a linear structure with dampers. Remove the joints."
        )
    model = structural_model(scene)
    mass = model.mass.copy()
    damper_masses: dict[int, float] = {}
    clearances: set[float] = set()
    for damper, md in zip(scene.dampers, model.damper_mass, strict=True):
        if damper.locked:
            mass[damper.body - 1, damper.body - 1] += md
            continue
        if damper.spring is not None:
            raise SceneError(
                f"damper in body {damper.body}: it is a mass on a spring, but the approximate method requires a "
                "floor. Remove the damper, or use rig.orbit_response."
            )
        if damper.grains is not None:
            raise SceneError(
                f"scene {scene.name!r}: the damper in body {damper.body} is a bed of grains; the "
                "approximate method treats a bed as one mass. Remove the damper's key grains."
            )
        if damper.contact is not None:
            raise SceneError(
                f"damper in body {damper.body}: its contact has a finite duration, but the approximate "
                "method requires instantaneous contact. Remove the damper's key contact, or use rig.orbit_response."
            )
        if damper.restitution != 0:
            raise SceneError(
                f"damper in body {damper.body}: restitution {damper.restitution}, but the approximate "
                "method requires 0. Set restitution to 0, or use rig.orbit_response."
            )
        damper_masses[damper.body] = damper_masses.get(damper.body, 0.0) + float(md)
        clearances.add(damper.clearance)
    if len(clearances) > 1:
        clearance_list = ", ".join(f"{1e3 * c:g} mm" for c in sorted(clearances))
        raise SceneError(
            f"dampers: got the clearances {clearance_list}, but the approximate method combines all dampers into one. "
            "Give all dampers the same clearance."
        )
    if force is None:
        levels = () if scene.test is None or scene.test.level_key != "force" else scene.test.levels
        if len(levels) != 1:
            raise SceneError("force: the test of the scene does not specify one force amplitude. Pass force=... in N.")
        force = float(levels[0])
    return reduce_to_mode(
        (mass, model.damping, model.stiffness),
        mode=mode,
        driven=tuple(body + 1 for body in driven_bodies(scene)),
        force=force,
        dampers=damper_masses,
        clearance=clearances.pop() if clearances else float("inf"),
        gravity=scene.gravity,
        weighting=weighting,
        at=at,
    )
