"""MPI ranks (processes) with shared objects: operations of all ranks, work of the first rank, and termination."""

import os
import sys
import threading
from pathlib import Path

import pytest

from rig.core.base.errors import SceneError
from rig.core.base.workers import Workers
from rig.extras.grains import ranks
from tests.rig.mpi import on_two_ranks

# Start of a program: the ranks share the object `part`, with the values 2 and 4.
_JOINED = (
    "from rig.extras.grains import ranks; ranks.join(); from tests.rig.mpi import Part; "
    "part = ranks.Shared(Part, 2.0); "
)


def test_second_rank_executes_operations_of_the_first() -> None:
    program = (
        "other = ranks.Shared(Part, 30.0); del other;"
        "print(ranks.rank_count(), part.value, part.total, part.increase(0.5), part.total)"
    )

    completed = on_two_ranks(_JOINED + program)

    # The totals are 2 + 4 and, after the increase, 2.5 + 4.5.
    assert (completed.returncode, completed.stdout, completed.stderr) == (0, "2 2.0 6.0 2.5 7.0\n", "")


def test_common_failure_is_reported_once() -> None:
    program = """
from rig.core.base.errors import RunError
try:
    part.fail()
except RunError as error:
    print(error, part.total)
"""

    completed = on_two_ranks(_JOINED + program)

    assert (completed.returncode, completed.stdout, completed.stderr) == (0, "nothing can be done 6.0\n", "")


@pytest.mark.parametrize("rank", [0, 1])
def test_failure_of_one_rank_ends_both(rank: int) -> None:
    completed = on_two_ranks(_JOINED + f"part.fail_on({rank}); print('continued')")

    assert completed.returncode == 1
    assert "memory has run out here" in completed.stderr
    assert "continued" not in completed.stdout


def test_output_is_awaited_until_it_is_read() -> None:
    reader, writer = os.pipe()
    os.write(writer, b"why it failed")
    received: list[bytes] = []
    waiter = threading.Thread(target=ranks.await_reader, args=(writer,))
    waiter.start()
    waiter.join(0.05)

    assert waiter.is_alive()
    received.append(os.read(reader, 5))
    waiter.join(0.05)
    assert waiter.is_alive()
    received.append(os.read(reader, 100))
    waiter.join()

    assert b"".join(received) == b"why it failed"


def test_output_without_a_reader_is_not_awaited() -> None:
    reader, writer = os.pipe()
    os.write(writer, b"why it failed")
    os.close(reader)

    ranks.await_reader(writer)


def test_output_to_a_file_is_not_awaited(tmp_path: Path) -> None:
    with (tmp_path / "log").open("wb") as file:
        file.write(b"why it failed")
        file.flush()

        ranks.await_reader(file.fileno())


def test_ctrl_c_ends_both_ranks() -> None:
    completed = on_two_ranks(_JOINED + "part.interrupt_first()")

    assert completed.returncode == 130


def test_single_process_joins_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("PMI_SIZE", "OMPI_COMM_WORLD_SIZE"):
        monkeypatch.delenv(name, raising=False)

    ranks.join()

    assert ranks.rank_count() == 1


@pytest.mark.parametrize("n_processes", ["2", "two", ""])
def test_missing_mpi4py_leaves_processes_separate(monkeypatch: pytest.MonkeyPatch, n_processes: str) -> None:
    monkeypatch.setenv("PMI_SIZE", n_processes)
    monkeypatch.setitem(sys.modules, "mpi4py", None)

    ranks.join()

    assert ranks.rank_count() == 1
    with pytest.raises(SceneError, match=r"pip install 'shotrig\[grains\]'"):
        ranks.communicators()


def test_several_ranks_compute_pieces_in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rig.core.base.workers.SERIAL", True)
    computed_numbers: list[float] = []
    pieces = [1.0, 2.0]

    def compute(number: float) -> float:
        computed_numbers.append(number)
        return 2.0 * number

    computed = {}
    with Workers() as workers:
        for number, result in workers.compute(compute, pieces):
            computed[number] = result
            if number == 1:
                pieces.append(5.0)

    assert (computed, computed_numbers) == ({0: 2.0, 1: 4.0, 2: 10.0}, pieces)
