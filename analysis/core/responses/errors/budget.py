"""The uncertainty budget of a measured response, assembled in the same way for all estimators."""

from collections.abc import Mapping, Sequence

import numpy as np

from analysis.core.responses.errors.aliasing import aliasing_limit
from analysis.core.responses.errors.systematic import (
    ChannelContributions,
    clock_deviation,
    clock_limit,
    clock_sources,
    sensitivity_limit,
    sensor_sources,
    uncertain_reference_limit,
)
from daq.core.recording.recording import Recording
from rig.core.base.arrays import Array
from rig.core.results.uncertainty import RandomErrors, UncertaintyBudget, circle_factor


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

    `error`, `degrees_of_freedom`: type A standard uncertainty of the real and of the imaginary part, and its degrees of
    freedom, shape (lines,). `estimator_limits`: limits of the errors of the estimator, by name; limits of the
    instrument's errors are computed here. `reference_limits`: limits of the relative errors of the reference, for the
    additional error of `uncertain_reference_limit`. `errors`: model of the random errors of several responses.
    `shared`: number of neighboring lines with a common error. `scale`: from `common_scale`.
    """
    limits = {**aliasing_limit(rec, contributions), **estimator_limits}
    if len(reference_limits):
        first_order_error = np.sqrt(
            np.sum(np.square([error * circle_factor(0.95, degrees_of_freedom), *limits.values()]), axis=0)
        )
        limits |= uncertain_reference_limit(first_order_error, np.sqrt(np.sum(np.square(reference_limits), axis=0)))
    limits |= sensitivity_limit(rec, contributions) | clock_limit(rec, contributions)
    return UncertaintyBudget.of(
        error,
        degrees_of_freedom,
        limits,
        sensor_sources(rec, contributions) | clock_sources(rec, contributions),
        errors=errors,
        shared=shared,
        clock=clock_deviation(rec),
        scale=scale,
    )
