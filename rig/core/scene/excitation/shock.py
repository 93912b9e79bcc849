"""Shocks: a half sine, or a transient with a prescribed shock response spectrum, replicated at a control channel."""

from collections.abc import Iterable
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from rig.core.base.arrays import Array
from rig.core.scene.excitation.kind import Count, DrivenShaker, Duration, KindOfTest, Start
from rig.core.scene.excitation.profile import Breakpoints, ChannelName, Decibels, Ramp
from rig.core.scene.shaker import Shaker
from rig.core.settings.problems import KeyPath, Problem
from rig.core.settings.quantities import ACCELERATION, RATIO
from rig.core.settings.quantity_field import Quantity
from rig.core.settings.settings import Settings

Acceleration = Annotated[float, Quantity(ACCELERATION, above=0.0)]
#: Amplitude of the compensating pulses before and after a half sine, relative to its peak.
COMPENSATION = 0.1
#: Position of the middle of a pulse in its interval.
PULSE_POSITION = 0.4
# Shortest interval between pulses, in widths of the half sine: a compensated pulse takes eleven widths.
_MIN_WIDTHS = 20.0
# Shortest interval between pulses, in periods of the lowest frequency of a spectrum.
_MIN_PERIODS = 20.0
# Number of frequencies per octave of a spectrum, as usual in shock tests.
_PER_OCTAVE = 6


class HalfSine(Settings):
    """A half-sine pulse of acceleration, compensated so that velocity and displacement end at zero."""

    peak: Acceleration
    """Peak of the acceleration [m/s²]."""
    width: Duration
    """Duration of the half sine [s]."""
    tolerance: Annotated[float, Quantity(RATIO, above=0.0)] = 0.2
    """Largest deviation from the pulse, relative to its peak."""

    def wave(self, time: Array) -> Array:
        """Return the compensated pulse [m/s²] with its middle at t = 0; `time`: s."""
        long = self.width / (2.0 * COMPENSATION)
        center = (self.width + long) / 2.0
        return self.peak * (
            _half_sine(time, self.width)
            - COMPENSATION * (_half_sine(time - center, long) + _half_sine(time + center, long))
        )


class ShockProfile(Breakpoints):
    """A maximax shock response spectrum, straight between breakpoints in log-log axes."""

    value_keys: ClassVar = ("acceleration",)
    acceleration: tuple[Acceleration, ...]
    """Largest acceleration of the oscillators [m/s²]."""
    q: Annotated[float, Quantity(RATIO, above=0.5)] = 10.0
    """Quality factor of the oscillators, 1 / (2 damping ratio)."""
    tolerance: Decibels = 3.0
    """Largest deviation from the spectrum [dB]."""

    @property
    def lines(self) -> Array:
        """Natural frequencies at which the spectrum is controlled, six per octave [Hz]."""
        low, high = self.frequencies[0], self.frequencies[-1]
        return np.geomspace(low, high, max(2, round(_PER_OCTAVE * np.log2(high / low)) + 1))


class Shock(KindOfTest):
    """Shocks whose pulse or spectrum is replicated at a channel, by the drive computed from weaker pulses."""

    one_of: ClassVar = (("half_sine", "spectrum"),)
    kind: Literal["shock"] = "shock"
    recorded_as: ClassVar = "shock"
    level_keys: ClassVar = ()
    start: Start = "settled"
    half_sine: HalfSine | None = None
    """Pulse with keys peak and width."""
    spectrum: ShockProfile | None = None
    """Instead of `half_sine`: shock response spectrum with keys frequencies and acceleration."""
    control: ChannelName
    """Name of the channel at which the shock is replicated."""
    repeats: Count = 3
    """Number of shocks at full level."""
    interval: Duration = 4.0
    """Time from one pulse to the next [s]."""
    practice: Ramp = Field((-12.0, -6.0), min_length=1)
    """Levels of the practice pulses relative to the shock [dB]."""
    shaker: DrivenShaker = None

    def check_consistency(self) -> Iterable[Problem]:
        """Check that pulses do not overlap."""
        if self.half_sine is not None:
            least = _MIN_WIDTHS * self.half_sine.width
        else:
            least = _MIN_PERIODS / self.spectrum.frequencies[0] if self.spectrum is not None else 0.0
        if self.interval < least:
            message = f"got {self.interval:g} s, which is too short for the pulse. Give at least {least:.3g} s."
            yield Problem(("interval",), message)

    @property
    def named_channels(self) -> Iterable[tuple[KeyPath, str]]:
        """The control channel."""
        return ((("control",), self.control),)

    @property
    def band(self) -> tuple[float, float]:
        """Lowest and highest frequency of the pulse's spectrum [Hz] as far as the sample rate permits."""
        if self.half_sine is not None:
            return 0.02 / self.half_sine.width, 1.5 / self.half_sine.width
        assert self.spectrum is not None
        return 0.5 * self.spectrum.frequencies[0], self.spectrum.frequencies[-1]

    @property
    def highest(self) -> tuple[KeyPath, float]:
        """Key path and value of the highest frequency [Hz]."""
        return ("half_sine", "width") if self.half_sine is not None else ("spectrum", "frequencies"), self.band[1]

    def sentence(self, shaker: Shaker | None) -> str:
        """Describe the test in words, without the band of its pulse."""
        return ", ".join((self.title, *self.details))

    @property
    def details(self) -> tuple[str, ...]:
        """The pulse or the spectrum, the control channel and the number of shocks."""
        repeats = f"{self.repeats} shock{'s' * (self.repeats != 1)}"
        pulse = self.half_sine
        if pulse is not None:
            shock = f"half sine of {pulse.peak:.3g} m/s² and {1e3 * pulse.width:.3g} ms"
        else:
            assert self.spectrum is not None
            shock = f"shock response spectrum of {self.spectrum.text}"
        return f"{shock} at {self.control}", repeats

    def pulse(self, time: Array) -> tuple[Array, float] | None:
        """Return the half sine and its tolerance [m/s²]."""
        pulse = self.half_sine
        return None if pulse is None else (pulse.wave(time), pulse.tolerance * pulse.peak)

    def shock_spectrum(self) -> tuple[Array, Array, float] | None:
        """Return frequencies [Hz], prescribed spectrum [m/s²] and its tolerance [dB]."""
        spectrum = self.spectrum
        return None if spectrum is None else (spectrum.lines, spectrum.at(spectrum.lines), spectrum.tolerance)

    @property
    def shortest(self) -> float:
        """Time of the practice pulses and the shocks [s]."""
        return (len(self.practice) + self.repeats) * self.interval


def _half_sine(time: Array, width: float) -> Array:
    """Return a half sine with a peak of 1 at t = 0."""
    return np.where(abs(time) < width / 2.0, np.cos(np.pi * time / width), 0.0)
