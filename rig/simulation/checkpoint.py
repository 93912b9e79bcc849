"""Checkpoint file of a run with grains, from which the run can be continued."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import astuple
from pathlib import Path
from typing import Any

import numpy as np

from rig.errors import RunError
from rig.grain_beds.coupling import CoupledState
from rig.output_files import atomic_write
from rig.simulation.energy import Energy
from rig.simulation.grains_run import Course
from rig.study import code_digest, digest

#: Arrays of a course that are stored unchanged.
_AS_THEY_ARE = ("rows", "contact", "events")


def write(path: Path, asked: Mapping[str, Any], course: Course) -> None:
    """Write a checkpoint and replace the previous one atomically.

    `asked`: all parameters of the run, with their names in messages. Raises `ShotrigError` if the file cannot be
    written.
    """
    state = course.state
    arrays = {name: getattr(course, name) for name in _AS_THEY_ARE}
    arrays |= {f"asked_{name}": digest(value) for name, value in asked.items()}
    arrays |= {f"structure_{number}": part for number, part in enumerate(state.structure)}
    arrays |= {f"bed_{number}": np.frombuffer(bed, dtype=np.uint8) for number, bed in enumerate(state.beds)}
    with atomic_write(path, overwrite=True) as part, part.open("wb") as file:
        np.savez(
            file,
            code=code_digest("rig"),
            begin=state.begin,
            impulse=state.impulse,
            counts=(state.fallen, course.ambiguous),
            energy=[astuple(each) for each in course.energy],
            **arrays,
        )


def read(path: Path, asked: Mapping[str, Any]) -> Course | None:
    """Read a checkpoint; None if the file does not exist.

    Raises `RunError` if the file belongs to another run or is not a checkpoint.
    """
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            stored = dict(arrays)
        if str(stored["code"]) != code_digest("rig"):
            raise ValueError(stored["code"])
        others = [name for name, value in asked.items() if str(stored[f"asked_{name}"]) != digest(value)]
        course = _course(stored)
    except FileNotFoundError:
        return None
    # A damaged file can cause an exception of almost any type in the reader.
    except Exception:
        raise RunError(
            f"{path}: is not an interrupted run with grains of this version. Delete it to start again, "
            "or choose another name with -o."
        ) from None
    if others:
        raise RunError(
            f"{path}: contains an interrupted run with another {', '.join(others)}. Use the same "
            "settings to continue it, delete the file to start again, or choose another name with -o."
        )
    return course


def _course(stored: Mapping[str, Any]) -> Course:
    fallen, ambiguous = stored["counts"].tolist()
    state = CoupledState(
        _numbered(stored, "structure"),
        tuple(bed.tobytes() for bed in _numbered(stored, "bed")),
        stored["begin"],
        stored["impulse"],
        fallen,
    )
    energy = tuple(Energy(*each) for each in stored["energy"].tolist())
    return Course(
        state=state, energy=energy, ambiguous=ambiguous, **{name: stored[name] for name in _AS_THEY_ARE}
    )


def _numbered(stored: Mapping[str, Any], name: str) -> tuple[Any, ...]:
    return tuple(
        stored[f"{name}_{number}"] for number in range(sum(key.startswith(f"{name}_") for key in stored))
    )
