"""MPI ranks (processes) of one command, as started by `mpiexec -n 4 rig simulate SCENE`.

The first rank runs the command. A `Shared` object, such as a bed of grains, has a part on each rank. If the first rank
calls a method of the object or reads an attribute, all ranks do so on their parts; no other data is exchanged.
Everything else is computed once, on the first rank. Ranks on several machines therefore need neither a common folder
nor processors with identical rounding.
"""

from __future__ import annotations

import atexit
import os
import select
import signal
import stat
import sys
import time
import weakref
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from rig.core.base.ending_signals import TERMINATION_SIGNALS
from rig.core.base.errors import RunError, SceneError, ShotrigError

if TYPE_CHECKING:
    from rig.core.base.arrays import Array

#: Environment variables with the number of processes: MPICH and its derivatives, and Open MPI.
_COUNT_VARIABLES = ("PMI_SIZE", "OMPI_COMM_WORLD_SIZE")
#: Communicator of all ranks (mpi4py); None in a single process.
_world: Any = None
#: Communicator of the ranks on this machine.
_machine: Any = None
#: Parts of shared objects on this rank, by the number of the object.
_parts: dict[int, Any] = {}
_numbers: Iterator[int] = count()
#: Numbers of shared objects that the first rank has released.
_released: list[int] = []
#: Exit code of all ranks if the first rank ends during a collective operation; 0 outside collective operations.
_abort_code = 0


class OneRankError(RunError):
    """An error on a single rank, while the other ranks wait for it."""


def rank_count() -> int:
    """Return the number of ranks that share objects; 1 for a single process."""
    return 1 if _world is None else int(_world.size)


def ranks_on_machine() -> int:
    """Return the number of ranks on this machine."""
    return 1 if _machine is None else int(_machine.size)


def join() -> None:
    """Join ranks started by mpiexec, if any. The first rank returns; the other ranks serve it, and end when it ends.

    Raises `SceneError` if mpiexec belongs to a different MPI implementation.
    """
    global _world, _machine
    counts = [os.environ.get(name, "") for name in _COUNT_VARIABLES]
    n_started = max((int(text) for text in counts if text.isdecimal()), default=1)
    # Without mpi4py, objects cannot be shared: each process runs the command separately; only grains need MPI.
    if n_started < 2 or _world is not None or find_spec("mpi4py") is None:
        return
    mpi = communicators()
    world = mpi.COMM_WORLD
    if world.size != n_started:
        raise SceneError(
            f"mpiexec has started {n_started} processes, which the MPI of this environment cannot join. Use its own "
            f"mpiexec, {Path(sys.prefix) / 'bin' / 'mpiexec'}."
        )
    _world, _machine = world, world.Split_type(mpi.COMM_TYPE_SHARED)
    # Every command imports this module, and few need workers.
    from rig.core.base import workers

    workers.SERIAL = True
    # Child processes must not join the ranks.
    for name in [name for name in os.environ if name.startswith(("PMI_", "OMPI_"))]:
        del os.environ[name]
    if world.rank > 0:
        _serve_first_rank()
    atexit.register(_end_other_ranks)


def communicators() -> Any:
    """Return `mpi4py.MPI`; raise `SceneError` if it is not installed."""
    try:
        from mpi4py import MPI
    except ImportError as error:
        raise SceneError(
            f"a bed of grains on several MPI processes needs mpi4py ({error}). Run pip install 'shotrig[grains]', or "
            "run the command without mpiexec."
        ) from None
    return MPI


def sum_over_ranks(values: Array) -> Array:
    """Sum arrays over all ranks; a collective operation."""
    result = values.copy()
    _world.Allreduce(values, result)
    return result


class Shared:
    """An object that is divided among all ranks (processes); calls and attribute accesses are executed on each rank.

    `make`: returns the part of a rank. The function must be picklable, as must all arguments of calls; `*arguments`:
    arguments of `make`.
    """

    def __init__(self, make: Callable[..., Any], *arguments: Any) -> None:
        self._number = next(_numbers)
        _execute_on_all_ranks(self._number, None, (make, *arguments))
        weakref.finalize(self, _released.append, self._number).atexit = False

    def __getattr__(self, name: str) -> Any:
        if callable(getattr(type(_parts[self._number]), name, None)):
            # The function refers to this object, so its parts exist until the call.
            return lambda *arguments: _execute_on_all_ranks(self._number, name, arguments)
        return _execute_on_all_ranks(self._number, name, None)


def _execute_on_all_ranks(number: int, name: str | None, arguments: tuple[Any, ...] | None) -> Any:
    """Execute an operation on the parts of all ranks; return the result of this rank."""
    global _abort_code
    call = (list(_released), number, name, arguments)
    try:
        _abort_code = 1
        _world.bcast(call)
        del _released[: len(call[0])]
        result = _execute_on_this_rank(*call)
    except OneRankError:
        raise
    except ShotrigError:
        _abort_code = 0
        raise
    except KeyboardInterrupt:
        _abort_code = 130
        raise
    _abort_code = 0
    return result


def _execute_on_this_rank(released: list[int], number: int, name: str | None, arguments: tuple[Any, ...] | None) -> Any:
    """Execute an operation on the part of this rank: create it, call a method, or read an attribute."""
    for released_number in released:
        del _parts[released_number]
    if arguments is None:
        return getattr(_parts[number], str(name))
    if name is not None:
        return getattr(_parts[number], name)(*arguments)
    make, *settings = arguments
    _parts[number] = make(*settings)
    return None


def _serve_first_rank() -> NoReturn:
    """Execute the operations that the first rank broadcasts, until the first rank ends."""
    # The first rank handles termination signals.
    for number in TERMINATION_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    try:
        while (call := _world.bcast(None)) is not None:
            try:
                _execute_on_this_rank(*call)
            except OneRankError:
                raise
            except ShotrigError:
                # The operation failed on all ranks, and the first rank reports the error.
                continue
    except OneRankError as error:
        print(f"error: {error}", file=sys.stderr)
        _abort(error.exit_code)
    except BaseException:
        # Imported here, because every command imports this module and few need it.
        import traceback

        traceback.print_exc()
        _abort(1)
    sys.exit(0)


def _end_other_ranks() -> None:
    """End the other ranks normally, or abort them if they wait in an incomplete collective operation."""
    if _abort_code:
        _abort(_abort_code)
    _world.bcast(None)


def _abort(code: int) -> None:
    """Abort all ranks after mpiexec has read the output of this rank; mpiexec discards output after an abort."""
    sys.stdout.flush()
    sys.stderr.flush()
    await_reader(1)
    await_reader(2)
    _world.Abort(code)


def await_reader(descriptor: int, timeout_s: float = 60.0) -> None:
    """Wait until all data in a pipe has been read or its reader has closed it, for at most `timeout_s` seconds.

    Returns immediately for files and terminals.
    """
    # Imported here: only a failing rank needs these modules, and not every system has them.
    try:
        import fcntl
        import termios
    except ImportError:
        return
    try:
        if not stat.S_ISFIFO(os.fstat(descriptor).st_mode):
            return
        poll = select.poll()
        poll.register(descriptor, 0)
        deadline = time.monotonic() + timeout_s
        while any(fcntl.ioctl(descriptor, termios.FIONREAD, bytes(4))) and time.monotonic() < deadline:
            # poll returns before its timeout of 1 ms only if the reader has closed the pipe.
            if poll.poll(1):
                return
    except OSError:
        return
