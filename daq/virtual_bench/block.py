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
    """Samples of all channels, in volts or counts, and the true motion at them, which tests and control do not use."""

    first: int  # number of the first sample, from power-on
    samples: NDArray[np.float64] | NDArray[np.int32]  # (channels, samples): volts or counts
    overload: NDArray[np.bool_]  # samples beyond the range of a channel or a limit of its devices
    motion: Motion
