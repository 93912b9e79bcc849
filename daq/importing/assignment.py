"""Assignment of signals to channels, and the scale of their numbers in the channel's unit."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from daq.dsp.skew import delays
from daq.importing.channel_table import EXAMPLE, Column
from daq.importing.signal import Signal
from daq.importing.units import meaning
from daq.recording.truth import points_of
from daq.signal_chain.chain import default_channels
from daq.signal_chain.channel import ChannelInfo, Quantity
from daq.signal_chain.devices import stages
from daq.signal_chain.stage import channel_info
from rig.arrays import Array
from rig.errors import SceneError, suggestion
from rig.scene.measurement_chain import Channel, Integrator
from rig.scene.presets import complete_from_preset, input_settings
from rig.scene.quantities import ACCELERATION_SENSITIVITY, FORCE_SENSITIVITY, parse
from rig.scene.scene import Scene

# Units whose sizes differ by a smaller share are the same, written with fewer digits.
_SAME_UNIT = 1e-3
# Orders of integration of an ideal channel that reads a velocity or a displacement, as a laser sensor does.
_INTEGRATION_ORDERS: dict[Quantity, int] = {"velocity": 1, "displacement": 2}


@dataclass(frozen=True)
class Assigned:
    """A channel and the source of its samples."""

    channel: Channel  # as in the scene; with the ideal integrator for a velocity or a displacement
    info: ChannelInfo
    signal: Signal
    column: Column
    factor: float  # Volts at the converter per number of the file, less the offset: recordings hold volts
    calibrated: bool  # Whether the sensitivity is known, so that these are the converter's volts

    def volts(self, start: int, stop: int) -> Array:
        """Read samples as volts at the converter."""
        return (self.signal.read(start, stop) - self.column.offset) * self.factor


@dataclass(frozen=True)
class Choice:
    """A channel of the scene, its position from 0, and its signal."""

    channel: Channel
    place: int
    signal: Signal
    column: Column


def choose(scene: Scene, signals: Sequence[Signal], table: Mapping[str, Column]) -> tuple[list[Choice], list[str]]:
    """Choose the signal of each channel of the scene, by the table or by name; return also notes on the others.

    Raises `SceneError` with all mistakes at once.
    """
    channels = channels_of(scene)
    names = [channel.name for channel in channels]
    mistakes = [
        f"{name}: not a channel of the scene, which has {', '.join(names)}{_hint(name, names)}"
        for name in table
        if name not in names
    ]
    chosen: list[Choice] = []
    missing: list[str] = []
    users: dict[int, list[str]] = {}
    for place, channel in enumerate(channels):
        column = table.get(channel.name)
        try:
            matches = _matches(channel.name, signals) if column is None else _by_column(column, signals)
            if len(matches) > 1:
                listed = ", ".join(f"{signal.file} ({signal.number}: {signal.name})" for signal in matches)
                name = channel.name if column is None else column.column
                raise ValueError(
                    f"several signals are called {name!r}: {listed}. Give its column and file in the table."
                )
        except ValueError as error:
            mistakes.append(f"{channel.name}: {error}")
            continue
        if not matches:
            missing.append(channel.name)
            continue
        signal = matches[0]
        chosen.append(Choice(channel, place, signal, column or Column(signal.name)))
        users.setdefault(id(signal), []).append(channel.name)
    mistakes += [f"{' and '.join(same)}: the same signal" for same in users.values() if len(same) > 1]
    if mistakes:
        raise SceneError("\n".join(mistakes))
    if not chosen:
        listed = "\n".join(f"  {signal.file}, {signal.number}: {signal}" for signal in signals)
        raise SceneError(
            f"none of the scene's channels, {', '.join(missing)}, is the name of a signal. The files hold\n{listed}\n"
            f"Assign them in a table (--table FILE.yaml) with lines such as {EXAMPLE}"
        )
    notes = [f"no signal for the channels {', '.join(missing)}: they are not recorded"] if missing else []
    unused = [signal.name for signal in signals if id(signal) not in users]
    if unused:
        notes.append(f"signals without a channel in the scene, left out: {', '.join(unused)[:300]}")
    return chosen, notes


def contradicted_units(chosen: Sequence[Choice]) -> list[str]:
    """Warn of units in the table that differ from the file's; only the table can state the meaning of volts."""
    notes = []
    for choice in chosen:
        signal, unit = choice.signal, choice.column.unit
        try:
            (from_file, size), (from_table, table_size) = meaning(signal.unit), meaning(unit or signal.unit)
        except ValueError:
            continue
        factor = table_size / size
        if from_file == from_table and abs(factor - 1.0) > _SAME_UNIT:
            effect = f", {factor:.4g} times as large"
        elif from_file not in (from_table, "voltage"):
            effect = f", {from_table} instead of {from_file}"
        else:
            continue
        notes.append(
            f"{choice.channel.name}: the table gives {unit}, {signal.file} {signal.unit} for {signal.name!r}. The "
            f"table's unit is used{effect}. Remove unit from the table if the file is right."
        )
    return notes


def assign(scene: Scene, chosen: Sequence[Choice], rate: float) -> list[Assigned]:
    """Determine the scale of signals in their channels' units; raise `SceneError` with all mistakes at once."""
    skews = delays(complete_from_preset(scene.converter).skew, len(channels_of(scene)), rate)
    assigned: list[Assigned] = []
    mistakes: list[str] = []
    for choice in chosen:
        try:
            assigned.append(_assigned(scene, choice, rate, skews[choice.place]))
        except ValueError as error:
            mistakes.append(f"{choice.channel.name}: {error}")
    if mistakes:
        raise SceneError("\n".join(mistakes))
    return assigned


