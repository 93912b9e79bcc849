"""Motion of the points of the rig, computed from a recording."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from daq.drawing.rig_view import RigPose
from daq.recording.displacement import DisplacementEstimate, motion_sources
from daq.recording.truth import points_of

if TYPE_CHECKING:
    from daq.recording.recording import Recording

# Samples that are read at a time: about a second at common rates.
BLOCK = 1 << 16


class RecordedMotion:
    """Displacements of bodies and table, and the dampers' gaps, read from a recording in segments."""

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        scene = recording.scene
        channels = list(recording.channels.values())
        self.sources = motion_sources(points_of(scene), channels, recording.has_truth)
        self.gaps_known = bool(scene.dampers) and recording.has_truth

    def segments(self, start: int, stop: int, step: int) -> Iterator[tuple[NDArray[np.int64], RigPose]]:
        """Yield sample numbers and the motion there, for every `step`-th sample of [start, stop).

        Samples that the recording lost are left out.
        """
        estimates = {
            source.point: DisplacementEstimate(source.quantity, self.recording.rate)
            for source in self.sources
            if source.channel is not None
        }
        for first in range(start, stop, BLOCK):
            last = min(first + BLOCK, stop)
            instants = np.arange(first + (-first) % step, last, step, dtype=np.int64)
            rows = self._displacements(estimates, first, last)
            motion = rows[:, instants - first]
            gap = self.recording.truth("gap", first, last)[:, instants - first] if self.gaps_known else None
            complete = np.isfinite(motion).all(axis=0)
            if gap is not None:
                complete &= np.isfinite(gap).all(axis=0)
                gap = gap[:, complete]
            motion = motion[:, complete]
            bodies = self.recording.scene.structure.bodies
            yield instants[complete], RigPose(motion[:bodies], motion[bodies:], gap)

    def _displacements(self, estimates: dict[str, DisplacementEstimate], first: int, last: int) -> NDArray[np.float64]:
        """Displacement of each source's point at samples [first, last); NaN where samples were lost."""
        rows = np.zeros((len(self.sources), last - first))
        if any(source.quantity == "truth" for source in self.sources):
            truth = dict(
                zip(self.recording.truth_points, self.recording.truth("displacement", first, last), strict=True)
            )
        for row, source in zip(rows, self.sources, strict=True):
            if source.quantity == "truth":
                row[:] = truth[source.point]
            elif source.channel is not None:
                samples = self.recording.read(source.channel, first, last)
                lost = np.isnan(samples)
                # Lost samples count as zero in the filter, whose memory NaN would spoil.
                row[:] = estimates[source.point].run(np.where(lost, 0.0, samples))
                row[lost] = np.nan
        return rows
