"""Signs of nonlinearity in a stepped sine: jumps, harmonics, and what the dampers do, all from the channels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.damper_motion.ceiling_reach import may_reach_ceiling
from analysis.damper_motion.impact_detection import Impacts, band, impacts
from analysis.damper_motion.landing_pulse import carried
from analysis.damper_motion.restitution import Restitution, hard_speeds, restitution
from analysis.decays.sensor_correction import corrected
from analysis.responses.frf import MOTIONS
from analysis.responses.systematic import tolerance
from rig.results import frequency_ranges

if TYPE_CHECKING:
    from analysis.responses.stepped_sine import Sweep
    from daq.recording.recording import Recording
    from rig.scene.damper import Damper

# So far from one a period impacts may be: of some twenty one or two fall on the edge of a window, or lie too
# near to another.
_ONCE = 0.15
# Blows that come again only after more periods than this make no pattern.
_LONGEST_PATTERN = 4
# A restitution of so many standard deviations is one.
_SURE = 3.0


# Of a window, so many samples are searched at most, unless that is less than so many periods.
_MOST, _PERIODS = 1 << 20, 20


# Kinds of motion as they are printed.
_AT_REST, _NEAR_GRAVITY = "at rest on the floor", "near 1 g"
_IRREGULAR = "irregular motion, or missed impacts,"
_NAMED_KINDS = ("type I", "type II", "type III", _AT_REST, _NEAR_GRAVITY, _IRREGULAR)
_OTHER_KINDS = "other periodic motions"
# With more kinds than this, counts of impacts that are no type share one entry.
_MAX_KINDS = 6


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
    """Whether the damper stays at the ceiling after it struck: it does so while the body's acceleration is below -g.
    None if undetermined: it is at -g within half a sample interval, a rebound may last too long for that, or a
    landing lasts and the ceiling may push on."""
    threshold: float
    """Smallest velocity jump that would have been seen for certain, m/s."""
    rides: bool
    """Whether the body's acceleration stays above -g by all that the channel may be off, so that no damper lifts."""
    restitution: Restitution | None = None
    """Of the body's only damper, if its impacts determine it."""
    repeats: int = 1
    """Periods after which all blows come again, to within the channel's resolution; 0: after none of a few."""
    may_reach: bool = False
    """Whether its flights may take the damper to the ceiling, struck too weakly to be seen."""

    @property
    def name(self) -> str:
        """Kind of motion, in the paper's terms where they apply."""
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
    """Estimate the motion of the damper under a channel in every measured window.

    A body may hold several dampers: their impacts are then counted together. `progress` is called with (windows
    searched, in all).

    A type is named where blows come a period apart, and impacts are counted where they come again after a few periods:
    else some are missed, or the motion is irregular. Riding is named where the body's least acceleration proves it:
    flights too short to see would else pass for it; type I where its flights stay below the ceiling. Of a long window
    the first million samples are searched, or as many periods as determine a pattern: the search holds all of them.
    """
    gravity = rec.scene.gravity
    place = rec.channels[channel].at
    numbers = [
        number
        for number, damper in enumerate(rec.scene.dampers, 1)
        if not damper.locked and f"body {damper.body}" == place
    ]
    inside = [rec.scene.dampers[number - 1] for number in numbers]
    out = []
    sizes = _acceleration(rec, sweep, channel)
    for frequency, size, (first, stop) in zip(sweep.lines.frequency, sizes, sweep.windows, strict=True):
        most = max(_MOST, int(_PERIODS * rec.rate / frequency))
        stop = min(int(stop), int(first) + most, rec.samples)
        found = impacts(rec, channel, int(first), int(stop))
        # The search leaves out the ends of its stretch.
        inner = found.searched * float(frequency)
        struck = found.kind == "ceiling"
        window = int(first), int(stop)
        repeats = _repeats(found, float(frequency), window[0] / rec.rate, window[1] / rec.rate)
        # Between impacts that are missed nothing flies freely.
        estimate = restitution(rec, found, inside[0], *window) if len(inside) == 1 and repeats else None
        out.append(
            DamperMotion(
                float(frequency),
                found.channel,
                float(np.sum(found.kind == "floor")) / inner,
                float(np.sum(struck)) / inner,
                _stays(
                    found.acceleration[struck] + gravity,
                    np.pi * frequency * (1.0 / rec.rate + 2.0 * found.lasts) * size,
                    _longest_rebound(rec, found, inside, estimate),
                    _pushed(found.acceleration[struck], size, gravity, frequency),
                ),
                found.threshold,
                _least_acceleration(rec, channel, numbers, frequency, *window) > -gravity,
                estimate,
                repeats,
                not struck.any() and any(may_reach_ceiling(rec, found, each, *window) for each in inside),
            )
        )
        if progress is not None:
            progress(len(out), sweep.lines.frequency.size)
    return out


