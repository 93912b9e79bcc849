"""Frequency responses in MATLAB and numpy files: complex arrays, with frequencies, or with rate and block length."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.extras.importing.arrays import arrays_of
from daq.extras.importing.clock import warn
from daq.extras.importing.matlab_file import ATTRIBUTE_MARK
from rig.core.base.arrays import Array
from rig.core.base.errors import RecordingError

# Names of scalars: sample rate in Hz, number of samples of a block, and spacing of the lines in Hz.
_RATE = re.compile(r"(.*[._])?(fs|rate|sample_?rate|sampling_?(rate|frequency)|freq|frequency)", re.IGNORECASE)
_BLOCK = re.compile(r"(.*[._])?(npts|n_?fft|n_?samples|block(_?(size|length))?)", re.IGNORECASE)
_SPACING = re.compile(r"(.*[._])?(df|delta_?f|resolution|x_values\.increment)", re.IGNORECASE)
# Name of the frequency of the first line [Hz], in files of Testlab.
_START = re.compile(r"(.*\.)?x_values\.start_value")
# Names of arrays of angular frequencies, or of frequencies in kHz, their units, and the factors to Hz.
_FREQUENCY_FACTORS = (
    (re.compile(r"(.*\.)?(w|om(ega)?)([_(].*)?|.*_rad([^a-z].*|s|ps)?", re.IGNORECASE), "rad/s", 0.5 / np.pi),
    (re.compile(r".*_khz", re.IGNORECASE), "kHz", 1e3),
)
# Name of the unit of the values.
_UNIT = re.compile(r"(?!(frequency|freq|x|time)[._@]?units?)(.*[._@])?(units?|y_values\.quantity\.label)")
# Name of a cross spectrum.
_SPECTRUM = re.compile(r"(^|[._])(c?p?sd|(cross|power|auto)*_?spec(trum|tra)?)(xy)?([._(\d]|$)", re.IGNORECASE)
# Minimum number of complex values of a response; a shorter array is more likely a setting than a response.
_MIN_LINES = 4


def response_arrays(path: Path) -> tuple[dict[str, NDArray[np.complex128]], Array, dict[str, Array], str]:
    """Read the complex arrays of a file; two-dimensional arrays have a response in each column.

    Returns responses by name, frequencies in Hz, coherences by name, and the unit, empty if not stated.
    Raises `RecordingError` if there are no complex arrays, if they differ in length, or if their frequencies are not
    stated.
    """
    arrays = {name: np.squeeze(np.asarray(array)) for name, array in arrays_of(path).items()}
    complex_arrays = {
        name: array
        for name, array in arrays.items()
        if array.dtype.kind == "c" and array.ndim in (1, 2) and max(array.shape) >= _MIN_LINES
    }
    if not complex_arrays:
        listed = ", ".join(name for name in arrays if ATTRIBUTE_MARK not in name)
        raise RecordingError(
            f"{path} contains no array of complex numbers; its arrays are {listed or 'none'}. Save the "
            "responses as complex numbers, or convert samples with `daq import`."
        )
    spectra = [name for name in complex_arrays if _SPECTRUM.search(name)]
    if len(spectra) < len(complex_arrays):
        complex_arrays = {name: array for name, array in complex_arrays.items() if name not in spectra}
        if spectra:
            warn(f"{path}: cross spectra are omitted: {', '.join(spectra)}")
    lengths = {max(array.shape) for array in complex_arrays.values()}
    if len(lengths) > 1:
        raise RecordingError(
            f"{path}: its complex arrays have {', '.join(map(str, sorted(lengths)))} lines. Save responses of one "
            "length in a file."
        )
    (lines,) = lengths
    values: dict[str, NDArray[np.complex128]] = {}
    for name, array in complex_arrays.items():
        columns = array.reshape(lines, -1) if array.shape[0] == lines else array.T
        separate = [name] if columns.shape[1] == 1 else [f"{name}({number + 1})" for number in range(columns.shape[1])]
        values |= dict(zip(separate, columns.T, strict=True))
    coherence = {name: arrays.get(f"coherence_{name}", np.array([])).astype(float) for name in values}
    # A coherence next to a response, in an array of complex numbers, has no imaginary part.
    real = {name: column.real for name, column in values.items() if not column.imag.any()}
    if len(values) - len(real) == len(real) == 1:
        values = {name: column for name, column in values.items() if name not in real}
        coherence = dict(zip(values, real.values(), strict=True))
    return values, _frequencies(path, arrays, lines), coherence, _unit(arrays)


def _frequencies(path: Path, arrays: Mapping[str, NDArray[Any]], lines: int) -> Array:
    """Return the frequencies: a rising array of the same length, or multiples of the spacing of the lines."""
    rising = {
        name: array.astype(float)
        for name, array in arrays.items()
        if array.dtype.kind in "fiu" and array.shape == (lines,) and (np.diff(array.astype(float)) > 0.0).all()
    }
    named = {name: array for name, array in rising.items() if name.lower().rpartition(".")[2].startswith(("f", "hz"))}
    candidates = named or rising
    if len(candidates) == 1:
        [(name, array)] = candidates.items()
        for names, unit, factor in _FREQUENCY_FACTORS:
            if names.fullmatch(name):
                warn(f"{path}: the frequencies {name!r} are read in {unit}. If they are in Hz, name them 'frequency'.")
                return factor * array
        return array
    if candidates:
        raise RecordingError(
            f"{path}: the frequencies may be {' or '.join(candidates)}. Name the array of frequencies in Hz "
            f"'frequency', and rename the others."
        )
    scalars = {name: float(array) for name, array in arrays.items() if array.dtype.kind in "fiu" and array.size == 1}
    spacing = _only(scalars, _SPACING)
    rate, block = _only(scalars, _RATE), _only(scalars, _BLOCK)
    if spacing is None and rate is not None and block is not None and int(block) // 2 + 1 == lines:
        spacing = rate / block
    if spacing is None or spacing <= 0.0:
        raise RecordingError(
            f"{path}: the frequencies of the {lines} lines are not stated. Add an array 'frequency' in Hz, or the "
            "scalar 'df' in Hz."
        )
    return (_only(scalars, _START) or 0.0) + np.arange(lines, dtype=np.float64) * spacing


def _only(scalars: Mapping[str, float], names: re.Pattern[str]) -> float | None:
    """Return the value of the scalars with one of the names; None without such a scalar, or for several values."""
    found = {value for name, value in scalars.items() if names.fullmatch(name)}
    return found.pop() if len(found) == 1 else None


def _unit(arrays: Mapping[str, NDArray[Any]]) -> str:
    """Return the unit that the file states; an empty string without a unit, or for several."""
    units = {
        str(array.item())
        for name, array in arrays.items()
        if _UNIT.fullmatch(name) and array.size == 1 and array.dtype.kind in "UO"
    }
    return units.pop() if len(units) == 1 else ""
