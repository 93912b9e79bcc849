"""MATLAB files, read in a separate process: a damaged file can crash the process of scipy's reader.

Run as a program, it writes the content of the file that its first argument names.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.errors import RecordingError, RunError
from rig.numerics.memory import LIMIT_VARIABLE, PROGRAM_BYTES, memory_limit

_NEEDS_H5PY, _NEEDS_MEMORY = "needs h5py", "needs more memory"
# Maximum depth of structures within structures.
_MAX_DEPTH = 8
# Maximum number of values: cells may refer to themselves.
_MAX_VALUES = 100_000


def matlab_arrays(path: Path) -> dict[str, Any]:
    """Read the variables of a MATLAB file.

    Raises `RecordingError` for a damaged file, `RunError` for version 7.3 without h5py.
    """
    memory = str(int(max(memory_limit() - PROGRAM_BYTES, memory_limit() / 2)))
    # The search path is that of this process: -m alone would search the user's folder first.
    program = [sys.executable, "-P", "-m", __name__, str(path.resolve()), memory]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(str(Path(entry).absolute()) for entry in sys.path)}
    with subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment) as reader:
        assert reader.stdout is not None
        try:
            content: dict[str, Any] | str = pickle.load(reader.stdout)
        except (EOFError, pickle.UnpicklingError):
            code = reader.wait()
            raise RecordingError(f"{path} is damaged: reading it ended with code {code}. Save it again.") from None
    if content == _NEEDS_H5PY:
        raise RunError(
            f"{path} is a MATLAB file of version 7.3 (HDF5), which needs the package h5py: pip install "
            "'shotrig[matlab]'; or in MATLAB: save(name, ..., '-v7')"
        )
    if content == _NEEDS_MEMORY:
        raise RecordingError(
            f"{path}: importing it takes more than the {memory_limit() / 1e9:.3g} GB of memory that are allowed. Save "
            f"the channels one by one, or as TDMS or WAV, or allow more: {LIMIT_VARIABLE}=8GB in the environment."
        )
    if isinstance(content, str):
        raise RecordingError(f"{path} {content}")
    return content


def _read(name: str, memory: int) -> dict[str, Any] | str:
    """Read the variables within a memory in bytes, or give an error text."""
    from scipy.io import loadmat

    with suppress(ImportError, ValueError, OSError):
        # Not every system can limit a process; a packed file holds a thousand times its size.
        import resource

        _, hard = resource.getrlimit(resource.RLIMIT_DATA)
        resource.setrlimit(resource.RLIMIT_DATA, (memory, hard))
    try:
        try:
            content = loadmat(name, squeeze_me=True, struct_as_record=True, chars_as_strings=True)
        except NotImplementedError:
            import h5py

            with h5py.File(name, "r") as file:
                items = _HdfItems(file)
                # Names with # are MATLAB's own: the targets of references in cells and structures.
                return {key: items.value(file[key]) for key in file if not key.startswith("#")}
    except ImportError:
        return _NEEDS_H5PY
    except MemoryError:
        return _NEEDS_MEMORY
    except Exception as error:
        # A damaged file can cause any exception in the reader.
        return f"is not a MATLAB file, or it is damaged: {type(error).__name__}: {error}"[:300]
    return {key: value for key, value in content.items() if key[:2] != "__"}


class _HdfItems:
    """The items of an open file of version 7.3, in the form that scipy gives those of older versions.

    Structures become dictionaries, cells arrays of objects.
    """

    def __init__(self, file: Any) -> None:
        self._file = file
        self._count = 0

    def value(self, item: Any, depth: int = 0) -> Any:
        """Return the MATLAB value of an item; None beyond the depth of data."""
        self._count += 1
        if self._count > _MAX_VALUES:
            raise ValueError(f"its structures and cells hold more than {_MAX_VALUES} values")
        if depth > _MAX_DEPTH:
            return None
        if hasattr(item, "keys"):
            fields = {name: self.value(item[name], depth + 1) for name in item}
            # Each field of an array of structures is a list of references, one for each structure.
            array = all(
                not hasattr(each, "keys") and each.dtype.kind == "O" and not _kind(each) for each in item.values()
            )
            if not (fields and array):
                return fields
            structures = np.empty(min(np.size(values) for values in fields.values()), dtype=object)
            for number in range(structures.size):
                structures[number] = {name: values.ravel()[number] for name, values in fields.items()}
            return structures
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


if __name__ == "__main__":
    pickle.dump(_read(sys.argv[1], int(sys.argv[2])), sys.stdout.buffer, protocol=5)
