"""Motions in closed form (objects of `Motion`), and signal chains that measure these motions.

A discontinuity is an instant between samples at which an impact changes the velocity abruptly.
"""

from dataclasses import dataclass, replace

import numpy as np

import rig
from daq.core.signal_chain.chain import Chain
from rig.core.simulation.motion import Motion


@dataclass(frozen=True)
class PointMotion:
    """The motion of a point."""

    tones: tuple = ()  # (amplitude of acceleration in m/s^2, frequency in Hz, phase in rad) of each
    impacts: tuple = ()  # (time in s, jump of velocity in m/s) of each
    start_velocity: float = 0.0  # m/s

    def at(self, time, before_impact=False):
        """Return displacement, velocity and acceleration (3, times), before or after an impact at that time."""
        t = np.asarray(time, dtype=float)
        x, v, a = self.start_velocity * t, np.full(t.shape, self.start_velocity), np.zeros(t.shape)
        for amplitude, frequency, phase in self.tones:
            omega = 2 * np.pi * frequency
            x = x - amplitude / omega**2 * np.cos(omega * t + phase)
            v = v + amplitude / omega * np.sin(omega * t + phase)
            a = a + amplitude * np.cos(omega * t + phase)
        for instant, jump in self.impacts:
            has_passed = t > instant if before_impact else t >= instant
            x = x + has_passed * jump * (t - instant)
            v = v + has_passed * jump
        return np.stack([x, v, a])


def motion_of(motions, rate, count, first=0):
    """Return `count` samples of the motion of several points; an impact at one point is a discontinuity for all."""
    t = np.arange(first, first + count) / rate
    times = np.array(sorted({instant for point in motions for instant, _ in point.impacts}))
    break_samples = np.ceil(times * rate - 1e-9).astype(np.int64)
    inside = (break_samples >= first) & (break_samples < first + count)
    times, break_samples = times[inside], break_samples[inside]
    x, v, a = np.moveaxis(np.array([point.at(t) for point in motions]), 1, 0)
    before, after = (np.array([point.at(times, side) for point in motions]) for side in (True, False))
    without_dampers = np.zeros((0, count))
    return Motion(
        first=first,
        displacement=x,
        velocity=v,
        acceleration=a,
        gap=without_dampers,
        contact=without_dampers.astype(np.int8),
        discontinuity_sample=break_samples,
        discontinuity_offset=times - (break_samples - 1) / rate,
        discontinuity_displacement=after[:, 0],
        discontinuity_velocity=np.stack([before[:, 1], after[:, 1]]),
        discontinuity_acceleration=np.stack([before[:, 2], after[:, 2]]),
        events=np.zeros(0),
    )


def cut(motion, first, stop):
    """Return part of a motion as a separate block."""
    discontinuities = (motion.discontinuity_sample >= first) & (motion.discontinuity_sample < stop)
    columns = slice(first - motion.first, stop - motion.first)
    return replace(
        motion,
        first=first,
        displacement=motion.displacement[:, columns],
        velocity=motion.velocity[:, columns],
        acceleration=motion.acceleration[:, columns],
        gap=motion.gap[:, columns],
        contact=motion.contact[:, columns],
        discontinuity_sample=motion.discontinuity_sample[discontinuities],
        discontinuity_offset=motion.discontinuity_offset[discontinuities],
        discontinuity_displacement=motion.discontinuity_displacement[:, discontinuities],
        discontinuity_velocity=motion.discontinuity_velocity[:, :, discontinuities],
        discontinuity_acceleration=motion.discontinuity_acceleration[:, :, discontinuities],
    )


def scene_of(*channels, converter="{rate: 5120 Hz}", bodies=1, other_settings=""):
    """Return a scene with channels c1 on body 1, c2 on body 2, ...; each is given by its further keys."""
    listed = "".join(f"\n  - {{name: c{n}, at: body {n}{keys}}}" for n, keys in enumerate(channels, 1))
    bodies = max(bodies, len(channels))
    return rig.loads(
        f"structure: {{masses: {['1 kg'] * bodies}, springs: {['1 kN/m'] * bodies}}}\n"
        f"{'channels:' + listed if channels else ''}\nconverter: {converter}\n{other_settings}"
    )


def chain_of(scene, oversampling=1):
    """Return the signal chain of a scene, and the rate of the motion that it measures, Hz."""
    rate = scene.converter.true_rate * oversampling
    return Chain(scene, rate, [f"body {n + 1}" for n in range(scene.structure.bodies)]), rate


def at_rest(bodies, rate, count, first=0):
    """Return a motion at rest."""
    return motion_of([PointMotion()] * bodies, rate, count, first)
