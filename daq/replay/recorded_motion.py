"""Motion of the points of the rig, computed from a recording."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from daq.drawing.rig_view import RigPose
from daq.recording.displacement import HIGH_PASS_HZ, DisplacementEstimate
from daq.recording.truth import points_of

if TYPE_CHECKING:
    from daq.recording.recording import Recording

# Samples read at a time: a second or so at common rates, whatever the length of the recording.
BLOCK = 1 << 16


@dataclass(frozen=True)
class MotionSource:
    """Where the displacement of one point comes from."""

    point: str  # 'body 1', ..., 'table'
    channel: str | None
    """The channel it is read from; None for truth and for a point nobody watched."""
    quantity: str
    """'displacement', 'velocity', 'acceleration', 'truth' or 'nothing'."""

    @property
    def sentence(self) -> str:
        """Notes for the viewer."""
        if self.quantity == "truth":
            return "recorded truth"
        if self.quantity == "nothing":
            return "not measured, drawn at rest"
        if self.quantity == "displacement":
            return f"channel {self.channel}"
        times = {"velocity": "once", "acceleration": "twice"}[self.quantity]
        return (
            f"channel {self.channel}, {self.quantity} integrated {times} (high-passed at {HIGH_PASS_HZ:g} Hz)"
        )


class RecordedMotion:
    """Displacements of bodies and table, and the dampers' gaps, read from a recording in stretches.

    A displacement channel is preferred, then recorded truth, then a velocity or acceleration channel that is
    integrated here.

    Parameters
    ----------
    recording : Recording
        Its scene says which points there are.
    """

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        scene = recording.scene
        self.sources = tuple(self._source(point) for point in points_of(scene))
        self.gaps_known = bool(scene.dampers) and recording.has_truth

    def _source(self, point: str) -> MotionSource:
        at = {info.quantity: name for name, info in self.recording.channels.items() if info.at == point}
        if "displacement" in at:
            return MotionSource(point, at["displacement"], "displacement")
        if self.recording.has_truth:
            return MotionSource(point, None, "truth")
        for quantity in ("velocity", "acceleration"):
            if quantity in at:
                return MotionSource(point, at[quantity], quantity)
        return MotionSource(point, None, "nothing")

    def stretches(self, start: int, stop: int, step: int) -> Iterator[tuple[NDArray[np.int64], RigPose]]:
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
            picked = rows[:, instants - first]
            gap = self.recording.truth("gap", first, last)[:, instants - first] if self.gaps_known else None
            kept = np.isfinite(picked).all(axis=0)
            if gap is not None:
                kept &= np.isfinite(gap).all(axis=0)
                gap = gap[:, kept]
            picked = picked[:, kept]
            bodies = self.recording.scene.structure.bodies
            yield instants[kept], RigPose(picked[:bodies], picked[bodies:], gap)

    def _displacements(
        self, estimates: dict[str, DisplacementEstimate], first: int, last: int
    ) -> NDArray[np.float64]:
        """Displacement of each source's point at samples [first, last); NaN where samples were lost."""
        rows = np.zeros((len(self.sources), last - first))
        if any(source.quantity == "truth" for source in self.sources):
            truth = dict(
                zip(
                    self.recording.truth_points,
                    self.recording.truth("displacement", first, last),
                    strict=True,
                )
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
