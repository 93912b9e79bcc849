"""Settings of a test: kind, level and duration of the excitation."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from rig.scene.shaker import Body
from rig.settings.alternatives import Alternatives, by_kind
from rig.settings.problems import Problem
from rig.settings.quantities import FORCE, FREQUENCY, LENGTH, RATIO, TIME, VELOCITY, VOLTAGE
from rig.settings.quantity_field import Quantity
from rig.settings.settings import Settings

Frequency = Annotated[float, Quantity(FREQUENCY, above=0.0)]
Duration = Annotated[float, Quantity(TIME, above=0.0)]
# The unit of the drive depends on the shaker: volts at its amplifier, or displacement of the table.
Force = Annotated[float, Quantity(FORCE, above=0.0)]
Drive = Annotated[float, Quantity(VOLTAGE, LENGTH, above=0.0)]
Forces = Annotated[float | tuple[float, ...], Quantity(FORCE, above=0.0, listed=True)]
Drives = Annotated[float | tuple[float, ...], Quantity(VOLTAGE, LENGTH, above=0.0, listed=True)]
Count = Annotated[int, Field(ge=1, le=1_000_000)]
ShakerNumber = Annotated[int, Field(ge=1)]
Start = Annotated[
    Literal["settled", "empty"],
    Field(
        description="Initial position, at rest with the dampers on their floors. settled: static equilibrium; empty: "
        "x = 0, the equilibrium of the structure without dampers."
    ),
]
Spacing = Literal["linear", "log"]

#: Maximum number of frequencies of a test.
MAX_STEPS = 100_000
#: Relative tolerance within which a controller accepts a force.
FORCE_TOLERANCE = 0.005


class Sine(Settings):
    """A sine of constant frequency and amplitude: amplitude times sin(2 pi f t) from t = 0."""

    one_of: ClassVar = (("force", "drive"),)
    kind: Literal["sine"] = "sine"
    start: Start = "settled"
    frequency: Frequency
    """Frequency [Hz]."""
    force: Force | None = None
    """Amplitude of the spring force, kept constant by the controller, or of the force of a force shaker [N]."""
    drive: Drive | None = None
    """Instead of `force`: amplitude of the drive, open loop [V, or m for a table shaker]."""
    shaker: ShakerNumber | None = None
    """With several shakers: the number of the driven shaker; the outputs of the others stay at zero."""
    duration: Duration = 2.0
    """Duration of the test [s]."""


class Settle(Settings):
    """Criterion for the steady state of a step."""

    tolerance: Annotated[float, Quantity(RATIO, above=0.0)] = 1e-3
    """Largest relative change of any channel's first harmonic between successive time windows."""
    longest: Duration = 60.0
    """Longest time to wait for the steady state [s]."""


class Measure(Settings):
    """Measurement time of a step in steady state, in periods of the drive."""

    periods: Count = 20
    """Number of periods."""


class SteppedSine(Settings):
    """A series of tones; each is brought to the level, settles to steady state and is measured."""

    one_of: ClassVar = (("force", "drive"), ("frequencies", "points"))
    kind: Literal["stepped_sine"] = "stepped_sine"
    start: Start = "settled"
    from_: Frequency | None = Field(None, alias="from")
    """First frequency [Hz]."""
    to: Frequency | None = None
    """Last frequency [Hz], above from."""
    points: Annotated[int, Field(ge=2, le=MAX_STEPS)] | None = None
    """Number of frequencies, both ends inclusive."""
    frequencies: tuple[Frequency, ...] | None = Field(None, min_length=1, max_length=MAX_STEPS)
    """Instead of from, to and points: the frequencies [Hz] in ascending order."""
    spacing: Spacing = "linear"
    """Whether the frequencies are evenly spaced on a linear or a logarithmic axis."""
    direction: Literal["up", "down", "both"] = "up"
    """Order of the frequencies; both: up, then down."""
    force: Forces | None = None
    """Amplitude of the spring force, kept constant by the controller, or of the force of a force shaker [N]. Several
    levels are run one after another."""
    drive: Drives | None = None
    """Instead of `force`: amplitude of the drive, open loop [V, or m for a table shaker]. Several levels are run one
    after another."""
    shaker: ShakerNumber | None = None
    """With several shakers: the number of the driven shaker; the outputs of the others stay at zero."""
    settle: Settle = Settle()
    """Criterion for the steady state of a step."""
    measure: Measure = Measure()
    """Measurement time of a step in steady state."""

    def check_consistency(self) -> Iterable[Problem]:
        """Check the range or the list of frequencies."""
        if self.frequencies is not None:
            if self.from_ is not None or self.to is not None:
                yield Problem((), "frequencies and from or to are given together. Remove frequencies, or from and to.")
            if any(b <= a for a, b in zip(self.frequencies, self.frequencies[1:], strict=False)):
                yield Problem(
                    ("frequencies",),
                    "the frequencies do not ascend. List them from low to high; direction: down reverses their order.",
                )
        elif self.from_ is None or self.to is None:
            yield Problem((), f"{'from' if self.from_ is None else 'to'} missing; expected a frequency such as 8 Hz")
        elif self.from_ >= self.to:
            message = f"got {self.from_:g} Hz, which is not below to, {self.to:g} Hz. Give the lower end first"
            yield Problem(("from",), f"{message}; direction: down sweeps downward.")

    @property
    def levels(self) -> tuple[float, ...]:
        """The levels (amplitudes of force or drive) in the order of the test [N, or the drive's unit]."""
        level = self.force if self.force is not None else self.drive
        return level if isinstance(level, tuple) else () if level is None else (level,)

    @property
    def order(self) -> tuple[float, ...]:
        """The frequencies of one level in the order of the test [Hz]."""
        ascending = self.frequencies
        if ascending is None:
            ascending = spaced_frequencies(self.from_ or 0.0, self.to or 0.0, self.points or 0, self.spacing)
        descending = ascending[::-1]
        return {"up": ascending, "down": descending, "both": ascending + descending}[self.direction]


