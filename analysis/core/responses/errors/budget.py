"""The uncertainty budget of a measured response, assembled in the same way for all estimators."""

from collections.abc import Mapping, Sequence

import numpy as np

from analysis.core.responses.errors.aliasing import aliasing_bound
from analysis.core.responses.errors.systematic import (
    ChannelContributions,
    clock_bound,
    clock_deviation,
    clock_sources,
    sensitivity_bound,
    sensor_sources,
    uncertain_reference_bound,
)
from daq.core.recording.recording import Recording
from rig.core.base.arrays import Array
from rig.core.results.uncertainty import RandomErrors, UncertaintyBudget, circle_factor


def assemble_budget(
    rec: Recording,
    contributions: ChannelContributions,
    error: Array,
    degrees_of_freedom: Array,
    estimator_bounds: Mapping[str, Array],
    reference_bounds: Sequence[Array] = (),
    errors: RandomErrors | None = None,
    shared: float = 1.0,
    scale: float = 0.0,
) -> UncertaintyBudget:
    """Assemble the uncertainty budget of a response.

    `error`, `degrees_of_freedom`: type A standard uncertainty of real and imaginary part, and its degrees of freedom,
    shape (lines,). `estimator_bounds`: limits of the errors of the estimator, by name; limits of the instrument's
    errors are computed here. `reference_bounds`: limits of the relative errors of the reference, for the additional
    error of `uncertain_reference_bound`. `errors`: model of the random errors of several responses. `shared`: number of
    neighboring lines with a common error. `scale`: from `common_scale`.
    """
    bounds = {**aliasing_bound(rec, contributions), **estimator_bounds}
    if len(reference_bounds):
        first_order_error = np.sqrt(
            np.sum(np.square([error * circle_factor(0.95, degrees_of_freedom), *bounds.values()]), axis=0)
        )
        bounds |= uncertain_reference_bound(first_order_error, np.sqrt(np.sum(np.square(reference_bounds), axis=0)))
    bounds |= sensitivity_bound(rec, contributions) | clock_bound(rec, contributions)
    return UncertaintyBudget.of(
        error,
        degrees_of_freedom,
        bounds,
        sensor_sources(rec, contributions) | clock_sources(rec, contributions),
        errors=errors,
        shared=shared,
        clock=clock_deviation(rec),
        scale=scale,
    )
