"""The bench of a scene: one plant, and its channels sampled at one or several rates."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Sequence
from fractions import Fraction
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from daq.signal_chain.outputs import Outputs
from daq.signal_chain.oversampling import DriveLine, oversampling
from daq.virtual_bench.stream import Block, Stream, samples_per_tick
from rig.arrays import Array
from rig.simulation.drive import validate_drive
from rig.simulation.plant import Plant

if TYPE_CHECKING:
    from daq.signal_chain.channel import ChannelInfo
    from rig.scene.measurement_chain import Channel
    from rig.scene.scene import Scene
    from rig.simulation.motion import Motion


# The filters of a rate that begins while the rig moves settle on this much of the past motion, s.
_SETTLING = 2.0
# Upper bound of the past motion in ticks: a stiff scene has a million ticks per second.
_LONGEST_PAST = 1 << 18


class Bench:
    """Plant, measuring chain and converter of a scene, from power-on.

    `acquire` takes the drive at the converter's rate and returns samples at that rate. `advance` takes it tick by
    tick and samples at several rates. The samples depend neither on the division of the drive into calls nor on
    other rates.

    >>> import rig
    >>> bench = Bench(rig.load("bare-structure"))
    >>> bench.inputs, bench.drive_units, [channel.at for channel in bench.channels]
    (('shaker',), ('m',), ['body 1', 'body 2', 'body 3', 'table'])
    >>> bench.acquire(np.zeros((1, 100))).samples.shape
    (4, 100)
    """

    def __init__(self, scene: Scene, ticks: int | None = None) -> None:
        self.scene = scene
        self.ticks = oversampling(scene) if ticks is None else ticks
        # Samples and ticks per second by the nominal clock; the bench runs at the true rate.
        self.rate = scene.converter.sample_rate
        self.tick_rate = self.rate * self.ticks
        self._plant = plant = Plant(scene, scene.converter.true_rate * self.ticks)
        self._own = Stream(scene, self.rate, Fraction(1, self.ticks), plant)
        self._streams = {self.rate: self._own}
        self._outputs = Outputs(scene, plant.inputs, plant.drive_units)
        self._line = DriveLine(len(plant.inputs), self.ticks)
        # Motion and drive of the latest ticks of `advance`.
        self._past: deque[tuple[Motion, Array]] = deque()
        self.latency = self._own.latency
        self.inputs: tuple[str, ...] = tuple(plant.inputs)
        self.drive_units: tuple[str, ...] = tuple(plant.drive_units)
        self.points: tuple[str, ...] = tuple(plant.points)
        self.drive = np.zeros((len(self.inputs), 0))

    @property
    def channels(self) -> tuple[ChannelInfo, ...]:
        """The channels at `rate`, in the order of the rows of `Block.samples`."""
        return self._own.channels

    @property
    def lost(self) -> tuple[tuple[int, int], ...]:
        """First and last sample of every stretch that is lost between converter and recording, at `rate`."""
        return self._own.lost

    def lost_at(self, rate: float) -> tuple[tuple[int, int], ...]:
        """Return the same for another rate of the latest `advance`."""
        return self._streams[rate].lost

    @property
    def wiring(self) -> tuple[Channel, ...]:
        """The channels of the scene with their present couplings and supplies, see `rewire`."""
        return self._own.wiring

    def rewire(self, wiring: Sequence[Channel]) -> None:
        """Set couplings and supplies of the channels; see `daq.signal_chain.chain.Chain.rewire`."""
        if tuple(wiring) != self.wiring:
            for stream in self._streams.values():
                stream.rewire(wiring)

    def acquire(self, drive: Array) -> Block:
        """Drive the rig, (inputs, samples) in `drive_units`, and return the samples at `rate`; lines join the drive."""
        drive = validate_drive(drive, self.inputs)
        line = self._line.through(self._outputs.put_out(drive))
        return self._own.take(self._plant.advance(line), line)

    def advance(self, drive: Array, rates: Collection[float] = ()) -> dict[float, Block]:
        """Drive the rig, (inputs, ticks), and return the samples at `rate` and at each of `rates`.

        Lines join the drive. A rate that was not among those of the last call begins with filters that have settled
        on the past motion.
        """
        rates = {self.rate, *rates}
        self._streams = {rate: self._streams.get(rate) or self._begin(rate) for rate in sorted(rates)}
        drive = self._outputs.put_out(drive)
        motion = self._plant.advance(drive)
        self._past.append((motion, drive))
        self.drive = drive[:, -motion.first % self.ticks :: self.ticks]
        while motion.first - self._past[0][0].first > min(_SETTLING * self.tick_rate, _LONGEST_PAST):
            self._past.popleft()
        return {rate: stream.take(motion, drive) for rate, stream in self._streams.items()}

    def _begin(self, rate: float) -> Stream:
        per_tick = samples_per_tick(rate, self.tick_rate)
        return Stream(self.scene, rate, per_tick, self._plant, self._past, self.wiring)

    def physical(self, samples: Array | NDArray[np.int32]) -> Array:
        """Convert samples to each channel's unit by its data sheet; shape (channels, samples)."""
        return self._own.physical(samples)
