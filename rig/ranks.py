"""Ranks of MPI, as `mpiexec -n 4 rig simulate SCENE` starts them: the first runs the command, all share objects.

Of an object that is `Shared` each rank holds a part. What the first does with it all do with theirs; nothing else goes
from rank to rank. So whatever has no parts is computed once, and ranks on several machines need neither a folder in
common nor processors that round alike.
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

from rig.ending_signals import ENDINGS
from rig.errors import RunError, SceneError, ShotrigError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

#: Where starters of processes say how many there are: those of MPICH and its kin, and that of Open MPI.
_STARTED = ("PMI_SIZE", "OMPI_COMM_WORLD_SIZE")
#: All ranks, as mpi4py knows them; None in a process by itself.
_world: Any = None
#: Those of them on this machine.
_near: Any = None
#: This rank's parts of what is shared, by number.
_parts: dict[int, Any] = {}
_numbers: Iterator[int] = count()
#: Numbers of shared objects that the first rank has let go.
_gone: list[int] = []
#: With which code to end where the first rank is in the middle of what the others do with it; 0 where it is not.
_midway = 0


class OneRankError(RunError):
    """What went wrong on this rank and on no other: the others wait for it."""


def size() -> int:
    """Count the ranks that share what this process shares: 1 of a process by itself."""
    return 1 if _world is None else int(_world.size)


def on_this_machine() -> int:
    """Count the ranks that run on this machine."""
    return 1 if _near is None else int(_near.size)


def join() -> None:
    """Join the ranks that mpiexec has started, if it has: the first returns, the others end here when it ends.

    Raises
    ------
    SceneError
        If mpiexec is that of another MPI.
    """
    global _world, _near
    said = [os.environ.get(name, "") for name in _STARTED]
    started = max((int(number) for number in said if number.isdecimal()), default=1)
    # Without mpi4py nothing can be shared: each process runs the command by itself, until it comes to grains.
    if started < 2 or _world is not None or find_spec("mpi4py") is None:
        return
    mpi = communicators()
    world = mpi.COMM_WORLD
    if world.size != started:
        raise SceneError(
            f"mpiexec has started {started} processes, which the MPI of this environment cannot join; expected its "
            f"own, {Path(sys.prefix) / 'bin' / 'mpiexec'}"
        )
    _world, _near = world, world.Split_type(mpi.COMM_TYPE_SHARED)
    # Processes that this one starts are by themselves.
    for name in [name for name in os.environ if name.startswith(("PMI_", "OMPI_"))]:
        del os.environ[name]
    if world.rank > 0:
        _follow()
    atexit.register(_end)


def communicators() -> Any:
    """Give `mpi4py.MPI`; raises `SceneError` if it is not installed."""
    try:
        from mpi4py import MPI
    except ImportError as error:
        raise SceneError(
            f"one bed of grains on several ranks needs mpi4py ({error}); expected: pip install 'shotrig[grains]', or "
            "the command without mpiexec"
        ) from None
    return MPI


def total(values: Array) -> Array:
    """Add up arrays of all ranks; each has to call it."""
    out = values.copy()
    _world.Allreduce(values, out)
    return out


class Shared:
    """An object of which each rank holds a part; whatever is called or looked at is so on every rank.

    Parameters
    ----------
    make : callable
        Gives a rank's part; it, as all that is given to parts, can be pickled.
    *given
        What it is called with.
    """

    def __init__(self, make: Callable[..., Any], *given: Any) -> None:
        self._number = next(_numbers)
        _on_all(self._number, None, (make, *given))
        weakref.finalize(self, _gone.append, self._number).atexit = False

    def __getattr__(self, name: str) -> Any:
        number = self._number
        if callable(getattr(type(_parts[number]), name, None)):
            return lambda *given: _on_all(number, name, given)
        return _on_all(number, name, None)


def _on_all(number: int, name: str | None, given: tuple[Any, ...] | None) -> Any:
    """Have all ranks do something with their parts; gives what this one's says."""
    global _midway
    call = (list(_gone), number, name, given)
    try:
        _midway = 1
        _world.bcast(call)
        del _gone[: len(call[0])]
        answer = _do(*call)
    except OneRankError:
        raise
    except ShotrigError:
        _midway = 0
        raise
    except KeyboardInterrupt:
        _midway = 130
        raise
    _midway = 0
    return answer


def _do(gone: list[int], number: int, name: str | None, given: tuple[Any, ...] | None) -> Any:
    """Do with this rank's part what all do: make it, call it, or look at it."""
    for each in gone:
        del _parts[each]
    if given is None:
        return getattr(_parts[number], str(name))
    if name is not None:
        return getattr(_parts[number], name)(*given)
    make, *settings = given
    _parts[number] = make(*settings)
    return None


def _follow() -> NoReturn:
    """Do what the first rank says until it ends."""
    # It answers what asks for an end.
    for number in ENDINGS:
        signal.signal(number, signal.SIG_IGN)
    try:
        while (call := _world.bcast(None)) is not None:
            try:
                _do(*call)
            except OneRankError:
                raise
            except ShotrigError:
                # It failed on all ranks alike, and the first one reports it.
                continue
    except OneRankError as error:
        print(f"error: {error}", file=sys.stderr)
        _abort(error.exit_code)
    except BaseException:
        # Every command imports this module, and hardly one needs that.
        import traceback

        traceback.print_exc()
        _abort(1)
    sys.exit(0)


def _end() -> None:
    """Let the other ranks end, or end them where they wait for what will not come."""
    if _midway:
        _abort(_midway)
    _world.bcast(None)


def _abort(code: int) -> None:
    """End all ranks, once mpiexec has read what this one has written: it drops the rest of an aborted rank's output."""
    sys.stdout.flush()
    sys.stderr.flush()
    await_reader(1)
    await_reader(2)
    _world.Abort(code)


def await_reader(descriptor: int, longest: float = 60.0) -> None:
    """Wait until all that was written to a pipe is read, or its reader is gone; at most so many seconds.

    What is no pipe, such as a file or a terminal, has nothing to wait for.
    """
    # Only a rank that fails needs them, and not every system has them.
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
        end = time.monotonic() + longest
        while any(fcntl.ioctl(descriptor, termios.FIONREAD, bytes(4))) and time.monotonic() < end:
            # Only an error, that nobody reads any more, ends this before its millisecond is over.
            if poll.poll(1):
                return
    except OSError:
        return
