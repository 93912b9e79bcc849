"""Workers that compute the independent pieces of a study: processes of this machine, or a Dask cluster.

A piece is the argument of a module-level function. Function, piece and result are sent between process and worker, so
that the machines of a cluster need to share only the folder of recordings. The result does not depend on the worker.
"""

from __future__ import annotations

import logging
import os
import signal
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, closing, contextmanager, suppress
from multiprocessing import parent_process
from multiprocessing.context import SpawnContext
from multiprocessing.process import BaseProcess
from multiprocessing.resource_tracker import ensure_running
from multiprocessing.synchronize import Semaphore
from queue import Empty, SimpleQueue
from threading import Thread, current_thread, main_thread
from time import monotonic, sleep
from types import TracebackType
from typing import Any, TypeVar

from rig.core.base.ending_signals import TERMINATION_SIGNALS
from rig.core.base.errors import RunError, SceneError

Piece = TypeVar("Piece")
Result = TypeVar("Result")

#: Whether pieces are computed in this process, because it shares each of them with other MPI ranks
#: (`rig.extras.grains.ranks.join`).
SERIAL = False
#: Number of times that the workers are restarted after one of them ended unexpectedly.
MAX_RESTARTS = 2
# A killed worker's exit code is awaited for at most this time, s.
_EXIT_CODE_TIMEOUT_S = 1.0
# The workers of a cluster are counted after this time without a result.
_WORKER_CHECK_INTERVAL_S = 5.0


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

    `cluster`: address of a running Dask scheduler, or "local" to start a local cluster; None: processes of this
    machine, one for each core, or only this process if `SERIAL`.
    Raises `SceneError` if no cluster answers at this address, or Dask is not installed.
    """

    def __init__(self, cluster: str | None = None) -> None:
        self._cluster = cluster
        self._client: Any = None
        self._has_warned = False
        self._cleanup = ExitStack()
        try:
            self._pool = self._start()
        except BaseException:
            self._cleanup.close()
            raise

    def __enter__(self) -> Workers:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._cleanup.close()

    def compute(self, function: Callable[[Piece], Result], pieces: Sequence[Piece]) -> Iterator[tuple[int, Result]]:
        """Start the pieces in order; yield the index and result of each when it is complete.

        Further pieces may be appended during the iteration.

        Raises `RunError` if workers repeatedly end unexpectedly. An exception raised by `function` is passed on.
        """
        if self._cluster is None and SERIAL:
            # This includes pieces that are appended during the iteration.
            yield from enumerate(map(function, pieces))
            return
        completed: set[int] = set()
        for _ in range(MAX_RESTARTS + 1):
            jobs: dict[Future[Result], int] = {}
            finished: SimpleQueue[Future[Result]] = SimpleQueue()
            submitted = 0
            try:
                while len(completed) < len(pieces):
                    # An interrupt while a process starts would leave it with half of its pipes.
                    with _deferred_signals(), _without_main_module(), _blocked_sigint():
                        for number in (n for n in range(submitted, len(pieces)) if n not in completed):
                            job = self._pool.submit(function, pieces[number])
                            jobs[job] = number
                            job.add_done_callback(finished.put)
                    submitted = len(pieces)
                    job = self._wait_for_next(finished)
                    result = self._result(job)
                    completed.add(jobs[job])
                    yield jobs.pop(job), result
                return
            except BrokenProcessPool:
                self._cleanup.close()
                self._pool = self._start()
            finally:
                for job in jobs:
                    job.cancel()
        raise RunError(
            f"a process that computed part of the study ended unexpectedly {MAX_RESTARTS + 1} "
            "times, possibly because memory ran out. Close other programs, or make the study smaller."
        )

    def _result(self, job: Future[Result]) -> Result:
        """Return the result of a finished piece; raise `RunError` if it repeatedly ended the workers of a cluster."""
        if self._cluster is None:
            return job.result()
        from distributed import KilledWorker

        try:
            return job.result()
        except KilledWorker as error:
            raise RunError(
                f"`cluster` {self._cluster}: the workers of a part of the study ended several times, possibly because "
                f"memory ran out ({error}). Give the workers more memory, or make the study smaller."
            ) from None

    def _wait_for_next(self, finished: SimpleQueue[Future[Result]]) -> Future[Result]:
        """Wait for a finished piece; warn once if the cluster has no workers."""
        while self._cluster is not None:
            with suppress(Empty):
                return finished.get(timeout=_WORKER_CHECK_INTERVAL_S)
            if not self._has_warned and not self._client.nthreads():
                warnings.warn(
                    f"`cluster` {self._cluster}: the scheduler has no workers. The study waits; start a worker with: "
                    f"dask worker {self._client.scheduler.address} --nthreads 1",
                    stacklevel=2,
                )
                self._has_warned = True
        return finished.get()

    def _start(self) -> Executor:
        """Start the workers; `_cleanup` ends them."""
        if self._cluster is None:
            return _start_processes(self._cleanup)
        self._client = _connect_to_dask(self._cluster, self._cleanup)
        pool: Executor = self._client.get_executor()
        return pool


class _OwnProcesses(SpawnContext):
    """Context of new processes that lists them, so that processes of others are not ended with the pool."""

    def __init__(self) -> None:
        super().__init__()
        self.started: list[BaseProcess] = []

    def Process(self, *args: Any, **kwargs: Any) -> Any:  # type: ignore[override]  # noqa: N802
        process = super().Process(*args, **kwargs)
        self.started.append(process)
        return process


def _start_processes(cleanup: ExitStack) -> Executor:
    """Start worker processes of this machine."""
    context = _OwnProcesses()
    with _deferred_signals():
        pool = ProcessPoolExecutor(
            cores(), mp_context=context, initializer=_initialize_worker, initargs=(context.Semaphore(1),)
        )

    @_deferred_signals()
    def end() -> None:
        # Waiting pieces are canceled before the workers end, because the pool would otherwise notify them.
        pool.shutdown(wait=False, cancel_futures=True)
        workers = [process for process in context.started if process.pid is not None]
        for worker in workers:
            worker.kill()
        for worker in workers:
            worker.join()
            # The pool's thread also waits for the process; `exitcode` is None until that wait has returned.
            deadline = monotonic() + _EXIT_CODE_TIMEOUT_S
            while worker.exitcode is None and monotonic() < deadline:
                sleep(1e-3)

    cleanup.callback(end)
    return pool


@contextmanager
def _without_main_module() -> Iterator[None]:
    """Prevent new processes from importing the user's script, which they do not need."""
    script: dict[str, Any] = vars(sys.modules["__main__"])
    removed: dict[str, Any] = {name: script.pop(name) for name in ("__file__", "__spec__") if name in script}
    script["__spec__"] = None
    try:
        yield
    finally:
        script.update(removed)


