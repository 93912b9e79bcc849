"""Assignment of the signals of files to the channels of a scene, and the factor from their numbers to volts."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from daq.core.dsp.skew import delays
from daq.core.recording.truth import points_of
from daq.core.signal_chain.chain import default_channels
from daq.core.signal_chain.channel import ChannelInfo, Quantity
from daq.core.signal_chain.devices import channel_stages
from daq.core.signal_chain.stage import channel_info
from daq.extras.importing.channel_table import EXAMPLE, Column
from daq.extras.importing.signal import Signal
from daq.extras.importing.units import quantity_and_scale
from rig.core.base.arrays import Array
from rig.core.base.errors import SceneError, suggestion
from rig.core.scene.measurement_chain import Channel, Integrator
from rig.core.scene.presets import complete_from_preset, input_settings
from rig.core.scene.scene import Scene
from rig.core.settings.quantities import ACCELERATION_SENSITIVITY, FORCE_SENSITIVITY, parse

# Two units are equal if their SI values differ by less than this fraction, because they may be rounded differently.
_UNIT_TOLERANCE = 1e-3
# A misspelled name is compared with at most this number of names: a table may contain thousands of misspelled names.
_MAX_COMPARED_NAMES = 200
# Number of integrations of an ideal channel that measures velocity or displacement, such as a laser sensor.
_INTEGRATION_ORDERS: dict[Quantity, int] = {"velocity": 1, "displacement": 2}


@dataclass(frozen=True)
class AssignedSignal:
    """A signal with its channel and the factor to volts: recordings contain the volts at the converter."""

    channel: Channel  # channel of the scene, with an ideal integrator if the signal is a velocity or a displacement
    info: ChannelInfo
    signal: Signal
    column: Column
    factor: float  # volts at the converter per unit of the file, after subtraction of the offset
    calibrated: bool  # whether the sensitivity is known, so the volts are those of the real converter

    def volts(self, start: int, stop: int) -> Array:
        """Read samples as volts at the converter; NaN beyond the end of the signal."""
        volts, end = np.full(stop - start, np.nan), self.signal.samples
        if end > start:
            volts[: end - start] = (self.signal.read(start, min(stop, end)) - self.column.offset) * self.factor
        return volts


@dataclass(frozen=True)
class ChosenSignal:
    """A channel of the scene, its position in the scene from 0, its signal, and the line of the table."""

    channel: Channel
    position: int
    signal: Signal
    column: Column


def choose_signals(
    scene: Scene, signals: Sequence[Signal], table: Mapping[str, Column], requires_force: bool
) -> tuple[list[ChosenSignal], list[str]]:
    """Choose the signal of each channel of the scene, by the table or by name; also return notes on omitted signals.

    Raises `SceneError` with all problems at once, or if the test requires a force channel and none has a signal.
    """
    channels = channels_of(scene)
    names = [channel.name for channel in channels]
    problems = [
        f"{name}: not a channel of the scene, which has {', '.join(names)}{_spelling_hint(name, names)}"
        for name in table
        if name not in names
    ]
    chosen: list[ChosenSignal] = []
    missing: list[str] = []
    channels_of_signal: dict[int, list[str]] = {}
    for position, channel in enumerate(channels):
        column = table.get(channel.name)
        try:
            matches = (
                _signals_with_name(channel.name, signals) if column is None else _signals_of_column(column, signals)
            )
            if len(matches) > 1:
                listed = ", ".join(f"{signal.file} ({signal.number}: {signal.name})" for signal in matches)
                name = channel.name if column is None else column.column
                raise ValueError(
                    f"several signals are called {name!r}: {listed}. Choose one by column and file in a channel table."
                )
        except ValueError as error:
            problems.append(f"{channel.name}: {error}")
            continue
        if not matches:
            missing.append(channel.name)
            continue
        signal = matches[0]
        chosen.append(ChosenSignal(channel, position, signal, column or Column(signal.name)))
        channels_of_signal.setdefault(id(signal), []).append(channel.name)
    problems += [
        f"{' and '.join(channel_names)}: the same signal. Assign a different signal to each."
        for channel_names in channels_of_signal.values()
        if len(channel_names) > 1
    ]
    if problems:
        raise SceneError("\n".join(problems))
    if not chosen:
        listed = "\n".join(f"  {signal.file}, {signal.number}: {signal}" for signal in signals)
        raise SceneError(
            f"no signal has the name of a channel of the scene ({', '.join(missing)}). The files contain\n"
            f"{listed}\nAssign signals in a channel table (`table`) with lines such as {EXAMPLE}"
        )
    unused = [signal.name for signal in signals if id(signal) not in channels_of_signal]
    listed = ", ".join(f"{name}{_spelling_hint(name, unused)}" for name in missing)
    notes = [f"no signal for the channels {listed}: they are not recorded"] if missing else []
    if unused:
        notes.append(f"omitted signals, for which the scene has no channel: {', '.join(unused)[:300]}")
    if requires_force and not any(choice.channel.measures_force for choice in chosen):
        raise SceneError(
            "no channel measures a force, in which the impacts of the scene's test are detected.\n"
            + "\n".join(f"  {note}" for note in notes)
            + f"\nAssign the force in a channel table (`table`) with lines such as {EXAMPLE}"
        )
    return chosen, notes


def contradicted_units(chosen: Sequence[ChosenSignal]) -> list[str]:
    """Return notes on units in the table that contradict the file; volts in the file contradict no unit."""
    notes = []
    for choice in chosen:
        signal, unit = choice.signal, choice.column.unit
        try:
            file_quantity, scale = quantity_and_scale(signal.unit)
            table_quantity, table_scale = quantity_and_scale(unit or signal.unit)
        except ValueError:
            continue
        factor = table_scale / scale
        if file_quantity == table_quantity and abs(factor - 1.0) > _UNIT_TOLERANCE:
            effect = f"the values are {factor:.4g} times as large"
        elif file_quantity not in (table_quantity, "voltage"):
            effect = f"the values are {table_quantity} instead of {file_quantity}"
        else:
            continue
        notes.append(
            f"{choice.channel.name}: the channel table gives unit {unit}, but {signal.file} gives {signal.unit} for "
            f"{signal.name!r}. The unit of the table is used: {effect}. If the file is right, remove this unit."
        )
    return notes


def assign(scene: Scene, chosen: Sequence[ChosenSignal], rate: float) -> list[AssignedSignal]:
    """Determine the factor that converts each signal to volts; `rate` in Hz.

    Raises `SceneError` with all problems at once.
    """
    skews = delays(complete_from_preset(scene.converter).skew, len(channels_of(scene)), rate)
    assigned: list[AssignedSignal] = []
    problems: list[str] = []
    for choice in chosen:
        try:
            assigned.append(_assigned(scene, choice, rate, skews[choice.position]))
        except ValueError as error:
            problems.append(f"{choice.channel.name}: {error}")
    if problems:
        raise SceneError("\n".join(problems))
    return assigned


def channels_of(scene: Scene) -> tuple[Channel, ...]:
    """Return the channels of a scene; the default channels if the scene defines none."""
    return default_channels(scene, points_of(scene)) if scene.channels is None else scene.channels


def _assigned(scene: Scene, chosen: ChosenSignal, rate: float, skew: float) -> AssignedSignal:
    channel, signal, column = chosen.channel, chosen.signal, chosen.column
    unit, converter_range = column.unit or signal.unit, complete_from_preset(scene.converter).range
    if not unit and signal.full_scale is not None and converter_range is not None:
        # The full scale of the file is the converter's range.
        unit = f"{converter_range!r} V"
    if not unit:
        has_full_scale = signal.full_scale is not None
        hint = ", or set converter.range in the scene" if has_full_scale else ""
        expected_unit = describe_channel(scene, channel, rate, skew).unit
        raise ValueError(
            f"the unit of {signal.name!r} in {signal.file} is not stated. Give it in a channel table, such as `unit: "
            f"{expected_unit}`, or `unit: 5 V` if the number 1 in the file represents 5 V{hint}."
        )
    measured, scale = quantity_and_scale(unit)
    is_ideal = channel.accelerometer is None and channel.integrator is None and not channel.measures_force
    if is_ideal and not channel.measures_voltage and measured in _INTEGRATION_ORDERS:
        channel = channel.replace(integrator=Integrator(order=_INTEGRATION_ORDERS[measured]))
    info = describe_channel(scene, channel, rate, skew if column.delay is None else column.delay)
    if measured == info.quantity:
        if column.sensitivity is not None and measured != "voltage":
            raise ValueError(
                f"sensitivity: only for a signal in volts, but {signal.name!r} is in {unit}. Remove sensitivity, or "
                "correct unit."
            )
        is_calibrated = measured == "voltage" or _has_sensitivity(channel)
        return AssignedSignal(channel, info, signal, column, column.sign * scale * info.sensitivity, is_calibrated)
    if measured != "voltage":
        raise ValueError(
            f"{signal.name!r} of {signal.file} is in {unit} ({measured}), but the channel measures {info.quantity} at "
            f"{channel.at}. Assign another column, or correct unit."
        )
    info = replace(info, sensitivity=_volts_per_unit(channel, info, column))
    return AssignedSignal(channel, info, signal, column, column.sign * scale, True)


def describe_channel(scene: Scene, channel: Channel, rate: float, delay: float) -> ChannelInfo:
    """Describe a real channel by its data sheets; `rate` in Hz, `delay` in s.

    A simulated converter averages over the sample interval unless the scene specifies otherwise; a real converter does
    so only if the scene specifies it. The delay of the filter is the same for all channels and therefore ignored.
    """
    settings = input_settings(scene.converter, channel).replace(excitation=None, remove_delay=True)
    chain_stages = channel_stages(channel, settings, scene.seed)
    info = channel_info(channel.name, channel.at, chain_stages, settings, rate, delay)
    return replace(info, average=settings.sampling == "average")


def _volts_per_unit(channel: Channel, info: ChannelInfo, column: Column) -> float:
    """Return the sensitivity in V per SI unit, from the table or the sensor of the scene."""
    if column.sensitivity is not None:
        unit_kinds = {"acceleration": ACCELERATION_SENSITIVITY, "force": FORCE_SENSITIVITY}
        if info.quantity not in unit_kinds:
            raise ValueError(
                f"sensitivity: not available for {info.quantity}. Instead, give the value of 1 V, such as unit: 2.5 mm."
            )
        value = parse(column.sensitivity, unit_kinds[info.quantity])
        if not 0 < value < float("inf"):
            raise ValueError(
                f"sensitivity: got {column.sensitivity!r}; expected a finite value above 0. For a reversed sensor, add "
                "sign: -1."
            )
        return value
    if not _has_sensitivity(channel):
        raise ValueError(
            f"{column.column!r} is in volts, and its sensitivity is not stated. Add it to the channel table "
            "(sensitivity: 100 mV/g), or to the sensor in the scene."
        )
    return info.sensitivity


def _has_sensitivity(channel: Channel) -> bool:
    if channel.measures_force:
        return channel.hammer is not None and complete_from_preset(channel.hammer).sensitivity is not None
    return channel.accelerometer is not None and complete_from_preset(channel.accelerometer).sensitivity is not None


def _signals_of_column(column: Column, signals: Sequence[Signal]) -> Sequence[Signal]:
    """Return the signals with the name or number in a line of the table."""
    files = {signal.file: signal.file.rpartition(".")[0] for signal in signals}
    in_file = [s for s in signals if column.file is None or column.file in (s.file, files[s.file])]
    if not in_file:
        raise ValueError(
            f"file: {column.file!r} is not imported; the imported files are {', '.join(files)}. Give one of them."
        )
    same_name = [signal for signal in in_file if signal.name == column.column]
    same_number = [signal for signal in in_file if str(signal.number) == column.column]
    matches = same_name or same_number or _signals_with_name(column.column, in_file)
    if not matches:
        listed = ", ".join(f"{signal.number}: {signal.name}" for signal in in_file[:20])
        hint = _spelling_hint(column.column, [signal.name for signal in in_file])
        searched = ", ".join(dict.fromkeys(signal.file for signal in in_file))
        raise ValueError(f"no column {column.column!r} in {searched}; there are {listed}{hint}")
    return matches


def _signals_with_name(name: str, signals: Sequence[Signal]) -> list[Signal]:
    """Return the signals of a name.

    Otherwise those whose name, or its last part, differs only in case or separators.
    """
    same_name = [signal for signal in signals if signal.name == name]
    return same_name or [signal for signal in signals if _normalized(name) in _similar_names(signal.name)]


@cache
def _similar_names(name: str) -> frozenset[str]:
    """Return a name and its last parts, without case and separators."""
    return frozenset(map(_normalized, (name, *(name.rpartition(separator)[2] for separator in "/."))))


@cache
def _normalized(text: str) -> str:
    return re.sub(r"[\s_.-]+", "", text).casefold()


def _spelling_hint(name: str, names: Sequence[str]) -> str:
    hint = suggestion(name, names) if len(names) <= _MAX_COMPARED_NAMES else ""
    return hint and f" ({hint})"
