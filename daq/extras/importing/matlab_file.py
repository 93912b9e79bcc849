"""Reader of MATLAB and HDF5 files in a child process, because a damaged file can crash a reader.

This module is also the program of the child process: it writes the variables of the file to standard output, pickled.
Its arguments are the file and the allowed memory in bytes.
"""

import os
import pickle
import re
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.extras.importing.clock import warn
from rig.core.base.errors import RecordingError, RunError, ShotrigError
from rig.core.numerics.memory import LIMIT_VARIABLE, PROGRAM_BYTES, memory_limit

# Key of the names of the items that are not read; no variable has an empty name.
_UNREADABLE = ""
# Between the name of an array and that of its attribute.
ATTRIBUTE_MARK = "@"
# Attributes of an array that state its unit, its sample rate, its sample interval, or the value of one count.
_STATED_ATTRIBUTES = re.compile(
    r"units?|.*(rate|freq|fs|sr|dt|interval|increment|delta|scal|gain|factor|lsb|slope|cal).*", re.IGNORECASE
)
# Depth of structures within structures; a structure may refer to itself.
MAX_DEPTH = 8
# Maximum number of values in a file: cells may refer to themselves.
_MAX_VALUES = 100_000


def matlab_arrays(path: Path) -> dict[str, Any]:
    """Return the variables of a MATLAB or HDF5 file by name.

    Raises `RecordingError` for a damaged file, `RunError` for version 7.3 without h5py.
    """
    max_bytes = str(int(max(memory_limit() - PROGRAM_BYTES, memory_limit() / 2)))
    # The child gets the search path of this process: -m alone would search the current folder first.
    program = [sys.executable, "-P", "-m", __name__, str(path), max_bytes]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(str(Path(entry).absolute()) for entry in sys.path)}
    with subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment) as reader:
        assert reader.stdout is not None
        try:
            content: dict[str, Any] | ShotrigError = pickle.load(reader.stdout)
        except (EOFError, pickle.UnpicklingError):
            code = reader.wait()
            raise RecordingError(
                f"{path} cannot be read: it is damaged, or the memory is exhausted (exit code {code}). Save it again, "
                "or free memory."
            ) from None
    if isinstance(content, ShotrigError):
        raise content
    if unreadable := content.pop(_UNREADABLE, None):
        warn(f"{path}: items of a type that is not read are omitted: {', '.join(unreadable):.200}")
    return content


def _read_variables(path: str, max_bytes: int) -> dict[str, Any] | ShotrigError:
    """Return the variables of a file, or an error; use at most `max_bytes` of memory."""
    from scipy.io import loadmat

    with suppress(ImportError, ValueError, OSError):
        # A compressed file can expand to a thousand times its size. Not every system can limit a process.
        import resource

        _, hard = resource.getrlimit(resource.RLIMIT_DATA)
        resource.setrlimit(resource.RLIMIT_DATA, (max_bytes, hard))
    try:
        with suppress(NotImplementedError):
            if path.lower().endswith(".mat"):
                content = loadmat(path, squeeze_me=True, struct_as_record=True, chars_as_strings=True)
                return {key: value for key, value in content.items() if key[:2] != "__"}
        import h5py

        with h5py.File(path, "r") as file:
            hdf_reader = _HdfReader(file)
            # MATLAB stores the targets of references in cells and structures under names with #.
            variables = {key: hdf_reader.value(file[key]) for key in file if not key.startswith("#")}
            # Programs in Python state the sample rate as an attribute.
            stated = {key: value for key, value in file.attrs.items() if np.asarray(value).dtype.kind in "biufSU"}
            return {**stated, **_attributes(file), **variables, _UNREADABLE: hdf_reader.unreadable}
    except ImportError:
        return RunError(
            f"{path} is an HDF5 file, as MATLAB writes from version 7.3 on, which needs the package h5py. Install it: "
            "pip install 'shotrig[matlab]', or save the file in MATLAB with save(name, ..., '-v7')."
        )
    except MemoryError:
        return RecordingError(
            f"{path}: importing it takes more than the {memory_limit() / 1e9:.3g} GB of memory that are allowed. Save "
            f"the channels one by one, or as TDMS or WAV, or allow more: set {LIMIT_VARIABLE}=8GB in the environment."
        )
    except RecordingError as error:
        return RecordingError(f"{path} {error}")
    except Exception as error:
        # A damaged file can cause any exception in the reader.
        return RecordingError(
            f"{path} cannot be read as a MATLAB or HDF5 file ({type(error).__name__}: {error!s:.200}). Save it again."
        )


