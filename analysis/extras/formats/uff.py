"""Export of channels and modes as Universal Files (data sets 58 and 55) for modal analysis programs."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from analysis.core.modal.modes import Modes
from analysis.core.recordings.slices import Slice
from rig.core.base.arrays import Array
from rig.core.base.errors import SceneError
from rig.core.base.output_files import temporary_folder
from rig.core.results.universal_file import QUANTITY_NUMBERS, text_line, universal_file, write_set

# Maximum number of samples of a channel: 340 MB of text.
MAX_TEXT_SAMPLES = 1 << 24


def write_uff(segment: Slice, path: Path) -> None:
    """Write a UFF text file with a data set 58 (time response) for each channel.

    Node n is body n, and direction +Z is up; table and hammer are node 0. The format rounds the sample interval to six
    digits; the fourth line of each data set contains the exact rate.

    Raises `RecordingError` if samples were lost. Raises `SceneError` if there are too many samples for a text file,
    or too few for the format. Raises `RunError` if pyuff is not installed.
    """
    segment.reject_gaps("UFF 58")
    count = segment.stop - segment.start
    if not 2 <= count <= MAX_TEXT_SAMPLES:
        raise SceneError(
            f"{segment.recording.path}: UFF 58 as text can contain 2 to {MAX_TEXT_SAMPLES} samples per channel; this "
            f"segment has {count}. Choose another segment (`from_s`, `to_s`), or export an .npz file."
        )
    recording = segment.recording
    universal_file(path, recording.scene.name, [info.body for info in segment.infos])
    with path.open("ab") as file:
        for number, info in enumerate(segment.infos, start=1):
            pieces = (np.nan_to_num(rows[0]) for _, rows in segment.pieces([info.name]))
            fields = {
                "type": 58, "binary": 0, "func_type": 1, "func_id": number,
                "id1": text_line(f"{info.name}: {info.quantity} at {info.at}"),
                "id2": text_line(f"from {recording.path.name}"),
                "id4": text_line(f"sample rate {recording.rate!r} Hz"),
                "rsp_ent_name": "NONE", "rsp_node": info.body, "rsp_dir": 3,
                "ref_ent_name": "NONE", "ref_node": 0, "ref_dir": 0,
                "abscissa_spacing": 1, "abscissa_spec_data_type": 17,
                "abscissa_axis_lab": "Time", "abscissa_axis_units_lab": "s",
                "ordinate_spec_data_type": QUANTITY_NUMBERS[info.quantity],
                "ordinate_axis_lab": info.quantity.capitalize(), "ordinate_axis_units_lab": info.unit,
                "orddenom_spec_data_type": 0, "z_axis_spec_data_type": 0,
                "x": np.arange(segment.start, segment.start + 2) / recording.rate,
            }  # fmt: skip
            _write_pieces(file, fields, count, pieces)


def _write_pieces(file: BinaryIO, fields: dict[str, Any], count: int, pieces: Iterator[Array]) -> None:
    # pyuff would write the whole data set as one text, and reads the whole file after each data set.
    import pyuff

    with temporary_folder() as folder:
        path = folder / "piece.uff"
        write_set(pyuff.UFF(str(path)), {**fields, "data": next(pieces)})
        *lines, delimiter = path.read_bytes().splitlines(keepends=True)
    # The ninth line begins with the data type and the number of samples, in ten columns each.
    lines[8] = b"%b%10d%b" % (lines[8][:10], count, lines[8][20:])
    file.writelines(lines)
    # The line ending that pyuff wrote: the remainder of the delimiter "    -1".
    line_end = delimiter.lstrip(b" -1")
    for samples in pieces:
        full, rest = divmod(samples.size, 4)
        form = (b"%20.11e" * 4 + line_end) * full + (b"%20.11e" * rest + line_end if rest else b"")
        file.write(form % tuple(samples.tolist()))
    file.write(delimiter)


def write_modes(modes: Modes, path: Path, nodes: Sequence[int]) -> None:
    """Write a UFF text file with a data set 55 (complex eigenvalue) for each mode: pole in rad/s, shape along +Z.

    The largest component of each shape is scaled to 1, because UFF 55 states no scaling.
    """
    file = universal_file(path, modes.label, nodes)
    for number, (pole, shape) in enumerate(zip(modes.poles, modes.shapes.T, strict=True), start=1):
        zeros = np.zeros(shape.size, dtype=complex)
        damping = 100.0 * modes.damping[number - 1]
        write_set(
            file,
            {
                "type": 55, "id1": text_line(modes.label), "id2": text_line(f"nodes {', '.join(modes.responses)}"),
                "id4": f"mode {number}, {modes.frequency[number - 1]:.6g} Hz, damping ratio {damping:.4g} %",
                "model_type": 1, "analysis_type": 3, "data_ch": 2, "spec_data_type": 8, "load_case": 1,
                "mode_n": number, "eig": complex(pole), "modal_a": 0j, "modal_b": 0j,
                "node_nums": list(nodes), "r1": zeros, "r2": zeros, "r3": shape,
            },
        )  # fmt: skip
