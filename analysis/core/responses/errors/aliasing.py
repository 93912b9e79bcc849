"""Aliasing: errors of responses due to components above half the sample rate, in channels without anti-aliasing filter.

An *image* of a drive of frequency f is its component at a multiple of the sample rate, plus or minus f.
"""

import numpy as np

from analysis.core.responses.errors.systematic import (
    ALIASING,
    ChannelContributions,
    gain_error_limit,
    relative_to_reading,
)
from daq.core.recording.recording import Recording
from rig import Scene
from rig.core.base.arrays import Array, ComplexArray
from rig.core.results.response import MOTIONS
from rig.core.scene.shaker import Shaker
from rig.core.system.structural_model import damper_masses, mass_matrix

# Multiples of the sample rate whose images are summed individually.
_MULTIPLES = np.array([k for k in range(-8, 9) if k])
# Factor on the sum for all further images; exact for the slowest possible decrease of images, as 1/k².
_FURTHER_IMAGES = 1.08
# The aliased part of a reading is at least this fraction of the reading times (frequency / sample rate)².
_MIN_IMAGE_RATIO = 0.1
# The top of the band begins at this fraction of the highest frequency.
_TOP_OF_BAND = 0.8


def aliasing_limit(rec: Recording, contributions: ChannelContributions) -> dict[str, Array]:
    """Compute the maximum error of a response due to aliasing of components above half the sample rate.

    The drive is interpolated linearly between samples. Its images are therefore smaller than the drive by the square of
    the frequency ratio. A channel without a decimation filter records the images, attenuated by its sensor and
    amplifier. The acceleration of the table contains the images that the shaker reproduces. The acceleration of a body
    contains the images that the structure transmits above its modes.
    """
    true_ratio, recorded_ratio = aliased_ratios(rec, contributions)
    return {ALIASING: gain_error_limit(true_ratio, recorded_ratio, contributions)} if recorded_ratio.any() else {}


def aliased_ratios(rec: Recording, contributions: ChannelContributions) -> tuple[Array, Array]:
    """Compute the largest aliased component of each channel, relative to the true and to the recorded amplitude.

    Both have the shape (channels, lines). They are zero for recordings of other instruments, because the scene does not
    describe how these instruments generate the drive and filter their inputs.
    """
    frequency, value, reference = contributions.frequency, contributions.value, contributions.reference
    true_ratio, recorded_ratio = np.zeros(reference.shape), np.zeros(reference.shape)
    if rec.source:
        return true_ratio, recorded_ratio
    # Above the modes, the acceleration of a body is at most its acceleration at the top of the band. The driven body is
    # an exception if modes lie above the band: its acceleration is then force over mass.
    acceleration = abs(value) * (2.0 * np.pi * frequency) ** (2 - MOTIONS.index(contributions.motion))
    top_acceleration = np.median(acceleration[frequency >= _TOP_OF_BAND * frequency.max()])
    above_band = np.minimum(top_acceleration / np.maximum(acceleration, 1e-300), 1.0)
    for row, name in enumerate(contributions.names):
        info = rec.channels[name]
        if info.filter:
            continue
        images = info.rate * _MULTIPLES[:, None] + frequency
        transmission = abs(info.response(images.ravel()).reshape(images.shape) / info.response(frequency))
        if info.quantity in MOTIONS:
            # Relative to the acceleration, images in velocity and displacement are smaller by the frequency ratio.
            transmission *= abs(frequency / images) ** (2 - MOTIONS.index(info.quantity))
        shaker = rec.scene.driven_shaker
        if info.at == "table" and shaker is not None:
            # A channel without a share in the force is computed from the driven body: k0 x0 / F = 1 + k0 x1 / F.
            spring_share = np.where(reference[row] == 0.0, 1.0 + (shaker.coil_spring or 0.0) * value, reference[row])
            image_ratio = _image_ratio(shaker, frequency, images, spring_share)
            true_ratio[row] = _FURTHER_IMAGES * np.sum(transmission * image_ratio, axis=0)
            recorded_ratio[row] = relative_to_reading(true_ratio[row])
            continue
        recorded_ratio[row] = _FURTHER_IMAGES * np.sum((frequency / images) ** 2 * transmission, axis=0)
        if info.body:
            driven_ratio = _free_acceleration(rec.scene, info.body) / np.maximum(acceleration, 1e-300)
            recorded_ratio[row] *= np.maximum(above_band, driven_ratio)
            # A channel that transmits even the highest image records impacts between two samples as well.
            recorded_ratio[row] += _impact_ratio(rec.scene, info.body) * transmission.min(axis=0)
        # The aliased part is at least this value.
        recorded_ratio[row] = np.maximum(recorded_ratio[row], _MIN_IMAGE_RATIO * (frequency / info.rate) ** 2)
        true_ratio[row] = relative_to_reading(recorded_ratio[row])
    return true_ratio, recorded_ratio


def _free_acceleration(scene: Scene, body: int) -> float:
    """Return the acceleration of a body per shaker force above all modes, 1/kg; 0 for a body without shaker."""
    shaker = scene.driven_shaker
    if shaker is None or body not in shaker.bodies:
        return 0.0
    return _inverse_mass(scene, body)


def _impact_ratio(scene: Scene, body: int) -> float:
    """Return the largest ratio of a body's acceleration by damper impacts to its total acceleration.

    It is the damper mass over the mass of the body: a damper that follows the body within its clearance receives a
    force in proportion to its mass, and impacts transmit at most this force.
    """
    masses = [
        damper_mass
        for damper, damper_mass in zip(scene.dampers, damper_masses(scene, mass_matrix(scene.structure)), strict=True)
        if damper.body == body and damper.impacts and not (damper.contact or damper.grains)
    ]
    return float(sum(masses)) * _inverse_mass(scene, body)


def _inverse_mass(scene: Scene, body: int) -> float:
    """Return the acceleration of a body per force on it while no other force acts on any body, 1/kg."""
    return float(np.linalg.inv(mass_matrix(scene.structure))[body - 1, body - 1])


def _image_ratio(shaker: Shaker, frequency: Array, images: Array, spring_share: ComplexArray) -> Array:
    """Compute the ratio of table accelerations due to images of the drive and due to the drive, shape (images, lines).

    A table motion X0 against a force F requires the drive P X0 + Q F. At an image frequency the structure is
    practically at rest, and the full spring force acts on the table. The image of the drive is smaller by the square of
    the frequency ratio, but the acceleration per displacement is larger by the same factor. `spring_share`: spring
    stiffness times X0 / F at each line.
    """
    spring = shaker.coil_spring or 0.0
    per_motion, per_force = shaker.required_drive(np.asarray(2j * np.pi * frequency, dtype=np.complex128))
    image_per_motion, image_per_force = shaker.required_drive(np.asarray(2j * np.pi * images, dtype=np.complex128))
    with np.errstate(divide="ignore", invalid="ignore"):
        drive = abs(per_motion) + abs(per_force) * spring / np.maximum(abs(spring_share), 1e-300)
    return np.asarray(drive / abs(image_per_motion + image_per_force * spring))
