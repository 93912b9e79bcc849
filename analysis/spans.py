"""Stretches of a recording, read once from front to back with bounded memory."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from daq.recording import Recording

BLOCK = 65536


def spans(
    rec: Recording, channels: Sequence[str], bounds: Iterable[tuple[int, int]]
) -> Iterator[NDArray[np.float64]]:
    """Yield the samples of each stretch ``[start, stop)``.

    Parameters
    ----------
    rec : daq.recording.Recording
        The recording.
    channels : sequence of str
        Names of the channels, in the order of the rows wanted.
    bounds : iterable of (start, stop)
        Sample numbers, with starts that never fall; stretches may overlap.

    Yields
    ------
    ndarray, shape (channels, stop - start)
        Physical units, NaN where samples are lost or the recording has ended.
    """
    source = _numbered(rec, channels)
    held: list[tuple[int, NDArray[np.float64]]] = []
    end = 0
    for start, stop in bounds:
        held = [(first, block) for first, block in held if first + block.shape[1] > start]
        while end < stop:
            found = next(source, None)
            if found is None:
                break
            end = found[0] + found[1].shape[1]
            if end > start:
                held.append(found)
        out = np.full((len(channels), stop - start), np.nan)
        for first, block in held:
            low, high = max(first, start), min(first + block.shape[1], stop)
            if high > low:
                out[:, low - start : high - start] = block[:, low - first : high - first]
        yield out


def _numbered(rec: Recording, channels: Sequence[str]) -> Iterator[tuple[int, NDArray[np.float64]]]:
    first = 0
    for block in rec.blocks(list(channels), BLOCK):
        yield first, block
        first += block.shape[1]
