"""A stretch of a recording: some of its channels from one time to another, read piece by piece."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rig.errors import RecordingError, SceneError

if TYPE_CHECKING:
    from daq.channel import ChannelInfo
    from daq.recording import Recording

# Samples in memory at a time, of each channel.
PIECE = 1 << 18


@dataclass(frozen=True)
class Stretch:
    """What of a recording is exported.

    Attributes
    ----------
    recording : Recording
        An open recording.
    channels : tuple of str
        Names of its channels.
    start, stop : int
        First sample, and the one after the last.
    """

    recording: Recording
    channels: tuple[str, ...]
    start: int
    stop: int

    @classmethod
    def of(
        cls,
        recording: Recording,
        channels: Sequence[str] | None = None,
        from_s: float | None = None,
        to_s: float | None = None,
    ) -> Stretch:
        """Take channels, by default all, between two times in s, by default from end to end.

        Raises
        ------
        SceneError
            If there is no such channel, or no sample between the times.
        """
        names = tuple(recording.channels if channels is None else channels)
        for name in names:
            if name not in recording.channels:
                known = ", ".join(recording.channels)
                raise SceneError(f"{recording.path} has no channel {name!r}; its channels are {known}")
        start = 0 if from_s is None else max(0, math.ceil(from_s * recording.rate))
        stop = recording.samples if to_s is None else min(recording.samples, math.ceil(to_s * recording.rate))
        if start >= stop:
            end = recording.samples / recording.rate
            raise SceneError(f"nothing to export: {recording.path} lasts from 0 s to {end:.6g} s")
        return cls(recording, names, start, stop)

    @property
    def infos(self) -> list[ChannelInfo]:
        """The channels' data sheets."""
        return [self.recording.channels[name] for name in self.channels]

    def pieces(self, names: Sequence[str]) -> Iterator[tuple[int, NDArray[np.float64]]]:
        """Yield sample number and samples (channels, piece), piece after piece."""
        for first in range(self.start, self.stop, PIECE):
            last = min(first + PIECE, self.stop)
            yield first, np.array([self.recording.read(name, first, last) for name in names])

    def need_all(self, form: str) -> None:
        """Refuse a stretch with lost samples for a format that has no way to say so."""
        for gap in self.recording.gaps:
            if (
                gap.first_sample < self.stop
                and gap.last_sample >= self.start
                and set(gap.channels) & {*self.channels}
            ):
                first, last = (at / self.recording.rate for at in (gap.first_sample, gap.last_sample + 1))
                raise RecordingError(
                    f"{self.recording.path} lacks {first:.6g} s to {last:.6g} s of "
                    f"{', '.join(gap.channels)}, which "
                    f"{form} cannot express; export a stretch without (--from, --to), or to .csv or .npz"
                )
