"""Pieces of a study: all computed once, wherever they are, and nothing left behind."""

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


def test_given_pieces_when_computed_then_each_comes_once_with_its_number() -> None:
    with Workers() as workers:
        found = list(workers.compute(square, range(20)))
        again = list(workers.compute(square, [7]))

    assert sorted(found) == [(k, k * k) for k in range(20)]
    assert again == [(0, 49)]
    assert not multiprocessing.active_children()


def test_given_pieces_that_lead_to_others_when_computed_then_those_are_computed_as_well() -> None:
    pieces = [2]
    with Workers() as workers:
        for _, found in workers.compute(square, pieces):
            if found < 100:
                pieces.append(found)

    assert pieces == [2, 4, 16]


def test_given_a_plain_script_when_it_computes_then_it_is_not_run_again_by_workers(tmp_path: Path) -> None:
    script = tmp_path / "study.py"
    script.write_text(
        "from rig.workers import Workers\nprint('begun')\n"
        "with Workers() as workers:\n    print(sorted(workers.compute(len, ['a', 'bb'])))\n"
    )
    found = subprocess.run([sys.executable, script], capture_output=True, text=True, check=True)
    assert found.stdout.splitlines() == ["begun", "[(0, 1), (1, 2)]"]


def test_given_a_piece_that_fails_when_computed_then_its_error_is_raised_and_no_process_is_left() -> None:
    with pytest.raises(SceneError, match="-3: expected"), Workers() as workers:
        list(workers.compute(square, [1, -3, 2]))

    assert not multiprocessing.active_children()


def test_given_workers_that_die_when_computed_then_only_their_pieces_are_computed_anew(
    tmp_path: Path,
) -> None:
    marks = [tmp_path / "one", tmp_path / "two"]
    marks[0].touch()
    with Workers() as workers:
        assert sorted(workers.compute(die_the_first_time, marks)) == [(0, "one"), (1, "two")]


def test_given_a_piece_that_always_kills_its_worker_when_computed_then_it_is_said_and_not_tried_for_ever() -> (
    None
):
    with pytest.raises(RunError, match="has died 3 times"), Workers() as workers:
        list(workers.compute(die, [1]))


def test_given_pieces_that_wait_when_workers_are_left_then_no_thread_trips_over_them(monkeypatch) -> None:
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
def test_given_ctrl_c_in_a_terminal_when_workers_start_then_they_do_not_hear_it() -> None:
    with Workers() as workers:
        assert list(workers.compute(deaf_to_ctrl_c, [1])) == [(0, True)]
    assert not deaf_to_ctrl_c(0)


def test_given_ctrl_c_when_a_cluster_of_our_own_starts_then_it_is_closed(monkeypatch) -> None:
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
def test_given_a_dask_cluster_when_computed_then_results_are_the_same() -> None:
    with Workers("local") as workers:
        assert sorted(workers.compute(square, range(20))) == [(k, k * k) for k in range(20)]


@pytest.mark.thorough
def test_given_no_scheduler_at_an_address_when_started_then_it_is_said() -> None:
    with pytest.raises(SceneError, match="no Dask scheduler answers"):
        Workers("tcp://127.0.0.1:9")
