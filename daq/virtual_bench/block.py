"""A block of samples of all channels, as the converter gives it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from rig.simulation.motion import Motion


@dataclass(frozen=True)
class Block:
    """Samples of all channels, and the motion that they measure.

    Attributes
    ----------
    first : int
        Number of the first sample, counted from power-on.
    samples : ndarray, shape (channels, samples)
        Volts (float64), or counts (int32) where the scene's converter has bits.
    overload : ndarray of bool, shape (channels, samples)
        Samples at which a channel exceeds its range, or its sensor or amplifier its limit.
    motion : Motion
        True motion at the same samples. It may be recorded or drawn; tests and control do not use it.
    """

    first: int
    samples: NDArray[np.float64] | NDArray[np.int32]
    overload: NDArray[np.bool_]
    motion: Motion
