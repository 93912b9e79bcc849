"""Input files of a command: labels of recordings, and FRF files of other programs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from analysis.recordings.names import scene_labels
from analysis.responses.frf_files import is_frf_file, read_frfs
from rig.errors import RecordingError
from rig.results.response import Response


def labels(paths: Sequence[Path]) -> list[str]:
    """Return legend labels: the scene name of a recording, the file name of another program's FRF file."""
    recordings = [path for path in paths if not is_frf_file(path)]
    recording_labels = dict(zip(recordings, scene_labels(recordings), strict=True))
    return [recording_labels.get(path, path.stem) for path in paths]


def read_curves(path: Path, reference: str, channels: Sequence[str] | None, unit: str | None) -> list[Response]:
    """Read FRFs of another program; `reference` is the node and direction of the force."""
    curves = read_frfs(path, None if reference == "force" else reference, unit)
    missing = [name for name in channels or () if name not in {curve.response for curve in curves}]
    if missing:
        available = ", ".join(curve.response for curve in curves)
        raise RecordingError(f"{path}: no response {', '.join(missing)}. Choose from {available[:300]}.")
    return [curve for curve in curves if not channels or curve.response in channels]
