"""Workers that compute the independent pieces of a study: processes of this machine, or a Dask cluster.

A piece is the argument of a module-level function. Function, piece and result are sent between process and worker, so
the machines of a cluster need no common folder, except that of recordings. The result does not depend on the worker.
"""

import logging
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager
from functools import partial
from multiprocessing import resource_tracker
from multiprocessing.synchronize import Semaphore
from queue import SimpleQueue
from threading import Thread
from typing import Any, Self, TypeVar

from rig.core.base.errors import RunError, SceneError

Piece = TypeVar("Piece")
Result = TypeVar("Result")

#: Whether pieces are computed in this process, because it shares each of them with other MPI ranks
#: (`rig.extras.grains.ranks.join`).
SERIAL = False
# Windows has none.
_HAS_SIGNAL_MASKS = hasattr(signal, "pthread_sigmask")
# Longest time until a cluster answers, even over a slow network [s].
_CONNECTION_TIMEOUT_S = 10.0
# Longest time until a cluster starts its first worker [s].
_FIRST_WORKER_TIMEOUT_S = 30.0


def cores() -> int:
    """Return the number of cores available to this process."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def free_cores() -> float:
    """Return the number of cores that a study gets while other programs run."""
    # The operating system shares the cores equally among all running processes.
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    return cores() ** 2 / (cores() + load)


class Workers:
    """Workers that compute pieces of a study; leaving the context ends them immediately.

    `cluster`: address of a running Dask scheduler; None: processes of this machine, one for each core, or only this
    process if `SERIAL`.
    Raises `SceneError` if no cluster with workers answers at this address, or Dask is not installed.
    """

    def __init__(self, cluster: str | None = None) -> None:
        self._cluster = cluster
        with ExitStack() as cleanup:
            self._pool = self._start(cleanup)
            self._cleanup = cleanup.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._cleanup.close()

    def compute(self, function: Callable[[Piece], Result], pieces: Sequence[Piece]) -> Iterator[tuple[int, Result]]:
        """Start the pieces in order; yield the index and result of each when it is complete.

        Further pieces may be appended during the iteration.

        Raises `RunError` if a worker ends unexpectedly. An exception raised by `function` is passed on.
        """
        if self._pool is None:
            # The loop includes pieces that are appended during the iteration.
            yield from enumerate(map(function, pieces))
            return
        jobs: dict[Future[Result], int] = {}
        finished: SimpleQueue[Future[Result]] = SimpleQueue()
        n_submitted = n_completed = 0
        while n_completed < len(pieces):
            with _interrupts_blocked():
                for number in range(n_submitted, len(pieces)):
                    job = self._pool.submit(function, pieces[number])
                    jobs[job] = number
                    job.add_done_callback(finished.put)
            n_submitted = len(pieces)
            job = finished.get()
            n_completed += 1
            yield jobs.pop(job), self._result(job)

    def _result(self, job: Future[Result]) -> Result:
        """Return the result of a finished job; raise `RunError` if its worker process ended unexpectedly."""
        try:
            return job.result()
        except Exception as error:
            if not isinstance(error, _end_of_worker(self._cluster)):
                raise
            place = "" if self._cluster is None else f"`cluster` {self._cluster}: "
            raise RunError(
                f"{place}a worker that computed a part of the study ended unexpectedly, possibly because memory ran "
                "out. Close other programs, or make the study smaller, and repeat the command: a study with a table "
                "continues where it stopped."
            ) from None

    def _start(self, cleanup: ExitStack) -> Executor | None:
        """Start the workers, which `cleanup` ends; return None if this process computes all pieces."""
        if self._cluster is not None:
            return _connect_to_dask(self._cluster, cleanup)
        return None if SERIAL else _start_processes(cleanup)


def _end_of_worker(cluster: str | None) -> type[Exception]:
    """Return the error of a piece whose worker ended."""
    if cluster is None:
        return BrokenProcessPool
    from distributed import KilledWorker

    return KilledWorker


def _start_processes(cleanup: ExitStack) -> Executor:
    """Start worker processes of this machine; they import the modules of the functions, but not the user's script."""
    from loky import ProcessPoolExecutor
    from loky.backend import get_context
    from loky.backend import resource_tracker as loky_tracker

    if _HAS_SIGNAL_MASKS:
        # They unblock Ctrl-C when they start, so they start before the workers.
        for tracker in (loky_tracker, resource_tracker):
            tracker.ensure_running()
    context = get_context("loky")
    pool = ProcessPoolExecutor(
        cores(), context=context, initializer=_initialize_worker, initargs=(os.getpid(), context.Semaphore(1))
    )
    cleanup.callback(partial(pool.shutdown, kill_workers=True))
    return pool


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Block Ctrl-C in this thread, and in the workers that it starts, which would report it while they import modules.

    A terminal sends Ctrl-C to all processes. It interrupts this process after the block.
    """
    if not _HAS_SIGNAL_MASKS:
        yield
        return
    previous = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, previous)


def _initialize_worker(parent: int, first: Semaphore) -> None:
    """Initialize a worker: one thread for linear algebra; the `parent` (process id) handles signals of the system.

    `first`: semaphore that one worker acquires, which reports the compilation.
    """
    # `_interrupts_blocked` blocks the signal until here.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Only the worker that acquires `first` reports that it compiles: all workers compile the same functions.
    if not first.acquire(block=False):
        logging.getLogger("shotrig.compiling").setLevel(logging.ERROR)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    Thread(target=_end_with_parent, args=(parent,), daemon=True).start()


def _end_with_parent(parent: int) -> None:
    """End this process as soon as its parent has ended, even if it computes a piece."""
    import psutil

    try:
        psutil.Process(parent).wait()
    finally:
        os._exit(1)


def _connect_to_dask(address: str, cleanup: ExitStack) -> Executor:
    try:
        from distributed import Client
    except ImportError:
        raise SceneError("`cluster`: Dask is not installed. Run pip install 'shotrig[cluster]'.") from None
    try:
        client: Any = Client(address, timeout=_CONNECTION_TIMEOUT_S)
    except (OSError, ValueError) as error:
        raise SceneError(
            f"`cluster` {address}: no Dask scheduler answers ({error}). Give its address, such as tcp://host:8786."
        ) from None
    cleanup.callback(client.close)
    try:
        client.wait_for_workers(1, timeout=_FIRST_WORKER_TIMEOUT_S)
    except TimeoutError:
        raise SceneError(
            f"`cluster` {address}: the scheduler has no workers. Start a worker: dask worker "
            f"{client.scheduler.address} --nthreads 1"
        ) from None
    pool: Executor = client.get_executor()
    return pool
