"""Free flights of a damper between its impacts: its restitution, and whether it may reach the ceiling."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from analysis.damper_motion.impact_detection import Impacts, band, impacts
from analysis.damper_motion.landing_pulse import landing_pulse
from analysis.damper_motion.matching_pursuit import RESIDUAL_SHARE
from analysis.decays.sensor_correction import CorrectedMotion
from analysis.responses.systematic import tolerance

if TYPE_CHECKING:
    from daq.recording.recording import Recording
    from daq.signal_chain.channel import ChannelInfo
    from rig.scene.damper import Damper
    from rig.scene.scene import Scene

Array = NDArray[np.float64]

# Ends of the stretch that are left out: the correction continues its motion as a mirror image.
_ENDS_SHARE = 0.05
# Least number of flights, and their least share of the intervals between impacts.
_MIN_FLIGHTS = 6
_MIN_SHARE = 0.25
# A flight agrees with the data if it ends this close to the wall, relative to its own height; it determines the
# restitution if its uncertainty is below the second value.
_MAX_MISS = 0.05
_MAX_UNCERTAINTY = 0.1
# Standard deviation of a normal error over its median deviation, times that of a median over that of a mean.
_MEDIAN_ERROR = 1.4826 * 1.2533
# A flight that ends nearer to the ceiling than this share of the clearance may reach it: the motion between samples and
# the impact itself, which the band-limited motion smears, limit the accuracy of the height.
_CEILING_SHARE = 0.03
# Samples that an impact smears.
_SMEARED_SAMPLES = 2


class BodyMotion:
    """Motion of a damper's body in a stretch of its channel, and the impacts detected in it."""

    def __init__(self, rec: Recording, channel: str, start: int, stop: int) -> None:
        self.rec, self.start = rec, start
        self.info: ChannelInfo = rec.channels[channel]
        self.samples = rec.read(self.info.name, start, stop)
        self._motion = CorrectedMotion(self.info, self.samples, *band(rec.rate))

    @cached_property
    def impacts(self) -> Impacts:
        """Impacts detected in the stretch."""
        stop = self.start + self.samples.size
        return impacts(self.rec, self.info.name, self.start, stop, self.samples)

    @cached_property
    def displacement(self) -> Array:
        """m; shape (n,)."""
        return self._motion("displacement")

    @cached_property
    def velocity(self) -> Array:
        """m/s; shape (n,)."""
        return self._motion("velocity")

    @cached_property
    def acceleration(self) -> Array:
        """m/s²; shape (n,)."""
        return self._motion("acceleration")

    @property
    def tolerance(self) -> float:
        """Relative uncertainty of the channel's sensitivity."""
        return tolerance(self.info)

    def wall_at(self, time: float, wall: float, added_speed: float) -> _Touch:
        """Position and speed of a wall at an impact: a band-limited signal passes the middle of the velocity jump."""
        whole = min(int(time * self.rec.rate), self.samples.size - 2)
        part = time * self.rec.rate - whole
        place, speed = (
            float(row[whole] + part * (row[whole + 1] - row[whole]))
            for row in (self.displacement, self.velocity)
        )
        return _Touch(time, wall, place + wall, speed + added_speed)


@dataclass(frozen=True)
class Restitution:
    """Coefficient of restitution (closing speed after an impact over the one before) and its standard deviation."""

    value: float
    error: float


class _Touch(NamedTuple):
    """A damper leaves or meets a wall: when, and the wall's height above the floor, position and speed; SI."""

    time: float
    wall: float
    place: float
    speed: float

    @property
    def away(self) -> float:
        """Direction from the wall into the cavity."""
        return 1.0 if self.wall == 0.0 else -1.0


class _Estimate(NamedTuple):
    value: float
    uncertainty: float


