"""Selection of channels, and mechanical quantities computed from them: motion of a point, forces on the structure.

A frequency response is the ratio of an *output* to a *reference*.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from daq.core.recording.recording import Recording
from daq.core.signal_chain.channel import ChannelInfo
from rig.core.base.errors import RecordingError, SceneError, suggestion
from rig.core.results.points import body_number
from rig.core.results.response import MOTIONS, Point

# A shaker counts as driven if the power of its force exceeds this value, relative to the largest force [dB].
_MIN_RELATIVE_FORCE_DB = -40.0


def find_channel(rec: Recording, name: str) -> ChannelInfo:
    """Return the channel called `name`, or the channel at that location (``"body 3"``, ``"arm"``, ``"table"``)."""
    channels = rec.channels
    if name in channels:
        return channels[name]
    bodies = body_names(rec)
    number = bodies.index(name.removeprefix("body ")) + 1 if name.removeprefix("body ") in bodies else None
    at = name if number is None else f"body {number}"
    for info in channels.values():
        if info.at == at:
            return info
    if number is not None:
        raise RecordingError(f"{rec.path}: no channel at {name}. Choose one of {', '.join(channels)}.")
    hint = suggestion(str(name), [*channels, *(info.at for info in channels.values()), *bodies])
    channel_list = f"{hint and hint + ' '}The channels are {', '.join(channels)}."
    raise RecordingError(f"{rec.path}: no channel {name!r}. {channel_list}")


def body_names(rec: Recording) -> tuple[str, ...]:
    """Return the names of the bodies in a recording's scene; empty if they have no names or there is no scene."""
    try:
        return rec.scene.structure.names or ()
    except RecordingError:
        return ()


def select_channels(rec: Recording, channels: Sequence[str] | str | None) -> list[str]:
    """Return the selected channels or bodies as a list; by default all channels that measure a body's motion."""
    if not channels:
        return response_channels(rec)
    names = [channels] if isinstance(channels, str) else channels
    if not isinstance(names, Iterable) or not all(isinstance(name, str) for name in names):
        raise SceneError(f"channels: got {channels!r:.60}; expected a list of names, such as {', '.join(rec.channels)}")
    return list(names)


def motion_channel_at(rec: Recording, location: str) -> ChannelInfo | None:
    """Return the first motion channel at a location (``"body 1"``, ``"table"``), or None."""
    return next((info for info in rec.channels.values() if info.at == location and info.quantity in MOTIONS), None)


def response_channels(rec: Recording) -> list[str]:
    """Return the names of the channels that measure a body's motion, in the recording's order."""
    return [name for name, info in rec.channels.items() if info.quantity in MOTIONS and info.body]


