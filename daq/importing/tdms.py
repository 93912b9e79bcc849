"""Signals of a TDMS file, as LabVIEW and NI's drivers write them, read piece by piece."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from daq.importing.signal import Array, Signal, rate_of_interval
from rig.errors import RecordingError, RunError

# LabVIEW's zero of time, which stands for a date that was not set.
_NO_DATE = np.datetime64("1904-01-02")
_EPOCH = np.datetime64("1970-01-01")


def tdms_signals(path: Path, stack: ExitStack) -> list[Signal]:
    """List the waveforms of a TDMS file, scaled as its properties say; the stack closes the file.

    Thinned out copies of the data, which SignalExpress keeps beside them, are left out.
    """
    try:
        import nptdms
    except ImportError:
        raise RunError("TDMS files need the package npTDMS: pip install 'shotrig[tdms]'") from None
    try:
        file = stack.enter_context(nptdms.TdmsFile.open(path))
        groups = file.groups()
        channels = [channel for group in groups for channel in group.channels()]
    except OSError:
        raise
    except Exception as error:
        # The reader meets damage as whatever it happens to lead to.
        raise RecordingError(f"{path} is no TDMS file, or it is damaged: {_told(error)}") from error
    whole = [channel for channel in channels if not channel.properties.get("DecimationLevel")]
    several = len({channel.group_name for channel in whole}) > 1
    return [_signal(path, number, channel, several) for number, channel in enumerate(whole, 1)]


def _signal(path: Path, number: int, channel: Any, several: bool) -> Signal:
    properties: Mapping[str, Any] = channel.properties
    name = f"{channel.group_name}/{channel.name}" if several else str(channel.name)
    where = f"{path}: {name!r}"
    interval, offset = properties.get("wf_increment"), properties.get("wf_start_offset", 0.0)
    try:
        rate = None if not interval else rate_of_interval(float(interval))
        start = float(offset)
    except (TypeError, ValueError):
        raise RecordingError(
            f"{where}: its wf_increment is {interval!r}, its wf_start_offset {offset!r}"
        ) from None
    except RecordingError as error:
        raise RecordingError(f"{where}: {error}") from None
    if interval is not None and channel.dtype is not None and channel.dtype.kind not in "fiu":
        raise RecordingError(f"{where} holds {channel.dtype}; expected real numbers")

    def read(first: int, stop: int) -> Array:
        try:
            return np.asarray(channel.read_data(first, stop - first), dtype=np.float64)
        except Exception as error:
            raise RecordingError(f"{where} cannot be read from sample {first} on: {_told(error)}") from error

    unit = str(properties.get("unit_string") or properties.get("NI_UnitDescription") or "")
    return Signal(
        path.name,
        number,
        name,
        unit,
        len(channel),
        rate,
        read,
        start,
        _nanoseconds(properties.get("wf_start_time")),
    )


def _nanoseconds(time: Any) -> int:
    if not isinstance(time, np.datetime64) or np.isnat(time) or time < _NO_DATE:
        return 0
    return max(0, int((time - _EPOCH) / np.timedelta64(1, "us")) * 1000)


def _told(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"[:200]
