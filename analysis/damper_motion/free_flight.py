"""Free flights of a damper between impacts: coefficient of restitution, and whether the ceiling may be reached."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from analysis.damper_motion.impact_detection import Impacts, band, impacts
from analysis.damper_motion.landing_pulse import landing_pulse
from analysis.damper_motion.matching_pursuit import RESIDUAL_SHARE
from analysis.decays.sensor_correction import CorrectedMotion
from analysis.responses.systematic import tolerance
from rig.arrays import Array

if TYPE_CHECKING:
    from daq.recording.recording import Recording
    from daq.signal_chain.channel import ChannelInfo
    from rig.scene.damper import Damper
    from rig.scene.scene import Scene


# Share of the stretch that is excluded at each end, because the correction mirrors the samples there.
_ENDS_SHARE = 0.05
_MIN_FLIGHTS = 6
# Minimum share of flights among the intervals between impacts.
_MIN_FLIGHTS_SHARE = 0.25
# A flight is consistent with the data if its computed end is this close to the wall, relative to its height.
_MAX_HEIGHT_ERROR = 0.05
# A flight determines the restitution if its uncertainty is below this.
_MAX_UNCERTAINTY = 0.1
# For normal errors: ratio of standard deviation to median absolute deviation, times ratio of the standard deviations
# of median and mean.
_MEDIAN_ERROR = 1.4826 * 1.2533
# A flight that comes within this share of the clearance of the ceiling may reach it. The accuracy of the height is
# limited by the motion between samples and by the band limit, which smears the impact.
_CEILING_SHARE = 0.03
# Number of samples that the band limit smears around an impact.
_SMEARED_SAMPLES = 2


class BodyMotion:
    """Motion of a body with dampers in a stretch of its channel, and the detected impacts."""

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
        """Displacement, m; shape (n,)."""
        return self._motion("displacement")

    @cached_property
    def velocity(self) -> Array:
        """Velocity, m/s; shape (n,)."""
        return self._motion("velocity")

    @cached_property
    def acceleration(self) -> Array:
        """Acceleration, m/s²; shape (n,)."""
        return self._motion("acceleration")

    @property
    def tolerance(self) -> float:
        """Relative uncertainty of the channel's sensitivity."""
        return tolerance(self.info)

    def wall_at(self, time: float, wall: float, added_speed: float) -> _Touch:
        """Return position and speed of a wall at a time; at a jump the band-limited velocity has its mean value."""
        whole = min(int(time * self.rec.rate), self.samples.size - 2)
        part = time * self.rec.rate - whole
        place, speed = (
            float(row[whole] + part * (row[whole + 1] - row[whole]))
            for row in (self.displacement, self.velocity)
        )
        return _Touch(time, wall, place + wall, speed + added_speed)


@dataclass(frozen=True)
class Restitution:
    """Coefficient of restitution (ratio of separation to approach speed) and its standard deviation."""

    value: float
    error: float


class _Touch(NamedTuple):
    """Contact of a damper with a wall: time, height of the wall above the floor, position and speed; SI units."""

    time: float
    wall: float
    place: float
    speed: float

    @property
    def away(self) -> float:
        """Direction from the wall into the cavity."""
        return 1.0 if self.wall == 0.0 else -1.0


