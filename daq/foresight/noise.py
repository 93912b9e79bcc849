"""The smallest ratio of signal to noise of each channel in a test."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from daq.foresight.linear import channel_readings, test_frequencies
from daq.signal_chain.channel import ChannelInfo
from rig.arrays import Array
from rig.errors import SceneError
from rig.scene.excitation import Multisine, Random, Sine, SteppedSine, SweptSine
from rig.scene.measurement_chain import Channel
from rig.scene.presets import filled_in
from rig.scene.scene import Scene
from rig.system.open_loop_drive import level_of

# Frequencies of a band at which signal and noise are compared.
_POINTS = 400


@dataclass(frozen=True)
class LeastSignal:
    """Smallest ratio of a channel's amplitude to the standard deviation of its noise in a measurement."""

    ratio: float
    frequency: float  # Hz

    def __str__(self) -> str:
        return f"{20.0 * np.log10(max(self.ratio, 1e-30)):.0f} dB at {self.frequency:.4g} Hz"


def least_signals(scene: Scene, channels: tuple[ChannelInfo, ...]) -> dict[str, LeastSignal]:
    """Compare the linear response with the noise of each channel that has any; by name.

    The noise is that of a measured tone (lock-in over its time T: sqrt(2 S / T) for a density S), or of a line of
    the spectrum. Hits and free decays have no such measurement.
    """
    frequencies = test_frequencies(scene.test, _POINTS)
    settings = {channel.name: channel for channel in scene.channels or ()}
    if not frequencies.size or scene.driven is None:
        return {}
    try:
        amplitudes = channel_readings(scene, channels, frequencies)
    except SceneError:
        return {}
    scale = _measured(scene, frequencies)
    smallest = {}
    for info, amplitude in zip(channels, amplitudes, strict=True):
        density = _density(scene, settings.get(info.name), info, frequencies)
        if density.any() and amplitude.any():
            ratio = amplitude * scale / np.maximum(density, np.finfo(float).tiny)
            place = int(np.argmin(ratio))
            smallest[info.name] = LeastSignal(float(ratio[place]), float(frequencies[place]))
    return smallest


def _measured(scene: Scene, frequencies: Array) -> Array:
    """Ratio of signal to noise in one measurement, for one unit of amplitude per level and of noise density."""
    test = scene.test
    level = min(test.levels) if isinstance(test, SteppedSine) else level_of(scene)
    if isinstance(test, Random):
        return np.full(frequencies.size, level / np.sqrt(test.to - test.from_))
    if isinstance(test, Multisine):
        period, band = test.period_s, test.to - test.from_
        amplitude = level * np.sqrt(2.0 / max(1.0, band * period))
        return np.full(frequencies.size, amplitude * np.sqrt(period * test.periods / 2.0))
    if isinstance(test, Sine):
        return np.full(frequencies.size, level * np.sqrt(test.duration / 2.0))
    if isinstance(test, SteppedSine):
        return np.asarray(level * np.sqrt(test.measure.periods / frequencies / 2.0))
    assert isinstance(test, SweptSine)
    # A sweep stays within the band that a measurement resolves for the inverse root of its rate.
    rate = np.full(frequencies.size, abs(test.to - test.from_) / test.duration)
    if test.spacing == "log":
        rate = frequencies * abs(np.log(test.to / test.from_)) / test.duration
    return np.asarray(level * np.sqrt(1.0 / np.sqrt(rate) / 2.0))


def _density(scene: Scene, channel: Channel | None, info: ChannelInfo, frequencies: Array) -> Array:
    """Noise density of a channel, in its unit per root of hertz."""
    converter, power = filled_in(scene.converter), np.zeros(frequencies.size)
    in_volts = (converter.noise or 0.0) ** 2
    if info.volts_per_count is not None:
        in_volts += info.volts_per_count**2 / (6.0 * info.rate)
    if channel is not None and channel.integrator is not None:
        in_volts += (channel.integrator.noise or 0.0) ** 2
    sensor = None if channel is None else channel.accelerometer
    if sensor is not None:
        sheet = filled_in(sensor)
        integrated = (2.0 * np.pi * frequencies) ** (2 - (info.derivative or 0))
        flicker = 1.0 + (sheet.noise_corner or 0.0) / frequencies
        power += ((sheet.noise or 0.0) * abs(info.response(frequencies)) / integrated) ** 2 * flicker
    elif channel is not None and channel.hammer is not None:
        power += (filled_in(channel.hammer).noise or 0.0) ** 2
    return np.asarray(np.sqrt(power + in_volts / info.sensitivity**2))
