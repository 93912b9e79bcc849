"""The virtual bench of a scene: the simulated rig (plant), and its channels sampled at one or several rates.

The drive has a value at each tick (time step of the bench), or at each sample of the converter.
"""

import math
from collections import deque
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from daq.core.signal_chain.chain import Chain
from daq.core.signal_chain.channel import ChannelInfo
from daq.core.signal_chain.converter import Outputs, Quantizer
from daq.core.signal_chain.oversampling import DriveInterpolator, choose_oversampling
from daq.core.virtual_bench.motion_rate import MotionAtRate
from rig.core.base.arrays import Array
from rig.core.base.errors import SceneError
from rig.core.scene.measurement_chain import Channel
from rig.core.scene.scene import Scene
from rig.core.simulation.motion import Motion
from rig.core.simulation.plant import Plant
from rig.core.system.open_loop_drive import validate_drive

# If sampling at a further rate begins while the rig moves, the filters first process this duration of past motion [s].
_SETTLING_S = 2.0
# Upper limit of the past motion that the filters process [ticks]: the bench of a stiff scene has a million ticks per
# second.
_MAX_PAST_TICKS = 1 << 18


class Bench:
    """Simulated rig (plant), signal chain and converter of a scene, from power-on.

    `acquire` requires a drive at the sample rate of the converter and returns samples at that rate. `advance` requires
    a drive at the tick rate and returns samples at several rates. The samples do not depend on how the drive is divided
    among calls, nor on the other rates.

    >>> import rig
    >>> bench = Bench(rig.load("bare-structure"))
    >>> bench.inputs, bench.drive_units, [channel.at for channel in bench.channels]
    (('shaker',), ('m',), ['body 1', 'body 2', 'body 3', 'table'])
    >>> bench.acquire(np.zeros((1, 100))).samples.shape
    (4, 100)
    """

    def __init__(self, scene: Scene, ticks_per_sample: int | None = None) -> None:
        self.scene = scene
        self.ticks_per_sample = choose_oversampling(scene) if ticks_per_sample is None else ticks_per_sample
        # Sample and tick rate by the nominal clock [1/s]; the plant runs at the true rate of the converter.
        self.rate = scene.converter.sample_rate
        self.tick_rate = self.rate * self.ticks_per_sample
        self._plant = plant = Plant(scene, scene.converter.true_rate * self.ticks_per_sample)
        self._base_stream = Stream(scene, self.rate, Fraction(1, self.ticks_per_sample), plant)
        self._streams = {self.rate: self._base_stream}
        self._outputs = Outputs(scene, plant.inputs, plant.drive_units)
        self._drive_interpolator = DriveInterpolator(len(plant.inputs), self.ticks_per_sample)
        # Motion and drive of the last ticks of `advance`.
        self._past_motion: deque[tuple[Motion, Array]] = deque()
        self.latency = self._base_stream.latency
        self.inputs: tuple[str, ...] = tuple(plant.inputs)
        self.drive_units: tuple[str, ...] = tuple(plant.drive_units)
        # Largest drive of each input that neither its output nor its amplifier clips; infinite without a limit.
        self.drive_limit = self._outputs.limit(plant.system.drive_limit)
        self.points: tuple[str, ...] = tuple(plant.points)
        self.drive = np.zeros((len(self.inputs), 0))  # drive of the last `advance` at the converter's samples

    @property
    def channels(self) -> tuple[ChannelInfo, ...]:
        """Descriptions of the channels at `rate`, in the order of the rows of `Block.samples`."""
        return self._base_stream.channels

    @property
    def lost(self) -> tuple[tuple[int, int], ...]:
        """First and last sample, at `rate`, of each range of samples that is lost between converter and recording."""
        return self._base_stream.lost

    def lost_at(self, rate: float) -> tuple[tuple[int, int], ...]:
        """Return the lost ranges at one of the rates of the last `advance`; see `lost`."""
        return self._streams[rate].lost

    @property
    def channel_settings(self) -> tuple[Channel, ...]:
        """The channels of the scene with their present couplings and supplies, which `set_conditioning` changes."""
        return self._base_stream.channel_settings

    def set_conditioning(self, channel_settings: Sequence[Channel]) -> None:
        """Set couplings and supplies of the channels; see `daq.core.signal_chain.chain.Chain.set_conditioning`."""
        if tuple(channel_settings) != self.channel_settings:
            for stream in self._streams.values():
                stream.set_conditioning(channel_settings)

    def acquire(self, drive: Array) -> "Block":
        """Return samples at `rate` under a drive (inputs, samples) in `drive_units`, interpolated linearly."""
        drive = validate_drive(drive, self.inputs)
        plant_drive = self._drive_interpolator.interpolate(self._outputs.convert(drive))
        return self._base_stream.sample(self._plant.advance(plant_drive), plant_drive)

    def advance(self, drive: Array, rates: Collection[float] = ()) -> dict[float, "Block"]:
        """Drive the rig and return the samples at `rate` and at each of `rates`.

        The drive, shape (inputs, ticks), is interpolated linearly between ticks. If a rate was absent in the last call,
        its filters first settle on the past motion.
        """
        rates = {self.rate, *rates}
        self._streams = {rate: self._streams.get(rate) or self._make_stream(rate) for rate in sorted(rates)}
        drive = self._outputs.convert(drive)
        motion = self._plant.advance(drive)
        self._past_motion.append((motion, drive))
        self.drive = drive[:, -motion.first % self.ticks_per_sample :: self.ticks_per_sample]
        while motion.first - self._past_motion[0][0].first > min(_SETTLING_S * self.tick_rate, _MAX_PAST_TICKS):
            self._past_motion.popleft()
        return {rate: stream.sample(motion, drive) for rate, stream in self._streams.items()}

    def _make_stream(self, rate: float) -> "Stream":
        per_tick = samples_per_tick(rate, self.tick_rate)
        return Stream(self.scene, rate, per_tick, self._plant, self._past_motion, self.channel_settings)

    def to_units(self, samples: Array | NDArray[np.int32]) -> Array:
        """Convert samples (channels, samples) in volts or counts to units of the channels, by nominal sensitivities."""
        return self._base_stream.to_units(samples)


