"""Type of damper motion in a stepped-sine test, estimated from the channels.

A damper moves in a cavity of its body, between floor and ceiling. The types are those of Inoue, Yokomichi and Hiraki
(2011). Riding: the bed is at rest on the floor. Type I: one floor impact per period. Types II and III: one impact on
each of floor and ceiling per period; the damper leaves the ceiling immediately (II), or stays there until the
acceleration of the body rises to -g (III). Other motions are described by their numbers of impacts per period.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from analysis.core.damper_motion.free_flight import (
    BodyMotion,
    Restitution,
    inelastic_closing_speeds,
    may_reach_ceiling,
    restitution,
)
from analysis.core.damper_motion.impact_detection import Impacts
from analysis.core.damper_motion.landing_pulse import transmissibility
from analysis.core.responses.stepped_sine import Sweep
from daq.core.recording.recording import Recording
from rig.core.base.arrays import Array
from rig.core.base.progress import CountProgress
from rig.core.base.renamed import renamed
from rig.core.results import format_frequencies
from rig.core.results.response import MOTIONS
from rig.core.results.table import Table
from rig.core.results.uncertainty import expand
from rig.core.scene.damper import Damper

# Allowed deviation from one impact per period: of about twenty impacts, one or two may be missed, because they are at
# an end of the window or too close to another impact.
_COUNT_TOLERANCE = 0.15
# Maximum number of periods of a cycle; by chance, longer cycles seem to repeat in any motion.
_MAX_CYCLE_PERIODS = 4
# A restitution differs significantly from zero above this number of standard uncertainties; a true value of zero does
# so by chance with a probability of 0.1 %.
_RESTITUTION_SIGMAS = 3.0
# Maximum number of samples of a window that are searched, to limit the memory.
_MAX_SEARCHED_SAMPLES = 1 << 20
# Number of periods that are searched even if they contain more samples: five repetitions of the longest cycle.
_MIN_SEARCHED_PERIODS = 20

#: Printed descriptions of motions by name (`DamperMotion.name`), in tables and legends.
MOTION_TEXTS = {
    "riding": "at rest on the floor",
    "unseen": "near 1 g: may fly, with impacts below the detection limit",
    "uncertain": "irregular, or impacts missed",
}
_AT_REST, _NEAR_GRAVITY = MOTION_TEXTS["riding"], MOTION_TEXTS["unseen"]
# One impact per period: Type I on the floor; II on floor and ceiling; III as II, with a stay at the ceiling.
_TYPES = ("Type I", "Type II", "Type III")
_OTHER = "other cycles of impacts, or irregular"
# Maximum number of rows of a body's moving dampers; further irregular motions and other cycles share a row.
_MAX_KINDS = 3


@dataclass(frozen=True)
class DamperMotion:
    """A damper's motion at one frequency, estimated from its impacts."""

    frequency: float  # Hz
    channel: str
    """Channel on the damper's body."""
    floor: float
    """Number of impacts that were detected on the floor, over the number of searched periods."""
    ceiling: float
    """Number of impacts that were detected on the ceiling, over the number of searched periods."""
    stays_at_ceiling: bool | None
    """Whether the damper stays at the ceiling after an impact there, which it does while the body's acceleration is
    below -g. None if undetermined: the acceleration crosses -g within half a sample interval of the impact, the
    rebound may take too long, or finite-duration contact may extend the push of the ceiling."""
    detection_limit: float
    """Smallest velocity jump that is reliably detected [m/s]."""
    stays_on_floor: bool
    """Whether the body's acceleration stays above -g by more than its uncertainty, so all dampers stay at rest on
    the floor.
    """
    restitution: Restitution | None = None
    """Coefficient of restitution, if the body has a single damper and its impacts determine it."""
    cycle_periods: int = 1
    """Number of periods in a cycle of impacts, which repeats within the time resolution of the channel; 0: none."""
    may_reach_ceiling_unseen: bool = False
    """Whether the damper may reach the ceiling with impacts that are too weak to be detected."""

    pattern_periods = renamed("pattern_periods", "cycle_periods")
    threshold = renamed("threshold", "detection_limit")

    @property
    def impacts_per_period(self) -> tuple[float, float]:
        """Numbers of impacts on floor and ceiling per period; NaN if impacts may have been missed.

        The ends of the search may add or omit an impact; a cycle has a whole number of impacts.
        """
        periods = self.cycle_periods
        if not periods:
            return np.nan, np.nan
        return round(self.floor * periods) / periods, round(self.ceiling * periods) / periods

    @property
    def name(self) -> str:
        """Type of motion, in the terms of Inoue, Yokomichi, Hiraki (2011) if they apply."""
        if self.floor == 0 and self.ceiling == 0:
            return "riding" if self.stays_on_floor else "unseen"
        if not self.cycle_periods:
            return f"uncertain: {MOTION_TEXTS['uncertain']}"
        once_per_period = abs(self.floor - 1.0) < _COUNT_TOLERANCE and (
            self.ceiling == 0 or abs(self.ceiling - 1.0) < _COUNT_TOLERANCE
        )
        possible_types = ""
        if once_per_period and self.cycle_periods == 1:
            if self.ceiling == 0 and not self.may_reach_ceiling_unseen:
                return "I"
            if self.ceiling and self.stays_at_ceiling is not None:
                return "III" if self.stays_at_ceiling else "II"
            possible_types = ", Type II or III" if self.ceiling else ", Type I or weak impacts on the ceiling"
        floor, ceiling = self.impacts_per_period
        return f"other: {floor:.3g} floor and {ceiling:.3g} ceiling impacts per period{possible_types}"


