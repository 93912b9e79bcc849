"""Restitution of a damper, from the jumps of its body's velocity: what impacts take out against how hard they are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.dampers.impact_detection import Impacts
from analysis.decays.sensor_correction import corrected
from analysis.recordings.slices import read_slices

if TYPE_CHECKING:
    from daq.recording.recording import Recording
    from rig.scene.damper import Damper

Array = NDArray[np.float64]

# Below the lowest frequency of interest, Hz; up to this share of the sample rate.
_LOW, _HIGH = 2.0, 0.4
# Parts whose scatter gives the standard deviation.
_PARTS = 8
# Fewer impacts say nothing.
_FEWEST = 16
# The impulses of impacts must carry the damper's weight to this part: what is missing was ridden, or not seen.
_CARRIED = 0.1


@dataclass(frozen=True)
class Restitution:
    """Closing speed after an impact over the one before, and its standard deviation."""

    value: float
    error: float


def restitution(rec: Recording, found: Impacts, damper: Damper, start: int, stop: int) -> Restitution | None:
    """Tell the restitution of the only damper on a body from the impacts in a steady stretch of its channel.

    An impulse J between body and damper takes out J²/(2 m) (1 - e)/(1 + e), m the reduced mass of both. As the
    damper's energy stays the same from period to period, that is what the body puts in: J times the mean of its
    velocities before and after. Both follow from the jumps of the body's velocity; the gain of the sensor cancels.

    None where the impacts seen do not carry the damper's weight: it rides part of the time, or strikes more often
    than can be seen.
    """
    from rig.system.structure import structure_matrices

    mass, _, _ = structure_matrices(rec.scene.structure)
    body = float(mass[damper.body - 1, damper.body - 1])
    own = damper.mass if damper.mass is not None else (damper.mass_ratio or 0.0) * body
    if found.time.size < _FEWEST or not own > 0:
        return None
    impulse = -body * found.jump
    weight = own * rec.scene.gravity * found.searched
    if not abs(impulse.sum() - weight) < _CARRIED * weight:
        return None
    carried = float(impulse.sum() / weight)
    velocity = _velocity(rec, found, start, stop)
    if velocity is None:
        return None
    # J = m (1 + e) w at closing speed w, so that what J takes out, per J², is (1 - e) / (1 + e) over 2 m.
    factor = 2.0 * own * body / (own + body)
    put_in, hard = impulse * velocity, impulse**2
    parts = np.array_split(np.arange(impulse.size), _PARTS)
    every = factor * put_in.sum() / hard.sum()
    # What each part leaves out of the whole (jackknife).
    without = np.array(
        [factor * (put_in.sum() - put_in[part].sum()) / (hard.sum() - hard[part].sum()) for part in parts]
    )
    scatter = float(np.sqrt((_PARTS - 1) / _PARTS * np.sum((without - without.mean()) ** 2)))
    # Weight that was not seen to be carried may have been carried in impacts like these, or ridden.
    spread = float(np.hypot(scatter, abs(carried - 1.0) * abs(every)))
    value = (1.0 - every) / (1.0 + every)
    return Restitution(float(value), float(2.0 * spread / (1.0 + every) ** 2))


def band(rate: float) -> tuple[float, float]:
    """Frequencies between which a body's motion is told at a sample rate, Hz."""
    return _LOW, _HIGH * rate


def _velocity(rec: Recording, found: Impacts, start: int, stop: int) -> Array | None:
    """Mean of the body's velocities before and after each impact: what a band-limited reading passes through."""
    info = rec.channels[found.channel]
    samples = next(read_slices(rec, [found.channel], [(start, stop)]))[0]
    if not np.isfinite(samples).all():
        return None
    smooth = corrected(info, samples, "velocity", *band(rec.rate))
    return np.interp(found.time * rec.rate - start, np.arange(smooth.size), smooth)
