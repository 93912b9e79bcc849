"""Writing to a task: its buffer, and whether it is played again."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from daq.face import argument
from daq.face.constants import RegenerationMode, WaitMode, WriteRelativeTo
from daq.instrument.errors import DaqError, DAQmxErrors, DaqWriteError, unsupported
from daq.instrument.generation import OutputBuffer

if TYPE_CHECKING:
    from daq.face.task import Task

_FROZEN = ("regen_mode", "relative_to", "offset")
_FREE = ("timeout", "auto_start", "wait_mode", "sleep_time")
_KINDS: dict[str, Any] = {
    "regen_mode": RegenerationMode,
    "relative_to": WriteRelativeTo,
    "wait_mode": WaitMode,
}


class OutStream:
    """The output side of a task; properties have the driver's names.

    What is written before the start becomes the buffer. With regeneration (the default) it is played again
    and again, and writing while the task runs replaces what is played, from where the last write ended;
    without, writes wait for room and the output stops when nothing new is left.

    Parameters
    ----------
    task : Task
        The task.
    """

    timeout: float
    auto_start: bool
    wait_mode: WaitMode
    sleep_time: float
    regen_mode: RegenerationMode
    relative_to: WriteRelativeTo
    offset: int

    def __init__(self, task: Task) -> None:
        self.__dict__.update(
            _task=task,
            timeout=10.0,
            auto_start=False,
            wait_mode=WaitMode.POLL,
            sleep_time=0.001,
            regen_mode=RegenerationMode.ALLOW_REGENERATION,
            relative_to=WriteRelativeTo.CURRENT_WRITE_POSITION,
            offset=0,
            _size=None,
            buffer=None,
            _played=False,
        )

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "output_buf_size":
            object.__setattr__(self, name, value)
            return
        if name not in _FROZEN + _FREE:
            raise unsupported(f"setting out_stream.{name}")
        if name in _FROZEN:
            self._task.check_idle(f"out_stream.{name}")
        if name in _KINDS:
            value = argument.choice(_KINDS[name], value, f"out_stream.{name}")
        self.__dict__[name] = value

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        raise unsupported(f"out_stream.{name}")

    @property
    def regenerate(self) -> bool:
        """Whether the buffer may be played again."""
        return self.regen_mode is RegenerationMode.ALLOW_REGENERATION

    @property
    def num_chans(self) -> int:
        """Number of channels written to."""
        return len(self._task.ao_channels)

    @property
    def output_buf_size(self) -> int:
        """Samples per channel the buffer holds."""
        if self._size is not None:
            return int(self._size)
        return 0 if self.buffer is None else int(self.buffer.size)

    @output_buf_size.setter
    def output_buf_size(self, size: int) -> None:
        self._task.check_idle("out_stream.output_buf_size")
        size = argument.whole(size, "out_stream.output_buf_size")
        if size < 1:
            raise DaqError(
                f"output_buf_size {size}: expected 1 sample at least",
                DAQmxErrors.INVALID_ATTRIBUTE_VALUE,
                self._task.name,
            )
        self.__dict__.update(_size=size, buffer=None)

    @property
    def curr_write_pos(self) -> int:
        """Samples per channel written so far."""
        return 0 if self.buffer is None else int(self.buffer.written)

    @property
    def total_samp_per_chan_generated(self) -> int:
        """Samples per channel put out since the start."""
        self._task.run.look("total_samp_per_chan_generated")
        run = self._task.run.generation
        return 0 if run is None else run.generated

    @property
    def space_avail(self) -> int:
        """Samples per channel that could be written without waiting."""
        self._task.run.look("space_avail")
        if self.buffer is None:
            return self.output_buf_size
        run = self._task.run.generation
        return int(
            self.buffer.room(0 if run is None else run.generated, self._task.is_running, self.regenerate)
        )

    def started(self) -> OutputBuffer:
        """Give the buffer to a task that starts.

        Raises
        ------
        DaqError
            With -200462, if nothing has been written.
        """
        if self.buffer is None or self.buffer.written == 0:
            raise DaqError(
                "nothing has been written for the output to play: write samples before starting the task",
                DAQmxErrors.OUTPUT_BUFFER_EMPTY,
                self._task.name,
            )
        self.__dict__["_played"] = True
        buffer: OutputBuffer = self.buffer
        return buffer

    def put(self, samples: NDArray[np.float64], auto_start: bool, timeout: float) -> int:
        """Write volts.

        Parameters
        ----------
        samples : ndarray, shape (channels, n)
            Volts.
        auto_start : bool
            Whether to start the task if it is not running.
        timeout : float
            Seconds to wait for room; 0 tries once, negative waits for ever.

        Returns
        -------
        int
            Samples per channel written, n.

        Raises
        ------
        DaqWriteError
            With -200292 when time is up, or the reason why the output stopped.
        DaqError
            With -200561 for volts beyond the channel's limits, -200524 for the wrong number of channels.
        """
        task = self._task
        task.require_outputs()
        timeout = argument.seconds(timeout)
        self._check(samples)
        with task.chassis.changed:
            if not task.timing.clocked:
                return self._hold(samples)
            if not task.is_running and (self.buffer is None or self._played):
                # What has been played to its end or stopped is done with: a new write begins a new buffer.
                self.__dict__.update(buffer=OutputBuffer(samples.shape[0], self._size), _played=False)
            written = self._fill(samples, timeout)
            if auto_start and not task.is_running:
                task.start()
            return written

    def _check(self, samples: NDArray[np.float64]) -> None:
        task = self._task
        terminals = task.ao_channels.terminals
        if samples.shape[0] != len(terminals):
            raise DaqError(
                f"the data have {samples.shape[0]} channels, the task has {len(terminals)}: write one row "
                "for each",
                DAQmxErrors.WRITE_NUM_CHANS_MISMATCH,
                task.name,
            )
        for terminal, row in zip(terminals, samples, strict=True):
            low, high = terminal.settings["ao_min"], terminal.settings["ao_max"]
            # Written this way round, NaN is caught too.
            if not ((row >= low) & (row <= high)).all():
                worst = row[~((row >= low) & (row <= high))][0]
                raise DaqError(
                    f"cannot put out {worst:g} V on {terminal.name}: its limits are {low:g} to {high:g} V",
                    DAQmxErrors.INVALID_AO_DATA_WRITE,
                    task.name,
                )

    def _hold(self, samples: NDArray[np.float64]) -> int:
        if samples.shape[1] != 1:
            raise DaqError(
                f"{samples.shape[1]} samples were written to a task without a sample clock, which puts out "
                "one at a "
                "time: call timing.cfg_samp_clk_timing first",
                DAQmxErrors.ANALOG_MULTI_SAMP_WRITE_NOT_SUPPORTED,
                self._task.name,
            )
        with self._task.reserved():
            self._task.chassis.held = samples[:, 0].copy()
        return 1

    def _fill(self, samples: NDArray[np.float64], timeout: float) -> int:
        task, buffer = self._task, self.buffer
        chassis, wanted, done = task.chassis, samples.shape[1], 0
        began = chassis.clock.now(chassis)

        def room() -> int:
            run = task.run.generation if task.is_running else None
            return int(buffer.room(0 if run is None else run.generated, run is not None, self.regenerate))

        def piece() -> int:
            return min(wanted - done, max(1, buffer.size // 2))

        while True:
            failure = task.run.failure if task.is_running else None
            if failure is not None:
                task.run.failure_told = True
                raise self._error(failure.error_code, failure.bare_message, done)
            if task.is_running and task.run.finished:
                raise self._error(DAQmxErrors.SAMPLES_CAN_NOT_YET_BE_WRITTEN, "the output has ended", done)
            take = min(room(), wanted - done)
            if take > 0:
                buffer.write(samples[:, done : done + take], task.is_running)
                done += take
            if done == wanted:
                return done
            left = timeout if timeout < 0 else max(0.0, timeout - (chassis.clock.now(chassis) - began))
            if not task.is_running or not chassis.clock.wait(
                chassis, lambda: task.run.finished or room() >= piece(), lambda: piece() - room(), left
            ):
                raise self._error(
                    DAQmxErrors.SAMPLES_CAN_NOT_YET_BE_WRITTEN,
                    f"{done} of {wanted} samples per channel found room in the buffer within {timeout:g} "
                    "s: start "
                    "the task, write less at a time, or enlarge out_stream.output_buf_size",
                    done,
                )

    def _error(self, code: int, message: str, done: int) -> DaqWriteError:
        return DaqWriteError(message, code, done, self._task.name)
