"""Stretches of a recording, each part of the file read once and with bounded memory."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from daq.recording import Recording

PIECE = 1 << 16


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
    held: dict[int, NDArray[np.float64]] = {}
    for start, stop in bounds:
        wanted = range(start // PIECE, -(-min(stop, rec.samples) // PIECE))
        held = {
            number: held[number] if number in held else _piece(rec, channels, number) for number in wanted
        }
        out = np.full((len(channels), stop - start), np.nan)
        for number, piece in held.items():
            first = number * PIECE
            low, high = max(first, start), min(first + piece.shape[1], stop)
            if high > low:
                out[:, low - start : high - start] = piece[:, low - first : high - first]
        yield out


def _piece(rec: Recording, channels: Sequence[str], number: int) -> NDArray[np.float64]:
    first, stop = number * PIECE, min((number + 1) * PIECE, rec.samples)
    return np.stack([rec.read(name, first, stop) for name in channels])
