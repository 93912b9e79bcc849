"""Random vibration control: the power spectral density at control channels follows a profile (IEC 60068-2-64)."""

from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from rig.core.scene.excitation.kind import MAX_STEPS, Count, DrivenShaker, Duration, KindOfTest, Start
from rig.core.scene.excitation.profile import (
    Control,
    Decibels,
    DensityLimit,
    DensityProfile,
    ProfileControl,
    Ramp,
    Share,
)
from rig.core.scene.shaker import Shaker
from rig.core.settings.problems import KeyPath
from rig.core.settings.quantities import RATIO
from rig.core.settings.quantity_field import Quantity


class RandomControl(ProfileControl, KindOfTest):
    """Noise whose power spectral density at control channels follows a profile, with limits of other channels."""

    kind: Literal["random_control"] = "random_control"
    recorded_as: ClassVar = "random"
    level_keys: ClassVar = ()
    kind_title: ClassVar = "random"
    start: Start = "settled"
    profile: DensityProfile
    """Power spectral density of the control channels: keys frequencies and density."""
    control: Control
    """Control channels: keys channels and combine."""
    limits: tuple[DensityLimit, ...] = ()
    """Largest power spectral densities of other channels: keys channel, frequencies and density."""
    ramp: Ramp = (-12.0, -6.0, -3.0)
    """Levels at which the drive is equalized before the full level [dB]."""
    hold: Duration = 10.0
    """Minimum time at each level of the ramp [s]."""
    duration: Duration
    """Duration at full level [s]."""
    lines: Annotated[int, Field(ge=4, le=MAX_STEPS)] = 200
    """Number of spectral lines of the profile."""
    averages: Count = 60
    """Number of spectra that are averaged for an update at full level."""
    clip: Annotated[float, Quantity(RATIO, above=1.0, infinite=True)] = 4.0
    """Drive clipping: largest drive over its root mean square (crest factor, "3 sigma" in other programs)."""
    speed: Annotated[float, Quantity(RATIO, above=0.0, below=1.0)] = 0.5
    """Gain of the control loop: fraction of the deviation from the profile that an update corrects."""
    tolerance: Decibels = 3.0
    """Tolerance of the profile [dB]."""
    abort: Decibels = 6.0
    """Abort limit [dB] of the excess of a line over the profile; see `abort_lines`."""
    abort_lines: Share = 0.1
    """The test is aborted if more than this fraction of the lines exceeds the profile by more than `abort`, plus twice
    the standard deviation of the averaged densities."""
    shaker: DrivenShaker = None

    def level_text(self, shaker: Shaker | None) -> str:
        """Return the root mean square of the profile."""
        return f"{self.rms():.2g} m/s² rms"

    @property
    def band(self) -> tuple[float, float]:
        """Lowest and highest frequency of the profile [Hz]."""
        return self.profile.frequencies[0], self.profile.frequencies[-1]

    @property
    def highest(self) -> tuple[KeyPath, float]:
        """Key path and value of the highest frequency [Hz]."""
        return ("profile", "frequencies"), self.band[1]

    @property
    def shortest(self) -> float:
        """Duration of the ramp and of the test at full level [s]."""
        return len(self.ramp) * self.hold + self.duration

    @property
    def resolution(self) -> float:
        """Spacing of the spectral lines [Hz]."""
        return (self.band[1] - self.band[0]) / self.lines

    def rms(self) -> float:
        """Return the root mean square acceleration of the profile [m/s²]."""
        # Ten points per line, because the profile is a power law between its breakpoints, not a straight line.
        frequency = np.linspace(*self.band, 10 * self.lines + 1)
        return float(np.sqrt(np.trapezoid(self.profile.at(frequency), frequency)))
