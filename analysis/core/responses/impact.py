"""Impact test: frequency responses from impacts with an instrumented hammer, by local fits or by averages of blocks."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy import fft

from analysis.core.recordings.slices import read_slices
from analysis.core.responses.checks.channel_changes import Parts
from analysis.core.responses.checks.clean_segments import describe_flaws, remedy
from analysis.core.responses.estimator import Blocks, Estimator, Request
from analysis.core.responses.estimators import AveragedSpectra, block_spectra, noise_bandwidth_bins, sampled_window
from analysis.core.responses.hammer_impacts import HammerImpacts
from analysis.core.responses.impact_errors import rounding_gain_error
from analysis.core.responses.local_models.local_spectra import FIT_HALF_WIDTH
from analysis.core.responses.segment_fits import SegmentFits, warn_of_dampers
from daq.core.recording.recording import Recording
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import RecordingError, SceneError
from rig.core.results import format_percent
from rig.core.results.response import Response

# Length of a block, relative to its pretrigger (its samples before the impact).
_BLOCK_PER_PRETRIGGER = 50
# Largest response at the end of a block, relative to its maximum, without significant leakage (of this order).
_MAX_END_RATIO = 0.02


def segment_fits(rec: Recording, channels: Sequence[str]) -> SegmentFits:
    """Return the local fits to all impacts; the response to an impact may overlap the next impact."""
    impacts = HammerImpacts.of(rec)
    # Lowest frequency that is estimated: four periods between successive impacts.
    low = 4.0 * rec.rate / impacts.interval
    return SegmentFits(
        tuple(channels), 0, rec.samples, low, impacts.highest_frequency(rec), impacts.unmarked, impacts,
        warnings=warn_of_dampers(rec),
    )  # fmt: skip


def averaged_spectra(rec: Recording, channels: Sequence[str], blocks: Blocks) -> AveragedSpectra:
    """Average the spectra of blocks, one for each impact, as most analyzers do.

    Default length of a block: the shortest time from an impact to the next impact, or to the end.
    """
    impacts = HammerImpacts.of(rec)
    begins = [begin for begin, _ in impacts.arrivals]
    block_samples = impacts.interval if blocks.block is None else round(blocks.block * rec.rate)
    pretrigger = min(block_samples // _BLOCK_PER_PRETRIGGER, begins[0])
    starts = [begin - pretrigger for begin in begins if begin - pretrigger + block_samples <= rec.samples]
    if block_samples < 16 or not starts:
        raise SceneError(
            f"{rec.path}: block: got {block_samples / rec.rate:.3g} s; expected {16 / rec.rate:.3g} s (16 samples) to "
            f"{(rec.samples - begins[0]) / rec.rate:.4g} s (from the first impact to the end of the recording)"
        )
    weights = sampled_window(blocks.window or ESTIMATOR.window, block_samples)
    averaged = block_spectra(rec, channels, starts, block_samples, weights, 0.0, impacts.highest_frequency(rec))
    reasons = describe_flaws(rec, averaged.flaws) or "the recording ends"
    if not averaged.used:
        raise RecordingError(
            f"{rec.path}: no impact can be used ({reasons}). {remedy(rec, averaged.flaws)}, and record again."
        )
    notes = []
    if averaged.used < len(begins):
        notes.append(f"{len(begins) - averaged.used} of {len(begins)} impacts omitted: {reasons}.")
    if averaged.used == 1:
        notes.append(
            "Only one impact was used, so the coherence is 1 for any noise and the random error is unknown. "
            "Record more impacts."
        )
    has_leakage = averaged.end_ratio > _MAX_END_RATIO
    if has_leakage:
        notes.append(
            f"{format_percent(averaged.end_ratio)} of the peak response remains at the end of a block, so the curve "
            "has leakage. Use longer blocks, or omit `estimator`, `block` and `window` for a response without leakage."
        )
    segments = [(start, start + block_samples) for start in starts]
    lines = np.rint(averaged.spectra.frequency * block_samples / rec.rate).astype(np.int64)
    return replace(
        averaged.spectra,
        resolution=noise_bandwidth_bins(weights) * rec.rate / block_samples if has_leakage else 0.0,
        warnings=tuple(notes),
        rounding_gain_error=rounding_gain_error(
            impacts, rec, channels, segments, _readings(rec, channels, segments), lines, FIT_HALF_WIDTH
        ),
        leakage_free=segment_fits(rec, channels) if has_leakage else None,
        estimator=blocks.estimator or "H1",
    )


def _readings(
    rec: Recording, channels: Sequence[str], segments: Sequence[tuple[int, int]]
) -> Iterator[tuple[Array, ComplexArray]]:
    """Yield the readings of each segment, minus their mean, and their spectra."""
    for block in read_slices(rec, channels, segments):
        readings = np.nan_to_num(block - np.nanmean(block, axis=1, keepdims=True))
        yield readings, fft.rfft(readings, axis=1)


def _compute(request: Request) -> list[Response]:
    """Estimate the response to all impacts, by local models or from averaged blocks."""
    rec, channels, blocks = request.rec, request.channels, request.blocks
    is_local = blocks == Blocks()
    return request.compute([segment_fits(rec, channels) if is_local else averaged_spectra(rec, channels, blocks)])


def _parts(request: Request) -> list[Parts]:
    impacts = HammerImpacts.of(request.rec)
    begins = np.array([begin for begin, _ in impacts.arrivals])
    pretrigger = int(min(impacts.interval // _BLOCK_PER_PRETRIGGER, begins[0]))
    low, high = 4.0 * request.rec.rate / impacts.interval, impacts.highest_frequency(request.rec)
    return [Parts(begins - pretrigger, impacts.interval, low, high)]


ESTIMATOR = Estimator(
    _compute,
    "a block belongs to one impact",
    "local rational method",
    frozenset({"estimator", "block", "window"}),
    parts=_parts,
    resolves_between_lines=True,
    peak_remedy=lambda needed: "Record longer after each impact (test.interval)",
    line_remedy=lambda step: f"Record longer after each impact (test.interval: {1.0 / step:.2g} s or more).",
)
