"""Free flights of a damper between impacts: coefficient of restitution, and whether the ceiling may be reached.

A damper moves vertically in a cavity of its body, between *floor* and *ceiling*, which are the *walls*. Their distance
from the damper at rest on the floor is the *clearance*. The *apparent gravity* is the body's acceleration plus g: the
damper stays on the floor while it is positive. The *closing speed* of an impact is the speed of the damper toward the
wall.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from analysis.core.damper_motion.impact_detection import Impacts, band, detect_impacts
from analysis.core.damper_motion.landing_pulse import landing_pulse
from analysis.core.damper_motion.matching_pursuit import RESIDUAL_RATIO
from analysis.core.decays.sensor_correction import correct_motion
from analysis.core.responses.errors.systematic import tolerance
from daq.core.recording.recording import Recording
from daq.core.signal_chain.channel import ChannelInfo
from rig.core.base.arrays import Array
from rig.core.scene.damper import Damper
from rig.core.scene.scene import Scene

# This fraction of the segment is excluded at each end, because the correction mirrors the samples there.
_EXCLUDED_END_RATIO = 0.05
# Smallest number of consistent flights for an estimate of the restitution: few are consistent by chance.
_MIN_FLIGHTS = 6
# At least this fraction of the intervals between impacts must be flights; otherwise impacts were missed.
_MIN_FLIGHT_RATIO = 0.25
# Largest deviation of a consistent flight's computed end from the wall, relative to the flight's height.
_MAX_HEIGHT_ERROR = 0.05
# Largest uncertainty of the restitution from a single flight that is used; other flights would only add noise.
_MAX_UNCERTAINTY = 0.1
# Standard uncertainty of the median of n values, times sqrt(n), over their median absolute deviation, for normal
# errors: 1.4826 for the standard deviation, sqrt(pi / 2) for the median.
_MEDIAN_ERROR = 1.4826 * 1.2533
# A flight may reach the ceiling if its distance from the ceiling is at most this fraction of the clearance. The
# accuracy of the height is limited by the motion between samples and by the band limit, which blurs the impact.
_CEILING_DISTANCE_RATIO = 0.03
# The band limit distorts this number of samples around an impact.
_BLURRED_SAMPLES = 2


class BodyMotion:
    """Motion of a body with dampers in a segment of its channel, and the detected impacts."""

    def __init__(self, rec: Recording, channel: str, start: int, stop: int) -> None:
        self.rec, self.start = rec, start
        self.info: ChannelInfo = rec.channels[channel]
        self.samples = rec.read(self.info.name, start, stop)

    @cached_property
    def impacts(self) -> Impacts:
        """Impacts detected in the segment."""
        stop = self.start + self.samples.size
        return detect_impacts(self.rec, self.info.name, self.start, stop, self.samples)

    @cached_property
    def displacement(self) -> Array:
        """Displacement [m]; shape (n,)."""
        return self._motion("displacement")

    @cached_property
    def velocity(self) -> Array:
        """Velocity [m/s]; shape (n,)."""
        return self._motion("velocity")

    @cached_property
    def acceleration(self) -> Array:
        """Acceleration [m/s²]; shape (n,)."""
        return self._motion("acceleration")

    def _motion(self, motion: str) -> Array:
        return correct_motion(self.info, self.samples, motion, *band(self.rec.rate))

    @property
    def tolerance(self) -> float:
        """Relative tolerance of the channel's sensitivity."""
        return tolerance(self.rec, self.info.name)

    def contact_at(self, time: float, wall: float, added_speed: float) -> "_WallContact":
        """Return position and speed of a wall at a time [s].

        `wall`: height of the wall above the floor [m]; `added_speed`: half the jump of an impact at this time, m/s,
        because the band-limited velocity there is the mean of the velocities before and after the jump.
        """
        sample = min(int(time * self.rec.rate), self.samples.size - 2)
        fraction = time * self.rec.rate - sample
        displacement, speed = (
            float(row[sample] + fraction * (row[sample + 1] - row[sample]))
            for row in (self.displacement, self.velocity)
        )
        return _WallContact(time, wall, displacement + wall, speed + added_speed)


@dataclass(frozen=True)
class Restitution:
    """Coefficient of restitution (ratio of rebound speed to closing speed) and its standard uncertainty."""

    value: float
    error: float


