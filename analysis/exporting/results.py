"""Frequency responses and modes for other tools: UFF 58 and 55, MATLAB."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from analysis.exporting import mat, uff
from analysis.modal.identification import identify
from analysis.recordings.names import opened
from analysis.responses.frequency_responses import frequency_responses
from analysis.responses.frf_files import is_frf_file, read_frfs
from rig.errors import SceneError
from rig.output_files import destination, replacing
from rig.results.response import Response, stack

ENDINGS = (".uff", ".unv", ".mat")


def export_results(
    file: Path,
    path: Path,
    what: str,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> list[str]:
    """Write the results of a recording, or another program's responses: one file for each sweep that it holds.

    Parameters
    ----------
    file : Path
        A recording, or a file that `analysis.read_frfs` takes.
    path : Path
        File to make, ``.uff``, ``.unv`` or ``.mat``; of several sweeps the later ones get a number.
    what : {'frfs', 'modes'}
    overwrite : bool
        Whether existing files with another content may be replaced.

    Returns
    -------
    list of str
        Lines for the user.

    Raises
    ------
    SceneError
        If the file's name says no format, or the file exists.
    """
    kind = path.suffix.lower()
    if what not in ("frfs", "modes"):
        raise SceneError(f"unknown --what {what!r}: expected samples, frfs or modes")
    if kind not in ENDINGS:
        raise SceneError(f"{path}: expected a name that ends in one of {', '.join(ENDINGS)} for {what}")
    destination(path, overwrite=True)
    lines = []
    for number, (curves, nodes, driven) in enumerate(_groups(file, progress), start=1):
        target = path if number == 1 else path.with_name(f"{path.stem}-{number}{path.suffix}")
        with replacing(target, overwrite or None) as part:
            if what == "frfs":
                mat.write_frfs(curves, part) if kind == ".mat" else stack(curves).to_uff(
                    part, nodes, [driven]
                )
                lines.append(
                    f"{curves[0].label}: {curves[0].name} of {', '.join(one.response for one in curves)} by "
                    f"{curves[0].input}"
                )
            else:
                modes = identify(curves)
                mat.write_modes(modes, part) if kind == ".mat" else uff.write_modes(modes, part, nodes)
                lines.append(modes.summary())
        lines.append(f"wrote {target}, {target.stat().st_size / 1e6:.2f} MB")
    return lines


def _groups(
    file: Path, progress: Callable[[int, int], None] | None
) -> list[tuple[Sequence[Response], list[int], int]]:
    """Give sets of responses, the nodes of their points, and the node of the force."""
    if is_frf_file(file):
        curves = read_frfs(file)
        return [(curves, list(range(1, len(curves) + 1)), 0)]
    with opened(file) as rec:
        groups = frequency_responses(rec, progress=progress)
        # A force on several bodies at once has no node of its own.
        driven = rec.scene.force_on[0] if len(rec.scene.force_on) == 1 else 0
        return [
            (group, [uff.node(rec.channels[one.response].at) for one in group], driven) for group in groups
        ]
