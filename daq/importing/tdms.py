"""Signals of a TDMS file, as LabVIEW and NI's drivers write them, read piece by piece."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from daq.importing.signal import TIME_NAMES, Array, Signal, note, rate_of_interval
from daq.importing.time_gaps import Missing, clock_with_gaps, with_missing
from rig.errors import RecordingError, RunError
from rig.scene.quantities import TIME, parse

if TYPE_CHECKING:
    from logging import LogRecord

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
        stack.enter_context(log_as_warning(path))
        file = stack.enter_context(nptdms.TdmsFile.open(path))
        groups = file.groups()
        return _signals(path, [channel for group in groups for channel in group.channels()])
    except (OSError, RecordingError):
        raise
    except Exception as error:
        # The reader meets damage as whatever it happens to lead to.
        raise RecordingError(f"{path} is no TDMS file, or it is damaged: {_cause(error)}") from error


@contextmanager
def log_as_warning(path: Path) -> Iterator[None]:
    """Turn what npTDMS logs of a file, by default to standard error, into one warning at the end."""
    from nptdms.log import log_manager

    messages: list[str] = []

    def take(record: LogRecord) -> bool:
        messages.append(record.getMessage())
        return False

    with ExitStack() as put_back:
        for log in log_manager.loggers.values():
            log.addFilter(take)
            put_back.callback(log.removeFilter, take)
        yield
    if messages:
        note(f"{path} is cut off or damaged ({messages[0]}). What can be read of it is taken")


def _signals(path: Path, channels: list[Any]) -> list[Signal]:
    whole = [channel for channel in channels if not channel.properties.get("DecimationLevel")]
    several = len({channel.group_name for channel in whole}) > 1
    times = {channel.group_name: channel for channel in whole if _is_clock(channel, whole)}
    clocks = {group: _clock(path, channel) for group, channel in times.items()}
    samples = [channel for channel in whole if channel is not times.get(channel.group_name)]
    return [
        _signal(path, number, channel, several, clocks.get(channel.group_name))
        for number, channel in enumerate(samples, 1)
    ]


def _is_clock(channel: Any, among: list[Any]) -> bool:
    """Whether a channel holds the times of those of its group, none of which has a clock of its own."""
    group = [other for other in among if other.group_name == channel.group_name and other is not channel]
    return (
        TIME_NAMES.fullmatch(str(channel.name).partition("[")[0].partition("(")[0].strip()) is not None
        and bool(group)
        and all(
            other.properties.get("wf_increment") is None and len(other) <= len(channel) for other in group
        )
    )


def _clock(path: Path, channel: Any) -> tuple[float, float, list[Missing]]:
    """Find the rate, the first time and the gaps of a channel of times: seconds, or dates with times of day."""
    where = f"{path}: the times in {channel.name!r}"
    try:
        times = np.asarray(channel[:])
        if times.dtype.kind == "M":
            times = (times - times[:1]) / np.timedelta64(1, "s")
        seconds = times.astype(float)
    except Exception as error:
        raise RecordingError(f"{where} cannot be read: {_cause(error)}") from error
    unit = str(channel.properties.get("unit_string") or "s")
    try:
        seconds = seconds * parse(f"1 {unit}", TIME)
    except ValueError as error:
        raise RecordingError(f"{where}: {error}; expected a unit of time such as s or ms") from None
    return clock_with_gaps(seconds, 0.0, where)


def _signal(
    path: Path, number: int, channel: Any, several: bool, clock: tuple[float, float, list[Missing]] | None
) -> Signal:
    properties: Mapping[str, Any] = channel.properties
    name = f"{channel.group_name}/{channel.name}" if several else str(channel.name)
    where = f"{path}: {name!r}"
    interval, offset = properties.get("wf_increment"), properties.get("wf_start_offset", 0.0)
    try:
        rate = None if not interval else rate_of_interval(float(interval))
        start, missing = float(offset), list[Missing]()
        if clock is not None:
            rate, start, missing = clock
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
            raise RecordingError(f"{where} cannot be read from sample {first} on: {_cause(error)}") from error

    unit = str(properties.get("unit_string") or properties.get("NI_UnitDescription") or "")
    start_ns = _nanoseconds(properties.get("wf_start_time"))
    signal = Signal(path.name, number, name, unit, len(channel), rate, read, start, start_ns)
    return with_missing(signal, missing)


def _nanoseconds(time: Any) -> int:
    if not isinstance(time, np.datetime64) or np.isnat(time) or time < _NO_DATE:
        return 0
    return max(0, int((time - _EPOCH) / np.timedelta64(1, "us")) * 1000)


def _cause(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"[:200]
