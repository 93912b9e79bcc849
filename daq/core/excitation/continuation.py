"""Control-based continuation: measurement of the response at constant force, also where the motion is unstable.

A resonance curve of a nonlinear structure can turn back in frequency (fold). Between two folds the motion is unstable
at constant force, and an open-loop test jumps past it. Here feedback holds the displacement amplitude
(`envelope_control`). In steady state the drive of the feedback is constant, so the held motion is also a motion at
constant force.

A point of the curve has two unknowns, frequency and displacement amplitude, and one equation: the measured force equals
the level. The next point is predicted along the curve from the last two chords. It is corrected by the secant method:
the motion is held at points on the normal to this direction until the force equals the level.

Distances along the curve are relative changes of the response: the change of the angular frequency divided by |l|, and
the change of the logarithm of the amplitude. l is the pole of the nearest mode minus the imaginary angular frequency of
the tone [1/s]. (J. Sieber et al., Phys. Rev. Lett. 100 (2008) 244101; L. Renson, D. A. W. Barton, S. A. Neild, Int. J.
Bifurc. Chaos 27 (2017) 1730002.)
"""

import cmath
import math
from collections.abc import Generator, Sequence
from itertools import pairwise

from daq.core.excitation.constant_response import AT_LIMIT_RATIO
from daq.core.excitation.controlled import measured_force
from daq.core.excitation.procedure import Form
from daq.core.excitation.station import AbortedTest, Excitation, Station
from daq.core.excitation.stepped_sine import SteadyTonesProcedure, expected_wait
from daq.core.excitation.tones.curve_tone import CurveTone, Point
from daq.core.excitation.tones.envelope_control import (
    AVERAGED_WINDOWS,
    MAX_GROWTH_TIMES_DEAD_TIME,
    MAX_POLE_TIMES_DEAD_TIME,
)
from rig.core.base.arrays import Array
from rig.core.results.text import format_decimals
from rig.core.scene.excitation import Continuation
from rig.core.scene.scene import Scene
from rig.core.system.structural_model import structural_model

# Feedback starts where the product of |l| and dead time is below this fraction of its stability limit, and stops above
# the limit.
_BEGIN_RATIO = 0.8
# Largest relative deviation of the force from the level: small against the change of force along the curve.
_TOLERANCE = 0.002
# Maximum number of holds that correct a point; more are needed only if the control has lost the curve.
_MAX_CORRECTIONS = 8
# Smallest assumed slope of ln(force) along the normal; it limits the distance to the next hold.
_MIN_SLOPE = 0.05
# A failed step is repeated with this fraction of its length: the correction converges from a closer start.
_STEP_REDUCTION = 0.5
# Smallest length of a step, as a fraction of `test.step`.
_MIN_STEP_FRACTION = 1.0 / 16.0
# A step with feedback that turns the curve by more than this angle [rad] is repeated with a shorter length.
_MAX_TURN = 0.25
# Smallest length of a step with feedback where the curve turns, as a fraction of `test.step`: noise determines the
# direction of shorter steps.
_SHORTEST_TURN = 0.125
# The frequency changes in a step by at most this fraction of the band, and by half of the fraction before the mode is
# known.
_MAX_BAND_RATIO = 0.05
# The curve begins at the first of these positions in the band, from 0 to 1, where the motion repeats.
_START_POSITIONS = 0.0, 0.05, 0.1, 0.15, 0.2
# Without feedback, a response that changes by more than this factor has jumped to another branch: the step along a
# branch is smaller.
_JUMP_RATIO = 2.0
# If the motion has not jumped, ln(amplitude) deviates by less than this after the return to the last point: noise is
# smaller, a jump larger.
_MAX_RETURN_DEVIATION = 0.05
# Lengths of the steps over a gap in the curve, in units of the length of a step.
_GAP_STEP_LENGTHS = 1.0, 2.0, 4.0
# Maximum number of gaps that a warning lists.
_LISTED_GAPS = 3
# Beyond a corner of the curve (grazing impacts), the frequency changes by this fraction of a step at a time, because
# the response there cannot be extrapolated.
_CORNER_RATIO = 0.25
# Maximum number of such changes in succession; more occur only if the curve is lost.
_MAX_CORNER_STEPS = 12
# Duration of each change of the frequency next to a corner, in units of 1 / |l|: the transients of slow changes are
# small, and the motion near a corner is stable only against small transients.
_CORNER_DURATION = 20.0
# Feedback that changes the drive by more than this fraction (rms) indicates a motion that does not repeat; noise
# changes the drive less.
_MAX_INVASIVE = 0.01


