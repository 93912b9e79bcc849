"""The linear response of a scene in its channels, with all dampers on their floors, and its signal-to-noise ratio."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from daq.signal_chain.channel import ChannelInfo
from rig.arrays import Array, ComplexArray
from rig.errors import SceneError
from rig.scene.excitation import Impulse, Multisine, Random, Sine, SteppedSine, SweptSine, Test, spaced_frequencies
from rig.scene.measurement_chain import Channel
from rig.scene.presets import complete_from_preset
from rig.scene.scene import Scene
from rig.system.assembly import assemble
from rig.system.hybrid_system import HybridSystem
from rig.system.open_loop_drive import drive_per_level, level_of, riding_response

# Frequencies of a band at which the required drive and the signal-to-noise ratio are computed.
_N_FREQUENCIES = 400


def test_band(test: Test | None) -> tuple[float, float] | None:
    """Band of a test that drives a shaker, Hz; None of others."""
    if isinstance(test, Sine):
        return test.frequency, test.frequency
    if isinstance(test, SteppedSine):
        return min(test.order), max(test.order)
    if isinstance(test, SweptSine | Random | Multisine):
        return min(test.from_, test.to), max(test.from_, test.to)
    return None


def test_frequencies(test: Test | None, points: int) -> Array:
    """Frequencies of a test, rising, Hz: its tones, or `points` frequencies over its band; none without a band."""
    if isinstance(test, Sine):
        return np.array([test.frequency])
    if isinstance(test, SteppedSine):
        return np.unique(test.order)
    band = test_band(test)
    if band is None:
        return np.zeros(0)
    return np.array(spaced_frequencies(*band, points, "log"))


def states_per_level(scene: Scene, system: HybridSystem, frequencies: Array) -> tuple[ComplexArray, ComplexArray]:
    """Return states (states, frequencies) and drive (frequencies,) for one unit of the test's level."""
    omega = 2.0 * np.pi * frequencies
    gain = np.broadcast_to(drive_per_level(scene, system, omega), omega.shape).astype(np.complex128)
    return riding_response(system, scene.at_driven("shaker"), omega) * gain, gain


def channel_readings(scene: Scene, channels: Sequence[ChannelInfo], frequencies: Array) -> Array:
    """Amplitude of each channel for a tone of one unit of level, (channels, frequencies), in its unit."""
    system = assemble(scene)
    states, gain = states_per_level(scene, system, frequencies)
    readings = np.zeros((len(channels), frequencies.size))
    for row, info in enumerate(channels):
        amplitude: Array
        if info.at in system.points:
            order = info.derivative or 0
            amplitude = abs(states[system.points.index(info.at)]) * (2.0 * np.pi * frequencies) ** order
        elif isinstance(scene.test, Impulse):
            continue
        else:
            amplitude = np.abs(gain)
        readings[row] = amplitude * abs(info.response(frequencies))
    return readings


def required_drive(scene: Scene, system: HybridSystem) -> tuple[float, float] | None:
    """Largest drive for one unit of the test's level, and its frequency; None for tests other than tones and sweeps."""
    frequencies = test_frequencies(scene.test, _N_FREQUENCIES)
    if not frequencies.size or not isinstance(scene.test, Sine | SteppedSine | SweptSine):
        return None
    gain = abs(states_per_level(scene, system, frequencies)[1])
    index = int(np.argmax(gain))
    return float(gain[index]), float(frequencies[index])


@dataclass(frozen=True)
class LowestSignalToNoise:
    """Smallest ratio of a channel's amplitude to the standard deviation of its noise in a measurement."""

    ratio: float
    frequency: float  # Hz

    def __str__(self) -> str:
        return f"{20.0 * np.log10(max(self.ratio, 1e-30)):.0f} dB at {self.frequency:.4g} Hz"


def lowest_signal_to_noise(scene: Scene, channels: tuple[ChannelInfo, ...]) -> dict[str, LowestSignalToNoise]:
    """Compare the linear response with the noise of each channel that has any; by name.

    The noise is that of a measured tone (lock-in over its time T: sqrt(2 S / T) for a density S), or of a line of
    the spectrum. Hits and free decays have no such measurement.
    """
    frequencies = test_frequencies(scene.test, _N_FREQUENCIES)
    settings = {channel.name: channel for channel in scene.channels or ()}
    if not frequencies.size or scene.driven is None:
        return {}
    try:
        amplitudes = channel_readings(scene, channels, frequencies)
    except SceneError:
        return {}
    amplitude_to_noise = _amplitude_to_noise(scene, frequencies)
    lowest = {}
    for info, amplitude in zip(channels, amplitudes, strict=True):
        density = _noise_density(scene, settings.get(info.name), info, frequencies)
        if density.any() and amplitude.any():
            ratio = amplitude * amplitude_to_noise / np.maximum(density, np.finfo(float).tiny)
            index = int(np.argmin(ratio))
            lowest[info.name] = LowestSignalToNoise(float(ratio[index]), float(frequencies[index]))
    return lowest


def _amplitude_to_noise(scene: Scene, frequencies: Array) -> Array:
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


def _noise_density(scene: Scene, channel: Channel | None, info: ChannelInfo, frequencies: Array) -> Array:
    """Noise density of a channel, in its unit per root of hertz."""
    converter, noise_power = complete_from_preset(scene.converter), np.zeros(frequencies.size)
    voltage_noise_power = (converter.noise or 0.0) ** 2
    if info.volts_per_count is not None:
        voltage_noise_power += info.volts_per_count**2 / (6.0 * info.rate)
    if channel is not None and channel.integrator is not None:
        voltage_noise_power += (channel.integrator.noise or 0.0) ** 2
    sensor = None if channel is None else channel.accelerometer
    if sensor is not None:
        data_sheet = complete_from_preset(sensor)
        integrated = (2.0 * np.pi * frequencies) ** (2 - (info.derivative or 0))
        flicker = 1.0 + (data_sheet.noise_corner or 0.0) / frequencies
        noise_power += ((data_sheet.noise or 0.0) * abs(info.response(frequencies)) / integrated) ** 2 * flicker
    elif channel is not None and channel.hammer is not None:
        noise_power += (complete_from_preset(channel.hammer).noise or 0.0) ** 2
    return np.asarray(np.sqrt(noise_power + voltage_noise_power / info.sensitivity**2))
