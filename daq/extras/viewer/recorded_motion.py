"""Displacements of the bodies and the shaker table, and gaps of the dampers, estimated from a recording."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from daq.core.drawing.rig_view import RigMotion
from daq.core.recording.displacement import DisplacementFilter, motion_sources
from daq.core.recording.recording import Recording
from daq.core.recording.truth import points_of

# Number of samples in a block: half a megabyte a channel, which the cache holds.
BLOCK_SAMPLES = 1 << 16


class RecordedMotion:
    """The motion in a recording, read in blocks.

    Displacements are the recorded true motion, or are integrated from a channel; gaps are known only from the true
    motion.
    """

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        scene = recording.scene
        channels = list(recording.channels.values())
        self.sources = motion_sources(points_of(scene), channels, recording.has_truth)
        self.gaps_known = bool(scene.dampers) and recording.has_truth

    def segments(self, start: int, stop: int, step: int) -> Iterator[tuple[NDArray[np.int64], RigMotion]]:
        """Yield sample indices and motion for every `step`-th sample of [start, stop) that is not lost."""
        filters = {
            source.point: DisplacementFilter(source.quantity, self.recording.rate)
            for source in self.sources
            if source.channel is not None
        }
        for first in range(start, stop, BLOCK_SAMPLES):
            last = min(first + BLOCK_SAMPLES, stop)
            sample_numbers = np.arange(first + (-first) % step, last, step, dtype=np.int64)
            displacements = self._displacements(filters, first, last)
            motion = displacements[:, sample_numbers - first]
            gap = self.recording.truth("gap", first, last)[:, sample_numbers - first] if self.gaps_known else None
            complete = np.isfinite(motion).all(axis=0)
            if gap is not None:
                complete &= np.isfinite(gap).all(axis=0)
                gap = gap[:, complete]
            motion = motion[:, complete]
            bodies = self.recording.scene.structure.bodies
            yield sample_numbers[complete], RigMotion(motion[:bodies], motion[bodies:], gap)

    def _displacements(self, filters: dict[str, DisplacementFilter], first: int, last: int) -> NDArray[np.float64]:
        """Return displacements in m at samples [first, last), shape (sources, samples); NaN where samples were lost."""
        displacements = np.zeros((len(self.sources), last - first))
        if any(source.quantity == "truth" for source in self.sources):
            truth = dict(
                zip(self.recording.truth_points, self.recording.truth("displacement", first, last), strict=True)
            )
        for displacement, source in zip(displacements, self.sources, strict=True):
            if source.quantity == "truth":
                displacement[:] = truth[source.point]
            elif source.channel is not None:
                samples = self.recording.read(source.channel, first, last)
                lost = np.isnan(samples)
                # Lost samples are replaced by zero in the filter, because NaN would remain in its state.
                displacement[:] = filters[source.point].run(np.where(lost, 0.0, samples))
                displacement[lost] = np.nan
        return displacements
