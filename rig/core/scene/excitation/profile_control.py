"""Common part of tests with profile control: control and limited channels, tolerance and abort line."""

from collections.abc import Iterable
from typing import TYPE_CHECKING

from rig.core.scene.excitation.profile import Control, DensityLimit, MotionLimit, limit_texts
from rig.core.settings.problems import KeyPath, Problem


class ProfileControl:
    """Control of channels at a profile; the subclasses define the keys."""

    if TYPE_CHECKING:
        control: Control
        limits: tuple[DensityLimit | MotionLimit, ...]
        tolerance: float
        abort: float

    def check_abort(self) -> Iterable[Problem]:
        """Check that the abort line lies above the tolerance."""
        if self.abort <= self.tolerance:
            message = f"got {self.abort:g} dB, which is not above the tolerance, {self.tolerance:g} dB. Increase it."
            yield Problem(("abort",), message)

    @property
    def details(self) -> tuple[str, ...]:
        """The limits of channels, in words."""
        return limit_texts(self.limits)

    @property
    def named_channels(self) -> Iterable[tuple[KeyPath, str]]:
        """The control and the limited channels."""
        for k, name in enumerate(self.control.channels):
            yield ("control", "channels", k), name
        for k, limit in enumerate(self.limits):
            yield ("limits", k, "channel"), limit.channel
