"""The uncertainty budget of a measured response, assembled in the same way for all estimators."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from analysis.responses.aliasing import aliasing_part
from analysis.responses.systematic import (
    clock_deviation,
    clock_part,
    doubtful_reference_part,
    sensitivity_part,
)
from rig.arrays import Array, ComplexArray
from rig.results.uncertainty import RandomErrors, UncertaintyBudget, radius

if TYPE_CHECKING:
    from daq.recording.recording import Recording


@dataclass(frozen=True)
class ReadingShares:
    """Shares of the channels in a response and in its reference.

    `upper`, `lower`, shape (channels, lines): share of each channel in the response and in the reference; their sums
    are `value` and 1.
    """

    names: Sequence[str]  # channels, in the order of the rows
    frequency: Array  # Hz, shape (lines,)
    motion: str  # quantity of the response
    value: ComplexArray  # shape (lines,)
    upper: ComplexArray
    lower: ComplexArray


def assemble_budget(
    rec: Recording,
    shares: ReadingShares,
    error: Array,
    degrees: Array,
    causes: Mapping[str, Array],
    doubts: Sequence[Array] = (),
    errors: RandomErrors | None = None,
    shared: float = 1.0,
    scale: float = 0.0,
) -> UncertaintyBudget:
    """Assemble the uncertainty budget of a response; the same for every estimator.

    The parts for aliasing, sensor tolerances and clock error follow from the shares of the channels. A reference that
    may be smaller than recorded increases the uncertainty beyond first-order propagation.

    `error`, `degrees`, shape (lines,): type A standard uncertainty of either quadrature component, and its degrees
    of freedom; `causes`: limits of error that the estimator provides, by cause; `doubts`, shape (lines,): largest
    relative deviations of the reference.
    """
    parts = shares.value, shares.upper, shares.lower
    limits = {**aliasing_part(rec, shares.names, shares.frequency, *parts, shares.motion), **causes}
    if len(doubts):
        bound = np.sqrt(np.sum(np.square([error * radius(0.95, degrees), *limits.values()]), axis=0))
        limits |= doubtful_reference_part(bound, np.sqrt(np.sum(np.square(doubts), axis=0)))
    limits |= sensitivity_part(rec, shares.names, *parts)
    limits |= clock_part(rec, shares.names, shares.frequency, *parts, shares.motion)
    return UncertaintyBudget.of(
        error, degrees, limits, errors=errors, shared=shared, clock=clock_deviation(rec), scale=scale
    )
