"""Restitution of a damper, from the jumps of its body's velocity and its free flights between them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from analysis.damper_motion.impact_detection import Impacts, band
from analysis.damper_motion.jump_search import LEFT_OVER
from analysis.decays.sensor_correction import corrected
from analysis.responses.systematic import tolerance

if TYPE_CHECKING:
    from daq.recording.recording import Recording
    from rig.scene.damper import Damper

Array = NDArray[np.float64]

# Ends of the stretch that are left out: there its motion is taken to go on as its mirror image.
_ENDS = 0.05
# Fewer flights say nothing, and neither do those of fewer than this part of the impacts.
_FEWEST, _LEAST_PART = 6, 0.25
# A flight explains the data if it ends so near to the wall, in its own height; and determines the restitution if
# its uncertainty is below this.
_MISSED, _AGREE = 0.05, 0.1
# Standard deviation of a normal error over its median deviation, times that of a median over that of a mean.
_OF_MEDIAN = 1.4826 * 1.2533


@dataclass(frozen=True)
class Restitution:
    """Closing speed after an impact over the one before, and its standard deviation."""

    value: float
    error: float


class _Touch(NamedTuple):
    """A damper leaves or meets a wall: when, and how far above the floor that wall is, where, and how fast; SI."""

    time: float
    wall: float
    place: float
    speed: float

    @property
    def away(self) -> float:
        """Direction from the wall into the cavity."""
        return 1.0 if self.wall == 0.0 else -1.0


def restitution(rec: Recording, found: Impacts, damper: Damper, start: int, stop: int) -> Restitution | None:
    """Estimate the restitution of the only damper on a body from the impacts in a stretch of its channel.

    Between two impacts the damper falls freely, in a cavity whose motion is measured. That it leaves one wall and meets
    the other at those times gives both speeds: its closing speed w, whether it lay at rest and left as its
    body fell away (then it must meet the wall when it does), or rebounded. The jump of its body's velocity is
    ``(1 + e) w m / (m + M)`` with the masses of both. Masses and clearance are the scene's.

    A rebound that ends before it is resolved from its impact makes of ``1 + e`` at most ``(1 + e) / (1 - e)``: the
    value is the middle between, and the error holds both, and every rebound that may hide in what the channel resolves.

    None where too few flights explain what is seen, or only by what no wall does; and where a landing lasts: when it
    ends is not seen, and how it goes on is part of what it is found by.
    """
    if found.lasts:
        return None
    info = rec.channels[found.channel]
    samples = rec.read(found.channel, start, stop)
    hard = hard_speeds(rec, found, damper)
    if not np.isfinite([*samples, *hard]).all() or found.time.size < _FEWEST:
        return None
    way, speed = (corrected(info, samples, what, *band(rec.rate)) for what in ("displacement", "velocity"))
    cavity = _Cavity(way, speed, rec.rate, rec.scene.gravity, tolerance(info))
    # Rebounds that end within the channel's resolution.
    weight = -np.sign(found.jump) * (found.acceleration + rec.scene.gravity)
    hidden = 0.5 * found.resolution * np.maximum(weight, 0.0)
    wall = np.where(found.jump < 0.0, 0.0, damper.clearance)
    time, length = found.time - start / rec.rate, samples.size / rec.rate
    inside = np.flatnonzero((time[:-1] > _ENDS * length) & (time[1:] < (1.0 - _ENDS) * length))
    estimates = []
    for k in inside[np.isfinite(wall[inside]) & np.isfinite(wall[inside + 1])]:
        left = cavity.touch(time[k], wall[k], 0.5 * found.jump[k])
        met = cavity.touch(time[k + 1], wall[k + 1], -0.5 * found.jump[k + 1])
        estimates.append(
            cavity.after_rest(left, met, hard[k + 1], hidden[k + 1])
            or cavity.after_rebound(left, met, hard[k : k + 2])
        )
    known = np.array([one for one in estimates if one is not None]).reshape(-1, 2)
    if len(known) < max(_FEWEST, _LEAST_PART * inside.size):
        return None
    value, doubt = np.median(known, axis=0)
    scatter = _OF_MEDIAN * float(np.median(abs(known[:, 0] - value))) / np.sqrt(len(known))
    # No jump is known better than to what fitting it leaves over: that is a bound, of two standard deviations.
    size = 0.5 * LEFT_OVER * (1.0 + value)
    error = float(np.sqrt(scatter**2 + doubt**2 + size**2))
    # Outside these no wall gives speed back: what was taken for its blows are none.
    return Restitution(float(value), error) if -2.0 * error <= value <= 1.0 + 2.0 * error else None


def hard_speeds(rec: Recording, found: Impacts, damper: Damper) -> Array:
    """Give closing speeds of the only damper on a body if nothing rebounded, m/s; not finite where it has no mass."""
    from rig.system.structural_model import structural_model

    model, place = structural_model(rec.scene), damper.body - 1
    bed = model.bed_mass[rec.scene.dampers.index(damper)]
    with np.errstate(divide="ignore"):
        return np.asarray(abs(found.jump) * (1.0 + 1.0 / (model.mobility[place, place] * bed)))


@dataclass(frozen=True)
class _Cavity:
    """Motion of a body between impacts, at a rate, and how far its sensor may be off."""

    place: Array
    speed: Array
    rate: float
    gravity: float
    tolerance: float

    def touch(self, time: float, wall: float, later: float) -> _Touch:
        """Return the wall's motion at an impact: a band-limited signal passes the middle of the velocity jump."""
        whole = min(int(time * self.rate), self.place.size - 2)
        part = time * self.rate - whole
        place, speed = (
            float(row[whole] + part * (row[whole + 1] - row[whole])) for row in (self.place, self.speed)
        )
        return _Touch(time, wall, place + wall, speed + later)

    def flight(self, left: _Touch, met: _Touch) -> tuple[float, float, float]:
        """Duration of a flight that begins as fast as its wall, how far above the other wall it ends, closing speed."""
        time = met.time - left.time
        above = left.place + left.speed * time - 0.5 * self.gravity * time**2 - met.place
        return time, above, -met.away * (left.speed - self.gravity * time - met.speed)

    def after_rest(self, left: _Touch, met: _Touch, hard: float, hidden: float) -> tuple[float, float] | None:
        """Restitution and doubt from a flight that began where the body fell away from a damper at rest on its wall."""
        inside = np.arange(int(left.time * self.rate) + 2, int(met.time * self.rate) - 1)
        if inside.size < 3:
            return None
        weight = left.away * (np.gradient(self.speed[inside]) * self.rate + self.gravity)
        best, off = None, _MISSED
        for begin in inside[:-1][(weight[:-1] > 0.0) & (weight[1:] <= 0.0)]:
            time, above, closing = self.flight(self.touch(begin / self.rate, left.wall, 0.0), met)
            missed = abs(above) / max(closing * time / 4.0, 1e-300)
            if missed < off:
                best, off = (closing, time), missed
        if best is None:
            return None
        closing, time = best
        most = hard / closing - 1.0
        least = most / (2.0 + most) if most > 0.0 else most
        # A landing later by d misses by w d, and closes faster by twice its share in the flight.
        off = 0.5 * off + self.tolerance * self.gravity * time / closing
        doubt = 0.5 * float(np.maximum(most - least, hidden / closing)) + off * (1.0 + most)
        return (0.5 * (least + most), doubt) if doubt < _AGREE else None

    def after_rebound(self, left: _Touch, met: _Touch, hard: Array) -> tuple[float, float] | None:
        """Restitution and doubt from a flight that began with an impact: its rebound, and the next closing speed."""
        time, above, closing = self.flight(left, met)
        rebound = -above / time
        closing, share = closing - met.away * rebound, left.away * rebound / hard[0]
        if closing <= 0.0 or share >= 1.0:
            return None
        from_jump, from_rebound = hard[1] / closing - 1.0, share / (1.0 - share)
        apart = abs(from_jump - from_rebound)
        if apart > _AGREE:
            return None
        off = self.tolerance * self.gravity * time / closing * (1.0 + from_jump)
        return 0.5 * (from_jump + from_rebound), 0.5 * apart + off