class _WallContact(NamedTuple):
    """Contact of a damper with a wall: an impact, or the start of a flight."""

    time: float  # s
    wall: float  # height of the wall above the floor [m]
    position: float  # position of the wall [m]
    speed: float  # speed of the wall [m/s]

    @property
    def inward(self) -> float:
        """Direction from the wall into the cavity: 1 upward, -1 downward."""
        return 1.0 if self.wall == 0.0 else -1.0


def restitution(motion: BodyMotion, damper: Damper) -> Restitution | None:
    """Estimate the restitution of the only damper in a body from the impacts in a segment of its channel.

    Between two impacts the damper is in free fall inside a cavity whose motion is measured. The times at which the
    damper leaves a wall and meets the next wall determine the closing speed w. The flight begins either from rest, when
    the body falls away from the damper, or with a rebound. The velocity jump of the body is ``(1 + e) w m / (m + M)``
    with the masses m of the damper and M of the body. Masses and clearance are taken from the scene.

    Rebounds that are too short to be resolved from their impact increase the apparent ``1 + e`` to at most ``(1 + e) /
    (1 - e)``. The estimate is the middle of this range; its uncertainty includes the range, and all rebounds that the
    channel does not resolve.

    The result is None if too few flights are consistent with the impacts, or if the value is impossible. The result is
    also None for finite-duration contact, because the release is not observed and the pulse that detects the impact
    depends on the restitution.
    """
    detected, rate, gravity = motion.impacts, motion.rec.rate, motion.rec.scene.gravity
    if detected.contact_duration or detected.time.size < _MIN_FLIGHTS:
        return None
    closing_speed = inelastic_closing_speeds(motion.rec.scene, detected, damper)
    if not np.isfinite(motion.samples).all() or not np.isfinite(closing_speed).all():
        return None
    # Largest rebound speeds that remain undetected: the flight is shorter than the time resolution of the channel.
    apparent_gravity = -np.sign(detected.jump) * (detected.acceleration + gravity)
    unresolved_rebound = 0.5 * detected.resolution * np.maximum(apparent_gravity, 0.0)
    wall = np.where(detected.jump < 0.0, 0.0, damper.clearance)
    time, duration = detected.time - motion.start / rate, motion.samples.size / rate
    # Indices of the impacts at which a flight may begin.
    candidates = np.flatnonzero(
        (time[:-1] > _EXCLUDED_END_RATIO * duration) & (time[1:] < (1.0 - _EXCLUDED_END_RATIO) * duration)
    )
    estimates = []
    for k in candidates[np.isfinite(wall[candidates]) & np.isfinite(wall[candidates + 1])]:
        departure = motion.contact_at(time[k], wall[k], 0.5 * detected.jump[k])
        arrival = motion.contact_at(time[k + 1], wall[k + 1], -0.5 * detected.jump[k + 1])
        estimates.append(
            _restitution_after_rest(motion, departure, arrival, closing_speed[k + 1], unresolved_rebound[k + 1])
            or _restitution_after_rebound(motion, departure, arrival, closing_speed[k : k + 2])
        )
    consistent = np.array([estimate for estimate in estimates if estimate is not None]).reshape(-1, 2)
    if len(consistent) < max(_MIN_FLIGHTS, _MIN_FLIGHT_RATIO * candidates.size):
        return None
    value, uncertainty = np.median(consistent, axis=0)
    scatter = _MEDIAN_ERROR * float(np.median(abs(consistent[:, 0] - value))) / np.sqrt(len(consistent))
    # The residual ratio limits the error of a jump; the limit is taken as two standard deviations.
    jump_error = 0.5 * RESIDUAL_RATIO * (1.0 + value)
    error = float(np.sqrt(scatter**2 + uncertainty**2 + jump_error**2))
    # A value outside 0 to 1 is impossible, so the detected jumps are not impacts of this damper.
    return Restitution(float(value), error) if -2.0 * error <= value <= 1.0 + 2.0 * error else None


def inelastic_closing_speeds(scene: Scene, detected: Impacts, damper: Damper) -> Array:
    """Return the closing speeds of the impacts of the only damper for zero restitution [m/s]; infinite without mass."""
    return np.asarray(abs(detected.jump) * _speed_per_jump(scene, damper))


