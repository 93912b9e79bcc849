"""Profile control: prescribed spectra, joined by straight lines in log-log axes, and the common part of the tests."""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from rig.core.base.arrays import Array
from rig.core.settings.problems import KeyPath, Problem
from rig.core.settings.quantities import ACCELERATION, ACCELERATION_DENSITY, FREQUENCY, LENGTH, LEVEL, RATIO, VELOCITY
from rig.core.settings.quantity_field import Quantity
from rig.core.settings.settings import Settings

ChannelName = Annotated[str, Field(min_length=1, max_length=200)]
Frequencies = Annotated[
    tuple[Annotated[float, Quantity(FREQUENCY, above=0.0)], ...], Field(min_length=2, max_length=1000)
]
#: Maximum difference from a profile [dB].
Decibels = Annotated[float, Quantity(LEVEL, above=0.0)]
#: Levels of the first parts of a test, relative to the full level [dB].
Ramp = tuple[Annotated[float, Quantity(LEVEL, below=0.0)], ...]
Share = Annotated[float, Quantity(RATIO, above=0.0, below=1.0)]

_UNITS = {"density": "(m/s²)²/Hz", "acceleration": "m/s²", "velocity": "m/s", "displacement": "m"}


class Breakpoints(Settings):
    """Frequencies with one value each; the subclasses define the keys of the values."""

    value_keys: ClassVar[tuple[str, ...]]
    frequencies: Frequencies
    """Frequencies of the breakpoints, ascending [Hz]."""

    @property
    def key(self) -> str:
        """Key of the given values: one of `value_keys`."""
        return next(key for key in self.value_keys if getattr(self, key) is not None)

    def check_consistency(self) -> Iterable[Problem]:
        """Check that the frequencies ascend, and that each has a value."""
        values = getattr(self, self.key)
        if any(high <= low for low, high in zip(self.frequencies, self.frequencies[1:], strict=False)):
            yield Problem(("frequencies",), "not ascending. Give the breakpoints by increasing frequency.")
        if len(values) != len(self.frequencies):
            message = f"got {len(values)} values; expected {len(self.frequencies)}, one for each frequency"
            yield Problem((self.key,), message)

    @property
    def text(self) -> str:
        """Range of the values with their unit."""
        return range_text(getattr(self, self.key), _UNITS[self.key])

    def at(self, frequency: Array) -> Array:
        """Return the values at frequencies in Hz; beyond the breakpoints NaN."""
        logarithm = np.interp(np.log(frequency), np.log(self.frequencies), np.log(getattr(self, self.key)))
        margin = 1e-9 * self.frequencies[-1]
        inside = (frequency >= self.frequencies[0] - margin) & (frequency <= self.frequencies[-1] + margin)
        return np.where(inside, np.exp(logarithm), np.nan)


class DensityProfile(Breakpoints):
    """Power spectral density of an acceleration over frequency, straight between breakpoints in log-log axes."""

    value_keys: ClassVar = ("density",)
    density: tuple[Annotated[float, Quantity(ACCELERATION_DENSITY, above=0.0)], ...]
    """Power spectral density of the acceleration [(m/s²)²/Hz]."""


class MotionProfile(Breakpoints):
    """Amplitude of a motion over frequency, straight between breakpoints in log-log axes."""

    one_of: ClassVar = (("acceleration", "velocity", "displacement"),)
    value_keys: ClassVar = ("displacement", "velocity", "acceleration")
    acceleration: tuple[Annotated[float, Quantity(ACCELERATION, above=0.0)], ...] | None = None
    """Amplitude of the acceleration [m/s²]."""
    velocity: tuple[Annotated[float, Quantity(VELOCITY, above=0.0)], ...] | None = None
    """Instead of `acceleration`: amplitude of the velocity [m/s]."""
    displacement: tuple[Annotated[float, Quantity(LENGTH, above=0.0)], ...] | None = None
    """Instead of `acceleration`: amplitude of the displacement [m]."""

    def at(self, frequency: Array) -> Array:
        """Return the amplitude of the acceleration [m/s²] at frequencies in Hz; beyond the breakpoints NaN."""
        order = 2 - self.value_keys.index(self.key)
        return super().at(frequency) * (2.0 * np.pi * np.asarray(frequency)) ** order


class DensityLimit(DensityProfile):
    """Largest power spectral density of a channel; the drive is reduced where it would be exceeded (notching)."""

    channel: ChannelName
    """Name of the limited channel."""


