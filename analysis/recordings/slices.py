"""A segment of a recording: some channels between two times, read in pieces."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from daq.recording.layout import refuse_reversed
from rig.errors import RecordingError, SceneError

if TYPE_CHECKING:
    from daq.recording.recording import Recording
    from daq.signal_chain.channel import ChannelInfo

# Samples of each channel in memory at a time.
PIECE = 1 << 16


@dataclass(frozen=True)
class Slice:
    """Channels and samples of a recording to export."""

    recording: Recording
    channels: tuple[str, ...]
    start: int
    stop: int  # first and one-past-last sample
    # called with the number of samples read since the last call, summed over the channels
    on_read: Callable[[int], None] = field(default=lambda samples: None, compare=False)

    @classmethod
    def of(
        cls,
        recording: Recording,
        channels: Sequence[str] | None = None,
        from_s: float | None = None,
        to_s: float | None = None,
    ) -> Slice:
        """Select channels (default: all) between two times in s (default: the whole recording)."""
        names = tuple(recording.channels if channels is None else channels)
        for name in names:
            if name not in recording.channels:
                known = ", ".join(recording.channels)
                raise SceneError(f"{recording.path}: no channel {name!r}. Choose one of {known}.")
        refuse_reversed(from_s, to_s)
        start = 0 if from_s is None else max(0, math.ceil(from_s * recording.rate))
        stop = recording.samples if to_s is None else min(recording.samples, math.ceil(to_s * recording.rate))
        if start >= stop:
            end = recording.samples / recording.rate
            raise SceneError(f"{recording.path}: no samples to export. Choose times from 0 s to {end:.6g} s.")
        recording.refuse_void(start, stop)
        return cls(recording, names, start, stop)

    @property
    def infos(self) -> list[ChannelInfo]:
        """Return the data sheets of the channels."""
        return [self.recording.channels[name] for name in self.channels]

    def pieces(self, names: Sequence[str]) -> Iterator[tuple[int, NDArray[np.float64]]]:
        """Yield the sample number and the samples (channels, piece) of each piece."""
        for first in range(self.start, self.stop, PIECE):
            last = min(first + PIECE, self.stop)
            yield first, np.array([self.recording.read(name, first, last) for name in names])
            self.on_read((last - first) * len(names))

    def whole(self, name: str) -> NDArray[np.float64]:
        """Read all samples of a channel."""
        samples = self.recording.read(name, self.start, self.stop)
        self.on_read(samples.size)
        return samples

    def need_all(self, form: str) -> None:
        """Reject a segment with lost samples for a format that cannot represent them."""
        for gap in self.recording.gaps:
            if (
                gap.first_sample < self.stop
                and gap.last_sample >= self.start
                and set(gap.channels) & {*self.channels}
            ):
                first, last = (at / self.recording.rate for at in (gap.first_sample, gap.last_sample + 1))
                raise RecordingError(
                    f"{self.recording.path}: the samples of {', '.join(gap.channels)} from {first:.6g} to "
                    f"{last:.6g} s are lost, which {form} cannot represent. Export another part (--from, --to), or "
                    "use .csv or .npz."
                )


def read_slices(
    rec: Recording, channels: Sequence[str], bounds: Iterable[tuple[int, int]]
) -> Iterator[NDArray[np.float64]]:
    """Yield the samples of each segment ``[start, stop)``.

    The starts do not decrease; segments may overlap. Yields shape (channels, stop - start), NaN where samples are lost
    or the recording has ended.
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


def hits(rec: Recording) -> list[tuple[int, int]]:
    """Return the first and last sample of every hit; a free decay is a hit of a single sample at its start."""
    marked = sorted((m.first_sample, m.end) for m in rec.markers if m.kind == "hit")
    if marked:
        return marked
    if not rec.test.drives:
        return [(0, 0)]
    raise RecordingError(
        f"{rec.path}: no free decay, and no hit is marked ({rec.test.name}). Record a scene with "
        "test: {kind: impulse, ...} or {kind: free, ...}."
    )
