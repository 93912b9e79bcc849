"""What folds back into the band from beyond half the sample rate, where a channel has no filter against it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.responses.systematic import ALIASING, of_reading, off_by_gains
from rig.results.response import MOTIONS
from rig.scene.shaker import ElectrodynamicShaker, TableShaker
from rig.system.structural_model import structural_model

if TYPE_CHECKING:
    from daq.recording.recording import Recording
    from rig import Scene

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# Multiples of the sample rate whose images count, and how much more all others are, at most: of 1/k² the sums differ
# so, and all that falls off faster by less.
_MULTIPLES = np.array([k for k in range(-8, 9) if k])
_TAIL = 1.08
# Images of a force in the motion it causes, as a share of the motion times the square of frequency over sample rate.
_IMAGES = 0.1
# From this part of the highest frequency on is the top of the band.
_TOP = 0.8


def aliasing_part(
    rec: Recording,
    names: Sequence[str],
    frequency: Array,
    value: ComplexArray,
    upper: ComplexArray,
    lower: ComplexArray,
    motion: str,
) -> dict[str, Array]:
    """How far what folds back from beyond half the sample rate can put a response off.

    The drive goes from sample to sample in straight lines, whose images about the multiples of the sample rate are
    smaller by the square of the ratio of frequencies. A channel without a decimation filter sees them as far as it lets
    them through: of a table's acceleration what its shaker follows, of a body's what a structure follows beyond its
    modes.

    Parameters
    ----------
    rec, names, value, upper, lower
        As in `analysis.responses.systematic.sensitivity_part`.
    frequency : ndarray, shape (lines,)
        Hz.
    motion : str
        What `value` is a response of: displacement, velocity or acceleration.
    """
    share, far = folded_shares(rec, names, frequency, value, lower, motion)
    return {ALIASING: off_by_gains(share, far, value, upper, lower)} if far.any() else {}


def folded_shares(
    rec: Recording,
    names: Sequence[str],
    frequency: Array,
    value: ComplexArray,
    lower: ComplexArray,
    motion: str,
) -> tuple[Array, Array]:
    """Give what folds back into each channel at most, as a share of what it should read and of what it reads.

    Both of shape (channels, lines). Nothing in what another instrument measured: how that drives, and what it filters,
    no scene says.
    """
    share, far = np.zeros(lower.shape), np.zeros(lower.shape)
    if rec.source:
        return share, far
    # Beyond the modes a structure is accelerated as at the top of the band, or less, but where it is driven: there by
    # the force over the mass, of which a band below further modes shows nothing.
    acceleration = abs(value) * (2.0 * np.pi * frequency) ** (2 - MOTIONS.index(motion))
    top = np.median(acceleration[frequency >= _TOP * frequency.max()])
    beyond = np.minimum(top / np.maximum(acceleration, 1e-300), 1.0)
    for row, name in enumerate(names):
        info = rec.channels[name]
        if info.filter:
            continue
        images = info.rate * _MULTIPLES[:, None] + frequency
        let_through = abs(info.response(images.ravel()).reshape(images.shape) / info.response(frequency))
        if info.quantity in MOTIONS:
            # Of the same acceleration there is the less velocity and displacement the higher the frequency.
            let_through *= abs(frequency / images) ** (2 - MOTIONS.index(info.quantity))
        shaker = rec.scene.driven_shaker
        if info.at == "table" and isinstance(shaker, TableShaker | ElectrodynamicShaker):
            # Without a share in the force, what responds is the driven body itself.
            of_force = np.where(lower[row] == 0.0, 1.0 + shaker.spring * value, lower[row])
            moved = _moved(shaker, frequency, images, of_force)
            share[row] = _TAIL * np.sum(let_through * moved, axis=0)
            far[row] = of_reading(share[row])
            continue
        far[row] = _TAIL * np.sum((frequency / images) ** 2 * let_through, axis=0)
        if info.at.startswith("body"):
            body = int(info.at.split()[1])
            free = _free_acceleration(rec.scene, body) / np.maximum(acceleration, 1e-300)
            far[row] *= np.maximum(beyond, free)
            # What is let through up to the farthest image lets a blow pass between two samples.
            far[row] += _blows(rec.scene, body) * let_through.min(axis=0)
        # Where neither is known to be less.
        far[row] = np.maximum(far[row], _IMAGES * (frequency / info.rate) ** 2)
        share[row] = of_reading(far[row])
    return share, far


def _free_acceleration(scene: Scene, body: int) -> float:
    """Acceleration of a body for each newton of a shaker's force beyond all modes, 1/kg: 0 where none drives it."""
    shaker = scene.driven_shaker
    if shaker is None or body not in shaker.bodies:
        return 0.0
    return _inverse_mass(scene, body)


def _blows(scene: Scene, body: int) -> float:
    """Share of a body's acceleration that instant blows of its dampers make: their masses over that which they hit.

    A damper that follows the body within its clearance takes its mass's share of the force, by blows at most all of it.
    """
    beds = [
        bed
        for damper, bed in zip(scene.dampers, structural_model(scene).bed_mass, strict=True)
        if damper.body == body and damper.moves and not (damper.contact or damper.grains)
    ]
    return float(sum(beds)) * _inverse_mass(scene, body) if beds else 0.0


def _inverse_mass(scene: Scene, body: int) -> float:
    """Acceleration of a body for each newton on it while no other has moved, 1/kg."""
    return float(structural_model(scene).mobility[body - 1, body - 1])


def _moved(
    shaker: TableShaker | ElectrodynamicShaker, frequency: Array, images: Array, share: ComplexArray
) -> Array:
    """Acceleration of a table by the images of a drive over that by the drive itself, shape (images, lines).

    A motion X0 that pulls with F takes the drive P X0 + Q F. At an image the structure stands still, and the whole
    spring pulls; the square of the ratio of frequencies that an image is smaller by is that by which it accelerates
    more.

    Parameters
    ----------
    share : ndarray of complex, shape (lines,)
        Spring times X0 over F: the table's share in the force.
    """
    motion, pull = _drive_taken(shaker, frequency)
    there, pull_there = _drive_taken(shaker, images)
    with np.errstate(divide="ignore", invalid="ignore"):
        here = abs(motion) + abs(pull) * shaker.spring / np.maximum(abs(share), 1e-300)
    return np.asarray(here / abs(there + pull_there * shaker.spring))


def _drive_taken(
    shaker: TableShaker | ElectrodynamicShaker, frequency: Array
) -> tuple[ComplexArray, ComplexArray]:
    """Drive, up to a gain, for each metre of a table's motion and for each newton that pulls at it."""
    s: ComplexArray = np.asarray(2j * np.pi * frequency, dtype=np.complex128)
    if isinstance(shaker, TableShaker):
        return np.square(1.0 + s / (2.0 * np.pi * shaker.bandwidth)), np.zeros_like(s)
    coil, armature = shaker.coil, shaker.armature
    force = armature.mass * s**2 + armature.damping * s + armature.stiffness
    if shaker.amplifier.mode == "current":
        return force, np.ones_like(s)
    impedance = (coil.resistance + coil.inductance * s) / coil.force_factor
    return impedance * force + coil.force_factor * s, impedance
