"""Results on disk, so that a long reproduction continues where it stopped.

Each part of the work has a name and a text with all inputs. Its arrays are stored under that name with a digest of the
text; a part whose digest is already stored is read, not computed.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from rig.errors import RunError

Arrays = dict[str, np.ndarray]


def partial_name(target: Path) -> Path:
    """Name of a file while it is written, with the process: a killed run may leave a worker running."""
    return target.with_name(f"{target.stem}.{os.getpid()}.partial{target.suffix}")


def remove_partial(folder: Path) -> None:
    """Remove files that earlier runs left half written."""
    for place in (folder / "data", folder / "recordings"):
        for path in place.glob("*.partial.*"):
            path.unlink(missing_ok=True)


@dataclass(frozen=True)
class PaperPart:
    """A piece of the reproduction that can be computed on its own."""

    name: str  # File stem of its results
    depends: str
    """All inputs of its results: scenes, grids, choices."""
    compute: Callable[..., Arrays]
    """Takes `arguments`, returns arrays by name; a function of a module, so that another process can run
    it."""
    arguments: Mapping[str, Any]
    """Arguments of `compute`."""
    title: str  # For the progress report
    effort: float = 1.0
    """Approximate time relative to other parts; for the order, and to estimate the remaining time."""

    @property
    def digest(self) -> str:
        """Digest of the inputs that a stored result must have."""
        return hashlib.sha256(f"{version('shotrig')}\n{self.depends}".encode()).hexdigest()

    def path(self, folder: Path) -> Path:
        """File of the results."""
        return folder / "data" / f"{self.name}.npz"

    def stored(self, folder: Path) -> Arrays | None:
        """Results from an earlier run, or None if there are none for the same inputs."""
        try:
            with self.path(folder).open("rb") as file, np.load(file, allow_pickle=False) as archive:
                arrays = {key: archive[key] for key in archive.files}
        except Exception:
            # Absent or damaged, for which numpy raises all kinds of errors: computed again.
            return None
        return arrays if str(arrays.pop("digest", "")) == self.digest else None

    def computed(self) -> Arrays:
        """Compute the results, possibly in another process."""
        return self.compute(**self.arguments)

    def store(self, folder: Path, arrays: Arrays) -> None:
        """Store results; the file appears when it is complete."""
        target = self.path(folder)
        partial = partial_name(target)
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            contents: dict[str, Any] = {"digest": np.array(self.digest), **arrays}
            np.savez_compressed(partial, **contents)
            partial.replace(target)
        except OSError as error:
            raise RunError(
                f"cannot write {target}: {error.strerror}; choose another place with --output"
            ) from None
