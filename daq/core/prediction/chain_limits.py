"""The limits of a measuring chain (sensor, integrator, converter input), and the scene without such limits."""

import numpy as np

from daq.core.signal_chain.channel import ChannelInfo
from rig.core.scene.measurement_chain import Channel
from rig.core.scene.presets import complete_from_preset
from rig.core.scene.scene import Scene

# A limit that no test reaches, in any unit; None may change the number of states of the device's model.
_NO_LIMIT = 1e8
# Largest word length [bits] of a converter; samples are stored with at most 32 bits.
_MAX_BITS = 32


def reading_limit(channel: Channel | None, info: ChannelInfo) -> tuple[float, str]:
    """Return the lowest limit of a channel's reading, in its unit (inf without a limit), and the part with this limit.

    The limit of an accelerometer is not a reading but an acceleration; `foresee` compares it with the motion.
    `channel`: settings of the channel in the scene; None if the scene does not define channels.
    """
    limits, sensitivity = [(np.inf, "")], abs(info.sensitivity)
    if info.range is not None:
        limits.append((info.range / sensitivity, f"input range {info.range:g} V"))
    if channel is None:
        return limits[-1]
    if channel.integrator is not None and channel.integrator.saturation is not None:
        saturation_volts = channel.integrator.saturation
        limits.append((saturation_volts / sensitivity, f"integrator saturation {saturation_volts:g} V"))
    if info.quantity == "force" and channel.hammer is not None:
        saturation = complete_from_preset(channel.hammer).saturation
        limits += [] if saturation is None else [(saturation, "sensor")]
    if channel.abort is not None:
        limits.append((channel.abort, "abort limit"))
    return min(limits, key=lambda limit: limit[0])


def without_limits(scene: Scene) -> Scene:
    """Return the scene with noise and resolution, without limits that clip a reading, mark an alarm or end a test."""
    converter, converter_settings = scene.converter, complete_from_preset(scene.converter)
    if converter_settings.range is not None and converter_settings.bits is None:
        converter = converter.replace(range=_NO_LIMIT)
    elif converter_settings.range is not None and converter_settings.bits is not None:
        # The quantization step (LSB) must not change.
        converter = converter.replace(
            range=converter_settings.range * 2.0 ** (_MAX_BITS - converter_settings.bits), bits=_MAX_BITS
        )
    channels = None if scene.channels is None else tuple(_channel_without_limits(channel) for channel in scene.channels)
    return scene.replace(channels=channels, converter=converter)


def _channel_without_limits(channel: Channel) -> Channel:
    changes: dict[str, object] = {"abort": None, "alarm": None}
    for name in ("accelerometer", "hammer"):
        sensor = getattr(channel, name)
        if sensor is not None and complete_from_preset(sensor).saturation is not None:
            changes[name] = sensor.replace(saturation=_NO_LIMIT)
    if channel.integrator is not None and channel.integrator.saturation is not None:
        changes["integrator"] = channel.integrator.replace(saturation=_NO_LIMIT)
    return channel.replace(**changes)
