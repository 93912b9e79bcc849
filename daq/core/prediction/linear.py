"""Linear response of a scene at its channels, with all dampers on their floors, and the signal-to-noise ratio."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from daq.core.excitation import procedure_of
from daq.core.signal_chain.channel import ChannelInfo
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import SceneError
from rig.core.scene.excitation import Test
from rig.core.scene.measurement_chain import Channel
from rig.core.scene.presets import complete_from_preset
from rig.core.scene.scene import Scene
from rig.core.scene.shaker import DRIVE_PER_VOLT
from rig.core.system.assembly import assemble, force_row
from rig.core.system.hybrid_system import HybridSystem
from rig.core.system.open_loop_drive import drive_per_level, riding_response

# Number of frequencies over the band of a test without tones: 1.7 per half-power width (0.5 % damping) in a decade.
_N_FREQUENCIES = 400


def test_frequencies(test: Test | None) -> Array:
    """Return the tones of a test, or frequencies over its band, ascending [Hz]; empty without a band."""
    return np.array(() if test is None else test.tones(_N_FREQUENCIES))


def states_per_level(scene: Scene, system: HybridSystem, frequencies: Array) -> tuple[ComplexArray, ComplexArray]:
    """Return complex amplitudes of states (states, frequencies) and drive (frequencies,) per unit of the test's level.

    The level is the force in N, or the drive in the shaker's unit; `frequencies` are in Hz.
    """
    omega = 2.0 * np.pi * frequencies
    drive_gain = np.broadcast_to(drive_per_level(scene, system, omega), omega.shape).astype(np.complex128)
    return riding_response(system, scene.at_driven("shaker"), omega) * drive_gain, drive_gain


def channel_readings(scene: Scene, channels: Sequence[ChannelInfo], frequencies: Array) -> Array:
    """Return the amplitude of each channel per unit of the test's level, (channels, frequencies), in its unit."""
    system = assemble(scene)
    states, drive_gain = states_per_level(scene, system, frequencies)
    readings = np.zeros((len(channels), frequencies.size))
    driven_input = scene.at_driven("shaker")
    drive_unit = system.drive_units[system.inputs.index(driven_input)]
    for row, info in enumerate(channels):
        amplitude: Array
        if info.at in system.points:
            derivative_order = info.derivative or 0
            amplitude = abs(states[system.points.index(info.at)]) * (2.0 * np.pi * frequencies) ** derivative_order
        elif scene.hammer is not None or info.at not in (driven_input, scene.at_driven("drive")):
            continue
        else:
            # The channel measures the force on the structure, or the voltage of the output that drives the shaker.
            spring_force = np.asarray(force_row(scene, system) @ states)
            drive_per_unit = DRIVE_PER_VOLT[drive_unit] if info.quantity == "voltage" else 1.0
            is_spring_force = info.quantity == "force" and spring_force.any()
            amplitude = np.abs(spring_force if is_spring_force else drive_gain / drive_per_unit)
        readings[row] = amplitude * abs(info.response(frequencies))
    return readings


def required_drive(scene: Scene, system: HybridSystem) -> tuple[float, float] | None:
    """Return the largest drive per unit of the test's level and its frequency; None for tests without tone or sweep."""
    frequencies = test_frequencies(scene.test)
    if not frequencies.size or scene.test is None or not scene.test.single_tone:
        return None
    drive_gain = abs(states_per_level(scene, system, frequencies)[1])
    index = int(np.argmax(drive_gain))
    return float(drive_gain[index]), float(frequencies[index])


@dataclass(frozen=True)
class LowestSignalToNoise:
    """Smallest ratio of a channel's amplitude to the standard deviation of its noise in a measurement."""

    ratio: float  # ratio of amplitudes, not in dB
    frequency: float  # Hz

    @property
    def decibels(self) -> float:
        """The ratio in dB."""
        return float(20.0 * np.log10(max(self.ratio, 1e-30)))

    def __str__(self) -> str:
        return f"{self.decibels:.0f} dB at {self.frequency:.4g} Hz"


def lowest_signal_to_noise(scene: Scene, channels: tuple[ChannelInfo, ...]) -> dict[str, LowestSignalToNoise]:
    """Return the lowest signal-to-noise ratio of each channel with noise, by name, from the linear response.

    The noise of a measured tone or spectral line has the standard deviation d sqrt(2 / T), for a noise density d per
    sqrt(Hz) and a lock-in measurement over the time T. The ratio is not defined for impacts and free decays.
    """
    test, frequencies = scene.test, test_frequencies(scene.test)
    settings = {channel.name: channel for channel in scene.channels or ()}
    if test is None or not frequencies.size or scene.driven is None:
        return {}
    snr_gain = procedure_of(test).snr_gain(test, frequencies)
    if snr_gain is None:
        return {}
    try:
        amplitudes = channel_readings(scene, channels, frequencies)
    except SceneError:
        return {}
    lowest = {}
    for info, amplitude in zip(channels, amplitudes, strict=True):
        density = noise_density(scene, settings.get(info.name), info, frequencies)
        if density.any() and amplitude.any():
            ratio = amplitude * min(test.levels) * snr_gain / np.maximum(density, np.finfo(float).tiny)
            index = int(np.argmin(ratio))
            lowest[info.name] = LowestSignalToNoise(float(ratio[index]), float(frequencies[index]))
    return lowest


def noise_density(scene: Scene, channel: Channel | None, info: ChannelInfo, frequencies: Array) -> Array:
    """Return the one-sided noise density of a channel, in its unit per sqrt(Hz), shape (frequencies,)."""
    converter, noise_power = complete_from_preset(scene.converter), np.zeros(frequencies.size)
    voltage_noise_power = (converter.noise or 0.0) ** 2
    if info.volts_per_count is not None:
        # Quantization: variance count^2 / 12 over half the sample rate.
        voltage_noise_power += info.volts_per_count**2 / (6.0 * info.rate)
    if channel is not None and channel.integrator is not None:
        voltage_noise_power += (channel.integrator.noise or 0.0) ** 2
    sensor = None if channel is None else channel.accelerometer
    if sensor is not None:
        data_sheet = complete_from_preset(sensor)
        integration_factor = (2.0 * np.pi * frequencies) ** (2 - (info.derivative or 0))
        flicker = 1.0 + (data_sheet.noise_corner or 0.0) / frequencies
        noise_power += ((data_sheet.noise or 0.0) * abs(info.response(frequencies)) / integration_factor) ** 2 * flicker
    elif channel is not None and channel.hammer is not None:
        noise_power += (complete_from_preset(channel.hammer).noise or 0.0) ** 2
    return np.asarray(np.sqrt(noise_power + voltage_noise_power / info.sensitivity**2))
