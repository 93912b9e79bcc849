"""Parallel parts of a study: each is computed once, on any worker, and no process remains."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import warnings
from multiprocessing.context import SpawnProcess
from pathlib import Path

import pytest
from distributed import LocalCluster

from rig.errors import RunError, SceneError
from rig.workers import Workers


def square(number: int) -> int:
    if number < 0:
        raise SceneError(f"{number}: expected a number that is not negative")
    return number * number


def die_the_first_time(mark: Path) -> str:
    if mark.exists():
        return mark.name
    mark.touch()
    os._exit(1)


def die(_: int) -> None:
    os._exit(1)


def go_on_for_ever_but_once(number: int) -> None:
    if number:
        threading.Event().wait()


def deaf_to_ctrl_c(_: int) -> bool:
    return signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ())


class ClusterWithCtrlC:
    """A Dask cluster, while whose workers start somebody presses Ctrl-C."""

    closed = 0

    def __init__(self, **_: object) -> None:
        signal.raise_signal(signal.SIGINT)

    def close(self) -> None:
        ClusterWithCtrlC.closed += 1


def test_each_piece_comes_once_with_its_number() -> None:
    with Workers() as workers:
        found = list(workers.compute(square, range(20)))
        again = list(workers.compute(square, [7]))

    assert sorted(found) == [(k, k * k) for k in range(20)]
    assert again == [(0, 49)]
    assert not multiprocessing.active_children()


def test_appended_pieces_are_computed_as_well() -> None:
    pieces = [2]
    with Workers() as workers:
        for _, found in workers.compute(square, pieces):
            if found < 100:
                pieces.append(found)

    assert pieces == [2, 4, 16]


def test_workers_do_not_rerun_the_script(tmp_path: Path) -> None:
    script = tmp_path / "study.py"
    script.write_text(
        "from rig.workers import Workers\nprint('begun')\n"
        "with Workers() as workers:\n    print(sorted(workers.compute(len, ['a', 'bb'])))\n"
    )
    found = subprocess.run([sys.executable, script], capture_output=True, text=True, check=True)
    assert found.stdout.splitlines() == ["begun", "[(0, 1), (1, 2)]"]


def test_failing_piece_raises_and_leaves_no_process() -> None:
    with pytest.raises(SceneError, match="-3: expected"), Workers() as workers:
        list(workers.compute(square, [1, -3, 2]))

    assert not multiprocessing.active_children()


def test_pieces_of_dead_workers_are_repeated(
    tmp_path: Path,
) -> None:
    marks = [tmp_path / "one", tmp_path / "two"]
    marks[0].touch()
    with Workers() as workers:
        assert sorted(workers.compute(die_the_first_time, marks)) == [(0, "one"), (1, "two")]


def test_deadly_piece_is_reported_not_repeated_forever() -> None:
    with pytest.raises(RunError, match="has died 3 times"), Workers() as workers:
        list(workers.compute(die, [1]))


def test_left_workers_drop_waiting_pieces(monkeypatch) -> None:
    failed: list[object] = []
    monkeypatch.setattr(threading, "excepthook", failed.append)
    kill = SpawnProcess.kill

    def kill_until_noticed(process: SpawnProcess) -> None:
        kill(process)
        for thread in threading.enumerate():
            if hasattr(thread, "terminate_broken"):
                thread.join()

    monkeypatch.setattr(SpawnProcess, "kill", kill_until_noticed)
    with Workers() as workers:
        next(workers.compute(go_on_for_ever_but_once, range(50)))

    assert not failed


@pytest.mark.skipif(not hasattr(signal, "pthread_sigmask"), reason="this system tells each process by itself")
def test_workers_do_not_hear_ctrl_c() -> None:
    with Workers() as workers:
        assert list(workers.compute(deaf_to_ctrl_c, [1])) == [(0, True)]
    assert not deaf_to_ctrl_c(0)


def test_ctrl_c_closes_our_starting_cluster(monkeypatch) -> None:
    monkeypatch.setattr("distributed.LocalCluster", ClusterWithCtrlC)
    with pytest.raises(KeyboardInterrupt):
        Workers("local")
    assert ClusterWithCtrlC.closed == 1 and not deaf_to_ctrl_c(0)


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_cluster_without_workers_is_reported_and_waited_for(monkeypatch) -> None:
    monkeypatch.setattr("rig.workers._WITHOUT_WORKERS", 0.05)
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
def test_missing_scheduler_is_reported() -> None:
    with pytest.raises(SceneError, match="no Dask scheduler answers"):
        Workers("tcp://127.0.0.1:9")
