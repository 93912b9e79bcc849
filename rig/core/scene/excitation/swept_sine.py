"""A sine whose frequency sweeps from one end to the other."""

from collections.abc import Iterable
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from rig.core.base.arrays import Array
from rig.core.scene.excitation.kind import (
    Chirp,
    Drive,
    DrivenShaker,
    Duration,
    Force,
    Frequency,
    KindOfTest,
    Spacing,
    Start,
)
from rig.core.settings.problems import Problem


class FrequencySweep(KindOfTest):
    """A test whose tone sweeps from one end to the other; the subclasses define the level."""

    recorded_as: ClassVar = "sweep"
    single_tone: ClassVar = True
    kind: str
    start: Start = "settled"
    from_: Frequency = Field(alias="from")
    """First frequency [Hz]."""
    to: Frequency
    """Last frequency [Hz], above or below the first."""
    duration: Duration
    """Duration of the sweep [s]."""
    spacing: Spacing = "log"
    """Whether the frequency changes by equal steps (linear) or equal factors (log) in equal times."""

    @property
    def band(self) -> tuple[float, float]:
        """Lowest and highest frequency of the tone [Hz]."""
        return min(self.from_, self.to), max(self.from_, self.to)

    @property
    def sweep_direction(self) -> Literal["up", "down"]:
        """Direction of the sweep."""
        return "up" if self.from_ < self.to else "down"

    @property
    def rate_text(self) -> str:
        """Direction and rate of the sweep, in the unit in which the rate is constant."""
        rate = f"{60.0 * abs(np.log2(self.to / self.from_)) / self.duration:.3g} oct/min"
        if self.spacing == "linear":
            rate = f"{abs(self.to - self.from_) / self.duration:.3g} Hz/s"
        return f"{self.sweep_direction}ward at {rate}"

    def frequency_at(self, fraction: Any) -> Any:
        """Return the frequency [Hz] after a `fraction` of the duration: a number or an array, from 0 to 1."""
        if self.spacing == "linear":
            return self.from_ + (self.to - self.from_) * fraction
        return self.from_ * (self.to / self.from_) ** fraction

    def periods_at(self, fractions: Array) -> Array:
        """Return the number of periods of the tone since its start, at fractions, 0 to 1, of the sweep."""
        if self.spacing == "linear":
            return self.duration * (self.from_ * fractions + (self.to - self.from_) * fractions**2 / 2)
        log_ratio = np.log(self.to / self.from_)
        return np.asarray(self.duration * self.from_ * np.expm1(log_ratio * fractions) / log_ratio)

    def frequency_slope(self, frequency: Any) -> Any:
        """Return the change of the frequency per second, Hz/s, at a frequency in Hz, or several frequencies."""
        if self.spacing == "linear":
            return (self.to - self.from_) / self.duration
        return frequency * np.log(self.to / self.from_) / self.duration

    def wave(self, samples: int, rate: float) -> Chirp:
        """Return the tone at its instantaneous frequency; after the end of the sweep, its phase is constant."""
        progress = np.minimum(np.arange(samples) / rate / self.duration, 1.0)
        return Chirp(2.0 * np.pi * self.periods_at(progress), self.frequency_at(progress))


class SweptSine(FrequencySweep):
    """A sine whose frequency sweeps steadily from one end to the other, upward or downward."""

    one_of: ClassVar = (("force", "drive"),)
    kind: Literal["swept_sine"] = "swept_sine"
    # The controller identifies the shaker from both ends of its spring, so it does not use a force sensor.
    controls_by_cell: ClassVar = False
    force: Force | None = None
    """Amplitude of the force of the coil spring, which the controller keeps constant, or of a force shaker [N]."""
    drive: Drive | None = None
    """Instead of `force`: amplitude of the drive, open loop [V, m for a table shaker, or m/s² for a base]."""
    shaker: DrivenShaker = None

    @property
    def details(self) -> tuple[str, ...]:
        """Rate of the sweep."""
        return (self.rate_text,)

    def check_consistency(self) -> Iterable[Problem]:
        """Check that the two end frequencies differ."""
        if self.from_ == self.to:
            yield Problem(("to",), f"got {self.to:g} Hz, the same as `from`. Use kind: sine for a constant frequency.")
