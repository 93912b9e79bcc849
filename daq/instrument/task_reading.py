"""Reading from a task: taking samples out of what runs, waiting for those that have not come yet."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from daq.instrument.clock import seconds
from daq.instrument.engines.acquisition import Acquisition
from daq.instrument.engines.ring_buffer import memory
from daq.instrument.errors import Code, DaqError, unsupported
from daq.instrument.plans import input_plan
from daq.instrument.values import LoggingMode, RelativeTo

if TYPE_CHECKING:
    from daq.instrument.engines.input_engine import InputEngine
    from daq.instrument.settings.channels import Channel
    from daq.instrument.settings.properties import Properties
    from daq.instrument.task import Task


@dataclass
class Reading:
    """What a read gave: samples, shape (channels, n), and why there are no more, if there should be."""

    samples: NDArray[Any]
    first: int = 0
    error: DaqError | None = None


def read(
    task: Task,
    samples: int,
    timeout: float,
    raw: bool = False,
    check: Callable[[int], None] = lambda samples: None,
) -> Reading:
    """Read samples, starting the task if need be.

    Parameters
    ----------
    samples : int
        Samples per channel; -1 takes all of a finite task, what is there of a continuous one.
    timeout : float
        Seconds to wait; 0 tries once, negative waits for ever.
    raw : bool
        Whether to give the converter's counts instead of readings in the channels' units.
    check : callable, optional
        Called with the samples per channel before any is read; what it raises ends the read.

    Returns
    -------
    Reading
        With -200284 when time is up, -200279 when samples have been overwritten (reading goes on with
        the oldest left), -200278 beyond the end of a finite acquisition, or the reason why the
        acquisition stopped; the samples that came before are there too.
    """
    timeout = seconds(timeout)
    with task.chassis.changed:
        task.settings.require("ai")
        if task.settings.groups["read"]["logging_mode"] == LoggingMode.LOG:
            raise DaqError(
                "the task only logs (LoggingMode.LOG): to read as well, log with LoggingMode.LOG_AND_READ",
                Code.READ_NOT_SUPPORTED_FOR_LOGGING_MODE,
            )
        if samples < 0:
            samples = default_count(task)
        check(samples)
        rows = task.settings.rows_to_read()
        out = memory(len(rows), samples, np.int32 if raw else np.float64)
        if not task.settings.clocked:
            return _read_on_demand(task, rows, out, timeout, raw)
        task.begin()
        assert task.acquisition is not None
        if timeout == 0:
            task.look("read")
        try:
            seek(task.settings.groups["read"], task.acquisition.acquisition)
            return collect(task, task.acquisition, rows, out, timeout, raw)
        finally:
            _after_read(task)


def _read_on_demand(task: Task, rows: list[int], out: NDArray[Any], timeout: float, raw: bool) -> Reading:
    chassis = task.chassis
    task.verify()
    task.reserve()
    chassis.wake(task)
    chassis.wire(task, task.settings.channels)
    plan = input_plan(task.settings, chassis.bench, None, None, on_demand=out.shape[1])
    task.acquisition = chassis.run_input(task, plan)
    try:
        return collect(task, task.acquisition, rows, out, timeout, raw)
    finally:
        chassis.halt(task)
        task.acquisition = None
        if not (task.running or task.committed):
            chassis.release(task)


def _after_read(task: Task) -> None:
    """Stop a finite task that a read has started and emptied."""
    run = task.run
    if task.automatic and task.running and run is not None and run.done and run.position >= run.readable:
        task.end()


def default_count(task: Task) -> int:
    """Count what a read takes by default: all of a finite task, what is there of a continuous one."""
    settings = task.settings
    settings.require("ai")
    run = task.acquisition.acquisition if task.running and task.acquisition is not None else None
    if not settings.clocked:
        return 1
    if settings.finite and not settings.groups["read"]["read_all_avail_samp"]:
        if run is None or run.plan.again:
            return settings.samples
        end = settings.samples if run.trigger is None else run.first_readable + settings.samples
        return max(end - run.position, 0) or settings.samples
    if run is None:
        task.begin()
        assert task.acquisition is not None
        run = task.acquisition.acquisition
    if run.readable <= run.position and task.running and not run.done:
        task.chassis.clock.glance(task.chassis)
    return max(0, run.readable - run.position)


def seek(settings: Properties, run: Acquisition) -> None:
    """Go to where reads begin, if the script has said so.

    Raises
    ------
    DaqError
        With -200277 for a place before the first sample, -200282 for one that a reference trigger would give.
    """
    relative, offset = RelativeTo(settings["relative_to"]), settings["offset"]
    position = run.position
    if relative == RelativeTo.CURRENT_READ_POSITION:
        position += offset
    elif relative == RelativeTo.FIRST_SAMPLE:
        position = offset
    elif relative == RelativeTo.MOST_RECENT_SAMPLE:
        position = max(0, run.ring.written + offset)
    elif run.plan.reference is None:
        raise DaqError(
            f"in_stream.relative_to is {relative.name}, but the task has no reference trigger",
            Code.NO_REF_TRIG_CONFIGURED,
        )
    elif run.trigger is not None:
        at_trigger = relative == RelativeTo.REFERENCE_TRIGGER
        position = (run.trigger if at_trigger else run.first_readable) + offset
    if position < 0:
        raise DaqError(
            f"the read would begin {-position} samples before the first one: in_stream.relative_to is "
            f"{relative.name} and in_stream.offset {offset}",
            Code.NEGATIVE_READ_SAMPLE_NUMBER,
            done=0,
        )
    run.position = position


def collect(
    task: Task, engine: InputEngine, rows: Sequence[int], out: NDArray[Any], timeout: float, raw: bool
) -> Reading:
    """Read from the run's position on; see `read` for the errors. The chassis is locked by the caller.

    Parameters
    ----------
    engine : InputEngine
        Where to read from.
    rows : sequence of int
        Channels to read, by their positions in the task.
    out : ndarray, shape (len(rows), n)
        Takes the samples.
    """
    chassis = task.chassis
    wanted, run = out.shape[1], engine.acquisition
    began, got, first = chassis.clock.now(chassis), 0, run.position

    def piece() -> int:
        # In pieces of half the buffer, so that a read may be longer than the buffer.
        return min(wanted - got, max(1, run.plan.buffer // 2))

    def ended(error: DaqError | None) -> Reading:
        task.reported |= error is not None and error is run.error
        return Reading(out[:, :got], first, error)

    while True:
        if lost := run.skip_lost():
            return ended(
                DaqError(
                    f"{lost} samples per channel were overwritten before they were read; the next read begins "
                    "with the oldest one left. Read more often or more at a time, or enlarge "
                    "in_stream.input_buf_size",
                    Code.SAMPLES_NO_LONGER_AVAILABLE,
                )
            )
        take = min(run.readable - run.position, wanted - got)
        if take > 0:
            first = first if got else run.position
            samples = run.take_out(take)
            for index, row in enumerate(rows):
                into = out[index, got : got + take]
                if raw:
                    into[:] = _counts(task.settings.channels[row], samples[row])
                else:
                    into[:] = run.plan.reading(row, samples[row])
            got += take
            if task.log is not None:
                task.log.follow(run)
        if got == wanted:
            return ended(None)
        if run.done and run.readable <= run.position:
            # A finite task acquires no more; a read that finds nothing ends with the error for that.
            return ended(None if got and run.error is None else run.error or _ended())
        left = timeout if timeout < 0 else max(0.0, timeout - (chassis.clock.now(chassis) - began))
        ready = chassis.wait(
            lambda: run.done or run.readable - run.position >= piece(),
            lambda: engine.ticks(run.missing(piece()), chassis.position),
            left,
        )
        if not ready and run.readable <= run.position:
            return ended(
                DaqError(
                    f"{got} of {wanted} samples per channel came within {timeout:g} s{_why(run)}; wait longer "
                    "(timeout), read less, or check that the task is triggered",
                    Code.SAMPLES_NOT_YET_AVAILABLE,
                )
            )


def _counts(channel: Channel, samples: NDArray[Any]) -> NDArray[Any]:
    """Give converter counts."""
    if np.issubdtype(samples.dtype, np.integer):
        return samples
    bits = channel.module.bits
    if bits is None or not np.isfinite(channel.range):
        raise unsupported(
            "an unscaled read",
            "The scene's converter has no counts: give it bits and a range, or read volts.",
        )
    full = 2.0 ** (bits - 1)
    return np.clip(np.rint(samples / channel.range * full), -full, full - 1)


def _why(run: Acquisition) -> str:
    if run.first_tick is None:
        return " (the start trigger has not come)"
    if run.plan.reference is not None and run.trigger is None:
        return " (the reference trigger has not come)"
    return ""


def _ended() -> DaqError:
    return DaqError(
        "the acquisition has ended and all its samples have been read; ask for less, acquire more "
        "(samps_per_chan), or stop and start the task to acquire again",
        Code.SAMPLES_WILL_NEVER_BE_AVAILABLE,
    )


def overloaded_exist(task: Task) -> bool:
    """Whether any channel has been overloaded since this was last asked; asking clears the flags."""
    run = None if task.acquisition is None else task.acquisition.acquisition
    flags = [] if run is None else run.overloaded.tolist()
    names = [each.name for each in task.settings.channels]
    task.overloads_reported = [name for name, flag in zip(names, flags, strict=False) if flag]
    if run is not None:
        run.overloaded[:] = False
    return bool(task.overloads_reported)


def overloaded(task: Task) -> list[str]:
    """Names of the channels that were overloaded when `overloaded_exist` was asked."""
    if task.overloads_reported is None:
        raise DaqError(
            "ask in_stream.overloaded_chans_exist first: it takes the flags that overloaded_chans names",
            Code.OVERLOADED_CHANS_EXIST_NOT_READ,
        )
    return list(task.overloads_reported)


def raw_width(task: Task) -> int:
    """Bytes of a converter count."""
    return 2 if all((each.module.bits or 32) <= 16 for each in task.settings.channels) else 4


def time_of_sample(task: Task, sample: int) -> int:
    """Time of a sample of the last acquisition, ns; without one, that of now."""
    engine, chassis = task.acquisition, task.chassis
    if engine is None:
        return chassis.time_ns(chassis.position)
    return chassis.time_ns(engine.tick_at(engine.acquisition.tick_of(sample)))
