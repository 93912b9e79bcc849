"""The settled bed: initial positions of the grains at rest on the floor, as dense as after long shaking.

The grains fall into the cavity without friction. The ceiling is then lowered until its force equals the bed's weight;
this flattens the bed, like the screw that closes a real cavity. Without friction the contact forces follow from the
positions alone: a run begins in exact equilibrium, with the whole weight on the floor. The computation takes more
CPU time than the simulation of many periods, so the result is stored in the user's cache.
"""

import hashlib
import os
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import platformdirs

from rig.core.base.arrays import Array
from rig.core.base.errors import RunError
from rig.core.base.study import code_digest
from rig.core.scene.scene import STANDARD_GRAVITY
from rig.core.system.spheres import Spheres, rayleigh_time
from rig.extras.grains.bed import CEILING, FLOOR, Bed
from rig.extras.grains.lammps_library import lammps_version

#: Time step of packing, relative to Rayleigh's time (`rayleigh_time`).
_STEP_RATIO = 0.1
#: While grains fall and the bed is flattened, Young's modulus is at most this value [Pa]. With this limit the
#: arrangement and its computing time do not depend on the modulus of stiff grains.
_MAX_PACKING_MODULUS = 1e7
#: Time constant of the drag on falling grains [s].
_DRAG_TIME = 10e-3
#: Deviation of the wall force from the weight at the end of the fall: the last grains still bounce.
_FALLEN_FORCE_RATIO = 0.1
#: The fall also requires a kinetic energy below this fraction of weight times grain diameter.
_FALLEN_ENERGY_RATIO = 1e-3
#: Largest deviation of the floor force from the weight of a bed at rest, far below the forces of a test.
_REST_FORCE_RATIO = 3e-4
#: Rest also requires that the last peak of the kinetic energy is below this fraction of weight times grain diameter.
_REST_ENERGY_RATIO = 1e-6
#: Speed of the ceiling that flattens the bed [m/s]: slow against the fall of a grain over its own diameter.
_CEILING_SPEED = 5e-3
#: Number of steps between checks of a falling bed; the fall takes many thousands of steps.
_FALL_STEPS = 500
#: Limit of the checks of a falling bed: an error is better than a simulation without end.
_MAX_FALL_CHECKS = 400
#: Number of steps between checks of a bed that comes to rest: few between two peaks of its kinetic energy.
_REST_STEPS = 20
#: Limit of the checks of a bed that comes to rest: an error is better than a simulation without end.
_MAX_REST_CHECKS = 40_000


def settled_positions(spheres: Spheres) -> Array:
    """Return resting positions of the grains [m], (grains, 3); raise `RunError` if they do not come to rest."""
    stored = _stored_file(spheres)
    # numpy may raise any exception for a damaged file; the bed is then packed again.
    with suppress(Exception), stored.open("rb") as file:
        positions = np.load(file, allow_pickle=False)
        if positions.shape == (spheres.count, 3) and np.isfinite(positions).all():
            return np.asarray(positions)
    positions = _pack(spheres)
    with suppress(OSError):
        stored.parent.mkdir(parents=True, exist_ok=True)
        temporary = stored.with_suffix(f".{os.getpid()}.npy")
        np.save(temporary, positions)
        temporary.replace(stored)
    return positions


def _pack(spheres: Spheres) -> Array:
    """Compute the positions: the grains fall, the ceiling flattens the bed, and the bed comes to rest."""
    frictionless = spheres.settings.replace(friction=0.0, side_friction=None)
    # Grains of limited modulus, which allow longer time steps.
    soft = replace(spheres, settings=frictionless.replace(modulus=min(frictionless.modulus, _MAX_PACKING_MODULUS)))
    flat = _flatten(soft, _drop(soft))
    return _settle(replace(spheres, settings=frictionless), flat)


def bed_top(spheres: Spheres, positions: Array) -> float:
    """Return the height of the highest point of a bed [m]."""
    return float((positions[:, 2] + 0.5 * spheres.diameters()).max())


def _new_bed(spheres: Spheres, positions: Array, ceiling: float) -> Bed:
    """Create a bed with the time step of packing; `ceiling`: height of the ceiling [m]."""
    step = _STEP_RATIO * rayleigh_time(spheres.settings, spheres.density())
    return Bed(spheres, positions, ceiling, STANDARD_GRAVITY, step)


