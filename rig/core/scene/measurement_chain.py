"""Settings of the measurement chain: sensors, integrating amplifiers, converter, and content of the recording.

Omitted effects are not modeled: an accelerometer without keys measures the exact acceleration.
"""

from collections.abc import Iterable, Mapping
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, WithJsonSchema

from rig.core.base.errors import SceneError
from rig.core.data_sheets.data_sheets import Preset, check_preset, data_sheet
from rig.core.data_sheets.modules import module
from rig.core.settings.problems import KeyPath, Problem
from rig.core.settings.quantities import (
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
    SAMPLE_RATE,
    TEMPERATURE,
    TIME,
    VELOCITY,
    VOLTAGE,
    VOLTAGE_NOISE,
    Kind,
)
from rig.core.settings.quantity_field import Quantity
from rig.core.settings.settings import Settings, value_at

Corner = Annotated[float, Quantity(FREQUENCY, above=0.0)]
Tolerance = Annotated[float, Quantity(RATIO, at_least=0.0, below=1.0)]
Time = Annotated[float, Quantity(TIME, at_least=0.0)]
Limit = Annotated[float, Quantity(LENGTH, VELOCITY, ACCELERATION, FORCE, VOLTAGE, above=0.0)]
# Locations where a channel measures force instead of motion.
FORCE_LOCATIONS = ("hammer", "shaker")
# Location where a channel measures output voltage instead of motion.
VOLTAGE_LOCATION = "drive"
Supply = Annotated[float, Quantity(CURRENT, at_least=0.0)]


class Accelerometer(Settings):
    """A piezoelectric accelerometer with the figures of its data sheet; only the given effects are modeled."""

    preset: Preset | None = None
    """Name of a part whose data sheet supplies the values not given here."""
    sensitivity: Annotated[float, Quantity(ACCELERATION_SENSITIVITY, above=0.0)] | None = None
    """Nominal sensitivity [V per m/s²]; None: 1."""
    sensitivity_tolerance: Tolerance | None = None
    """Largest deviation of the true sensitivity, relative to `sensitivity`; the deviation is random (`seed`)."""
    resonance: Corner | None = None
    """Mounted resonance [Hz]."""
    q: Annotated[float, Quantity(RATIO, above=0.0)] | None = None
    """Quality factor of the resonance; None: 30."""
    low_cutoff: Corner | None = None
    """Corner frequency of the first-order high-pass filter [Hz]."""
    noise: Annotated[float, Quantity(ACCELERATION_NOISE, at_least=0.0)] | None = None
    """White noise density [m/s²/sqrt(Hz)]."""
    noise_corner: Corner | None = None
    """Frequency below which the power density of the noise rises as 1/f [Hz]; needs `noise`."""
    bias: Annotated[float, Quantity(VOLTAGE)] | None = None
    """Offset of the output at rest [V]."""
    bias_settling: Annotated[float, Quantity(TIME, above=0.0)] | None = None
    """Time constant with which the bias settles from zero after power-on [s]; needs `bias`."""
    transverse: Tolerance | None = None
    """Transverse sensitivity relative to the nominal sensitivity; its direction is random (`seed`)."""
    lateral: Annotated[float, Quantity(RATIO, at_least=0.0)] | None = None
    """Ratio of the lateral to the vertical acceleration of the mounting point (10 % if only `transverse` is given); the
    model of the structure has only vertical motion."""
    saturation: Annotated[float, Quantity(ACCELERATION, above=0.0)] | None = None
    """Largest acceleration that the output of the sensor follows [m/s²]; samples above it are marked as overloaded. A
    jump of the velocity by dv (impact of a damper) gives a peak of 2 pi f dv at the resonance f; without `resonance`,
    every impact overloads the sensor. The limit does not depend on the sample rate."""
    overload_recovery: Annotated[float, Quantity(TIME, above=0.0)] | None = None
    """Time constant of the recovery after saturation [s]; needs `saturation`."""
    temperature_drift: Annotated[float, Quantity(PER_KELVIN)] | None = None
    """Relative change of sensitivity per kelvin [1/K]; needs `temperature_change`."""
    temperature_change: Annotated[float, Quantity(TEMPERATURE)] | None = None
    """Temperature difference between sensor and calibration [K]."""
    iepe: bool | None = None
    """Whether the sensor's amplifier needs a supply current from the converter (`excitation`)."""

    needs: ClassVar[Mapping[str, str]] = {
        "q": "resonance",
        "noise_corner": "noise",
        "bias_settling": "bias",
        "lateral": "transverse",
        "overload_recovery": "saturation",
        "temperature_drift": "temperature_change",
    }

    def check_consistency(self) -> Iterable[Problem]:
        """Check that every key on which a given key depends is given too, unless a preset may supply it."""
        yield from check_preset(self.preset, "accelerometer")
        for key, other in self.needs.items():
            if self.preset is None and getattr(self, key) is not None and getattr(self, other) is None:
                yield Problem((key,), f"given without {other}. Add {other}, or remove {key}.")


