"""All channels of a bench, sampled at one rate: a measuring chain and converter of their own on the common motion."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from daq.instrument.bench.motion_rate import MotionAtRate
from daq.signal_chain.bench import AcquiredBlock
from daq.signal_chain.chain import Chain
from daq.signal_chain.channel import ChannelInfo
from daq.signal_chain.converter import Quantiser, SampleClock
from daq.signal_chain.oversampling import oversampling
from rig.errors import SceneError
from rig.scene.measurement_chain import Channel
from rig.scene.scene import Scene
from rig.simulation.motion import Motion
from rig.simulation.plant import Plant

Array = NDArray[np.float64]


class InputStream:
    """Samples of all channels at one rate.

    Sample number n is taken n / `rate` seconds after power-on of the bench, whenever the stream was begun. What it
    holds does not depend on how ticks come in blocks, nor on other streams.

    Parameters
    ----------
    scene : Scene
        What is on the bench.
    rate : float
        Samples per second.
    per_tick : Fraction
        Samples per tick of the plant.
    plant : Plant
        What moves.
    past : iterable of (Motion, ndarray)
        The latest motion and forces; filters have settled on them when the stream begins.
    wiring : sequence of Channel or None
        How the channels are set, see `Chain.rewire`; None: as in the scene.

    Attributes
    ----------
    channels : tuple of ChannelInfo
        The channels.
    lost : tuple of tuple of int
        First and last sample of every stretch that is lost on the way from the converter.
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
        self._intervals = _intervals(self._scene, per_tick)
        clock = SampleClock.of(self._scene.converter)
        self._chain = Chain(self._scene, clock.true_rate * self._intervals, plant.points, plant.inputs)
        past = list(past)
        begin = past[0][0].first if past else 0
        self._first = -(-begin * per_tick.numerator // per_tick.denominator)
        self._motion = MotionAtRate(
            per_tick * self._intervals, self._intervals, 1.0 / plant.rate, self._first * self._intervals
        )
        self._interval = 1.0 / (clock.true_rate * self._intervals)
        self.rewire(self._chain.wiring if wiring is None else wiring)
        for motion, forces in past:
            self.take(motion, forces)

    @property
    def wiring(self) -> tuple[Channel, ...]:
        """The channels of the scene as they are set now."""
        return self._chain.wiring

    def rewire(self, wiring: Sequence[Channel]) -> None:
        """Set couplings and supplies of the channels anew; see `daq.signal_chain.chain.Chain.rewire`."""
        self._chain.rewire(wiring)
        self._converter = Quantiser(self._scene.converter, self._chain.channels)
        self.channels: tuple[ChannelInfo, ...] = self._converter.channels
        self.lost = self._converter.lost
        self._scale = np.array([[channel.unit_per_count] for channel in self.channels])

    def take(self, motion: Motion, forces: Array) -> AcquiredBlock:
        """Sample what the next ticks reach."""
        motion, forces = self._motion.take(motion, forces)
        block = self._converter.convert(self._chain.measure(motion, forces))
        motion = motion.every(self._intervals, self._interval)
        first = self._first + max(motion.first - self._chain.latency, 0)
        return AcquiredBlock(first, block.samples, block.overload | self._chain.overload, motion)

    def physical(self, samples: NDArray[np.float64] | NDArray[np.int32]) -> Array:
        """Read samples in each channel's unit, as its data sheet says; shape (channels, samples)."""
        return samples * self._scale


def at_rate(scene: Scene, rate: float) -> Scene:
    """Give a scene with another sample rate; without its test if that rate does not resolve its tones."""
    if rate == scene.converter.sample_rate:
        return scene
    converter = scene.converter.replace(rate=rate)
    try:
        return scene.replace(converter=converter)
    except SceneError:
        return scene.replace(converter=converter, test=None)


def _intervals(scene: Scene, per_tick: Fraction) -> int:
    """Choose the intervals per sample, of whole ticks where there are such: see `oversampling`."""
    needed = oversampling(scene, SampleClock.of(scene.converter))
    ticks = 1 / per_tick
    if ticks.denominator > 1:
        return needed
    return next((each for each in range(needed, int(ticks) + 1) if int(ticks) % each == 0), needed)
