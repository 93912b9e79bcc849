"""Data sets 58 of Universal Files, in text and binary (58b), as pyuff reads them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from daq.importing.clock import Clock, clock_of_times, rate_of_interval
from daq.importing.signal import Signal
from rig.errors import RecordingError, RunError
from rig.numerics.memory import require_memory_with_program
from rig.results.universal_file import FRF, GENERAL

# Function types of data set 58.
TIME_RESPONSE, COHERENCE = 1, 6
# Units by the kind of the data, used if a label states none and data set 164 states that the file is in SI.
UNITS = {8: "m", 11: "m/s", 12: "m/s^2", 9: "N", 13: "N"}
# Code of an abscissa of time.
_ABSCISSA_TIME = 17
# Code of SI in data set 164.
_UNITS_SI = 1
# Memory that reading a byte of the file takes, bytes, measured: text, its numbers as objects, and an array of them.
_READ_BYTES = 6
_DIRECTIONS = {1: "+X", 2: "+Y", 3: "+Z", 4: "+RX", 5: "+RY", 6: "+RZ"}


def uff_signals(path: Path, _stack: ExitStack) -> list[Signal]:
    """List the time responses of a Universal File; they are held in memory."""
    sets = functions(path)
    times = [each for each in sets if is_time(each)]
    if not times:
        kinds = Counter(int(each["func_type"]) for each in sets)
        hint = "Give its frequency responses to `analysis modes`." if kinds[FRF] else "Export time histories."
        raise RecordingError(f"{path} contains no time history (data set 58, function type 1). {hint}")
    names = [title(each) for each in times]
    return [
        _signal(path, number, name if names.count(name) == 1 else f"{name} #{number}", each)
        for number, (name, each) in enumerate(zip(names, times, strict=True), 1)
    ]


def functions(path: Path) -> list[dict[str, Any]]:
    """Read all data sets 58 of a Universal File; ``si`` in each states whether the file is in SI.

    Raises `RecordingError` for a damaged file or one without them, `RunError` without pyuff.
    """
    try:
        import pyuff
    except ImportError:
        raise RunError("Universal Files need the package pyuff: pip install 'shotrig[export]'") from None
    size = path.stat().st_size
    require_memory_with_program(_READ_BYTES * size, f"{path}: importing it")
    with path.open("rb") as stream:
        # The reader ignores a last data set without an end.
        stream.seek(max(0, size - 4096))
        if not stream.read().rstrip().endswith(b"-1"):
            raise RecordingError(
                f"{path} is not a Universal File, or it is cut off: it does not end with the mark -1. Export it again."
            )
    try:
        file = pyuff.UFF(str(path))
        kinds = [int(kind) for kind in file.get_set_types()]
    except Exception as error:
        raise RecordingError(
            f"{path} is not a Universal File, or it is damaged: {error!s:.200}. Export it again."
        ) from error
    sets: list[dict[str, Any]] = []
    units = None
    for index, kind in enumerate(kinds):
        if kind not in (58, 164):
            continue
        try:
            content = file.read_sets(index)
            if kind == 164:
                units = int(content["units_code"])
                continue
            present, stated = np.asarray(content["data"]).size, int(content["num_pts"])
            if present != stated:
                raise ValueError(f"its header states {stated} values, it contains {present}")
        except Exception as error:
            raise RecordingError(
                f"{path}: its data set {index + 1}, a {kind}, cannot be read: the file is cut off or damaged "
                f"({error!s:.100}). Export it again."
            ) from error
        sets.append(content)
    if not sets:
        others = ", ".join(map(str, sorted(set(kinds) - {0}))) or "none"
        raise RecordingError(f"{path} holds no data set 58 (functions); its data sets: {others}")
    for data_set in sets:
        data_set["si"] = units == _UNITS_SI
    return sets


def title(data_set: Mapping[str, Any]) -> str:
    """Name a function by the beginning of its first line, or by its node and direction."""
    first = str(data_set["id1"]).partition(":")[0].strip()
    return first if first and first.upper() != "NONE" else point(data_set, "rsp")


def point(data_set: Mapping[str, Any], which: str) -> str:
    """Name the node and direction of a response (``rsp``) or reference (``ref``): ``3 +Z``."""
    direction = int(data_set[f"{which}_dir"])
    sign = _DIRECTIONS.get(abs(direction), "")
    return f"{int(data_set[f'{which}_node'])} {sign if direction >= 0 else sign.replace('+', '-')}".strip()


def label(data_set: Mapping[str, Any], axis: str) -> str:
    """Return the unit of an axis by its label, or by its kind in a file in SI; empty if neither states it."""
    text = str(data_set.get(f"{axis}_axis_units_lab", "")).strip()
    if text and text.upper() != "NONE":
        # Labels of Windows programs are not UTF-8; the character that the reader cannot decode in a unit is the square.
        return text.replace("\ufffd", "²")
    return UNITS.get(int(data_set.get(f"{axis}_spec_data_type", 0)), "") if data_set["si"] else ""


def is_time(data_set: Mapping[str, Any]) -> bool:
    """Return whether a function is a function of time."""
    kind = int(data_set["func_type"])
    return kind == TIME_RESPONSE or (kind == GENERAL and int(data_set["abscissa_spec_data_type"]) == _ABSCISSA_TIME)


def _signal(path: Path, number: int, name: str, data_set: Mapping[str, Any]) -> Signal:
    where = f"{path}: times of {name!r}"
    if int(data_set["abscissa_spacing"]):
        interval = float(data_set["abscissa_inc"])
        try:
            rate = _stated_rate(data_set) or rate_of_interval(interval, _last_digit(interval) / 2)
        except RecordingError as error:
            raise RecordingError(f"{where}: {error}") from None
        clock = Clock(rate, float(data_set["abscissa_min"]))
    else:
        times = np.asarray(data_set["x"], dtype=float)
        clock = clock_of_times(times, _resolution(times, data_set), where)
    return Signal.of_array(path, number, name, label(data_set, "ordinate"), np.asarray(data_set["data"]), clock)


def _stated_rate(data_set: Mapping[str, Any]) -> float | None:
    """Read the exact rate that `analysis export` writes in the fourth line, where there is one."""
    words = str(data_set.get("id4", "")).split()
    if len(words) == 4 and words[:2] == ["sample", "rate"] and words[3] == "Hz":
        try:
            return float(words[2])
        except ValueError:
            return None
    return None


def _resolution(times: np.ndarray, data_set: Mapping[str, Any]) -> float:
    """Resolution of unevenly spaced times: six digits in text, or that of single precision, s."""
    largest = float(abs(times).max(initial=0.0))
    if not int(data_set.get("binary", 0)):
        return _last_digit(largest)
    return float(np.spacing(np.float32(largest))) if int(data_set["ord_data_type"]) in (2, 5) else 0.0


def _last_digit(number: float) -> float:
    """Size of the last digit of a number that is written with six (E13.5)."""
    return 0.0 if number == 0 else 10.0 ** (np.floor(np.log10(abs(number))) - 5)
