"""Base class of all kinds of test: the properties that other modules use, with the values that most kinds share.

The class of a kind defines the properties of this kind. Other modules use the properties, and do not depend on the
kind.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self

from pydantic import Field

from rig.core.base.arrays import Array
from rig.core.scene.body_names import body_problems
from rig.core.scene.excitation.profile import ProfileControl, range_text
from rig.core.scene.shaker import Shaker, as_tuple
from rig.core.settings.problems import KeyPath, Problem
from rig.core.settings.quantities import ACCELERATION, FORCE, FREQUENCY, LENGTH, RATIO, TIME, VOLTAGE
from rig.core.settings.quantity_field import Quantity
from rig.core.settings.settings import Settings

Frequency = Annotated[float, Quantity(FREQUENCY, above=0.0)]
Duration = Annotated[float, Quantity(TIME, above=0.0)]
Force = Annotated[float, Quantity(FORCE, above=0.0)]
# The unit depends on the kind of shaker: V at its amplifier, m of its table, or m/s² of a base.
Drive = Annotated[float, Quantity(VOLTAGE, LENGTH, ACCELERATION, above=0.0)]
Forces = Annotated[float | tuple[float, ...], Quantity(FORCE, above=0.0, listed=True)]
Drives = Annotated[float | tuple[float, ...], Quantity(VOLTAGE, LENGTH, ACCELERATION, above=0.0, listed=True)]
Count = Annotated[int, Field(ge=1, le=1_000_000)]
ShakerNumber = Annotated[int, Field(ge=1)]
DrivenShaker = Annotated[
    ShakerNumber | None,
    Field(description="With several shakers: the number of the driven shaker; the outputs of the others stay at zero."),
]
Start = Annotated[
    Literal["settled", "empty"],
    Field(
        description="Initial position, at rest with the dampers on their floors. settled: static equilibrium; empty: "
        "x = 0, the equilibrium of the structure without dampers."
    ),
]
Spacing = Literal["linear", "log"]

#: Maximum number of frequencies of a test; more are a typing error and would take days.
MAX_STEPS = 100_000
#: Relative tolerance within which a controller accepts a force.
FORCE_TOLERANCE = 0.005
# Minimum settling time of simultaneous tones [beat periods]: 12 windows of two beat periods, because each of two
# updates of the drive needs six windows (a transition and five observations).
_SETTLING_BEATS = 24.0


class Chirp(NamedTuple):
    """Open-loop drive: a tone of changing frequency at the level of the test, from t = 0 to `KindOfTest.shortest`."""

    phase: Array  # rad, shape (samples,)
    frequency: Array  # Hz, shape (samples,)


class Pulses(NamedTuple):
    """Open-loop drive: samples of any waveform at one input."""

    input: Literal["hammer", "shaker"]
    values: Array  # N of a hammer, or drive of the shaker in `drive_unit`, shape (samples,)


class Rest(NamedTuple):
    """Open-loop drive that is zero."""


class Settle(Settings):
    """Criterion for the steady state of a dwell."""

    tolerance: Annotated[float, Quantity(RATIO, above=0.0)] = 1e-3
    """Steady state is reached if the amplitude at the frequency of the tone will change by less than this fraction in
    every channel; the remaining change is predicted from successive time windows."""
    longest: Duration = 60.0
    """Longest time to wait for the steady state [s]."""

    def check_spacing(self, key_path: KeyPath, frequencies: Iterable[float]) -> Iterable[Problem]:
        """Check that simultaneous tones in Hz are far enough apart to settle; `key_path`: key of the tones."""
        spacing = min((upper - lower for lower, upper in pairwise(sorted(frequencies))), default=math.inf)
        required = _SETTLING_BEATS / self.longest
        if spacing < required:
            yield Problem(
                key_path,
                f"tones that differ by {spacing:.2g} Hz do not settle within {self.longest:g} s. Space the tones by at "
                f"least {required:.2g} Hz, or increase `test.settle.longest`.",
            )


class KindOfTest(Settings):
    """A kind of test. Subclasses are the sections `test` of a scene; this class has no keys.

    `recorded_as`: kind of evaluation of the recordings, a value of `daq.core.recording.recorded_test.TestKind`.
    `level_keys`: alternative keys for the level of the test. `level_name`: quantity of the level, as text after its
    unit. `kind_title`: name of the kind in sentences, if not that of its key. `uses_shaker`: whether a shaker is
    driven. `single_tone`: whether the drive is one tone at a time. `controls_by_cell`: whether the controller uses a
    force sensor at the shaker, if there is one, instead of the motion of both ends of the spring. `follows_motion`:
    whether feedback of the motion changes the tone until shortly before each measurement.
    """

    recorded_as: ClassVar[str]
    level_keys: ClassVar[tuple[str, ...]] = ("force", "drive")
    level_name: ClassVar[str] = ""
    kind_title: ClassVar[str] = ""
    uses_shaker: ClassVar[bool] = True
    single_tone: ClassVar[bool] = False
    controls_by_cell: ClassVar[bool] = True
    follows_motion: ClassVar[bool] = False

    @classmethod
    def kind_name(cls) -> str:
        """Return the value of `kind`, which is also the name of the kind's modules."""
        return str(cls.model_fields["kind"].default)

    @property
    def level_key(self) -> str:
        """Key of the level; empty if the test has no level."""
        return next((key for key in self.level_keys if getattr(self, key) is not None), "")

    @property
    def levels(self) -> tuple[float, ...]:
        """Levels (amplitude or root mean square of force or drive), run one after another, in the key's unit."""
        level = getattr(self, self.level_key) if self.level_key else ()
        return level if isinstance(level, tuple) else (level,)

    @property
    def title(self) -> str:
        """Name of the kind in sentences."""
        return self.kind_title or self.kind_name().replace("_", " ")

    def level_text(self, shaker: Shaker | None) -> str:
        """Return the level with its unit, or the range of the levels; `shaker`: the driven shaker."""
        unit, levels = self.level_unit(shaker).replace("^2", "²"), self.levels
        return f"{range_text(levels, unit)} {self.level_name}".rstrip() if levels else ""

    @property
    def details(self) -> tuple[str, ...]:
        """Settings of the test besides its level and band, in a few words."""
        return ()

    @property
    def duration_text(self) -> str:
        """Duration of the measurement; empty if the test has no such setting."""
        duration = getattr(self, "duration", None)
        return "" if duration is None else f"{duration:.4g} s"

    def sentence(self, shaker: Shaker | None) -> str:
        """Describe the test in words; `shaker`: the driven shaker."""
        band = self.band
        parts = (
            self.title, "" if band is None else range_text(band, "Hz"), self.level_text(shaker), *self.details,
            self.duration_text,
        )  # fmt: skip
        return ", ".join(filter(None, parts))

    def at_level(self, level: float) -> Self:
        """Return the test at a different level."""
        return self.replace(**{self.level_key: level})

    def level_unit(self, shaker: Shaker | None) -> str:
        """Return the unit of the level; `shaker`: the driven shaker."""
        return shaker.drive_unit if self.level_key == "drive" and shaker is not None else "N"

    @property
    def held_motion(self) -> tuple[str, int] | None:
        """Location and number of time derivatives of the motion whose amplitude is the level; None without one."""
        return None

    @property
    def held_phase(self) -> tuple[str, float] | None:
        """Location of the displacement whose phase relative to the force is constant, and this phase [rad]; or None."""
        return None

    @property
    def hits(self) -> tuple[int, float]:
        """Number of impacts or pulses, and time between them [s]; default: the keys `repeats` and `interval`."""
        return int(getattr(self, "repeats", 1)), float(getattr(self, "interval", 0.0))

    @property
    def driven(self) -> int | None:
        """Number of the driven shaker, from 1, if the test gives it."""
        return getattr(self, "shaker", None)

    @property
    def also_driven(self) -> tuple[int, ...]:
        """Numbers of the shakers that are driven simultaneously."""
        return getattr(self, "also", None) or ()

    @property
    def band(self) -> tuple[float, float] | None:
        """Lowest and highest frequency of the drive [Hz]; default: from the keys; None without a band."""
        given = self.given_frequencies.values()
        return (min(given), max(given)) if given else None

    @property
    def given_frequencies(self) -> dict[KeyPath, float]:
        """Frequencies by key path [Hz]: of the keys `from` and `to`, otherwise of `frequencies` or `frequency`."""
        first, last = getattr(self, "from_", None), getattr(self, "to", None)
        if first is not None and last is not None:
            return {("to",): last, ("from",): first}
        single = getattr(self, "frequency", None)
        if single is not None:
            return {("frequency",): single}
        return {("frequencies", k): value for k, value in enumerate(getattr(self, "frequencies", None) or ())}

    @property
    def dwells(self) -> tuple[float, ...]:
        """Frequencies of the tones that are held until steady state, in the order of one level [Hz]."""
        return ()

    def remedy_between(self, bands: Sequence[tuple[float, float]]) -> str:
        """Return the instruction to measure in bands (lowest and highest frequency, Hz) between two `dwells`."""
        ranges = " and ".join(f"{low:.6g} to {high:.6g} Hz" for low, high in bands)
        return f"Measure {ranges} in a separate test."

    @property
    def sweep_direction(self) -> Literal["up", "down", "both"]:
        """Order of the frequencies in the test; default: the key `direction`, or upward."""
        return getattr(self, "direction", "up")

    @property
    def steady_state(self) -> Settle:
        """Criterion for the steady state of a tone; default: the key `settle`, if the kind has it."""
        return getattr(self, "settle", None) or Settle()

    @property
    def accepted_transient(self) -> float:
        """Largest relative transient at the end of a wait for the steady state; 0 without the key `settle`."""
        return self.steady_state.tolerance if getattr(self, "settle", None) is not None else 0.0

    def tones(self, points: int) -> tuple[float, ...]:
        """Return the tones of the test, or `points` frequencies over its band, ascending [Hz]; () without a band."""
        if self.dwells:
            return tuple(sorted(set(self.dwells)))
        return () if self.band is None else spaced_frequencies(*self.band, points, "log")

    @property
    def highest(self) -> tuple[KeyPath, float] | None:
        """Key path and value of the highest frequency [Hz]; None without a band."""
        if self.band is None:
            return None
        return next(
            (item for item in self.given_frequencies.items() if item[1] == self.band[1]), (("from",), self.band[1])
        )

    @property
    def shortest(self) -> float:
        """Duration without waits for steady states [s]; default: the key `duration`."""
        return float(getattr(self, "duration", 0.0))

    @property
    def simulated(self) -> float:
        """Duration of the open-loop drive in `rig simulate` [s]; default: the key `duration`, or 2 s."""
        return float(getattr(self, "duration", 2.0))

    @property
    def tone(self) -> float | None:
        """Frequency of the open-loop drive if it is a tone [Hz]; otherwise None."""
        return self.dwells[0] if self.dwells else None

    def wave(self, samples: int, rate: float) -> Chirp | Pulses | Rest | None:
        """Return the open-loop drive, if it is not one tone; None if it depends on measured values. `rate`: Hz.

        With a level of force this is possible only where the drive is a force (`KindOfShaker.drive_is_force`).
        """
        return None

    @property
    def hammer(self) -> int | None:
        """Number of the body on which a hammer acts, from 1; None without a hammer."""
        return None

    def initial_motion(self, bodies: int, shapes: Callable[[], Array]) -> tuple[Array, Array] | None:
        """Return initial displacement [m] and velocity [m/s] of the bodies, shape (bodies,); None for rest.

        `shapes` computes the mode shapes of the structure, shape (bodies, modes).
        """
        return None

    def controlled_terms(self, shaker: Shaker, table: str) -> dict[str, float]:
        """Return the controlled quantity per meter of displacement at each location; empty in open loop.

        By default the controlled quantity is the motion whose amplitude is the level, or the force of the driven
        shaker, whose table has the name `table`.
        """
        if self.held_motion is not None:
            return {self.held_motion[0]: 1.0}
        if self.level_key != "force" or shaker.drive_is_force:
            return {}
        return shaker.force_terms("", table)

    @property
    def named_channels(self) -> Iterable[tuple[KeyPath, str]]:
        """Key paths and names of the channels that the test names; they must measure motion."""
        return ()

    def pulse(self, time: Array) -> tuple[Array, float] | None:
        """Return the prescribed acceleration of a shock and its tolerance [m/s²]; None without a prescribed pulse.

        `time`: from the middle of the pulse [s].
        """
        return None

    def shock_spectrum(self) -> tuple[Array, Array, float] | None:
        """Return frequencies [Hz], prescribed shock response spectrum [m/s²] and tolerance [dB], or None."""
        return None

    @property
    def profile_control(self) -> ProfileControl | None:
        """The test as a test with profile control, or None."""
        return None

    def references(self, valid: Mapping[str, Any]) -> Iterable[Problem]:
        """Check references to other sections; `valid`: the valid sections before the test, by key."""
        if self.uses_shaker and "shaker" in valid:
            yield from self._check_shakers(as_tuple(valid["shaker"]))
        if (at := getattr(self, "at", None)) is not None:
            yield from body_problems(valid, int(at.removeprefix("body ")), ("at",))

    def _check_shakers(self, shakers: tuple[Shaker, ...]) -> Iterable[Problem]:
        """Check the numbers of the driven shakers, and that the first has the key of the level."""
        n_shakers, number, others = len(shakers), self.driven or 1, self.also_driven
        if not shakers:
            message = f"{self.kind_name()} requires a shaker. Add a shaker to the scene."
            yield Problem(("kind",), message, absent="shaker")
        elif n_shakers > 1 and self.driven is None:
            message = f"the scene has {n_shakers} shakers, but the test does not name the driven shaker."
            yield Problem((), f"{message} Add shaker: N to the test, with N from 1 to {n_shakers}.")
        elif number > n_shakers:
            yield Problem(("shaker",), f"shaker {number} does not exist; expected 1 to {n_shakers}")
        elif max(others, default=0) > n_shakers:
            yield Problem(("also",), f"shaker {max(others)} does not exist; expected numbers from 1 to {n_shakers}")
        elif len({self.driven, *others}) <= len(others):
            message = "a shaker is given twice; expected each number once in the keys shaker and also together"
            yield Problem(("also",), message)
        elif self.level_key in {"force", "drive"} - {*shakers[number - 1].level_keys}:
            shaker = shakers[number - 1]
            permitted = [key for key in shaker.level_keys if key in self.level_keys]
            remedy = f"Give {permitted[0]} instead." if permitted else "Choose another shaker or another kind of test."
            message = f"a shaker of kind {shaker.kind} {shaker.level_remark}. {remedy}"
            yield Problem((self.level_key,), message)


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


def check_band(low: float, high: float) -> Iterable[Problem]:
    """Check that the lowest frequency of a band is below the highest."""
    if low >= high:
        yield Problem(("from",), f"got {low:g} Hz, which is not below `to`, {high:g} Hz. Give the lower end first.")