@dataclass(frozen=True)
class Measurand:
    """A mechanical quantity as a weighted sum of channels."""

    channels: tuple[str, ...]  # channels that are summed
    weights: tuple[float, ...]  # factor of the quantity at each channel
    motion: str  # quantity of the sum: displacement, velocity, acceleration or force
    reference: str = ""  # quantity as a reference of responses: force or table

    def row(self, rec: Recording, names: Sequence[str], frequency: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Compute the weights of the amplitudes of the channels `names` as recorded, shape (channels, frequencies).

        The weights contain the inverse response of sensor, amplifier and converter, and the powers of j omega that
        convert between displacement, velocity and acceleration.
        """
        row = np.zeros((len(names), frequency.size), dtype=complex)
        for name, weight in zip(self.channels, self.weights, strict=True):
            info = rec.channels[name]
            factor = weight / info.response(frequency)
            if self.motion in MOTIONS:
                order = MOTIONS.index(self.motion) - MOTIONS.index(info.quantity)
                factor = factor * (2j * np.pi * frequency) ** order
            row[names.index(name)] = factor
        return row


def motion_channel(rec: Recording, name: str) -> ChannelInfo:
    """Return the channel called `name`, which must measure motion."""
    info = find_channel(rec, name)
    if info.quantity not in MOTIONS:
        raise RecordingError(
            f"{rec.path}: channel {info.name!r} measures {info.quantity}, not motion. Choose one of "
            f"{', '.join(response_channels(rec))}."
        )
    return info


def motion_of(rec: Recording, name: str, motion: str = "displacement") -> Measurand:
    """Return the motion at the channel called `name`."""
    return Measurand((motion_channel(rec, name).name,), (1.0,), motion)


def default_reference(rec: Recording) -> str:
    """Return the reference of a recording's responses, unless another is requested."""
    try:
        return rec.scene.reference
    except RecordingError:  # the recording has no scene
        return "force"


def force_of(channel: str) -> Measurand:
    """Return the force that a channel measures."""
    return Measurand((channel,), (1.0,), "force", "force")


def reference_of(rec: Recording, reference: str) -> Measurand:
    """Return the force on the structure, or the displacement of the shaker table.

    The force is measured by a force channel if there is one. Otherwise it is the force of the coil spring,
    F1 = k0 (x0 - x1), from the channels on the table and on the driven body.
    """
    if reference == "table":
        location = rec.scene.at_driven("table")
        table = motion_channel_at(rec, location)
        if table is None:
            raise RecordingError(
                f"{rec.path}: no channel on the table ({_locations(rec)}). "
                f"Add {{name: table, at: {location}}} to the scene's channels."
            )
        return Measurand((table.name,), (1.0,), "displacement", "table")
    if reference != "force":
        raise RecordingError(f"reference: got {reference!r}; expected 'force' or 'table'")
    forces = [info for info in rec.channels.values() if info.quantity == "force"]
    # Of several force channels, that of the hammer or of the driven shaker is the reference.
    forces.sort(key=lambda info: info.at not in ("hammer", rec.scene.at_driven("shaker")))
    if forces:
        return force_of(forces[0].name)
    if rec.scene.hammer is not None:
        raise RecordingError(
            f"{rec.path}: no channel measures the force of the hammer ({_locations(rec)}). "
            "Add {name: hammer, at: hammer} to the scene's channels, or use `analysis decay`."
        )
    shaker = rec.scene.driven_shaker
    if shaker is None or shaker.coil_spring is None:
        hint = "Drive the structure through a coil spring, shaker: {kind: table, body: 1, spring: 6.6 kN/m}."
        if shaker is not None and "shaker" not in shaker.points:
            hint = f"{rec.scene.at_driven('shaker')}: {shaker.force_hint(rec.scene.at_driven('table'))}"
        elif shaker is not None:
            hint = f"Add {{name: force, at: {rec.scene.at_driven('shaker')}}} to the scene's channels."
        raise RecordingError(f"{rec.path}: no channel measures the force ({_locations(rec)}, no coil spring). {hint}")
    ends, terms = [], shaker.force_terms("", rec.scene.at_driven("table"))
    for at in terms:
        info = motion_channel_at(rec, at)
        if info is None:
            raise RecordingError(
                f"{rec.path}: the spring force k0 (x0 - x{shaker.bodies[0]}) needs a motion channel at {at} "
                f"({_locations(rec)}). Add {{name: {at.replace(' ', '')}, at: {at}}} to the scene's channels."
            )
        ends.append(info.name)
    return Measurand(tuple(ends), tuple(terms.values()), "displacement", "force")


def input_location(rec: Recording, reference: str) -> str:
    """Return the names of the bodies on which the force acts; empty for the reference 'table'."""
    label = rec.scene.structure.label
    return " and ".join(label(number) for number in rec.scene.force_on) if reference == "force" else ""


def output_point(rec: Recording, channel: str, motion: str) -> Point:
    """Return the output of responses of a channel, with the number of its body; 0 for any other location."""
    at = rec.channels[channel].at
    return Point(channel, motion, rec.scene.structure.label(at), body_number(at))


def required_channels(rec: Recording, responses: Sequence[str], reference: str) -> list[str]:
    """Return the channels from which responses and their reference are computed."""
    measurands = [*(motion_of(rec, name) for name in responses), reference_of(rec, reference)]
    return list(dict.fromkeys(name for measurand in measurands for name in measurand.channels))


def driven_forces(rec: Recording) -> tuple[Point, ...]:
    """Return the force channels of the shakers that were driven simultaneously; empty if there are fewer than two."""
    return strong_forces(relative_forces(rec))


def strong_forces(forces: Sequence[tuple[Point, float]]) -> tuple[Point, ...]:
    """Return the forces that are strong enough to be inputs; `forces`: from `relative_forces`."""
    return tuple(force for force, relative in forces if relative > _MIN_RELATIVE_FORCE_DB)


def weak_force_warnings(forces: Sequence[tuple[Point, float]]) -> list[str]:
    """Return a warning for each force that is too weak to be an input; `forces`: from `relative_forces`."""
    used = ", ".join(force.name for force in strong_forces(forces))
    return [
        f"{force.name} at {force.place} is "
        f"{'zero' if np.isinf(relative) else f'{-relative:.0f} dB below the largest'}. "
        f"It is neglected as an input, so the responses are those to {used} alone. Check its amplifier and sensor."
        for force, relative in forces
        if relative <= _MIN_RELATIVE_FORCE_DB
    ]


def relative_forces(rec: Recording) -> list[tuple[Point, float]]:
    """Return the force channel of each of several shakers, and its power relative to the largest force [dB]."""
    marker = next((marker for marker in rec.markers if "shakers" in marker.fields and marker.kind == "measure"), None)
    if marker is None:
        return []
    forces: list[Point] = []
    for number in marker.fields["shakers"]:
        at = f"shaker {number}"
        name = next((info.name for info in rec.channels.values() if info.at == at), None)
        if name is None:
            raise RecordingError(
                f"{rec.path}: no channel measures the force of shaker {number}. Add "
                f"{{name: force{number}, at: {at}}} to the scene's channels."
            )
        bodies = (rec.scene.structure.label(body) for body in rec.scene.shakers[number - 1].bodies)
        forces.append(Point(name, "force", " and ".join(bodies)))
    stop = min(marker.stop, rec.samples)
    power = [float(np.nanvar(rec.read(point.name, marker.first_sample, stop))) for point in forces]
    with np.errstate(divide="ignore", invalid="ignore"):
        decibels = 10.0 * np.log10(np.array(power) / max(power))
    return list(zip(forces, np.nan_to_num(decibels, nan=-np.inf, neginf=-np.inf).tolist(), strict=True))


def reject_zero_reference(rec: Recording, denominator: Measurand, amplitude: NDArray[np.generic]) -> None:
    """Reject a reference that is zero at all lines, because the response is then undefined."""
    if not np.any(np.abs(amplitude) > 0):
        quantity = "force on the structure" if denominator.reference == "force" else "displacement of the table"
        raise RecordingError(
            f"{rec.path}: the {quantity} is zero throughout the measurement. Check the excitation and its channels "
            "(`daq info`), and record again."
        )


def _locations(rec: Recording) -> str:
    """List the channels of a recording with their quantities and locations, for messages."""
    channels = [f"{name}: {info.quantity} at {info.at}" for name, info in rec.channels.items()]
    return f"it has {', '.join(channels) or 'no channels'}"
