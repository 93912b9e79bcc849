"""Signals from files of named arrays: numpy's .npz and .npy, MATLAB's .mat, and HDF5.

An array contains samples, times, or a setting such as the sample rate, according to its size and its name.
"""

import re
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.extras.importing.clock import (
    Clock,
    clock_of_times,
    looks_like_times,
    rate_of_interval,
    time_scale,
    warn,
    warn_used_as_times,
)
from daq.extras.importing.matlab_file import ATTRIBUTE_MARK, MAX_DEPTH, matlab_arrays
from daq.extras.importing.signal import Signal
from daq.extras.importing.units import warn_of_scale
from rig.core.base.errors import RecordingError, ShotrigError
from rig.core.numerics.memory import require_memory_with_program

# Names of arrays that state the sample rate.
_RATE_NAMES = re.compile(r"(.*[._])?(f_?s|sr|rate|(samp|sample|sampling)_?(rate|freq|frequency))(_?hz)?", re.IGNORECASE)
# Names of arrays that state the sample interval.
_INTERVAL_NAMES = re.compile(r"(.*[._])?(dt|ts|increment|delta_?t|(sample_?|t)?interval|x?delta)(_?s)?", re.IGNORECASE)
# Names of arrays that contain the times of the samples.
_TIME_NAMES = re.compile(r"(.*[._])?(t|time|times|zeit)(_s)?", re.IGNORECASE)
# Names of the index of a table of pandas; it contains times if it rises evenly, but not by 1.
_INDEX_NAMES = re.compile(r".*\.(axis1|index)")
# Shorter arrays are settings, not samples.
_MIN_SAMPLES = 16
# Two-dimensional arrays with more channels do not contain samples.
_MAX_CHANNELS = 4096
# Maximum number of structures that are read from an array, to limit the time for malformed files.
_MAX_STRUCTURES = 1000
# Memory for estimating the clock, bytes per time: the times as floats, and the times in s.
_CLOCK_BYTES = 16


def array_signals(path: Path, _stack: ExitStack) -> list[Signal]:
    """List the arrays of a numpy or MATLAB file as signals in memory."""
    return _signals(path, arrays_of(path))


def arrays_of(path: Path) -> dict[str, Any]:
    """Return the arrays of a numpy or MATLAB file by name; the names of arrays in structures are paths.

    Raises `RecordingError` for a damaged file and for arrays of Python objects.
    """
    is_numpy = path.suffix.lower() in (".npz", ".npy")
    return _numpy_arrays(path) if is_numpy else dict(_flatten(matlab_arrays(path)))