def _drop(spheres: Spheres) -> Array:
    """Return the positions after the fall; the grains may still move slowly."""
    bed = _new_bed(spheres, _initial_positions(spheres), np.inf)
    bed.add_drag(_DRAG_TIME)
    weight = spheres.mass * STANDARD_GRAVITY
    for _ in range(_MAX_FALL_CHECKS):
        bed.advance(_FALL_STEPS)
        force_deviation = abs(bed.forces().sum() / weight - 1.0)
        is_slow = bed.kinetic_energy < _FALLEN_ENERGY_RATIO * weight * spheres.settings.diameter
        if force_deviation < _FALLEN_FORCE_RATIO and is_slow:
            return bed.positions
    raise _not_at_rest(bed, _FALL_STEPS * _MAX_FALL_CHECKS)


def _flatten(spheres: Spheres, fallen: Array) -> Array:
    """Return the positions under a ceiling that was lowered until its force equals the bed's weight."""
    bed = _new_bed(spheres, fallen, bed_top(spheres, fallen))
    bed.add_drag(_DRAG_TIME)
    depth, weight = 0.0, spheres.mass * STANDARD_GRAVITY
    while -bed.forces()[CEILING] < weight:
        depth += _CEILING_SPEED * bed.step
        bed.lower_ceiling(depth)
        bed.advance()
    return bed.positions


def _settle(spheres: Spheres, flat: Array) -> Array:
    """Bring the grains to rest by kinetic damping: all grains are stopped at each peak of their kinetic energy."""
    # Viscous drag, as during the fall, would overdamp slow motions of a bed without friction, so grains would creep.
    bed = _new_bed(spheres, flat, np.inf)
    weight = spheres.mass * STANDARD_GRAVITY
    max_energy = _REST_ENERGY_RATIO * weight * spheres.settings.diameter
    peak_energy = 0.0
    for _ in range(_MAX_REST_CHECKS):
        bed.advance(_REST_STEPS)
        energy = bed.kinetic_energy
        if energy >= peak_energy:
            peak_energy = energy
            continue
        if peak_energy < max_energy and abs(bed.forces()[FLOOR] / weight - 1.0) < _REST_FORCE_RATIO:
            return bed.positions
        bed.stop_grains()
        peak_energy = 0.0
    raise _not_at_rest(bed, _REST_STEPS * _MAX_REST_CHECKS)


def _not_at_rest(bed: Bed, steps: int) -> RunError:
    """Return the error for a bed that still moves after a number of steps."""
    return RunError(
        f"{len(bed.positions)} grains did not come to rest within {steps * bed.step:.3g} s after filling. Set another "
        "seed, or a larger grains.cavity (diameter)."
    )


def _initial_positions(spheres: Spheres) -> Array:
    """Return positions on a slightly disordered grid above the floor, without contacts."""
    max_diameter = float(spheres.diameters().max())
    pitch = 1.06 * max_diameter
    radius = 0.5 * (spheres.settings.cavity - max_diameter)
    coordinates = pitch * np.arange(-np.floor(radius / pitch), np.floor(radius / pitch) + 1.0)
    layer = np.array([(x, y) for x in coordinates for y in coordinates if np.hypot(x, y) <= radius])
    n_layers = -(-spheres.count // len(layer))  # rounded up
    heights = pitch * (0.6 + np.arange(n_layers))
    grid = np.column_stack([np.tile(layer, (n_layers, 1)), np.repeat(heights, len(layer))])[: spheres.count]
    shifts = np.random.default_rng([spheres.seed, 1]).uniform(-0.02, 0.02, grid.shape)
    return np.asarray(grid + max_diameter * shifts)


def _stored_file(spheres: Spheres) -> Path:
    """Return the file of a settled bed. Its name is a digest of the inputs and the code of the packing."""
    # Time step and friction of the motion do not affect the packing; density and diameters follow from the inputs.
    grains = spheres.settings.replace(time_step=None, friction=0.0, side_friction=None)
    inputs = (
        code_digest("rig.extras.grains"),
        lammps_version(),
        repr(grains),
        spheres.count,
        spheres.seed,
        repr(spheres.mass),
    )
    name = hashlib.sha256(repr(inputs).encode()).hexdigest()[:24]
    return folder() / f"{name}.npy"


def folder() -> Path:
    """Return the folder of stored beds, in the user's cache."""
    return platformdirs.user_cache_path("shotrig", appauthor=False) / "beds"
