"""Slices of recordings: ranges of samples of selected channels, read in pieces."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Self

import numpy as np
from numpy.typing import NDArray

from daq.core.recording.layout import require_ordered_times
from daq.core.recording.markers import impacts_of
from daq.core.recording.recording import Recording
from daq.core.signal_chain.channel import ChannelInfo
from rig.core.base.arrays import Array
from rig.core.base.errors import RecordingError, SceneError

# Number of samples of each channel that are read at a time: half a megabyte, which the cache of the processor holds,
# and a whole number of lines of UFF text.
PIECE_SAMPLES = 1 << 16
# Smallest number of samples of each channel that are read at a time for successive short slices. A measured window of a
# dwell has about as many samples; samples between windows are not needed.
_READ_AHEAD_SAMPLES = 1 << 12


@dataclass(frozen=True)
class Slice:
    """A range of samples of selected channels of a recording, for export."""

    recording: Recording
    channels: tuple[str, ...]
    start: int  # first sample
    stop: int  # one past the last sample
    # called with the number of samples that were read since the previous call, summed over the channels
    on_read: Callable[[int], None] = field(default=lambda samples: None, compare=False)

    @classmethod
    def of(
        cls,
        recording: Recording,
        channels: Sequence[str] | None = None,
        from_s: float | None = None,
        to_s: float | None = None,
    ) -> Self:
        """Select channels (default: all) between two times in s (default: the whole recording)."""
        names = tuple(recording.channels if channels is None else channels)
        for name in names:
            if name not in recording.channels:
                available = ", ".join(recording.channels)
                raise SceneError(f"{recording.path}: no channel {name!r}. Choose one of {available}.")
        require_ordered_times(from_s, to_s)
        start = 0 if from_s is None else max(0, math.ceil(from_s * recording.rate))
        stop = recording.samples if to_s is None else min(recording.samples, math.ceil(to_s * recording.rate))
        if start >= stop:
            end = recording.samples / recording.rate
            limits = (("after", from_s), ("before", to_s))
            chosen = " and ".join(f"{word} {seconds:.6g} s" for word, seconds in limits if seconds is not None)
            raise SceneError(
                f"{recording.path}: no samples {chosen or 'in this file'}. Choose times from 0 s to {end:.6g} s."
            )
        recording.reject_mostly_lost(start, stop)
        return cls(recording, names, start, stop)

    @property
    def infos(self) -> list[ChannelInfo]:
        """Return the descriptions of the channels: sensor, sensitivity, range and response."""
        return [self.recording.channels[name] for name in self.channels]

    def pieces(self, names: Sequence[str]) -> Iterator[tuple[int, Array]]:
        """Yield the first sample index and the samples of each piece, shape (channels, samples), in physical units."""
        for first in range(self.start, self.stop, PIECE_SAMPLES):
            stop = min(first + PIECE_SAMPLES, self.stop)
            yield first, np.array([self.recording.read(name, first, stop) for name in names])
            self.on_read((stop - first) * len(names))

    def read_channel(self, name: str) -> Array:
        """Read all samples of a channel."""
        samples = self.recording.read(name, self.start, self.stop)
        self.on_read(samples.size)
        return samples

    def reject_gaps(self, file_format: str) -> None:
        """Reject a slice with lost samples for a file format that cannot represent them."""
        for gap in self.recording.gaps:
            if gap.first_sample < self.stop and gap.last_sample >= self.start and set(gap.channels) & {*self.channels}:
                first, last = (sample / self.recording.rate for sample in (gap.first_sample, gap.last_sample + 1))
                raise RecordingError(
                    f"{self.recording.path}: the samples of {', '.join(gap.channels)} from {first:.6g} to "
                    f"{last:.6g} s are lost, which {file_format} cannot represent. Export another part (`from_s`, "
                    "`to_s`), or use .csv, .npz or .mat."
                )


def read_slices(rec: Recording, channels: Sequence[str], bounds: Iterable[tuple[int, int]]) -> Iterator[Array]:
    """Yield the samples of each slice, from start to stop - 1, shape (channels, stop - start).

    `bounds`: start and stop of each slice. The starts must not decrease; slices may overlap. Samples that are lost or
    after the end of the recording are NaN.
    """
    first, buffer = 0, np.empty((len(channels), 0))
    for start, stop in bounds:
        begin = max(start, first + buffer.shape[1])
        first, buffer = start, buffer[:, start - first :]
        if min(stop, rec.samples) > begin:
            ahead = min(max(stop, begin + _READ_AHEAD_SAMPLES), rec.samples)
            kept, buffer = buffer, np.empty((len(channels), ahead - start))
            buffer[:, : begin - start] = kept
            for row, name in enumerate(channels):
                buffer[row, begin - start :] = rec.read(name, begin, ahead)
        samples = np.empty((len(channels), stop - start))
        available = buffer[:, : stop - start]
        samples[:, : available.shape[1]], samples[:, available.shape[1] :] = available, np.nan
        yield samples


def interpolated(samples: Array, is_valid: NDArray[np.bool_]) -> Array:
    """Return samples in which invalid samples are interpolated linearly; at least one sample must be valid.

    >>> interpolated(np.array([1.0, np.nan, 3.0]), np.array([True, False, True])).tolist()
    [1.0, 2.0, 3.0]
    """
    return np.interp(np.arange(samples.size), np.flatnonzero(is_valid), samples[is_valid])


def impact_ranges(rec: Recording) -> list[tuple[int, int]]:
    """Return the first and last sample of every impact; a free decay counts as one impact at sample 0."""
    ranges = [(impact.first_sample, impact.end) for impact in impacts_of(rec.markers)]
    if ranges:
        return ranges
    if not rec.test.drives:
        return [(0, 0)]
    raise RecordingError(
        f"{rec.path}: no free decay, and no impact is marked ({rec.test.name}). Record a scene with "
        "test: {kind: impulse, ...} or {kind: free, ...}."
    )