@lru_cache(maxsize=8)
def _speed_per_jump(scene: Scene, damper: Damper) -> float:
    from rig.core.system.structural_model import damper_masses, mass_matrix

    mass, body = mass_matrix(scene.structure), damper.body - 1
    damper_mass = damper_masses(scene, mass)[scene.dampers.index(damper)]
    with np.errstate(divide="ignore"):
        return float(1.0 + 1.0 / (np.linalg.inv(mass)[body, body] * damper_mass))


def _flight(gravity: float, departure: _WallContact, arrival: _WallContact) -> tuple[float, float, float]:
    """Return duration [s], final height error [m] and closing speed [m/s] of a flight that begins without rebound."""
    time = arrival.time - departure.time
    height_error = departure.position + departure.speed * time - 0.5 * gravity * time**2 - arrival.position
    return time, height_error, -arrival.inward * (departure.speed - gravity * time - arrival.speed)


def _restitution_after_rest(
    motion: BodyMotion,
    departure: _WallContact,
    arrival: _WallContact,
    inelastic_speed: float,
    unresolved_rebound: float,
) -> tuple[float, float] | None:
    """Estimate the restitution from a flight that began when the body fell away from a damper at rest.

    `inelastic_speed`: closing speed of the impact at the end of the flight for zero restitution; `unresolved_rebound`:
    largest rebound speed that is not resolved [m/s]. Returns value and uncertainty, or None if the flight is not
    consistent.
    """
    rate, gravity = motion.rec.rate, motion.rec.scene.gravity
    between = slice(int(departure.time * rate) + 2, int(arrival.time * rate) - 1)
    if between.stop - between.start < 3:
        return None
    apparent_gravity = departure.inward * (np.gradient(motion.velocity[between]) * rate + gravity)
    best_flight, relative_error = None, _MAX_HEIGHT_ERROR
    for begin in between.start + np.flatnonzero((apparent_gravity[:-1] > 0.0) & (apparent_gravity[1:] <= 0.0)):
        departure_from_rest = motion.contact_at(begin / rate, departure.wall, 0.0)
        time, height_error, closing_speed = _flight(gravity, departure_from_rest, arrival)
        deviation = abs(height_error) / max(closing_speed * time / 4.0, 1e-300)
        if deviation < relative_error:
            best_flight, relative_error = (closing_speed, time), deviation
    if best_flight is None:
        return None
    closing_speed, time = best_flight
    upper = inelastic_speed / closing_speed - 1.0
    lower = upper / (2.0 + upper) if upper > 0.0 else upper
    # An impact that is later by d changes the end height by w d, and the relative closing speed by 2 d / duration.
    relative_error = 0.5 * relative_error + motion.tolerance * gravity * time / closing_speed
    uncertainty = 0.5 * float(np.maximum(upper - lower, unresolved_rebound / closing_speed)) + relative_error * (
        1.0 + upper
    )
    return (0.5 * (lower + upper), uncertainty) if uncertainty < _MAX_UNCERTAINTY else None


def _restitution_after_rebound(
    motion: BodyMotion, departure: _WallContact, arrival: _WallContact, inelastic_speed: Array
) -> tuple[float, float] | None:
    """Estimate the restitution from rebound and next closing speed; `inelastic_speed`: both for zero restitution."""
    gravity = motion.rec.scene.gravity
    time, height_error, closing_speed = _flight(gravity, departure, arrival)
    # The rebound speed with which the flight ends exactly at the wall.
    rebound = -height_error / time
    closing_speed -= arrival.inward * rebound
    rebound_ratio = departure.inward * rebound / inelastic_speed[0]
    if closing_speed <= 0.0 or rebound_ratio >= 1.0:
        return None
    from_jump, from_rebound = inelastic_speed[1] / closing_speed - 1.0, rebound_ratio / (1.0 - rebound_ratio)
    difference = abs(from_jump - from_rebound)
    if difference > _MAX_UNCERTAINTY:
        return None
    relative_error = motion.tolerance * gravity * time / closing_speed * (1.0 + from_jump)
    return 0.5 * (from_jump + from_rebound), 0.5 * difference + relative_error


