"""The uncertainty budget of a measured response, assembled in the same way for all estimators."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from analysis.responses.aliasing import aliasing_part
from analysis.responses.systematic import (
    ReadingShares,
    clock_deviation,
    clock_part,
    sensitivity_part,
    uncertain_reference_part,
)
from rig.arrays import Array
from rig.results.uncertainty import RandomErrors, UncertaintyBudget, coverage_factor

if TYPE_CHECKING:
    from daq.recording.recording import Recording


def assemble_budget(
    rec: Recording,
    shares: ReadingShares,
    error: Array,
    degrees: Array,
    estimator_limits: Mapping[str, Array],
    reference_limits: Sequence[Array] = (),
    errors: RandomErrors | None = None,
    shared: float = 1.0,
    scale: float = 0.0,
) -> UncertaintyBudget:
    """Assemble the uncertainty budget of a response.

    `error`, `degrees`: type A standard uncertainty of either quadrature component, and its degrees of freedom, shape
    (lines,). `estimator_limits`: limits of error by name, which the estimator adds to those of the instrument.
    `reference_limits`: largest relative deviations of the reference. A reference that is smaller than recorded
    increases the uncertainty beyond first-order propagation. `shared`: number of neighboring lines with a common
    error. `scale`: from `common_scale`.
    """
    limits = {**aliasing_part(rec, shares), **estimator_limits}
    if len(reference_limits):
        bound = np.sqrt(np.sum(np.square([error * coverage_factor(0.95, degrees), *limits.values()]), axis=0))
        limits |= uncertain_reference_part(bound, np.sqrt(np.sum(np.square(reference_limits), axis=0)))
    limits |= sensitivity_part(rec, shares) | clock_part(rec, shares)
    return UncertaintyBudget.of(
        error, degrees, limits, errors=errors, shared=shared, clock=clock_deviation(rec), scale=scale
    )
