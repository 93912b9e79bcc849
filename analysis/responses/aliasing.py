"""Aliasing: the effect of components above half the sample rate in channels without an anti-aliasing filter."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from analysis.responses.systematic import ALIASING, ReadingShares, gain_errors, of_reading
from rig.arrays import Array, ComplexArray
from rig.results.response import MOTIONS
from rig.scene.shaker import ElectrodynamicShaker, TableShaker
from rig.system.structural_model import structural_model

if TYPE_CHECKING:
    from daq.recording.recording import Recording
    from rig import Scene


# Multiples of the sample rate whose images are summed, and the largest factor by which all further images increase
# the sum. The factor is exact for images that decrease as 1/k²; it is smaller for images that decrease faster.
_MULTIPLES = np.array([k for k in range(-8, 9) if k])
_TAIL = 1.08
# Images of a force in the resulting motion, as a share of the motion times (frequency / sample rate)².
_IMAGES = 0.1
# The top of the band begins at this fraction of the highest frequency.
_TOP = 0.8


def aliasing_part(rec: Recording, shares: ReadingShares) -> dict[str, Array]:
    """Largest deviation of a response by aliasing of components above half the sample rate.

    The drive is interpolated linearly between samples. Its images about the multiples of the sample rate are smaller
    by the square of the frequency ratio. A channel without a decimation filter records them, attenuated by its sensor
    and amplifier. The table's acceleration contains the images that the shaker reproduces, a body's acceleration
    those that the structure transmits above its modes.
    """
    share, far = folded_shares(rec, shares)
    return {ALIASING: gain_errors(share, far, shares)} if far.any() else {}


def folded_shares(rec: Recording, shares: ReadingShares) -> tuple[Array, Array]:
    """Compute the largest aliased component of each channel, relative to the true and to the recorded amplitude.

    Both have shape (channels, lines). They are zero for recordings of other instruments, because the scene does not
    describe how those generate the drive and filter their inputs.
    """
    frequency, value, lower = shares.frequency, shares.value, shares.lower
    share, far = np.zeros(lower.shape), np.zeros(lower.shape)
    if rec.source:
        return share, far
    # Above the modes the acceleration of a body is at most that at the top of the band. The driven body is the
    # exception: its acceleration is force over mass, which does not show in a band below further modes.
    acceleration = abs(value) * (2.0 * np.pi * frequency) ** (2 - MOTIONS.index(shares.motion))
    top = np.median(acceleration[frequency >= _TOP * frequency.max()])
    beyond = np.minimum(top / np.maximum(acceleration, 1e-300), 1.0)
    for row, name in enumerate(shares.names):
        info = rec.channels[name]
        if info.filter:
            continue
        images = info.rate * _MULTIPLES[:, None] + frequency
        let_through = abs(info.response(images.ravel()).reshape(images.shape) / info.response(frequency))
        if info.quantity in MOTIONS:
            # For equal acceleration, velocity and displacement decrease with frequency.
            let_through *= abs(frequency / images) ** (2 - MOTIONS.index(info.quantity))
        shaker = rec.scene.driven_shaker
        if info.at == "table" and isinstance(shaker, TableShaker | ElectrodynamicShaker):
            # A channel that takes no part in the force measures the driven body itself.
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
            # A channel that transmits up to the highest image also records an impact between two samples.
            far[row] += _blows(rec.scene, body) * let_through.min(axis=0)
        # Lower bound where no smaller value is known for either.
        far[row] = np.maximum(far[row], _IMAGES * (frequency / info.rate) ** 2)
        share[row] = of_reading(far[row])
    return share, far


def _free_acceleration(scene: Scene, body: int) -> float:
    """Acceleration of a body per shaker force above all modes, 1/kg; 0 for a body that no shaker drives."""
    shaker = scene.driven_shaker
    if shaker is None or body not in shaker.bodies:
        return 0.0
    return _inverse_mass(scene, body)


def _blows(scene: Scene, body: int) -> float:
    """Share of a body's acceleration due to instantaneous damper impacts: damper mass over the mass that it hits.

    A damper that follows the body within its clearance takes a share of the force in proportion to its mass; impacts
    transmit at most this share.
    """
    beds = [
        bed
        for damper, bed in zip(scene.dampers, structural_model(scene).bed_mass, strict=True)
        if damper.body == body and damper.moves and not (damper.contact or damper.grains)
    ]
    return float(sum(beds)) * _inverse_mass(scene, body) if beds else 0.0


def _inverse_mass(scene: Scene, body: int) -> float:
    """Acceleration of a body per force on it while all other bodies are at rest, 1/kg."""
    return float(structural_model(scene).mobility[body - 1, body - 1])


def _moved(
    shaker: TableShaker | ElectrodynamicShaker, frequency: Array, images: Array, share: ComplexArray
) -> Array:
    """Ratio of a table's acceleration by the images of a drive to that by the drive itself, shape (images, lines).

    A table motion X0 against a force F requires the drive P X0 + Q F. At an image frequency the structure is
    practically at rest, and the full spring force acts on the table. The image is smaller by the square of the
    frequency ratio; its acceleration per displacement is larger by the same factor. `share`: spring stiffness times X0
    / F.
    """
    motion, pull = _drive_taken(shaker, frequency)
    there, pull_there = _drive_taken(shaker, images)
    with np.errstate(divide="ignore", invalid="ignore"):
        here = abs(motion) + abs(pull) * shaker.spring / np.maximum(abs(share), 1e-300)
    return np.asarray(here / abs(there + pull_there * shaker.spring))


def _drive_taken(
    shaker: TableShaker | ElectrodynamicShaker, frequency: Array
) -> tuple[ComplexArray, ComplexArray]:
    """Drive, up to a constant gain, per metre of table motion and per newton of force on the table."""
    s: ComplexArray = np.asarray(2j * np.pi * frequency, dtype=np.complex128)
    if isinstance(shaker, TableShaker):
        return np.square(1.0 + s / (2.0 * np.pi * shaker.bandwidth)), np.zeros_like(s)
    coil, armature = shaker.coil, shaker.armature
    force = armature.mass * s**2 + armature.damping * s + armature.stiffness
    if shaker.amplifier.mode == "current":
        return force, np.ones_like(s)
    impedance = (coil.resistance + coil.inductance * s) / coil.force_factor
    return impedance * force + coil.force_factor * s, impedance
