"""Taking samples out of a running acquisition, waiting for those that have not come yet."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from daq.instrument.acquisition import Acquisition
from daq.instrument.errors import Code, DaqError, unsupported
from daq.instrument.values import RelativeTo

if TYPE_CHECKING:
    from daq.instrument.channels import Channel
    from daq.instrument.chassis import Chassis, InputEngine
    from daq.instrument.properties import Properties


@dataclass
class Reading:
    """What a read gave: samples, shape (channels, n), and why there are no more, if there should be."""

    samples: NDArray[Any]
    first: int = 0
    error: DaqError | None = None


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
    chassis: Chassis,
    engine: InputEngine,
    rows: Sequence[int],
    out: NDArray[Any],
    timeout: float,
    raw_of: Sequence[Channel] | None,
    taken: Callable[[], None],
) -> Reading:
    """Read from the run's position on; see `Task.read` for the errors.

    Parameters
    ----------
    chassis : Chassis
        The chassis; its lock is held.
    engine : InputEngine
        Where to read from.
    rows : sequence of int
        Channels to read, by their positions in the task.
    out : ndarray, shape (len(rows), n)
        Takes the samples.
    timeout : float
        Seconds.
    raw_of : sequence of Channel, optional
        The task's channels, to give the converter's counts instead of readings in the channels' units.
    taken : callable
        Told whenever samples have been taken out.
    """
    wanted, run = out.shape[1], engine.acquisition
    began, got, first = chassis.clock.now(chassis), 0, run.position

    def piece() -> int:
        # In pieces of half the buffer, so that a read may be longer than the buffer.
        return min(wanted - got, max(1, run.plan.buffer // 2))

    def ended(error: DaqError | None) -> Reading:
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
                if raw_of is None:
                    into[:] = run.plan.reading(row, samples[row])
                else:
                    into[:] = _counts(raw_of[row], samples[row])
            got += take
            taken()
        if got == wanted:
            return ended(None)
        if run.done and run.readable <= run.position:
            # What a finite task has acquired is all there is; a read that finds nothing is told so.
            return ended(None if got and run.error is None else run.error or _ended())
        left = timeout if timeout < 0 else max(0.0, timeout - (chassis.clock.now(chassis) - began))
        ready = chassis.wait(
            lambda: run.done or run.readable - run.position >= piece(),
            lambda: run.missing(piece()) * engine.divisor,
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
