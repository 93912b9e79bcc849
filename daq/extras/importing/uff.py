"""Functions (data sets 58 and 58b) of Universal Files, read with pyuff: time histories and frequency responses."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from daq.extras.importing.clock import Clock, clock_of_times, rate_of_interval, time_scale
from daq.extras.importing.signal import Signal
from rig.core.base.errors import RecordingError, RunError
from rig.core.numerics.memory import require_memory_with_program
from rig.core.results.universal_file import FRF, GENERAL

# Function types of data set 58.
TIME_RESPONSE, COHERENCE = 1, 6
# Unit for each data type; used if a label states no unit and data set 164 specifies that the file is in SI.
SI_UNITS = {8: "m", 11: "m/s", 12: "m/s^2", 9: "N", 13: "N"}
# Data type of an abscissa that is time.
_ABSCISSA_TIME = 17
# Code of SI in data set 164.
_UNITS_SI = 1
# Memory for reading, bytes per byte of the file, measured: text, numbers as objects, and an array of the numbers.
_MEMORY_PER_BYTE = 6
_DIRECTIONS = {1: "+X", 2: "+Y", 3: "+Z", 4: "+RX", 5: "+RY", 6: "+RZ"}


def uff_signals(path: Path, _stack: ExitStack) -> list[Signal]:
    """List the time histories of a Universal File as signals in memory."""
    sets = functions(path)
    time_sets = [data_set for data_set in sets if is_time(data_set)]
    if not time_sets:
        function_counts = Counter(int(data_set["func_type"]) for data_set in sets)
        hint = "Give its frequency responses to `analysis modes`." if function_counts[FRF] else "Export time histories."
        raise RecordingError(f"{path} contains no time history (data set 58, function type 1). {hint}")
    names = [title(data_set) for data_set in time_sets]
    return [
        _signal(path, number, name if names.count(name) == 1 else f"{name} #{number}", data_set)
        for number, (name, data_set) in enumerate(zip(names, time_sets, strict=True), 1)
    ]


def functions(path: Path) -> list[dict[str, Any]]:
    """Read all functions (data sets 58) of a Universal File; ``si`` in each specifies whether the file is in SI.

    Raises `RecordingError` for a damaged file or a file without functions, `RunError` without pyuff.
    """
    sets = data_sets(path, (58, 164))
    unit_codes = [int(content["units_code"]) for content in sets if content["type"] == 164]
    time_histories = [content for content in sets if content["type"] == 58]
    if not time_histories:
        raise RecordingError(
            f"{path} contains no data set 58 (functions). Export time histories or frequency responses as data set 58; "
            "`analysis.read_modes` reads modes (data set 55)."
        )
    for content in time_histories:
        content["si"] = unit_codes[-1:] == [_UNITS_SI]
    return time_histories


def data_sets(path: Path, types: Sequence[int]) -> list[dict[str, Any]]:
    """Read the data sets of given types in a Universal File.

    Raises `RecordingError` for a damaged file, `RunError` without pyuff.
    """
    try:
        import pyuff
    except ImportError:
        raise RunError("Universal Files need the package pyuff: pip install 'shotrig[export]'") from None
    if not path.is_file():
        raise RecordingError(f"{path}: no such file. Check the path.")
    size = path.stat().st_size
    require_memory_with_program(_MEMORY_PER_BYTE * size, f"{path}: importing it")
    with path.open("rb") as stream:
        # The reader ignores a last data set without an end.
        stream.seek(max(0, size - 4096))
        if not stream.read().rstrip().endswith(b"-1"):
            raise RecordingError(
                f"{path} is not a Universal File, or the file is truncated: the final mark -1 is missing. Export it "
                "again."
            )
    try:
        file = pyuff.UFF(str(path))
        set_types = [int(set_type) for set_type in file.get_set_types()]
    except Exception as error:
        raise RecordingError(f"{path} cannot be read as a Universal File ({error!s:.200}). Export it again.") from error
    sets: list[dict[str, Any]] = []
    for index, set_type in enumerate(set_types):
        if set_type not in types:
            continue
        try:
            content = dict(file.read_sets(index))
            if set_type == 58:
                value_count, stated_count = np.asarray(content["data"]).size, int(content["num_pts"])
                if value_count != stated_count:
                    raise ValueError(f"its header states {stated_count} values, but it contains {value_count}")
        except Exception as error:
            raise RecordingError(
                f"{path}: data set {index + 1} (type {set_type}) cannot be read: the file is truncated or damaged "
                f"({error!s:.100}). Export it again."
            ) from error
        sets.append(content)
    return sets


def title(data_set: Mapping[str, Any]) -> str:
    """Return the name of a function: the beginning of its first line, otherwise its node and direction."""
    first = str(data_set["id1"]).partition(":")[0].strip()
    return first if first and first.upper() != "NONE" else point(data_set, "rsp")


def point(data_set: Mapping[str, Any], end: str) -> str:
    """Return node and direction of the response (`end` is ``rsp``) or the reference (``ref``), such as ``3 +Z``."""
    return f"{int(data_set[f'{end}_node'])} {direction(int(data_set[f'{end}_dir']))}".strip()


def direction(number: int) -> str:
    """Return the name of a direction, such as ``+Z`` for 3 and ``-Z`` for -3; empty if there is none."""
    name = _DIRECTIONS.get(abs(number), "")
    return name if number >= 0 else name.replace("+", "-")


def label(data_set: Mapping[str, Any], axis: str) -> str:
    """Return the unit of an axis from its label, or in an SI file from its data type; empty without a unit."""
    text = str(data_set.get(f"{axis}_axis_units_lab", "")).strip()
    if text and text.upper() != "NONE":
        # Windows programs do not write UTF-8. A character that the reader cannot decode is the superscript two of a
        # unit.
        return text.replace("\ufffd", "²")
    return SI_UNITS.get(int(data_set.get(f"{axis}_spec_data_type", 0)), "") if data_set["si"] else ""


def is_time(data_set: Mapping[str, Any]) -> bool:
    """Return whether a function is a function of time."""
    function_type = int(data_set["func_type"])
    return function_type == TIME_RESPONSE or (
        function_type == GENERAL and int(data_set["abscissa_spec_data_type"]) == _ABSCISSA_TIME
    )


def _signal(path: Path, number: int, name: str, data_set: Mapping[str, Any]) -> Signal:
    where, scale = f"{path}: the times of {name!r}", _time_unit(data_set)
    if int(data_set["abscissa_spacing"]):
        interval = scale * float(data_set["abscissa_inc"])
        rate = stated_number(data_set, "sample rate") or rate_of_interval(interval, _last_digit(interval) / 2, where)
        clock = Clock(rate, scale * float(data_set["abscissa_min"]))
    else:
        times = np.asarray(data_set["x"], dtype=float)
        clock = clock_of_times(scale * times, scale * _resolution(times, data_set), where)
    return Signal.from_array(path, number, name, label(data_set, "ordinate"), np.asarray(data_set["data"]), clock)


def _time_unit(data_set: Mapping[str, Any]) -> float:
    """Return the SI value of the unit of the times [s]; 1 if the label of their axis states no unit of time."""
    try:
        return time_scale(label(data_set, "abscissa"), "")
    except RecordingError:
        return 1.0


def stated_number(data_set: Mapping[str, Any], name: str) -> float | None:
    """Return the quantity [Hz] that this program writes in the fourth line, such as the exact rate; None without it.

    >>> stated_number({"id4": "sample rate 51200.0 Hz"}, "sample rate"), stated_number({"id4": "NONE"}, "sample rate")
    (51200.0, None)
    """
    match = re.fullmatch(rf"{name} (\S+) Hz", str(data_set.get("id4") or "").strip())
    try:
        return float(match[1]) if match else None
    except ValueError:
        return None


def _resolution(times: np.ndarray, data_set: Mapping[str, Any]) -> float:
    """Return the resolution of unevenly spaced times [s]: six digits in text, or single precision."""
    largest = float(abs(times).max(initial=0.0))
    if not int(data_set.get("binary", 0)):
        return _last_digit(largest)
    return float(np.spacing(np.float32(largest))) if int(data_set["ord_data_type"]) in (2, 5) else 0.0


def _last_digit(number: float) -> float:
    """Return the size of the last digit of a number that is written with six digits (E13.5)."""
    return 0.0 if number == 0 else 10.0 ** (np.floor(np.log10(abs(number))) - 5)
