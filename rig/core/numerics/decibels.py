"""Ratios of amplitudes in decibels."""

import numpy as np

from rig.core.base.arrays import Array


def in_decibels(ratio: Array | float) -> Array:
    """Return a ratio of amplitudes in dB.

    >>> float(in_decibels(10.0))
    20.0
    """
    return np.asarray(20.0 * np.log10(ratio))


def from_decibels(level: float) -> float:
    """Return the ratio of amplitudes of a level in dB.

    >>> from_decibels(-20.0)
    0.1
    """
    return float(10.0 ** (level / 20.0))