def restitution(motion: BodyMotion, damper: Damper) -> Restitution | None:
    """Estimate the restitution of the only damper on a body from the impacts in a stretch of its channel.

    Between two impacts the damper is in free fall inside a cavity whose motion is measured. The times at which it
    leaves one wall and meets the next determine its speeds, and so its closing speed w. The flight begins either from
    rest, when the body falls away from the damper, or with a rebound. The velocity jump of the body is
    ``(1 + e) w m / (m + M)`` with the masses of damper and body. Masses and clearance are those of the scene.

    Unresolved rebounds, which end before the channel resolves them from their impact, increase the apparent ``1 + e``
    to at most ``(1 + e) / (1 - e)``. The estimate is the middle of this range, and its error covers the range and all
    rebounds shorter than the resolution of the channel.

    The result is None if too few flights are consistent with the impacts, or if the value is impossible. It is also
    None for finite-duration contact, because the release is not observed and the pulse that detects the impact
    depends on the restitution.
    """
    detected, rate, gravity = motion.impacts, motion.rec.rate, motion.rec.scene.gravity
    if detected.contact_duration or detected.time.size < _MIN_FLIGHTS:
        return None
    closing = inelastic_closing_speeds(motion.rec.scene, detected, damper)
    if not np.isfinite(motion.samples).all() or not np.isfinite(closing).all():
        return None
    # Speeds of rebounds that end within the time resolution of the channel.
    weight = -np.sign(detected.jump) * (detected.acceleration + gravity)
    hidden = 0.5 * detected.resolution * np.maximum(weight, 0.0)
    wall = np.where(detected.jump < 0.0, 0.0, damper.clearance)
    time, length = detected.time - motion.start / rate, motion.samples.size / rate
    inside = np.flatnonzero((time[:-1] > _ENDS_SHARE * length) & (time[1:] < (1.0 - _ENDS_SHARE) * length))
    estimates = []
    for k in inside[np.isfinite(wall[inside]) & np.isfinite(wall[inside + 1])]:
        left = motion.wall_at(time[k], wall[k], 0.5 * detected.jump[k])
        met = motion.wall_at(time[k + 1], wall[k + 1], -0.5 * detected.jump[k + 1])
        estimates.append(
            _after_rest(motion, left, met, closing[k + 1], hidden[k + 1])
            or _after_rebound(motion, left, met, closing[k : k + 2])
        )
    known = np.array([each for each in estimates if each is not None]).reshape(-1, 2)
    if len(known) < max(_MIN_FLIGHTS, _MIN_FLIGHTS_SHARE * inside.size):
        return None
    value, uncertainty = np.median(known, axis=0)
    scatter = _MEDIAN_ERROR * float(np.median(abs(known[:, 0] - value))) / np.sqrt(len(known))
    # The residual share of a jump is a bound, taken as two standard deviations.
    size = 0.5 * RESIDUAL_SHARE * (1.0 + value)
    error = float(np.sqrt(scatter**2 + uncertainty**2 + size**2))
    # A value outside 0 to 1 is impossible, so the detected jumps are not impacts of this damper.
    return Restitution(float(value), error) if -2.0 * error <= value <= 1.0 + 2.0 * error else None


def inelastic_closing_speeds(scene: Scene, detected: Impacts, damper: Damper) -> Array:
    """Return the closing speeds of the only damper on a body for zero restitution, m/s; infinite without mass."""
    return np.asarray(abs(detected.jump) * _speed_per_jump(scene, damper))


@lru_cache(maxsize=8)
def _speed_per_jump(scene: Scene, damper: Damper) -> float:
    from rig.system.structural_model import structural_model

    model, place = structural_model(scene), damper.body - 1
    bed = model.bed_mass[scene.dampers.index(damper)]
    with np.errstate(divide="ignore"):
        return float(1.0 + 1.0 / (model.mobility[place, place] * bed))


def _flight(gravity: float, left: _Touch, met: _Touch) -> tuple[float, float, float]:
    """Duration of a flight that starts with the wall's speed, height error at its end, and closing speed."""
    time = met.time - left.time
    above = left.place + left.speed * time - 0.5 * gravity * time**2 - met.place
    return time, above, -met.away * (left.speed - gravity * time - met.speed)


def _after_rest(
    motion: BodyMotion, left: _Touch, met: _Touch, inelastic: float, hidden: float
) -> tuple[float, float] | None:
    """Restitution and its uncertainty from a flight that began when the body fell away from a damper at rest."""
    rate, gravity = motion.rec.rate, motion.rec.scene.gravity
    inside = slice(int(left.time * rate) + 2, int(met.time * rate) - 1)
    if inside.stop - inside.start < 3:
        return None
    weight = left.away * (np.gradient(motion.velocity[inside]) * rate + gravity)
    best, relative_error = None, _MAX_HEIGHT_ERROR
    for begin in inside.start + np.flatnonzero((weight[:-1] > 0.0) & (weight[1:] <= 0.0)):
        time, above, closing = _flight(gravity, motion.wall_at(begin / rate, left.wall, 0.0), met)
        deviation = abs(above) / max(closing * time / 4.0, 1e-300)
        if deviation < relative_error:
            best, relative_error = (closing, time), deviation
    if best is None:
        return None
    closing, time = best
    most = inelastic / closing - 1.0
    least = most / (2.0 + most) if most > 0.0 else most
    # An impact that is later by d changes the end height by w d, and the relative closing speed by 2 d / duration.
    relative_error = 0.5 * relative_error + motion.tolerance * gravity * time / closing
    uncertainty = 0.5 * float(np.maximum(most - least, hidden / closing)) + relative_error * (1.0 + most)
    return (0.5 * (least + most), uncertainty) if uncertainty < _MAX_UNCERTAINTY else None