class _HdfReader:
    """Reads the items of an open file of version 7.3 (HDF5) in the form in which scipy reads older versions.

    Structures become dictionaries; cells become arrays of objects.
    """

    def __init__(self, file: Any) -> None:
        self._file = file
        self.unreadable: list[str] = []  # names of items of types that numpy does not have
        self._value_count = 0
        # Value of each item at each depth, and the number of values in it; cached because a malformed file may refer to
        # an item many times.
        self._cache: dict[tuple[int, int, int], tuple[Any, int]] = {}

    def value(self, item: Any, depth: int = 0) -> Any:
        """Return the value of an item; None if it is nested deeper than `MAX_DEPTH`."""
        from h5py import h5o

        info = h5o.get_info(item.id)
        key = (info.fileno, info.addr, depth)
        if key in self._cache:
            value, count = self._cache[key]
            self._count(count)
            return value
        count_before = self._value_count
        self._count(1)
        value = self._unread_value(item, depth) if depth <= MAX_DEPTH else None
        self._cache[key] = (value, self._value_count - count_before)
        return value

    def _count(self, count: int) -> None:
        self._value_count += count
        if self._value_count > _MAX_VALUES:
            raise RecordingError(
                f"has more than {_MAX_VALUES} values in its structures and cells. Save only the arrays of samples."
            )

    def _unread_value(self, item: Any, depth: int) -> Any:
        from h5py import check_dtype

        if hasattr(item, "keys"):
            fields = {name: self.value(item[name], depth + 1) for name in item}
            # Each field of an array of structures is a list of references, one for each structure.
            is_array = all(
                not hasattr(field, "keys") and check_dtype(ref=field.dtype) and not _matlab_class(field)
                for field in item.values()
            )
            if not (fields and is_array):
                return {**_attributes(item), **fields}
            structures = np.empty(min(np.size(values) for values in fields.values()), dtype=object)
            for number in range(structures.size):
                structures[number] = {name: values.ravel()[number] for name, values in fields.items()}
            return structures
        if item.attrs.get("MATLAB_empty", 0) or getattr(item, "size", None) in (None, 0):
            return np.array([])
        if check_dtype(vlen=item.dtype) is str:
            return np.asarray(item.asstr(errors="replace")[()], dtype=str).squeeze()
        if item.dtype.kind == "O" and not check_dtype(ref=item.dtype):
            self.unreadable.append(item.name)
            return None
        values: NDArray[Any] = np.asarray(item[()]).T.squeeze()
        if values.dtype.kind == "O":
            cells = np.empty(values.shape, dtype=object)
            for index, reference in np.ndenumerate(values):
                cells[index] = self.value(self._file[reference], depth + 1) if reference else None
            return cells
        if _matlab_class(item) == "char":
            return "".join(map(chr, values.ravel().tolist()))
        if values.dtype.names == ("real", "imag"):
            return values["real"] + 1j * values["imag"]
        return values


def _attributes(group: Any) -> dict[str, Any]:
    """Return the units and clocks that the items of a group state as attributes: ``force@unit``."""
    return {
        f"{name}{ATTRIBUTE_MARK}{key}": value
        for name in group
        for key, value in group[name].attrs.items()
        if not name.startswith("#") and _STATED_ATTRIBUTES.fullmatch(key) and np.asarray(value).dtype.kind in "biufSU"
    }


def _matlab_class(item: Any) -> str:
    kind = item.attrs.get("MATLAB_class", b"")
    return kind.decode() if isinstance(kind, bytes) else str(kind)


if __name__ == "__main__":
    pickle.dump(_read_variables(sys.argv[1], int(sys.argv[2])), sys.stdout.buffer, protocol=5)