def restitution(motion: BodyMotion, damper: Damper) -> Restitution | None:
    """Estimate the restitution of the only damper on a body from the impacts in a stretch of its channel.

    Between two impacts the damper falls freely, in a cavity whose motion is measured. That it leaves one wall and meets
    the other at those times gives both speeds: its closing speed w, whether it was at rest and left as its body fell
    away, or rebounded. The jump of its body's velocity is ``(1 + e) w m / (m + M)`` with the masses of both. Masses and
    clearance are the scene's.

    A rebound that ends before it is resolved from its impact makes of ``1 + e`` at most ``(1 + e) / (1 - e)``: the
    value is the middle between, and the error includes both, and every rebound shorter than the channel's resolution.

    None where too few flights agree with the impacts, or only with an impossible value; and where contact has a
    duration: its end is not observed, and the pulse that detects it depends on the restitution.
    """
    found, rate, gravity = motion.impacts, motion.rec.rate, motion.rec.scene.gravity
    if found.contact_duration or found.time.size < _MIN_FLIGHTS:
        return None
    closing = inelastic_closing_speeds(motion.rec.scene, found, damper)
    if not np.isfinite(motion.samples).all() or not np.isfinite(closing).all():
        return None
    # Rebounds that end within the channel's resolution.
    weight = -np.sign(found.jump) * (found.acceleration + gravity)
    hidden = 0.5 * found.resolution * np.maximum(weight, 0.0)
    wall = np.where(found.jump < 0.0, 0.0, damper.clearance)
    time, length = found.time - motion.start / rate, motion.samples.size / rate
    inside = np.flatnonzero((time[:-1] > _ENDS_SHARE * length) & (time[1:] < (1.0 - _ENDS_SHARE) * length))
    estimates = []
    for k in inside[np.isfinite(wall[inside]) & np.isfinite(wall[inside + 1])]:
        left = motion.wall_at(time[k], wall[k], 0.5 * found.jump[k])
        met = motion.wall_at(time[k + 1], wall[k + 1], -0.5 * found.jump[k + 1])
        estimates.append(
            _after_rest(motion, left, met, closing[k + 1], hidden[k + 1])
            or _after_rebound(motion, left, met, closing[k : k + 2])
        )
    known = np.array([each for each in estimates if each is not None]).reshape(-1, 2)
    if len(known) < max(_MIN_FLIGHTS, _MIN_SHARE * inside.size):
        return None
    value, uncertainty = np.median(known, axis=0)
    scatter = _MEDIAN_ERROR * float(np.median(abs(known[:, 0] - value))) / np.sqrt(len(known))
    # A jump is known to no better than its residual: a bound of two standard deviations.
    size = 0.5 * RESIDUAL_SHARE * (1.0 + value)
    error = float(np.sqrt(scatter**2 + uncertainty**2 + size**2))
    # Outside these no wall returns speed: what was detected are not its impacts.
    return Restitution(float(value), error) if -2.0 * error <= value <= 1.0 + 2.0 * error else None


def inelastic_closing_speeds(scene: Scene, found: Impacts, damper: Damper) -> Array:
    """Return closing speeds of the only damper on a body if nothing rebounded, m/s; not finite where it has no mass."""
    return np.asarray(abs(found.jump) * _speed_per_jump(scene, damper))


@lru_cache(maxsize=8)
def _speed_per_jump(scene: Scene, damper: Damper) -> float:
    from rig.system.structural_model import structural_model

    model, place = structural_model(scene), damper.body - 1
    bed = model.bed_mass[scene.dampers.index(damper)]
    with np.errstate(divide="ignore"):
        return float(1.0 + 1.0 / (model.mobility[place, place] * bed))


def _flight(gravity: float, left: _Touch, met: _Touch) -> tuple[float, float, float]:
    """Duration of a flight that begins with its wall's speed, its end's height above the other wall, closing speed."""
    time = met.time - left.time
    above = left.place + left.speed * time - 0.5 * gravity * time**2 - met.place
    return time, above, -met.away * (left.speed - gravity * time - met.speed)


def _after_rest(
    motion: BodyMotion, left: _Touch, met: _Touch, inelastic: float, hidden: float
) -> _Estimate | None:
    """Restitution from a flight that began where the body fell away from a damper at rest on its wall."""
    rate, gravity = motion.rec.rate, motion.rec.scene.gravity
    inside = slice(int(left.time * rate) + 2, int(met.time * rate) - 1)
    if inside.stop - inside.start < 3:
        return None
    weight = left.away * (np.gradient(motion.velocity[inside]) * rate + gravity)
    best, miss = None, _MAX_MISS
    for begin in inside.start + np.flatnonzero((weight[:-1] > 0.0) & (weight[1:] <= 0.0)):
        time, above, closing = _flight(gravity, motion.wall_at(begin / rate, left.wall, 0.0), met)
        missed = abs(above) / max(closing * time / 4.0, 1e-300)
        if missed < miss:
            best, miss = (closing, time), missed
    if best is None:
        return None
    closing, time = best
    most = inelastic / closing - 1.0
    least = most / (2.0 + most) if most > 0.0 else most
    # A landing later by d misses by w d, and closes faster by twice its share in the flight.
    miss = 0.5 * miss + motion.tolerance * gravity * time / closing
    uncertainty = 0.5 * float(np.maximum(most - least, hidden / closing)) + miss * (1.0 + most)
    return _Estimate(0.5 * (least + most), uncertainty) if uncertainty < _MAX_UNCERTAINTY else None


