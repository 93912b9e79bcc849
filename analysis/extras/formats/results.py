"""Export of frequency responses and modes: UFF 58 and 55, MATLAB."""

from pathlib import Path

from analysis.core.modal.identification import identify
from analysis.core.recordings.opening import open_existing
from analysis.core.responses.frequency_responses import frequency_responses
from analysis.extras.formats import mat, uff
from analysis.extras.formats.frf_files import is_frf_file, read_frfs
from daq.core.recording.recording import Recording
from rig.core.base.errors import SceneError
from rig.core.base.output_files import atomic_write, resolve_output
from rig.core.base.progress import CountProgress
from rig.core.results.response import Response

ENDINGS = (".uff", ".unv", ".mat")


def export_results(
    file: Path, path: Path, what: str, overwrite: bool = False, progress: CountProgress | None = None
) -> list[str]:
    """Write the FRFs or modes of a recording or of an FRF file; return messages for the user.

    `file`: a recording, or an FRF file that `analysis.read_frfs` can read. `path`: output file (``.uff``, ``.unv`` or
    ``.mat``). Each sweep has its own file; from the second on, the name is numbered. `what`: 'frfs' or 'modes'.
    `overwrite`: whether existing files may be replaced. Raises `SceneError` if the suffix is unknown, or the file
    exists.
    """
    kind = path.suffix.lower()
    if what not in ("frfs", "modes"):
        raise SceneError(f"`what`: unknown {what!r}. Choose frfs or modes.")
    if kind not in ENDINGS:
        raise SceneError(
            f"{path}: unknown format {kind!r} for {what}. Choose a name that ends in one of {', '.join(ENDINGS)}."
        )
    resolve_output(path, overwrite=True)
    lines = []
    for number, (curves, nodes, driven) in enumerate(_sweeps(file, progress), start=1):
        target = path if number == 1 else path.with_name(f"{path.stem}-{number}{path.suffix}")
        with atomic_write(target, overwrite) as temporary:
            if what == "frfs":
                mat.write_frfs(curves, temporary) if kind == ".mat" else curves.to_uff(temporary, nodes, driven)
                lines.append(f"{curves.label}: {curves.name} of {curves.response} by {curves.input}")
            else:
                modes = identify(curves)
                # Responses with unbounded uncertainty have no component in the mode shapes.
                mode_nodes = [nodes[curves.keys().index(name)] for name in modes.responses]
                mat.write_modes(modes, temporary) if kind == ".mat" else uff.write_modes(modes, temporary, mode_nodes)
                lines.append(modes.summary())
        lines.append(f"wrote {target}, {target.stat().st_size / 1e6:.2f} MB")
    return lines


def _sweeps(file: Path, progress: CountProgress | None) -> list[tuple[Response, list[int], list[int]]]:
    """Return response, nodes of the outputs and nodes of the inputs (0: several bodies) of each sweep."""
    if is_frf_file(file):
        response = read_frfs(file)
        return [(response, list(range(1, len(response) + 1)), [0])]
    with open_existing(file) as rec:
        return [
            (
                response,
                [rec.channels[point.name].body for point in response.outputs],
                [_force_node(rec, point.name) for point in response.inputs],
            )
            for response in frequency_responses(rec, progress=progress)
        ]


def _force_node(rec: Recording, name: str) -> int:
    """Return the node of the body on which a force (`name`, if several) acts, or 0 for several bodies."""
    place = rec.channels[name].at if name in rec.channels else ""
    bodies = rec.scene.shakers[int(place.split()[1]) - 1].bodies if place.startswith("shaker ") else rec.scene.force_on
    return bodies[0] if len(bodies) == 1 else 0