def _after_rebound(
    motion: BodyMotion, left: _Touch, met: _Touch, inelastic: Array
) -> tuple[float, float] | None:
    """Restitution and its uncertainty from a flight that began with a rebound: its speed and the next closing speed."""
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
    relative_error = motion.tolerance * gravity * time / closing * (1.0 + from_jump)
    return 0.5 * (from_jump + from_rebound), 0.5 * difference + relative_error


def may_reach_ceiling(motion: BodyMotion, damper: Damper) -> bool:
    """Return whether the only damper on a body may reach its ceiling between its floor impacts.

    After an instant impact the damper is at rest on the floor while the body's acceleration exceeds -g, and then in
    free fall, so that its height above the floor follows from the motion of the body alone. For finite-duration
    contact the release is unknown; the flight is then computed backward from the closing speed of the next impact.
    The height is the largest that the sensor tolerance allows. Its median over the stretch is compared with the
    clearance of the scene.
    """
    if not np.isfinite(damper.clearance) or not np.any(motion.impacts.jump < 0.0):
        return False
    detected, rate, gravity = motion.impacts, motion.rec.rate, motion.rec.scene.gravity
    largest = 1.0 / max(1.0 - motion.tolerance, 1e-300)
    place, count = detected.time * rate - motion.start, motion.samples.size
    chosen = (detected.jump < 0.0) & (place > _ENDS_SHARE * count) & (place < (1.0 - _ENDS_SHARE) * count)
    place = place[chosen]
    weight = largest * motion.acceleration + gravity
    floor = _Floor(largest * motion.displacement, largest * motion.velocity, weight, rate, gravity)
    pulse, flights = landing_pulse(motion.rec.scene, motion.info.at, rate), pairwise(place)
    if pulse is None:
        heights = [floor.height_from_rest(int(left) + _SMEARED_SAMPLES, int(met)) for left, met in flights]
    else:
        speeds = inelastic_closing_speeds(motion.rec.scene, detected, damper)[chosen]
        closing = largest * speeds[1:] / (1.0 + pulse.restitution)
        heights = [
            floor.height_before(int(left), met, speed)
            for (left, met), speed in zip(flights, closing, strict=True)
        ]
    return bool(heights) and float(np.median(heights)) > (1.0 - _CEILING_SHARE) * damper.clearance


@dataclass(frozen=True)
class _Floor:
    """Motion of the floor of a cavity; `weight` is its acceleration plus g."""

    place: Array
    speed: Array
    weight: Array
    rate: float
    gravity: float

    def height_from_rest(self, at: int, last: int) -> float:
        """Return the maximum height, m, of a damper that starts at rest on the floor and does not rebound."""
        highest = 0.0
        while at < last and (falling := np.flatnonzero(self.weight[at:last] < 0.0)).size:
            begin, late = at + int(falling[0]), 0.0
            if begin > at:
                # The damper left between two samples, at the interpolated zero of `weight`.
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
        """Return the maximum height, m, of a flight after `first` that ends at `met` with a closing speed."""
        # The backward computation starts at the last sample that the impact does not smear.
        last = int(met) - _SMEARED_SAMPLES
        left = (met - last) / self.rate
        height = left * closing - 0.5 * self.weight[last] * left**2
        closing = closing - self.weight[last] * left
        time = np.arange(max(last - first, 0)) / self.rate
        own = self.place[last] + height - (self.speed[last] - closing) * time - 0.5 * self.gravity * time**2
        above = own - self.place[last - np.arange(time.size)]
        landed = np.flatnonzero(above < 0.0)
        return float(above[: int(landed[0]) if landed.size else above.size].max(initial=0.0))
