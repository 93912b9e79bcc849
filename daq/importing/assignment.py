"""Which signal is which channel, and what its numbers are in the channel's unit."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from daq.dsp.skew import delays
from daq.importing.channel_table import EXAMPLE, Column
from daq.importing.signal import Array, Signal
from daq.importing.units import meaning
from daq.recording.truth import points_of
from daq.signal_chain.chain import default_channels, stages
from daq.signal_chain.channel import ChannelInfo, Quantity
from daq.signal_chain.channel_description import channel_info
from daq.signal_chain.converter import SampleClock, volts_per_count
from rig.errors import SceneError
from rig.scene.measurement_chain import Channel, Integrator
from rig.scene.presets import filled_in, input_settings
from rig.scene.quantities import ACCELERATION_SENSITIVITY, FORCE_SENSITIVITY, parse
from rig.scene.scene import Scene

# Units whose sizes differ by a smaller share are the same, written with fewer digits.
_SAME_UNIT = 1e-3
# Orders of integration after which an ideal channel reads what a vibrometer or a distance sensor does.
_ORDERS: dict[Quantity, int] = {"velocity": 1, "displacement": 2}


@dataclass(frozen=True)
class Assigned:
    """A channel and where its samples come from."""

    channel: Channel
    """As the scene has it; with the ideal integrator where the signal is a velocity or a displacement."""
    info: ChannelInfo
    signal: Signal
    column: Column
    factor: float
    """What one of the file's numbers, less the offset, is in volts at the converter: recordings hold volts."""
    calibrated: bool
    """Whether the sensitivity is known, so that these are the volts that the converter had."""

    def volts(self, start: int, stop: int) -> Array:
        """Read samples as the converter would have given them."""
        return (self.signal.read(start, stop) - self.column.offset) * self.factor


@dataclass(frozen=True)
class Choice:
    """A channel of the scene and the signal that is its own."""

    channel: Channel
    place: int
    """Which of the scene's channels it is, from 0."""
    signal: Signal
    column: Column


def choose(
    scene: Scene, signals: Sequence[Signal], table: Mapping[str, Column]
) -> tuple[list[Choice], list[str]]:
    """Find the signal of each of the scene's channels: as the table says, or else by its name.

    Returns
    -------
    list of Choice
        In the order of the scene.
    list of str
        What was not found or not used, in words.

    Raises
    ------
    SceneError
        If the table names what is not there, or no signal is a channel's; all at once.
    """
    channels = of_scene(scene)
    wrong = [_unknown(name, channels) for name in table if name not in {channel.name for channel in channels}]
    chosen: list[Choice] = []
    missing: list[str] = []
    for place, channel in enumerate(channels):
        said = table.get(channel.name)
        try:
            signal = _chosen(said, signals) if said is not None else _by_name(channel.name, signals)
        except ValueError as error:
            wrong.append(f"{channel.name}: {error}")
            continue
        if signal is None:
            missing.append(channel.name)
        else:
            chosen.append(Choice(channel, place, signal, Column(signal.name) if said is None else said))
    wrong += _twice(chosen)
    if wrong:
        raise SceneError("\n".join(wrong))
    if not chosen:
        listed = "\n".join(f"  {signal.file}, {signal.number}: {signal}" for signal in signals)
        raise SceneError(
            f"none of the scene's channels, {', '.join(missing)}, is the name of a signal. The files hold\n{listed}\n"
            f"Say which is which in a table (--table FILE.yaml) with lines such as {EXAMPLE}"
        )
    notes = (
        [f"no signal for the channels {', '.join(missing)}: the recording goes without"] if missing else []
    )
    used = {id(one.signal) for one in chosen}
    unused = [signal.name for signal in signals if id(signal) not in used]
    if unused:
        notes.append(f"signals that are no channel of the scene, left out: {', '.join(unused)[:300]}")
    return chosen, notes