def may_reach_ceiling(motion: BodyMotion, damper: Damper) -> bool:
    """Return whether the only damper in a body may reach its ceiling between its floor impacts.

    After an instantaneous impact the damper is at rest on the floor while the body's acceleration exceeds -g. The
    damper is then in free fall, so its height above the floor follows from the motion of the body. For
    finite-duration contact the release is unknown; the flight is then computed backward from the closing speed of the
    next impact. The computed height is the largest within the sensor tolerance. The median of these heights over the
    segment is compared with the clearance of the scene.
    """
    if not np.isfinite(damper.clearance) or not np.any(motion.impacts.jump < 0.0):
        return False
    detected, rate, gravity = motion.impacts, motion.rec.rate, motion.rec.scene.gravity
    largest_factor = 1.0 / max(1.0 - motion.tolerance, 1e-300)
    impact_sample, count = detected.time * rate - motion.start, motion.samples.size
    is_evaluated = (
        (detected.jump < 0.0)
        & (impact_sample > _EXCLUDED_END_RATIO * count)
        & (impact_sample < (1.0 - _EXCLUDED_END_RATIO) * count)
    )
    impact_sample = impact_sample[is_evaluated]
    apparent_gravity = largest_factor * motion.acceleration + gravity
    displacement, velocity = largest_factor * motion.displacement, largest_factor * motion.velocity
    floor = _FloorMotion(displacement, velocity, apparent_gravity, rate, gravity)
    pulse, flights = landing_pulse(motion.rec.scene, motion.info.at, rate), pairwise(impact_sample)
    if pulse is None:
        heights = [floor.height_from_rest(int(start) + _BLURRED_SAMPLES, int(end)) for start, end in flights]
    else:
        inelastic_speeds = inelastic_closing_speeds(motion.rec.scene, detected, damper)[is_evaluated]
        closing_speeds = largest_factor * inelastic_speeds[1:] / (1.0 + pulse.restitution)
        heights = [
            floor.height_before(int(start), end, speed)
            for (start, end), speed in zip(flights, closing_speeds, strict=True)
        ]
    return bool(heights) and float(np.median(heights)) > (1.0 - _CEILING_DISTANCE_RATIO) * damper.clearance


@dataclass(frozen=True)
class _FloorMotion:
    """Motion of the floor of a cavity, sampled; arrays have the shape (samples,)."""

    position: Array  # m
    speed: Array  # m/s
    apparent_gravity: Array  # acceleration plus g [m/s²]
    rate: float  # samples per second
    gravity: float  # g [m/s²]

    def height_from_rest(self, sample: int, last: int) -> float:
        """Return the maximum height [m], until sample `last`, of a damper at rest at `sample` that does not rebound."""
        highest = 0.0
        while sample < last and (falling := np.flatnonzero(self.apparent_gravity[sample:last] < 0.0)).size:
            release, delay = sample + int(falling[0]), 0.0
            if release > sample:
                # The damper left its floor between two samples, at the interpolated zero of `apparent_gravity`.
                before, after = self.apparent_gravity[release - 1 : release + 1]
                delay = after / (after - before) / self.rate
            start = self.position[release] - self.speed[release] * delay - 0.5 * self.gravity * delay**2
            speed = self.speed[release] + self.gravity * delay
            time = delay + np.arange(1, last - release + 1) / self.rate
            height = start + speed * time - 0.5 * self.gravity * time**2 - self.position[release + 1 : last + 1]
            landed = np.flatnonzero(height < 0.0)
            end = int(landed[0]) if landed.size else height.size
            highest = max(highest, float(height[:end].max(initial=0.0)))
            sample = release + 1 + end
        return highest

    def height_before(self, first: int, end_sample: float, closing_speed: float) -> float:
        """Return the maximum height [m] of a flight after `first` that ends at `end_sample` with a closing speed."""
        # The backward computation starts at the last sample that the band-limited impact does not distort.
        last = int(end_sample) - _BLURRED_SAMPLES
        remaining_time = (end_sample - last) / self.rate
        height = remaining_time * closing_speed - 0.5 * self.apparent_gravity[last] * remaining_time**2
        closing_speed = closing_speed - self.apparent_gravity[last] * remaining_time
        time = np.arange(max(last - first, 0)) / self.rate
        damper_position = (
            self.position[last] + height - (self.speed[last] - closing_speed) * time - 0.5 * self.gravity * time**2
        )
        height_above_floor = damper_position - self.position[last - np.arange(time.size)]
        on_floor = np.flatnonzero(height_above_floor < 0.0)
        flight_samples = int(on_floor[0]) if on_floor.size else height_above_floor.size
        return float(height_above_floor[:flight_samples].max(initial=0.0))
