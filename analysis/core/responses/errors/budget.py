"""A measured response as the quotient of two weighted sums of channels, with its uncertainty budget.

All estimators compute values and random errors of their own. Weights of the channels, systematic errors of the
instrument and the budget are computed here, in the same way for all.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from analysis.core.responses.errors.aliasing import aliasing_limit
from analysis.core.responses.errors.systematic import (
    ChannelContributions,
    clock_deviation,
    clock_limit,
    clock_sources,
    common_scale,
    sensitivity_limit,
    sensor_sources,
    uncertain_reference_limit,
)
from analysis.core.responses.measurands import Measurand
from daq.core.recording.recording import Recording
from rig.core.base.arrays import Array, ComplexArray
from rig.core.results.response import Response
from rig.core.results.uncertainty import RandomErrors, UncertaintyBudget, circle_factor


class Quotient:
    """Response of a numerator to a denominator, which are weighted sums of channels; `others`: the other inputs.

    The rows of all arrays are the channels `names`.
    """

    def __init__(
        self,
        rec: Recording,
        numerator: Measurand,
        denominator: Measurand,
        others: Sequence[Measurand],
        frequency: Array,
    ) -> None:
        measurands = (numerator, denominator, *others)
        self.rec, self.numerator, self.denominator, self.others = rec, numerator, denominator, others
        self.frequency = frequency
        self.names = tuple(dict.fromkeys(name for each in measurands for name in each.channels))
        self.response_weights, self.reference_weights = (
            each.row(rec, self.names, frequency) for each in (numerator, denominator)
        )

    def change_per_reading(self, value: ComplexArray) -> ComplexArray:
        """Return the change of a response per change of each reading, for a reference of 1; (channels, lines)."""
        return self.response_weights - value * self.reference_weights

    def contributions(self, value: ComplexArray, readings: ComplexArray) -> ChannelContributions:
        """Return the contributions of the channels to a response; `readings`: per unit of the reference."""
        shares = (weights * readings for weights in (self.response_weights, self.reference_weights))
        return ChannelContributions(self.names, self.frequency, self.numerator.motion, value, *shares)

    def response(
        self,
        contributions: ChannelContributions,
        error: Array,
        degrees_of_freedom: Array,
        estimator_limits: Mapping[str, Array],
        reference_limits: Sequence[Array],
        errors: RandomErrors,
        shared: float = 1.0,
        **fields: Any,
    ) -> Response:
        """Return the response with its uncertainty budget.

        `error`, `degrees_of_freedom`: type A standard uncertainty of the real and of the imaginary part, and its
        degrees of freedom, shape (lines,). `estimator_limits`: limits of the errors of the estimator, by name; limits
        of the instrument's errors are computed here. `reference_limits`: limits of the relative errors of the
        reference, for the additional error of `uncertain_reference_limit`. `errors`: model of the random errors of
        several responses. `shared`: number of neighboring lines with a common error. `fields`: of `Response.curve`.
        """
        rec = self.rec
        limits = {**aliasing_limit(rec, contributions), **estimator_limits}
        if len(reference_limits):
            first_order_error = np.sqrt(
                np.sum(np.square([error * circle_factor(0.95, degrees_of_freedom), *limits.values()]), axis=0)
            )
            limits |= uncertain_reference_limit(first_order_error, np.sqrt(np.sum(np.square(reference_limits), axis=0)))
        limits |= sensitivity_limit(rec, contributions) | clock_limit(rec, contributions)
        budget = UncertaintyBudget.of(
            error, degrees_of_freedom, limits, sensor_sources(rec, contributions) | clock_sources(rec, contributions),
            errors=errors, shared=shared, clock=clock_deviation(rec),
            scale=common_scale(rec, self.numerator.channels, self.denominator.channels),
        )  # fmt: skip
        fields = {"value": contributions.value, "label": rec.scene.name, **fields}
        return Response.curve(
            self.frequency, output=self.numerator.channels[0], reference=self.denominator.reference,
            motion=self.numerator.motion, uncertainty=budget, **fields,
        )  # fmt: skip