def _repeats(found: Impacts, frequency: float, begin: float, end: float) -> int:
    """Least number of periods after which all blows on each wall come again in a stretch, s; 0 if there is none."""
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


def _all_near(time: NDArray[np.float64], others: NDArray[np.float64], found: Impacts) -> bool:
    """Whether there is another within the channel's resolution of each time at which impacts can be detected."""
    near, stretches = found.resolution, found.left_out
    unsearched = ((time[:, None] > stretches[:, 0] - near) & (time[:, None] < stretches[:, 1] + near)).any(
        axis=1
    )
    apart = abs(time[~unsearched, None] - others).min(axis=1, initial=np.inf)
    return bool(np.all(apart < near))


def _stays(weight: NDArray[np.float64], change: float, rebound: float, pushed: float) -> bool | None:
    """Whether a damper stays at the ceiling, by its body's acceleration above -g as it strikes, known to `change`.

    One that rebounds, at `rebound` m/s or less, stays only if it surely comes back within the time for which the
    ceiling pushes it, s: under an acceleration that falls from a to zero in a time t, one slower than a t / 3 does.
    """
    known = weight[np.isfinite(weight)]
    middle = float(np.median(known)) if known.size else 0.0
    if abs(middle) <= change:
        return None
    if middle > 0.0:
        return False
    return True if rebound <= -middle * pushed / 3.0 else None


def _longest_rebound(
    rec: Recording, found: Impacts, inside: list[Damper], estimate: Restitution | None
) -> float:
    """Give the largest speed at which a damper may leave the ceiling after it struck it, all its bounces together, m/s.

    By what its flights determine; if they determine nothing, or not even that it exceeds zero, by the scene. Where a
    landing lasts, it is not known when it leaves.
    """
    if found.lasts:
        return np.inf
    struck = replace(found, jump=found.jump[found.kind == "ceiling"])
    share = max((damper.restitution for damper in inside), default=0.0)
    if estimate is not None and (share > 0.0 or estimate.value > _SURE * estimate.error):
        share = min(estimate.value + 2.0 * estimate.error, 1.0)
    hard = np.concatenate([np.zeros(1), *(hard_speeds(rec, struck, damper) for damper in inside)])
    # Bounces last as long as one whose speed is their sum: a geometric series.
    return float(hard.max() * share / (1.0 + share) / max(1.0 - share, 1e-9)) if share > 0.0 else 0.0


def _pushed(acceleration: NDArray[np.float64], size: float, gravity: float, frequency: float) -> float:
    """Give the least time for which the ceiling pushes, s: of a tone of acceleration that rises as it strikes."""
    known = acceleration[np.isfinite(acceleration)]
    struck = float(np.median(known)) if known.size else 0.0
    ends = np.arcsin(np.clip([struck / size, -gravity / size], -1.0, 1.0))
    return max(float(ends[1] - ends[0]), 0.0) / (2 * np.pi * frequency)


def _acceleration(rec: Recording, sweep: Sweep, channel: str) -> NDArray[np.float64]:
    """Amplitude of the acceleration under a channel at the frequencies of a sweep, shape (n,)."""
    info, frequency = rec.channels[channel], sweep.lines.frequency
    read = np.abs(sweep.lines.mean[sweep.lines.channels.index(channel)] / info.response(frequency))
    return np.asarray(read * (2 * np.pi * frequency) ** (2 - MOTIONS.index(info.quantity)), dtype=np.float64)