def motion_table(bodies: Sequence[list[DamperMotion]], omitted: Sequence[float] = ()) -> Table:
    """Return the motions in each body with their frequencies; `omitted`: frequencies without a result [Hz]."""
    rows = [row for motions in bodies for row in _motion_rows(motions, omitted)]
    return Table(("channel", "motion", "frequency"), "<<<", rows)


def _motion_rows(motions: list[DamperMotion], omitted: Sequence[float]) -> list[tuple[str, str, str]]:
    """Return the rows of one body: each type of motion with its frequencies; resting dampers come last."""
    kind_at_frequency = [(motion.frequency, _kind(motion)) for motion in motions] + [(f, "") for f in omitted]
    kinds = dict.fromkeys(kind for _, kind in kind_at_frequency if kind)
    if len(kinds) - (_AT_REST in kinds) > _MAX_KINDS:
        separate_kinds = (*_TYPES, _AT_REST, _NEAR_GRAVITY, "")
        kind_at_frequency = [(f, kind if kind in separate_kinds else _OTHER) for f, kind in kind_at_frequency]
        kinds = dict.fromkeys(kind for _, kind in kind_at_frequency if kind)
    frequency = [f for f, _ in kind_at_frequency]
    order = sorted(kinds, key=lambda kind: (kind == _AT_REST, kind == _NEAR_GRAVITY))
    rows = []
    for kind in order:
        printed_frequencies = format_frequencies(frequency, [kind == other for _, other in kind_at_frequency])
        # The previous rows list all other frequencies.
        rows.append(("", kind, "elsewhere" if kind == _AT_REST and len(order) > 1 else printed_frequencies))
    return [(motions[0].channel, *rows[0][1:]), *rows[1:]]


def _kind(motion: DamperMotion) -> str:
    """Return the printed description of a motion."""
    kind, _, counts = motion.name.partition(": ")
    return counts if kind == "other" else MOTION_TEXTS.get(kind, f"Type {kind}")