class Integrator(Settings):
    """An integrating amplifier, downstream of the accelerometer."""

    order: Annotated[int, Field(ge=1, le=2)]
    """1: the output is proportional to velocity, 2: to displacement."""
    corner: Annotated[float, Quantity(FREQUENCY, at_least=0.0)] = 0.0
    """Corner frequency [Hz] of the first-order high-pass filter in each integration stage, which does not integrate
    below it; 0: the amplifier integrates at all frequencies."""
    low_cutoff: Corner | None = None
    """Corner frequency of the first-order high-pass filter at its input [Hz], which removes the sensor's bias."""
    gain: Annotated[float, Quantity(RATIO, above=0.0)] = 1.0
    """Output per integral of the input [1/s for order 1, 1/s^2 for order 2]."""
    noise: Annotated[float, Quantity(VOLTAGE_NOISE, at_least=0.0)] | None = None
    """White noise density at the output [V/sqrt(Hz)]."""
    saturation: Annotated[float, Quantity(VOLTAGE, above=0.0)] | None = None
    """Largest voltage of each integration stage [V], at any sample rate; samples that reach it are marked as
    overloaded."""


class Hammer(Settings):
    """A force sensor: in the head of an impulse hammer, or between a shaker and the body it pushes."""

    preset: Preset | None = None
    """Name of a part whose data sheet supplies the values not given here."""
    sensitivity: Annotated[float, Quantity(FORCE_SENSITIVITY, above=0.0)] | None = None
    """Nominal sensitivity [V/N]; None: 1."""
    sensitivity_tolerance: Tolerance | None = None
    """Largest deviation of the true sensitivity, relative to `sensitivity`; the deviation is random (`seed`)."""
    noise: Annotated[float, Quantity(FORCE_NOISE, at_least=0.0)] | None = None
    """White noise density [N/sqrt(Hz)]."""
    low_cutoff: Corner | None = None
    """Corner frequency of the first-order high-pass filter [Hz]."""
    saturation: Annotated[float, Quantity(FORCE, above=0.0)] | None = None
    """Largest force that the output of the sensor follows [N]; samples above it are marked as overloaded."""
    iepe: bool | None = None
    """Whether the sensor's amplifier needs a supply current from the converter (`excitation`)."""

    def check_consistency(self) -> Iterable[Problem]:
        """Check that the part is known."""
        return check_preset(self.preset, "hammer")


