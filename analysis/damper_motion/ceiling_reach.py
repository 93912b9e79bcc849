"""Whether a damper whose blows on the floor are seen may reach the ceiling as well, where a blow is too weak to see."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.damper_motion.impact_detection import Impacts, band
from analysis.damper_motion.landing_pulse import landing_pulse
from analysis.damper_motion.restitution import hard_speeds
from analysis.decays.sensor_correction import corrected
from analysis.responses.systematic import tolerance

if TYPE_CHECKING:
    from daq.recording.recording import Recording
    from rig.scene.damper import Damper

Array = NDArray[np.float64]

# A flight that ends nearer to the ceiling than this part of the clearance may reach it: the motion between samples, and
# the blow itself, which the body's band-limited motion smears, put the height off.
_NEAR = 0.03
# Ends of the stretch that are left out: there its motion is taken to go on as its mirror image.
_ENDS = 0.05
# What a blow smears, samples.
_SMEARED = 2


def may_reach_ceiling(rec: Recording, found: Impacts, damper: Damper, start: int, stop: int) -> bool:
    """Return whether the only damper on a body may reach its ceiling between its floor impacts.

    After a blow the damper rests on the floor while its body's acceleration exceeds -g, and falls freely from then on:
    its height above the floor follows from the body's motion alone. Where landings last, when and how fast it left the
    floor is not known; but its impact gives its closing speed, and that its fall before. It is taken as large
    as the sensor's tolerance allows, and its median over the stretch is held against the scene's clearance.
    """
    if not np.isfinite(damper.clearance):
        return False
    info, gravity = rec.channels[found.channel], rec.scene.gravity
    samples = rec.read(found.channel, start, stop)
    largest = 1.0 / max(1.0 - tolerance(info), 1e-300)
    way, speed, acceleration = (
        largest * corrected(info, samples, what, *band(rec.rate))
        for what in ("displacement", "velocity", "acceleration")
    )
    place = found.time * rec.rate - start
    struck = (found.jump < 0.0) & (place > _ENDS * samples.size) & (place < (1.0 - _ENDS) * samples.size)
    place, weight = place[struck], acceleration + gravity
    pulse = landing_pulse(rec.scene, info.at, rec.rate)
    if pulse is not None:
        closing = largest * hard_speeds(rec, found, damper)[struck] / (1.0 + pulse.restitution)
        heights = [
            _height_before(way, speed, weight, (int(left), met), late, rec.rate, gravity)
            for (left, met), late in zip(pairwise(place), closing[1:], strict=True)
        ]
    else:
        heights = [
            _height(way, speed, weight, (int(left) + _SMEARED, int(met)), rec.rate, gravity)
            for left, met in pairwise(place)
        ]
    return bool(heights) and float(np.median(heights)) > (1.0 - _NEAR) * damper.clearance


def _height(
    way: Array, speed: Array, weight: Array, within: tuple[int, int], rate: float, gravity: float
) -> float:
    """Greatest height above the floor of what rests on it at first and is never thrown back, between two samples, m."""
    at, last = within
    highest = 0.0
    while at < last and (falling := np.flatnonzero(weight[at:last] < 0.0)).size:
        begin, late = at + int(falling[0]), 0.0
        if begin > at:
            # It left between two samples: where its weight, a straight line there, passed through zero.
            late = weight[begin] / (weight[begin] - weight[begin - 1]) / rate
        left_at = way[begin] - speed[begin] * late - 0.5 * gravity * late**2
        as_fast = speed[begin] + gravity * late
        time = late + np.arange(1, last - begin + 1) / rate
        height = left_at + as_fast * time - 0.5 * gravity * time**2 - way[begin + 1 : last + 1]
        landed = np.flatnonzero(height < 0.0)
        end = int(landed[0]) if landed.size else height.size
        highest = max(highest, float(height[:end].max(initial=0.0)))
        at = begin + 1 + end
    return highest


def _height_before(
    way: Array,
    speed: Array,
    weight: Array,
    within: tuple[int, float],
    closing: float,
    rate: float,
    gravity: float,
) -> float:
    """Greatest height above the floor of what closes on it so fast at a place in samples, after another place, m."""
    first, met = within
    # The last sample that the blow does not smear, and what was left to fall then.
    last = int(met) - _SMEARED
    left = (met - last) / rate
    height, closing = left * closing - 0.5 * weight[last] * left**2, closing - weight[last] * left
    time = np.arange(max(last - first, 0)) / rate
    own = way[last] + height - (speed[last] - closing) * time - 0.5 * gravity * time**2
    above = own - way[last - np.arange(time.size)]
    risen = np.flatnonzero(above < 0.0)
    return float(above[: int(risen[0]) if risen.size else above.size].max(initial=0.0))