def damper_motion(
    rec: Recording, sweep: Sweep, channel: str, progress: CountProgress | None = None
) -> list[DamperMotion]:
    """Estimate the motion of the dampers in the body of a channel in every measurement window.

    Several dampers in a body are treated as one. A type is assigned if the impacts repeat every period. Impacts are
    counted if they repeat after a few periods; otherwise some were missed, or the motion is irregular. Riding
    requires that the body's acceleration stays above -g, because short flights may be undetectable. Type I requires
    flights that stay below the ceiling. In a long window only the first million samples are searched, but at least
    enough periods to determine a cycle.

    `rec`: recording of a stepped-sine test; `sweep`: result of `analysis.core.responses.stepped_sine.sweeps`;
    `channel`: channel on the body of the dampers. Returns the motion in each window.
    """
    location = rec.channels[channel].at
    numbers = [
        number
        for number, damper in enumerate(rec.scene.dampers, 1)
        if not damper.locked and damper.falls_freely and f"body {damper.body}" == location
    ]
    motions: list[DamperMotion] = []
    info, lines = rec.channels[channel], sweep.lines
    reading = np.abs(lines.mean[lines.channels.index(channel)] / info.response(lines.frequency))
    # Acceleration amplitude [m/s²].
    amplitudes = reading * (2 * np.pi * lines.frequency) ** (2 - MOTIONS.index(info.quantity))
    for frequency, amplitude, (first, stop) in zip(
        lines.frequency.tolist(), amplitudes.tolist(), sweep.windows.tolist(), strict=True
    ):
        max_samples = max(_MAX_SEARCHED_SAMPLES, int(_MIN_SEARCHED_PERIODS * rec.rate / frequency))
        motion = BodyMotion(rec, channel, first, min(stop, first + max_samples, rec.samples))
        motions.append(_motion_in_window(motion, numbers, frequency, amplitude))
        if progress is not None:
            progress(len(motions), lines.frequency.size)
    return motions


def _motion_in_window(motion: BodyMotion, numbers: list[int], frequency: float, amplitude: float) -> DamperMotion:
    """Estimate the motion of the dampers `numbers` at a frequency [Hz] and an acceleration amplitude [m/s²]."""
    detected, rate, gravity = motion.impacts, motion.rec.rate, motion.rec.scene.gravity
    dampers = [motion.rec.scene.dampers[number - 1] for number in numbers]
    # The searched duration excludes the ends of the segment.
    searched_periods = detected.searched_duration * frequency
    is_at_ceiling = detected.wall == "ceiling"
    begin, end = motion.start / rate, (motion.start + motion.samples.size) / rate
    cycle_periods = _cycle_periods(detected, frequency, begin, end) if detected.time.size else 1
    # Without a cycle, impacts may have been missed, so free flights cannot be identified.
    estimate = restitution(motion, dampers[0]) if len(dampers) == 1 and cycle_periods else None
    stays_at_ceiling = None
    if is_at_ceiling.any():
        stays_at_ceiling = _stays_at_ceiling(
            detected.acceleration[is_at_ceiling] + gravity,
            np.pi * frequency * (1.0 / rate + 2.0 * detected.contact_duration) * amplitude,
            _fastest_rebound(motion, dampers, estimate),
            _push_time(detected.acceleration[is_at_ceiling], amplitude, gravity, frequency),
        )
    return DamperMotion(
        frequency,
        detected.channel,
        float(np.sum(~is_at_ceiling)) / searched_periods,
        float(np.sum(is_at_ceiling)) / searched_periods,
        stays_at_ceiling,
        detected.detection_limit,
        _min_acceleration(motion, numbers, frequency) > -gravity,
        estimate,
        cycle_periods,
        not is_at_ceiling.any() and any(may_reach_ceiling(motion, damper) for damper in dampers),
    )


def _cycle_periods(detected: Impacts, frequency: float, begin: float, end: float) -> int:
    """Return the smallest number of periods after which all impacts between two times [s] repeat; 0 if they do not."""
    walls = [detected.time[detected.wall == wall] for wall in ("floor", "ceiling")]
    begin, end = begin + detected.ringing, end - detected.ringing
    if any(times.size and not np.any((times > begin) & (times < end)) for times in walls):
        return 0
    unsearched = detected.unsearched + np.array([-1.0, 1.0]) * detected.resolution
    for periods in range(1, _MAX_CYCLE_PERIODS + 1):
        shift = periods / frequency
        repeats = True
        for impact_times, expected in ((times, times + sign * shift) for times in walls for sign in (1.0, -1.0)):
            expected = expected[(expected > begin) & (expected < end), None]
            searched = ~((expected > unsearched[:, 0]) & (expected < unsearched[:, 1])).any(axis=1)
            distance = abs(expected[searched] - impact_times).min(axis=1, initial=np.inf)
            repeats &= bool(np.all(distance < detected.resolution))
        if repeats:
            return periods
    return 0