@dataclass(frozen=True)
class Block:
    """Samples of all channels, and the true motion at the sampling instants.

    Tests and controllers must not use the motion.
    """

    first: int  # index of the first sample, from power-on
    samples: Array | NDArray[np.int32]  # volts or counts, shape (channels, samples)
    overload: NDArray[np.bool_]  # whether each sample is clipped or depends on a saturated device
    motion: Motion


class Stream:
    """Samples of all channels at one rate; sample n is taken n / rate seconds after power-on of the bench.

    The samples depend neither on their division into blocks nor on other streams. `past_motion` is the motion and drive
    of the blocks before the stream begins; its filters settle on this motion.
    """

    def __init__(
        self,
        scene: Scene,
        rate: float,
        per_tick: Fraction,
        plant: Plant,
        past_motion: Iterable[tuple[Motion, Array]] = (),
        channel_settings: Sequence[Channel] | None = None,
    ) -> None:
        self._scene = at_rate(scene, rate)
        min_intervals = choose_oversampling(scene, self._scene.converter)
        if any(channel.measures_force or channel.measures_voltage for channel in scene.channels or ()):
            # Force and drive channels measure the drive; the stream then needs a rate at which each tick is resolved.
            min_intervals = max(min_intervals, math.ceil(1 / per_tick))
        self._intervals_per_sample = intervals = _choose_intervals(min_intervals, per_tick)
        motion_rate = self._scene.converter.true_rate * intervals
        self._chain = Chain(self._scene, motion_rate, plant.points, plant.inputs)
        self._interval = 1.0 / motion_rate
        past_motion = list(past_motion)
        start_tick = past_motion[0][0].first if past_motion else 0
        self._first = first_sample(per_tick, start_tick)
        self._motion_at_rate = MotionAtRate(per_tick * intervals, intervals, 1.0 / plant.rate, self._first * intervals)
        self._converter = Quantizer(self._scene.converter)
        self.lost, self.latency = self._converter.lost, self._chain.latency
        self.set_conditioning(self._chain.channel_settings if channel_settings is None else channel_settings)
        for motion, drive in past_motion:
            self.sample(motion, drive)

    @property
    def channel_settings(self) -> tuple[Channel, ...]:
        """The channels of the scene with their present couplings and supplies."""
        return self._chain.channel_settings

    def set_conditioning(self, channel_settings: Sequence[Channel]) -> None:
        """Set couplings and supplies of the channels; see `daq.core.signal_chain.chain.Chain.set_conditioning`."""
        self._chain.set_conditioning(channel_settings)
        self.channels = self._chain.channels
        self._scale = np.array([[channel.unit_per_count] for channel in self.channels])

    def sample(self, motion: Motion, drive: Array) -> Block:
        """Return the samples of the next ticks, with the drive of shape (inputs, ticks)."""
        motion, drive = self._motion_at_rate.resample(motion, drive)
        samples, overload = self._converter.convert(self._chain.measure(motion, drive))
        if self._intervals_per_sample > 1:
            motion = motion.decimated(self._intervals_per_sample, self._interval)
        first = self._first + max(motion.first - self.latency, 0)
        return Block(first, samples, overload | self._chain.overload, motion)

    def to_units(self, samples: Array | NDArray[np.int32]) -> Array:
        """Convert samples (channels, samples) in volts or counts to units of the channels, by nominal sensitivities."""
        return samples * self._scale


def samples_per_tick(rate: float, tick_rate: float) -> Fraction:
    """Return the number of samples per tick as a fraction; both rates are in 1/s.

    >>> samples_per_tick(51200.0 / 6, 51200.0)
    Fraction(1, 6)
    """
    return Fraction(rate).limit_denominator(10_000) / Fraction(tick_rate).limit_denominator(10_000)


def first_sample(per_tick: Fraction, tick: int) -> int:
    """Return the index of the first sample at or after a tick.

    >>> first_sample(Fraction(1, 6), 13)
    3
    """
    return -(-tick * per_tick.numerator // per_tick.denominator)


def first_tick(per_tick: Fraction, sample: int) -> int:
    """Return the index of the first tick at or after a sample."""
    return first_sample(1 / per_tick, sample)


def at_rate(scene: Scene, rate: float) -> Scene:
    """Return the scene with a different sample rate, without its test if the rate is too low for the test."""
    if rate == scene.converter.sample_rate:
        return scene
    converter = scene.converter.replace(rate=rate)
    try:
        return scene.replace(converter=converter)
    except SceneError:
        return scene.replace(converter=converter, test=None)


def _choose_intervals(min_intervals: int, per_tick: Fraction) -> int:
    """Return the number of intervals per sample: at least `min_intervals`, each a whole number of ticks if possible."""
    ticks_per_sample = 1 / per_tick
    if ticks_per_sample.denominator > 1:
        return min_intervals
    ticks = int(ticks_per_sample)
    return next((count for count in range(min_intervals, ticks + 1) if ticks % count == 0), min_intervals)
