"""Monitor of the limits of the channels: it marks overloads and alarms, and detects when a test must end.

A marker is an entry of a recording that names an interval of samples and its kind, such as "overload" or "alarm".
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from daq.core.signal_chain.channel import ChannelInfo
from daq.core.virtual_bench.bench import Bench
from rig.core.base.arrays import Array
from rig.core.scene.presets import complete_from_preset
from rig.core.scene.scene import Scene

# Intervals with a shorter gap are merged [s]: an oscillation exceeds its limit twice per period.
_MIN_GAP_S = 0.5
# Interval at which the limits of channels are checked [s], independent of the block size.
_CHECK_INTERVAL_S = 0.1
# Check interval if only the channels of a controlled force are monitored [s].
_CONTROL_CHECK_INTERVAL_S = 0.5
# A test ends if a control channel is overloaded for longer than this value [s].
_MAX_OVERLOAD_S = 1.0
# Maximum time between an overload and an abort that it may have caused [s]: tests wait some seconds before.
_RECENT_S = 10.0
# The settling of a sensor is simulated for at most this time; afterwards, the bias is assumed to be constant [s].
_MAX_SETTLING_S = 60.0


@dataclass(frozen=True)
class Exceedance:
    """A reading that exceeds the abort limit of its channel."""

    sample: int  # index of the sample
    channel: ChannelInfo
    value: float  # reading, in the channel's unit
    limit: float  # abort limit, in the channel's unit

    def __str__(self) -> str:
        name, unit = self.channel.name, self.channel.unit
        return (
            f"channel {name}: {self.value:.4g} {unit} at {self.sample / self.channel.rate:.3f} s "
            f"exceeds its abort limit of {self.limit:.4g} {unit}"
        )


class DriveInput(NamedTuple):
    """An input of the rig; an amplifier can clip its drive."""

    name: str
    rate: float  # Hz


class FlaggedIntervals:
    """Merges flagged samples of each channel or input into intervals, and calls `mark` for each complete interval.

    The arguments of `mark` are the kind of marker, the first sample, the sample after the last, and the channel's name.

    >>> info = ChannelInfo("body1", "body 1", "acceleration", sensitivity=1.0, rate=10.0)
    >>> intervals = FlaggedIntervals("overload", [info], lambda *args, **fields: print(*args, fields))
    >>> intervals.add(0, np.array([[0, 1, 0, 1, 0, 0, 0, 0, 0, 0]], dtype=bool))
    overload 1 4 {'channel': 'body1'}
    """

    def __init__(self, kind: str, channels: Sequence[ChannelInfo | DriveInput], mark: Callable[..., Any]) -> None:
        self._kind, self._channels, self._mark = kind, channels, mark
        self._open_intervals: dict[int, tuple[int, int]] = {}  # first sample and sample after the last, by row

    def add(self, first: int, flags: NDArray[np.bool_]) -> None:
        """Add the flags of the next samples, shape (channels, samples); `first` is the index of the first sample."""
        if not self._open_intervals and not flags.any():
            return
        min_gap = max(1, round(_MIN_GAP_S * self._channels[0].rate))
        for row in range(len(self._channels)):
            flagged = np.flatnonzero(flags[row]) + first
            # Flagged samples with a gap of less than `_MIN_GAP_S` belong to the same interval.
            for interval in np.split(flagged, np.flatnonzero(np.diff(flagged) > min_gap) + 1):
                if not interval.size:
                    continue
                start, stop = int(interval[0]), int(interval[-1]) + 1
                if row in self._open_intervals and start - self._open_intervals[row][1] >= min_gap:
                    self._mark_interval(row)
                self._open_intervals[row] = self._open_intervals.get(row, (start, stop))[0], stop
            if row in self._open_intervals and first + flags.shape[1] - self._open_intervals[row][1] >= min_gap:
                self._mark_interval(row)

    def close(self) -> None:
        """Mark the open intervals."""
        for row in sorted(self._open_intervals):
            self._mark_interval(row)

    def _mark_interval(self, row: int) -> None:
        """Mark the open interval of flagged samples of a channel, and close it."""
        start, stop = self._open_intervals.pop(row)
        self._mark(self._kind, start, stop, channel=self._channels[row].name)


class Limits:
    """Monitors alarm and abort limits, in the unit of each channel.

    A reading beyond an alarm limit is marked; a reading beyond an abort limit ends the test.
    """

    def __init__(self, scene: Scene, channels: Sequence[ChannelInfo], mark: Callable[..., Any]) -> None:
        settings = {channel.name: channel for channel in scene.channels or ()}

        def limits(key: str) -> Array:
            """Return the limit of each channel, infinite if it has none, shape (channels, 1)."""
            values = [getattr(settings.get(info.name), key, None) for info in channels]
            return np.array([[np.inf if limit is None else limit] for limit in values])

        self._channels = channels
        self._alarm_limits, self._abort_limits = limits("alarm"), limits("abort")
        self._alarms = FlaggedIntervals("alarm", channels, mark)
        self.has_limits = bool(np.isfinite(self._alarm_limits).any() or np.isfinite(self._abort_limits).any())

    @property
    def interval(self) -> float:
        """Interval at which the channels are checked [s]."""
        return _CHECK_INTERVAL_S if self.has_limits else _CONTROL_CHECK_INTERVAL_S

    def watch(self, first: int, readings: Array) -> Exceedance | None:
        """Check readings, shape (channels, samples), and return the first reading beyond an abort limit."""
        if not self.has_limits:
            return None
        magnitude = abs(readings)
        self._alarms.add(first, magnitude > self._alarm_limits)
        exceeded = magnitude > self._abort_limits
        if not exceeded.any():
            return None
        sample = int(np.argmax(exceeded.any(axis=0)))
        row = int(np.argmax(exceeded[:, sample]))
        value, limit = float(readings[row, sample]), float(self._abort_limits[row, 0])
        return Exceedance(first + sample, self._channels[row], value, limit)

    def close(self) -> None:
        """Write a marker for each alarm that lasts until the end of the test."""
        self._alarms.close()


class ControlLoss:
    """Detects a control channel that is overloaded for too long: the controller then has no valid feedback."""

    def __init__(self, scene: Scene, channels: Sequence[ChannelInfo]) -> None:
        self._rows = [row for row, info in enumerate(channels) if info.at in scene.controlled_terms]
        self._scene, self._channels = scene, channels
        self._overload_start: int | None = None  # first sample of the current overload
        self._latest: dict[int, int] = {}  # sample after the last overload, by row

    def watch(self, first: int, flags: NDArray[np.bool_]) -> str | None:
        """Check overload flags, shape (channels, samples); return a message if an overload lasts too long."""
        any_overloaded = np.flatnonzero(flags.any(axis=1)).tolist() if flags.any() else []
        self._latest.update(dict.fromkeys(any_overloaded, first + flags.shape[1]))
        overloaded_rows = [row for row in self._rows if row in any_overloaded]
        if not overloaded_rows:
            self._overload_start = None
            return None
        self._overload_start = first if self._overload_start is None else self._overload_start
        info, stop = self._channels[overloaded_rows[0]], first + flags.shape[1]
        if stop - self._overload_start <= _MAX_OVERLOAD_S * info.rate:
            return None
        return (
            f"input {info.name}: overloaded since {self._overload_start / info.rate:.2f} s, so the control has no "
            f"reading at {info.at}. {self._remedy(overloaded_rows[0], stop)}"
        )

    def describe(self, reason: str, now: int) -> str:
        """Return the reason of an abort, preceded by a recent overload, which may be its cause; `now`: sample."""
        rows = [row for row, stop in self._latest.items() if now - stop < _RECENT_S * self._channels[row].rate]
        if not rows:
            return reason
        names = ", ".join(self._channels[row].name for row in rows)
        verb = "input {} was" if len(rows) == 1 else "inputs {} were"
        overload = f"{verb.format(names)} overloaded, which may be the cause. {self._remedy(rows[0], now)}"
        return f"{overload} The test ended: {reason}"

    def _remedy(self, row: int, now: int) -> str:
        """Return the cause of the overload of a channel if it is a bias, and the setting to change."""
        level = self._scene.level_key or "excitation"
        return bias_overload(self._scene, row, now / self._channels[row].rate) or (
            f"Choose a lower {level}, a larger converter range or a lower sensitivity."
        )


def bias_overload(scene: Scene, row: int, seconds: float) -> str | None:
    """Return a message if the bias of a sensor overloads its input after `seconds` at rest; otherwise None."""
    channel = None if scene.channels is None else scene.channels[row]
    if channel is None or channel.accelerometer is None:
        return None
    sensor = complete_from_preset(channel.accelerometer)
    if not sensor.bias:
        return None
    bench = Bench(scene)
    second_of_zeros, overloaded = np.zeros((len(bench.inputs), max(1, round(bench.rate)))), False
    # The input counts as overloaded if it is overloaded in the last second.
    for _ in range(max(1, round(min(seconds, _MAX_SETTLING_S)))):
        overloaded = bool(bench.acquire(second_of_zeros).overload[row].any())
    if not overloaded:
        return None
    settling, integrated = "", ""
    if sensor.bias_settling is not None:
        settling = f" (time constant {sensor.bias_settling:g} s)"
    remedies = ["bias: 0 V in its accelerometer (for a sensor that was switched on long before the test)"]
    if channel.integrator is not None:
        integrated = " after integration"
        remedies.append("a higher low_cutoff (several hertz) or a smaller gain in the integrator")
    elif complete_from_preset(scene.converter).coupling != "AC":
        remedies.append("coupling: AC in the converter")
    return (
        f"The bias of its sensor, {sensor.bias:g} V{settling}, overloads the input{integrated} even with the shaker at "
        f"rest. Set {', '.join(remedies)}, or a larger converter range."
    )