def spaced_frequencies(first: float, last: float, points: int, spacing: str) -> tuple[float, ...]:
    """Return `points` frequencies, evenly spaced on a linear or logarithmic axis; first and last are exact.

    >>> spaced_frequencies(8.0, 10.0, 3, "linear")
    (8.0, 9.0, 10.0)
    """
    fractions = [k / (points - 1) for k in range(points)]
    if spacing == "log":
        interior = [first * (last / first) ** fraction for fraction in fractions]
    else:
        interior = [first + (last - first) * fraction for fraction in fractions]
    return (first, *interior[1:-1], last)


class SweptSine(Settings):
    """A sine whose frequency sweeps steadily from one end to the other, upward or downward."""

    one_of: ClassVar = (("force", "drive"),)
    kind: Literal["swept_sine"] = "swept_sine"
    start: Start = "settled"
    from_: Frequency = Field(alias="from")
    """First frequency [Hz]."""
    to: Frequency
    """Last frequency [Hz], above or below the first."""
    duration: Duration
    """Duration of the sweep [s]."""
    spacing: Spacing = "log"
    """Whether the frequency changes by equal steps (linear) or equal factors (log) in equal times."""
    force: Force | None = None
    """Amplitude of the spring force, kept constant by the controller, or of the force of a force shaker [N]."""
    drive: Drive | None = None
    """Instead of `force`: amplitude of the drive, open loop [V, or m for a table shaker]."""
    shaker: ShakerNumber | None = None
    """With several shakers: the number of the driven shaker; the outputs of the others stay at zero."""

    def check_consistency(self) -> Iterable[Problem]:
        """Check that the two end frequencies differ."""
        if self.from_ == self.to:
            yield Problem(("to",), f"got {self.to:g} Hz, which equals from. Use kind: sine for a constant frequency.")


class Random(Settings):
    """Gaussian noise between two frequencies."""

    one_of: ClassVar = (("force", "drive"),)
    kind: Literal["random"] = "random"
    start: Start = "settled"
    from_: Frequency = Field(alias="from")
    """Lower end of the band [Hz]."""
    to: Frequency
    """Upper end of the band [Hz]."""
    duration: Duration
    """Duration of the test [s]."""
    burst: Annotated[float, Quantity(RATIO, above=0.0, below=1.0)] | None = None
    """Fraction of each block during which the noise is on, above 0 and below 1; None: always on."""
    force: Force | None = None
    """Root mean square of the spring force, or of the force of a force shaker [N]."""
    drive: Drive | None = None
    """Instead of `force`: root mean square of the drive [V, or m for a table shaker]."""
    shaker: ShakerNumber | None = None
    """With several shakers: the number of the driven shaker; the outputs of the others stay at zero."""
    also: Annotated[tuple[ShakerNumber, ...], Field(min_length=1)] | None = None
    """Numbers of other shakers to drive simultaneously, with uncorrelated noise of the same spectrum."""

    def check_consistency(self) -> Iterable[Problem]:
        """Check the band."""
        return check_band(self.from_, self.to)


class Multisine(Settings):
    """A periodic sum of tones with random phases."""

    one_of: ClassVar = (("force", "drive"), ("lines", "period"))
    kind: Literal["multisine"] = "multisine"
    start: Start = "settled"
    from_: Frequency = Field(alias="from")
    """Lower end of the band [Hz]."""
    to: Frequency
    """Upper end of the band [Hz]."""
    lines: Annotated[int, Field(ge=2, le=MAX_STEPS)] | None = None
    """Number of tones in the band."""
    period: Duration | None = None
    """Instead of `lines`: the period of the signal [s]; the tones are multiples of its reciprocal."""
    periods: Count = 8
    """Number of measured periods of each realization."""
    realisations: Count = 4
    """Number of realizations: sets of random phases."""
    force: Force | None = None
    """Root mean square of the spring force, or of the force of a force shaker [N]."""
    drive: Drive | None = None
    """Instead of `force`: root mean square of the drive [V, or m for a table shaker]."""
    shaker: ShakerNumber | None = None
    """With several shakers: the number of the driven shaker; the outputs of the others stay at zero."""
    also: Annotated[tuple[ShakerNumber, ...], Field(min_length=1)] | None = None
    """Numbers of other shakers to drive simultaneously: each realization then has one experiment per shaker,
    with orthogonal phases."""

    @property
    def period_s(self) -> float:
        """Period of the signal [s], as given or from the number of lines."""
        return self.period if self.period is not None else (self.lines or 2) / (self.to - self.from_)

    def check_consistency(self) -> Iterable[Problem]:
        """Check the band."""
        yield from check_band(self.from_, self.to)
        if self.period is not None and math.floor(self.to * self.period) < math.ceil(self.from_ * self.period):
            message = f"no line of the multisine (multiple of {1.0 / self.period:g} Hz) lies between from and to"
            yield Problem(("period",), f"{message}. Give a longer period.")


