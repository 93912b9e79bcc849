"""Variants of a scene for `analysis cost`: one part of its measurement chain is changed at a time."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from rig.core.base.errors import SceneError
from rig.core.scene.measurement_chain import Accelerometer, Channel, Integrator
from rig.core.scene.presets import complete_from_preset
from rig.core.scene.scene import Scene

#: Sample rates, relative to the sample rate of the scene.
RATE_RATIOS = (0.125, 0.25, 0.5, 2.0, 4.0, 8.0)
#: Minimum number of samples per period of the highest frequency.
MIN_SAMPLES_PER_PERIOD = 4.0
#: Mounted resonances of the sensors, relative to the highest frequency: from a visible to a negligible error.
RESONANCE_RATIOS = (10.0, 100.0, 1000.0)
#: Bits of the converter.
BITS = (24, 16, 12)
#: Lower corner frequency of an added integrator, relative to the lowest frequency: its phase error is visible there.
CORNER_RATIO = 0.1
#: Sensor settings whose effect no data sheet can correct: tolerances, and bias after switching on.
UNCORRECTABLE_SETTINGS = (
    "sensitivity_tolerance", "temperature_drift", "temperature_change", "transverse", "lateral",
    "bias", "bias_settling",
)  # fmt: skip
#: Range of the converter relative to the largest voltage, if the scene gives no range: noise and transients fit in.
HEADROOM = 1.5

#: Output of an integrator of order 0, 1, 2.
INTEGRATOR_OUTPUTS = ("none", "velocity", "displacement")
#: Changed parts, in the order of the signal path.
GROUPS = ("sensor", "noise", "integrator", "anti-alias filter", "sample rate", "bits")


@dataclass(frozen=True)
class Variant:
    """A scene with one part of its chain changed."""

    group: str  # changed part, one of `GROUPS`; "" for the scene itself
    setting: str  # new setting of this part
    scene: Scene


def expand_chain(scene: Scene) -> Scene:
    """Return the scene with presets and channels, without alarms and aborts; `SceneError` without a force channel."""
    shaker = scene.driven_shaker
    converter = complete_from_preset(scene.converter).replace(preset=None, rate=scene.converter.sample_rate)
    channels = scene.channels
    if shaker is not None and shaker.drive_is_force:
        if channels is not None and not any(channel.measures_force for channel in channels):
            raise SceneError(
                "channels: no channel measures the force, so the compliance has no reference. Add "
                "{name: force, at: shaker}, or delete the key channels to assume ideal channels."
            )
    elif channels is None:
        bodies = [f"body {number}" for number in range(1, scene.structure.bodies + 1)]
        channels = tuple(Channel(name=at.replace(" ", ""), at=at) for at in [*bodies, scene.at_driven("table")])
    if channels is not None:
        channels = tuple(_with_presets_filled_in(channel) for channel in channels)
    return scene.replace(channels=channels, converter=converter)


def _with_presets_filled_in(channel: Channel) -> Channel:
    sensor = channel.accelerometer
    if sensor is not None:
        sensor = complete_from_preset(sensor).replace(preset=None)
    hammer = None if channel.hammer is None else complete_from_preset(channel.hammer).replace(preset=None)
    return channel.replace(accelerometer=sensor, hammer=hammer, alarm=None, abort=None)


def scene_setting(scene: Scene, group: str) -> str:
    """Describe the setting of a part of the chain, one of `GROUPS`, in an expanded scene."""
    converter, channels = scene.converter, scene.channels or ()
    if group == "sample rate":
        return f"{converter.rate:.6g} Hz"
    if group == "bits":
        return "none" if converter.bits is None else str(converter.bits)
    if group == "anti-alias filter":
        return "off" if converter.filter is None else "on"
    if group == "integrator":
        texts = [
            INTEGRATOR_OUTPUTS[0 if c.integrator is None else c.integrator.order]
            for c in channels
            if not c.measures_force
        ]
    elif group == "sensor":
        sensors = [channel.accelerometer for channel in channels if not channel.measures_force]
        texts = [
            "no resonance" if s is None or s.resonance is None else f"resonance {s.resonance:.6g} Hz" for s in sensors
        ]
    else:
        texts = []
    return " and ".join(dict.fromkeys(texts))


def without_noise(scene: Scene) -> Scene:
    """Return an expanded scene without the errors that no correction removes: noise, rounding, tolerances and bias."""
    return _without_tolerances(_without_quantization(_with_noise(scene, 0.0)))


def _without_tolerances(scene: Scene) -> Scene:
    """Remove sensor tolerances and bias."""
    if scene.channels is None:
        return scene
    scene = _with_sensors(scene, **dict.fromkeys(UNCORRECTABLE_SETTINGS))
    channels = [
        channel
        if channel.hammer is None
        else channel.replace(hammer=channel.hammer.replace(sensitivity_tolerance=None))
        for channel in scene.channels or ()
    ]
    return scene.replace(channels=channels)


def _without_quantization(scene: Scene) -> Scene:
    """Remove quantization by the converter."""
    return _with_converter(scene, bits=None).replace(recording=scene.recording.replace(samples=None))


def variants(
    scene: Scene, lowest: float, peak_frequency: float, highest: float, largest_voltage: float
) -> Iterator[Variant]:
    """Change one part at a time in the scene from `without_noise`, in which noise does not mask the effects.

    `scene`: as returned by `expand_chain`; `lowest`, `peak_frequency`, `highest`: measured frequencies [Hz]; an added
    integrator has unit gain at `peak_frequency`; `largest_voltage`: of the unchanged scene [V]; it determines the range
    of a converter without a range.
    """
    for name, factor in (("the scene's", 1.0), ("ten times", 10.0)):
        noisy = _with_noise(scene, factor)
        if noisy != _with_noise(scene, 0.0):
            yield Variant("noise", name, _without_tolerances(_without_quantization(noisy)))
    if _without_tolerances(scene) != scene:
        yield Variant("sensor", "tolerances, bias", _without_quantization(_with_noise(scene, 0.0)))
    full_scale = scene.converter.range or HEADROOM * largest_voltage
    scene = without_noise(scene)
    yield from _resonances(scene, highest)
    yield from _integrators(scene, lowest, peak_frequency)
    if scene.converter.filter is None:
        yield Variant("anti-alias filter", "on", _with_converter(scene, filter="delta_sigma", remove_delay=True))
    else:
        yield Variant("anti-alias filter", "off", _with_converter(scene, filter=None, remove_delay=False))
    rate = scene.converter.sample_rate
    for factor in RATE_RATIOS:
        if factor * rate >= MIN_SAMPLES_PER_PERIOD * highest:
            yield Variant("sample rate", f"{factor * rate:.6g} Hz", _with_converter(scene, rate=factor * rate))
    for bits in BITS:
        yield Variant("bits", str(bits), _with_converter(scene, bits=bits, range=full_scale))


def _with_converter(scene: Scene, **changes: Any) -> Scene:
    return scene.replace(converter=scene.converter.replace(**changes))


def _with_sensors(scene: Scene, **changes: Any) -> Scene:
    """Change settings of all accelerometers; a channel without accelerometer gets one if a setting is not None."""
    assert scene.channels is not None
    channels = [
        channel.replace(accelerometer=(channel.accelerometer or Accelerometer()).replace(**changes))
        if not channel.measures_force and (channel.accelerometer is not None or any(changes.values()))
        else channel
        for channel in scene.channels
    ]
    return scene.replace(channels=channels)


def _resonances(scene: Scene, highest: float) -> Iterator[Variant]:
    if scene.channels is None:
        return
    if any(c.accelerometer is not None and c.accelerometer.resonance is not None for c in scene.channels):
        yield Variant("sensor", "no resonance", _with_sensors(scene, resonance=None, q=None))
    for factor in RESONANCE_RATIOS:
        resonance = float(f"{factor * highest:.1g}")
        yield Variant("sensor", f"resonance {resonance:g} Hz", _with_sensors(scene, resonance=resonance))


def _with_noise(scene: Scene, factor: float) -> Scene:
    """Multiply all noise densities and the jitter of an expanded scene by a factor; 0 removes them."""

    def scaled(noise: float | None) -> float | None:
        return None if noise is None or factor == 0.0 else factor * noise

    channels = []
    for channel in scene.channels or ():
        sensor, amplifier = channel.accelerometer, channel.integrator
        if sensor is not None:
            corner = sensor.noise_corner if factor else None
            sensor = sensor.replace(noise=scaled(sensor.noise), noise_corner=corner)
        if amplifier is not None:
            amplifier = amplifier.replace(noise=scaled(amplifier.noise))
        hammer = channel.hammer
        if hammer is not None:
            hammer = hammer.replace(noise=scaled(hammer.noise))
        channels.append(channel.replace(accelerometer=sensor, integrator=amplifier, hammer=hammer))
    converter = scene.converter
    scene = _with_converter(scene, noise=scaled(converter.noise), jitter=scaled(converter.jitter))
    return scene if scene.channels is None else scene.replace(channels=channels)


def _integrators(scene: Scene, lowest: float, peak_frequency: float) -> Iterator[Variant]:
    """Yield variants without integrators (the analysis integrates numerically), or with a different order."""
    if scene.channels is None:
        return
    omega = 2.0 * np.pi * peak_frequency
    for order, name in enumerate(INTEGRATOR_OUTPUTS):
        channels = []
        for channel in scene.channels:
            integrator = channel.integrator
            if order == 0 or channel.measures_force:
                changed = None
            elif integrator is None:
                changed = Integrator(order=order, corner=CORNER_RATIO * lowest, gain=omega**order)
            else:
                changed = integrator.replace(order=order, gain=integrator.gain * omega ** (order - integrator.order))
            channels.append(channel.replace(integrator=changed))
        if tuple(channels) != scene.channels:
            yield Variant("integrator", name, scene.replace(channels=channels))
