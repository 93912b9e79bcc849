"""Random and burst random: spectra averaged over blocks (Welch)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from analysis.responses.block_spectra import bins_of, cross_spectra, window_of
from analysis.responses.clean_stretches import cure, describe_flaws
from analysis.responses.estimators import Averages
from analysis.responses.sensor_settling import settling
from analysis.responses.systematic import in_counts, noise_gain
from analysis.responses.whole_stretches import WholeStretches, dampers_move
from rig.errors import RecordingError, SceneError

if TYPE_CHECKING:
    from daq.recording.markers import Marker
    from daq.recording.recording import Recording

# Default number of blocks: error bars of about 10 % at a coherence of 0.7, with the finest possible resolution.
DEFAULT_BLOCKS = 30
# The response to a burst has decayed if less than this part of it remains at the end of the block.
_LEFT_OVER = 0.02


def whole(rec: Recording, marker: Marker, channels: Sequence[str]) -> WholeStretches:
    """Process a random test as a whole, bursts included."""
    low, high = float(marker.fields["from"]), float(marker.fields["to"])
    stop = min(rec.samples, rec.samples if marker.last_sample is None else marker.stop)
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
    forgetting: float | None = None,
    progress: Callable[[int, int], None] | None = None,
    window: str = "hann",
) -> Averages:
    """Average the spectra of a random test.

    `marker`: the ``measure`` marker of the test; `channels`: names of the channels to average; `block`: length of a
    block in s. If omitted, the length for about 30 averages, or the block of the bursts; `overlap`: overlap of
    successive blocks, from 0 to below 1, as a fraction of the block. Bursts do not overlap; `forgetting`: weight of
    each block relative to the next block, between 0 and 1: exponential averaging, for a structure that changes.
    Linear averaging if omitted; `window`: window of each block, by its name in `scipy.signal.get_window`; bursts
    have no window.
    """
    if not 0.0 <= overlap < 1.0:
        raise SceneError(f"overlap of {overlap:g}: expected 0 or more, below 1")
    if forgetting is not None and not 0.0 < forgetting < 1.0:
        raise SceneError(f"forgetting of {forgetting:g}: expected above 0 and below 1")
    if block is not None and not 0.0 < block < np.inf:
        raise SceneError(f"block of {block:g} s: expected a length above 0 s")
    first = marker.first_sample
    stop = min(rec.samples, rec.samples if marker.last_sample is None else marker.last_sample + 1)
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
            f"{(stop - first) / rec.rate:.3g} s of random hold {max(count, 0)} blocks of "
            f"{size / rec.rate:.3g} s, too few to average. Record longer or choose shorter blocks "
            "(--block)."
        )
    starts = [first + i * step for i in range(count)]
    summed = cross_spectra(rec, channels, starts, weights, low, high, forgetting, progress)
    found, left = summed.flaws, summed.left
    notes = [f"The beginning is excluded: {describe_flaws(rec, spoilt)}."] if spoilt else []
    if summed.used < count:
        notes.append(f"{count - summed.used} of {count} blocks left out: {describe_flaws(rec, found)}.")
    if summed.used < 2:
        raise RecordingError(
            f"only one block has no overloaded or lost samples: {describe_flaws(rec, found)}; "
            f"{cure(rec, found)}, or choose shorter blocks (--block)"
        )
    width = bins_of(weights) * rec.rate / size
    leaks = burst is None or left > _LEFT_OVER
    if burst is None:
        notes.append(
            f"Blocks of {size / rec.rate:.3g} s have a resolution of {width:.3g} Hz: narrower peaks are "
            "widened and too low, as stated by the leakage in the uncertainty. Omit --block and "
            "--estimator to avoid leakage."
        )
    if burst is not None and leaks:
        notes.append(
            f"{left:.0%} of the response to a burst remain when the next begins, which causes leakage "
            "as with continuous random. Use longer blocks, a smaller burst share, multisine or stepped "
            "sine."
        )
    return summed.averages(
        step,
        resolution=width if leaks else 0.0,
        label=rec.scene.name,
        warnings=tuple(notes),
        gain=np.repeat(
            noise_gain(in_counts(rec, channels, summed.squares))[:, None], summed.frequency.size, axis=1
        ),
        unsmeared=whole(rec, marker, channels) if leaks else None,
    )
