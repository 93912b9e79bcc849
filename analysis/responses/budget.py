"""The uncertainty budget of a measured response, assembled in the same way for all estimators."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from analysis.responses.aliasing import aliasing_limit
from analysis.responses.systematic import (
    ChannelContributions,
    clock_deviation,
    clock_limit,
    sensitivity_limit,
    uncertain_reference_limit,
)
from rig.arrays import Array
from rig.results.uncertainty import RandomErrors, UncertaintyBudget, coverage_factor

if TYPE_CHECKING:
    from daq.recording.recording import Recording


def assemble_budget(
    rec: Recording,
    contributions: ChannelContributions,
    error: Array,
    degrees_of_freedom: Array,
    estimator_limits: Mapping[str, Array],
    reference_limits: Sequence[Array] = (),
    errors: RandomErrors | None = None,
    shared: float = 1.0,
    scale: float = 0.0,
) -> UncertaintyBudget:
    """Assemble the uncertainty budget of a response.

    `error`, `degrees_of_freedom`: type A standard uncertainty of either quadrature component, and its degrees of
    freedom, shape (lines,). `estimator_limits`: limits of error of the estimator, by name; those of the instrument are
    computed here. `reference_limits`: largest relative deviations of the reference, for the additional error of
    `uncertain_reference_limit`. `errors`: model of the random errors of several responses. `shared`: number of
    neighboring lines with a common error. `scale`: from `common_scale`.
    """
    limits = {**aliasing_limit(rec, contributions), **estimator_limits}
    if len(reference_limits):
        bound = np.sqrt(
            np.sum(np.square([error * coverage_factor(0.95, degrees_of_freedom), *limits.values()]), axis=0)
        )
        limits |= uncertain_reference_limit(bound, np.sqrt(np.sum(np.square(reference_limits), axis=0)))
    limits |= sensitivity_limit(rec, contributions) | clock_limit(rec, contributions)
    return UncertaintyBudget.of(
        error, degrees_of_freedom, limits, errors=errors, shared=shared, clock=clock_deviation(rec), scale=scale
    )
