"""Frequency responses as data sets 58 of Universal Files, which modal programs read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rig.arrays import Array, ComplexArray
from rig.errors import RunError
from rig.escaping import shown

#: Function types of data set 58.
FRF, GENERAL = 4, 0
#: Beginnings of lines in which our files state what the format has no field for: the width over which leakage smears
#: each line of a response, and of which response a general function is the standard deviation.
RESOLUTION_LINE, DEVIATION_LINE = "shotrig: resolution", "standard deviation of"
#: Kinds of data in the format's own numbering.
KINDS = {"displacement": 8, "velocity": 11, "acceleration": 12, "force": 13, "voltage": 1}
_UNITS = {"displacement": "m", "velocity": "m/s", "acceleration": "m/s²"}


def write_curve(
    file: Any, number: int, node: int, driven: int, title: str, labels: tuple[str, str], motion: str,
    resolution: float, frequency: Array, value: ComplexArray, error: Array,
) -> None:  # fmt: skip
    """Append a response to a force as a data set 58 of function type 4.

    After it follows its standard deviation, as a general function (type 0), which other programs skip.

    `number`, `node`, `driven`: of the function, of the output, whose direction is +Z, and of the force; `title`,
    `labels`: response and ratio; scene and ratio; `motion`: quantity of the response; `resolution`: Hz.
    """
    steps = np.diff(frequency)
    where = {
        "type": 58, "binary": 0, "id2": line(labels[0]), "id3": line(labels[1]),
        "id4": f"{RESOLUTION_LINE} {resolution!r} Hz",
        "rsp_ent_name": "NONE", "rsp_node": node, "rsp_dir": 3,
        "ref_ent_name": "NONE", "ref_node": driven, "ref_dir": 3,
        "abscissa_spacing": int(np.ptp(steps) < 1e-6 * steps.mean()) if steps.size else 0,
        "abscissa_spec_data_type": 18, "abscissa_axis_lab": "Frequency", "abscissa_axis_units_lab": "Hz",
        "ordinate_spec_data_type": KINDS[motion], "ordinate_axis_lab": motion.capitalize(),
        "ordinate_axis_units_lab": _UNITS[motion],
        "orddenom_spec_data_type": KINDS["force"], "orddenom_axis_lab": "Force",
        "orddenom_axis_units_lab": "N", "z_axis_spec_data_type": 0, "x": frequency,
    }  # fmt: skip
    write_set(file, {**where, "func_type": FRF, "func_id": number, "id1": line(title), "data": value})
    if np.isfinite(error).all():
        deviation = line(f"{DEVIATION_LINE} {title}")
        write_set(file, {**where, "func_type": GENERAL, "func_id": number, "id1": deviation, "data": error})


def universal_file(path: Path) -> Any:
    """Open a file for `write_set`."""
    try:
        import pyuff
    except ImportError:
        raise RunError("UFF files need the package pyuff: pip install 'shotrig[export]'") from None
    return pyuff.UFF(str(path))


def write_set(file: Any, data: dict[str, Any]) -> None:
    """Append a data set."""
    try:
        file.write_sets(data, mode="add")
    except Exception as error:
        # pyuff hides what the disk said.
        if isinstance(error.__context__, OSError):
            raise error.__context__ from None
        raise


def line(text: str) -> str:
    """Fit text into a line of a data set."""
    return " ".join(shown(text).split())[:80] or "NONE"
