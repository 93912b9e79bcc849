"""The bench: plant, measuring chain and converter on one sample clock; drive samples in, samples out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from daq.signal_chain.chain import Chain
from daq.signal_chain.channel import ChannelInfo
from daq.signal_chain.converter import Quantiser, SampleClock
from daq.signal_chain.outputs import Outputs
from daq.signal_chain.oversampling import DriveLine, oversampling
from rig.errors import SceneError
from rig.simulation.plant import Plant

if TYPE_CHECKING:
    from rig.scene.measurement_chain import Channel
    from rig.scene.scene import Scene
    from rig.simulation.motion import Motion


@dataclass(frozen=True)
class AcquiredBlock:
    """What the converter gave for a block of drive samples.

    Attributes
    ----------
    first : int
        Number of the first sample, counted from the start of the bench.
    samples : ndarray, shape (channels, samples)
        Volts (float64), or counts (int32) where the scene's converter has bits; as many as drive samples went
        in, `Bench.latency` fewer at first.
    overload : ndarray of bool, shape (channels, samples)
        Where a channel was driven beyond its range, or its sensor or amplifier beyond what it can follow.
    motion : Motion
        The truth behind the samples; for recording beside them, never for tests or control.
    """

    first: int
    samples: NDArray[np.float64] | NDArray[np.int32]
    overload: NDArray[np.bool_]
    motion: Motion


class Bench:
    """Everything of a scene that is switched on before a test runs.

    Attributes
    ----------
    rate : float
        Samples per second as the clock states it, of drive and channels alike.
    inputs : tuple of str
        Drive inputs, a subset of ``("shaker", "hammer")``; where there are several shakers, ``"shaker 1"``, ...
    drive_units : tuple of str
        Unit of each input: N, m or V.
    points : tuple of str
        Points of the rig, in the order of the rows of `AcquiredBlock.motion`.
    latency : int
        Samples by which what comes out lags behind the drive, where a filter's delay is taken out of their
        numbers: so many samples fewer come out at first.
    lost : tuple of tuple of int
        First and last sample of every stretch that is lost on the way from the converter to the recording.

    Examples
    --------
    >>> import rig
    >>> bench = Bench(rig.load("bare-structure"))
    >>> bench.inputs, bench.drive_units, [channel.at for channel in bench.channels]
    (('shaker',), ('m',), ['body 1', 'body 2', 'body 3', 'table'])
    >>> bench.acquire(np.zeros((1, 100))).samples.shape
    (4, 100)
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        clock = SampleClock.of(scene.converter)
        self.rate = clock.rate
        self._intervals = oversampling(scene, clock)
        # A clock with an error runs at its true rate and goes by the stated one.
        rate = clock.true_rate * self._intervals
        self._plant = Plant(scene, rate)
        self._chain = Chain(scene, rate, self._plant.points, self._plant.inputs)
        self._outputs = Outputs(scene, self._plant.inputs, self._plant.drive_units)
        self._line = DriveLine(len(self._plant.inputs), self._intervals)
        self._converter = Quantiser(scene.converter, self._chain.channels)
        self.latency: int = self._chain.latency
        self.lost: tuple[tuple[int, int], ...] = self._converter.lost
        self.inputs: tuple[str, ...] = tuple(self._plant.inputs)
        self.drive_units: tuple[str, ...] = tuple(self._plant.drive_units)
        self.points: tuple[str, ...] = tuple(self._plant.points)
        self._scale = np.array([[channel.unit_per_count] for channel in self.channels])

    @property
    def channels(self) -> tuple[ChannelInfo, ...]:
        """The channels, in the order of the rows of `AcquiredBlock.samples`."""
        return self._converter.channels

    @property
    def wiring(self) -> tuple[Channel, ...]:
        """The channels of the scene as they are set now, see `rewire`."""
        return self._chain.wiring

    def rewire(self, wiring: Sequence[Channel]) -> None:
        """Set couplings and supplies of the channels anew; see `daq.signal_chain.chain.Chain.rewire`."""
        if tuple(wiring) == self.wiring:
            return
        self._chain.rewire(wiring)
        self._converter = Quantiser(self.scene.converter, self._chain.channels)

    def acquire(self, drive: NDArray[np.float64]) -> AcquiredBlock:
        """Play drive samples and acquire what comes out meanwhile.

        The samples do not depend on how a drive is split into calls.

        Parameters
        ----------
        drive : ndarray, shape (inputs, samples)
            Drive in `drive_units`.

        Raises
        ------
        SceneError
            If the drive has another shape or is not finite.
        """
        if drive.ndim != 2 or drive.shape[0] != len(self.inputs):
            raise SceneError(
                f"the bench has {len(self.inputs)} drive input(s) ({', '.join(self.inputs) or 'none'}): "
                f"expected a drive of shape ({len(self.inputs)}, samples), got {drive.shape}"
            )
        if not np.isfinite(drive).all():
            raise SceneError("the drive holds values that are not finite: check the signal that was written")
        line = self._line.through(self._outputs.put_out(drive))
        motion = self._plant.advance(line)
        block = self._converter.convert(self._chain.measure(motion, line))
        overload = block.overload | self._chain.overload
        if self._intervals > 1:
            motion = motion.every(self._intervals, 1.0 / self._plant.rate)
        return AcquiredBlock(max(motion.first - self.latency, 0), block.samples, overload, motion)

    def physical(self, samples: NDArray[np.float64] | NDArray[np.int32]) -> NDArray[np.float64]:
        """Read samples in each channel's unit, as its data sheet says; shape (channels, samples)."""
        return samples * self._scale
