"""The linear response of a scene in its channels, with all dampers on their floors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from daq.signal_chain.channel import ChannelInfo
from rig.arrays import Array, ComplexArray
from rig.scene.excitation import Impulse, Multisine, Random, Sine, SteppedSine, SweptSine, Test, spaced
from rig.scene.scene import Scene
from rig.system.assembly import assemble
from rig.system.hybrid_system import HybridSystem
from rig.system.open_loop_drive import drive_per_level, riding_response

# Frequencies of a band at which the required drive is computed.
_POINTS = 400


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
    return np.array(spaced(*band, points, "log"))


def states_per_level(
    scene: Scene, system: HybridSystem, frequencies: Array
) -> tuple[ComplexArray, ComplexArray]:
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
        size: Array
        if info.at in system.points:
            order = info.derivative or 0
            size = abs(states[system.points.index(info.at)]) * (2.0 * np.pi * frequencies) ** order
        elif isinstance(scene.test, Impulse):
            continue
        else:
            size = np.abs(gain)
        readings[row] = size * abs(info.response(frequencies))
    return readings


def drive_needed(scene: Scene, system: HybridSystem) -> tuple[float, float] | None:
    """Largest drive for one unit of the test's level, and its frequency; None for tests other than tones and sweeps."""
    frequencies = test_frequencies(scene.test, _POINTS)
    if not frequencies.size or not isinstance(scene.test, Sine | SteppedSine | SweptSine):
        return None
    gain = abs(states_per_level(scene, system, frequencies)[1])
    place = int(np.argmax(gain))
    return float(gain[place]), float(frequencies[place])
