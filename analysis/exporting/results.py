"""Export of frequency responses and modes: UFF 58 and 55, MATLAB."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from analysis.exporting import mat, uff
from analysis.modal.identification import identify
from analysis.recordings.names import opened
from analysis.responses.frequency_responses import frequency_responses
from analysis.responses.frf_files import is_frf_file, read_frfs
from rig.errors import SceneError
from rig.output_files import atomic_write, resolve_output
from rig.progress import CountProgress
from rig.results.response import Response, stack

ENDINGS = (".uff", ".unv", ".mat")


def export_results(
    file: Path, path: Path, what: str, overwrite: bool = False, progress: CountProgress | None = None
) -> list[str]:
    """Write the FRFs or modes of a recording or of an FRF file, one output file for each sweep.

    `file`: a recording, or an FRF file that `analysis.read_frfs` can read; `path`: output file, ``.uff``, ``.unv``
    or ``.mat``; the files of the second and later sweeps are numbered; `what`: results to write, 'frfs' or 'modes';
    `overwrite`: whether existing files with different content may be replaced. Returns messages for the user. Raises
    `SceneError` if the file name ending is unknown, or the file exists.
    """
    kind = path.suffix.lower()
    if what not in ("frfs", "modes"):
        raise SceneError(f"--what: unknown {what!r}. Choose samples, frfs or modes.")
    if kind not in ENDINGS:
        raise SceneError(
            f"{path}: unknown format {kind!r} for {what}. Choose a name that ends in one of {', '.join(ENDINGS)}."
        )
    resolve_output(path, overwrite=True)
    lines = []
    for number, (curves, nodes, force_node) in enumerate(_sweeps(file, progress), start=1):
        target = path if number == 1 else path.with_name(f"{path.stem}-{number}{path.suffix}")
        with atomic_write(target, overwrite or None) as temporary:
            if what == "frfs":
                first, names = curves[0], ", ".join(curve.response for curve in curves)
                mat.write_frfs(curves, temporary) if kind == ".mat" else stack(curves).to_uff(
                    temporary, nodes, [force_node]
                )
                lines.append(f"{first.label}: {first.name} of {names} by {first.input}")
            else:
                modes = identify(curves)
                mat.write_modes(modes, temporary) if kind == ".mat" else uff.write_modes(modes, temporary, nodes)
                lines.append(modes.summary())
        lines.append(f"wrote {target}, {target.stat().st_size / 1e6:.2f} MB")
    return lines


def _sweeps(file: Path, progress: CountProgress | None) -> list[tuple[Sequence[Response], list[int], int]]:
    """Return for each sweep its responses, the nodes of their points, and the node of the force (0: not one body)."""
    if is_frf_file(file):
        curves = read_frfs(file)
        return [(curves, list(range(1, len(curves) + 1)), 0)]
    with opened(file) as rec:
        sweeps = frequency_responses(rec, progress=progress)
        # A force that acts on several bodies has no single node.
        force_node = rec.scene.force_on[0] if len(rec.scene.force_on) == 1 else 0
        return [
            (curves, [uff.node(rec.channels[curve.response].at) for curve in curves], force_node) for curves in sweeps
        ]
