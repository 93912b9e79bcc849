"""How a kind of test is run, predicted, imported and offered on the bench page.

The module of a kind in this package defines a subclass of `Procedure` and its only instance, `PROCEDURE`.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, Literal, TypeVar, get_args

from daq.core.excitation.sensor_settling import longest_duration
from daq.core.excitation.station import Excitation, Station
from daq.core.signal_chain.channel import ChannelInfo
from rig.core.base.arrays import Array
from rig.core.base.errors import SceneError
from rig.core.scene.excitation.kind import KindOfTest, Pulses
from rig.core.scene.scene import Scene

TestT = TypeVar("TestT", bound=KindOfTest)
Detection = Literal["hits", "dwells", "start", "band"]
Rehearsal = Literal["part", "peaks"]

# An open-loop drive is output in blocks of this duration [s].
_BLOCK_S = 0.5


# Keys of the test for fields of a form that have other names.
_FORM_KEYS = {"level": "force", "low": "from", "high": "to"}


@dataclass
class FormValues:
    """Values of the controls on the bench page."""

    kind: str  # kind of test: the title of its form
    level: float  # amplitude of a sine or sweep, rms of a random test, or peak of an impact [N]
    frequency: float  # frequency of a sine [Hz]
    low: float  # lower limit of a sweep or random test [Hz]
    high: float  # upper limit of a sweep or random test [Hz]
    duration: float  # duration of a sweep or random test [s]
    interval: float  # time between impacts [s]
    hits: int  # number of impacts


@dataclass(frozen=True)
class Form:
    """How the bench page offers a kind of test.

    `fields`: names of the `FormValues` of the test; without fields, the page offers the test of the scene unchanged.
    `adjustable`: the operator can change frequency and level of the tone during the test.
    """

    title: str
    fields: tuple[str, ...]
    adjustable: bool = False


class Procedure(Generic[TestT]):
    """The procedure of a kind of test; subclasses override the methods that differ from a drive of fixed duration.

    `detection`: the features that an import detects in the samples: impacts, dwells, the start of a decay, or only the
    band of the test. `rehearsal`: whether a long test is represented by its first part, or by dwells about the peaks of
    the linear response. `budget`: multiple of the CPU time for a rehearsal. `duration_ratio`: ratio by which the
    duration may differ from `seconds`; more than 1 if the waits at other levels or points differ from the waits in the
    part. `waits_for_sensors`: whether the test begins when the bias of the sensors has settled. `form`: form of the
    test on the bench page; None if the page does not offer it.
    """

    detection: ClassVar[Detection] = "band"
    rehearsal: ClassVar[Rehearsal] = "part"
    budget: ClassVar[float] = 1.0
    duration_ratio: ClassVar[float] = 1.0
    waits_for_sensors: ClassVar[bool] = False
    form: ClassVar[Form | None] = None

    def __init_subclass__(cls) -> None:
        """Raise `SceneError` for an unknown value: an import would detect nothing."""
        for name, value, values in (("detection", cls.detection, Detection), ("rehearsal", cls.rehearsal, Rehearsal)):
            if value not in get_args(values):
                expected = ", ".join(get_args(values))
                raise SceneError(f"{cls.__module__}: {cls.__name__}.{name} is {value!r}; expected one of {expected}.")

    def excite(self, station: Station, test: TestT) -> Excitation:
        """Run the test; by default, output its open-loop drive, and mark the intervals of `measured`."""
        wave = test.wave(station.samples(test.shortest), station.rate)
        assert isinstance(wave, Pulses), f"{test.kind_name()}: define excite, or KindOfTest.wave"
        first, level, block = station.now, station.drive_level, station.samples(_BLOCK_S)
        for start in range(0, wave.values.size, block):
            station.report(start / wave.values.size, test.kind_name().replace("_", " "))
            yield station.drive(wave.values[start : start + block])
        for begin_s, end_s, fields in self.measured(test, station.rate):
            begin, end = (first + round(time * station.rate) for time in (begin_s, end_s))
            station.mark("measure", begin, end, level=level, settled=True, **fields)

    def measured(self, test: TestT, rate: float) -> Iterable[tuple[float, float, dict[str, Any]]]:
        """Return start and end [s] of each measured interval of an open-loop drive, and its marker's fields.

        `rate`: sample rate [Hz].
        """
        return [(0.0, test.shortest, {})]

    def check(self, test: TestT, scene: Scene, channels: Sequence[ChannelInfo]) -> Iterable[str]:
        """Return lines of text that follow from the scene before the test runs; `channels`: channels of the bench."""
        return ()

    def snr_gain(self, test: TestT, frequency: Array) -> Array | None:
        """Return the signal-to-noise ratio of a measurement [sqrt(s)], for unit level and unit noise density.

        The noise density is per sqrt(Hz). `frequency`: frequencies in Hz, in the test or not; shape (n,), like the
        result. None if the ratio is not defined for this kind of test.
        """
        return None

    def waits(self, test: TestT, scene: Scene) -> float:
        """Return the expected time of all waits for steady states [s]."""
        return 0.0

    def power_on_wait(self, channels: Sequence[ChannelInfo]) -> float:
        """Return the longest time before the test [s] in which the sensors settle after power-on."""
        return longest_duration(channels) if self.waits_for_sensors else 0.0

    def control_seconds(self, test: TestT) -> float:
        """Return the CPU time of the controller [s]."""
        return 0.0

    def stored(self, test: TestT) -> float:
        """Return the duration of the drive that is stored in memory [s]."""
        return 0.0

    def part(self, test: TestT, seconds: float, scene: Scene) -> TestT:
        """Return a first part of the test that takes about `seconds`."""
        return test.replace(duration=min(test.shortest, seconds))

    def extension(self, test: TestT, seconds: float) -> float:
        """Return the ratio of the largest value in the whole test to the largest value in its first `seconds`."""
        return 1.0

    def seconds(self, test: TestT, part: TestT, part_seconds: float) -> float:
        """Return the expected duration of the test [s] if a part of it takes `part_seconds`."""
        return part_seconds + max(test.shortest - part.shortest, 0.0)

    def periods_of_step(self, test: TestT) -> int:
        """Return the number of measured periods of each dwell of the rehearsal about the peaks."""
        return 5

    def frequency_at(self, test: TestT, fraction: float) -> float | None:
        """Return the frequency of the tone [Hz] when a fraction of the test has passed; None if markers state it."""
        return None

    def from_form(self, values: FormValues, test: KindOfTest | None) -> Any:
        """Return a test, or the settings of a test, with the values of the page; `test`: the test of the scene."""
        assert self.form is not None
        if not self.form.fields:
            return test
        # The module of a procedure has the name of the kind.
        settings = {_FORM_KEYS.get(name, name): getattr(values, name) for name in self.form.fields}
        return {"kind": type(self).__module__.rpartition(".")[2], **settings}
