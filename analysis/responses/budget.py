"""The uncertainty budget of a measured response, assembled in the same way for all estimators."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from analysis.responses.aliasing import aliasing_part
from analysis.responses.systematic import (
    ReadingShares,
    clock_deviation,
    clock_part,
    common_scale,
    doubtful_reference_part,
    sensitivity_part,
)
from rig.arrays import Array
from rig.results.response import Response
from rig.results.uncertainty import RandomErrors, UncertaintyBudget, radius

if TYPE_CHECKING:
    from analysis.responses.measurands import Measurand
    from daq.recording.recording import Recording


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

    `error`: type A standard uncertainty of either quadrature component, shape (lines,). `causes`: limits of error from
    the estimator. `doubts`: largest relative deviations of the reference. A reference that is smaller than recorded
    increases the uncertainty beyond first-order propagation.
    """
    limits = {**aliasing_part(rec, shares), **causes}
    if len(doubts):
        bound = np.sqrt(np.sum(np.square([error * radius(0.95, degrees), *limits.values()]), axis=0))
        limits |= doubtful_reference_part(bound, np.sqrt(np.sum(np.square(doubts), axis=0)))
    limits |= sensitivity_part(rec, shares) | clock_part(rec, shares)
    return UncertaintyBudget.of(
        error, degrees, limits, errors=errors, shared=shared, clock=clock_deviation(rec), scale=scale
    )


def measured_curve(
    rec: Recording,
    shares: ReadingShares,
    above: Measurand,
    below: Measurand,
    reference: str,
    error: Array,
    degrees: Array,
    causes: Mapping[str, Array],
    doubts: Sequence[Array],
    errors: RandomErrors,
    shared: float = 1.0,
    **fields: Any,
) -> Response:
    """Return the response of a measurand to a reference with its budget; `fields` as in `Response.curve`."""
    scale = common_scale(rec, above.channels, below.channels)
    budget = assemble_budget(rec, shares, error, degrees, causes, doubts, errors, shared, scale)
    return Response.curve(
        shares.frequency, shares.value, above.channels[0], reference=reference, motion=shares.motion,
        uncertainty=budget, **fields,
    )  # fmt: skip
