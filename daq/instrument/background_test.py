"""Plays the test of a scene on the bench while no client drives the outputs."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.excitation import Excitation, Station, excitation
from daq.measurement.bench_loop import RAMP_S, ramp_down
from daq.signal_chain.oversampling import DriveInterpolator
from rig.arrays import Array
from rig.errors import ShotrigError


class BackgroundTest:
    """Plays a test on a bench in windows: intervals whose drive depends on the readings of the previous window.

    `station` describes the bench to the test; `station.now` is the number of the first sample. The excitation is a
    generator that yields the drive of each window and receives the readings; `excite` creates it. The drive is
    interpolated linearly over the `ticks` of the bench per sample. `physical` converts samples to the channels' units.
    `lead_ticks` ticks without drive precede the first sample. `ended` is called once when the test ends, with the
    reason, which is empty at a regular end. Without `ended`, the test restarts at its end, and an error is a warning.
    """

    def __init__(
        self,
        station: Station,
        ticks: int,
        physical: Callable[[NDArray[Any]], Array],
        lead_ticks: int = 0,
        excite: Callable[[Station], Excitation] = excitation,
        ended: Callable[[str], None] | None = None,
    ) -> None:
        self._station, self._physical, self._excite, self._ended = station, physical, excite, ended
        self._interpolator = DriveInterpolator(len(station.inputs), ticks)
        self._stopping = False
        self._position = 0  # in the drive of the window, ticks
        self._readings: list[Array] = []  # of the present window
        self._drive = np.zeros((len(station.inputs), 0))  # of the present window, at every tick
        # True while nothing is played: there is no test, it has ended or failed, or a client uses its output.
        self.quiet = station.scene.test is None
        if not self.quiet:
            self._start_test("cannot be played")
            self._drive = np.concatenate([np.zeros((len(self._drive), lead_ticks)), self._drive], axis=1)

    def _start_test(self, failure: str) -> None:
        """Start the test with its first window; `failure` is the predicate of the message if it cannot start."""
        try:
            self._test = self._excite(self._station)
            self._start_window(next(self._test))
        except ShotrigError as error:
            self._finish(failure, str(error))

    def _start_window(self, window: Array) -> None:
        """Start the next window, the drive of the next samples; the test receives their readings at its end."""
        self._window, self._drive, self._position = window, self._interpolator.interpolate(window), 0

    def _finish(self, failure: str, reason: str) -> None:
        """Play nothing from now on, and report the reason; `failure` is the predicate of the warning."""
        self.quiet = True
        if self._ended is not None:
            self._ended(reason)
        else:
            warnings.warn(
                f"the test of scene {self._station.scene.name!r} {failure}: {reason.rstrip('.')}. Until a script "
                "writes to an output, nothing drives the bench.",
                RuntimeWarning,
                stacklevel=2,
            )

    def stop(self) -> None:
        """End the test at the end of the current window, with a ramp of its drive to zero."""
        self._stopping = True

    def release_outputs(self) -> None:
        """Release the outputs to a client. A hammer test continues."""
        test = self._station.scene.test
        if not self.quiet and test is not None and test.kind != "impulse":
            if self._ended is None:
                self.quiet = True
            else:
                self._test.close()
                self._finish("", "a client has taken the output")

    def limit_ticks(self, ticks: int) -> int:
        """Limit a number of ticks to the current window: the next window depends on its readings."""
        return ticks if self.quiet else min(ticks, self._drive.shape[1] - self._position)

    def drive(self, ticks: int) -> Array:
        """Return the drive of the next ticks, shape (inputs, ticks)."""
        if self.quiet:
            return np.zeros((len(self._station.inputs), ticks))
        return self._drive[:, self._position : self._position + ticks]

    def add_readings(self, samples: NDArray[np.float64] | NDArray[np.int32], ticks: int) -> None:
        """Add converter samples of `ticks` ticks, shape (channels, samples); start the next window if one ends."""
        if self.quiet:
            return
        self._readings.append(self._physical(samples))
        self._position += ticks
        if self._position < self._drive.shape[1]:
            return
        size = self._window.shape[1]
        latest = np.concatenate(self._readings, axis=1)[:, -size:]
        # With a removed filter delay, the first window has fewer readings than samples.
        readings = np.zeros((latest.shape[0], size))
        readings[:, size - latest.shape[1] :] = latest
        self._station.now += size
        self._readings = []
        try:
            if self._stopping:
                self._stopping = False
                self._test.close()
                self._test = _ramp(self._window[:, -2:], self._station.samples(RAMP_S))
                self._start_window(next(self._test))
            else:
                self._start_window(self._test.send(readings))
        except StopIteration:
            if self._ended is not None:
                self._finish("", "")
            else:
                self._station = replace(self._station, now=0)
                self._start_test("cannot be played again")
        except ShotrigError as error:
            self._finish("has ended", str(error))


def _ramp(last: Array, samples: int) -> Excitation:
    """Return an excitation of one window: a ramp to zero from the last two samples of the drive, shape (inputs, 2)."""
    yield ramp_down(last, samples)
