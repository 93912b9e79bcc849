"""Reading of modes that another program estimated or computed: Universal Files with data sets 55."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from analysis.core.modal.modes import Modes
from daq.extras.importing.uff import data_sets, direction
from rig.core.base.arrays import ComplexArray
from rig.core.base.errors import RecordingError
from rig.core.base.input_files import as_path

# Analysis types of data set 55: normal modes, and complex eigenvalues of first order.
_NORMAL, _COMPLEX = 2, 3
_COMPONENTS = tuple(f"r{number}" for number in range(1, 7))


def read_modes(path: str | Path) -> Modes:
    """Read the modes in a Universal File (data sets 55: normal modes, or complex eigenvalues).

    Parameters
    ----------
    path : str or Path
        File with one data set 55 for each mode, all with the same nodes.

    Returns
    -------
    Modes
        Frequencies, damping ratios and shapes, named after nodes and directions such as ``3 +Z``; directions without
        motion in all modes are omitted. The file states no uncertainty, so standard uncertainties are NaN. The residues
        equal the shapes, because the file may lack modal masses; the result of `receptance` is therefore known only up
        to a factor.

    Raises
    ------
    RecordingError
        If the file is damaged, contains no modes, or its modes have different nodes.
    """
    file = as_path(path)
    sets = [
        data_set for data_set in data_sets(file, (55,)) if int(data_set.get("analysis_type", 0)) in (_NORMAL, _COMPLEX)
    ]
    if not sets:
        raise RecordingError(
            f"{file} contains no modes (data set 55 of analysis type 2 or 3). Export the mode shapes as data set 55."
        )
    nodes = [int(node) for node in sets[0]["node_nums"]]
    if any([int(node) for node in data_set["node_nums"]] != nodes for data_set in sets):
        raise RecordingError(f"{file}: its modes have different nodes. Export all modes with the same nodes.")
    shapes, names = _shapes(file, sets, nodes)
    poles = np.array([_pole(data_set) for data_set in sets])
    order = np.argsort(abs(poles))
    poles, shapes = poles[order], shapes[:, order]
    unknown, count = np.full(poles.size, np.nan), len(names)
    return Modes(
        frequency=np.asarray(abs(poles) / (2.0 * np.pi), dtype=np.float64),
        frequency_std=unknown,
        damping=0.0 - poles.real / abs(poles),  # an undamped mode has 0.0, not -0.0
        damping_std=unknown,
        shape_std=np.full(shapes.shape, np.nan),
        residue=shapes,
        responses=names,
        chart=(),
        lower=np.zeros(count),
        upper=np.zeros((count, 3)),
        model_error=0.0,
        label=file.stem,
        warnings=(f"{file.name} states no uncertainty of its modes.",),
    )


def _shapes(
    file: Path, sets: Sequence[Mapping[str, Any]], nodes: Sequence[int]
) -> tuple[ComplexArray, tuple[str, ...]]:
    """Return the shapes, shape (points, modes), and the names of the points that move."""
    rows, names = [], []
    for number, component in enumerate(_COMPONENTS, 1):
        if component not in sets[0]:
            continue
        values = np.array([np.asarray(data_set[component], dtype=complex) for data_set in sets]).T
        for node, row in zip(nodes, values, strict=True):
            if np.any(row):
                rows.append(row)
                names.append(f"{node} {direction(number)}")
    if not rows:
        raise RecordingError(f"{file}: the mode shapes are zero at all nodes. Export the modes again.")
    return np.array(rows), tuple(names)


def _pole(data_set: Mapping[str, Any]) -> complex:
    """Return the pole [rad/s] of a mode: the eigenvalue, or the pole for natural frequency and viscous damping."""
    if int(data_set["analysis_type"]) == _COMPLEX:
        return complex(data_set["eig"])
    # The formula of the pole is valid for damping ratios from 0 to 1.
    damping = min(max(float(data_set["modal_damp_vis"]), 0.0), 1.0)
    return complex(2.0 * np.pi * float(data_set["freq"]) * (-damping + 1j * np.sqrt(1.0 - damping**2)))
