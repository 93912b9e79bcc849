"""What happens on the bench while no script has taken the shaker's output: the scene's own test."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from daq.excitation import Station, excitation
from daq.signal_chain.oversampling import DriveLine
from rig.errors import ShotrigError

if TYPE_CHECKING:
    from daq.signal_chain.channel import ChannelInfo
    from rig.scene.scene import Scene

Array = NDArray[np.float64]


class BackgroundTest:
    """Plays the scene's test on a bench, over and over, with its controller watching the channels.

    Parameters
    ----------
    scene : Scene
        What is on the bench.
    channels, inputs : sequence
        Its channels, and the names of its drive inputs.
    rate : float
        Samples per second.
    ticks : int
        Ticks of the bench per sample; the drive is joined by straight lines.
    physical : callable
        Reads samples in the channels' units.

    Attributes
    ----------
    quiet : bool
        Whether it does nothing: there is no test, none that can be played, or the shaker is a script's.
    """

    def __init__(
        self,
        scene: Scene,
        channels: Sequence[ChannelInfo],
        inputs: Sequence[str],
        rate: float,
        ticks: int,
        physical: Callable[[NDArray[Any]], Array],
    ) -> None:
        self._scene, self._inputs, self._physical = scene, tuple(inputs), physical
        self._channels, self._rate = channels, rate
        self._line = DriveLine(len(inputs), ticks)
        self.quiet = scene.test is None
        self._at = 0
        self._heard: list[Array] = []
        self._drive = np.zeros((len(inputs), 0))
        if not self.quiet:
            self._begin()

    def _begin(self) -> None:
        self._station = Station(
            self._scene, self._channels, self._inputs, self._rate, mark=lambda *given, **fields: None
        )
        try:
            self._test = excitation(self._station)
            self._play(next(self._test))
        except ShotrigError as error:
            self.quiet = True
            warnings.warn(
                f"the test of scene {self._scene.name!r} cannot be played, the bench stays quiet until a script "
                f"drives it: {error}",
                RuntimeWarning,
                stacklevel=2,
            )

    def _play(self, window: Array) -> None:
        """Take the drive of the next samples; what they say is heard when the last one is over."""
        self._samples, self._drive, self._at = window.shape[1], self._line.through(window), 0

    def leave_shaker(self) -> None:
        """Let a script have the shaker; where there is a hammer, go on hitting with it."""
        self.quiet |= "hammer" not in self._inputs

    def horizon(self, ticks: int) -> int:
        """Cut a number of ticks at the end of the current window: the next one depends on what is heard."""
        return ticks if self.quiet else min(ticks, self._drive.shape[1] - self._at)

    def drive(self, ticks: int) -> Array:
        """Give the drive of the next ticks, shape (inputs, ticks)."""
        if self.quiet:
            return np.zeros((len(self._inputs), ticks))
        return self._drive[:, self._at : self._at + ticks]

    def hear(self, samples: NDArray[np.float64] | NDArray[np.int32], ticks: int) -> None:
        """Take what the channels gave in so many ticks, shape (channels, samples)."""
        if self.quiet:
            return
        self._heard.append(self._physical(samples))
        self._at += ticks
        if self._at < self._drive.shape[1]:
            return
        heard = np.concatenate(self._heard, axis=1)
        # Where a filter's latency is hidden in the sample numbers, nothing comes out at first.
        readings = np.zeros((heard.shape[0], self._samples))
        readings[:, self._samples - heard.shape[1] :] = heard
        self._station.now += self._samples
        self._heard = []
        try:
            self._play(self._test.send(readings))
        except StopIteration:
            self._begin()
        except ShotrigError as error:
            self.quiet = True
            warnings.warn(f"the scene's test has ended: {error}", RuntimeWarning, stacklevel=2)
