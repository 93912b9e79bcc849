"""Stretches of a recording in which the selected channels have no overload and no lost samples."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rig.scene.quantities import ACCELERATION, FORCE, parse

if TYPE_CHECKING:
    from daq.recording.recording import Recording
    from daq.signal_chain.channel import ChannelInfo


#: Flaw of a channel while the bias of its sensor has not settled.
SETTLING = "settling"


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
        Flaw(
            gap.first_sample,
            gap.last_sample + 1,
            next(name for name in gap.channels if name in channels),
            "lost",
        )
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
    """Describe the flaws and their times: ``a3 overloaded (at 1.2 s, 4.5 s, ...), all channels lost (at 7 s)``."""
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
    limits = [
        f"{name} follows {text}"
        for name in dict.fromkeys(flaw.channel for flaw in found if flaw.what == "overloaded")
        for key, text in rec.channels[name].sensor.items()
        if key.endswith(".saturation") and _reached_first(rec.channels[name], text)
    ]
    other = f", or take a sensor that follows more ({', '.join(limits)})" if limits else ""
    cures = [f"lower the level, widen the range (converter: range){other}"] if kinds != {SETTLING} else []
    if SETTLING in kinds:
        cures.append("switch the sensors on long before the test")
    return ", and ".join(cures)


def _reached_first(info: ChannelInfo, limit: str) -> bool:
    """Whether the limit in the sensor's data sheet is below the range of the converter."""
    kind = {"acceleration": ACCELERATION, "force": FORCE}.get(info.quantity)
    return kind is None or info.range is None or parse(limit, kind) * info.sensitivity < info.range