def contradicted_units(chosen: Sequence[Choice]) -> list[str]:
    """Warn of units in the table other than those that the files state; what volts mean only the table can say."""
    notes = []
    for one in chosen:
        signal, unit = one.signal, one.column.unit
        try:
            (stated, size), (said, said_size) = meaning(signal.unit), meaning(unit or signal.unit)
        except ValueError:
            continue
        factor = said_size / size
        if stated == said and abs(factor - 1.0) > _SAME_UNIT:
            how = f", {factor:.4g} times as large"
        elif stated not in (said, "voltage"):
            how = f", {said} instead of {stated}"
        else:
            continue
        notes.append(
            f"{one.channel.name}: the table says {unit}, {signal.file} says {signal.unit} of {signal.name!r}. The "
            f"table's unit is used{how}. Remove unit from the table if the file is right."
        )
    return notes


def assign(scene: Scene, chosen: Sequence[Choice], rate: float) -> list[Assigned]:
    """Say what the numbers of signals are in their channels' units.

    Raises
    ------
    SceneError
        If numbers have no unit or a wrong one; all at once.
    """
    late = delays(filled_in(scene.converter).skew, len(of_scene(scene)), rate)
    made: list[Assigned] = []
    wrong: list[str] = []
    for one in chosen:
        try:
            made.append(_assigned(scene, one, rate, late[one.place]))
        except ValueError as error:
            wrong.append(f"{one.channel.name}: {error}")
    if wrong:
        raise SceneError("\n".join(wrong))
    return made


def of_scene(scene: Scene) -> tuple[Channel, ...]:
    """Give the channels of a scene, also of one that names none."""
    if scene.channels is not None:
        return scene.channels
    return default_channels(scene, points_of(scene))


def _assigned(scene: Scene, chosen: Choice, rate: float, skew: float) -> Assigned:
    channel, signal, column = chosen.channel, chosen.signal, chosen.column
    unit = column.unit or signal.unit
    if not unit:
        unit = _full_scale_unit(scene, signal)
    measured, size = meaning(unit)
    bare = channel.accelerometer is None and channel.integrator is None and not channel.measures_force
    if bare and not channel.measures_voltage and measured in _ORDERS:
        channel = channel.replace(integrator=Integrator(order=_ORDERS[measured]))
    info = described(scene, channel, rate, skew if column.delay is None else column.delay)
    if measured == info.quantity:
        if column.sensitivity is not None and measured != "voltage":
            raise ValueError(
                f"sensitivity given, but {signal.name!r} is in {unit}, not in volts; leave one out"
            )
        known = measured == "voltage" or _stated(channel)
        return Assigned(channel, info, signal, column, column.sign * size * info.sensitivity, known)
    if measured != "voltage":
        raise ValueError(
            f"{signal.name!r} of {signal.file} is in {unit}, {measured}; the channel measures {info.quantity} at "
            f"{channel.at}: columns swapped, or a wrong unit?"
        )
    info = replace(info, sensitivity=_sensitivity(channel, info, column))
    return Assigned(channel, info, signal, column, column.sign * size, True)


def described(scene: Scene, channel: Channel, rate: float, delay: float) -> ChannelInfo:
    """Describe a real channel by its data sheets.

    Averaging over the sample interval is how converters are simulated of which a scene says nothing; a real one does it
    only if the scene says so. The filter's delay belongs to all channels and cannot be seen in a file.
    """
    settings = input_settings(scene.converter, channel).replace(excitation=None, remove_delay=True)
    line = stages(channel, settings, scene.seed)
    info = channel_info(channel.name, channel.at, line, settings, SampleClock(rate, rate), delay)
    return replace(
        info,
        average=settings.sampling == "average",
        range=settings.range,
        volts_per_count=volts_per_count(settings),
    )


