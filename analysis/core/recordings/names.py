"""Names of recordings in legends, tables and text: scene names, with file names if scenes have equal names."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import replace
from functools import wraps
from pathlib import Path
from typing import Concatenate, ParamSpec, Protocol, TypeVar

import numpy as np

from daq.core.recording.markers import faults_of_impacts, impacts_of
from daq.core.recording.recording import Recording
from rig.core.base.errors import RecordingError
from rig.core.results.response import Response


class _Labeled(Protocol):
    """A dataclass with a label that begins with the name of its scene."""

    @property
    def label(self) -> str: ...


Labeled = TypeVar("Labeled", bound=_Labeled)
Parameters = ParamSpec("Parameters")
Returned = TypeVar("Returned")


def require_file(path: Path) -> None:
    """Raise `RecordingError` if an input file does not exist; the message suggests how to get it."""
    if not path.exists():
        similar_path = "recordings" / Path(path.name)
        hint = (
            f". Did you mean '{similar_path}'?"
            if similar_path.exists()
            else f". Make one: `daq record SCENE -o {path}`."
        )
        raise RecordingError(f"{path}: no such file{hint}")


def open_existing(path: Path) -> Recording:
    """Open a recording that must exist."""
    import daq

    require_file(path)
    return daq.open(path)


class OpenRecordings(ExitStack):
    """The recordings of a command: each is opened, and its scene read, once, when it is first used."""

    def __init__(self) -> None:
        super().__init__()
        self._open: dict[Path, Recording] = {}

    def of(self, path: Path) -> Recording:
        """Return the recording in a file, which stays open until this context ends."""
        if path not in self._open:
            self._open[path] = self.enter_context(open_existing(path))
        return self._open[path]


def with_recordings(
    command: Callable[Concatenate[OpenRecordings, Parameters], Returned],
) -> Callable[Parameters, Returned]:
    """Decorate a command: pass it its recordings, and close them afterwards."""

    @wraps(command)
    def run(*args: Parameters.args, **options: Parameters.kwargs) -> Returned:
        with OpenRecordings() as recordings:
            return command(recordings, *args, **options)

    return run


def as_context(recording: Recording | str | Path) -> AbstractContextManager[Recording]:
    """Return a context with a recording: a path is open inside the context; an open recording stays open."""
    return open_existing(Path(recording)) if isinstance(recording, str | Path) else nullcontext(recording)


def require_recording(recording: object, name: str) -> None:
    """Reject an argument that is neither a path nor a recording; the message begins with `name`."""
    if not isinstance(recording, str | Path) and not hasattr(recording, "channels"):
        raise RecordingError(
            f"{name}: got {recording!r:.60}; expected a recording: its path, or the object that daq.open returns"
        )


def takes_path(
    function: Callable[Concatenate[Recording, Parameters], Returned],
) -> Callable[Concatenate[Recording | str | Path, Parameters], Returned]:
    """Decorate a function of a recording so that it also takes a path; the file is open while the function runs."""

    @wraps(function)
    def with_opened(
        recording: Recording | str | Path, /, *args: Parameters.args, **kwargs: Parameters.kwargs
    ) -> Returned:
        require_recording(recording, function.__name__)
        with as_context(recording) as rec:
            return function(rec, *args, **kwargs)

    return with_opened


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


def excitation_text(rec: Recording) -> str:
    """Describe the test and its level, on which the response of a nonlinear structure depends: stepped sine, 2.6 N."""
    test = rec.scene.test
    if test is None:
        return ""
    level = test.level_text(rec.scene.driven_shaker)
    if test.held_motion is not None:
        level += f" at {rec.scene.structure.label(test.held_motion[0])}"
    return ", ".join(filter(None, [test.title, level]))


def validity_texts(rec: Recording) -> list[str]:
    """Describe the causes that limit the validity of responses: nonlinear parts, and impacts or samples with faults."""
    texts = ["nonlinear, valid only for this kind and level of excitation"] * (not rec.scene.is_linear)
    if faulty := faults_of_impacts(rec.markers):
        omitted = ", clipped samples omitted" * bool(rec.overloads)
        return [*texts, f"of {len(impacts_of(rec.markers))} impacts, {faulty}{omitted}"]
    count = len(rec.overloads)
    return [*texts, *[f"{count} overload{'s' * (count > 1)}"] * (count > 0)]


def acquisition_text(rec: Recording, frf: Response | None = None, estimate: str = "") -> str:
    """Describe number of averages or points, line spacing, estimate and sample rate: 3 impacts of 4 ms, Δf 0.33 Hz."""
    test = rec.scene.test
    details = () if test is None else (*test.details, test.duration_text)
    spacing = freedom = ""
    if frf is not None:
        spacing = line_spacing(frf)
        # Impacts and periods are averages; a continuous test has equivalent averages.
        if test is not None and test.duration_text and frf.degrees_of_freedom.any():
            freedom = f"{np.median(frf.degrees_of_freedom):.0f} degrees of freedom per line"
    return ", ".join(filter(None, [*details, spacing, estimate, freedom, f"sampled at {rec.rate:g} Hz"]))


def full_test_text(rec: Recording) -> str:
    """Describe test, level, averages and sample rate for the subtitle of a figure."""
    return ", ".join(filter(None, [excitation_text(rec), acquisition_text(rec)]))


def line_spacing(frf: Response) -> str:
    """Write the spacing of lines, or its range for unevenly spaced tones.

    >>> line_spacing(Response.curve(np.array([10.0, 10.5, 11.0, 12.5]), np.ones(4, dtype=complex), "a"))
    'Δf 0.5 Hz'
    >>> line_spacing(Response.curve(np.array([10.0, 10.5, 11.1]), np.ones(3, dtype=complex), "a"))
    'Δf 0.5 to 0.6 Hz'
    """
    steps = np.diff(np.sort(frf.frequency))
    if not steps.size or steps.min() <= 0.0:
        return ""
    lines = steps / steps.min()
    largest = "" if np.allclose(lines, np.round(lines), atol=1e-3) else f" to {steps.max():.2g}"
    return f"Δf {steps.min():.2g}{largest} Hz"


def relabel(curve: Labeled, scene: str, label: str) -> Labeled:
    """Replace the name of the scene with the recording's label."""
    return replace(curve, label=label + curve.label.removeprefix(scene))  # type: ignore[type-var]
