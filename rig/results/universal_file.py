"""Frequency responses as data sets 58 of Universal Files, which modal programs read."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rig.errors import RunError, SceneError
from rig.escaping import shown

if TYPE_CHECKING:
    from rig.results.response import Response

#: Function types of data set 58.
FRF, GENERAL = 4, 0
#: Beginnings of lines in which our files state what the format has no field for: the width over which leakage smears
#: each line of a response, and of which response a general function is the standard deviation.
RESOLUTION_LINE, DEVIATION_LINE = "shotrig: resolution", "standard deviation of"
#: Kinds of data in the format's own numbering.
KINDS = {"displacement": 8, "velocity": 11, "acceleration": 12, "force": 13, "voltage": 1}
_UNITS = {"displacement": "m", "velocity": "m/s", "acceleration": "m/s²"}


def write_responses(
    response: Response, path: Path, nodes: Sequence[int] | None = None, driven: Sequence[int] = (0,)
) -> None:
    """Write responses to forces in text, with a data set 58 (function type 4) for each.

    After each follows its standard deviation, as a general function (type 0), which other programs skip.

    Parameters
    ----------
    nodes : sequence of int, optional
        Of the outputs, whose direction is +Z; omitted, by their places, or their numbers.
    driven : sequence of int
        Nodes of the inputs.

    Raises
    ------
    SceneError
        If they are responses to something else.
    RunError
        If pyuff is not installed.
    """
    file = universal_file(path)
    if nodes is None:
        nodes = [_node(point.place, number) for number, point in enumerate(response.outputs, 1)]
    places = [(node, force) for node in nodes for force in driven]
    for number, (curve, (node, force)) in enumerate(zip(response.sorted().curves(), places, strict=True), 1):
        if curve.reference != "force":
            raise SceneError(
                f"{curve.response}: a response to the {curve.reference}; UFF 58 is written of forces"
            )
        steps = np.diff(curve.frequency)
        where = {
            "type": 58, "binary": 0, "id2": line(curve.label), "id3": line(curve.ratio),
            "id4": f"{RESOLUTION_LINE} {curve.resolution!r} Hz",
            "rsp_ent_name": "NONE", "rsp_node": node, "rsp_dir": 3,
            "ref_ent_name": "NONE", "ref_node": force, "ref_dir": 3,
            "abscissa_spacing": int(np.ptp(steps) < 1e-6 * steps.mean()) if steps.size else 0,
            "abscissa_spec_data_type": 18, "abscissa_axis_lab": "Frequency", "abscissa_axis_units_lab": "Hz",
            "ordinate_spec_data_type": KINDS[curve.motion], "ordinate_axis_lab": curve.motion.capitalize(),
            "ordinate_axis_units_lab": _UNITS[curve.motion],
            "orddenom_spec_data_type": KINDS["force"], "orddenom_axis_lab": "Force",
            "orddenom_axis_units_lab": "N", "z_axis_spec_data_type": 0, "x": curve.frequency,
        }  # fmt: skip
        title = f"{curve.response}: {curve.name}"
        write_set(
            file, {**where, "func_type": FRF, "func_id": number, "id1": line(title), "data": curve.value}
        )
        if np.isfinite(curve.error).all():
            identification = line(f"{DEVIATION_LINE} {title}")
            write_set(
                file,
                {
                    **where,
                    "func_type": GENERAL,
                    "func_id": number,
                    "id1": identification,
                    "data": curve.error,
                },
            )


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


def _node(place: str, number: int) -> int:
    last = place.rpartition(" ")[2]
    return int(last) if place.startswith("body ") and last.isdigit() else number