class Lost(Exception):
    """The controller lost the curve, for the stated reason."""


class _Curve:
    """The curve of a level: its points so far, and the steps from point to point."""

    def __init__(self, station: Station, test: Continuation, tone: CurveTone, level: float) -> None:
        self._station, self._test, self._tone, self._level = station, test, tone, level
        self.at_level = f"level {station.level_text(level)}"
        self._forward = math.copysign(1.0, test.to - test.from_)
        self._band = abs(test.to - test.from_)
        self.points: list[Point] = []
        # Direction of the curve at the last point, as e^{i angle} in the plane of `_change`.
        self._tangent = complex(self._forward)
        self._holding = False
        self._length = test.step  # length of the last step
        self._chord, self._bend = test.step, 0.0  # distance of the last two points, and change of direction [rad]
        self._drive = 0.0  # amplitude of the drive at the level, next to the last point
        self.folds = 0  # number of points at which the curve turned back
        self.gaps: list[tuple[float, float]] = []  # frequencies of the points at their ends [Hz]
        self._is_irregular = False  # whether a motion did not repeat

    @property
    def unstable(self) -> bool:
        """Whether the last step was opposite to the direction of the test, as between folds: the motion is unstable."""
        return self._tangent.real * self._forward < 0.0

    def follow(self, drive: float) -> Generator[Array, Array, None]:
        """Measure points up to the end of the band; raise `Lost`. `drive`: amplitude of the first drive."""
        test = self._test
        yield from self._begin(drive)
        while len(self.points) < test.points and (0.0 <= self._share < 1.0 or len(self.points) == 1):
            length, shortest = min(test.step, self._length / _STEP_REDUCTION), _MIN_STEP_FRACTION * test.step
            point = None
            while point is None and length >= shortest:
                point = yield from (self._held(length) if self._holding else self._driven(length))
                if point is not None and (self._turns_sharply(point, length) or not (yield from self._add(point))):
                    point = None
                    if not (self._holding or (yield from self._returns())):
                        break
                self._length, length = length, length * _STEP_REDUCTION
            if point is None:
                growth = (yield from self._growth()) if self._holding and self.unstable else 0.0
                yield from self._leap(self._reason(growth))
        if len(self.points) == test.points:
            self._station.warn(
                f"{self.at_level}: the curve ends at {self.points[-1].frequency:.4g} Hz after {test.points} "
                "points. Increase test.points or test.step."
            )
        elif self._share < 0.0:
            self._station.warn(
                f"{self.at_level}: the curve turns back and leaves the band at {self.points[-1].frequency:.4g} "
                "Hz, where the test began. Folds outside the band are not measured. Set test.from farther from the "
                "resonance."
            )

    def _begin(self, drive: float) -> Generator[Array, Array, None]:
        """Measure the first point, at the first frequency where the motion repeats; raise `Lost`."""
        test, frequency = self._test, 0.0
        for share in _START_POSITIONS:
            frequency = test.from_ + share * (test.to - test.from_)
            point = yield from self._tone.drive_to(frequency, drive, self._level)
            if point is not None and (yield from self._add(point)):
                self.gaps += [(test.from_, frequency)] if share else []
                return
            if limitation := self._limitation():
                raise Lost(limitation)
        cause, remedy = f"no steady state within {test.settle.longest:g} s", "increase test.settle.longest"
        if self._is_irregular:
            cause, remedy = "the motion is irregular", "choose another level"
        raise Lost(
            f"{cause} from {test.from_:.5g} to {frequency:.5g} Hz. Start farther from the resonance, or {remedy}"
        )

    @property
    def _share(self) -> float:
        """Position of the last point in the band, from 0 to 1."""
        return (self.points[-1].frequency - self._test.from_) * self._forward / self._band

    def _add(self, point: Point) -> Generator[Array, Array, bool]:
        """Measure at a settled point next to the last point, and add it to the curve; return whether it was steady."""
        change = self._change(point) if self.points else 0j
        length = math.hypot(change.real, change.imag)
        if not length:
            return (yield from self._measure(point, self._tangent, self._chord, self._bend))
        bend = 2.0 * self._turn(point) / (length + self._chord)
        bend = max(-_MAX_TURN, min(_MAX_TURN, bend * length)) / length if self._holding else 0.0
        return (yield from self._measure(point, change / length, length, bend))

    def _measure(
        self, point: Point, tangent: complex, chord: float, bend: float, jump: float | None = None
    ) -> Generator[Array, Array, bool]:
        """Measure at a settled point, and add it to the curve with its direction; return whether it was steady.

        `jump`: result of `_past_corner`.
        """
        test, station, tone, is_unstable = self._test, self._station, self._tone, tangent.real * self._forward < 0.0
        samples = round(test.measure.periods * station.rate / point.frequency)
        # At constant drive, a motion next to a fold drifts slowly, and its force is in error.
        held = yield from tone.hold_until_decayed(samples, point.motion, feedback=self._holding)
        if self._holding and not is_unstable and held.invasive >= _MAX_INVASIVE:
            # Feedback excites some stable motions, such as those next to corners.
            if (yield from tone.hold_at(point.frequency, point.motion)) is None:
                return False
            held = yield from tone.hold_until_decayed(samples, point.motion, feedback=False)
        # The amplitude of an irregular motion can also grow.
        settled = held.invasive < _MAX_INVASIVE and not (held.growth and held.repetition)
        self._is_irregular |= settled and not held.repetition
        fields = {"distance": abs(point.pole), "frequency": point.frequency, "level": self._level}
        tone.mark_measured(held, settled, **fields, direction="up", jump=jump)
        if not (settled and held.repetition):
            return False
        self.folds += is_unstable != self.unstable
        self._tangent, self._chord, self._bend = tangent, chord, bend
        self._drive = abs(held.drive) * self._level / point.level
        self.points.append(point)
        self._holding = tone.is_holdable(point, 1.0 if self._holding else _BEGIN_RATIO)
        share = min(max(self._share, 0.0), 1.0)
        station.report(share, f"{format_decimals(point.frequency, 2)} Hz, {self.at_level}")
        return True

    def _change(self, point: Point) -> complex:
        """Return the change from the last point: the angular frequency over `_rate` + i ln(amplitude)."""
        last = self.points[-1]
        turn = 2.0 * math.pi * (point.frequency - last.frequency) / self._rate(last)
        return complex(turn, math.log(point.motion / last.motion))

    def _rate(self, point: Point) -> float:
        """Return |l| at a point, 1/s, limited by the largest change of the frequency in a step."""
        longest = _MAX_BAND_RATIO * self._band / self._test.step
        known = abs(point.pole) / (2.0 * math.pi) if point.pole else 0.5 * longest
        return 2.0 * math.pi * min(known, longest)

    def _driven(self, length: float) -> Generator[Array, Array, Point | None]:
        """Measure the next frequency without feedback; return None if it did not settle. Raise `Lost` after a jump."""
        last = self.points[-1]
        if self.unstable:
            return None
        frequency = last.frequency + self._forward * length * self._rate(last) / (2.0 * math.pi)
        limit = max if self._forward < 0.0 else min
        point = yield from self._tone.drive_to(limit(frequency, self._test.to), self._drive, self._level)
        if point is not None and abs(math.log(point.motion / last.motion)) > math.log(_JUMP_RATIO):
            raise Lost(
                f"the response jumps at {frequency:.4g} Hz, where its envelope cannot be controlled. Start at the "
                "other end of the band"
            )
        return point

    def _held(self, length: float) -> Generator[Array, Array, Point | None]:
        """Measure the next point along the curve with feedback; return None if the corrections do not converge."""
        last = self.points[-1]
        # The next chord is assumed to turn as much as the last chord, in proportion to the distance of their centers.
        direction = self._tangent * cmath.exp(0.5j * self._bend * (self._chord + length))
        along, up, rate = direction.real, direction.imag, self._rate(last)
        # Expected slope of ln(force) along the normal, from its slopes over w / |l| and over ln |X|. The slope over w /
        # |l| is that of a mode. The slope over ln |X| is 1 for a mode; where the curve is steep, it follows from the
        # tangent, along which the force is constant.
        over_frequency = -last.pole.imag / abs(last.pole)
        over_motion = -over_frequency * along / up if abs(up) > 0.5 else 1.0
        slope = over_motion * along - over_frequency * up
        visited = list[tuple[float, float]]()
        position = 0.0
        for _ in range(_MAX_CORRECTIONS):
            change = complex(length, position) * direction
            frequency = last.frequency + change.real * rate / (2.0 * math.pi)
            point = yield from self._tone.hold_at(frequency, last.motion * math.exp(change.imag))
            if point is None:
                return None
            error = math.log(point.level / self._level)
            if abs(error) <= max(_TOLERANCE, 2.0 * self._tone.scatter / math.sqrt(AVERAGED_WINDOWS)):
                return point
            visited.append((position, error))
            if (candidate := _next_position(visited, slope, 2.0 * length)) is None:
                return None
            position = candidate
        return None

    def _leap(self, reason: str) -> Generator[Array, Array, None]:
        """Add a stable point at the other side of a gap in the curve; raise `Lost` for a reason if none is nearby.

        Where impacts begin or end, no feedback of the envelope holds the motion: the curve has a corner, often a fold.
        """
        last, was_unstable, jump = self.points[-1], self.unstable, None
        if not self._tone.is_holdable(last, 1.0):
            # The dead time is too long: steps without feedback would jump past folds.
            raise Lost(reason)
        self._holding = False
        for ratio in _GAP_STEP_LENGTHS:
            if was_unstable:
                point, jump = yield from self._past_corner(ratio * self._test.step)
            else:
                point = yield from self._driven(ratio * self._test.step)
            if point is None:
                continue
            if (yield from self._measure(point, complex(self._forward), self._test.step, 0.0, jump)):
                is_adjacent = bool(self.gaps) and self.gaps[-1][1] == last.frequency
                start = self.gaps.pop()[0] if is_adjacent else last.frequency
                self.gaps.append((start, point.frequency))
                return
        raise Lost(reason)

    def _past_corner(self, length: float) -> Generator[Array, Array, tuple[Point | None, float]]:
        """Settle at the stable motion next to a corner behind the last point, which is unstable.

        Return this point (None without such a motion), and the frequency [Hz] at which the motion has jumped; the fold
        lies between the two frequencies. `length`: change of ln(amplitude) along the curve, from which the motion
        settles.
        """
        last, tone, up = self.points[-1], self._tone, self._tangent.imag
        target = last.motion * math.exp(math.copysign(length, up))
        step = -self._forward * _CORNER_RATIO * self._test.step * self._rate(last) / (2.0 * math.pi)

        def settle(frequency: float) -> Generator[Array, Array, Point | None]:
            """Change slowly to a frequency and settle; return the point, None without steady state."""
            if steps := abs(frequency - tone.frequency) / abs(step):
                samples = self._station.samples(_CORNER_DURATION * max(steps, 1.0) / abs(last.pole))
                yield self._station.drive(tone.transition(samples, frequency, self._drive))
            return (yield from tone.drive_to(frequency, self._drive, self._level))

        def has_jumped(motion: float) -> bool:
            """Return whether the motion differs from an earlier one and is not beyond that of the curve."""
            return math.log(abs(tone.motion) / motion) * up < -_MAX_RETURN_DEVIATION

        def begin() -> Generator[Array, Array, bool]:
            """Settle next to the corner at the frequency of the last point; return whether this succeeded."""
            yield from tone.hold_at(last.frequency, target)
            return (yield from settle(last.frequency)) is not None and not has_jumped(last.motion)

        reached = jump = last.frequency
        if not (yield from begin()):
            return None, jump
        for _ in range(_MAX_CORNER_STEPS):
            motion, jump = abs(tone.motion), reached + step
            point = yield from settle(jump)
            if has_jumped(motion):
                point = (yield from settle(reached)) if (yield from begin()) else None
                # The transient of a change can cause the jump early, by a change at most.
                return (None if has_jumped(last.motion) else point), jump + step
            if point is None:
                break
            reached = jump
        return None, jump

    def _turn(self, point: Point) -> float:
        """Return the angle from the last chord to the chord to a new point [rad]."""
        return cmath.phase(self._change(point) * self._tangent.conjugate())

    def _returns(self) -> Generator[Array, Array, bool]:
        """Settle at the last point without feedback; return whether the motion is the same: it has not jumped."""
        last = self.points[-1]
        point = yield from self._tone.drive_to(last.frequency, self._drive, self._level)
        return point is not None and abs(math.log(point.motion / last.motion)) < _MAX_RETURN_DEVIATION

    def _turns_sharply(self, point: Point, length: float) -> bool:
        """Return whether a step with feedback to a point requires a shorter length."""
        return self._holding and abs(self._turn(point)) > _MAX_TURN and length > _SHORTEST_TURN * self._test.step

    def _growth(self) -> Generator[Array, Array, float]:
        """Return the rate at which the motion leaves the last point without feedback [1/s].

        The result is 0 if the point is not reached.
        """
        last = self.points[-1]
        if (yield from self._tone.hold_at(last.frequency, last.motion)) is None:
            return 0.0
        samples = round(self._test.measure.periods * self._station.rate / last.frequency)
        return (yield from self._tone.hold_envelope(samples, last.motion, feedback=False)).growth

    def _limitation(self) -> str:
        """Return a message if the amplifier limits the drive; empty if the drive is below the limit."""
        if self._tone.amplitude < AT_LIMIT_RATIO * self._station.drive_limit:
            return ""
        return f"the amplifier is at its limit at {self._tone.frequency:.4g} Hz. Lower the level"

    def _reason(self, growth: float = 0.0) -> str:
        """Return the reason why no further point was measured.

        `growth`: growth rate of the last motion without feedback [1/s].
        """
        if limitation := self._limitation():
            return limitation
        last, tone = self.points[-1], self._tone
        rates = (
            ("an open-loop growth", growth, MAX_GROWTH_TIMES_DEAD_TIME),
            ("a pole", abs(last.pole), MAX_POLE_TIMES_DEAD_TIME),
        )
        for name, rate, largest in rates:
            if rate * tone.dead_time > largest:
                return (
                    f"{name} of {rate:.2g} 1/s at {last.frequency:.4g} Hz requires a dead time below "
                    f"{largest / rate:.2g} s; it is {tone.dead_time:.2g} s. Use a converter filter with a shorter delay"
                )
        return (
            f"the curve ends with {1e3 * last.motion:.3g} mm of {self._test.at} at {last.frequency:.4g} Hz: the next "
            f"point was not reached (relative standard deviation of force {1e2 * tone.scatter:.1f} %). The period of "
            "the motion may have doubled, or the impacts in a period may have changed; increase test.settle.longest, "
            "or reduce test.step"
        )


