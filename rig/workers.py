"""Workers for the independent pieces of a study: processes of this machine, or a Dask cluster.

A piece is the argument of a module-level function. Function, piece and result are sent between process and worker, so
that only the folder of recordings has to be shared. The result of a piece does not depend on the worker.
"""

from __future__ import annotations

import os
import signal
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, closing, contextmanager, suppress
from multiprocessing import active_children, get_context, parent_process
from multiprocessing.resource_tracker import ensure_running
from queue import Empty, SimpleQueue
from threading import Thread, current_thread, main_thread
from time import sleep
from types import TracebackType
from typing import Any, TypeVar

from rig.ending_signals import ENDINGS
from rig.errors import RunError, SceneError
from rig.ranks import size

Piece = TypeVar("Piece")
Result = TypeVar("Result")

#: Number of times that pieces are recomputed after a worker ended unexpectedly.
LIVES = 2
# Time for the thread of the pool to detect that a worker has been killed, ms.
_PATIENCE = 1000
# Seconds without a result after which a cluster's workers are counted.
_WITHOUT_WORKERS = 5.0


def cores() -> int:
    """Return the number of cores available to this process."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Workers:
    """Workers that compute pieces of a study; leaving the context ends them immediately.

    `cluster`: address of a running Dask scheduler, or "local" to start a local cluster; None: processes of this
    machine, one for each core, or only this process if it shares each piece with other MPI ranks (`rig.ranks`).
    Raises `SceneError` if there is no such cluster, or Dask is not installed.
    """

    def __init__(self, cluster: str | None = None) -> None:
        self._cluster = cluster
        self._client: Any = None
        self._reported = False
        self._open = ExitStack()
        try:
            self._pool = self._start()
        except BaseException:
            self._open.close()
            raise

    def __enter__(self) -> Workers:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open.close()

    def compute(
        self, function: Callable[[Piece], Result], pieces: Sequence[Piece]
    ) -> Iterator[tuple[int, Result]]:
        """Compute the pieces in order; yield the number and result of each when it is complete.

        Further pieces may be appended during the iteration.

        Raises `RunError` if workers repeatedly end unexpectedly. Raises `Exception`: the exception of a piece.
        """
        if self._cluster is None and size() > 1:
            # This includes pieces that are appended during the iteration.
            yield from enumerate(map(function, pieces))
            return
        done: set[int] = set()
        for _ in range(LIVES + 1):
            jobs: dict[Future[Result], int] = {}
            finished: SimpleQueue[Future[Result]] = SimpleQueue()
            handed_out = 0
            try:
                while len(done) < len(pieces):
                    with _script_left_alone(), _deaf_to_ctrl_c():
                        for number in sorted({*range(handed_out, len(pieces))} - done):
                            job = self._pool.submit(function, pieces[number])
                            jobs[job] = number
                            job.add_done_callback(finished.put)
                    handed_out = len(pieces)
                    job = self._next(finished)
                    result = job.result()
                    done.add(jobs[job])
                    yield jobs.pop(job), result
                return
            except BrokenProcessPool:
                self._open.close()
                self._pool = self._start()
            finally:
                for job in jobs:
                    job.cancel()
        raise RunError(
            f"a process that computed one of {len(pieces) - len(done)} pieces has died {LIVES + 1} "
            "times, possibly because memory ran out. Close other programs, or make the study smaller."
        )

    def _next(self, finished: SimpleQueue[Future[Result]]) -> Future[Result]:
        """Wait for a finished piece; report once if the cluster has no workers."""
        while self._cluster is not None:
            with suppress(Empty):
                return finished.get(timeout=_WITHOUT_WORKERS)
            if self._client.nthreads():
                break
            if not self._reported:
                warnings.warn(
                    f"--cluster {self._cluster}: the scheduler has no workers. The study waits for one; start it with: "
                    f"dask worker {self._client.scheduler.address} --nthreads 1",
                    stacklevel=2,
                )
                self._reported = True
        return finished.get()

    def _start(self) -> Executor:
        if self._cluster is None:
            return _processes(self._open)
        self._client = _dask(self._cluster, self._open)
        pool: Executor = self._client.get_executor()
        return pool


def _processes(until: ExitStack) -> Executor:
    before = set(active_children())
    pool = ProcessPoolExecutor(cores(), mp_context=get_context("spawn"), initializer=_begin)

    def end() -> None:
        # Waiting pieces are cancelled before the workers end, because the pool would otherwise notify them.
        pool.shutdown(wait=False, cancel_futures=True)
        workers = set(active_children()) - before
        for worker in workers:
            worker.kill()
        for worker in workers:
            worker.join()
            # The thread of the pool may detect the end first; wait until it has done so.
            for _ in range(_PATIENCE):
                if worker.exitcode is not None:
                    break
                sleep(1e-3)

    until.callback(end)
    return pool


@contextmanager
def _script_left_alone() -> Iterator[None]:
    """Prevent new processes from importing the user's script, which they do not need."""
    script: dict[str, Any] = vars(sys.modules["__main__"])
    kept: dict[str, Any] = {name: script.pop(name) for name in ("__file__", "__spec__") if name in script}
    script["__spec__"] = None
    try:
        yield
    finally:
        script.update(kept)


@contextmanager
def _deaf_to_ctrl_c() -> Iterator[None]:
    """Block Ctrl-C in new processes from their start, because a terminal sends it to all processes."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    # The resource tracker is started first, because Python unblocks Ctrl-C when it starts it.
    ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _answering_later() -> Iterator[None]:
    """Defer signals until the end of the body, so that it is not interrupted in an incomplete state."""
    if current_thread() is not main_thread():
        yield
        return
    came: list[int] = []
    before = {number: signal.getsignal(number) for number in ENDINGS}
    for number in before:
        signal.signal(number, lambda number, _: came.append(number))
    try:
        yield
    finally:
        for number, answer in before.items():
            signal.signal(number, answer)
        for first in came[:1]:
            signal.raise_signal(first)


def _begin() -> None:
    """Initialize a worker: a single thread for linear algebra; signals are handled by the parent."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _dask(address: str, until: ExitStack) -> Any:
    try:
        from distributed import Client, LocalCluster
    except ImportError:
        raise SceneError("--cluster needs Dask: pip install 'shotrig[cluster]'") from None
    where: Any = address
    if address == "local":
        with _answering_later(), _deaf_to_ctrl_c():
            try:
                cluster = LocalCluster(n_workers=cores(), threads_per_worker=1)
            except RuntimeError as error:
                raise RunError(f"--cluster local: its workers do not start ({error})") from None
            where = until.enter_context(closing(cluster))
    try:
        client = until.enter_context(closing(Client(where, timeout=10)))
    except (OSError, ValueError) as error:
        raise SceneError(
            f"--cluster {address}: no Dask scheduler answers ({error}); expected its address, such as "
            "tcp://host:8786, or local"
        ) from None
    return client