def _after_rebound(motion: BodyMotion, left: _Touch, met: _Touch, inelastic: Array) -> _Estimate | None:
    """Restitution from a flight that began with an impact: its rebound, and the next closing speed."""
    gravity = motion.rec.scene.gravity
    time, above, closing = _flight(gravity, left, met)
    rebound = -above / time
    closing, share = closing - met.away * rebound, left.away * rebound / inelastic[0]
    if closing <= 0.0 or share >= 1.0:
        return None
    from_jump, from_rebound = inelastic[1] / closing - 1.0, share / (1.0 - share)
    difference = abs(from_jump - from_rebound)
    if difference > _MAX_UNCERTAINTY:
        return None
    miss = motion.tolerance * gravity * time / closing * (1.0 + from_jump)
    return _Estimate(0.5 * (from_jump + from_rebound), 0.5 * difference + miss)


def may_reach_ceiling(motion: BodyMotion, damper: Damper) -> bool:
    """Return whether the only damper on a body may reach its ceiling between its floor impacts.

    After an impact the damper is at rest on the floor while its body's acceleration exceeds -g, and falls freely from
    then on: its height above the floor follows from the body's motion alone. Where contact has a duration, its release
    is not known; but its impact gives its closing speed, and that its fall before. The height is taken as large as the
    sensor's tolerance allows, and its median over the stretch is compared with the scene's clearance.
    """
    if not np.isfinite(damper.clearance) or not np.any(motion.impacts.jump < 0.0):
        return False
    found, rate, gravity = motion.impacts, motion.rec.rate, motion.rec.scene.gravity
    largest = 1.0 / max(1.0 - motion.tolerance, 1e-300)
    place, count = found.time * rate - motion.start, motion.samples.size
    chosen = (found.jump < 0.0) & (place > _ENDS_SHARE * count) & (place < (1.0 - _ENDS_SHARE) * count)
    place = place[chosen]
    floor = _Floor(
        largest * motion.displacement,
        largest * motion.velocity,
        largest * motion.acceleration + gravity,
        rate,
        gravity,
    )
    pulse = landing_pulse(motion.rec.scene, motion.info.at, rate)
    if pulse is None:
        heights = [
            floor.height_from_rest(int(left) + _SMEARED_SAMPLES, int(met)) for left, met in pairwise(place)
        ]
    else:
        speeds = inelastic_closing_speeds(motion.rec.scene, found, damper)[chosen]
        closing = largest * speeds / (1.0 + pulse.restitution)
        heights = [
            floor.height_before(int(left), met, speed)
            for (left, met), speed in zip(pairwise(place), closing[1:], strict=True)
        ]
    return bool(heights) and float(np.median(heights)) > (1.0 - _CEILING_SHARE) * damper.clearance


@dataclass(frozen=True)
class _Floor:
    """Motion of a cavity's floor; `weight` is its acceleration above -g."""

    place: Array
    speed: Array
    weight: Array
    rate: float
    gravity: float

    def height_from_rest(self, at: int, last: int) -> float:
        """Greatest height between two samples of what is at rest on the floor at first and does not rebound, m."""
        highest = 0.0
        while at < last and (falling := np.flatnonzero(self.weight[at:last] < 0.0)).size:
            begin, late = at + int(falling[0]), 0.0
            if begin > at:
                # It left between two samples: where its weight, a straight line there, passed through zero.
                before = self.weight[begin - 1]
                late = self.weight[begin] / (self.weight[begin] - before) / self.rate
            start = self.place[begin] - self.speed[begin] * late - 0.5 * self.gravity * late**2
            speed = self.speed[begin] + self.gravity * late
            time = late + np.arange(1, last - begin + 1) / self.rate
            height = start + speed * time - 0.5 * self.gravity * time**2 - self.place[begin + 1 : last + 1]
            landed = np.flatnonzero(height < 0.0)
            end = int(landed[0]) if landed.size else height.size
            highest = max(highest, float(height[:end].max(initial=0.0)))
            at = begin + 1 + end
        return highest

    def height_before(self, first: int, met: float, closing: float) -> float:
        """Greatest height of what meets the floor at a place with a closing speed, after another place, m."""
        # The last sample that the impact does not smear, and the height there.
        last = int(met) - _SMEARED_SAMPLES
        left = (met - last) / self.rate
        height, closing = (
            left * closing - 0.5 * self.weight[last] * left**2,
            closing - self.weight[last] * left,
        )
        time = np.arange(max(last - first, 0)) / self.rate
        own = self.place[last] + height - (self.speed[last] - closing) * time - 0.5 * self.gravity * time**2
        above = own - self.place[last - np.arange(time.size)]
        landed = np.flatnonzero(above < 0.0)
        return float(above[: int(landed[0]) if landed.size else above.size].max(initial=0.0))
