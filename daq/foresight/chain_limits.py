"""The limits of a measuring chain, and the same scene without them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from daq.signal_chain.channel import ChannelInfo
from rig.scene.measurement_chain import Channel, Converter
from rig.scene.presets import filled_in
from rig.scene.scene import Scene

# A limit that no test reaches, in any unit: the device keeps its states.
_UNREACHED = 1e8
_MOST_BITS = 32


@dataclass(frozen=True)
class ReadingLimit:
    """Largest reading of a part of the channel, in the channel's unit."""

    size: float
    part: str


def reading_limit(channel: Channel | None, info: ChannelInfo) -> ReadingLimit:
    """Give the smallest limit of a channel: its input, its integrator, its abort limit; infinite if none."""
    limits = [ReadingLimit(np.inf, "")]
    if info.range is not None:
        limits.append(ReadingLimit(info.range / abs(info.sensitivity), f"input of {info.range:g} V"))
    if channel is None:
        return limits[-1]
    rails = None if channel.integrator is None else channel.integrator.saturation
    if rails is not None:
        limits.append(ReadingLimit(rails / abs(info.sensitivity), f"integrator of {rails:g} V"))
    if info.quantity == "force" and channel.hammer is not None:
        most = filled_in(channel.hammer).saturation
        limits += [] if most is None else [ReadingLimit(most, "sensor")]
    if channel.abort is not None:
        limits.append(ReadingLimit(channel.abort, "abort limit"))
    return min(limits, key=lambda limit: limit.size)


def without_limits(scene: Scene) -> Scene:
    """Remove the limits that clip a reading or end a test; noise, resolution and linear parts stay."""
    channels = None
    if scene.channels is not None:
        channels = tuple(_unlimited(channel) for channel in scene.channels)
    return scene.replace(channels=channels, converter=_wider(scene.converter))


def _unlimited(channel: Channel) -> Channel:
    changes: dict[str, object] = {"abort": None, "alarm": None}
    accelerometer, hammer = channel.accelerometer, channel.hammer
    if accelerometer is not None and filled_in(accelerometer).saturation is not None:
        changes["accelerometer"] = accelerometer.replace(saturation=_UNREACHED)
    if hammer is not None and filled_in(hammer).saturation is not None:
        changes["hammer"] = hammer.replace(saturation=_UNREACHED)
    if channel.integrator is not None and channel.integrator.saturation is not None:
        changes["integrator"] = channel.integrator.replace(saturation=_UNREACHED)
    return channel.replace(**changes)


def _wider(converter: Converter) -> Converter:
    """Widen the range without changing the size of a count."""
    filled = filled_in(converter)
    if filled.range is None:
        return converter
    if filled.bits is None:
        return converter.replace(range=_UNREACHED)
    more = _MOST_BITS - filled.bits
    return converter.replace(range=filled.range * 2.0**more, bits=_MOST_BITS)
