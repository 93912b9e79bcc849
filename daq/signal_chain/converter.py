"""The analogue-to-digital converter: its clock, and volts turned into counts."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from daq.dsp.circuit import high_pass
from daq.signal_chain.channel import ChannelInfo
from daq.signal_chain.stage import Stage
from rig.scene.measurement_chain import Converter as Settings
from rig.scene.presets import filled_in

Array = NDArray[np.float64]

DEFAULT_AC_CORNER = 0.5


@dataclass(frozen=True)
class SampleClock:
    """The rate of the samples."""

    rate: float
    """As stated: the requested rate or, of a module, the next rate above it that its clock divides to, Hz."""
    true_rate: float
    """With the clock's error, Hz. Everything on the bench runs at it, the drive as well."""

    @classmethod
    def of(cls, settings: Settings) -> SampleClock:
        """Find the rate of a converter.

        Raises
        ------
        SceneError
            If the module cannot sample that fast.

        Examples
        --------
        >>> SampleClock.of(Settings(preset="NI 9234", rate="8 kHz")).rate
        8533.333333333334
        >>> round(SampleClock.of(Settings(rate="5 kHz", clock_error="20 ppm")).true_rate, 6)
        5000.1
        """
        rate = settings.sample_rate
        return cls(rate, rate * (1.0 + (settings.clock_error or 0.0)))


def coupling(settings: Settings) -> tuple[Stage, ...]:
    """Describe the circuit between a converter's connector and its input: a capacitor, if it is AC coupled."""
    if settings.coupling != "AC":
        return ()
    corner = DEFAULT_AC_CORNER if settings.ac_corner is None else settings.ac_corner
    return (Stage("converter", (high_pass(corner, "AC coupling"),)),)


@dataclass(frozen=True)
class Conversion:
    """Converted samples of a block."""

    samples: Array | NDArray[np.int32]
    """Counts (int32) where the converter has bits, else volts (float64); shape (channels, samples)."""
    overload: NDArray[np.bool_]
    """Where the voltage was beyond the range; bool, shape (channels, samples)."""


def volts_per_count(settings: Settings) -> float | None:
    """Return the size of a count, V; None without bits and a range.

    >>> volts_per_count(Settings(bits=8, range="1 V"))
    0.0078125
    """
    if settings.bits is None or settings.range is None:
        return None
    return float(2.0 * settings.range / 2.0**settings.bits)


class Quantiser:
    """Quantises and clips; the most positive code is a count less than the range, as in two's complement.

    >>> quantiser = Quantiser(Settings(bits=8, range="1 V"), [])
    >>> block = quantiser.convert(np.array([[0.5, -0.004, 1.5]]))
    >>> block.samples, block.overload
    (array([[ 64,  -1, 127]], dtype=int32), array([[False, False,  True]]))
    """

    def __init__(self, settings: Settings, channels: Sequence[ChannelInfo]) -> None:
        clock = SampleClock.of(settings)
        settings = filled_in(settings)
        self._bits, self._range = settings.bits, settings.range
        self._count = volts_per_count(settings)
        self.channels = tuple(
            replace(channel, volts_per_count=self._count, range=self._range) for channel in channels
        )
        starts = [(round(block.at * clock.rate), block.samples) for block in settings.dropped_blocks]
        self.lost = _merged((first, first + samples - 1) for first, samples in sorted(starts))

    def convert(self, volts: Array) -> Conversion:
        """Convert a block of volts, shape (channels, samples)."""
        if self._range is None:
            return Conversion(volts, np.zeros(volts.shape, dtype=bool))
        if self._bits is None or self._count is None:
            samples = np.clip(volts, -self._range, self._range)
            return Conversion(samples, samples != volts)
        codes = volts / self._count
        np.rint(codes, out=codes)
        full = 2.0 ** (self._bits - 1)
        clipped = np.minimum(np.maximum(codes, -full), full - 1.0)
        return Conversion(clipped.astype(np.int32), clipped != codes)


def _merged(blocks: Iterable[tuple[int, int]]) -> tuple[tuple[int, int], ...]:
    """Join blocks that overlap or touch."""
    merged: list[tuple[int, int]] = []
    for first, last in blocks:
        if merged and first <= merged[-1][1] + 1:
            merged[-1] = (merged[-1][0], max(merged[-1][1], last))
        else:
            merged.append((first, last))
    return tuple(merged)
