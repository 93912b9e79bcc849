"""All channels of a bench sampled at one rate: a measuring chain and a converter on the motion of the plant."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from daq.signal_chain.chain import Chain
from daq.signal_chain.converter import Quantiser
from daq.signal_chain.oversampling import oversampling
from daq.virtual_bench.motion_rate import MotionAtRate
from rig.arrays import Array
from rig.errors import SceneError

if TYPE_CHECKING:
    from rig.scene.measurement_chain import Channel
    from rig.scene.scene import Scene
    from rig.simulation.motion import Motion
    from rig.simulation.plant import Plant


@dataclass(frozen=True)
class Block:
    """Samples of all channels, in volts or counts, and the true motion at them, which tests and control do not use."""

    first: int  # number of the first sample, from power-on
    samples: Array | NDArray[np.int32]  # (channels, samples): volts or counts
    overload: NDArray[np.bool_]  # samples beyond the range of a channel or a limit of its devices
    motion: Motion


class Stream:
    """Samples of all channels at one rate: sample n is taken n / rate seconds after power-on of the bench.

    The samples depend neither on the division into blocks nor on other streams. The filters settle on the `past`
    motion and drive before the stream begins.
    """

    def __init__(
        self,
        scene: Scene,
        rate: float,
        per_tick: Fraction,
        plant: Plant,
        past: Iterable[tuple[Motion, Array]] = (),
        wiring: Sequence[Channel] | None = None,
    ) -> None:
        self._scene = at_rate(scene, rate)
        needed = oversampling(self._scene)
        if any(channel.measures_force or channel.measures_voltage for channel in scene.channels or ()):
            # The drive is a straight line from tick to tick: longer intervals would lose what lies between.
            needed = max(needed, math.ceil(1 / per_tick))
        self._intervals = _intervals(needed, per_tick)
        motion_rate = self._scene.converter.true_rate * self._intervals
        self._chain = Chain(self._scene, motion_rate, plant.points, plant.inputs)
        self._interval = 1.0 / motion_rate
        past = list(past)
        begin = past[0][0].first if past else 0
        self._first = first_sample(per_tick, begin)
        self._motion = MotionAtRate(
            per_tick * self._intervals, self._intervals, 1.0 / plant.rate, self._first * self._intervals
        )
        self._converter = Quantiser(self._scene.converter)
        self.lost, self.latency = self._converter.lost, self._chain.latency
        self.rewire(self._chain.wiring if wiring is None else wiring)
        for motion, drive in past:
            self.take(motion, drive)

    @property
    def wiring(self) -> tuple[Channel, ...]:
        """The channels of the scene with their present couplings and supplies."""
        return self._chain.wiring

    def rewire(self, wiring: Sequence[Channel]) -> None:
        """Set couplings and supplies of the channels; see `daq.signal_chain.chain.Chain.rewire`."""
        self._chain.rewire(wiring)
        self.channels = self._chain.channels
        self._scale = np.array([[channel.unit_per_count] for channel in self.channels])

    def take(self, motion: Motion, drive: Array) -> Block:
        """Sample the motion of the next ticks, driven by `drive`, shape (inputs, ticks)."""
        motion, drive = self._motion.take(motion, drive)
        samples, overload = self._converter.convert(self._chain.measure(motion, drive))
        if self._intervals > 1:
            motion = motion.every(self._intervals, self._interval)
        first = self._first + max(motion.first - self.latency, 0)
        return Block(first, samples, overload | self._chain.overload, motion)

    def physical(self, samples: Array | NDArray[np.int32]) -> Array:
        """Convert samples to each channel's unit by its data sheet; shape (channels, samples)."""
        return samples * self._scale


def samples_per_tick(rate: float, tick_rate: float) -> Fraction:
    """Return the samples at a rate [S/s] per tick, as a ratio of whole numbers.

    >>> samples_per_tick(51200.0 / 6, 51200.0)
    Fraction(1, 6)
    """
    return Fraction(rate).limit_denominator(10_000) / Fraction(tick_rate).limit_denominator(10_000)


def first_sample(per_tick: Fraction, tick: int) -> int:
    """Return the number of the first sample at or after a tick.

    >>> first_sample(Fraction(1, 6), 13)
    3
    """
    return -(-tick * per_tick.numerator // per_tick.denominator)


def first_tick(per_tick: Fraction, sample: int) -> int:
    """Return the number of the first tick at or after a sample."""
    return first_sample(1 / per_tick, sample)


def at_rate(scene: Scene, rate: float) -> Scene:
    """Return a scene with another sample rate; without its test if that rate does not resolve the test's tones."""
    if rate == scene.converter.sample_rate:
        return scene
    converter = scene.converter.replace(rate=rate)
    try:
        return scene.replace(converter=converter)
    except SceneError:
        return scene.replace(converter=converter, test=None)


def _intervals(needed: int, per_tick: Fraction) -> int:
    """Choose the intervals per sample: at least `needed`, of whole ticks if possible."""
    ticks = 1 / per_tick
    if ticks.denominator > 1:
        return needed
    return next((each for each in range(needed, int(ticks) + 1) if int(ticks) % each == 0), needed)
