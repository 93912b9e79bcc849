"""Variables of MATLAB files of version 7.3, which are HDF5, as scipy gives those of older ones."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_DEEPEST = 8
# What refers to itself would otherwise be followed for ever.
_MOST = 100_000


def hdf5_variables(path: str) -> dict[str, Any]:
    """Read the variables: arrays, texts, structures as dictionaries, cells as arrays of objects.

    Raises
    ------
    ImportError
        If h5py is not installed.
    OSError
        If the file is damaged.
    """
    import h5py

    with h5py.File(path, "r") as file:
        # Names with # are MATLAB's own: what cells and structures refer to.
        found = _Items(file)
        return {name: found.value(file[name]) for name in file if not name.startswith("#")}


class _Items:
    """The items of an open file, as far as they refer to each other."""

    def __init__(self, file: Any) -> None:
        self._file = file
        self._count = 0

    def value(self, item: Any, depth: int = 0) -> Any:
        """Turn an item into what MATLAB has there; what lies deeper than data do is left out."""
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
            found = np.empty(values.shape, dtype=object)
            for place, reference in np.ndenumerate(values):
                found[place] = self.value(self._file[reference], depth + 1) if reference else None
            return found
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
    found = np.empty(count, dtype=object)
    for number in range(count):
        found[number] = {name: values.ravel()[number] for name, values in fields.items()}
    return found
