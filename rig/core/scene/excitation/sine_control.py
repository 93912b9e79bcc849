"""Swept-sine control: the amplitude at control channels follows a profile (IEC 60068-2-6)."""

from collections.abc import Iterable
from typing import Annotated, ClassVar, Literal

from rig.core.scene.excitation.kind import DrivenShaker
from rig.core.scene.excitation.profile import Control, Decibels, MotionLimit, MotionProfile, ProfileControl
from rig.core.scene.excitation.swept_sine import FrequencySweep
from rig.core.scene.shaker import Shaker
from rig.core.settings.problems import Problem
from rig.core.settings.quantities import RATIO
from rig.core.settings.quantity_field import Quantity


class SineControl(ProfileControl, FrequencySweep):
    """A swept sine whose amplitude at control channels follows a profile, with limits of other channels."""

    kind: Literal["sine_control"] = "sine_control"
    level_keys: ClassVar = ()
    kind_title: ClassVar = "sine sweep"
    profile: MotionProfile
    """Amplitude of the control channels: keys frequencies, and acceleration, velocity or displacement."""
    control: Control
    """Control channels: keys channels and combine."""
    limits: tuple[MotionLimit, ...] = ()
    """Largest amplitudes of other channels: keys channel, frequencies, and acceleration, velocity or displacement."""
    speed: Annotated[float, Quantity(RATIO, above=0.0, below=1.0)] = 0.3
    """Gain of the controller, relative to the gain at its limit of stability; larger values follow resonances faster,
    with less margin (compressor speed in other programs)."""
    tolerance: Decibels = 3.0
    """Permissible deviation from the profile [dB]."""
    abort: Decibels = 6.0
    """Deviation above the profile at which the test ends [dB]."""
    shaker: DrivenShaker = None

    def check_consistency(self) -> Iterable[Problem]:
        """Check that the profile contains the sweep, and that the abort limit is above the tolerance."""
        low, high = min(self.from_, self.to), max(self.from_, self.to)
        if low == high:
            yield Problem(("to",), f"got {self.to:g} Hz, the same as `from`. Give another frequency.")
        if low < self.profile.frequencies[0] or high > self.profile.frequencies[-1]:
            ends = f"{self.profile.frequencies[0]:g} to {self.profile.frequencies[-1]:g} Hz"
            message = f"the profile from {ends} does not contain the sweep. Give breakpoints at `from` and `to`."
            yield Problem(("profile", "frequencies"), message)
        yield from super().check_consistency()

    def level_text(self, shaker: Shaker | None) -> str:
        """Return the amplitudes of the profile."""
        return self.profile.text

    @property
    def details(self) -> tuple[str, ...]:
        """Rate of the sweep, and the limits."""
        return self.rate_text, *super().details

    def rate_at(self, frequency: float) -> float:
        """Return the relative change of the frequency per second [1/s] at a frequency in Hz."""
        return float(abs(self.frequency_slope(frequency)) / frequency)
