"""Workers compute each piece of a study once, and no process remains."""

from __future__ import annotations

import multiprocessing
import signal
import subprocess
import sys
import threading
import warnings
from multiprocessing.context import SpawnProcess
from pathlib import Path

import dask
import psutil
import pytest
from distributed import LocalCluster

from rig.core.base.errors import RunError, SceneError
from rig.core.base.workers import Workers, free_cores
from tests.rig.worker_pieces import (
    exit_at_first_call,
    exit_process,
    log_compilation,
    sigint_is_blocked,
    square,
    wait_forever_unless_zero,
)


class ClusterWithCtrlC:
    """A Dask cluster that receives Ctrl-C while its workers start."""

    closed = 0

    def __init__(self, **_: object) -> None:
        signal.raise_signal(signal.SIGINT)

    def close(self) -> None:
        ClusterWithCtrlC.closed += 1


def test_each_piece_is_computed_once() -> None:
    with Workers() as workers:
        squares = list(workers.compute(square, range(20)))
        second = list(workers.compute(square, [7]))

    assert sorted(squares) == [(k, k * k) for k in range(20)]
    assert second == [(0, 49)]
    assert not multiprocessing.active_children()


def test_interrupt_does_not_stop_the_start_of_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    started = []
    workers = Workers()
    submit = workers._pool.submit

    def interrupted_submit(*arguments: object) -> object:
        signal.raise_signal(signal.SIGTERM)
        started.append(arguments)
        return submit(*arguments)

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(workers._pool, "submit", interrupted_submit)
    previous = signal.signal(signal.SIGTERM, interrupt)
    try:
        with pytest.raises(KeyboardInterrupt), workers:
            list(workers.compute(square, [1, 2]))
    finally:
        signal.signal(signal.SIGTERM, previous)
    assert len(started) == 2 and not multiprocessing.active_children()


def test_appended_pieces_are_computed_as_well() -> None:
    pieces = [2]
    with Workers() as workers:
        for _, result in workers.compute(square, pieces):
            if result < 100:
                pieces.append(result)

    assert pieces == [2, 4, 16]


