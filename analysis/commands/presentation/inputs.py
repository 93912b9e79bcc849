"""Input files of an `analysis` command: labels, and checks of the files and options.

A command must be able to analyze its files, and each option must have an effect. The message of a failed check names a
suitable command or option.
"""

import shlex
from collections.abc import Sequence
from pathlib import Path

from analysis.core.recordings.names import scene_labels
from analysis.core.recordings.opening import OpenRecordings
from analysis.core.responses.estimator import Blocks, estimator_of
from analysis.extras.formats.frf_files import is_frf_file, read_frfs
from daq.core.recording.recorded_test import TestKind
from daq.core.recording.recording import Recording
from rig.core.base.errors import RecordingError, SceneError
from rig.core.base.input_files import duplicate_files
from rig.core.results.response import Response


def labels(recordings: OpenRecordings, paths: Sequence[Path]) -> list[str]:
    """Return the label of each file: scene name of a recording, or name of a file of FRFs."""
    recorded = [path for path in paths if not is_frf_file(path)]
    recording_labels = dict(zip(recorded, scene_labels(recordings, recorded), strict=True))
    return [recording_labels.get(path, path.stem) for path in paths]


def read_curves(path: Path, reference: str | None, channels: Sequence[str] | None, unit: str | None) -> list[Response]:
    """Read FRFs from a file.

    `reference`: node and direction of the force in the file, or "force" if there is only one; `channels`: responses to
    return; `unit`: unit of the values, if the file states none.
    """
    curves = read_frfs(path, None if reference == "force" else reference, unit)
    missing = [name for name in channels or () if name not in {curve.response for curve in curves}]
    if missing:
        available = ", ".join(curve.response for curve in curves)
        raise RecordingError(f"{path}: no response {', '.join(missing)}. Choose from {available[:300]}.")
    return [curve for curve in curves if not channels or curve.response in channels]


def check_recording(rec: Recording, path: Path, command: str) -> None:
    """Raise an error if a recording lacks the data that a command analyzes.

    `path`: file of the recording, for the message; `command`: 'frf', 'modes', 'decay' or 'dampers'. Raises
    `RecordingError`, whose message gives the content of the recording and a suitable command.
    """
    test, file = rec.test, shlex.quote(str(path))
    if command == "decay" and not test.decays and test.kind is not TestKind.NONE:
        raise RecordingError(
            f"{path}: the recording contains no free decay ({test.name}). Use `analysis frf {file}` for its frequency "
            "responses."
        )
    if command in ("frf", "modes", "dampers") and not test.drives:
        raise RecordingError(
            f"{path}: {test.name} has no driving force, which frequency responses need. Use `analysis decay {file}`."
        )
    if command == "dampers":
        if not rec.scene.dampers and not rec.scene.joints:
            raise RecordingError(f"{path}: its scene has no dampers. Use `analysis frf {file}` for its responses.")
        if not test.kind.steady and test.kind is not TestKind.NONE:
            suitable = "decay" if test.decays else "frf"
            raise RecordingError(
                f"{path}: the motion of dampers is estimated from steady tones, not from {test.name}. Record test: "
                f"{{kind: stepped_sine, ...}} or {{kind: sine, ...}}, or use `analysis {suitable} {file}`."
            )


def duplicate_warnings(paths: Sequence[Path]) -> list[str]:
    """Return a warning for each file that is given twice: equal files are not independent measurements."""
    return [
        f"{duplicate}: the same content as {first}. Give each recording once."
        for first, duplicate in duplicate_files(paths)
    ]


def check_inputs(
    recordings: OpenRecordings,
    paths: Sequence[Path],
    command: str,
    blocks: Blocks,
    theory: bool = False,
    unit: str | None = None,
) -> list[str]:
    """Raise an error for files that a command cannot analyze and for options without effect on any file.

    `command`: as in `check_recording`; `blocks`, `theory`, `unit`: options of the command, None or False if not given.
    Returns warnings about files given twice, and about options without effect on some of the files, with the reason.
    """
    requested = {**vars(blocks), "theory": theory or None, "unit": unit}
    # For each requested option: the files on which it has no effect, with the reason.
    without_effect: dict[str, list[str]] = {name: [] for name, value in requested.items() if value is not None}
    for path in paths:
        effective: tuple[str, ...]
        if is_frf_file(path):
            effective, reason = ("unit",), "it contains frequency responses, not samples"
        else:
            check_recording(recordings.of(path), path, command)
            own_estimator = estimator_of(recordings.of(path).test.kind)
            effective, reason = ("theory", *own_estimator.options), own_estimator.method
        for name in without_effect.keys() - {*effective}:
            without_effect[name].append(f"{path.name}: {reason if name != 'unit' else 'a recording states its units'}")
    for name, files in without_effect.items():
        if len(files) == len(paths):
            raise SceneError(f"--{name} has no effect on {files[0]}. Omit it.")
    unused_options = [f"--{name} has no effect on {text}" for name, files in without_effect.items() for text in files]
    return [*duplicate_warnings(paths), *unused_options]
