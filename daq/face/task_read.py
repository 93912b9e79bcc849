"""Taking samples out of a running acquisition, waiting for those that have not come yet."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from daq.instrument.acquisition import Acquisition
from daq.instrument.errors import DAQmxErrors, DaqReadError

if TYPE_CHECKING:
    from daq.face.task import Task


def collect(
    task: Task, run: Acquisition, rows: list[int], out: NDArray[Any], timeout: float, raw: bool
) -> int:
    """Read from the run's position on; see `InStream.fill` for the errors.

    Parameters
    ----------
    task : Task
        The task; the lock of its chassis is held.
    run : Acquisition
        Where to read from.
    rows : list of int
        Channels to read, by their positions in the task.
    out : ndarray, shape (len(rows), n)
        Takes the samples.
    timeout : float
        Seconds.
    raw : bool
        Whether to leave the converter's samples as they are.

    Returns
    -------
    int
        Samples per channel read.
    """
    chassis, wanted = task.chassis, out.shape[1]
    scale = run.plan.scale[rows, None]
    began, got = chassis.clock.now(chassis), 0

    def piece() -> int:
        # In pieces of half the buffer, so that a read may be longer than the buffer.
        return min(wanted - got, max(1, run.plan.buffer // 2))

    while True:
        if lost := run.skip_lost():
            raise DaqReadError(
                f"{lost} samples per channel were overwritten before they were read; the next read begins "
                "with the oldest one left. Read more often or more at a time, or enlarge "
                "in_stream.input_buf_size",
                DAQmxErrors.SAMPLES_NO_LONGER_AVAILABLE,
                got,
                task.name,
            )
        take = min(run.readable - run.position, wanted - got)
        if take > 0:
            samples = run.take_out(take)[rows]
            out[:, got : got + take] = samples if raw else samples * scale
            got += take
            task.run.log_read()
        if got == wanted:
            return got
        if run.done and run.readable <= run.position:
            raise _ended(task, run, got)
        left = timeout if timeout < 0 else max(0.0, timeout - (chassis.clock.now(chassis) - began))
        ready = chassis.clock.wait(
            chassis,
            lambda: run.done or run.readable - run.position >= piece(),
            lambda: run.missing(piece()),
            left,
        )
        if not ready and run.readable <= run.position:
            raise DaqReadError(
                f"{got} of {wanted} samples per channel came within {timeout:g} s{_why(run)}; wait longer "
                "(timeout), read less, or check that the task is triggered",
                DAQmxErrors.SAMPLES_NOT_YET_AVAILABLE,
                got,
                task.name,
            )


def _why(run: Acquisition) -> str:
    if run.first_tick is None:
        return " (the start trigger has not come)"
    if run.plan.reference is not None and run.trigger is None:
        return " (the reference trigger has not come)"
    return ""


def _ended(task: Task, run: Acquisition, got: int) -> DaqReadError:
    if run.error is not None:
        task.run.failure_told = True
        return DaqReadError(run.error.bare_message, run.error.error_code, got, task.name)
    return DaqReadError(
        "the acquisition has ended and all its samples have been read; ask for less, acquire more "
        "(samps_per_chan), or stop and start the task to acquire again",
        DAQmxErrors.SAMPLES_WILL_NEVER_BE_AVAILABLE,
        got,
        task.name,
    )
