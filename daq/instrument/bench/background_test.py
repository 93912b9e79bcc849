"""What happens on the bench while no script has taken the shaker's output: the scene's own test."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from daq.excitation import Station, excitation
from rig.errors import ShotrigError

if TYPE_CHECKING:
    from daq.signal_chain.bench import Bench

Array = NDArray[np.float64]


class BackgroundTest:
    """Plays the scene's test on a bench, over and over, with its controller watching the channels.

    Parameters
    ----------
    bench : Bench
        The bench.
    """

    def __init__(self, bench: Bench) -> None:
        self._bench = bench
        self._quiet = bench.scene.test is None
        self._at = 0
        self._heard: list[Array] = []
        self._window = np.zeros((len(bench.inputs), 0))
        if not self._quiet:
            self._begin()

    def _begin(self) -> None:
        bench = self._bench
        self._station = Station(
            bench.scene, bench.channels, bench.inputs, bench.rate, mark=lambda *given, **fields: None
        )
        try:
            self._test = excitation(self._station)
            self._window = next(self._test)
        except ShotrigError as error:
            self._quiet = True
            warnings.warn(
                f"the test of scene {bench.scene.name!r} cannot be played, the bench stays quiet until a "
                "script "
                f"drives it: {error}",
                RuntimeWarning,
                stacklevel=2,
            )

    def leave_shaker(self) -> None:
        """Let a script have the shaker; where there is a hammer, go on hitting with it."""
        self._quiet |= "hammer" not in self._bench.inputs

    def horizon(self, samples: int) -> int:
        """Cut a number of samples at the end of the current window: the next one depends on what is heard."""
        return samples if self._quiet else min(samples, self._window.shape[1] - self._at)

    def drive(self, samples: int) -> Array:
        """Give the drive of the next samples, shape (inputs, samples)."""
        if self._quiet:
            return np.zeros((len(self._bench.inputs), samples))
        return self._window[:, self._at : self._at + samples]

    def hear(self, samples: NDArray[np.float64] | NDArray[np.int32], ticks: int) -> None:
        """Take what the channels gave in so many ticks, shape (channels, up to `ticks`)."""
        if self._quiet:
            return
        # Where a filter's latency is hidden in the sample numbers, nothing comes out at first.
        readings = np.zeros((samples.shape[0], ticks))
        readings[:, ticks - samples.shape[1] :] = self._bench.physical(samples)
        self._heard.append(readings)
        self._at += ticks
        if self._at < self._window.shape[1]:
            return
        readings = self._heard[0] if len(self._heard) == 1 else np.concatenate(self._heard, axis=1)
        self._station.now += self._at
        self._heard, self._at = [], 0
        try:
            self._window = self._test.send(readings)
        except StopIteration:
            self._begin()
        except ShotrigError as error:
            self._quiet = True
            warnings.warn(f"the scene's test has ended: {error}", RuntimeWarning, stacklevel=2)
