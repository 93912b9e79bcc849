"""The channels of a TDMS file, the format of LabVIEW and NI's drivers; samples are read when needed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from daq.extras.importing.clock import TIME_NAMES, Clock, clock_of_times, rate_of_interval, time_scale, warn
from daq.extras.importing.signal import Signal
from daq.extras.importing.text_layout import name_and_unit
from daq.extras.importing.units import warn_of_scale
from rig.core.base.arrays import Array
from rig.core.base.errors import RecordingError, RunError

if TYPE_CHECKING:
    from logging import LogRecord

# LabVIEW's zero of time plus a day; an earlier date means that no date was set.
_FIRST_DATE = np.datetime64("1904-01-02")
_EPOCH = np.datetime64("1970-01-01")


def tdms_signals(path: Path, stack: ExitStack) -> list[Signal]:
    """List the channels of a TDMS file as signals, scaled as its properties state; `stack` closes the file.

    Decimated copies of the data, which SignalExpress stores, are omitted.
    """
    try:
        import nptdms
    except ImportError:
        raise RunError("TDMS files need the package npTDMS: pip install 'shotrig[tdms]'") from None
    try:
        stack.enter_context(log_as_warning(path))
        file = stack.enter_context(nptdms.TdmsFile.open(path))
        all_channels = [channel for group in file.groups() for channel in group.channels()]
        channels = [channel for channel in all_channels if not channel.properties.get("DecimationLevel")]
        has_several_groups = len({channel.group_name for channel in channels}) > 1
        time_channels = {channel.group_name: channel for channel in channels if _is_clock(channel, channels)}
        clocks = {group: _clock(path, channel) for group, channel in time_channels.items()}
        sample_channels = [channel for channel in channels if channel is not time_channels.get(channel.group_name)]
        return [
            _signal(path, number, channel, has_several_groups, clocks.get(channel.group_name))
            for number, channel in enumerate(sample_channels, 1)
        ]
    except (OSError, RecordingError):
        raise
    except Exception as error:
        # A damaged file can cause any exception in the reader.
        raise RecordingError(
            f"{path} cannot be read as a TDMS file ({_error_text(error)}). Export it again."
        ) from error


@contextmanager
def log_as_warning(path: Path) -> Iterator[None]:
    """Collect log messages of npTDMS, and issue one warning at the end instead."""
    from nptdms.log import log_manager

    messages: list[str] = []

    def collect(record: LogRecord) -> bool:
        messages.append(record.getMessage())
        return False

    with ExitStack() as stack:
        for logger in log_manager.loggers.values():
            logger.addFilter(collect)
            stack.callback(logger.removeFilter, collect)
        yield
    if messages:
        warn(
            f"{path} is truncated or damaged ({messages[0]}). Only the readable part is imported; for the rest, export "
            "the file again."
        )


def _is_clock(channel: Any, channels: list[Any]) -> bool:
    """Return whether a channel contains the times of the other channels of its group, which lack a sample interval."""
    others = [each for each in channels if each.group_name == channel.group_name and each is not channel]
    name = str(channel.name).partition("[")[0].partition("(")[0].strip()
    return (
        TIME_NAMES.fullmatch(name) is not None
        and bool(others)
        and all(each.properties.get("wf_increment") is None and len(each) <= len(channel) for each in others)
    )


def _clock(path: Path, channel: Any) -> Clock:
    """Estimate the clock from a channel of times, which are numbers or dates with times of day."""
    where = f"{path}: the times in {channel.name!r}"
    try:
        times = np.asarray(channel[:])
        if times.dtype.kind == "M":
            times = (times - times[:1]) / np.timedelta64(1, "s")
        seconds = times.astype(float)
    except Exception as error:
        raise RecordingError(f"{where} cannot be read: {_error_text(error)}. Export the file again.") from error
    unit = str(channel.properties.get("unit_string") or name_and_unit(str(channel.name))[1])
    seconds = seconds * time_scale(unit, where)
    return clock_of_times(seconds, 0.0, where)


def _signal(path: Path, number: int, channel: Any, has_several_groups: bool, clock: Clock | None) -> Signal:
    properties: Mapping[str, Any] = channel.properties
    name = f"{channel.group_name}/{channel.name}" if has_several_groups else str(channel.name)
    where = f"{path}: {name!r}"
    interval, offset = properties.get("wf_increment"), properties.get("wf_start_offset", 0.0)
    try:
        channel_clock = Clock(rate_of_interval(float(interval), where=where) if interval else None, float(offset))
    except (TypeError, ValueError):
        raise RecordingError(
            f"{where}: wf_increment is {interval!r}, wf_start_offset is {offset!r}; expected numbers, in s. Correct "
            "the file."
        ) from None
    if interval is not None and channel.dtype is not None and channel.dtype.kind not in "fiu":
        raise RecordingError(
            f"{where} contains values of type {channel.dtype}; expected real numbers. Export it as real samples."
        )
    if channel.dtype is not None and channel.dtype.kind in "iu":
        warn_of_scale(where, properties)
    clock = clock or channel_clock

    def read(first: int, stop: int) -> Array:
        try:
            return np.asarray(channel.read_data(first, stop - first), dtype=np.float64)
        except Exception as error:
            time = "" if clock.rate is None else f" ({first / clock.rate:.6g} s)"
            raise RecordingError(
                f"{where} cannot be read from sample {first}{time} on: {_error_text(error)}. Import the samples before "
                "this time: set `to_s`."
            ) from error

    unit = str(properties.get("unit_string") or properties.get("NI_UnitDescription") or "")
    start_ns = _nanoseconds(properties.get("wf_start_time"))
    signal = Signal(path.name, number, name, unit, len(channel), clock.rate, read, clock.start_s, start_ns)
    return signal.with_gaps(clock)


def _nanoseconds(time: Any) -> int:
    if not isinstance(time, np.datetime64) or np.isnat(time) or time < _FIRST_DATE:
        return 0
    return max(0, int((time - _EPOCH) / np.timedelta64(1, "us")) * 1000)


def _error_text(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"[:200]
