"""The test of a scene, run on the bench while no client drives the outputs."""

import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.core.excitation import Excitation, Station, excitation
from daq.core.excitation.station import AbortedTest
from daq.core.measurement.bench_loop import RAMP_S, ramp_down
from daq.core.signal_chain.oversampling import DriveInterpolator
from rig.core.base.arrays import Array
from rig.core.base.errors import ShotrigError


class BackgroundTest:
    """Runs a test block by block: the drive of a block may depend on the readings of the previous block.

    `station`: interface of the test to the bench, with the first sample of the current block in `station.now`;
    `ticks_per_sample`: the drive is interpolated linearly at the ticks; `to_units`: converts samples to the channels'
    units; `lead_ticks`: ticks without drive before the first sample; `make_excitation`: creates the generator of the
    drive; `on_end`: called when the test ends, with the reason (empty if the test ran to completion). If None, the test
    is repeated, and an error is only a warning.
    """

    def __init__(
        self,
        station: Station,
        ticks_per_sample: int,
        to_units: Callable[[NDArray[Any]], Array],
        lead_ticks: int = 0,
        make_excitation: Callable[[Station], Excitation] = excitation,
        on_end: Callable[[str], None] | None = None,
    ) -> None:
        self._station, self._to_units, self._make_excitation, self._on_end = station, to_units, make_excitation, on_end
        self._interpolator = DriveInterpolator(len(station.inputs), ticks_per_sample)
        self._is_stopping = False
        self._reason = ""  # reason why the test aborted
        self._position = 0  # position in the drive of the current block [ticks]
        self._readings: list[Array] = []  # readings of the current block
        self._drive = np.zeros((len(station.inputs), 0))  # drive of the current block at every tick
        # Whether no test runs: the scene has none, it has ended or failed, or a task of a client drives an output.
        self.is_idle = station.scene.test is None
        if not self.is_idle:
            self._start_test("cannot run")
            self._drive = np.concatenate([np.zeros((len(self._drive), lead_ticks)), self._drive], axis=1)

    def _start_test(self, failure: str) -> None:
        """Start the test; `failure`: verb phrase of the warning if the test cannot start, such as "cannot run"."""
        try:
            self._test = self._make_excitation(self._station)
            self._start_block(next(self._test))
        except ShotrigError as error:
            self._finish(failure, str(error))

    def _start_block(self, drive: Array) -> None:
        """Start the next block, with its drive at the sample rate, shape (inputs, samples)."""
        self._block_drive, self._drive, self._position = drive, self._interpolator.interpolate(drive), 0

    def _start_ramp(self) -> None:
        """Start a last block, in which the drive decreases to zero."""
        self._test = _ramp(self._block_drive[:, -2:], self._station.samples(RAMP_S))
        self._start_block(next(self._test))

    def _finish(self, failure: str, reason: str) -> None:
        """End the drive, and report the reason; `failure`: verb phrase of the warning, such as "has ended"."""
        self.is_idle = True
        if self._on_end is not None:
            self._on_end(reason)
        else:
            warnings.warn(
                f"the test of scene {self._station.scene.name!r} {failure}: {reason.rstrip('.')}. Nothing drives "
                "the bench until a script writes to an output.",
                RuntimeWarning,
                stacklevel=2,
            )

    def stop(self) -> None:
        """End the test after the current block, with a ramp to zero; without `on_end`, the test then starts again."""
        self._is_stopping = True

    def release_outputs(self) -> None:
        """End the test because a client uses an output; an impact test, which uses no output, continues."""
        scene = self._station.scene
        if not self.is_idle and scene.test is not None and scene.hammer is None:
            if self._on_end is None:
                self.is_idle = True
            else:
                self._test.close()
                self._finish("", "a client has taken the output")

    def limit_ticks(self, ticks: int) -> int:
        """Limit a number of ticks to the current block: the next drive is not known before its readings."""
        return ticks if self.is_idle else min(ticks, self._drive.shape[1] - self._position)

    def drive(self, ticks: int) -> Array:
        """Return the drive of the next ticks, shape (inputs, ticks)."""
        if self.is_idle:
            return np.zeros((len(self._station.inputs), ticks))
        return self._drive[:, self._position : self._position + ticks]

    def add_readings(self, samples: NDArray[np.float64] | NDArray[np.int32], ticks: int) -> None:
        """Add converter samples of `ticks` ticks, shape (channels, samples); at the end of a block, start the next."""
        if self.is_idle:
            return
        self._readings.append(self._to_units(samples))
        self._position += ticks
        if self._position < self._drive.shape[1]:
            return
        n_samples = self._block_drive.shape[1]
        received = np.concatenate(self._readings, axis=1)[:, -n_samples:]
        # If the filter delay is removed, the first block has fewer samples; the missing samples are set to zero.
        readings = np.zeros((received.shape[0], n_samples))
        readings[:, n_samples - received.shape[1] :] = received
        self._station.now += n_samples
        self._readings = []
        try:
            if self._is_stopping:
                self._is_stopping = False
                self._test.close()
                self._start_ramp()
            else:
                self._start_block(self._test.send(readings))
        except AbortedTest as error:
            self._reason = str(error)
            self._start_ramp()
        except StopIteration:
            if self._on_end is not None or self._reason:
                self._finish("has ended", self._reason)
            else:
                self._station = replace(self._station, now=0)
                self._start_test("cannot be repeated")
        except ShotrigError as error:
            self._finish("has ended", str(error))


def _ramp(last_drive: Array, samples: int) -> Excitation:
    """Return an excitation of one block: a ramp to zero from the last two samples of the drive, shape (inputs, 2)."""
    yield ramp_down(last_drive, samples)