def channels_of(scene: Scene) -> tuple[Channel, ...]:
    """Return the channels of a scene; the default channels if it names none."""
    return default_channels(scene, points_of(scene)) if scene.channels is None else scene.channels


def _assigned(scene: Scene, chosen: Choice, rate: float, skew: float) -> Assigned:
    channel, signal, column = chosen.channel, chosen.signal, chosen.column
    unit, limit = column.unit or signal.unit, complete_from_preset(scene.converter).range
    if not unit and signal.full_scale is not None and limit is not None:
        # Full scale of the file is the converter's range.
        unit = f"{limit!r} V"
    if not unit:
        scaled = signal.full_scale is not None
        more = " (full scale; or state the converter's range in the scene)" if scaled else ""
        raise ValueError(
            f"the unit of {signal.name!r} in {signal.file} is not stated. Give it in the table, such as unit: m/s^2, "
            f"or the meaning of 1 in the file{more}, such as unit: 5 V."
        )
    measured, size = meaning(unit)
    is_ideal = channel.accelerometer is None and channel.integrator is None and not channel.measures_force
    if is_ideal and not channel.measures_voltage and measured in _INTEGRATION_ORDERS:
        channel = channel.replace(integrator=Integrator(order=_INTEGRATION_ORDERS[measured]))
    info = describe_channel(scene, channel, rate, skew if column.delay is None else column.delay)
    if measured == info.quantity:
        if column.sensitivity is not None and measured != "voltage":
            raise ValueError(
                f"sensitivity given, but {signal.name!r} is in {unit}, not in volts. Remove the wrong key."
            )
        is_calibrated = measured == "voltage" or _has_sensitivity(channel)
        return Assigned(channel, info, signal, column, column.sign * size * info.sensitivity, is_calibrated)
    if measured != "voltage":
        raise ValueError(
            f"{signal.name!r} of {signal.file} is in {unit}, {measured}; the channel measures {info.quantity} at "
            f"{channel.at}. Check for swapped columns or a wrong unit."
        )
    info = replace(info, sensitivity=_sensitivity(channel, info, column))
    return Assigned(channel, info, signal, column, column.sign * size, True)


def describe_channel(scene: Scene, channel: Channel, rate: float, delay: float) -> ChannelInfo:
    """Describe a real channel by its data sheets.

    Simulated converters average over the sample interval unless the scene states otherwise; real converters do so only
    if the scene states it. The filter's delay is common to all channels and cannot be seen in a file.
    """
    settings = input_settings(scene.converter, channel).replace(excitation=None, remove_delay=True)
    line = stages(channel, settings, scene.seed)
    info = channel_info(channel.name, channel.at, line, settings, rate, delay)
    return replace(info, average=settings.sampling == "average")


def _sensitivity(channel: Channel, info: ChannelInfo, column: Column) -> float:
    """Volts per unit, of the table or the scene's sensor."""
    if column.sensitivity is not None:
        kinds = {"acceleration": ACCELERATION_SENSITIVITY, "force": FORCE_SENSITIVITY}
        if info.quantity not in kinds:
            raise ValueError(
                f"sensitivity of a {info.quantity}. Give the meaning of a volt instead, such as unit: 2.5 mm."
            )
        value = parse(column.sensitivity, kinds[info.quantity])
        if not 0 < value < float("inf"):
            raise ValueError(f"sensitivity: {column.sensitivity!r} is not above 0. Reverse a sensor with sign: -1.")
        return value
    if not _has_sensitivity(channel):
        raise ValueError(
            f"{column.column!r} is in volts, and its sensitivity is not stated. Give it in the table (sensitivity: "
            "100 mV/g) or to the scene's sensor."
        )
    return info.sensitivity


def _has_sensitivity(channel: Channel) -> bool:
    if channel.measures_force:
        return channel.hammer is not None and complete_from_preset(channel.hammer).sensitivity is not None
    return channel.accelerometer is not None and complete_from_preset(channel.accelerometer).sensitivity is not None


def _by_column(column: Column, signals: Sequence[Signal]) -> Sequence[Signal]:
    """Return the signals that a line of the table names, or numbers."""
    files = {signal.file: signal.file.rpartition(".")[0] for signal in signals}
    inside = [s for s in signals if column.file is None or column.file in (s.file, files[s.file])]
    if not inside:
        raise ValueError(f"file {column.file!r} is none of {', '.join(files)}")
    exact = [signal for signal in inside if signal.name == column.column]
    numbered = [signal for signal in inside if str(signal.number) == column.column]
    matches = exact or numbered or _matches(column.column, inside)
    if not matches:
        listed = ", ".join(f"{signal.number}: {signal.name}" for signal in inside[:20])
        hint = _hint(column.column, [signal.name for signal in inside])
        raise ValueError(f"no column {column.column!r}; there are {listed}{hint}")
    return matches


def _matches(name: str, signals: Sequence[Signal]) -> list[Signal]:
    """Return the signals of a name; if there are none, those whose name or its last part has a similar spelling."""
    exact = [signal for signal in signals if signal.name == name]

    def spelling(text: str) -> str:
        return re.sub(r"[\s_.-]+", "", text).casefold()

    return exact or [
        signal
        for signal in signals
        if spelling(name) in {spelling(signal.name), *(spelling(signal.name.rpartition(mark)[2]) for mark in "/.")}
    ]


def _hint(name: str, names: Sequence[str]) -> str:
    hint = suggestion(name, names)
    return hint and f". {hint}"