class Channel(Settings):
    """One measured signal: the point, its sensor and the integrating amplifier.

    At `shaker` the signal is the force of a shaker on its body, as a force sensor between its coil spring (stinger) and
    the body measures it. Without this channel, the force of a coil spring follows from the motion of its two ends,
    the table and the driven body. At `drive` the signal is the output voltage in front of a shaker, as on a teed
    cable. With several shakers, the location contains the shaker's number: `table 2`, `shaker 2`, `drive 2`.
    """

    name: Annotated[str, Field(max_length=80, pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]*$")]
    """A name of letters, digits, _, - and . for the channel in the recording."""
    at: Annotated[
        str,
        Field(pattern=r"^(body [1-9][0-9]{0,5}|hammer|(table|shaker|drive)( [1-9][0-9]{0,3})?)$"),
        # The schema also allows a body's name, which `Scene` replaces by its number.
        WithJsonSchema({"type": "string"}),
    ]
    """A location: a body (its name, or body 1), table, hammer, shaker (force of a shaker on its body) or drive (voltage
    of a shaker's output)."""
    accelerometer: Accelerometer | None = None
    """Sensor at a body or the table."""
    integrator: Integrator | None = None
    """Integrating amplifier at a body or the table."""
    hammer: Hammer | None = None
    """Force sensor of an impact hammer or of a shaker."""
    alarm: Limit | None = None
    """Limit of the measured quantity, in the channel's unit, above which the recording is marked [m, m/s,
    m/s², N or V]."""
    abort: Limit | None = None
    """Limit of the measured quantity, in the channel's unit, above which the test ends [m, m/s, m/s², N or V]."""
    coupling: Literal["AC", "DC"] | None = None
    """Coupling of this input, AC or DC; None: as the converter."""
    excitation: Supply | None = None
    """Supply current of the sensor at this input [A], 0: none; None: as the converter."""

    @classmethod
    def kinds_from_other_keys(cls, content: Mapping[str, Any]) -> Mapping[KeyPath, Kind]:
        """Return the kind of the limits `alarm` and `abort`, which is the kind of the measured quantity."""
        kind = {"1": VELOCITY, "2": LENGTH}.get(str(value_at(content, ("integrator", "order"))), ACCELERATION)
        location = str(content.get("at")).partition(" ")[0]
        kind = FORCE if location in FORCE_LOCATIONS else VOLTAGE if location == VOLTAGE_LOCATION else kind
        return {("alarm",): kind, ("abort",): kind}

    def check_consistency(self) -> Iterable[Problem]:
        """Check that the sensor suits the location."""
        if self.measures_voltage:
            for key in ("accelerometer", "integrator", "hammer"):
                if getattr(self, key) is not None:
                    yield Problem((key,), f"the drive is a voltage and needs no {key}. Remove {key}.")
        elif self.measures_force:
            for key in ("accelerometer", "integrator"):
                if getattr(self, key) is not None:
                    message = f"the channel at the {self.at} measures force. Replace {key} with hammer: and its keys."
                    yield Problem((key,), message)
        elif self.hammer is not None:
            yield Problem(
                ("hammer",),
                f"the key hammer is for force sensors, but the channel at {self.at} measures acceleration. Replace "
                "hammer with accelerometer, or give at: hammer.",
            )

    @property
    def place_kind(self) -> str:
        """Kind of the location: body, table, hammer, shaker or drive."""
        return self.at.partition(" ")[0]

    @property
    def number(self) -> int | None:
        """Number of the body or shaker at the location, from 1; None if the location has no number."""
        number = self.at.partition(" ")[2]
        return int(number) if number else None

    @property
    def measures_force(self) -> bool:
        """Return whether the channel measures force, at the hammer or a shaker."""
        return self.place_kind in FORCE_LOCATIONS

    @property
    def measures_voltage(self) -> bool:
        """Return whether the channel measures the voltage of an output."""
        return self.place_kind == VOLTAGE_LOCATION

    @property
    def body(self) -> int | None:
        """Number of the body on which the sensor is mounted, from 1; None at other locations."""
        return self.number if self.place_kind == "body" else None


class DroppedBlock(Settings):
    """Samples that the converter loses, to test how a faulty acquisition is handled."""

    at: Time
    """Time from the start of the acquisition [s]."""
    samples: Annotated[int, Field(ge=1, le=100_000_000)]
    """Number of samples in each channel: a whole number, at least 1."""


class Converter(Settings):
    """The analog-to-digital converter and its clock, common to all channels."""

    preset: Preset | None = None
    """Name of a module whose data sheet supplies the values not given here."""
    rate: Annotated[float, Quantity(SAMPLE_RATE, above=0.0)] = 5120.0
    """Requested sample rate [Hz]."""
    bits: Annotated[int, Field(ge=2, le=32)] | None = None
    """Number of bits, such as 24; one count is 2 `range` / 2^bits. Needs `range`. None: not quantized."""
    range: Annotated[float, Quantity(VOLTAGE, above=0.0)] | None = None
    """Voltage at full scale [V]; None: not clipped."""
    noise: Annotated[float, Quantity(VOLTAGE_NOISE, at_least=0.0)] | None = None
    """White noise density at the input [V/sqrt(Hz)]."""
    coupling: Literal["AC", "DC"] | None = None
    """Coupling of the inputs; AC: a first-order high-pass filter. None: DC."""
    ac_corner: Corner | None = None
    """Corner frequency of the high-pass filter of AC coupling [Hz]; None: 0.5."""
    excitation: Supply | None = None
    """Constant supply current of IEPE sensors [A]; 0: none, None: an external supply."""
    filter: Literal["delta_sigma"] | None = None
    """The decimation filter of a delta-sigma converter. The rig is evaluated several times per sample if it
    oscillates fast relative to the sample rate, or if the rate is low. None: no filter."""
    remove_delay: bool = False
    """Whether the time stamps are corrected for the filter's delay."""
    sampling: Literal["point", "average"] | None = None
    """Meaning of a sample without a filter. point: the voltage at the sampling instant, as in a real converter
    without a filter, which misses impulses between two instants and aliases frequencies above half the rate;
    average: the mean voltage over the interval that ends at the sample, which includes every impulse. None: point
    in channels with an integrator, whose signals contain no impulses, average in all others."""
    skew: Annotated[float | tuple[float, ...], Quantity(TIME, at_least=0.0, listed=True)] | None = None
    """Delay of the channels' sampling instants [s]: of each channel relative to the previous channel, or one
    value per channel."""
    clock_error: Annotated[float, Quantity(RATIO)] | None = None
    """Relative error of the sample clock's frequency (20 ppm = 2e-5)."""
    jitter: Time | None = None
    """Standard deviation of the errors of the sampling instants [s]."""
    dropped_blocks: tuple[DroppedBlock, ...] = ()
    """Blocks of samples that are lost, as in a real acquisition under load."""

    def check_consistency(self) -> Iterable[Problem]:
        """Check that every key on which a given key depends is given too, and that the module supports the values."""
        preset_problems = list(check_preset(self.preset, "converter"))
        yield from preset_problems
        if not preset_problems:
            yield from self._check_rate()
            yield from self._check_sampling()
        if self.bits is not None and self.range is None and self.preset is None:
            yield Problem(("bits",), "given without range. Add range, the full-scale voltage, such as 5 V.")
        if self.ac_corner is not None and self.coupling != "AC" and self.preset is None:
            yield Problem(("ac_corner",), "given without coupling: AC. Add coupling: AC, or remove ac_corner.")
        if self.clock_error is not None and abs(self.clock_error) >= 0.1:
            yield Problem(("clock_error",), f"got {self.clock_error}; expected less than 10 %, such as 20 ppm")

    def _check_sampling(self) -> Iterable[Problem]:
        preset_values = {} if self.preset is None else data_sheet(self.preset, "converter").settings["converter"]
        filter_name = self.filter or preset_values.get("filter")
        if self.sampling is not None and filter_name is not None:
            yield Problem(
                ("sampling",),
                f"got {self.sampling}, but the filter {filter_name}{'' if self.filter else f' of {self.preset}'} "
                f"determines the samples. Remove sampling{' or filter' if self.filter else ''}.",
            )

    def _check_rate(self) -> Iterable[Problem]:
        try:
            _ = self.sample_rate
        except SceneError as error:
            yield Problem(("rate",), str(error))

    @property
    def sample_rate(self) -> float:
        """Sample rate [Hz]: as requested or, for a module, the next higher rate of its clock."""
        if self.preset is None:
            return self.rate
        hardware = module(self.preset)
        assert hardware.inputs is not None  # the data sheet of a module specifies its inputs
        try:
            return hardware.inputs.rates.at_least(self.rate)
        except SceneError as error:
            raise SceneError(f"{error}, the range of sample rates of {hardware.name}") from None

    @property
    def true_rate(self) -> float:
        """True sample rate of readings and drive [Hz], which includes the error of the clock."""
        return self.sample_rate * (1.0 + (self.clock_error or 0.0))


class RecordingSettings(Settings):
    """Content of the recording in addition to the channels."""

    display: bool = True
    """Whether to record decimated channels, which a viewer plots without configuration."""
    truth: bool = False
    """Whether to record the true motion, in separate topics."""
    samples: Literal["float64", "float32", "counts"] | None = None
    """Data type of the stored samples. None: counts if the converter has bits, else float64."""
