"""Names of recordings in legends, tables and text: scene names, with file names if scenes have equal names."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol, TypeVar

from analysis.core.recordings.opening import OpenRecordings


class _Labeled(Protocol):
    """A dataclass with a label that begins with the name of its scene."""

    @property
    def label(self) -> str: ...


Labeled = TypeVar("Labeled", bound=_Labeled)


def distinct_names(names: Sequence[str], paths: Sequence[Path]) -> list[str]:
    """Return distinct names of recordings.

    >>> distinct_names(["none", "three", "three"], [Path("a.mcap"), Path("b.mcap"), Path("c.mcap")])
    ['none', 'three (b)', 'three (c)']
    >>> distinct_names(["none", "none"], [Path("x/a.mcap"), Path("x/b.mcap")])
    ['a', 'b']
    """
    if len(paths) > 1 and len(set(names)) == 1:
        # A common name of all recordings does not distinguish them.
        stems = [path.stem for path in paths]
        return stems if len(set(stems)) == len(paths) else [path.as_posix() for path in paths]
    pairs = list(zip(names, paths, strict=True))
    with_stem = [f"{name} ({path.stem})" if names.count(name) > 1 else name for name, path in pairs]
    with_path = [f"{name} ({path.as_posix()})" for name, path in pairs]
    return [longer if with_stem.count(label) > 1 else label for label, longer in zip(with_stem, with_path, strict=True)]


def scene_labels(recordings: OpenRecordings, paths: Sequence[Path]) -> list[str]:
    """Name recordings after their scenes."""
    return distinct_names([recordings.of(path).scene.name for path in paths], paths)


def baseline_label(recordings: Mapping[str, bool]) -> str:
    """Return the label of the baseline of a comparison: the first recording without moving dampers, or the first.

    `recordings`: whether dampers can move, by label. A single recording is not compared, and its label is "".

    >>> baseline_label({"three": True, "none": False}), baseline_label({"a": True, "b": True}), baseline_label({})
    ('none', 'a', '')
    """
    if len(recordings) < 2:
        return ""
    return next((label for label, moves in recordings.items() if not moves), next(iter(recordings)))


def belongs_to(label: str, recording: str) -> bool:
    """Return whether a label belongs to a recording, or to one of its sweeps."""
    return bool(recording) and (label == recording or label.startswith(f"{recording}, "))


def sweep_name(label: str, recording: str) -> str:
    """Return the part of the label of a sweep that follows the label of its recording; empty for a single sweep.

    >>> sweep_name("beam, 2 N up", "beam"), sweep_name("beam", "beam")
    ('2 N up', '')
    """
    return label.removeprefix(recording).removeprefix(", ")


def without_common_direction(names: Sequence[str]) -> list[str]:
    """Remove the direction from names of sweeps that are all upward.

    >>> without_common_direction(["1 N up", "2 N up"]), without_common_direction(["1 N up", "1 N down"])
    (['1 N', '2 N'], ['1 N up', '1 N down'])
    """
    is_common = all(name.endswith(" up") for name in names)
    return [name.removesuffix(" up") if is_common else name for name in names]


def relabel(curve: Labeled, scene: str, label: str) -> Labeled:
    """Replace the name of the scene with the recording's label."""
    return replace(curve, label=label + curve.label.removeprefix(scene))  # type: ignore[type-var]
