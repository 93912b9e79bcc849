"""The analogue-to-digital converter: volts turned into counts."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from rig.arrays import Array
from rig.scene.measurement_chain import Converter as Settings
from rig.scene.presets import filled_in


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

    >>> quantiser = Quantiser(Settings(bits=8, range="1 V"))
    >>> quantiser.convert(np.array([[0.5, -0.004, 1.5]]))
    (array([[ 64,  -1, 127]], dtype=int32), array([[False, False,  True]]))
    """

    def __init__(self, settings: Settings) -> None:
        settings = filled_in(settings)
        self._bits, self._range = settings.bits, settings.range
        self._count = volts_per_count(settings)
        starts = [
            (round(block.at * settings.sample_rate), block.samples) for block in settings.dropped_blocks
        ]
        self.lost = _merged((first, first + samples - 1) for first, samples in sorted(starts))

    def convert(self, volts: Array) -> tuple[Array | NDArray[np.int32], NDArray[np.bool_]]:
        """Return the volts, or counts where the converter has bits, and where the volts exceed the range."""
        if self._range is None:
            return volts, np.zeros(volts.shape, dtype=bool)
        if self._bits is None or self._count is None:
            samples = np.clip(volts, -self._range, self._range)
            return samples, samples != volts
        codes = volts / self._count
        np.rint(codes, out=codes)
        full = 2.0 ** (self._bits - 1)
        clipped = np.minimum(np.maximum(codes, -full), full - 1.0)
        return clipped.astype(np.int32), clipped != codes


def _merged(blocks: Iterable[tuple[int, int]]) -> tuple[tuple[int, int], ...]:
    """Join blocks that overlap or touch."""
    merged: list[tuple[int, int]] = []
    for first, last in blocks:
        if merged and first <= merged[-1][1] + 1:
            merged[-1] = (merged[-1][0], max(merged[-1][1], last))
        else:
            merged.append((first, last))
    return tuple(merged)
