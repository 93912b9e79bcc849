"""Type of motion of dampers in a stepped sine, estimated from the channels: riding, types I to III, or others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.damper_motion.free_flight import (
    BodyMotion,
    Restitution,
    inelastic_closing_speeds,
    may_reach_ceiling,
    restitution,
)
from analysis.damper_motion.impact_detection import Impacts
from analysis.damper_motion.landing_pulse import transmissibility
from rig.results.response import MOTIONS

if TYPE_CHECKING:
    from analysis.responses.stepped_sine import Sweep
    from daq.recording.recording import Recording
    from rig.scene.damper import Damper

Array = NDArray[np.float64]

# Deviation from one impact a period: of some twenty, one or two are at the edge of a window or too close to another.
_ONCE = 0.15
# Impacts that recur only after more periods than this form no pattern.
_LONGEST_PATTERN = 4
# A restitution of fewer standard deviations may be zero.
_RESTITUTION_SIGMAS = 3.0
# Samples searched of a window, unless that is less than so many periods: the search holds all of them.
_MAX_SAMPLES = 1 << 20
_MIN_PERIODS = 20


@dataclass(frozen=True)
class DamperMotion:
    """A damper's motion at one frequency, estimated from its impacts."""

    frequency: float  # Hz
    channel: str
    """Channel on the damper's body."""
    floor: float
    ceiling: float
    """Impacts a period."""
    stays: bool | None
    """Whether the damper stays at the ceiling after an impact there: it does so while the body's acceleration is below
    -g. None if undetermined: the acceleration is -g within half a sample interval, a rebound may take too long, or
    contact has a duration and the ceiling may push longer."""
    threshold: float
    """Detection limit: smallest velocity jump that is not missed, m/s."""
    rides: bool
    """Whether the body's acceleration stays above -g, allowing for the channel's errors, so that no damper lifts."""
    restitution: Restitution | None = None
    """Of the body's only damper, if its impacts determine it."""
    repeats: int = 1
    """Periods after which all impacts recur, to within the channel's resolution; 0: after none of a few."""
    may_reach: bool = False
    """Whether its flights may take the damper to the ceiling, with impacts there too weak to be detected."""

    @property
    def name(self) -> str:
        """Type of motion, in the paper's terms where they apply."""
        if self.floor == 0 and self.ceiling == 0:
            return "riding" if self.rides else "unseen"
        if not self.repeats:
            return "unsure: impacts are missed, or the motion is irregular"
        once = abs(self.floor - 1.0) < _ONCE and (self.ceiling == 0 or abs(self.ceiling - 1.0) < _ONCE)
        why = ""
        if once and self.repeats == 1:
            if self.ceiling == 0 and not self.may_reach:
                return "I"
            if self.ceiling and self.stays is not None:
                return "III" if self.stays else "II"
            why = ", staying or not" if self.ceiling else ", and perhaps weak ones on the ceiling"
        floor, ceiling = (round(count * self.repeats) / self.repeats for count in (self.floor, self.ceiling))
        return f"other: {floor:.3g} floor and {ceiling:.3g} ceiling impacts a period{why}"


def damper_motion(
    rec: Recording, sweep: Sweep, channel: str, progress: Callable[[int, int], None] | None = None
) -> list[DamperMotion]:
    """Estimate the motion of the dampers under a channel in every measured window.

    Several dampers in a body are counted as one. A type is named where impacts occur a period apart, and impacts are
    counted where they recur after a few periods: otherwise some are missed, or the motion is irregular. Riding is named
    where the body's least acceleration proves it, because flights may be too short to detect; type I where its flights
    stay below the ceiling. Of a long window the first million samples are searched, or as many periods as determine a
    pattern.

    Parameters
    ----------
    progress : callable, optional
        Called with (windows searched, in all).
    """
    place = rec.channels[channel].at
    numbers = [
        number
        for number, damper in enumerate(rec.scene.dampers, 1)
        if not damper.locked and f"body {damper.body}" == place
    ]
    out: list[DamperMotion] = []
    sizes = _acceleration_amplitude(rec, sweep, channel)
    for frequency, size, (first, stop) in zip(
        sweep.lines.frequency.tolist(), sizes.tolist(), sweep.windows.tolist(), strict=True
    ):
        most = max(_MAX_SAMPLES, int(_MIN_PERIODS * rec.rate / frequency))
        motion = BodyMotion(rec, channel, first, min(stop, first + most, rec.samples))
        out.append(_motion_in_window(motion, numbers, frequency, size))
        if progress is not None:
            progress(len(out), sweep.lines.frequency.size)
    return out


def _motion_in_window(motion: BodyMotion, numbers: list[int], frequency: float, size: float) -> DamperMotion:
    """Motion of dampers (counted from 1) at a frequency, Hz, under an amplitude of acceleration, m/s²."""
    found, rate, gravity = motion.impacts, motion.rec.rate, motion.rec.scene.gravity
    inside = [motion.rec.scene.dampers[number - 1] for number in numbers]
    # The search leaves out the ends of its stretch.
    periods = found.searched * frequency
    ceiling = found.kind == "ceiling"
    begin, end = (at / rate for at in (motion.start, motion.start + motion.samples.size))
    repeats = _repeats(found, frequency, begin, end) if found.time.size else 1
    # Between impacts that are missed there is no free flight.
    estimate = restitution(motion, inside[0]) if len(inside) == 1 and repeats else None
    stays = None
    if ceiling.any():
        stays = _stays(
            found.acceleration[ceiling] + gravity,
            np.pi * frequency * (1.0 / rate + 2.0 * found.contact_duration) * size,
            _fastest_rebound(motion, inside, estimate),
            _push_time(found.acceleration[ceiling], size, gravity, frequency),
        )
    return DamperMotion(
        frequency,
        found.channel,
        float(np.sum(~ceiling)) / periods,
        float(np.sum(ceiling)) / periods,
        stays,
        found.threshold,
        _least_acceleration(motion, numbers, frequency) > -gravity,
        estimate,
        repeats,
        not ceiling.any() and any(may_reach_ceiling(motion, each) for each in inside),
    )


