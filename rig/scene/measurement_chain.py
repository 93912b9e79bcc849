"""Settings of the measurement chain: sensors, integrating amplifiers, converter, and what a recording holds besides.

What is not given is not modelled: an accelerometer without keys reads the acceleration as it is.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, WithJsonSchema

from rig.errors import SceneError
from rig.scene.data_sheets import Preset, data_sheet, unknown_preset
from rig.scene.modules import module
from rig.scene.quantities import (
    ACCELERATION,
    ACCELERATION_NOISE,
    ACCELERATION_SENSITIVITY,
    CURRENT,
    FORCE,
    FORCE_NOISE,
    FORCE_SENSITIVITY,
    FREQUENCY,
    LENGTH,
    PER_KELVIN,
    RATIO,
    TEMPERATURE,
    TIME,
    VELOCITY,
    VOLTAGE,
    VOLTAGE_NOISE,
    Kind,
)
from rig.scene.quantity_field import Quantity
from rig.scene.settings import Mistake, Place, Settings, at

Corner = Annotated[float, Quantity(FREQUENCY, above=0.0)]
Tolerance = Annotated[float, Quantity(RATIO, at_least=0.0, below=1.0)]
Time = Annotated[float, Quantity(TIME, at_least=0.0)]
Limit = Annotated[float, Quantity(LENGTH, VELOCITY, ACCELERATION, FORCE, VOLTAGE, above=0.0)]
# Where a channel measures force, or the voltage of an output, not motion.
FORCE_PLACES, VOLTAGE_PLACE = ("hammer", "shaker"), "drive"
Supply = Annotated[float, Quantity(CURRENT, at_least=0.0)]


class Accelerometer(Settings):
    """A piezoelectric accelerometer, as its datasheet describes it; each effect is there when it is named."""

    preset: Preset | None = None
    """A part, by its name, whose datasheet fills in what is not given here."""
    sensitivity: Annotated[float, Quantity(ACCELERATION_SENSITIVITY, above=0.0)] | None = None
    """Nominal sensitivity [V per m/s^2]; None: 1."""
    sensitivity_tolerance: Tolerance | None = None
    """Largest deviation of the true sensitivity from the nominal one, as a share; the seed draws it."""
    resonance: Corner | None = None
    """Mounted resonance [Hz]."""
    q: Annotated[float, Quantity(RATIO, above=0.0)] | None = None
    """Quality factor of the resonance; None: 30."""
    low_cutoff: Corner | None = None
    """Corner of the first-order high pass [Hz]."""
    noise: Annotated[float, Quantity(ACCELERATION_NOISE, at_least=0.0)] | None = None
    """White noise density [m/s^2/sqrt(Hz)]."""
    noise_corner: Corner | None = None
    """Frequency below which the noise density rises as 1/f in power [Hz]; needs `noise`."""
    bias: Annotated[float, Quantity(VOLTAGE)] | None = None
    """Offset of the output at rest [V]."""
    bias_settling: Annotated[float, Quantity(TIME, above=0.0)] | None = None
    """Time constant with which the bias settles from zero after power-on [s]; needs `bias`."""
    transverse: Tolerance | None = None
    """Transverse sensitivity as a share of the nominal one; the seed draws its direction."""
    lateral: Annotated[float, Quantity(RATIO, at_least=0.0)] | None = None
    """Sideways acceleration of the mounting point as a share of the vertical (10 % where `transverse` is
    given without it); the structure itself moves vertically only."""
    saturation: Annotated[float, Quantity(ACCELERATION, above=0.0)] | None = None
    """Largest acceleration the output follows [m/s^2], whatever the sample rate; beyond, samples are marked as
    overloaded. A jump of velocity shakes a sensor with up to that jump times 2 pi resonance; one without a resonance
    cannot follow any."""
    overload_recovery: Annotated[float, Quantity(TIME, above=0.0)] | None = None
    """Time constant of the recovery after saturation [s]; needs `saturation`."""
    temperature_drift: Annotated[float, Quantity(PER_KELVIN)] | None = None
    """Relative change of sensitivity per kelvin [1/K]; needs `temperature_change`."""
    temperature_change: Annotated[float, Quantity(TEMPERATURE)] | None = None
    """Temperature of the sensor above that of its calibration [K]."""
    iepe: bool | None = None
    """Whether its amplifier needs the current that the converter feeds it with (`excitation`)."""

    needs: ClassVar[Mapping[str, str]] = {
        "q": "resonance",
        "noise_corner": "noise",
        "bias_settling": "bias",
        "lateral": "transverse",
        "overload_recovery": "saturation",
        "temperature_drift": "temperature_change",
    }

    def relations(self) -> Iterable[Mistake]:
        """Check that nothing is given without what it belongs to; a preset may supply that."""
        yield from unknown_preset(self.preset, "accelerometer")
        for key, other in self.needs.items():
            if self.preset is None and getattr(self, key) is not None and getattr(self, other) is None:
                yield Mistake((key,), f"given without {other}, to which it belongs")


class Integrator(Settings):
    """An integrating amplifier behind the accelerometer."""

    order: Annotated[int, Field(ge=1, le=2)]
    """1: the output follows the velocity, 2: the displacement."""
    corner: Annotated[float, Quantity(FREQUENCY, at_least=0.0)] = 0.0
    """Frequency below which it stops integrating [Hz], a first-order high pass per order; 0: it never
    does."""
    low_cutoff: Corner | None = None
    """Corner of the first-order high pass at its input [Hz], which keeps a sensor's bias out."""
    gain: Annotated[float, Quantity(RATIO, above=0.0)] = 1.0
    """Output per integral of the input [1/s for order 1, 1/s^2 for order 2]."""
    noise: Annotated[float, Quantity(VOLTAGE_NOISE, at_least=0.0)] | None = None
    """White noise density at the output [V/sqrt(Hz)]."""
    saturation: Annotated[float, Quantity(VOLTAGE, above=0.0)] | None = None
    """Largest voltage of each integration [V], whatever the sample rate; samples in which it is reached are marked as
    overloaded."""


