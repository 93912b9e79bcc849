"""Impact test: frequency responses from hits with a force-measuring hammer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from analysis.responses.hits import Hits
from analysis.responses.whole_stretches import WholeStretches, dampers_move

if TYPE_CHECKING:
    from daq.recording.recording import Recording


def whole(rec: Recording, channels: Sequence[str]) -> WholeStretches:
    """Take all hits together, whatever rings from one into the next."""
    hits = Hits.of(rec)
    return WholeStretches(
        tuple(channels),
        0,
        rec.samples,
        hits.lowest_frequency(rec),
        hits.highest_frequency(rec),
        hits,
        label=rec.scene.name,
        warnings=dampers_move(rec),
    )
