"""Workers compute each piece of a study once, and no process remains."""

import multiprocessing
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import dask
import psutil
import pytest
from distributed import LocalCluster

from rig.core.base.errors import RunError, SceneError
from rig.core.base.workers import Workers, free_cores
from tests.rig.worker_pieces import (
    exit_process,
    log_compilation,
    sigint_is_ignored,
    square,
    wait_forever_unless_zero,
)
from tests.rig.worker_processes import worker_processes


def test_each_piece_is_computed_once() -> None:
    with Workers() as workers:
        squares = list(workers.compute(square, range(20)))
        second = list(workers.compute(square, [7]))

    assert sorted(squares) == [(k, k * k) for k in range(20)]
    assert second == [(0, 49)]
    assert not worker_processes()


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


def test_one_worker_reports_that_it_compiles(tmp_path, monkeypatch, capfd):
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

    assert not worker_processes()


def test_piece_that_ends_workers_is_reported() -> None:
    with pytest.raises(RunError, match=r"a worker .* ended unexpectedly"), Workers() as workers:
        list(workers.compute(exit_process, [1]))


def test_workers_ignore_ctrl_c() -> None:
    with Workers() as workers:
        assert list(workers.compute(sigint_is_ignored, [1])) == [(0, True)]
    assert not sigint_is_ignored(0)


@pytest.mark.skipif(not hasattr(signal, "pthread_sigmask"), reason="Windows has no signal masks")
def test_starting_workers_have_ctrl_c_blocked() -> None:
    script = (
        "from rig.core.base.workers import Workers\n"
        "from tests.rig.worker_pieces import sigint_is_blocked\n"
        "with Workers() as workers: print(dict(workers.compute(sigint_is_blocked, [0, 1])), sigint_is_blocked(0))"
    )
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert run.stdout == "{0: True, 1: True} False\n"


def test_busy_workers_end_with_their_parent(tmp_path: Path) -> None:
    script = (
        "import sys\nfrom pathlib import Path\nfrom rig.core.base.workers import Workers\n"
        "from tests.rig.worker_pieces import write_id_and_wait\n"
        "with Workers() as workers:\n    list(workers.compute(write_id_and_wait, [Path(sys.argv[1])]))\n"
    )
    written = tmp_path / "id"
    parent = subprocess.Popen([sys.executable, "-c", script, str(written)])
    while not written.exists():
        os.sched_yield()
    worker = psutil.Process(int(written.read_text()))
    parent.kill()
    parent.wait()
    worker.wait(timeout=60.0)


@pytest.fixture
def scheduler() -> Iterator[str]:
    """Return the address of a Dask scheduler with two workers, each of which may end once."""
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 1}),
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
    ):
        yield cluster.scheduler_address


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_dask_cluster_gives_the_same_results(scheduler: str) -> None:
    with Workers(scheduler) as workers:
        assert sorted(workers.compute(square, range(20))) == [(k, k * k) for k in range(20)]


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_piece_that_ends_cluster_workers_is_reported(scheduler: str) -> None:
    with Workers(scheduler) as workers, pytest.raises(RunError, match=r"`cluster` tcp:.*: a worker .* ended"):
        list(workers.compute(exit_process, [1]))


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_cluster_without_workers_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rig.core.base.workers._FIRST_WORKER_TIMEOUT_S", 0.1)
    with (
        LocalCluster(n_workers=0, threads_per_worker=1, processes=False, dashboard_address=None) as cluster,
        pytest.raises(SceneError, match=rf"no workers\. .*dask worker {cluster.scheduler_address}"),
    ):
        Workers(cluster.scheduler_address)


@pytest.mark.thorough
def test_missing_scheduler_is_reported() -> None:
    with pytest.raises(SceneError, match="no Dask scheduler answers"):
        Workers("tcp://127.0.0.1:9")
