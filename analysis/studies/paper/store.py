"""Parts of the reproduction, whose results are stored, so an interrupted reproduction can be continued.

The results of a part are stored with a digest of its inputs and of the program. Results with the same digest are loaded
instead of computed.
"""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rig.core.base.output_files import atomic_write
from rig.core.base.study import code_digest

Arrays = dict[str, np.ndarray]


@dataclass(frozen=True)
class PaperPart:
    """A part of the reproduction, independent of other parts: a simulation, or a recording with its evaluation."""

    name: str  # file stem of its results
    all_inputs: str  # text that contains all inputs of the results: scenes, grids, options
    compute: Callable[..., Arrays]
    """Takes `arguments` and returns arrays by name; a module-level function, for use in other processes."""
    arguments: Mapping[str, Any]  # arguments of `compute`
    title: str  # title in the progress report
    effort: float = 1.0
    """Approximate time relative to other parts, for the order and the estimate of the remaining time."""

    @property
    def digest(self) -> str:
        """Digest of the inputs and of the program."""
        code = code_digest("rig", "daq", "analysis")
        return hashlib.sha256(f"{code}\n{self.all_inputs}".encode()).hexdigest()

    def path(self, folder: Path) -> Path:
        """Return the file of the results."""
        return folder / "data" / f"{self.name}.npz"

    def load(self, folder: Path) -> Arrays | None:
        """Return the results of an earlier run with the same inputs, or None."""
        try:
            with self.path(folder).open("rb") as file, np.load(file, allow_pickle=False) as archive:
                arrays = {key: archive[key] for key in archive.files}
        except Exception:
            # The file does not exist or is damaged; numpy raises various errors for damaged files.
            return None
        return arrays if str(arrays.pop("digest", "")) == self.digest else None

    def run(self) -> Arrays:
        """Compute the results, possibly in another process."""
        return self.compute(**self.arguments)

    def store(self, folder: Path, arrays: Arrays) -> None:
        """Store results; the file gets its name only when it is complete."""
        contents: dict[str, Any] = {"digest": np.array(self.digest), **arrays}
        with atomic_write(self.path(folder), overwrite=True) as partial:
            np.savez_compressed(partial, **contents)