@contextmanager
def _blocked_sigint() -> Iterator[None]:
    """Block Ctrl-C in new processes from their start, because a terminal sends it to all processes."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    # The resource tracker is started first, because Python unblocks Ctrl-C when it starts it.
    ensure_running()
    previous_mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, previous_mask)


@contextmanager
def _deferred_signals() -> Iterator[None]:
    """Defer signals until the end of the body, so that it is not interrupted in an incomplete state."""
    if current_thread() is not main_thread():
        yield
        return
    received: list[int] = []
    handlers = {number: signal.getsignal(number) for number in TERMINATION_SIGNALS}
    for number in handlers:
        signal.signal(number, lambda number, _: received.append(number))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        if received:
            signal.raise_signal(received[0])


def _initialize_worker(first: Semaphore) -> None:
    """Initialize a worker: a single thread for linear algebra; signals are handled by the parent.

    `first`: acquired by the first worker. Only this worker reports that it compiles, because all compile the same.
    """
    if not first.acquire(block=False):
        logging.getLogger("shotrig.compiling").setLevel(logging.ERROR)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this process as soon as its parent has ended."""
    parent = parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _close_cluster(cluster: Any) -> None:
    """Close a local cluster; Dask fails with an assertion if it is starting a worker again at this moment."""
    with suppress(AssertionError):
        cluster.close()


def _connect_to_dask(address: str, cleanup: ExitStack) -> Any:
    """Connect to a Dask cluster and return its client."""
    try:
        from distributed import Client, LocalCluster
    except ImportError:
        raise SceneError("`cluster`: Dask is not installed. Run pip install 'shotrig[cluster]'.") from None
    scheduler: Any = address
    if address == "local":
        with _deferred_signals(), _blocked_sigint():
            try:
                cluster = LocalCluster(
                    n_workers=cores(), threads_per_worker=1, host="127.0.0.1", dashboard_address="127.0.0.1:0"
                )
            except RuntimeError as error:
                raise RunError(
                    f"`cluster` local: the workers did not start ({error}). Leave out `cluster` to compute without "
                    "Dask."
                ) from None
            cleanup.callback(_close_cluster, cluster)
            scheduler = cluster
    try:
        client = cleanup.enter_context(closing(Client(scheduler, timeout=10)))
    except (OSError, ValueError) as error:
        raise SceneError(
            f"`cluster` {address}: no Dask scheduler answers ({error}). Give its address, such as "
            "tcp://host:8786, or local."
        ) from None
    return client
