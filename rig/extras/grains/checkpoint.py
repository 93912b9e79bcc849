"""Checkpoint file of a run with grains, from which the run can be continued."""

from collections.abc import Mapping
from dataclasses import astuple
from pathlib import Path
from typing import Any

import numpy as np

from rig.core.base.errors import RunError
from rig.core.base.output_files import atomic_write
from rig.core.base.study import code_digest, digest
from rig.core.simulation.energy import Energy
from rig.extras.grains.coupling import CoupledState
from rig.extras.grains.grains_run import GrainsState

#: Fields of `GrainsState` that are stored unchanged.
_PLAIN_ARRAYS = ("rows", "contact", "events")


def write_checkpoint(path: Path, settings: Mapping[str, Any], state: GrainsState) -> None:
    """Write a checkpoint, and replace the previous checkpoint atomically.

    `settings`: all parameters of the run, with their names in messages. Raises `ShotrigError` if the file cannot be
    written.
    """
    coupled = state.coupled
    arrays = {name: getattr(state, name) for name in _PLAIN_ARRAYS}
    arrays |= {f"digest_{name}": digest(value) for name, value in settings.items()}
    arrays |= {f"structure_{number}": array for number, array in enumerate(coupled.structure)}
    arrays |= {f"bed_{number}": np.frombuffer(bed, dtype=np.uint8) for number, bed in enumerate(coupled.beds)}
    with atomic_write(path, overwrite=True) as temporary, temporary.open("wb") as file:
        np.savez(
            file,
            code=code_digest("rig"),
            ambiguous=state.ambiguous,
            energy=[astuple(energy) for energy in state.energy],
            **arrays,
        )


def read_checkpoint(path: Path, settings: Mapping[str, Any]) -> GrainsState | None:
    """Read a checkpoint (None: no file); raise `RunError` if it belongs to another run or is not a checkpoint."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            stored = dict(arrays)
        if str(stored["code"]) != code_digest("rig"):
            raise ValueError(stored["code"])
        different = [name for name, value in settings.items() if str(stored[f"digest_{name}"]) != digest(value)]
        state = _restore_state(stored)
    except FileNotFoundError:
        return None
    # A damaged file can cause an exception of almost any type in the reader.
    except Exception:
        raise RunError(
            f"{path} is not a checkpoint of this version of shotrig for a run with grains. Delete the file to start "
            "again, or choose another name with -o."
        ) from None
    if different:
        raise RunError(
            f"{path} contains an interrupted run that was started with a different {', '.join(different)}. Restore "
            "the previous values to continue it, or delete the file to start again."
        )
    return state


def _restore_state(stored: Mapping[str, Any]) -> GrainsState:
    beds = tuple(bed.tobytes() for bed in _numbered(stored, "bed"))
    energy = tuple(Energy(*values) for values in stored["energy"].tolist())
    return GrainsState(
        coupled=CoupledState(_numbered(stored, "structure"), beds),
        energy=energy,
        ambiguous=stored["ambiguous"].item(),
        **{name: stored[name] for name in _PLAIN_ARRAYS},
    )


def _numbered(stored: Mapping[str, Any], name: str) -> tuple[Any, ...]:
    """Return the arrays `name_0`, `name_1`, ... in order."""
    return tuple(stored[f"{name}_{number}"] for number in range(sum(key.startswith(f"{name}_") for key in stored)))
