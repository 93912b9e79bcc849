"""Run programs on two MPI ranks (processes), for tests; and `Part`, an object with a part on each rank."""

import subprocess
import sys
from pathlib import Path

import numpy as np

from rig.core.base.errors import RunError
from rig.extras.grains.ranks import OneRankError, communicators, sum_over_ranks

_MPIEXEC = Path(sys.prefix) / "bin" / "mpiexec"


def on_two_ranks(program: str) -> subprocess.CompletedProcess[str]:
    """Run Python code on two ranks and return its output; skip the test without mpi4py or MPICH."""
    # Imported here, because the ranks import this module as well.
    import pytest

    pytest.importorskip("mpi4py", reason="the optional dependencies are not installed: pip install 'shotrig[grains]'")
    if not _MPIEXEC.is_file():
        pytest.skip(
            f"{_MPIEXEC} does not exist: the optional dependencies are not installed: pip install 'shotrig[grains]'"
        )
    command = [_MPIEXEC, "-n", "2", sys.executable, "-c", program]
    return subprocess.run(command, capture_output=True, text=True, check=False)


class Part:
    """A value on each rank: the given value times the number of the rank, counted from 1.

    Tests call its methods on all ranks by `rig.extras.grains.ranks.Shared`.
    """

    def __init__(self, value: float) -> None:
        self.value = value * (1 + communicators().COMM_WORLD.rank)

    @property
    def total(self) -> float:
        """Sum of the values of all ranks."""
        return float(sum_over_ranks(np.array(self.value)))

    def increase(self, amount: float) -> float:
        """Increase the value of every rank; return the value of this rank."""
        self.value += amount
        return self.value

    def fail(self) -> None:
        """Fail on all ranks."""
        raise RunError("nothing can be done")

    def fail_on(self, rank: int) -> None:
        """Fail on one rank (from 0), while the other waits for it."""
        if communicators().COMM_WORLD.rank == rank:
            raise OneRankError("memory has run out here")
        communicators().COMM_WORLD.Barrier()

    def interrupt_first(self) -> None:
        """Interrupt the first rank as by Ctrl-C, while the other waits for it."""
        if communicators().COMM_WORLD.rank == 0:
            raise KeyboardInterrupt
        communicators().COMM_WORLD.Barrier()