def _numpy_arrays(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            if file.read(6) == b"\x93NUMPY":
                array = np.load(path, mmap_mode="r", allow_pickle=False)
                return {name: array[name] for name in array.dtype.names or ()} or {"array": array}
        # Compression can shrink an archive to a thousandth of its content.
        with zipfile.ZipFile(path) as packed:
            require_memory_with_program(sum(entry.file_size for entry in packed.infolist()), f"{path}: importing it")
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (OSError, MemoryError, ShotrigError):
        raise
    except Exception as error:
        # A damaged file can cause any exception in the reader.
        raise RecordingError(
            f"{path} cannot be read as an .npz or .npy file of numbers ({error!s:.200}). Save the file again, "
            "with arrays of numbers only."
        ) from error


def _flatten(content: Mapping[str, Any], prefix: str = "", depth: int = 0) -> Iterator[tuple[str, Any]]:
    """Yield name and array of each variable; the fields of structures have paths: ``Signal_1.y_values.values``."""
    for name, value in content.items():
        path = f"{prefix}{name}"
        if isinstance(value, Mapping):
            if depth < MAX_DEPTH:
                yield from _flatten(value, f"{path}.", depth + 1)
            continue
        array = np.asarray(value)
        items = array.ravel()[:_MAX_STRUCTURES]
        if array.dtype.names and array.size >= _MIN_SAMPLES and not array.dtype.hasobject:
            # A table, as pandas and h5py store it: a column for each name.
            yield from _flatten({column: array[column] for column in array.dtype.names}, f"{path}.", depth + 1)
        elif array.dtype.names and depth < MAX_DEPTH:
            for number, item in enumerate(items, 1):
                item_path = path if items.size == 1 else f"{path}({number})"
                yield from _flatten(dict(zip(array.dtype.names, item, strict=True)), f"{item_path}.", depth + 1)
        elif array.dtype.kind == "O" and array.size == 1 and depth < MAX_DEPTH:
            yield from _flatten({name: array.item()}, prefix, depth + 1)
        elif array.dtype.kind == "O" and all(isinstance(item, Mapping) for item in array.flat):
            for number, item in enumerate(items, 1):
                yield from _flatten({f"{name}({number})": item}, prefix, depth + 1)
        else:
            yield path, array


def _signals(path: Path, content: Mapping[str, Any]) -> list[Signal]:
    """Return the signals in named arrays, with the clocks and units that other arrays state."""
    arrays = {name: np.asarray(value) for name, value in content.items()}
    numbers = {name: array for name, array in arrays.items() if array.dtype.kind in "fiu"}
    in_memory = sum(array.nbytes for array in numbers.values() if not isinstance(array, np.memmap))
    sample_arrays: dict[str, NDArray[Any]] = {}
    clocks: dict[str, Clock] = {}
    for name, array in numbers.items():
        if array.size < _MIN_SAMPLES or array.ndim > 2 or (array.ndim == 2 and min(array.shape) > _MAX_CHANNELS):
            continue
        where, times_in = f"{path}: {name!r}", f"{path}: the times in {name!r}"
        # There are more samples than channels, in either orientation.
        is_table = array.ndim == 2
        rows = min(np.atleast_2d(array), np.atleast_2d(array).T, key=len)
        first, unit = rows[0], "" if is_table else _stated_unit(arrays, name)
        may_be_times = len(rows) > 1 if is_table else first.dtype.kind == "f" and _INDEX_NAMES.fullmatch(name)
        is_named = not is_table and _TIME_NAMES.fullmatch(name) is not None
        if may_be_times or is_named:
            require_memory_with_program(in_memory + _CLOCK_BYTES * first.size, f"{path}: importing it")
        is_rising = bool(may_be_times) and looks_like_times(first.astype(float), float(first[-1]), first.size)
        has_times = is_named or is_rising
        if has_times:
            if is_rising and not unit:
                column = f"{where}: its first row or column" if is_table else where
                warn_used_as_times(column, float(first[1]) - float(first[0]))
            scale = 1.0
            try:
                scale = time_scale(unit, times_in)
            except RecordingError as error:
                warn(f"{error}. The times are read in s. If this is wrong, correct the unit.")
            clocks[f"{name}(1)" if is_table else name] = clock_of_times(scale * first.astype(float), 0.0, times_in)
        sample_arrays |= {
            f"{name}({number})" if is_table else name: row
            for number, row in enumerate(rows[int(has_times) :], 1 + has_times)
        }
    if not sample_arrays:
        listed = [f"{name} {array.shape}" for name, array in arrays.items() if ATTRIBUTE_MARK not in name]
        ellipsis = " ..." if len(listed) > 8 else ""
        raise RecordingError(
            f"{path} contains no array of samples; it contains {', '.join(listed[:8]) + ellipsis or 'nothing'}. "
            + (
                "If its complex numbers are frequency responses, give the file to `analysis frf`."
                if any(array.dtype.kind == "c" for array in arrays.values())
                else "Save the samples as numbers: an array for each channel, or an array with a row or column for "
                "each channel."
            )
        )
    scalars = {name: float(array.ravel()[0]) for name, array in numbers.items() if array.size == 1}
    if counts := [name for name, array in sample_arrays.items() if array.dtype.kind in "iu"]:
        warn_of_scale(f"{path}: {counts[0]!r}", scalars)
    # Units in the form that `analysis export` writes: two rows of strings, ``channels`` and ``units``.
    texts = (arrays.get(key, np.array([])).ravel().tolist() for key in ("channels", "units"))
    units = dict(zip(*(map(str, text) for text in texts), strict=False))
    return [
        Signal.from_array(
            path,
            number,
            name,
            units.get(name) or units.get(name.partition("(")[0]) or _stated_unit(arrays, name),
            row,
            _clock_of(path, name, scalars, clocks),
        )
        for number, (name, row) in enumerate(sample_arrays.items(), 1)
    ]


def _stated_unit(arrays: Mapping[str, NDArray[Any]], name: str) -> str:
    """Return the unit that an array states as an attribute; an empty string without it."""
    stated = (arrays.get(f"{name.partition('(')[0]}{ATTRIBUTE_MARK}{key}") for key in ("unit", "units"))
    return next((_text(unit) for unit in stated if unit is not None and unit.size == 1), "")


def _text(array: NDArray[Any]) -> str:
    value = array.item()
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)


def _clock_of(path: Path, name: str, scalars: Mapping[str, float], clocks: Mapping[str, Clock]) -> Clock:
    """Return the clock of a signal; a clock in its own structure overrides the clock of the whole file."""
    clock_key = f"{name.partition('(')[0]}(1)"
    if clock_key in clocks:
        return clocks[clock_key]
    structure = name.split(".", 1)[0] if "." in name else ""
    own_prefix = f"{name.partition('(')[0]}{ATTRIBUTE_MARK}"

    def matching_names(pattern: re.Pattern[str], named: Mapping[str, Any]) -> list[str]:
        own = [key for key in named if key.startswith(own_prefix) and pattern.fullmatch(key.removeprefix(own_prefix))]
        matching = [key for key in named if ATTRIBUTE_MARK not in key and pattern.fullmatch(key)]
        in_structure = [key for key in matching if structure and key.startswith(f"{structure}.")]
        return own or in_structure or [key for key in matching if "." not in key]

    if times := matching_names(_TIME_NAMES, clocks) or matching_names(_INDEX_NAMES, clocks):
        return clocks[times[0]]
    start = next((scalars[key] for key in ("start_s", f"{structure}.x_values.start_value") if key in scalars), 0.0)
    for key in matching_names(_RATE_NAMES, scalars):
        if not 0 < scalars[key] < 1e12:
            raise RecordingError(
                f"{path}: {key} = {scalars[key]!r}; expected a sample rate above 0, in Hz. Correct the file."
            )
        return Clock(scalars[key], start)
    for key in matching_names(_INTERVAL_NAMES, scalars):
        return Clock(rate_of_interval(scalars[key], where=f"{path}: {key}"), start)
    return Clock(None, start)
