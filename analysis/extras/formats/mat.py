"""Export of channels, frequency responses and modes as MATLAB 5 files for MATLAB, Octave and scipy."""

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from analysis.core.modal.modes import Modes
from analysis.core.recordings.slices import Slice
from rig.core.base.errors import SceneError
from rig.core.numerics.memory import require_memory_with_program
from rig.core.results.response import Response

# Maximum number of samples in a variable: the format limits a variable to 2 GB.
MAX_SAMPLES = (1 << 28) - 1024
# Number of copies of a channel that are in memory at a time (measured).
_COPIES = 2


def write_mat(segment: Slice, path: Path) -> None:
    """Write a variable for each channel, and ``channels``, ``units``, ``fs`` [Hz] and ``start_s``.

    Lost samples are NaN. Raises `SceneError` if there are too many samples for the format.
    """
    count = segment.stop - segment.start
    if count > MAX_SAMPLES:
        raise SceneError(
            f"{segment.recording.path}: a MATLAB file can contain at most {MAX_SAMPLES} samples per channel; this "
            f"segment has {count}. Export a shorter segment (`from_s`, `to_s`), or an .npz file."
        )
    names = variable_names(segment.channels, {"channels", "units", "fs", "start_s"})
    rate = segment.recording.rate
    require_memory_with_program(_COPIES * 8 * count, f"{segment.recording.path}: a channel in a MATLAB file")
    with path.open("wb") as file:
        for name, channel in zip(names, segment.channels, strict=True):
            # Writing the variables one after the other requires the memory of a single channel.
            _save(file, {name: segment.read_channel(channel)})
        _save(
            file,
            {
                "channels": np.array(names, dtype=object),
                "units": np.array([info.unit for info in segment.infos], dtype=object),
                "fs": rate,
                "start_s": segment.start / rate,
            },
        )


def write_frfs(response: Response, path: Path) -> None:
    """Write ``frequency`` [Hz], ``unit``, ``reference``, and value, bound and coherence of each curve."""
    curves = response.sorted().curves()
    has_several_inputs = len(response.inputs) > 1
    labels = [f"{curve.response}_{curve.inputs[0].name}" if has_several_inputs else curve.response for curve in curves]
    names = variable_names(labels, {"frequency", "unit", "reference", "channels"})
    content: dict[str, Any] = {"frequency": curves[0].frequency, "unit": response.unit, "reference": response.input}
    for name, curve in zip(names, curves, strict=True):
        content |= {name: curve.value, f"bound_{name}": curve.bound(), f"coherence_{name}": curve.coherence}
    _save(path, content | {"channels": np.array(names, dtype=object)})


def write_modes(modes: Modes, path: Path) -> None:
    """Write frequencies [Hz], damping ratios, their standard deviations, shapes and residues [m/(N s)]."""
    _save(
        path,
        {
            "frequency_Hz": modes.frequency,
            "frequency_std_Hz": modes.frequency_std,
            "damping_ratio": modes.damping,
            "damping_ratio_std": modes.damping_std,
            "shapes": modes.shapes,
            "residues": modes.residue,
            "responses": np.array(modes.responses, dtype=object),
        },
    )


def variable_names(names: Iterable[str], reserved: set[str]) -> list[str]:
    """Convert names to valid MATLAB variable names.

    >>> variable_names(["body1", "3 +Z", "fs"], {"fs"})
    ['body1', 'x3__Z', 'fs_']

    Raises `SceneError` if two names become equal.
    """
    names = list(names)
    cleaned = [re.sub(r"\W", "_", name, flags=re.ASCII)[:50] for name in names]
    valid = [f"x{name}" if not name[:1].isalpha() else name for name in cleaned]
    valid = [f"{name}_" if name in reserved else name for name in valid]
    for variable in valid:
        same = [other for other, other_variable in zip(names, valid, strict=True) if other_variable == variable]
        if len(same) > 1:
            raise SceneError(
                f".mat: the channels {' and '.join(map(repr, same))} would have the same variable name {variable!r}. "
                "Export as .uff."
            )
    return valid


def _save(path: Path | BinaryIO, content: dict[str, Any]) -> None:
    from scipy.io import savemat

    savemat(path, content, oned_as="column", long_field_names=True)
