"""Stretches of a recording in which the selected channels are free of overloads, losses and settling sensors."""

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


#: Flaw of a channel while the bias of its sensor has not settled.
SETTLING = "settling"
# Blocks of the second half that determine the scatter of means after settling, and the fewest blocks for a result.
_LATER, _FEWEST = 32, 16
# A block belongs to a drift if its mean deviates by more than this number of standard deviations of later blocks.
_DRIFT_SIGMAS = 5.0
# The drift has ended after this number of successive blocks without such a deviation.
_BLOCKS_AFTER_DRIFT = 3


@dataclass(frozen=True)
class Flaw:
    """Samples ``[first, stop)`` that do not measure the motion, with the reason."""

    first: int
    stop: int
    channel: str
    what: str


def flaws(rec: Recording, channels: Collection[str], first: int, stop: int) -> list[Flaw]:
    """Find overloads and lost samples of the channels between two samples, in order of their beginning."""
    found = [
        Flaw(marker.first_sample, marker.stop, str(marker.fields.get("channel", "")), "overloaded")
        for marker in rec.overloads
        if marker.fields.get("channel") in channels
    ]
    found += [
        Flaw(gap.first_sample, gap.last_sample + 1, next(n for n in gap.channels if n in channels), "lost")
        for gap in rec.gaps
        if set(gap.channels) & set(channels)
    ]
    return sorted(
        (flaw for flaw in found if flaw.first < stop and flaw.stop > first), key=lambda flaw: flaw.first
    )


def clean_stretches(found: list[Flaw], first: int, stop: int) -> list[tuple[int, int]]:
    """Return the stretches (start, stop) between two samples that contain no flaw.

    >>> clean_stretches([Flaw(20, 30, "a", "lost"), Flaw(25, 40, "b", "overloaded")], 0, 100)
    [(0, 20), (40, 100)]
    """
    left, at = [], first
    for flaw in found:
        if flaw.first > at:
            left.append((at, min(flaw.first, stop)))
        at = max(at, flaw.stop)
    return [*left, (at, stop)] if at < stop else left


def describe_flaws(rec: Recording, found: Sequence[Flaw]) -> str:
    """Describe the flaws and their times: ``a3 overloaded (at 1.2 s, 4.5 s), a1 lost (at 7 s)``."""
    groups: dict[str, list[str]] = {}
    for flaw in found:
        groups.setdefault(f"{flaw.channel} {flaw.what}", []).append(f"{flaw.first / rec.rate:.4g} s")
    return ", ".join(
        f"{what} (at {', '.join(times[:3])}{f' and {len(times) - 3} times more' if len(times) > 3 else ''})"
        for what, times in groups.items()
    )


def cure(rec: Recording, found: Sequence[Flaw]) -> str:
    """Recommend a remedy for flaws: another level, range or sensor, or a longer wait for sensors to settle."""
    kinds = {flaw.what for flaw in found}
    limits = []
    for name in dict.fromkeys(flaw.channel for flaw in found if flaw.what == "overloaded"):
        info = rec.channels[name]
        kind = {"acceleration": ACCELERATION, "force": FORCE}.get(info.quantity)
        for key, text in info.sensor.items():
            if not key.endswith(".saturation"):
                continue
            # Only a sensor whose limit is below the range of the converter limits the signal.
            if kind is None or info.range is None or parse(text, kind) * info.sensitivity < info.range:
                limits.append(f"{name} follows {text}")
    other = f", or take a sensor that follows more ({', '.join(limits)})" if limits else ""
    cures = [f"lower the level, widen the range (converter: range){other}"] if kinds != {SETTLING} else []
    if SETTLING in kinds:
        cures.append("switch the sensors on long before the test")
    text = ", and ".join(cures)
    return text[0].upper() + text[1:]


def settling(rec: Recording, names: Sequence[str], first: int, stop: int, lowest: float) -> list[Flaw]:
    """Find the beginning of a test in which a channel's bias has not settled; `lowest` excited frequency in Hz.

    The mean of the motion over a period of the lowest frequency is zero, so a mean that differs from later means is an
    error of the sensor. In a reference channel it is an apparent force.
    """
    size = int(np.ceil(rec.rate / lowest))
    count = (stop - first) // size
    if count < _FEWEST:
        return []
    blocks = [(first + k * size, first + (k + 1) * size) for k in range(count)]
    chosen = np.unique(np.linspace(count // 2, count - 1, _LATER).astype(int))
    means = [_means(block) for block in read_slices(rec, names, [blocks[k] for k in chosen])]
    # A channel without any valid sample has no result; the masked array avoids numpy's warning.
    later = np.ma.masked_invalid(means)
    middle, scatter = later.mean(axis=0).filled(np.nan), later.std(axis=0).filled(np.nan)
    ends, calm = np.zeros(len(names), dtype=int), np.zeros(len(names), dtype=int)
    ended = np.zeros(len(names), dtype=bool)
    for number, block in enumerate(read_slices(rec, names, blocks[: count // 2]), 1):
        off = abs(_means(block) - middle) > _DRIFT_SIGMAS * scatter
        ends = np.where(off & ~ended, number, ends)
        calm = np.where(off, 0, calm + 1)
        ended |= calm >= _BLOCKS_AFTER_DRIFT
        if ended.all():
            break
    return [
        Flaw(first, first + int(end) * size, name, SETTLING)
        for name, end in zip(names, ends, strict=True)
        if end
    ]


def _means(block: Array) -> Array:
    return np.array([np.nanmean(row) if np.isfinite(row).any() else np.nan for row in block])
