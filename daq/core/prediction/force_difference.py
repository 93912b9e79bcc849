"""Prediction whether the sensors at the ends of a coil spring resolve the force of the spring.

The force k0 (x0 - x1) is a small difference of two readings if the spring is stiff: at a resonance of the structure,
both ends move by many times the extension of the spring. The relative error of the force is then the relative error of
a reading times this multiple.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from daq.core.excitation import procedure_of
from daq.core.prediction.linear import noise_density, states_per_level, test_frequencies
from daq.core.signal_chain.channel import ChannelInfo
from rig.core.base.errors import SceneError
from rig.core.results import format_number
from rig.core.scene.measurement_chain import Channel
from rig.core.scene.presets import complete_from_preset
from rig.core.scene.scene import Scene
from rig.core.system.hybrid_system import HybridSystem
from rig.core.system.structural_model import structural_model

# Largest limit of error of a resolved force, relative to it: beyond it, the 95 % interval nearly includes zero.
_MAX_ERROR_RATIO = 0.5
# Maximum number of frequencies that a warning lists; a longer list would hide the remedy.
_MAX_LISTED = 8


def unresolved_force(scene: Scene, system: HybridSystem, channels: Sequence[ChannelInfo]) -> Iterator[str]:
    """Yield a warning if the sensors do not resolve the spring force at resonances in the band of the test."""
    test, shaker, band = scene.test, scene.driven_shaker, test_frequencies(scene.test)
    if test is None or shaker is None or shaker.coil_spring is None or not band.size:
        return
    has_cell = any(info.at == scene.at_driven("shaker") for info in channels)
    is_controlled_by_ends = bool(scene.controlled_terms) and not test.controls_by_cell
    if has_cell and not is_controlled_by_ends:
        return
    weights = shaker.force_terms(scene.at_driven("shaker"), scene.at_driven("table"))
    ends = {info.at: info for info in reversed(channels) if info.at in weights and info.derivative is not None}
    riding = range(1, len(scene.dampers) + 1)
    resonances = structural_model(scene).with_damper_masses(riding).modes.omega / (2.0 * np.pi)
    resonances = resonances[(resonances >= band[0]) & (resonances <= band[-1])]
    omega = 2.0 * np.pi * resonances
    if len(ends) < len(weights) or not resonances.size:
        return
    try:
        states, _ = states_per_level(scene, system, resonances)
    except SceneError:
        return
    force, variance = np.zeros(resonances.size, dtype=complex), np.zeros(resonances.size)
    snr_gain = procedure_of(test).snr_gain(test, resonances)
    channel_settings = {channel.name: channel for channel in scene.channels or ()}
    for place, weight in weights.items():
        displacement, info = states[system.points.index(place)], ends[place]
        settings = channel_settings.get(info.name)
        force += weight * displacement
        variance += (_tolerance(settings) * weight * abs(displacement)) ** 2
        if snr_gain is not None:
            noise = noise_density(scene, settings, info, resonances) / omega ** (info.derivative or 0)
            variance += (2.0 * weight * noise / (min(test.levels) * snr_gain)) ** 2
    ratio = np.sqrt(variance) / np.maximum(abs(force), np.finfo(float).tiny)
    is_unresolved = ratio > _MAX_ERROR_RATIO
    if is_unresolved.any():
        listed = ", ".join(f"{frequency:.4g}" for frequency in resonances[is_unresolved][:_MAX_LISTED])
        every = " (every resonance of the test)" if is_unresolved.all() else ""
        softer = shaker.coil_spring * _MAX_ERROR_RATIO / ratio.max()
        # The controller of a sweep uses the motion of both ends of the spring, even if a cell measures the force.
        remedy = "Measure the force (at: shaker)"
        if is_controlled_by_ends:
            cell = "that is at the shaker" if has_cell else "at: shaker"
            remedy = f"Use a stepped sine, which is controlled by a force sensor ({cell})"
        yield (
            f"coil spring: at {listed} Hz{every}, the spring is so stiff that its force is a small difference of two "
            f"readings; tolerances and noise of the two sensors cause errors of up to {ratio.max():.2g} times the "
            f"force. {remedy}, calibrate the sensors, or choose a spring of at most {format_number(softer)} N/m."
        )


def _tolerance(channel: Channel | None) -> float:
    """Return the sensitivity tolerance of the accelerometer of a channel."""
    sensor = None if channel is None or channel.accelerometer is None else complete_from_preset(channel.accelerometer)
    return (sensor.sensitivity_tolerance or 0.0) if sensor is not None else 0.0
