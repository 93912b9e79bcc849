"""Writing to a task: on demand, or into its buffer, waiting for room."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from daq.bench.stream import samples_per_tick
from daq.instrument.clock import seconds
from daq.instrument.engines.generation import OutputBuffer, OutputPlan
from daq.instrument.errors import Code, DaqError

if TYPE_CHECKING:
    from daq.instrument.engines.generation import Generation
    from daq.instrument.settings.channels import Channel
    from daq.instrument.task import Task

Array = NDArray[np.float64]


def write(task: Task, volts: Array, auto_start: bool, timeout: float) -> int:
    """Write samples, shape (channels, n), in the channels' units.

    Returns
    -------
    int
        Samples per channel written, n.

    Raises
    ------
    DaqError
        With -200292 when time is up; the reason why the output stopped; -200561 for samples beyond the
        channel's limits, -200524 for the wrong number of channels.
    """
    timeout = seconds(timeout)
    task.settings.require("ao")
    check_volts(task.settings.channels, volts)
    with task.chassis.changed:
        if not task.settings.clocked:
            if not (auto_start or task.running):
                raise DaqError(
                    "the task is not running, and auto_start is off: call start() before writing",
                    Code.CANNOT_READ_WHEN_AUTO_START_FALSE_AND_TASK_NOT_RUNNING_OR_COMMITTED,
                )
            return _put_out_on_demand(task, volts)
        if not task.running and (task.buffer is None or task.played):
            # What has been played to its end or stopped is done with: a new write begins a new buffer.
            chosen = task.settings.groups["buffer"]
            size = int(chosen["output_buf_size"]) if chosen.was_set("output_buf_size") else None
            task.buffer, task.played = OutputBuffer(volts.shape[0], size), False
        assert task.buffer is not None
        written = _fill(task, task.buffer, volts, timeout)
        if auto_start and not task.running:
            task.start()
        return written


def _put_out_on_demand(task: Task, volts: Array) -> int:
    """Put samples out one after the other at the rate of the bench; the last one stays."""
    chassis, rows = task.chassis, [each.row for each in task.settings.channels]
    task.verify()
    task.reserve()
    try:
        chassis.wake(task)
        if volts.shape[1] > 1:
            buffer = OutputBuffer(volts.shape[0], None)
            buffer.write(volts, running=False)
            per_tick = samples_per_tick(chassis.bench.rate, chassis.rate)
            plan = OutputPlan(tuple(rows), chassis.rate, per_tick, volts.shape[1], False)
            run = chassis.run_output(task, plan, buffer)
            chassis.wait(lambda: run.done, run.missing, -1.0)
            chassis.halt(task)
            if run.error is not None:
                raise run.error
        elif volts.shape[1]:
            chassis.held[rows] = volts[:, 0]
    finally:
        if not (task.running or task.committed):
            chassis.release(task)
    return volts.shape[1]


def _fill(task: Task, buffer: OutputBuffer, volts: Array, timeout: float) -> int:
    """Write samples into a buffer, waiting for room; see `write`."""
    chassis, wanted, done = task.chassis, volts.shape[1], 0
    began = chassis.clock.now(chassis)

    def running() -> Generation | None:
        return task.generation if task.running else None

    def free() -> int:
        run = running()
        generated = 0 if run is None else run.generated
        return int(buffer.free(generated, run is not None, task.settings.regenerates))

    def piece() -> int:
        return min(wanted - done, max(1, buffer.size // 2))

    while True:
        run = running()
        if run is not None and run.error is not None:
            task.reported = True
            raise DaqError(str(run.error), run.error.code, done)
        if run is not None and run.done:
            raise DaqError("the output has ended", Code.SAMPLES_CAN_NOT_YET_BE_WRITTEN, done)
        take = min(free(), wanted - done)
        if take > 0:
            buffer.write(volts[:, done : done + take], run is not None)
            done += take
        if done == wanted:
            return done
        left = timeout if timeout < 0 else max(0.0, timeout - (chassis.clock.now(chassis) - began))

        def ready() -> bool:
            now = running()
            return now is None or now.done or free() >= piece()

        if run is None or not chassis.wait(ready, lambda: piece() - free(), left):
            raise DaqError(
                f"{done} of {wanted} samples per channel found room in the buffer within {timeout:g} s: start "
                "the task, write less at a time, or enlarge out_stream.output_buf_size",
                Code.SAMPLES_CAN_NOT_YET_BE_WRITTEN,
                done,
            )


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