class MotionLimit(MotionProfile):
    """Largest amplitude of a channel; the drive is reduced where it would be exceeded (notching)."""

    channel: ChannelName
    """Name of the limited channel."""


class Control(Settings):
    """The channels that are controlled to the profile."""

    channels: Annotated[tuple[ChannelName, ...], Field(min_length=1, max_length=64)]
    """Names of the channels."""
    combine: Literal["average", "maximum", "minimum"] = "average"
    """Combination of several control channels at each frequency."""

    def combined(self, values: Array) -> Array:
        """Return the mean, largest or smallest of the channels' values, shape (channels, ...)."""
        combinations: dict[str, Any] = {"average": np.mean, "maximum": np.max, "minimum": np.min}
        return np.asarray(combinations[self.combine](values, axis=0))


class ProfileControl:
    """Control of channels to a profile of densities or amplitudes; the subclasses define the keys."""

    if TYPE_CHECKING:
        control: Control
        profile: Breakpoints
        limits: tuple[DensityLimit | MotionLimit, ...]
        tolerance: float
        abort: float

    def check_consistency(self) -> Iterable[Problem]:
        """Check that the abort limit is above the tolerance."""
        if self.abort <= self.tolerance:
            message = f"got {self.abort:g} dB, which is not above the tolerance, {self.tolerance:g} dB. Increase it."
            yield Problem(("abort",), message)

    @property
    def details(self) -> tuple[str, ...]:
        """The limits of channels, in words."""
        return tuple(
            f"{limit.channel} limited to {limit.text} from {range_text(limit.frequencies, 'Hz')}"
            for limit in self.limits
        )

    @property
    def named_channels(self) -> Iterable[tuple[KeyPath, str]]:
        """The control and the limited channels."""
        for k, name in enumerate(self.control.channels):
            yield ("control", "channels", k), name
        for k, limit in enumerate(self.limits):
            yield ("limits", k, "channel"), limit.channel

    @property
    def profile_control(self) -> Self:
        """The test, because it has profile control."""
        return self

    @property
    def resolution(self) -> float | None:
        """Spacing of the lines of a density [Hz]; None for amplitudes."""
        return None

    def required(self, values: Array, frequency: Array) -> Array:
        """Return the ratio of required to measured values, for the control and each limited channel.

        The drive follows the smallest of these ratios; a ratio is infinite where its limit is not defined. `values`:
        densities or amplitudes of the channels as in `named_channels`, shape (channels, n); `frequency`: Hz, shape
        (n,). Returns shape (1 + limits, n).
        """
        count = len(self.control.channels)
        bounds = np.array([each.at(frequency) for each in (self.profile, *self.limits)])
        measured = np.concatenate([self.control.combined(values[:count])[None], values[count:]])
        return np.where(np.isfinite(bounds), bounds / np.maximum(measured, 1e-12 * bounds[0]), np.inf)

    def decibels(self, ratio: Array) -> Array:
        """Return ratios of the values in dB."""
        return np.asarray((20.0 if self.resolution is None else 10.0) * np.log10(ratio))


def range_text(values: Sequence[float], unit: str) -> str:
    """Return the smallest and the largest value with their unit; lengths of less than 0.1 m in mm.

    >>> range_text([2.6], "N"), range_text([8.0, 60.0], "Hz"), range_text([0.002, 0.001], "m")
    ('2.6 N', '8 to 60 Hz', '1 to 2 mm')
    """
    factor, unit = (1e3, "mm") if unit == "m" and max(values) < 0.1 else (1.0, unit)
    ends = dict.fromkeys(f"{factor * value:.3g}" for value in (min(values), max(values)))
    return f"{' to '.join(ends)} {unit}"


def limits_drive(control: Array, limited: Array, margin: float) -> NDArray[np.bool_]:
    """Return where a channel limits the drive (notching): it is near its limit, and the control below the profile.

    `control`, `limited`: required over measured values [dB] as `ProfileControl.required`; `margin`: distance of the
    channel to its limit that counts as near [dB].

    >>> limits_drive(np.array([2.0, -1.0, 3.0]), np.array([0.1, 0.1, 9.0]), 1.5).tolist()
    [True, False, False]
    """
    return np.asarray((control > 0.0) & (limited < margin), dtype=bool)
