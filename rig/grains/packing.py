"""The settled bed: grains rained into the cavity without friction, as dense as long shaking packs them, and at rest.

A lid that comes down until it bears the bed's weight levels them, as the screw does by which a cavity is closed.
Without friction nothing but the positions is left of the rain: a run begins in exact equilibrium, the whole weight on
the floor. A settled bed costs more than many periods of motion; it is kept in the user's cache.
"""

from __future__ import annotations

import hashlib
import os
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
from numba.misc.appdirs import AppDirs
from numpy.typing import NDArray

from rig.errors import RunError
from rig.grains.bed import CEILING, FLOOR, Bed
from rig.grains.lammps_library import lammps_version
from rig.grains.spheres import Spheres, rayleigh_time
from rig.scene.scene import STANDARD_GRAVITY

Array = NDArray[np.float64]

#: Rayleigh's times in a step while grains are packed.
_STEP = 0.1
#: Young's modulus at which they fall and are levelled, Pa, if they are not softer; the arrangement that this gives is
#: then the same whatever their own modulus is, and costs the same.
_SOFT = 1e7
#: How fast falling grains lose speed, s.
_RELAXATION = 10e-3
#: Shares of its weight that the floor lacks, and of what lifts it by a grain that it has as kinetic energy: of a bed
#: that has fallen, and of one at rest at a peak.
_FALLEN, _AT_REST = (0.1, 1e-3), (3e-4, 1e-6)
#: How fast the lid comes down, m/s.
_LOWERING = 5e-3
#: Steps between looks at a bed that falls, and the most of them.
_LOOK, _MOST = 500, 400
#: Steps between looks at a bed that comes to rest, and the most of them.
_GLANCE, _MOST_GLANCES = 20, 40_000
#: What kept beds go by besides their settings: to be changed with the way in which they are made.
_METHOD = "rain, lid and peaks 3"


def settled(spheres: Spheres) -> Array:
    """Give the positions of grains at rest on the floor, m; shape (grains, 3).

    Raises
    ------
    RunError
        If the grains do not come to rest.
    """
    kept = _file(spheres)
    # Whatever a damaged file leads the reader to: the packing is made anew.
    with suppress(Exception), kept.open("rb") as file:
        positions = np.load(file, allow_pickle=False)
        if positions.shape == (spheres.count, 3) and np.isfinite(positions).all():
            return np.asarray(positions)
    positions = _rained(spheres)
    with suppress(OSError):
        kept.parent.mkdir(parents=True, exist_ok=True)
        part = kept.with_suffix(f".{os.getpid()}.npy")
        np.save(part, positions)
        part.replace(kept)
    return positions


def _rained(spheres: Spheres) -> Array:
    """Let the grains fall, press a lid on them until it bears the bed's weight, and let them come to rest."""
    own = spheres.settings.replace(friction=0.0, side_friction=None)
    soft = replace(spheres, settings=own.replace(modulus=min(own.modulus, _SOFT)))
    levelled = _levelled(soft, _fallen(soft))
    return _resting(replace(spheres, settings=own), levelled)


def highest(spheres: Spheres, positions: Array) -> float:
    """Give the height of the highest point of a bed, m: where a lid that is lowered touches it."""
    return float((positions[:, 2] + 0.5 * spheres.diameters()).max())


def _packed(spheres: Spheres, positions: Array, ceiling: float) -> Bed:
    """Make a bed with the step of time of packing."""
    step = _STEP * rayleigh_time(spheres.settings, spheres.density())
    return Bed(spheres, positions, ceiling, STANDARD_GRAVITY, step)


def _fallen(spheres: Spheres) -> Array:
    """Give the positions of grains that have rained in and lie, though they may creep."""
    bed = _packed(spheres, _hung(spheres), np.inf)
    bed.slow(_RELAXATION)
    weight = spheres.mass * STANDARD_GRAVITY
    for _ in range(_MOST):
        bed.advance(_LOOK)
        unbalanced = abs(bed.forces().sum() / weight - 1.0)
        still = bed.kinetic_energy < _FALLEN[1] * weight * spheres.settings.diameter
        if unbalanced < _FALLEN[0] and still:
            return bed.positions
    raise _restless(bed, _LOOK * _MOST)


def _levelled(spheres: Spheres, fallen: Array) -> Array:
    """Give the positions under a lid that came down until it bears the bed's weight."""
    bed = _packed(spheres, fallen, highest(spheres, fallen))
    bed.slow(_RELAXATION)
    depth, weight = 0.0, spheres.mass * STANDARD_GRAVITY
    while -bed.forces()[CEILING] < weight:
        depth += _LOWERING * bed.step
        bed.lower(depth)
        bed.advance()
    return bed.positions


def _resting(spheres: Spheres, levelled: Array) -> Array:
    """Give the positions at rest, by stopping all grains whenever their kinetic energy is past a peak.

    A bed without friction creeps for long where it is slowed by drag: what is fast is damped well, what is slow is
    damped far too much. Stopped at its peaks of kinetic energy, it is damped well at every pace.

    References
    ----------
    Cundall, P. A., "Explicit finite-difference methods in geomechanics", Proc. 2nd International Conference on
    Numerical Methods in Geomechanics (1976), 132-150.
    """
    bed = _packed(spheres, levelled, np.inf)
    weight = spheres.mass * STANDARD_GRAVITY
    still = _AT_REST[1] * weight * spheres.settings.diameter
    peak = 0.0
    for _ in range(_MOST_GLANCES):
        bed.advance(_GLANCE)
        energy = bed.kinetic_energy
        if energy >= peak:
            peak = energy
            continue
        if peak < still and abs(bed.forces()[FLOOR] / weight - 1.0) < _AT_REST[0]:
            return bed.positions
        bed.stop()
        peak = 0.0
    raise _restless(bed, _GLANCE * _MOST_GLANCES)


def _restless(bed: Bed, steps: int) -> RunError:
    return RunError(
        f"{len(bed.positions)} grains did not come to rest in {steps * bed.step:.3g} s: expected another seed:, or a "
        "wider grains: cavity"
    )


def _hung(spheres: Spheres) -> Array:
    """Hang the grains above the floor without touching each other, on a grid a little out of true."""
    largest = float(spheres.diameters().max())
    pitch = 1.06 * largest
    reach = 0.5 * (spheres.settings.cavity - largest)
    row = pitch * np.arange(-np.floor(reach / pitch), np.floor(reach / pitch) + 1.0)
    layer = np.array([(x, y) for x in row for y in row if np.hypot(x, y) <= reach])
    layers = -(-spheres.count // len(layer))
    heights = pitch * (0.6 + np.arange(layers))
    grid = np.column_stack([np.tile(layer, (layers, 1)), np.repeat(heights, len(layer))])[: spheres.count]
    shifts = np.random.default_rng([spheres.seed, 1]).uniform(-0.02, 0.02, grid.shape)
    return np.asarray(grid + largest * shifts)


def _file(spheres: Spheres) -> Path:
    # Time step and friction of the motion have no part in it; density and diameters come from what has.
    grains = spheres.settings.replace(time_step=None, friction=0.0, side_friction=None)
    said = (_METHOD, lammps_version(), repr(grains), spheres.count, spheres.seed, repr(spheres.mass))
    name = hashlib.sha256(repr(said).encode()).hexdigest()[:24]
    return folder() / f"{name}.npy"


def folder() -> Path:
    """Give the folder of kept beds, in the user's cache."""
    return Path(AppDirs("shotrig", appauthor=False).user_cache_dir) / "beds"