def _next_position(visited: Sequence[tuple[float, float]], slope: float, length: float) -> float | None:
    """Return the next position along a normal by the secant method; None if the curve is farther away than `length`.

    `visited`: pairs of position and error, in the order of the measurements; `slope`: expected slope of the error.
    """
    position, error = visited[-1]
    if len(visited) > 1:
        slope = (error - visited[-2][1]) / (position - visited[-2][0])
    slope = math.copysign(max(abs(slope), _MIN_SLOPE), slope)
    candidate = max(-length, min(length, position - error / slope))
    ordered = sorted(visited)
    for (low, before), (high, after) in pairwise(ordered):
        if before * after < 0.0:
            # The curve lies between the two positions. Where the error is not smooth, the secant can leave this
            # interval.
            return candidate if low < candidate < high else (low + high) / 2.0
    return None if any(candidate == other for other, _ in visited) else candidate


def format_gaps(gaps: Sequence[tuple[float, float]]) -> str:
    """List the first gaps in the curve, in Hz, and the number of the others.

    >>> format_gaps([(30.0, 29.5), (27.0, 26.5), (25.0, 24.5), (23.0, 22.5), (21.0, 20.5)])
    '30 to 29.5, 27 to 26.5, 25 to 24.5 Hz and in 2 more ranges'
    """
    listed = ", ".join(f"{start:.5g} to {end:.5g}" for start, end in gaps[:_LISTED_GAPS]) + " Hz"
    return f"{listed} and in {len(gaps) - _LISTED_GAPS} more ranges" if len(gaps) > _LISTED_GAPS else listed


