"""Beds of grains by an independent discrete-element program, compared with LAMMPS as coupled by rig.

    python -m tests.benchmarks.discrete_elements

The program only uses the contact laws: Hertz with the dashpot of the restitution, Mindlin with Coulomb's limit, and
walls of the same material. The motion of the floor is prescribed. Both programs start from the same packings, because
the motion below a ceiling depends on the height of the bed to a hundredth of a diameter. The comparison takes a quarter
of an hour on one core.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from analysis.reproduction.bed_study import BEDS, FREQUENCY, Setting, scene_of_bed, summary_row
from rig.arrays import Array
from rig.bed_response.steady_bed import steady_grains
from rig.grain_beds.packing import highest, settled
from rig.grain_beds.spheres import Spheres, rayleigh_time, spheres_of
from rig.scene.excitation import Sine
from rig.scene.scene import STANDARD_GRAVITY

#: Acceleration in g, clearance in m, layers, and periods of a block. There are three blocks, of which the last two are
#: averaged. Deep beds below a high ceiling need many periods to become steady.
SETTINGS = (
    (3.0, math.inf, 6, 20), (2.5, math.inf, 4, 20), (3.0, 0.3e-3, 2, 20), (4.5, 0.15e-3, 2, 20), (5.5, 0.5e-3, 4, 20),
    (7.0, 2e-3, 6, 60),
)  # fmt: skip
PACKINGS = (1, 2, 3)
#: Time step in Rayleigh times.
STEP_RAYLEIGH_TIMES = 0.1
#: Distance up to which spheres are neighbors, in radii.
SKIN_RADII = 0.3
FLOOR, CEILING, SIDE = range(3)


@njit(cache=True)  # type: ignore[untyped-decorator]
def contact_force(
    normal: Array, overlap: float, radius: float, mass: float, relative: Array, spin: Array, displacement: Array,
    law: Array, friction: float, step: float, force: Array, shear: Array,
) -> None:  # fmt: skip
    """Compute the force of a contact and its tangential part, and update its tangential displacement.

    `relative`: relative velocity of the centers; `spin`: sum of the lever arms times the spins; `law`: effective normal
    and shear modulus, damping of the restitution.
    """
    closing = relative @ normal
    contact_radius = math.sqrt(radius * overlap)
    dashpot = 2.0 * math.sqrt(5.0 / 6.0) * law[2] * math.sqrt(2.0 * law[0] * contact_radius * mass)
    normal_force = 4.0 / 3.0 * law[0] * contact_radius * overlap - dashpot * closing
    sliding_velocity = relative - closing * normal - np.cross(spin, normal)
    # The tangential displacement rotates with the contact at constant length.
    previous_length = math.sqrt(displacement @ displacement)
    displacement -= (displacement @ normal) * normal
    length = math.sqrt(displacement @ displacement)
    if length > 0.0:
        displacement *= previous_length / length
    displacement += sliding_velocity * step
    stiffness = 8.0 * law[1] * contact_radius
    shear[:] = -stiffness * displacement - dashpot * sliding_velocity
    shear_force, friction_limit = math.sqrt(shear @ shear), friction * abs(normal_force)
    if shear_force > friction_limit:
        shear *= friction_limit / shear_force
        displacement[:] = -(shear + dashpot * sliding_velocity) / stiffness
    force[:] = normal_force * normal + shear


@njit(cache=True)  # type: ignore[untyped-decorator]
def pair_forces(
    at: Array, speed: Array, spin: Array, radius: float, mass: float, law: Array, friction: float, step: float,
    pairs: NDArray[np.int64], stretch: Array, force: Array, torque: Array,
) -> None:  # fmt: skip
    """Add the forces and torques of pairs of spheres."""
    force_ij, shear = np.empty(3), np.empty(3)
    for i, j in pairs:
        separation = at[i] - at[j]
        distance = math.sqrt(separation @ separation)
        overlap = 2.0 * radius - distance
        if overlap <= 0.0:
            stretch[i, j] = 0.0
            continue
        normal, arm = separation / distance, radius - 0.5 * overlap
        surface_velocity = arm * (spin[i] + spin[j])
        contact_force(
            normal, overlap, 0.5 * radius, 0.5 * mass, speed[i] - speed[j], surface_velocity, stretch[i, j],
            law, friction, step, force_ij, shear,
        )  # fmt: skip
        force[i] += force_ij
        force[j] -= force_ij
        torque_ij = -arm * np.cross(normal, shear)
        torque[i] += torque_ij
        torque[j] += torque_ij


@njit(cache=True)  # type: ignore[untyped-decorator]
def wall_forces(
    at: Array, speed: Array, spin: Array, radius: float, mass: float, law: Array, frictions: Array, step: float,
    cavity: Array, stretch: Array, force: Array, torque: Array, lift: Array,
) -> None:  # fmt: skip
    """Add the forces and torques of floor, ceiling and side; `cavity`: its radius and height; `lift`: upward forces."""
    push, shear, normal = np.empty(3), np.empty(3), np.empty(3)
    lift[:] = 0.0
    for i in range(len(at)):
        for wall in range(3):
            normal[:], curved = 0.0, radius
            if wall == FLOOR:
                overlap, normal[2] = radius - at[i, 2], 1.0
            elif wall == CEILING:
                overlap, normal[2] = at[i, 2] + radius - cavity[1], -1.0
            else:
                out = math.hypot(at[i, 0], at[i, 1])
                overlap, curved = out + radius - cavity[0], radius * cavity[0] / (cavity[0] - radius)
                if out > 0.0:
                    normal[:2] = -at[i, :2] / out
            if overlap <= 0.0:
                stretch[i, wall] = 0.0
                continue
            arm = radius - 0.5 * overlap
            contact_force(
                normal, overlap, curved, mass, speed[i], arm * spin[i], stretch[i, wall],
                law, frictions[wall], step, push, shear,
            )  # fmt: skip
            force[i] += push
            torque[i] -= arm * np.cross(normal, shear)
            lift[wall] += push[2]


@njit(cache=True)  # type: ignore[untyped-decorator]
def neighbors(at: Array, within: float) -> NDArray[np.int64]:
    """Return the pairs of spheres whose centers are closer than a distance."""
    count = 0
    pairs = np.empty((len(at) * 30, 2), np.int64)
    for i in range(len(at)):
        for j in range(i + 1, len(at)):
            offset = at[i] - at[j]
            if offset @ offset < within * within:
                pairs[count, 0], pairs[count, 1] = i, j
                count += 1
    return pairs[:count]


@njit(cache=True)  # type: ignore[untyped-decorator]
def shake_bed(
    at: Array, radius: float, mass: float, law: Array, frictions: Array, cavity: Array, step: float, steps: int,
    amplitude: float, omega: float, gravity: float,
) -> Array:  # fmt: skip
    """Shake a bed from rest; return the upward forces of floor, ceiling and side after each step (steps, 3)."""
    count = len(at)
    speed, spin, force, torque = np.zeros((4, count, 3))
    pair_displacements, wall_displacements, lift = (np.zeros((count, count, 3)), np.zeros((count, 3, 3)), np.zeros(3))
    history, traveled, skin = np.empty((steps, 3)), 0.0, SKIN_RADII * radius
    pairs = neighbors(at, 2.0 * radius + skin)
    inertia = 0.4 * mass * radius**2
    frame_acceleration = np.zeros(3)
    for k in range(steps + 1):
        # Velocities for the dashpots are extrapolated over the remaining half step.
        predicted_speed, predicted_spin = (
            speed + 0.5 * step * (force / mass - frame_acceleration),
            spin + 0.5 * step * torque / inertia,
        )
        force[:], torque[:] = 0.0, 0.0
        pair_forces(
            at,
            predicted_speed,
            predicted_spin,
            radius,
            mass,
            law,
            frictions[0],
            step,
            pairs,
            pair_displacements,
            force,
            torque,
        )
        wall_forces(
            at,
            predicted_speed,
            predicted_spin,
            radius,
            mass,
            law,
            frictions,
            step,
            cavity,
            wall_displacements,
            force,
            torque,
            lift,
        )
        frame_acceleration[2] = gravity - amplitude * omega**2 * math.sin(omega * k * step)
        step_fraction = 0.5 if k == 0 else 1.0
        speed += step_fraction * step * (force / mass - frame_acceleration)
        spin += step_fraction * step * torque / inertia
        if k > 0:
            history[k - 1] = lift
        at += step * speed
        traveled += step * math.sqrt((speed**2).sum(axis=1).max())
        if traveled > 0.5 * skin:
            pairs, traveled = neighbors(at, 2.0 * radius + skin), 0.0
    return history


def simulate_bed(spheres: Spheres, amplitude: float, block: int) -> Array:
    """Simulate a bed on a floor with an amplitude [m]; return impulses of floor and ceiling, and energy, normalized."""
    grains = spheres.settings
    positions = settled(spheres)
    per_period = math.ceil(1.0 / (FREQUENCY * STEP_RAYLEIGH_TIMES * rayleigh_time(grains, spheres.density())))
    step, omega = 1.0 / (FREQUENCY * per_period), 2.0 * math.pi * FREQUENCY
    side = grains.friction if grains.side_friction is None else grains.side_friction
    loss = -math.log(grains.restitution) / math.hypot(math.log(grains.restitution), math.pi)
    shear = grains.modulus / (4.0 * (2.0 - grains.poisson_ratio) * (1.0 + grains.poisson_ratio))
    law = np.array([grains.modulus / (2.0 * (1.0 - grains.poisson_ratio**2)), shear, loss])
    lift = shake_bed(
        positions.copy(), 0.5 * grains.diameter, spheres.mass / spheres.count, law,
        np.array([grains.friction, grains.friction, side]),
        np.array([0.5 * grains.cavity, highest(spheres, positions) + spheres.clearance]),
        step, 3 * block * per_period, amplitude, omega, STANDARD_GRAVITY,
    )[block * per_period :]  # fmt: skip
    weight = spheres.mass * STANDARD_GRAVITY
    speed = amplitude * omega * np.cos(omega * step * (np.arange(len(lift)) + 1))
    energy = float(lift.sum(axis=1) @ speed) * step / (2 * block)
    return np.array([lift[:, FLOOR].mean() / weight, -lift[:, CEILING].mean() / weight, energy / (weight * 1e-3)])


def compare_programs(setting: Setting, block: int) -> tuple[Array, Array]:
    """Simulate a bed with LAMMPS in a structure, and with the program above on a floor with the same motion."""
    scene = scene_of_bed(setting)
    (spheres,) = spheres_of(scene).values()
    assert spheres.count == BEDS[setting.layers][0]
    motion = steady_grains(scene, FREQUENCY, block, 3, min_blocks=3)
    test: Any = scene.test
    assert isinstance(test, Sine)
    assert test.force is not None
    _, floor, ceiling, energy, *_ = summary_row(scene, motion)
    other = simulate_bed(spheres, abs(motion.compliance[0]) * test.force, block)
    return np.array([float(floor), float(ceiling), float(energy)]), other


def main() -> None:
    """Print means over packings with their standard errors, and the differences of the two programs."""
    for level, clearance, layers, block in SETTINGS:
        results = np.array(
            [compare_programs(Setting(level, clearance, layers, packing), block) for packing in PACKINGS]
        )
        # Both start from the same packing, so that their difference scatters less than either result.
        values = np.stack([results[:, 0], results[:, 1], results[:, 0] - results[:, 1]])
        means, errors = values.mean(axis=1), values.std(axis=1, ddof=1) / math.sqrt(len(PACKINGS))
        print(f"{level:g} g, clearance {1e3 * clearance:g} mm, {layers} layers:")
        names = ("floor's impulse", "ceiling's impulse", "energy")
        for name, mean, error in zip(names, means.T, errors.T, strict=True):
            (lammps, other, difference), (lammps_error, other_error, difference_error) = mean, error
            if other > 0.0:
                print(
                    f"  {name:18} LAMMPS {lammps:.4g} ±{lammps_error:.2g}, other {other:.4g} ±{other_error:.2g}, "
                    f"difference {100 * difference / other:+.1f} ±{100 * difference_error / other:.1f} %",
                    flush=True,
                )


if __name__ == "__main__":
    main()