@pytest.mark.parametrize(("load", "free"), [(0.0, 2.0), (2.0, 1.0), (14.0, 0.25)])
def test_load_of_other_programs_takes_cores(load: float, free: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rig.core.base.workers.cores", lambda: 2)
    monkeypatch.setattr("os.getloadavg", lambda: (load, 0.0, 0.0))
    assert free_cores() == free


def test_one_worker_reports_that_it_compiles(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("rig.core.base.workers.cores", lambda: 2)
    with Workers() as workers:
        assert len(list(workers.compute(log_compilation, [tmp_path] * 2))) == 2

    assert capfd.readouterr().err.count("compiling") == 1


def test_workers_end_no_other_process() -> None:
    with Workers() as workers:
        other = multiprocessing.get_context("spawn").Process(target=wait_forever_unless_zero, args=(1,))
        other.start()
        assert list(workers.compute(square, [3])) == [(0, 9)]

    assert other.is_alive()
    other.kill()
    other.join()


def test_workers_do_not_rerun_the_script(tmp_path: Path) -> None:
    script = tmp_path / "study.py"
    script.write_text(
        "from rig.core.base.workers import Workers\nprint('begun')\n"
        "with Workers() as workers:\n    print(sorted(workers.compute(len, ['a', 'bb'])))\n"
    )
    process = subprocess.run([sys.executable, script], capture_output=True, text=True, check=True)
    assert process.stdout.splitlines() == ["begun", "[(0, 1), (1, 2)]"]


def test_failing_piece_raises_and_leaves_no_process() -> None:
    with pytest.raises(SceneError, match="-3: expected"), Workers() as workers:
        list(workers.compute(square, [1, -3, 2]))

    assert not multiprocessing.active_children()


def test_pieces_of_ended_workers_are_repeated(tmp_path: Path) -> None:
    markers = [tmp_path / "one", tmp_path / "two"]
    markers[0].touch()
    with Workers() as workers:
        assert sorted(workers.compute(exit_at_first_call, markers)) == [(0, "one"), (1, "two")]


def test_piece_that_ends_workers_is_reported() -> None:
    with pytest.raises(RunError, match="ended unexpectedly 3 times"), Workers() as workers:
        list(workers.compute(exit_process, [1]))


def test_leaving_the_context_cancels_waiting_pieces(monkeypatch) -> None:
    thread_errors: list[object] = []
    monkeypatch.setattr(threading, "excepthook", thread_errors.append)
    kill = SpawnProcess.kill

    def kill_and_wait_for_executor(process: SpawnProcess) -> None:
        kill(process)
        # Wait until the thread of the executor has handled the end of the process.
        for thread in threading.enumerate():
            if hasattr(thread, "terminate_broken"):
                thread.join()

    monkeypatch.setattr(SpawnProcess, "kill", kill_and_wait_for_executor)
    with Workers() as workers:
        next(workers.compute(wait_forever_unless_zero, range(50)))

    assert not thread_errors


@pytest.mark.skipif(not hasattr(signal, "pthread_sigmask"), reason="signals cannot be blocked on this system")
def test_workers_block_ctrl_c() -> None:
    with Workers() as workers:
        assert list(workers.compute(sigint_is_blocked, [1])) == [(0, True)]
    assert not sigint_is_blocked(0)


def test_ctrl_c_closes_a_starting_cluster(monkeypatch) -> None:
    monkeypatch.setattr("distributed.LocalCluster", ClusterWithCtrlC)
    with pytest.raises(KeyboardInterrupt):
        Workers("local")
    assert ClusterWithCtrlC.closed == 1 and not sigint_is_blocked(0)


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_cluster_without_workers_is_reported(monkeypatch) -> None:
    monkeypatch.setattr("rig.core.base.workers._WORKER_CHECK_INTERVAL_S", 0.05)
    with LocalCluster(n_workers=0, threads_per_worker=1, processes=False, dashboard_address=None) as cluster:
        reported: list[str] = []

        def start_a_worker(message: Warning | str, *_: object, **__: object) -> None:
            reported.append(str(message))
            cluster.scale(1)

        with warnings.catch_warnings(), Workers(cluster.scheduler_address) as workers:
            warnings.showwarning = start_a_worker
            warnings.simplefilter("always", UserWarning)
            assert sorted(workers.compute(square, [2, 3])) == [(0, 4), (1, 9)]
    (message,) = [text for text in reported if "no workers" in text]
    assert f"dask worker {cluster.scheduler_address}" in message


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_dask_cluster_gives_the_same_results() -> None:
    with Workers("local") as workers:
        assert sorted(workers.compute(square, range(20))) == [(k, k * k) for k in range(20)]


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_piece_that_ends_cluster_workers_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    # One worker, which is restarted once: each start takes a second.
    monkeypatch.setattr("rig.core.base.workers.cores", lambda: 1)
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 1}),
        Workers("local") as workers,
        pytest.raises(RunError, match="`cluster` local: the workers of a part of the study ended"),
    ):
        list(workers.compute(exit_process, [1]))


@pytest.mark.thorough
def test_missing_scheduler_is_reported() -> None:
    with pytest.raises(SceneError, match="no Dask scheduler answers"):
        Workers("tcp://127.0.0.1:9")


@pytest.mark.thorough
def test_local_cluster_listens_on_loopback_only() -> None:
    def listening() -> set[tuple[int, str, int]]:
        own = psutil.Process()
        return {
            (process.pid, connection.laddr.ip, connection.laddr.port)
            for process in (own, *own.children(recursive=True))
            for connection in process.net_connections("tcp")
            if connection.status == psutil.CONN_LISTEN
        }

    # Clusters of other tests in this process may still be closing.
    earlier = listening()
    with Workers("local") as workers:
        list(workers.compute(square, [1]))
        opened = listening() - earlier
    assert {address for _, address, _ in opened} == {"127.0.0.1"}