def _repeats(found: Impacts, frequency: float, begin: float, end: float) -> int:
    """Least number of periods after which all impacts on each wall recur in a stretch, s; 0 if there is none."""
    walls = [found.time[found.kind == wall] for wall in ("floor", "ceiling")]
    begin, end = begin + found.ringing, end - found.ringing
    if any(wall.size and not np.any((wall > begin) & (wall < end)) for wall in walls):
        return 0
    for periods in range(1, _LONGEST_PATTERN + 1):
        shift = periods / frequency
        if all(
            _all_near(later[(later > begin) & (later < end)], wall, found)
            for wall in walls
            for later in (wall + shift, wall - shift)
        ):
            return periods
    return 0


def _all_near(time: Array, others: Array, found: Impacts) -> bool:
    """Whether there is another within the channel's resolution of each time at which impacts can be detected."""
    near, stretches = found.resolution, found.left_out
    unsearched = ((time[:, None] > stretches[:, 0] - near) & (time[:, None] < stretches[:, 1] + near)).any(
        axis=1
    )
    apart = abs(time[~unsearched, None] - others).min(axis=1, initial=np.inf)
    return bool(np.all(apart < near))


def _stays(weight: Array, change: float, rebound: float, push: float) -> bool | None:
    """Whether a damper stays at the ceiling, by its body's acceleration above -g at the impact, known to `change`.

    After a rebound, at `rebound` m/s or less, it stays only if it returns within the time for which the ceiling pushes
    it, s: under an acceleration that falls from a to zero in a time t, a rebound slower than a t / 3 does.
    """
    known = weight[np.isfinite(weight)]
    middle = float(np.median(known)) if known.size else 0.0
    if abs(middle) <= change:
        return None
    if middle > 0.0:
        return False
    return True if rebound <= -middle * push / 3.0 else None


def _fastest_rebound(motion: BodyMotion, inside: list[Damper], estimate: Restitution | None) -> float:
    """Largest speed at which a damper may leave the ceiling after an impact, all its bounces together, m/s.

    By the restitution of its flights; if they determine none, or may be zero, by the scene's. Where contact has a
    duration, its release is not known.
    """
    found = motion.impacts
    if found.contact_duration:
        return np.inf
    share = max((damper.restitution for damper in inside), default=0.0)
    if estimate is not None and (share > 0.0 or estimate.value > _RESTITUTION_SIGMAS * estimate.error):
        share = min(estimate.value + 2.0 * estimate.error, 1.0)
    if share <= 0.0:
        return 0.0
    at_ceiling = replace(found, jump=found.jump[found.kind == "ceiling"])
    speeds = [inelastic_closing_speeds(motion.rec.scene, at_ceiling, damper) for damper in inside]
    # All bounces take as long as one of the sum of their speeds: a geometric series.
    return float(np.max(speeds, initial=0.0) * share / (1.0 + share) / max(1.0 - share, 1e-9))


def _push_time(acceleration: Array, size: float, gravity: float, frequency: float) -> float:
    """Least time for which the ceiling pushes, s: of a tone of acceleration that rises at the impact."""
    known = acceleration[np.isfinite(acceleration)]
    at_impact = float(np.median(known)) if known.size else 0.0
    ends = np.arcsin(np.clip([at_impact / size, -gravity / size], -1.0, 1.0))
    return max(float(ends[1] - ends[0]), 0.0) / (2 * np.pi * frequency)


def _acceleration_amplitude(rec: Recording, sweep: Sweep, channel: str) -> Array:
    """Amplitude of the acceleration under a channel at the frequencies of a sweep, shape (n,)."""
    info, frequency = rec.channels[channel], sweep.lines.frequency
    read = np.abs(sweep.lines.mean[sweep.lines.channels.index(channel)] / info.response(frequency))
    return np.asarray(read * (2 * np.pi * frequency) ** (2 - MOTIONS.index(info.quantity)), dtype=np.float64)


def _least_acceleration(motion: BodyMotion, numbers: list[int], frequency: float) -> float:
    """Lower bound of the acceleration of the dampers at rest in a body, m/s²: noise and tolerance count as motion."""
    scene, rows = motion.rec.scene, [motion.acceleration]
    size = rows[0].size
    for number in numbers:
        if scene.dampers[number - 1].contact is not None:
            share = transmissibility(scene, number, np.asarray(np.fft.rfftfreq(size, 1.0 / motion.rec.rate)))
            rows.append(np.fft.irfft(np.fft.rfft(rows[0]) * share, size))
    # The correction continues a stretch at its ends as a mirror image.
    edge = min(int(np.ceil(motion.rec.rate / frequency)), size // 4)
    return float(min(row[edge:-edge].min() for row in rows) / max(1.0 - motion.tolerance, 1e-300))
