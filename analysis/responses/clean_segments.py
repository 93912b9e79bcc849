"""Segments of a recording in which the selected channels are free of overloads, losses and settling sensors."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from analysis.recordings.slices import read_slices
from rig.arrays import Array
from rig.scene.quantities import ACCELERATION, FORCE, parse

if TYPE_CHECKING:
    from daq.recording.recording import Recording


#: Reason of a flaw while the bias of a sensor has not settled.
SETTLING = "settling"
# Number of blocks in the second half of the test from which the scatter of means after settling is estimated.
_SETTLED_BLOCKS = 32
# Smallest number of blocks of a test whose second half is certainly settled.
_MIN_BLOCKS = 16
# Deviation of a block's mean above which the block belongs to a drift, in standard deviations of settled blocks.
_DRIFT_SIGMAS = 5.0
# Number of successive blocks without such a deviation that end the drift.
_SETTLED_IN_A_ROW = 3


@dataclass(frozen=True)
class Flaw:
    """Samples ``[first, stop)`` that do not measure the motion, with the reason."""

    first: int
    stop: int
    channel: str
    reason: str  # such as overloaded, lost or settling


def flaws(rec: Recording, channels: Collection[str], first: int, stop: int) -> list[Flaw]:
    """Return overloads and lost samples of the channels between two samples, sorted by their first sample."""
    all_flaws = [
        Flaw(marker.first_sample, marker.stop, str(marker.fields.get("channel", "")), "overloaded")
        for marker in rec.overloads
        if marker.fields.get("channel") in channels
    ]
    all_flaws += [
        Flaw(gap.first_sample, gap.last_sample + 1, next(name for name in gap.channels if name in channels), "lost")
        for gap in rec.gaps
        if set(gap.channels) & set(channels)
    ]
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
    """Describe the flaws and their times: ``a3 overloaded (at 1.2 s, 4.5 s), a1 lost (at 7 s)``."""
    groups: dict[str, list[str]] = {}
    for flaw in all_flaws:
        groups.setdefault(f"{flaw.channel} {flaw.reason}", []).append(f"{flaw.first / rec.rate:.4g} s")
    return ", ".join(
        f"{kind} (at {', '.join(times[:3])}{f' and {len(times) - 3} times more' if len(times) > 3 else ''})"
        for kind, times in groups.items()
    )


def remedy(rec: Recording, all_flaws: Sequence[Flaw]) -> str:
    """Return a remedy for flaws, as a sentence without full stop: another level, range or sensor, or time to settle."""
    reasons = {flaw.reason for flaw in all_flaws}
    limits = []
    for name in dict.fromkeys(flaw.channel for flaw in all_flaws if flaw.reason == "overloaded"):
        info = rec.channels[name]
        kind = {"acceleration": ACCELERATION, "force": FORCE}.get(info.quantity)
        for key, text in info.sensor.items():
            if not key.endswith(".saturation"):
                continue
            # Only a sensor whose limit is below the range of the converter limits the signal.
            if kind is None or info.range is None or parse(text, kind) * info.sensitivity < info.range:
                limits.append(f"{name} up to {text}")
    sensor = f", or use a sensor of a larger range ({', '.join(limits)})" if limits else ""
    remedies = [] if reasons == {SETTLING} else [f"lower the level, widen the range (converter: range){sensor}"]
    if SETTLING in reasons:
        remedies.append("switch the sensors on longer before the test")
    text = ", and ".join(remedies)
    return text[0].upper() + text[1:]


def settling_flaws(rec: Recording, names: Sequence[str], first: int, stop: int, lowest: float) -> list[Flaw]:
    """Return a flaw at the beginning of a test for each channel whose bias has not settled there.

    `lowest`: lowest excited frequency, Hz. The motion has a zero mean over its period. A mean that differs from later
    means is therefore an error of the sensor, which in a reference channel is an apparent force.
    """
    size = int(np.ceil(rec.rate / lowest))
    count = (stop - first) // size
    if count < _MIN_BLOCKS:
        return []
    blocks = [(first + k * size, first + (k + 1) * size) for k in range(count)]
    settled = np.unique(np.linspace(count // 2, count - 1, _SETTLED_BLOCKS).astype(int))
    means = [_means(block) for block in read_slices(rec, names, [blocks[k] for k in settled])]
    # A channel without any valid sample has no mean; the masked array avoids numpy's warning.
    settled_means = np.ma.masked_invalid(means)
    mean, scatter = settled_means.mean(axis=0).filled(np.nan), settled_means.std(axis=0).filled(np.nan)
    drift_blocks, blocks_in_a_row = np.zeros(len(names), dtype=int), np.zeros(len(names), dtype=int)
    settled_channels = np.zeros(len(names), dtype=bool)
    for number, block in enumerate(read_slices(rec, names, blocks[: count // 2]), 1):
        is_drifting = abs(_means(block) - mean) > _DRIFT_SIGMAS * scatter
        drift_blocks = np.where(is_drifting & ~settled_channels, number, drift_blocks)
        blocks_in_a_row = np.where(is_drifting, 0, blocks_in_a_row + 1)
        settled_channels |= blocks_in_a_row >= _SETTLED_IN_A_ROW
        if settled_channels.all():
            break
    return [
        Flaw(first, first + int(end) * size, name, SETTLING)
        for name, end in zip(names, drift_blocks, strict=True)
        if end
    ]


def _means(block: Array) -> Array:
    """Return the mean of each channel's valid samples, shape (channels,); NaN without any."""
    return np.array([np.nanmean(row) if np.isfinite(row).any() else np.nan for row in block])