class ContinuationProcedure(SteadyTonesProcedure["Continuation"]):
    """A tone that follows the response curve of each level."""

    form = Form("continuation", ("level", "low", "high"))
    waits_for_sensors = True
    # The durations of seven random curves with folds were 0.8 to 3.3 times their extrapolation.
    duration_ratio = 3.0

    def excite(self, station: Station, test: Continuation) -> Excitation:
        """Follow the curve of each level; raise `AbortedTest` if none reached a fold or the end of the band."""
        force = None if test.level_key == "drive" or station.force_is_drive else measured_force(station)
        tone, failures, useless = CurveTone(station, test, force), list[str](), 0
        yield from tone.measure_noise()
        for level in test.levels:
            curve = _Curve(station, test, tone, level)
            try:
                yield from curve.follow(tone.start(level))
            except Lost as loss:
                failures.append(f"{curve.at_level}, {len(curve.points)} points: {loss}.")
                useless += not curve.folds
            if curve.gaps:
                station.warn(
                    f"{curve.at_level}: no points from {format_gaps(curve.gaps)}, where no steady motion was found: "
                    "the period has doubled, or the impacts in a period change. Folds in this range are not measured. "
                    "Reduce test.step."
                )
            tone.warn_of_repetitions()
            yield tone.end()
        if useless == len(test.levels):
            raise AbortedTest(failures[0])
        for message in failures:
            station.warn(message)
        station.report(1.0, "done")

    def waits(self, test: Continuation, scene: Scene) -> float:
        """Return the expected time [s] of all points; their number follows from the linear modes in the band."""
        modes, count = structural_model(scene).modes, 1.0
        low, high = sorted((2.0 * math.pi * test.from_, 2.0 * math.pi * test.to))
        for omega, rate in zip(modes.omega, modes.decay_rate, strict=True):
            if low < omega < high:
                count += (math.asinh((high - omega) / rate) + math.asinh((omega - low) / rate)) / test.step
        seconds = expected_wait(scene, test.settle.longest) + test.measure.periods / test.from_
        return len(test.levels) * min(count, test.points) * seconds


PROCEDURE = ContinuationProcedure()
