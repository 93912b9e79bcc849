"""Impact test: frequency responses from hits with an instrumented hammer, as a whole or block by block."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy import fft

from analysis.responses.clean_stretches import cure, describe_flaws
from analysis.responses.estimators import Averages, bins_of, block_spectra, window_of
from analysis.responses.hits import Hits
from analysis.responses.local_models.local_spectra import SIDE
from analysis.responses.whole_stretches import WholeStretches, dampers_move
from rig.errors import RecordingError, SceneError

if TYPE_CHECKING:
    from daq.recording.recording import Recording


# The hit begins after this part (1/n) of a block.
_LEAD = 50
# A larger residual response at the end of a block causes leakage that is reported.
_LARGEST_RESIDUAL_SHARE = 0.02


def whole(rec: Recording, channels: Sequence[str]) -> WholeStretches:
    """Process all hits together; the response to a hit may overlap the next hit."""
    hits = Hits.of(rec)
    # Lowest frequency that the time between hits resolves.
    low = 4.0 * rec.rate / hits.interval
    return WholeStretches(
        tuple(channels), 0, rec.samples, low, hits.highest_frequency(rec), hits.missed, hits,
        label=rec.scene.name, warnings=dampers_move(rec),
    )  # fmt: skip


def averages(
    rec: Recording, channels: Sequence[str], block: float | None = None, window: str = "none"
) -> Averages:
    """Average the spectra of one block for each hit, as most programs do.

    `block`: length of a block in s; if omitted, the shortest time from a hit to the next hit, or to the end.
    """
    hits = Hits.of(rec)
    begins = [begin for begin, _ in hits.arrivals]
    size = hits.interval if block is None else round(block * rec.rate)
    lead = min(size // _LEAD, begins[0])
    starts = [begin - lead for begin in begins if begin - lead + size <= rec.samples]
    if size < 16 or not starts:
        raise SceneError(
            f"blocks of {size / rec.rate:.3g} s: expected at least 16 samples, and no more than the "
            f"{(rec.samples - begins[0]) / rec.rate:.4g} s that follow a hit"
        )
    weights = window_of(window, size)
    summed = block_spectra(rec, channels, starts, size, weights, 0.0, hits.highest_frequency(rec))
    spoilt = describe_flaws(rec, summed.flaws) or "the recording ends"
    if not summed.used:
        raise RecordingError(
            f"{rec.path}: no complete hit ({spoilt}). {cure(rec, summed.flaws)}, and record again."
        )
    notes = []
    if summed.used < len(begins):
        notes.append(f"{len(begins) - summed.used} of {len(begins)} hits left out: {spoilt}.")
    if summed.used == 1:
        notes.append("One block: its coherence is 1 whatever the noise, and the scatter is undetermined.")
    leaks = summed.left > _LARGEST_RESIDUAL_SHARE
    if leaks:
        notes.append(
            f"{summed.left:.0%} of the motion remain at the end of a block, so the curve has the stated leakage. Use "
            "longer blocks, or leave out --estimator for a response without leakage."
        )
    stretches = [(start, start + size) for start in starts]
    blocks = [np.stack([rec.read(name, *each) for name in channels]) for each in stretches]
    blocks = [np.nan_to_num(block - np.nanmean(block, axis=1, keepdims=True)) for block in blocks]
    spectra = [fft.rfft(block, axis=1) for block in blocks]
    lines = np.rint(summed.averages.frequency * size / rec.rate).astype(np.int64)
    return replace(
        summed.averages,
        resolution=bins_of(weights) * rec.rate / size if leaks else 0.0,
        warnings=tuple(notes),
        gain=hits.rounding(rec, channels, stretches, blocks, spectra, lines, SIDE),
        unsmeared=whole(rec, channels) if leaks else None,
    )
