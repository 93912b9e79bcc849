"""The limits of a measuring chain, and the same scene without them."""

from __future__ import annotations

import numpy as np

from daq.signal_chain.channel import ChannelInfo
from rig.scene.measurement_chain import Channel
from rig.scene.presets import complete_from_preset
from rig.scene.scene import Scene

# A limit that no test reaches, in any unit: the device keeps its states.
_UNREACHED = 1e8
_MOST_BITS = 32


def reading_limit(channel: Channel | None, info: ChannelInfo) -> tuple[float, str]:
    """Return the smallest limit of a channel in its unit, and the part that has it; infinite if none."""
    limits, volts = [(np.inf, "")], abs(info.sensitivity)
    if info.range is not None:
        limits.append((info.range / volts, f"input of {info.range:g} V"))
    if channel is None:
        return limits[-1]
    if channel.integrator is not None and channel.integrator.saturation is not None:
        rails = channel.integrator.saturation
        limits.append((rails / volts, f"integrator of {rails:g} V"))
    if info.quantity == "force" and channel.hammer is not None:
        most = complete_from_preset(channel.hammer).saturation
        limits += [] if most is None else [(most, "sensor")]
    if channel.abort is not None:
        limits.append((channel.abort, "abort limit"))
    return min(limits, key=lambda limit: limit[0])


def without_limits(scene: Scene) -> Scene:
    """Remove the limits that clip a reading or end a test; noise, resolution and linear parts stay."""
    converter, filled = scene.converter, complete_from_preset(scene.converter)
    if filled.range is not None and filled.bits is None:
        converter = converter.replace(range=_UNREACHED)
    elif filled.range is not None and filled.bits is not None:
        # The size of a count does not change.
        converter = converter.replace(range=filled.range * 2.0 ** (_MOST_BITS - filled.bits), bits=_MOST_BITS)
    channels = None if scene.channels is None else tuple(_unlimited(channel) for channel in scene.channels)
    return scene.replace(channels=channels, converter=converter)


def _unlimited(channel: Channel) -> Channel:
    changes: dict[str, object] = {"abort": None, "alarm": None}
    for name in ("accelerometer", "hammer"):
        sensor = getattr(channel, name)
        if sensor is not None and complete_from_preset(sensor).saturation is not None:
            changes[name] = sensor.replace(saturation=_UNREACHED)
    if channel.integrator is not None and channel.integrator.saturation is not None:
        changes["integrator"] = channel.integrator.replace(saturation=_UNREACHED)
    return channel.replace(**changes)