def _least_acceleration(
    rec: Recording, channel: str, inside: list[int], frequency: float, first: int, stop: int
) -> float:
    """Least acceleration of what rides in a body that its channel allows, m/s²: noise and tolerance count as motion."""
    info, period = rec.channels[channel], int(np.ceil(rec.rate / frequency))
    samples = rec.read(channel, first, stop)
    read = corrected(info, samples, "acceleration", *band(rec.rate))
    # At its ends a stretch is taken to go on as its mirror image.
    edge = min(period, samples.size // 4)
    rows, spectrum = [read], np.fft.rfft(read)
    for number in inside:
        beds = carried(rec.scene, number, np.asarray(np.fft.rfftfreq(read.size, 1.0 / rec.rate)))
        rows.append(np.fft.irfft(spectrum * beds, read.size))
    return float(min(row[edge:-edge].min() for row in rows) / max(1.0 - tolerance(info), 1e-300))


def describe_restitution(motions: list[DamperMotion]) -> list[str]:
    """One line about the restitution that a body's impacts determine, if any do: weighted by its errors."""
    estimates = [one.restitution for one in motions if one.restitution is not None]
    if not estimates:
        return []
    value, weight = (
        np.array([one.value for one in estimates]),
        np.array([one.error**-2.0 for one in estimates]),
    )
    mean = float(np.sum(weight * value) / weight.sum())
    # What a sensor or the fit of jumps puts off, it does so at all frequencies; and no better than their scatter says.
    scatter = float(np.sqrt(np.sum(weight * (value - mean) ** 2) / weight.sum() / max(len(estimates) - 1, 1)))
    error = max(float(weight.mean() ** -0.5), scatter)
    return [
        f"{motions[0].channel}: restitution {mean:z.2f} ± {2.0 * error:.1g}, determined at {len(estimates)} frequencies"
    ]


def describe_motion(motions: list[DamperMotion], left_out: Sequence[float] = ()) -> list[str]:
    """Describe the motion of a body's dampers in one line: each kind with its frequencies, and the detection limit.

    Parameters
    ----------
    motions : list of DamperMotion
        Of one channel.
    left_out : sequence of float
        Hz: frequencies without a result, at which a range ends.

    Examples
    --------
    >>> hit = DamperMotion(30.0, "body2", 1.0, 0.0, False, 1.6e-3, False)
    >>> at_rest = DamperMotion(31.0, "body2", 0.0, 0.0, False, 1.6e-3, True)
    >>> describe_motion([hit, at_rest])
    ['body2: type I at 30 Hz; no impact detected elsewhere (limit 1.6 mm/s)']
    """
    every = [(one.frequency, _kind(one)) for one in motions] + [(f, "") for f in left_out]
    frequency = [f for f, _ in every]
    kinds = dict.fromkeys(kind for _, kind in every if kind)
    if len(kinds) > _MAX_KINDS:
        every = [(f, kind if kind in _NAMED_KINDS or not kind else _OTHER_KINDS) for f, kind in every]
        kinds = dict.fromkeys(kind for _, kind in every if kind)
    parts = [
        f"{kind} at {frequency_ranges(frequency, [kind == other for _, other in every])}"
        for kind in kinds
        if kind not in (_AT_REST, _NEAR_GRAVITY)
    ]
    limit = f"limit {1e3 * max(one.threshold for one in motions):.2g} mm/s"
    if _AT_REST in kinds or _NEAR_GRAVITY in kinds:
        parts.append(f"no impact detected{' elsewhere' if parts else ''} ({limit})")
    else:
        parts[-1] += f" ({limit})"
    if _NEAR_GRAVITY in kinds:
        near = [kind == _NEAR_GRAVITY for _, kind in every]
        parts.append(f"near 1 g, where the damper may fly, at {frequency_ranges(frequency, near)}")
    return [f"{motions[0].channel}: {'; '.join(parts)}"]


def _kind(one: DamperMotion) -> str:
    """Name the kind of motion for people."""
    kind, _, counts = one.name.partition(": ")
    if kind == "riding":
        return _AT_REST
    if kind == "unseen":
        return _NEAR_GRAVITY
    if kind == "unsure":
        return _IRREGULAR
    return counts if kind == "other" else f"type {kind}"