def _stays_at_ceiling(apparent_gravity: Array, error: float, rebound_speed: float, push_time: float) -> bool | None:
    """Return whether a damper stays at the ceiling after impacts; None if undetermined.

    `apparent_gravity`: acceleration of the body plus g at each impact [m/s²]; `error`: limit of its error [m/s²];
    `rebound_speed`: fastest rebound [m/s]; `push_time`: time for which the ceiling pushes [s]. The damper stays if it
    returns within this time. While the relative acceleration falls linearly from a to 0 within a time t, a mass that
    rebounds at less than a t / 3 returns.
    """
    finite = apparent_gravity[np.isfinite(apparent_gravity)]
    median = float(np.median(finite)) if finite.size else 0.0
    if abs(median) <= error:
        return None
    if median > 0.0:
        return False
    return True if rebound_speed <= -median * push_time / 3.0 else None


def _fastest_rebound(motion: BodyMotion, dampers: list[Damper], estimate: Restitution | None) -> float:
    """Return an upper bound of the rebound speed at the ceiling, summed over all bounces [m/s]."""
    # The restitution estimated from flights replaces the scene's if the scene's is above zero or the estimate differs
    # significantly from zero. The release of finite-duration contact is unknown.
    detected = motion.impacts
    if detected.contact_duration:
        return np.inf
    max_restitution = max((damper.restitution for damper in dampers), default=0.0)
    if estimate is not None and (max_restitution > 0.0 or estimate.value > _RESTITUTION_SIGMAS * estimate.error):
        max_restitution = min(estimate.value + float(expand(estimate.error)), 1.0)
    if max_restitution <= 0.0:
        return 0.0
    at_ceiling = replace(detected, jump=detected.jump[detected.wall == "ceiling"])
    speeds = [inelastic_closing_speeds(motion.rec.scene, at_ceiling, damper) for damper in dampers]
    # All bounces together take as long as one bounce with the sum of their speeds (geometric series).
    return float(
        np.max(speeds, initial=0.0) * max_restitution / (1.0 + max_restitution) / max(1.0 - max_restitution, 1e-9)
    )


def _push_time(acceleration: Array, amplitude: float, gravity: float, frequency: float) -> float:
    """Return a lower bound of the time [s] until the `acceleration` at the impacts, if sinusoidal, rises to -g."""
    finite = acceleration[np.isfinite(acceleration)]
    at_impact = float(np.median(finite)) if finite.size else 0.0
    begin_phase, end_phase = np.arcsin(np.clip([at_impact / amplitude, -gravity / amplitude], -1.0, 1.0))
    return max(float(end_phase - begin_phase), 0.0) / (2 * np.pi * frequency)


def _min_acceleration(motion: BodyMotion, numbers: list[int], frequency: float) -> float:
    """Return a lower bound of the acceleration of a body and of its resting dampers [m/s²] including the tolerance."""
    scene, rows = motion.rec.scene, [motion.acceleration]
    count = rows[0].size
    for number in numbers:
        if scene.dampers[number - 1].contact is not None:
            gain = transmissibility(scene, number, np.asarray(np.fft.rfftfreq(count, 1.0 / motion.rec.rate)))
            rows.append(np.fft.irfft(np.fft.rfft(rows[0]) * gain, count))
    # The correction for the sensor mirrors the samples at the ends of a segment, so the results there are inaccurate.
    edge = min(int(np.ceil(motion.rec.rate / frequency)), count // 4)
    return float(min(row[edge:-edge].min() for row in rows) / max(1.0 - motion.tolerance, 1e-300))