class Hammer(Settings):
    """A force sensor: in the head of an impulse hammer, or between a shaker and the body it pushes."""

    preset: Preset | None = None
    """A part, by its name, whose datasheet fills in what is not given here."""
    sensitivity: Annotated[float, Quantity(FORCE_SENSITIVITY, above=0.0)] | None = None
    """Nominal sensitivity [V/N]; None: 1."""
    sensitivity_tolerance: Tolerance | None = None
    """Largest deviation of the true sensitivity from the nominal one, as a share; the seed draws it."""
    noise: Annotated[float, Quantity(FORCE_NOISE, at_least=0.0)] | None = None
    """White noise density [N/sqrt(Hz)]."""
    low_cutoff: Corner | None = None
    """Corner of the first-order high pass [Hz]."""
    saturation: Annotated[float, Quantity(FORCE, above=0.0)] | None = None
    """Largest force the output follows [N]; samples beyond are marked as overloaded."""
    iepe: bool | None = None
    """Whether its amplifier needs the current that the converter feeds it with (`excitation`)."""

    def relations(self) -> Iterable[Mistake]:
        """Check that the part is known."""
        return unknown_preset(self.preset, "hammer")


class Channel(Settings):
    """One measured signal: a point, the sensor on it and the amplifier behind that.

    At `shaker` it is the force between a shaker of kind force and its body; that of other shakers is read from the
    ends of their coil spring, the table and the driven body. At `drive` it is the voltage of the output in front of a
    shaker, as a teed cable gives it. Where there are several shakers, a place at one of them bears its number:
    `table 2`, `shaker 2`, `drive 2`.
    """

    name: Annotated[str, Field(max_length=80, pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]*$")]
    """A name of letters, digits, _, - and . under which it stands in the recording."""
    at: Annotated[
        str,
        Field(pattern=r"^(body [1-9][0-9]{0,5}|hammer|(table|shaker|drive)( [1-9][0-9]{0,3})?)$"),
        # A body's name is put into its number by the scene, which knows the names.
        WithJsonSchema({"type": "string"}),
    ]
    """A body, by its name or as body 1; table, hammer, shaker or drive: the force of a shaker of kind force, the
    voltage of its output."""
    accelerometer: Accelerometer | None = None
    """Sensor at a body or the table."""
    integrator: Integrator | None = None
    """Integrating amplifier at a body or the table."""
    hammer: Hammer | None = None
    """Force sensor, at the hammer or the shaker."""
    alarm: Limit | None = None
    """Limit of the measured quantity, in the channel's unit, above which the recording is marked [m, m/s,
    m/s^2, N or V]."""
    abort: Limit | None = None
    """Limit of the measured quantity, in the channel's unit, above which the test ends [m, m/s, m/s^2, N or V]."""
    coupling: Literal["AC", "DC"] | None = None
    """Coupling of this input alone; None: the converter's."""
    excitation: Supply | None = None
    """Current that feeds the sensor at this input [A], 0: none; None: the converter's."""

    @classmethod
    def kind_by_neighbours(cls, given: Mapping[str, Any]) -> Mapping[Place, Kind]:
        """Limits are in what the channel measures."""
        kind = {"1": VELOCITY, "2": LENGTH}.get(str(at(given, ("integrator", "order"))), ACCELERATION)
        what = str(given.get("at")).partition(" ")[0]
        kind = FORCE if what in FORCE_PLACES else VOLTAGE if what == VOLTAGE_PLACE else kind
        return {("alarm",): kind, ("abort",): kind}

    def relations(self) -> Iterable[Mistake]:
        """Check that the sensor suits the place."""
        if self.measures_voltage:
            for key in ("accelerometer", "integrator", "hammer"):
                if getattr(self, key) is not None:
                    yield Mistake(
                        (key,), "given at the drive; expected no sensor, for it is a voltage already"
                    )
        elif self.measures_force:
            for key in ("accelerometer", "integrator"):
                if getattr(self, key) is not None:
                    yield Mistake(
                        (key,), f"given at the {self.at}; expected hammer: with the keys of its force sensor"
                    )
        elif self.hammer is not None:
            yield Mistake(("hammer",), f"given at {self.at}; expected it at: hammer or at: shaker")

    @property
    def what(self) -> str:
        """Kind of place: body, table, hammer, shaker or drive."""
        return self.at.partition(" ")[0]

    @property
    def number(self) -> int | None:
        """Number of the body or the shaker it is at, from 1; None where it names none."""
        number = self.at.partition(" ")[2]
        return int(number) if number else None

    @property
    def measures_force(self) -> bool:
        """Whether its sensor is one of force: at the hammer or a shaker."""
        return self.what in FORCE_PLACES

    @property
    def measures_voltage(self) -> bool:
        """Whether it reads a voltage, that of an output."""
        return self.what == VOLTAGE_PLACE

    @property
    def body(self) -> int | None:
        """The body it is mounted on, from 1; None elsewhere."""
        return self.number if self.what == "body" else None


class DroppedBlock(Settings):
    """Samples that the converter loses, to test what becomes of a faulty acquisition."""

    at: Time
    """When, from the start of the acquisition [s]."""
    samples: Annotated[int, Field(ge=1, le=100_000_000)]
    """How many in each channel: a whole number, at least 1."""


class Converter(Settings):
    """The analogue-to-digital converter and its clock, common to all channels."""

    preset: Preset | None = None
    """A module, by its name, whose datasheet fills in what is not given here."""
    rate: Annotated[float, Quantity(FREQUENCY, above=0.0)] = 5120.0
    """Sample rate asked for [Hz]."""
    bits: Annotated[int, Field(ge=2, le=32)] | None = None
    """Resolution, a whole number such as 24; needs `range`. None: not quantised."""
    range: Annotated[float, Quantity(VOLTAGE, above=0.0)] | None = None
    """Voltage at full scale [V]; None: not clipped."""
    noise: Annotated[float, Quantity(VOLTAGE_NOISE, at_least=0.0)] | None = None
    """White noise density at the input [V/sqrt(Hz)]."""
    coupling: Literal["AC", "DC"] | None = None
    """Coupling of the inputs; AC: through a first-order high pass. None: DC."""
    ac_corner: Corner | None = None
    """Corner of that high pass [Hz]; None: 0.5."""
    excitation: Supply | None = None
    """Constant current that feeds IEPE sensors [A]; 0: none, None: they are fed somehow."""
    filter: Literal["delta_sigma"] | None = None
    """The decimation filter of a delta-sigma converter, which looks at the rig several times a sample where
    the rig oscillates fast for the sample rate, or the rate is low. None: no filter."""
    remove_delay: bool = False
    """Whether the filter's delay is taken out of the samples' times."""
    sampling: Literal["point", "average"] | None = None
    """What a sample is where there is no filter. point: the voltage at the instant of the sample, as in a real
    converter without a filter, which sees nothing of an impulse between two instants and folds back what is faster
    than half the rate; average: the mean voltage over the interval that ends at the sample, in which no impulse is
    lost. None: point in channels with an integrator, in whose signals no impulse is left, average in all others."""
    skew: Annotated[float | tuple[float, ...], Quantity(TIME, at_least=0.0, listed=True)] | None = None
    """Lateness of the channels' sampling instants [s]: of each channel relative to the one before it, or one
    value per channel."""
    clock_error: Annotated[float, Quantity(RATIO)] | None = None
    """Relative error of the sample clock's frequency (20 ppm = 2e-5)."""
    jitter: Time | None = None
    """Standard deviation of the sampling instants [s]."""
    dropped_blocks: tuple[DroppedBlock, ...] = ()
    """Samples to lose."""

    def relations(self) -> Iterable[Mistake]:
        """Check that nothing is given without what it belongs to, and that its module can do it."""
        unknown = list(unknown_preset(self.preset, "converter"))
        yield from unknown
        if not unknown:
            yield from self._too_fast()
            yield from self._filtered_already()
        if self.bits is not None and self.range is None and self.preset is None:
            yield Mistake(("bits",), "given without range, the voltage at full scale such as 5 V")
        if self.ac_corner is not None and self.coupling != "AC" and self.preset is None:
            yield Mistake(("ac_corner",), "given without coupling: AC")
        if self.clock_error is not None and abs(self.clock_error) >= 0.1:
            yield Mistake(("clock_error",), f"got {self.clock_error}; expected a small ratio such as 20 ppm")

    def _filtered_already(self) -> Iterable[Mistake]:
        sheet = {} if self.preset is None else data_sheet(self.preset, "converter").settings["converter"]
        named = self.filter or sheet.get("filter")
        if self.sampling is not None and named is not None:
            yield Mistake(
                ("sampling",),
                f"{self.sampling} with the filter {named}{'' if self.filter else f' of {self.preset}'}; expected "
                "one of the two, for a sample behind a filter is what the filter gives",
            )

    def _too_fast(self) -> Iterable[Mistake]:
        try:
            _ = self.sample_rate
        except SceneError as error:
            yield Mistake(("rate",), str(error))

    @property
    def sample_rate(self) -> float:
        """Rate of its samples [Hz]: as asked for or, from a module, the next one above that its clock allows."""
        if self.preset is None:
            return self.rate
        found = module(self.preset)
        assert found.inputs is not None  # as its data sheet has figures for a converter
        try:
            return found.inputs.rates.at_least(self.rate)
        except SceneError as error:
            raise SceneError(f"{error}, which is what {found.name} samples at") from None


class RecordingSettings(Settings):
    """What goes into the recording besides the channels."""

    display: bool = True
    """Channels thinned out for plots that need no configuration."""
    truth: bool = False
    """The true motion, under its own topics."""
    samples: Literal["float64", "float32", "counts"] | None = None
    """How samples are stored. None: counts where the converter has bits, else float64."""
