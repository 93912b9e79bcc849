"""Variables of MATLAB files of version 7.3, which are HDF5, in the form that scipy gives those of older versions."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

# Structures within structures that are read.
_DEEPEST = 8
# Values that are read: cells may refer to themselves.
_MOST = 100_000


def hdf5_variables(path: str) -> dict[str, Any]:
    """Read the variables: arrays, texts, structures as dictionaries, cells as arrays of objects.

    Raises `ImportError` without h5py, `OSError` for a damaged file.
    """
    import h5py

    with h5py.File(path, "r") as file:
        # Names with # are MATLAB's own: what cells and structures refer to.
        items = _Items(file)
        return {name: items.value(file[name]) for name in file if not name.startswith("#")}


class _Items:
    """The items of an open file, which refer to each other."""

    def __init__(self, file: Any) -> None:
        self._file = file
        self._count = 0

    def value(self, item: Any, depth: int = 0) -> Any:
        """Give the MATLAB value of an item; None beyond the depth of data."""
        self._count += 1
        if self._count > _MOST:
            raise ValueError(f"its structures and cells hold more than {_MOST} values")
        if depth > _DEEPEST:
            return None
        if hasattr(item, "keys"):
            fields = {name: self.value(item[name], depth + 1) for name in item}
            return _elements(fields) if fields and _is_array_of_structures(item) else fields
        if item.attrs.get("MATLAB_empty", 0):
            return np.array([])
        values: NDArray[Any] = np.asarray(item[()]).T.squeeze()
        if values.dtype.kind == "O":
            cells = np.empty(values.shape, dtype=object)
            for place, reference in np.ndenumerate(values):
                cells[place] = self.value(self._file[reference], depth + 1) if reference else None
            return cells
        if _kind(item) == "char":
            return "".join(map(chr, values.ravel().tolist()))
        if values.dtype.names == ("real", "imag"):
            return values["real"] + 1j * values["imag"]
        return values


def _kind(item: Any) -> str:
    kind = item.attrs.get("MATLAB_class", b"")
    return kind.decode() if isinstance(kind, bytes) else str(kind)


def _is_array_of_structures(group: Any) -> bool:
    """Whether each field is a list of references, one for each structure, rather than a value."""
    return all(
        not hasattr(item, "keys") and item.dtype.kind == "O" and not _kind(item) for item in group.values()
    )


def _elements(fields: dict[str, Any]) -> NDArray[Any]:
    """Sort the fields of several structures by structure."""
    count = min(np.size(values) for values in fields.values())
    structures = np.empty(count, dtype=object)
    for number in range(count):
        structures[number] = {name: values.ravel()[number] for name, values in fields.items()}
    return structures
