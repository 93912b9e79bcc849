"""The signal chain of a scene: computes the samples in volts from motion and forces, block by block."""

from collections.abc import Sequence
from itertools import compress

import numpy as np

from daq.core.dsp.block_buffers import SharedScratch
from daq.core.dsp.interpolation import ForceInterpolator, MotionInterpolator, SpringForceInterpolator
from daq.core.dsp.noise import generator
from daq.core.dsp.skew import delays
from daq.core.signal_chain.channel import ChannelInfo
from daq.core.signal_chain.decimation_filter import DELAY_SAMPLES
from daq.core.signal_chain.devices import channel_stages
from daq.core.signal_chain.signal_path import SignalPath
from daq.core.signal_chain.stage import channel_effects, channel_info
from rig.core.base.arrays import Array
from rig.core.base.errors import SceneError
from rig.core.scene.measurement_chain import Channel
from rig.core.scene.presets import complete_from_preset, input_settings
from rig.core.scene.scene import Scene
from rig.core.scene.shaker import DRIVE_PER_VOLT, at_shaker
from rig.core.simulation.motion import Motion


class Chain:
    """All channels of a scene, from motion to samples in volts.

    The samples do not depend on the division of the motion into blocks.

    `rate` is the rate of the motion [Hz], a multiple of the converter's true rate (its sample rate with the clock
    error). `points` are the points whose motion is given, such as "body 1"; `inputs` are the inputs of the rig whose
    forces or drives are given.

    The acceleration of a point is piecewise cubic between samples and impacts (`daq.core.dsp.interpolation`). Each
    impact is an impulse of acceleration at its instant. The response of the analog stages to this input is exact,
    including their limits (`daq.core.dsp.propagation`). If the scene has a decimation filter, the samples are its
    output. Without a filter, the output of an integrator is read at the instant of the sample. A signal without
    integration may contain impulses, so it is averaged over the interval that ends at the sample. All stages are at
    rest before sample 0. The random numbers of a channel depend only on the seed and the name of the channel.

    >>> import rig
    >>> scene = rig.loads("structure: {masses: [1 kg], springs: [1 kN/m]}")
    >>> chain = Chain(scene, 5120.0, points=["body 1"])
    >>> chain.channels[0].name, chain.channels[0].quantity, chain.effects
    ('body1', 'acceleration', {'body1': {'averaging': 1}})
    """

    def __init__(self, scene: Scene, rate: float, points: Sequence[str], inputs: Sequence[str] = ()) -> None:
        self._scene, true_rate = scene, scene.converter.true_rate
        converter = complete_from_preset(scene.converter)
        self._oversampling = round(rate / true_rate)
        if self._oversampling < 1 or abs(rate - self._oversampling * true_rate) > 1e-9 * rate:
            raise SceneError(
                f"rate: got {rate!r} Hz; expected {true_rate!r} Hz (sample rate with clock error) or a multiple."
            )
        channels = default_channels(scene, points) if scene.channels is None else scene.channels
        self._delays = delays(converter.skew, len(channels), true_rate)
        self._inputs, self._sources = tuple(inputs), [_source(channel, scene) for channel in channels]
        # Channels measure motion, or a force or drive.
        is_motion = [not (channel.measures_force or channel.measures_voltage) for channel in channels]
        motion_rows = [_point_row(channel, points) for channel in compress(channels, is_motion)]
        self._motion_interpolator = MotionInterpolator(motion_rows, rate)
        self._force_interpolators = [None if motion else ForceInterpolator() for motion in is_motion]
        self._spring_forces = [_spring_force(channel, scene, points, rate) for channel in channels]
        self._buffers = SharedScratch()
        self._jitter = generator(scene.seed, "", "jitter") if converter.jitter else None
        # If the delay of the filter is removed, this number of initial samples is omitted.
        self.latency = DELAY_SAMPLES if converter.filter is not None and converter.remove_delay else 0
        parts = [self._build_channel(row, channel) for row, channel in enumerate(channels)]
        self.channel_settings: tuple[Channel, ...] = tuple(channels)
        self.overload = np.zeros((len(channels), 0), dtype=bool)  # flags of the latest block
        self._paths = [path for path, _, _ in parts]
        self.channels: tuple[ChannelInfo, ...] = tuple(info for _, info, _ in parts)
        self.effects = {info.name: effects for _, info, effects in parts}

    def _build_channel(self, row: int, channel: Channel) -> tuple[SignalPath, ChannelInfo, dict[str, int]]:
        """Return the signal path of a channel in its initial state, its description, and its simulated effects."""
        scene, delay = self._scene, self._delays[row]
        settings, converter = input_settings(scene.converter, channel), complete_from_preset(scene.converter)
        stages = channel_stages(channel, settings, scene.seed)
        path = SignalPath(channel.name, stages, converter, self._oversampling, delay, scene.seed, self._buffers)
        info = channel_info(channel.name, channel.at, stages, settings, converter.sample_rate, delay)
        effects = channel_effects(stages, converter, delay)
        if "1/f noise" in effects:
            effects["1/f noise"] = path.noise_states
        return path, info, effects

    def set_conditioning(self, channel_settings: Sequence[Channel]) -> None:
        """Change couplings and sensor supplies; a changed channel restarts from rest, as at power-on.

        `channel_settings` are the new settings of all channels, in their order.
        """
        infos = list(self.channels)
        for row, (previous, channel) in enumerate(zip(self.channel_settings, channel_settings, strict=True)):
            if channel != previous:
                self._paths[row], infos[row], self.effects[channel.name] = self._build_channel(row, channel)
        self.channel_settings, self.channels = tuple(channel_settings), tuple(infos)

    def measure(self, motion: Motion, forces: Array | None = None) -> Array:
        """Return the voltages of the next block [V], shape (channels, samples); see also `overload`.

        `forces` are the forces or drives of the inputs at the motion samples, shape (inputs, motion samples); they are
        interpolated linearly.
        """
        count = motion.displacement.shape[1]
        # Samples of the converter in this block: sample n is at motion sample n times the oversampling.
        first, stop = (-(-k // self._oversampling) for k in (motion.first, motion.first + count))
        jitter = None if self._jitter is None else self._jitter.standard_normal(stop - first)
        volts = np.empty((len(self._paths), stop - first))
        overload = np.zeros(volts.shape, dtype=bool)
        motion_cubics = iter(self._motion_interpolator.interpolate(motion))
        for row, (interpolator, path) in enumerate(zip(self._force_interpolators, self._paths, strict=True)):
            spring_force = self._spring_forces[row]
            if interpolator is None:
                cubics = next(motion_cubics)
            elif spring_force is not None:
                cubics = spring_force.interpolate(motion)
            else:
                # An omitted input is zero, such as the force of an unused hammer.
                name, factor = self._sources[row]
                signal = np.zeros(count)
                if forces is not None and name in self._inputs:
                    signal = np.ascontiguousarray(factor * forces[self._inputs.index(name)], dtype=float)
                cubics = interpolator.interpolate(signal)
            volts[row], flags = path.measure(cubics, jitter)
            if flags is not None:
                overload[row] = flags
        self.overload = overload[:, max(self.latency - first, 0) :]
        return volts[:, max(self.latency - first, 0) :]


def default_channels(scene: Scene, points: Sequence[str]) -> tuple[Channel, ...]:
    """Return ideal channels for a scene without `channels`: accelerations of all points, and forces of its inputs."""
    channels = [Channel(name=point.replace(" ", ""), at=point) for point in points]
    if scene.hammer is not None:
        channels.append(Channel(name="force", at="hammer"))
        return tuple(channels)
    for number, shaker in enumerate(scene.shakers, 1):
        if shaker.drive_is_force:
            name, location = (at_shaker(word, number, len(scene.shakers)) for word in ("force", "shaker"))
            channels.append(Channel(name=name.replace(" ", ""), at=location))
    return tuple(channels)


def _source(channel: Channel, scene: Scene) -> tuple[str, float]:
    """Return the input that a force or drive channel measures, and the measured quantity per unit of the input."""
    if not channel.measures_voltage:
        return channel.at, 1.0
    number = channel.number or 1
    drive_unit = scene.shakers[number - 1].drive_unit
    return at_shaker("shaker", number, len(scene.shakers)), 1.0 / DRIVE_PER_VOLT[drive_unit]


def _spring_force(channel: Channel, scene: Scene, points: Sequence[str], rate: float) -> SpringForceInterpolator | None:
    """Return the interpolator of a force that follows from the motion; None for other channels."""
    terms = scene.force_terms(channel.at) if channel.place_kind == "shaker" else {}
    if not terms or channel.at in terms:
        return None
    weights = np.array([terms.get(point, 0.0) for point in points])
    return SpringForceInterpolator(weights, rate)


def _point_row(channel: Channel, points: Sequence[str]) -> int:
    """Return the row of the motion that a channel measures."""
    if channel.at not in points:
        raise SceneError(f"channel {channel.name!r}: the rig has no {channel.at}. Choose {', '.join(points)}.")
    return list(points).index(channel.at)
