"""Random and burst random: spectra averaged over blocks (Welch)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from analysis.responses.clean_stretches import cure, describe_flaws, settling
from analysis.responses.estimators import Averages, bins_of, block_spectra, window_of
from analysis.responses.systematic import in_counts, noise_gain
from analysis.responses.whole_stretches import WholeStretches, dampers_move
from rig.errors import RecordingError, SceneError

if TYPE_CHECKING:
    from daq.recording.markers import Marker
    from daq.recording.recording import Recording

# Default number of blocks: error bars of about 10 % at a coherence of 0.7, with the finest possible resolution.
DEFAULT_BLOCKS = 30
# The response to a burst has decayed if less than this part of it remains at the end of the block.
_LARGEST_RESIDUAL_SHARE = 0.02


def whole(rec: Recording, marker: Marker, channels: Sequence[str]) -> WholeStretches:
    """Process a random test as a whole, bursts included."""
    low, high = float(marker.fields["from"]), float(marker.fields["to"])
    stop = rec.samples if marker.last_sample is None else min(rec.samples, marker.stop)
    bursts = None
    if "block" in marker.fields:
        block = int(marker.fields["block"])
        bursts = block, int(np.ceil(float(marker.fields["burst"]) * block))
    return WholeStretches(
        tuple(channels), marker.first_sample, stop, low, high,
        settling(rec, channels, marker.first_sample, stop, low),
        bursts=bursts, label=rec.scene.name, warnings=dampers_move(rec),
    )  # fmt: skip


def averages(
    rec: Recording,
    marker: Marker,
    channels: Sequence[str],
    block: float | None = None,
    overlap: float = 0.5,
    progress: Callable[[int, int], None] | None = None,
    window: str = "hann",
) -> Averages:
    """Average the spectra of a random test.

    `block`: length of a block in s, for about 30 averages if omitted; `overlap`: as a fraction of the block. Bursts
    are blocks without overlap and window.
    """
    if not 0.0 <= overlap < 1.0:
        raise SceneError(f"overlap of {overlap:g}: expected 0 or more, below 1")
    if block is not None and not 0.0 < block < np.inf:
        raise SceneError(f"block of {block:g} s: expected a length above 0 s")
    first = marker.first_sample
    stop = rec.samples if marker.last_sample is None else min(rec.samples, marker.stop)
    burst = marker.fields.get("block")
    if burst is not None:
        size, step = int(burst), int(burst)
        weights = np.ones(size)
    else:
        wanted = block if block is not None else (stop - first) / rec.rate / (0.5 * DEFAULT_BLOCKS + 0.5)
        size = round(wanted * rec.rate)
        step = max(1, round(size * (1.0 - overlap)))
        weights = window_of(window, max(size, 1))
    low, high = float(marker.fields["from"]), float(marker.fields["to"])
    spoilt = settling(rec, channels, first, stop, low)
    first += -(-max((flaw.stop - first for flaw in spoilt), default=0) // step) * step
    count = (stop - first - size) // step + 1
    if size < 16 or count < 2:
        raise RecordingError(
            f"{rec.path}: {max(count, 0)} blocks of {size / rec.rate:.3g} s in {(stop - first) / rec.rate:.3g} s of "
            "random excitation are too few to average. Record longer or choose shorter blocks (--block)."
        )
    starts = [first + i * step for i in range(count)]
    summed = block_spectra(rec, channels, starts, step, weights, low, high, progress)
    spoilt_blocks = describe_flaws(rec, summed.flaws)
    notes = [f"The beginning left out: {describe_flaws(rec, spoilt)}."] if spoilt else []
    if summed.used < count:
        notes.append(f"{count - summed.used} of {count} blocks left out: {spoilt_blocks}.")
    if summed.used < 2:
        raise RecordingError(
            f"{rec.path}: fewer than two blocks are complete ({spoilt_blocks}). {cure(rec, summed.flaws)}, or choose "
            "shorter blocks (--block)."
        )
    width = bins_of(weights) * rec.rate / size
    leaks = burst is None or summed.left > _LARGEST_RESIDUAL_SHARE
    if burst is None:
        notes.append(
            f"Blocks of {size / rec.rate:.3g} s resolve {width:.3g} Hz: peaks narrower than that are smeared and too "
            "low, by the stated leakage. Leave out --block and --estimator for a response without leakage."
        )
    elif leaks:
        notes.append(
            f"{summed.left:.0%} of the response to a burst remain when the next begins, so the curve has leakage. Use "
            "longer blocks, a smaller burst share, multisine or stepped sine."
        )
    gain = noise_gain(in_counts(rec, channels, summed.squares))
    return replace(
        summed.averages,
        resolution=width if leaks else 0.0,
        warnings=tuple(notes),
        gain=np.repeat(gain[:, None], summed.averages.frequency.size, axis=1),
        unsmeared=whole(rec, marker, channels) if leaks else None,
    )
