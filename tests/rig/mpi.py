"""Two processes started by mpiexec, and an object that they share."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from rig.errors import RunError
from rig.ranks import OneRankError, communicators, sum_over_ranks

_MPIEXEC = Path(sys.prefix) / "bin" / "mpiexec"


def on_two_ranks(program: str) -> subprocess.CompletedProcess[str]:
    """Run a program of Python on two ranks, once it has joined them."""
    pytest.importorskip("mpi4py", reason="the extra grains is not installed: pip install 'shotrig[grains]'")
    if not _MPIEXEC.is_file():
        pytest.skip(f"there is no {_MPIEXEC}: MPICH is not that of pip install 'shotrig[grains]'")
    words = [_MPIEXEC, "-n", "2", sys.executable, "-c", program]
    return subprocess.run(words, capture_output=True, text=True, check=False)


class Part:
    """A value on each rank: the given value times the number of the rank, from 1."""

    def __init__(self, value: float) -> None:
        self.value = value * (1 + communicators().COMM_WORLD.rank)

    @property
    def total(self) -> float:
        """Sum of the values of all ranks."""
        return float(sum_over_ranks(np.array(self.value)))

    def grow(self, by: float) -> float:
        """Increase the value of every rank; return that of this rank."""
        self.value += by
        return self.value

    def fail(self) -> None:
        """Fail on all ranks."""
        raise RunError("nothing can be done")

    def fail_on(self, rank: int) -> None:
        """Fail on one rank, while the other waits for it."""
        if communicators().COMM_WORLD.rank == rank:
            raise OneRankError("memory has run out here")
        communicators().COMM_WORLD.Barrier()

    def interrupt_first(self) -> None:
        """Interrupt the first rank as by Ctrl-C, while the other waits for it."""
        if communicators().COMM_WORLD.rank == 0:
            raise KeyboardInterrupt
        communicators().COMM_WORLD.Barrier()
