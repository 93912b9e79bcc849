"""Common part of tests with profile control: control and limited channels, tolerance and abort limit."""

from collections.abc import Iterable
from typing import TYPE_CHECKING, Self

import numpy as np

from rig.core.base.arrays import Array
from rig.core.scene.excitation.profile import Breakpoints, Control, DensityLimit, MotionLimit, limit_texts
from rig.core.settings.problems import KeyPath, Problem


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
        return limit_texts(self.limits)

    @property
    def named_channels(self) -> Iterable[tuple[KeyPath, str]]:
        """The control and the limited channels."""
        for k, name in enumerate(self.control.channels):
            yield ("control", "channels", k), name
        for k, limit in enumerate(self.limits):
            yield ("limits", k, "channel"), limit.channel

    @property
    def profile_control(self) -> Self:
        """The test itself."""
        return self

    @property
    def resolution(self) -> float | None:
        """Spacing of the lines of a density [Hz]; None for amplitudes."""
        return None

    def required(self, values: Array, frequency: Array) -> Array:
        """Return the ratio of required to measured values, for the control and each limited channel.

        Infinite without limit.

        The drive follows the smallest of these ratios. `values`: densities or amplitudes of the channels as in
        `named_channels`, shape (channels, n); `frequency`: Hz, shape (n,). Returns shape (1 + limits, n).
        """
        count = len(self.control.channels)
        bounds = np.array([each.at(frequency) for each in (self.profile, *self.limits)])
        measured = np.concatenate([self.control.combined(values[:count])[None], values[count:]])
        return np.where(np.isfinite(bounds), bounds / np.maximum(measured, 1e-12 * bounds[0]), np.inf)

    def decibels(self, ratio: Array) -> Array:
        """Return ratios of the values in dB."""
        return np.asarray((20.0 if self.resolution is None else 10.0) * np.log10(ratio))
