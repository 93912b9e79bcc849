"""Random and burst random tests: local rational method for whole segments, or spectra averaged over blocks (Welch)."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from analysis.core.responses.checks.channel_changes import Parts, sections
from analysis.core.responses.checks.clean_segments import describe_flaws, remedy, settling_flaws
from analysis.core.responses.errors.systematic import noise_gain_error, power_in_counts
from analysis.core.responses.estimator import Blocks, Estimator, Request
from analysis.core.responses.estimators import AveragedSpectra, block_spectra, noise_bandwidth_bins, sampled_window
from analysis.core.responses.segment_fits import SegmentFits, warn_of_dampers
from daq.core.recording.markers import Marker
from daq.core.recording.recording import Recording
from rig.core.base.errors import RecordingError, SceneError
from rig.core.base.progress import CountProgress
from rig.core.results import format_percent
from rig.core.results.response import Response

# Default number of blocks, which are as long as possible: uncertainty of about 10 % at a coherence of 0.7.
DEFAULT_BLOCKS = 30
# Minimum number of samples in a block.
_MIN_BLOCK_SAMPLES = 16
# Largest response at the end of a block, relative to its maximum, that does not leak (error of this order).
_MAX_END_RATIO = 0.02


def segment_fits(rec: Recording, marker: Marker, channels: Sequence[str]) -> SegmentFits:
    """Return the local fits to a random test, bursts included."""
    low, high = float(marker.fields["from"]), float(marker.fields["to"])
    stop = rec.samples if marker.last_sample is None else min(rec.samples, marker.stop)
    bursts = _bursts(marker)
    return SegmentFits(
        tuple(channels), marker.first_sample, stop, low, high,
        settling_flaws(rec, channels, marker.first_sample, stop, low, bursts),
        bursts=bursts, warnings=warn_of_dampers(rec),
    )  # fmt: skip


def _bursts(marker: Marker) -> tuple[int, int] | None:
    """Return distance and duration of the bursts of a test [samples]; None for continuous noise."""
    if "block" not in marker.fields:
        return None
    block = int(marker.fields["block"])
    return block, int(np.ceil(float(marker.fields["burst"]) * block))


def averaged_spectra(
    rec: Recording, marker: Marker, channels: Sequence[str], blocks: Blocks, progress: CountProgress | None
) -> AveragedSpectra:
    """Average the spectra of a random test over blocks.

    Default of `blocks`: about 30 averages, overlap 0.5, window "hann". The options are ignored for bursts: each burst
    is a block without overlap or window.
    """
    block, overlap = blocks.block, 0.5 if blocks.overlap is None else blocks.overlap
    if not 0.0 <= overlap < 1.0:
        raise SceneError(f"overlap: got {overlap:g}; expected 0 or more, below 1")
    if block is not None and not 0.0 < block < np.inf:
        raise SceneError(f"block: got {block:g} s; expected more than 0 s")
    first = marker.first_sample
    stop = rec.samples if marker.last_sample is None else min(rec.samples, marker.stop)
    burst_block = marker.fields.get("block")
    if burst_block is not None:
        block_samples, step = int(burst_block), int(burst_block)
        weights = np.ones(block_samples)
    else:
        block_s = block if block is not None else (stop - first) / rec.rate / (0.5 * DEFAULT_BLOCKS + 0.5)
        block_samples = round(block_s * rec.rate)
        step = max(1, round(block_samples * (1.0 - overlap)))
        weights = sampled_window(blocks.window or ESTIMATOR.window, max(block_samples, 1))
    low, high = float(marker.fields["from"]), float(marker.fields["to"])
    unsettled = settling_flaws(rec, channels, first, stop, low, _bursts(marker))
    # The first block begins a whole number of steps later, when all channels have settled.
    first += -(-max((flaw.stop - first for flaw in unsettled), default=0) // step) * step  # rounded up
    count = (stop - first - block_samples) // step + 1
    block_s = block_samples / rec.rate
    if block_samples < _MIN_BLOCK_SAMPLES:
        raise RecordingError(
            f"{rec.path}: a block has {block_samples} samples ({block_s:.3g} s); expected at least "
            f"{_MIN_BLOCK_SAMPLES}. Choose longer blocks (`block`) or record longer."
        )
    if count < 2:
        shorter_blocks = " or choose shorter blocks (`block`)" if burst_block is None else ""
        raise RecordingError(
            f"{rec.path}: {max(count, 0)} blocks of {block_s:.3g} s in {(stop - first) / rec.rate:.3g} s of "
            f"random excitation are too few to average. Record longer{shorter_blocks}."
        )
    starts = [first + i * step for i in range(count)]
    averaged = block_spectra(rec, channels, starts, step, weights, low, high, progress)
    reasons = describe_flaws(rec, averaged.flaws)
    notes = [f"The beginning is omitted: {describe_flaws(rec, unsettled)}."] if unsettled else []
    if averaged.used < count:
        notes.append(f"{count - averaged.used} of {count} blocks omitted: {reasons}.")
    if averaged.used < 2:
        raise RecordingError(
            f"{rec.path}: fewer than two blocks are usable ({reasons}). {remedy(rec, averaged.flaws)}, or choose "
            "shorter blocks (`block`)."
        )
    resolution = noise_bandwidth_bins(weights) * rec.rate / block_samples
    has_leakage = burst_block is None or averaged.end_ratio > _MAX_END_RATIO
    if burst_block is None:
        notes.append(
            f"Blocks of {block_s:.3g} s resolve {resolution:.3g} Hz: narrower peaks appear wider and lower, within "
            "the stated leakage. Omit `estimator`, `block`, `overlap` and `window` for a response without leakage."
        )
    elif has_leakage:
        notes.append(
            f"{format_percent(averaged.end_ratio)} of the response to a burst remains when the next begins, so the "
            "curve has leakage. Use longer blocks, a shorter burst in each block (test.burst), multisine or "
            "stepped sine."
        )
    rounding_gain_error = noise_gain_error(power_in_counts(rec, channels, averaged.mean_squares))
    return replace(
        averaged.spectra,
        resolution=resolution if has_leakage else 0.0,
        warnings=tuple(notes),
        rounding_gain_error=np.repeat(rounding_gain_error[:, None], averaged.spectra.frequency.size, axis=1),
        leakage_free=segment_fits(rec, marker, channels) if has_leakage else None,
        estimator=blocks.estimator or "H1",
    )


def _compute(request: Request) -> list[Response]:
    """Estimate the response of each measurement, by local models or from averaged blocks."""
    blocks, rec, channels = request.blocks, request.rec, request.channels
    if blocks == Blocks():
        return request.compute(segment_fits(rec, marker, channels) for marker in request.measured)
    return request.compute(
        averaged_spectra(rec, marker, channels, blocks, request.progress) for marker in request.measured
    )


def _parts(request: Request) -> list[Parts]:
    """Return the bursts of each measurement, or sections of a measurement without bursts."""
    parts = []
    for fit in (segment_fits(request.rec, marker, request.channels) for marker in request.measured):
        if fit.bursts is None:
            parts.append(sections(request.rec, request.channels, fit.first, fit.stop, fit.low, fit.high))
        else:
            period, _ = fit.bursts
            starts = np.arange(fit.first, fit.stop - period + 1, period)
            parts.append(Parts(starts, period, fit.low, fit.high))
    return parts


ESTIMATOR = Estimator(
    _compute,
    "a random test is processed as a whole, by the local rational method",
    "local rational method",
    frozenset({"estimator", "block", "overlap", "window"}),
    window="hann",
    parts=_parts,
)
