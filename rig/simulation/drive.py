"""Validation of a sampled drive."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rig.errors import RunError


def validate_drive(drive: ArrayLike, inputs: Sequence[str], first: int = 0) -> NDArray[np.float64]:
    """Return a drive as an array of shape (inputs, samples).

    `inputs`: names of the drive inputs; `first`: number of the first sample, for error messages. Raises `RunError`
    if the drive has another shape or is not finite.
    """
    block = np.asarray(drive, dtype=np.float64)
    if block.ndim != 2 or block.shape[0] != len(inputs):
        raise RunError(
            f"drive: the array has shape {block.shape}. Give one of shape ({len(inputs)}, samples) for the inputs "
            f"{', '.join(inputs) or '(none)'}."
        )
    if not np.isfinite(block).all():
        row, column = np.argwhere(~np.isfinite(block))[0]
        raise RunError(
            f"drive: {block[row, column]} at sample {first + column} of input {inputs[row]} is not a finite number. "
            "Check the signal."
        )
    return block
