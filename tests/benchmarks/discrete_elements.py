"""Beds of grains simulated by an independent discrete-element program, compared with LAMMPS as used by `rig`.

    python -m tests.benchmarks.discrete_elements

The independent program below shares only the contact laws: normal force by Hertz with a dashpot for the restitution,
tangential force by Mindlin with Coulomb's limit, and walls of the same material. Its floor has the motion of the
structure in `rig`. Both programs start from the same packings, because the motion below a ceiling depends on the height
of the bed to a hundredth of a diameter. The comparison takes a quarter of an hour on one core.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from analysis.studies.paper.bed_study import BEDS, FREQUENCY, Setting, scene_of_bed, summary_row
from rig.core.base.arrays import Array
from rig.core.scene.excitation import Sine
from rig.core.scene.scene import STANDARD_GRAVITY
from rig.core.system.spheres import Spheres, rayleigh_time, spheres_of
from rig.extras.bed_response.steady_bed import steady_grains
from rig.extras.grains.packing import bed_top, settled_positions

#: Amplitude of the acceleration, g; clearance, m; number of layers; periods of a block. A simulation has three blocks,
#: and its results are averaged over the last two. Deep beds below a high ceiling need many periods to become steady.
SETTINGS = (
    (3.0, math.inf, 6, 20), (2.5, math.inf, 4, 20), (3.0, 0.3e-3, 2, 20), (4.5, 0.15e-3, 2, 20), (5.5, 0.5e-3, 4, 20),
    (7.0, 2e-3, 6, 60),
)  # fmt: skip
#: Seeds of the random packings.
PACKINGS = (1, 2, 3)
#: Time step in Rayleigh times.
STEP_RAYLEIGH_TIMES = 0.1
#: Two spheres are neighbors if the gap between them is at most this, in radii (the skin of the neighbor list).
SKIN_RADII = 0.3
#: Indices of the walls.
FLOOR, CEILING, SIDE = range(3)


@njit(cache=True)  # type: ignore[untyped-decorator]
def contact_force(
    normal: Array, overlap: float, radius: float, mass: float, velocity: Array, spin: Array, displacement: Array,
    law: Array, friction: float, step: float, force: Array, tangential_force: Array,
) -> None:  # fmt: skip
    """Compute the force of a contact and its tangential part, N, and update its tangential displacement, m.

    The force acts on the first body; `normal` is a unit vector from the second body to the first.

    `radius`, `mass`: effective radius and mass; `velocity`: relative velocity of the centers; `spin`: sum of the lever
    arms times the angular velocities; `law`: effective normal and shear modulus, Pa, and damping ratio; `friction`:
    coefficient of friction; `step`: time step, s.
    """
    normal_velocity = velocity @ normal
    contact_radius = math.sqrt(radius * overlap)
    dashpot = 2.0 * math.sqrt(5.0 / 6.0) * law[2] * math.sqrt(2.0 * law[0] * contact_radius * mass)
    normal_force = 4.0 / 3.0 * law[0] * contact_radius * overlap - dashpot * normal_velocity
    sliding_velocity = velocity - normal_velocity * normal - np.cross(spin, normal)
    # The tangential displacement rotates with the contact at constant length.
    previous_length = math.sqrt(displacement @ displacement)
    displacement -= (displacement @ normal) * normal
    length = math.sqrt(displacement @ displacement)
    if length > 0.0:
        displacement *= previous_length / length
    displacement += sliding_velocity * step
    stiffness = 8.0 * law[1] * contact_radius
    tangential_force[:] = -stiffness * displacement - dashpot * sliding_velocity
    magnitude, friction_limit = math.sqrt(tangential_force @ tangential_force), friction * abs(normal_force)
    if magnitude > friction_limit:
        tangential_force *= friction_limit / magnitude
        displacement[:] = -(tangential_force + dashpot * sliding_velocity) / stiffness
    force[:] = normal_force * normal + tangential_force


@njit(cache=True)  # type: ignore[untyped-decorator]
def add_pair_forces(
    positions: Array, velocity: Array, spin: Array, radius: float, mass: float, law: Array, friction: float,
    step: float, pairs: NDArray[np.int64], displacements: Array, force: Array, torque: Array,
) -> None:  # fmt: skip
    """Add the forces [N] and torques [N m] between pairs of spheres to those of each sphere, shape (spheres, 3).

    `spin`: angular velocities; `displacements`: tangential displacement of each pair, shape (spheres, spheres, 3).
    """
    pair_force, tangential_force = np.empty(3), np.empty(3)
    for i, j in pairs:
        separation = positions[i] - positions[j]
        distance = math.sqrt(separation @ separation)
        overlap = 2.0 * radius - distance
        if overlap <= 0.0:
            displacements[i, j] = 0.0
            continue
        normal, arm = separation / distance, radius - 0.5 * overlap
        contact_force(
            normal, overlap, 0.5 * radius, 0.5 * mass, velocity[i] - velocity[j], arm * (spin[i] + spin[j]),
            displacements[i, j], law, friction, step, pair_force, tangential_force,
        )  # fmt: skip
        force[i] += pair_force
        force[j] -= pair_force
        pair_torque = -arm * np.cross(normal, tangential_force)
        torque[i] += pair_torque
        torque[j] += pair_torque


@njit(cache=True)  # type: ignore[untyped-decorator]
def add_wall_forces(
    positions: Array, velocity: Array, spin: Array, radius: float, mass: float, law: Array, frictions: Array,
    step: float, cavity: Array, displacements: Array, force: Array, torque: Array, upward_force: Array,
) -> None:  # fmt: skip
    """Add the forces and torques of floor, ceiling and side, and sum the upward force of each wall on the bed.

    `frictions`, `upward_force`: coefficient of friction and force of each wall; `cavity`: its radius and height, m;
    `displacements`: tangential displacement of each sphere at each wall, shape (spheres, 3, 3).
    """
    wall_force, tangential_force, normal = np.empty(3), np.empty(3), np.empty(3)
    upward_force[:] = 0.0
    for i in range(len(positions)):
        for wall in range(3):
            normal[:], effective_radius = 0.0, radius
            if wall == FLOOR:
                overlap, normal[2] = radius - positions[i, 2], 1.0
            elif wall == CEILING:
                overlap, normal[2] = positions[i, 2] + radius - cavity[1], -1.0
            else:
                # The side wall is a cylinder around the spheres: its curvature increases the effective radius.
                axis_distance = math.hypot(positions[i, 0], positions[i, 1])
                overlap = axis_distance + radius - cavity[0]
                effective_radius = radius * cavity[0] / (cavity[0] - radius)
                if axis_distance > 0.0:
                    normal[:2] = -positions[i, :2] / axis_distance
            if overlap <= 0.0:
                displacements[i, wall] = 0.0
                continue
            arm = radius - 0.5 * overlap
            contact_force(
                normal, overlap, effective_radius, mass, velocity[i], arm * spin[i], displacements[i, wall],
                law, frictions[wall], step, wall_force, tangential_force,
            )  # fmt: skip
            force[i] += wall_force
            torque[i] -= arm * np.cross(normal, tangential_force)
            upward_force[wall] += wall_force[2]


@njit(cache=True)  # type: ignore[untyped-decorator]
def neighboring_pairs(positions: Array, max_distance: float) -> NDArray[np.int64]:
    """Return the pairs of spheres (pairs, 2) whose centers are closer than a distance."""
    count = 0
    # Each pair is listed once, and a sphere has fewer than 30 neighbors.
    pairs = np.empty((len(positions) * 30, 2), np.int64)
    for i in range(len(positions)):
        for j in range(i + 1, len(positions)):
            separation = positions[i] - positions[j]
            if separation @ separation < max_distance * max_distance:
                pairs[count, 0], pairs[count, 1] = i, j
                count += 1
    return pairs[:count]


@njit(cache=True)  # type: ignore[untyped-decorator]
def shake_bed(
    positions: Array, radius: float, mass: float, law: Array, frictions: Array, cavity: Array, step: float, steps: int,
    amplitude: float, omega: float, gravity: float,
) -> Array:  # fmt: skip
    """Shake a bed from rest; return the upward forces of floor, ceiling and side after each step, N, shape (steps, 3).

    The cavity moves as `amplitude` [m] times sin(`omega` t). The leapfrog method computes the motion in the frame of
    the cavity: velocities are those in the middle of a step.
    """
    count = len(positions)
    velocity, spin, force, torque = np.zeros((4, count, 3))
    pair_displacements, wall_displacements = np.zeros((count, count, 3)), np.zeros((count, 3, 3))
    upward_force, history = np.zeros(3), np.empty((steps, 3))
    # Neighbors are searched again when spheres may have moved by half of `skin`, the largest gap between neighbors.
    traveled, skin = 0.0, SKIN_RADII * radius
    pairs = neighboring_pairs(positions, 2.0 * radius + skin)
    inertia = 0.4 * mass * radius**2
    frame_acceleration = np.zeros(3)
    for k in range(steps + 1):
        # Velocities for the dashpots are extrapolated over the remaining half step.
        predicted_velocity = velocity + 0.5 * step * (force / mass - frame_acceleration)
        predicted_spin = spin + 0.5 * step * torque / inertia
        force[:], torque[:] = 0.0, 0.0
        add_pair_forces(
            positions, predicted_velocity, predicted_spin, radius, mass, law, frictions[0], step,
            pairs, pair_displacements, force, torque,
        )  # fmt: skip
        add_wall_forces(
            positions, predicted_velocity, predicted_spin, radius, mass, law, frictions, step,
            cavity, wall_displacements, force, torque, upward_force,
        )  # fmt: skip
        # Apparent gravity in the frame of the cavity.
        frame_acceleration[2] = gravity - amplitude * omega**2 * math.sin(omega * k * step)
        step_fraction = 0.5 if k == 0 else 1.0
        velocity += step_fraction * step * (force / mass - frame_acceleration)
        spin += step_fraction * step * torque / inertia
        if k > 0:
            history[k - 1] = upward_force
        positions += step * velocity
        traveled += step * math.sqrt((velocity**2).sum(axis=1).max())
        if traveled > 0.5 * skin:
            pairs, traveled = neighboring_pairs(positions, 2.0 * radius + skin), 0.0
    return history


def simulate_bed(spheres: Spheres, amplitude: float, block: int) -> Array:
    """Simulate a bed on a floor that moves with an amplitude [m]; `block`: periods of each of three blocks.

    Returns three means over the last two blocks: forces of floor and ceiling, relative to the weight of the bed, and
    energy that the bed receives per period, relative to the weight times 1 mm.
    """
    grains = spheres.settings
    positions = settled_positions(spheres)
    rayleigh_step = STEP_RAYLEIGH_TIMES * rayleigh_time(grains, spheres.density())
    steps_per_period = math.ceil(1.0 / (FREQUENCY * rayleigh_step))
    step, omega = 1.0 / (FREQUENCY * steps_per_period), 2.0 * math.pi * FREQUENCY
    side_friction = grains.friction if grains.side_friction is None else grains.side_friction
    damping_ratio = -math.log(grains.restitution) / math.hypot(math.log(grains.restitution), math.pi)
    normal_modulus = grains.modulus / (2.0 * (1.0 - grains.poisson_ratio**2))
    shear_modulus = grains.modulus / (4.0 * (2.0 - grains.poisson_ratio) * (1.0 + grains.poisson_ratio))
    forces = shake_bed(
        positions.copy(), 0.5 * grains.diameter, spheres.mass / spheres.count,
        np.array([normal_modulus, shear_modulus, damping_ratio]),
        np.array([grains.friction, grains.friction, side_friction]),
        np.array([0.5 * grains.cavity, bed_top(spheres, positions) + spheres.clearance]),
        step, 3 * block * steps_per_period, amplitude, omega, STANDARD_GRAVITY,
    )[block * steps_per_period :]  # fmt: skip
    weight = spheres.mass * STANDARD_GRAVITY
    floor_velocity = amplitude * omega * np.cos(omega * step * (np.arange(len(forces)) + 1))
    energy = float(forces.sum(axis=1) @ floor_velocity) * step / (2 * block)
    return np.array([forces[:, FLOOR].mean() / weight, -forces[:, CEILING].mean() / weight, energy / (weight * 1e-3)])


def compare_programs(setting: Setting, block: int) -> tuple[Array, Array]:
    """Simulate a bed with LAMMPS in a structure, and with `simulate_bed` on a floor with the same motion.

    Returns the results of both, as `simulate_bed` does.
    """
    scene = scene_of_bed(setting)
    (spheres,) = spheres_of(scene).values()
    assert spheres.count == BEDS[setting.layers][0]
    motion = steady_grains(scene, FREQUENCY, block, 3, min_blocks=3)
    test: Any = scene.test
    assert isinstance(test, Sine)
    assert test.force is not None
    _, floor, ceiling, energy, *_ = summary_row(scene, motion)
    amplitude = abs(motion.compliance[0]) * test.force
    return np.array([float(floor), float(ceiling), float(energy)]), simulate_bed(spheres, amplitude, block)


def main() -> None:
    """Print means over packings with their standard uncertainties, and the differences of the two programs."""
    for level, clearance, layers, block in SETTINGS:
        results = np.array(
            [compare_programs(Setting(level, clearance, layers, packing), block) for packing in PACKINGS]
        )
        # Both start from the same packing: their difference scatters less than the result of either.
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