def check_band(low: float, high: float) -> Iterable[Problem]:
    """Check that a frequency band is given with its lower end first."""
    if low >= high:
        yield Problem(("from",), f"got {low:g} Hz, which is not below to, {high:g} Hz. Give the lower end first.")


class DoubleHit(Settings):
    """Double hit: the hammer bounces, and a second, weaker pulse follows."""

    hits: tuple[Count, ...] | None = Field(None, min_length=1)
    """Numbers of the hits that bounce, from 1; None: all."""
    after: Duration = 20e-3
    """Time from the start of the first pulse to the start of the second [s]."""
    ratio: Annotated[float, Quantity(RATIO, above=0.0)] = 0.4
    """Ratio of the second pulse's peak to the first's."""


class Impulse(Settings):
    """Hammer hits: half-sine pulses of force on a body."""

    kind: Literal["impulse"] = "impulse"
    start: Start = "settled"
    body: Body
    """The body hit, by its number from 1 or its name."""
    peak: Annotated[float, Quantity(FORCE, above=0.0)]
    """Peak of the pulse [N]."""
    width: Duration
    """Duration of the half sine [s]; a softer tip makes it longer."""
    repeats: Count = 1
    """Number of hits."""
    interval: Duration = 6.0
    """Time from one hit to the next, and recording time after the last [s]."""
    double_hit: DoubleHit | None = None
    """Bounces of the hammer, each with a second, weaker pulse; None: single hits only."""

    def check_consistency(self) -> Iterable[Problem]:
        """Check that pulses do not overlap."""
        if self.width >= self.interval:
            yield Problem(
                ("width",),
                f"got {self.width:g} s, which is not shorter than the interval between hits, {self.interval:g} s. Give "
                "a shorter width or a longer interval.",
            )
        if self.double_hit is None:
            return
        if self.double_hit.after < self.width or self.double_hit.after + self.width >= self.interval:
            yield Problem(
                ("double_hit", "after"),
                f"got {self.double_hit.after:g} s, but the second pulse must lie between the first pulse and the next "
                f"hit. Give at least {self.width:g} s and less than {self.interval - self.width:g} s, or a longer "
                "interval.",
            )
        for k, hit in enumerate(self.double_hit.hits or ()):
            if hit > self.repeats:
                yield Problem(
                    ("double_hit", "hits", k),
                    f"hit {hit} does not exist; expected at most {self.repeats}, the number of repeats",
                )


class Free(Settings):
    """Free vibration from given displacements and velocities, with the drive at rest."""

    kind: Literal["free"] = "free"
    start: Start = "settled"
    displacement: tuple[Annotated[float, Quantity(LENGTH)], ...] | None = Field(None, min_length=1)
    """One initial displacement for each body, relative to the start position [m]."""
    velocity: tuple[Annotated[float, Quantity(VELOCITY)], ...] | None = Field(None, min_length=1)
    """One initial velocity for each body [m/s]."""
    mode: Annotated[int, Field(ge=1)] | None = None
    """Instead of displacement and velocity: number of the mode whose shape is the initial displacement, from 1."""
    amplitude: Annotated[float, Quantity(LENGTH, above=0.0)] | None = None
    """Largest initial displacement of that mode shape [m]."""
    duration: Duration = 6.0
    """Duration of the test [s]."""

    def check_consistency(self) -> Iterable[Problem]:
        """Check that the initial state is given in exactly one form."""
        if (self.mode is None) != (self.amplitude is None):
            given_key, missing_key = ("mode", "amplitude") if self.amplitude is None else ("amplitude", "mode")
            yield Problem((given_key,), f"given without {missing_key}. Add {missing_key}, or remove {given_key}.")
        if self.mode is not None and (self.displacement is not None or self.velocity is not None):
            yield Problem(("mode",), "mode is given together with displacement or velocity. Remove one of the two.")
        if self.mode is None and self.displacement is None and self.velocity is None:
            yield Problem((), "no initial state; expected displacement, velocity, or mode and amplitude")


Test = Annotated[Sine | SteppedSine | SweptSine | Random | Multisine | Impulse | Free, Alternatives(by_kind)]