def _sensitivity(channel: Channel, info: ChannelInfo, column: Column) -> float:
    """Volts per unit, as the table or the scene's sensor has it."""
    if column.sensitivity is not None:
        kinds = {"acceleration": ACCELERATION_SENSITIVITY, "force": FORCE_SENSITIVITY}
        if info.quantity not in kinds:
            raise ValueError(
                f"sensitivity of a {info.quantity}: say by unit what a volt means, such as unit: 2.5 mm"
            )
        value = parse(column.sensitivity, kinds[info.quantity])
        if not 0 < value < float("inf"):
            raise ValueError(
                f"sensitivity: got {column.sensitivity!r}; expected one above 0 (sign: -1 turns it round)"
            )
        return value
    if not _stated(channel):
        raise ValueError(
            f"{column.column!r} is in volts, and nothing says its sensitivity; give it in the table (sensitivity: "
            "100 mV/g) or to the scene's sensor"
        )
    return info.sensitivity


def _stated(channel: Channel) -> bool:
    """Whether the scene says the sensitivity of a channel's sensor."""
    if channel.measures_force:
        return channel.hammer is not None and filled_in(channel.hammer).sensitivity is not None
    return channel.accelerometer is not None and filled_in(channel.accelerometer).sensitivity is not None


def _full_scale_unit(scene: Scene, signal: Signal) -> str:
    """Take full scale for the converter's range where a file knows full scale only."""
    limit = filled_in(scene.converter).range
    if signal.full_scale is not None and limit is not None:
        return f"{limit!r} V"
    more = (
        " (full scale; the converter's range in the scene says it, too)"
        if signal.full_scale is not None
        else ""
    )
    raise ValueError(
        f"nothing says the unit of {signal.name!r} in {signal.file}; give it in the table, such as unit: m/s^2, or "
        f"what one in the file means{more}, such as unit: 5 V"
    )


def _chosen(said: Column, signals: Sequence[Signal]) -> Signal:
    """Find the signal that the table names, or numbers."""
    inside = [
        signal
        for signal in signals
        if said.file is None or said.file in (signal.file, signal.file.rpartition(".")[0])
    ]
    if not inside:
        raise ValueError(
            f"file {said.file!r} is none of {', '.join(dict.fromkeys(signal.file for signal in signals))}"
        )
    found = [signal for signal in inside if signal.name == said.column]
    found = found or [signal for signal in inside if str(signal.number) == said.column]
    found = found or [signal for signal in inside if _plain(said.column) in _aliases(signal)]
    if not found:
        near = difflib.get_close_matches(said.column, [signal.name for signal in inside], n=1)
        names = ", ".join(f"{signal.number}: {signal.name}" for signal in inside[:20])
        raise ValueError(f"no column {said.column!r}{f'; {near[0]}?' if near else ''}; there are {names}")
    return _only(found, said.column)


def _by_name(name: str, signals: Sequence[Signal]) -> Signal | None:
    found = [signal for signal in signals if signal.name == name]
    found = found or [signal for signal in signals if _plain(name) in _aliases(signal)]
    return _only(found, name) if found else None


def _only(found: Sequence[Signal], name: str) -> Signal:
    if len(found) > 1:
        where = ", ".join(f"{signal.file} ({signal.number}: {signal.name})" for signal in found)
        raise ValueError(
            f"several signals are called {name!r}: {where}; say which in the table, by column and file"
        )
    return found[0]


def _plain(name: str) -> str:
    return re.sub(r"[\s_.-]+", "", name).casefold()


def _aliases(signal: Signal) -> set[str]:
    """Names that a signal goes by: its own, and without its group or the structure that it is in."""
    return {_plain(signal.name), *(_plain(signal.name.rpartition(mark)[2]) for mark in "/.")}


def _twice(chosen: Sequence[Choice]) -> list[str]:
    users: dict[int, list[str]] = {}
    for one in chosen:
        users.setdefault(id(one.signal), []).append(one.channel.name)
    return [f"{' and '.join(names)}: one signal for both" for names in users.values() if len(names) > 1]


def _unknown(name: str, channels: Sequence[Channel]) -> str:
    names = [channel.name for channel in channels]
    near = difflib.get_close_matches(name, names, n=1)
    return f"{name}: no channel of the scene, which has {', '.join(names)}{f'; {near[0]}?' if near else ''}"
