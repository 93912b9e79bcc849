"""Writing of frequency responses to Universal Files (data set 58), which programs for modal analysis read."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import RunError
from rig.core.base.escaping import escape_terminal

#: Function types of data set 58: frequency response, and general function.
FRF, GENERAL = 4, 0
#: Beginning of the text line that states the bandwidth of each frequency of a response.
RESOLUTION_LINE = "shotrig: resolution"
#: Beginning of the text line of a response's standard deviation (general function), before the response's name.
DEVIATION_LINE = "standard deviation of"
#: Beginning of the text line of a general function that contains the bound of the systematic errors of a response.
BOUND_LINE = "systematic bound of"
#: Written instead of an infinite bound, because the writer has no infinity.
UNBOUNDED = 1e60
#: Numbers of the physical quantities in the format.
QUANTITY_NUMBERS = {"displacement": 8, "velocity": 11, "acceleration": 12, "force": 13, "voltage": 1}
_UNITS = {"displacement": "m", "velocity": "m/s", "acceleration": "m/s²"}


def write_curve(
    file: Any, number: int, output_node: int, force_node: int, title: str, labels: tuple[str, str], motion: str,
    resolution: float, frequency: Array, value: ComplexArray, error: Array,
    bound: Array | None = None,
) -> None:  # fmt: skip
    """Append a response to a force as a data set 58 of function type 4.

    The standard deviation of the response and the bound of its systematic errors follow as general functions (type 0),
    which other programs skip.

    `number`: number of the function in the file. `output_node`, `force_node`: nodes of the output and of the force,
    both in the direction +Z. `title`, `labels`: text lines 1, and 2 and 3, of the data set. `motion`: quantity of the
    response. `resolution`: bandwidth of each frequency [Hz]. `error`: standard uncertainty of the real and of the
    imaginary part. `bound`: bound of the systematic errors; not written if it is unknown.
    """
    steps = np.diff(frequency)
    fields = {
        "type": 58, "binary": 0, "id2": text_line(labels[0]), "id3": text_line(labels[1]),
        "id4": f"{RESOLUTION_LINE} {resolution!r} Hz",
        "rsp_ent_name": "NONE", "rsp_node": output_node, "rsp_dir": 3,
        "ref_ent_name": "NONE", "ref_node": force_node, "ref_dir": 3,
        "abscissa_spacing": int(np.ptp(steps) < 1e-6 * steps.mean()) if steps.size else 0,
        "abscissa_spec_data_type": 18, "abscissa_axis_lab": "Frequency", "abscissa_axis_units_lab": "Hz",
        "ordinate_spec_data_type": QUANTITY_NUMBERS[motion], "ordinate_axis_lab": motion.capitalize(),
        "ordinate_axis_units_lab": _UNITS[motion],
        "orddenom_spec_data_type": QUANTITY_NUMBERS["force"], "orddenom_axis_lab": "Force",
        "orddenom_axis_units_lab": "N", "z_axis_spec_data_type": 0, "x": frequency,
    }  # fmt: skip
    write_set(file, {**fields, "func_type": FRF, "func_id": number, "id1": text_line(title), "data": value})
    columns = (
        (DEVIATION_LINE, error if np.isfinite(error).all() else None),
        (BOUND_LINE, None if bound is None else np.nan_to_num(bound, nan=UNBOUNDED, posinf=UNBOUNDED)),
    )
    for beginning, column in columns:
        if column is not None:
            line = text_line(f"{beginning} {title}")
            write_set(file, {**fields, "func_type": GENERAL, "func_id": number, "id1": line, "data": column})


def universal_file(path: Path, title: str, nodes: Iterable[int]) -> Any:
    """Open a new file for `write_set`, with title (151), units (164, SI), nodes (15) and the line through them (82).

    The nodes of bodies lie on the axis Z at their numbers, because a scene has no coordinates. Node 0, for table and
    hammer, is omitted. The dates are constant, so equal results give equal files.
    """
    try:
        import pyuff
    except ImportError:
        raise RunError("UFF files: pyuff is not installed. Run pip install 'shotrig[export]'.") from None
    file = pyuff.UFF(str(path))
    names = {"model_name": text_line(title), "description": "NONE", "db_app": "shotrig", "program": "shotrig"}
    dates = dict.fromkeys(("date_db_created", "date_db_saved", "date_file_written"), "01-Jan-80")
    times = dict.fromkeys(("time_db_created", "time_db_saved", "time_file_written"), "00:00:00")
    write_set(file, {"type": 151, **names, **dates, **times})
    si = {"units_code": 1, "units_description": "SI: m, N, s"}
    write_set(file, {"type": 164, **si, "temp_mode": 1, "length": 1.0, "force": 1.0, "temp": 1.0, "temp_offset": 0.0})
    bodies = np.array(sorted({node for node in nodes if node > 0}))
    if bodies.size:
        origin = np.zeros(bodies.size)
        write_set(file, {"type": 15, "node_nums": bodies, "x": origin, "y": origin, "z": bodies.astype(float)})
        write_set(file, {"type": 82, "trace_num": 1, "id": "bodies", "nodes": bodies})
    return file


def write_set(file: Any, data: dict[str, Any]) -> None:
    """Append a data set; raise `OSError` if the file cannot be written."""
    try:
        file.write_sets(data, mode="add")
    except Exception as error:
        # pyuff replaces the error of the file system, although only this error states the cause.
        if isinstance(error.__context__, OSError):
            raise error.__context__ from None
        raise


def text_line(text: str) -> str:
    """Shorten text to a line of a data set."""
    return " ".join(escape_terminal(text).split())[:80] or "NONE"
