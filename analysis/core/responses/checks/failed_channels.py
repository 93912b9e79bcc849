"""Detection of channels that fail during a test, for example because a cable breaks: their signal drops to noise.

Blocks at equal distances over the test contain every part of its excitation. A channel has failed if its signal is far
smaller in all blocks up to the end than in the blocks just before, while the motion continues. The failure begins in
the first of these last blocks.
"""

from collections.abc import Sequence
from weakref import WeakKeyDictionary

import numpy as np

from daq.core.recording.markers import Marker, impacts_of
from daq.core.recording.recording import Recording
from rig.core.base.arrays import Array

# Number of blocks of a test.
_BLOCKS = 64
# Shortest block, in samples.
_MIN_SAMPLES = 1024
# Shortest block, in periods of the lowest frequency.
_MIN_PERIODS = 4.0
# Minimum number of failed blocks at the end.
_MIN_FAILED = 2
# Maximum number of blocks before the failure with which the failed blocks are compared.
_COMPARED = 8
# Minimum number of blocks, or of impacts, in a test that is checked: with fewer, its parts cannot be compared.
_MIN_BLOCKS = 4
# A signal has failed if it is below this fraction of the previous signal: only noise and crosstalk remain.
_FAILED_RATIO = 0.01
# A signal that falls by more than this factor in several steps has settled; one that fails falls in one step, or in two
# at the beginning of a block.
_MAX_FALL = 10.0
# Smallest standard deviation of a channel before its failure [counts of the converter]; a smaller signal falls below
# half a count.
_MIN_COUNTS = 3.0
# Minimum ratio of the fall of a failed channel to that of another channel; otherwise, the excitation ended.
_MIN_CONTRAST = 10.0
# A reading is valid if it deviates this many times as far from the mean as any in the first failed block.
_PEAK_RATIO = 3.0

# For each open recording: the first invalid sample of each failed channel.
_failed_channels_of: WeakKeyDictionary[Recording, dict[str, int]] = WeakKeyDictionary()


def failed_channels(rec: Recording) -> dict[str, int]:
    """Return the first invalid sample of each failed channel; computed once while a file is open."""
    if rec not in _failed_channels_of:
        _failed_channels_of[rec] = _find(rec)
    return _failed_channels_of[rec]


def failed_channel_warnings(rec: Recording, names: Sequence[str], responses: Sequence[str]) -> list[str]:
    """Return a warning for each of the channels `names` that fails; `responses`: channels other than the reference."""
    warnings = []
    for name, first in failed_channels(rec).items():
        others = ", ".join(other for other in responses if other != name)
        remedy = (
            f"To use the other channels to the end, choose them (`response`: {others})."
            if name in responses and others
            else ""
        )
        if name in names:
            warnings.append(
                f"{name}: disconnected or failed from {first / rec.rate:.4g} s on; only the test before is used. Check "
                f"cable and sensor, and record again. {remedy}".rstrip()
            )
    return warnings


def _find(rec: Recording) -> dict[str, int]:
    """Compare the blocks at the end of a test with the previous blocks."""
    marks = [mark for mark in rec.markers if mark.kind in ("measure", "hit")]
    names = [name for name, info in rec.channels.items() if info.quantity != "voltage"]
    if not marks:
        return {}
    first, stop = marks[0].first_sample, rec.samples
    if marks[-1].kind == "measure" and marks[-1].last_sample is not None:
        stop = min(marks[-1].stop, rec.samples)
    samples = max(min(_block_samples(rec, marks), stop - first), 1)
    count = min(_BLOCKS, (stop - first) // samples)
    if count < _MIN_BLOCKS or (marks[0].kind == "hit" and len(marks) < _MIN_BLOCKS):
        return {}
    starts = first + np.arange(count) * ((stop - first) // count)
    levels = np.array([[_level(rec, name, start, samples) for start in starts.tolist()] for name in names])
    is_motion = np.array([rec.channels[name].quantity != "force" for name in names])
    failed = {}
    for row, name in enumerate(names):
        block = _first_failed_block(levels[row])
        info = rec.channels[name]
        min_level = 0.0 if info.volts_per_count is None else _MIN_COUNTS * info.unit_per_count
        if block is None or np.median(levels[row, max(block - 1 - _COMPARED, 0) : block - 1]) < min_level:
            continue
        # Motion is compared with other motion: beyond the last resonance, all motion falls while the force continues.
        others = is_motion if is_motion.sum() > is_motion[row] else ~is_motion
        others = others & (np.arange(len(names)) != row)
        falls = [_fall(level, block) for level in levels[others]]
        if min(falls, default=0.0) < _fall(levels[row], block) / _MIN_CONTRAST:
            failed[name] = _first_invalid_sample(rec, name, int(starts[block - 1]), int(starts[block]), samples)
    return failed


def _block_samples(rec: Recording, marks: Sequence[Marker]) -> int:
    """Return the length of a block. It contains a period, a burst or an impact, or several periods of a tone."""
    impacts = [mark.first_sample for mark in impacts_of(marks)]
    lengths = [_MIN_SAMPLES, *np.diff(impacts).tolist()]
    for mark in marks:
        lengths.append(mark.repeated_samples)
        if mark.lowest_frequency > 0.0:
            lengths.append(int(_MIN_PERIODS * rec.rate / mark.lowest_frequency))
    return max(lengths)


def _level(rec: Recording, name: str, start: int, samples: int) -> float:
    """Return the standard deviation of a block, NaN if all its samples are lost."""
    block = rec.read(name, start, start + samples)
    block = block[np.isfinite(block)]
    return float(block.std()) if block.size else np.nan


def _first_failed_block(levels: Array) -> int | None:
    """Return the first of the last blocks in which a channel has failed."""
    for block in range(_MIN_FAILED, levels.size - _MIN_FAILED + 1):
        # The block before the failure may be partly invalid.
        before = levels[max(block - 1 - _COMPARED, 0) : block - 1]
        falls = levels[max(block - 3, 0) : block] > _MAX_FALL * levels[max(block - 3, 0) + 1 : block + 1]
        has_settled = falls.sum() > 1 and (falls.size < 3 or falls[0])
        if levels[block:].max() < _FAILED_RATIO * before.min() and not has_settled:
            return block
    return None


def _fall(levels: Array, block: int) -> float:
    """Return the ratio of the median level before a block to the median level from this block on."""
    before = float(np.median(levels[max(block - 1 - _COMPARED, 0) : block - 1]))
    return before / max(float(np.median(levels[block:])), 1e-300)


def _first_invalid_sample(rec: Recording, name: str, first: int, last: int, samples: int) -> int:
    """Return the first invalid sample of a channel, between the first samples of two successive blocks."""
    readings = rec.read(name, first, min(last + samples, rec.samples))
    failed = readings[last - first :]
    is_valid = abs(readings - failed.mean()) > _PEAK_RATIO * abs(failed - failed.mean()).max()
    return first + int(np.flatnonzero(is_valid)[-1:].sum()) + 1
