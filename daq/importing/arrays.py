"""Signals of files that hold named arrays: numpy's .npz and .npy, MATLAB's .mat."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.importing.matlab_file import matlab_arrays
from daq.importing.signal import (
    Array,
    Signal,
    held,
    looks_like_times,
    rate_of_interval,
    tell_times,
)
from daq.importing.time_gaps import Missing, clock_with_gaps, with_missing
from rig.errors import RecordingError, ShotrigError
from rig.numerics.memory import need_beside_program

# Rate in Hz, first time in s, gaps.
Clock = tuple[float, float, list[Missing]]
# What programs call the sample rate, the sample interval and the times.
_RATES = re.compile(
    r"(.*[._])?(f_?s|sr|rate|(samp|sample|sampling)_?(rate|freq|frequency))(_?hz)?", re.IGNORECASE
)
_INTERVALS = re.compile(r"(.*[._])?(dt|ts|increment|delta_?t|sample_?interval|x?delta)(_?s)?", re.IGNORECASE)
_TIMES = re.compile(r"(.*[._])?(t|time|times|zeit)(_s)?", re.IGNORECASE)
# Shorter arrays are settings, not samples.
_SHORTEST = 16
_DEEPEST = 8
# Memory that finding the clock takes of each time, bytes: the times, those of an even grid and their differences.
_CLOCK_BYTES = 48


def numpy_signals(path: Path) -> list[Signal]:
    """List the arrays of an .npz or .npy file, which are held in memory; arrays of Python objects are refused."""
    try:
        arrays = _numpy_arrays(path)
    except (OSError, MemoryError, ShotrigError):
        raise
    except Exception as error:
        # The reader meets damage as whatever it happens to lead to.
        raise RecordingError(
            f"{path} is no .npz or .npy file of numbers, or it is damaged: {error!s:.200}"
        ) from error
    return _signals(path, arrays)


def _numpy_arrays(path: Path) -> dict[str, Any]:
    """Read what is in the file, as far as memory allows: an archive of zeros is a thousandth of what it holds."""
    with path.open("rb") as file:
        if file.read(6) == b"\x93NUMPY":
            array = np.load(path, mmap_mode="r", allow_pickle=False)
            # It is read in place.
            return {"array": array}
    with zipfile.ZipFile(path) as packed:
        need_beside_program(sum(each.file_size for each in packed.infolist()), f"{path}: importing it")
    with np.load(path, allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


def matlab_signals(path: Path) -> list[Signal]:
    """List the arrays of a MATLAB file, which are held in memory, structures field by field."""
    return _signals(path, dict(_flat(matlab_arrays(path))))


def _flat(content: Mapping[str, Any], before: str = "", depth: int = 0) -> Iterator[tuple[str, Any]]:
    """Name the fields of structures by their way: ``Signal_1.y_values.values``."""
    for name, value in content.items():
        where = f"{before}{name}"
        if isinstance(value, Mapping):
            if depth < _DEEPEST:
                yield from _flat(value, f"{where}.", depth + 1)
            continue
        array = np.asarray(value)
        if array.dtype.names and depth < _DEEPEST:
            items = array.ravel()[:1000]
            for number, item in enumerate(items, 1):
                part = where if items.size == 1 else f"{where}({number})"
                yield from _flat(dict(zip(array.dtype.names, item, strict=True)), f"{part}.", depth + 1)
        elif array.dtype.kind == "O" and array.size == 1 and depth < _DEEPEST:
            yield from _flat({name: array.item()}, before, depth + 1)
        elif array.dtype.kind == "O" and all(isinstance(item, Mapping) for item in array.flat):
            for number, item in enumerate(array.ravel()[:1000], 1):
                yield from _flat({f"{name}({number})": item}, before, depth + 1)
        else:
            yield where, array


def _signals(path: Path, arrays: Mapping[str, Any]) -> list[Signal]:
    """Separate samples from times, rates and units among named arrays."""
    numbers = {
        name: np.asarray(value) for name, value in arrays.items() if np.asarray(value).dtype.kind in "fiu"
    }
    texts = {
        name: np.asarray(value) for name, value in arrays.items() if np.asarray(value).dtype.kind in "UO"
    }
    held_bytes = sum(array.nbytes for array in numbers.values() if not isinstance(array, np.memmap))
    rows: dict[str, NDArray[Any]] = {}
    clocks: dict[str, Clock] = {}
    for name, array in numbers.items():
        if array.size < _SHORTEST or array.ndim > 2 or (array.ndim == 2 and min(array.shape) > 4096):
            continue
        where = f"{path}: {name!r}"
        if _TIMES.fullmatch(name) and array.ndim == 1:
            need_beside_program(held_bytes + _CLOCK_BYTES * array.size, f"{path}: importing it")
            clocks[name] = clock_with_gaps(array.astype(float), 0.0, where)
        elif array.ndim == 1:
            rows[name] = held(array, str(path), len(rows) + 1, name)
        else:
            # Samples of a channel are more than there are channels, whichever way they lie.
            across = array if array.shape[0] <= array.shape[1] else array.T
            need_beside_program(held_bytes + _CLOCK_BYTES * across.shape[1], f"{path}: importing it")
            times = across[0].astype(float)
            timed = len(across) > 1 and looks_like_times(times, float(times[-1]), times.size)
            if timed:
                tell_times(f"{where}: its first row or column", times[1] - times[0])
                clocks[f"{name}(1)"] = clock_with_gaps(times, 0.0, where)
            for number, row in enumerate(across[int(timed) :], 1 + timed):
                rows[f"{name}({number})"] = held(row, str(path), len(rows) + 1, f"{name}({number})")
    if not rows:
        raise RecordingError(f"{path} holds no array of samples; it holds {_listed(arrays)}")
    scalars = {name: float(array.ravel()[0]) for name, array in numbers.items() if array.size == 1}
    units = _units(texts)
    found = []
    for number, (name, row) in enumerate(rows.items(), 1):
        rate, start, missing = _clock(path, name, scalars, clocks)
        unit = units.get(name) or units.get(name.partition("(")[0]) or ""

        def read(first: int, stop: int, row: NDArray[Any] = row) -> Array:
            return row[first:stop].astype(np.float64)

        signal = Signal(path.name, number, name, unit, row.size, rate, read, start)
        found.append(with_missing(signal, missing))
    return found


def _clock(
    path: Path, name: str, scalars: Mapping[str, float], clocks: Mapping[str, Clock]
) -> tuple[float | None, float, list[Missing]]:
    """Find the rate, first time and gaps of a signal: its own structure overrides what is for all."""
    of_array = f"{name.partition('(')[0]}(1)"
    if of_array in clocks:
        return clocks[of_array]
    own = name.split(".", 1)[0] if "." in name else ""

    def nearest(pattern: re.Pattern[str], among: Mapping[str, Any]) -> list[str]:
        fitting = [key for key in among if pattern.fullmatch(key)]
        return [key for key in fitting if own and key.startswith(f"{own}.")] or [
            key for key in fitting if "." not in key
        ]

    times = nearest(_TIMES, clocks)
    if times:
        return clocks[times[0]]
    start = next((scalars[key] for key in ("start_s", f"{own}.x_values.start_value") if key in scalars), 0.0)
    for key in nearest(_RATES, scalars):
        if not 0 < scalars[key] < 1e12:
            raise RecordingError(f"{path}: {key} = {scalars[key]!r}; expected a sample rate in Hz")
        return scalars[key], start, []
    for key in nearest(_INTERVALS, scalars):
        try:
            return rate_of_interval(scalars[key]), start, []
        except RecordingError as error:
            raise RecordingError(f"{path}: {key}: {error}") from None
    return None, start, []


def _units(texts: Mapping[str, Any]) -> dict[str, str]:
    """Read units as `analysis export` writes them: two rows of texts, ``channels`` and ``units``."""
    names, units = (texts.get(key, np.array([])).ravel().tolist() for key in ("channels", "units"))
    return dict(zip(map(str, names), map(str, units), strict=False))


def _listed(arrays: Mapping[str, Any]) -> str:
    said = [f"{name} {np.asarray(value).shape}" for name, value in arrays.items()]
    return ", ".join(said[:8]) + (" ..." if len(said) > 8 else "") or "nothing"
