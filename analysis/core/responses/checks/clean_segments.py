"""Segments of a recording without *flaws*: overloads, lost samples, settling and failed sensors of some channels."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from analysis.core.recordings.slices import read_slices
from analysis.core.responses.checks.failed_channels import failed_channels
from daq.core.recording.recording import Recording
from rig.core.base.arrays import Array
from rig.core.settings.quantities import ACCELERATION, FORCE, parse

# Reasons of flaws. A sensor is *settling* until its bias is constant.
OVERLOADED = "overloaded"
LOST = "lost"
SETTLING = "settling"
FAILED = "disconnected or failed"
# Number of blocks (periods of the lowest frequency) in the second half that determine mean and scatter after settling.
_SETTLED_BLOCKS = 32
# The second half of a test with at least this number of blocks is assumed to be settled.
_MIN_BLOCKS = 16
# A block drifts if its mean deviates from that of settled blocks by more than this number of their standard deviations.
_DRIFT_SIGMAS = 5.0
# Number of successive blocks without drift after which a channel is settled: a single block can agree by chance.
_SETTLED_IN_A_ROW = 3


@dataclass(frozen=True)
class Flaw:
    """Samples ``[first, stop)`` that do not measure the motion, with the reason."""

    first: int
    stop: int
    channel: str
    reason: str  # `OVERLOADED`, `LOST`, `SETTLING`, or another phrase that follows the name of the channel

    @property
    def description(self) -> str:
        """Channel and reason, for messages."""
        return f"{'samples of ' if self.reason == LOST else ''}{self.channel} {self.reason}"


def find_flaws(rec: Recording, channels: Collection[str], first: int, stop: int) -> list[Flaw]:
    """Return overloads, lost samples and failed channels between two samples, sorted by their first sample."""
    all_flaws = [
        Flaw(marker.first_sample, marker.stop, str(marker.fields.get("channel", "")), OVERLOADED)
        for marker in rec.overloads
        if marker.fields.get("channel") in channels
    ]
    all_flaws += [
        Flaw(gap.first_sample, gap.last_sample + 1, next(name for name in gap.channels if name in channels), LOST)
        for gap in rec.gaps
        if set(gap.channels) & set(channels)
    ]
    all_flaws += [Flaw(k, rec.samples, name, FAILED) for name, k in failed_channels(rec).items() if name in channels]
    return sorted((flaw for flaw in all_flaws if flaw.first < stop and flaw.stop > first), key=lambda flaw: flaw.first)


def clean_segments(all_flaws: list[Flaw], first: int, stop: int) -> list[tuple[int, int]]:
    """Return the segments (start, stop) between two samples that contain no flaw.

    >>> clean_segments([Flaw(20, 30, "a", "lost"), Flaw(25, 40, "b", "overloaded")], 0, 100)
    [(0, 20), (40, 100)]
    """
    clean, start = [], first
    for flaw in all_flaws:
        if flaw.first > start:
            clean.append((start, min(flaw.first, stop)))
        start = max(start, flaw.stop)
    return [*clean, (start, stop)] if start < stop else clean


def describe_flaws(rec: Recording, all_flaws: Sequence[Flaw]) -> str:
    """Describe the flaws and their times: ``a3 overloaded (at 1.2 s, 4.5 s), samples of a1 lost (at 7 s)``."""
    groups: dict[str, list[str]] = {}
    for flaw in all_flaws:
        times = groups.setdefault(flaw.description, [])
        # A flaw may affect several parts of a test.
        if (time := f"{flaw.first / rec.rate:.4g} s") not in times:
            times.append(time)
    return ", ".join(
        f"{description} (at {', '.join(times[:3])}{f' and {len(times) - 3} other times' if len(times) > 3 else ''})"
        for description, times in groups.items()
    )


def remedy(rec: Recording, all_flaws: Sequence[Flaw]) -> str:
    """Return a sentence without full stop that describes the remedy for flaws."""
    reasons = {flaw.reason for flaw in all_flaws}
    limits = []
    for name in dict.fromkeys(flaw.channel for flaw in all_flaws if flaw.reason == OVERLOADED):
        info = rec.channels[name]
        kind = {"acceleration": ACCELERATION, "force": FORCE}.get(info.quantity)
        for key, text in info.sensor.items():
            if not key.endswith(".saturation"):
                continue
            # A sensor limits the signal only if its limit is below the range of the converter.
            if kind is None or info.range is None or parse(text, kind) * info.sensitivity < info.range:
                limits.append(f"{name} up to {text}")
    sensor = f", or use a sensor of a larger range ({', '.join(limits)})" if limits else ""
    remedies = {
        OVERLOADED: f"lower the level, widen the range (converter: range){sensor}",
        SETTLING: "switch the sensors on earlier",
        FAILED: "check cable and sensor",
    }
    text = ", and ".join(remedies[reason] for reason in remedies if reason in reasons)
    text = text or "check the recording with `daq info`"
    return text[0].upper() + text[1:]


def settling_flaws(
    rec: Recording, names: Sequence[str], first: int, stop: int, lowest: float, bursts: tuple[int, int] | None = None
) -> list[Flaw]:
    """Return a flaw at the beginning of a test for each channel whose bias is not constant there.

    `lowest`: lowest excited frequency [Hz]. Over a period of this frequency, the mean of the motion is zero. A mean
    that differs from later means is therefore an error of the sensor, and in a force channel an apparent force.
    `bursts`: distance and duration of the bursts [samples]; the means of the pauses have almost no scatter.
    """
    stop = min([stop, *(failed for name, failed in failed_channels(rec).items() if name in names)])
    block_samples = int(np.ceil(rec.rate / lowest))
    distance, duration = bursts or (stop - first, stop - first)
    starts = range(0, stop - first - block_samples + 1, block_samples)
    blocks = [
        (first + start, first + start + block_samples)
        for start in starts
        if start % distance + block_samples <= duration
    ]
    n_blocks = len(blocks)
    if n_blocks < _MIN_BLOCKS:
        return []
    late_blocks = np.unique(np.linspace(n_blocks // 2, n_blocks - 1, _SETTLED_BLOCKS).astype(int))
    means = [_means(block) for block in read_slices(rec, names, [blocks[k] for k in late_blocks])]
    # A channel without any valid sample has no mean; the masked array avoids numpy's warning.
    settled_means = np.ma.masked_invalid(means)
    mean, scatter = settled_means.mean(axis=0).filled(np.nan), settled_means.std(axis=0).filled(np.nan)
    n_drift_blocks, n_settled_in_a_row = np.zeros(len(names), dtype=int), np.zeros(len(names), dtype=int)
    is_settled = np.zeros(len(names), dtype=bool)
    for number, block in enumerate(read_slices(rec, names, blocks[: n_blocks // 2]), 1):
        is_drifting = abs(_means(block) - mean) > _DRIFT_SIGMAS * scatter
        n_drift_blocks = np.where(is_drifting & ~is_settled, number, n_drift_blocks)
        n_settled_in_a_row = np.where(is_drifting, 0, n_settled_in_a_row + 1)
        is_settled |= n_settled_in_a_row >= _SETTLED_IN_A_ROW
        if is_settled.all():
            break
    return [
        Flaw(first, blocks[int(n_drifting) - 1][1], name, SETTLING)
        for name, n_drifting in zip(names, n_drift_blocks, strict=True)
        if n_drifting
    ]


def _means(block: Array) -> Array:
    """Return the mean of each channel's valid samples, shape (channels,); NaN for a channel without valid samples."""
    return np.array([np.nanmean(row) if np.isfinite(row).any() else np.nan for row in block])
