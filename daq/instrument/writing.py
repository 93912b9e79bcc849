"""Writing to an output: on demand, or into its buffer, waiting for room."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from daq.instrument.errors import Code, DaqError
from daq.instrument.generation import OutputBuffer, OutputPlan

if TYPE_CHECKING:
    from daq.instrument.channels import Channel
    from daq.instrument.chassis import Chassis, Runner
    from daq.instrument.generation import Generation

Array = NDArray[np.float64]


def check_volts(channels: Sequence[Channel], volts: Array) -> None:
    """Check samples against channels; with -200524 or -200561."""
    if volts.ndim != 2 or volts.shape[0] != len(channels):
        raise DaqError(
            f"the data have {volts.shape[0]} channels, the task has {len(channels)}: write one row for each",
            Code.WRITE_NUM_CHANS_MISMATCH,
        )
    for channel, row in zip(channels, volts, strict=True):
        low, high = channel.settings["ao_min"], channel.settings["ao_max"]
        # Written this way round, NaN is caught too.
        wrong = ~((row >= low) & (row <= high))
        if wrong.any():
            raise DaqError(
                f"cannot put out {row[wrong][0]:g} V on {channel.name}: its limits are {low:g} to {high:g} V",
                Code.INVALID_AO_DATA_WRITE,
                done=0,
            )


def hold(chassis: Chassis, task: Runner, rows: Sequence[int], volts: Array) -> None:
    """Put samples out on demand, one after the other, a tick each; the last one stays."""
    if volts.shape[1] > 1:
        buffer = OutputBuffer(volts.shape[0], None)
        buffer.write(volts, running=False)
        plan = OutputPlan(tuple(rows), chassis.rate, Fraction(1), volts.shape[1], False)
        run = chassis.run_output(task, plan, buffer)
        chassis.wait(lambda: run.done, run.missing, -1.0)
        chassis.halt(task)
        if run.error is not None:
            raise run.error
    elif volts.shape[1]:
        chassis.held[list(rows)] = volts[:, 0]


def fill(
    chassis: Chassis,
    buffer: OutputBuffer,
    volts: Array,
    timeout: float,
    regenerates: bool,
    running: Callable[[], Generation | None],
) -> int:
    """Write samples into a buffer; see `Task.write`.

    Parameters
    ----------
    chassis : Chassis
        The chassis; its lock is held.
    buffer : OutputBuffer
        Where to.
    volts : ndarray, shape (channels, n)
        The samples.
    timeout : float
        Seconds.
    regenerates : bool
        Whether the buffer may be played again.
    running : callable
        Gives what plays it; None while nothing does.
    """
    wanted, done = volts.shape[1], 0
    began = chassis.clock.now(chassis)

    def room() -> int:
        run = running()
        return int(buffer.room(0 if run is None else run.generated, run is not None, regenerates))

    def piece() -> int:
        return min(wanted - done, max(1, buffer.size // 2))

    while True:
        run = running()
        if run is not None and run.error is not None:
            raise DaqError(str(run.error), run.error.code, done)
        if run is not None and run.done:
            raise DaqError("the output has ended", Code.SAMPLES_CAN_NOT_YET_BE_WRITTEN, done)
        take = min(room(), wanted - done)
        if take > 0:
            buffer.write(volts[:, done : done + take], run is not None)
            done += take
        if done == wanted:
            return done
        left = timeout if timeout < 0 else max(0.0, timeout - (chassis.clock.now(chassis) - began))

        def ready() -> bool:
            now = running()
            return now is None or now.done or room() >= piece()

        if run is None or not chassis.wait(ready, lambda: piece() - room(), left):
            raise DaqError(
                f"{done} of {wanted} samples per channel found room in the buffer within {timeout:g} s: start "
                "the task, write less at a time, or enlarge out_stream.output_buf_size",
                Code.SAMPLES_CAN_NOT_YET_BE_WRITTEN,
                done,
            )
