"""Uncertainty budget of a frequency response: its contributions by name and type, as in the GUM, and their sums.

A line is one frequency of the response; an element is one output over one input.

References
----------
JCGM 100:2008, Guide to the expression of uncertainty in measurement (GUM), sections 4.2, 4.3 and 5.1.
J. S. Bendat, A. G. Piersol, Random Data, 4th ed., Wiley 2010, section 9.2.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from rig.arrays import Array, ComplexArray
from rig.results.text import round_to_bound

Lines = NDArray[np.bool_] | NDArray[np.intp]

SCATTER = "scatter"
# Degrees of freedom above which Student's t and Fisher's F have their limits to four digits.
_NORMAL_DEGREES = 1e6
#: Names of contributions that are tolerances of data sheets, or contain them. These contributions are added linearly,
#: because clock and sensors of a test may deviate by the full tolerance at the same time.
CLOCK, SENSITIVITY = "sample clock", "sensors' sensitivity"
#: Name of the sum of all systematic errors, if a file gives no separate contributions.
SYSTEMATIC = "systematic errors"
TOLERANCES = (CLOCK, SENSITIVITY, SYSTEMATIC)


class Covariance(Protocol):
    """Covariance of the random errors e of a response, over its elements and lines."""

    @property
    def lines(self) -> ComplexArray:
        """``E[e e^H]`` at each line, shape (lines, elements, elements)."""

    @property
    def shared(self) -> float:
        """Number of adjacent lines that have the same error, because they are computed from the same samples."""

    @property
    def reference(self) -> Array | None:
        """Noise power of the reference, relative to its power, shape (lines,); None if it is not estimated."""

    def at(self, lines: Lines) -> Covariance:
        """Select some lines."""

    def select(self, elements: Sequence[int]) -> Covariance:
        """Select some elements."""

    def of_sums(self, weights: ComplexArray) -> Array:
        """Return the covariance of ``Re(sum(conj(weights) e))``, (sums, sums); weights (lines, elements, sums)."""


class RandomErrors(Protocol):
    """Random errors of a response's elements, computed from the errors of the readings, which elements may share."""

    def at(self, lines: Lines) -> RandomErrors:
        """Select some lines."""

    def select(self, elements: Sequence[int]) -> RandomErrors:
        """Select some elements."""

    def scaled(self, factor: ComplexArray) -> RandomErrors:
        """Multiply by a factor at each line."""

    def joined(self, others: Sequence[RandomErrors]) -> RandomErrors | None:
        """Join with the errors of other elements; None if they depend on different readings."""

    def covariance(self, error: Array, shared: float) -> Covariance:
        """Return the covariance over elements, given each element's standard uncertainty, shape (lines, elements)."""


@dataclass(frozen=True)
class Contribution:
    """One cause of uncertainty.

    `deviation`, of the shape of the values. Type A: standard uncertainty of either quadrature component, NaN where a
    single average has no scatter. Type B: bound of the error, infinite where it is unbounded.
    """

    name: str
    evaluation: Literal["A", "B"]  # by statistics of the readings, or by other knowledge (GUM 4.2, 4.3)
    deviation: Array
    degrees: Array | None = None  # degrees of freedom of type A

    def standard(self) -> Array:
        """Return the standard uncertainty; type B is assumed to have a uniform distribution (GUM 4.3.7)."""
        return self.deviation if self.evaluation == "A" else self.deviation / np.sqrt(3.0)

    def bound(self, confidence: float = 0.95) -> Array:
        """Return the expanded uncertainty of this contribution alone: the radius of a circle in the complex plane."""
        if self.evaluation == "B" or self.degrees is None:
            return self.deviation
        return self.deviation * coverage_factor(confidence, self.degrees)


@dataclass(frozen=True)
class UncertaintyBudget:
    """Contributions to the uncertainty of a response.

    `errors`: random errors of the elements, for their covariance; None: they are independent. `shared`: number of
    adjacent lines that have the same error, because they are computed from the same samples. `clock`: bound of the
    relative error of the sample clock, and so of all frequencies; its effect on the values is one of the contributions.
    """

    contributions: tuple[Contribution, ...] = ()  # empty if the response is exact
    errors: RandomErrors | None = None
    shared: float = 1.0
    clock: float = 0.0
    scale: float = 0.0  # bound of the relative error of the reference's sensor, common to all values

    @classmethod
    def of(
        cls, error: Array, degrees: Array, limits: Mapping[str, Array] | None = None, **fields: Any
    ) -> UncertaintyBudget:
        """Make a budget from the scatter and the bounds of systematic errors by name."""
        contributions = [Contribution(name, "B", bound) for name, bound in (limits or {}).items()]
        return cls((Contribution(SCATTER, "A", error, degrees), *contributions), **fields)

    @property
    def limits(self) -> dict[str, Array]:
        """Bounds of the systematic errors (type B) by name."""
        return {cause.name: cause.deviation for cause in self.contributions if cause.evaluation == "B"}

    @property
    def scatter(self) -> Contribution | None:
        """Contribution of type A."""
        return next((cause for cause in self.contributions if cause.evaluation == "A"), None)

    def random_bound(self, confidence: float = 0.95) -> Array | float:
        """Return the expanded uncertainty from the scatter alone: radius of a circle in the complex plane.

        The two components have equal, independent errors, so that the squared deviation of a complex mean is
        F-distributed with 2 and `degrees` degrees of freedom.
        """
        return 0.0 if self.scatter is None else self.scatter.bound(confidence)

    @property
    def combined_limit(self) -> Array | float:
        """Root of the sum of squares of the bounds of systematic errors, without the tolerances of data sheets."""
        bounds = [bound for name, bound in self.limits.items() if name not in TOLERANCES]
        return np.asarray(np.linalg.norm(bounds, axis=0)) if bounds else 0.0

    def systematic_bound(self) -> Array | float:
        """Return `combined_limit` plus the tolerances of data sheets."""
        return self.combined_limit + self._tolerances()

    def bound(self, confidence: float = 0.95) -> Array | float:
        """Return the expanded uncertainty: the radius of the circle that contains the true value.

        It is the root sum of squares of the random bound and `combined_limit`, plus the tolerances of data sheets;
        infinite where a contribution is unbounded.
        """
        without_tolerances = np.hypot(self.random_bound(confidence), self.combined_limit)
        return np.asarray(without_tolerances + self._tolerances())

    def _tolerances(self) -> Array | float:
        limits = self.limits
        return np.asarray(sum(limits[name] for name in TOLERANCES if name in limits))

    def largest_contributions(self) -> list[str]:
        """Return the name of the largest contribution to the bound at each line of a curve."""
        bounds = np.nan_to_num([cause.bound() for cause in self.contributions], posinf=np.inf)
        return [self.contributions[index].name for index in np.argmax(bounds, axis=0)]

    def covariance(self, shape: tuple[int, ...]) -> Covariance:
        """Return the covariance of the random errors over the elements of a response of a given shape."""
        error = np.zeros(shape) if self.scatter is None else self.scatter.deviation
        error = np.reshape(error, (shape[0], -1))
        if self.errors is not None:
            return self.errors.covariance(error, self.shared)
        lines = np.einsum("ka,ab->kab", 2.0 * error**2, np.eye(error.shape[1])).astype(complex)
        return LineCovariance(lines, self.shared)

    def at(self, lines: Any) -> UncertaintyBudget:
        """Select some lines."""
        return self.with_arrays(lambda array: array[lines], None if self.errors is None else self.errors.at(lines))

    def scaled(self, factor: ComplexArray) -> UncertaintyBudget:
        """Return the budget of the values times a factor at each line."""
        errors = None if self.errors is None else self.errors.scaled(factor)

        def multiply(deviation: Array) -> Array:
            return np.asarray(deviation * np.reshape(abs(factor), (-1, *[1] * (deviation.ndim - 1))))

        contributions = tuple(replace(cause, deviation=multiply(cause.deviation)) for cause in self.contributions)
        return replace(self, contributions=contributions, errors=errors)

    def with_limits(self, limits: Mapping[str, Array]) -> UncertaintyBudget:
        """Add bounds of systematic errors by name, or replace those of the same name."""
        unchanged = tuple(cause for cause in self.contributions if cause.name not in limits)
        return replace(
            self, contributions=(*unchanged, *(Contribution(name, "B", bound) for name, bound in limits.items()))
        )

    def without(self, *names: str) -> UncertaintyBudget:
        """Remove contributions."""
        return replace(self, contributions=tuple(cause for cause in self.contributions if cause.name not in names))

    def with_gaps(self, lines: NDArray[np.intp]) -> UncertaintyBudget:
        """Insert a line of NaN before each of the given lines."""
        return self.with_arrays(lambda array: np.insert(array, lines, np.nan, axis=0), None)

    def with_arrays(self, change: Callable[[Array], Array], errors: RandomErrors | None) -> UncertaintyBudget:
        """Return the budget with a function applied to the arrays of all contributions, and with other `errors`."""
        contributions = tuple(
            replace(
                cause,
                deviation=change(cause.deviation),
                degrees=None if cause.degrees is None else change(cause.degrees),
            )
            for cause in self.contributions
        )
        return replace(self, contributions=contributions, errors=errors)


def stack_budgets(budgets: Sequence[UncertaintyBudget], shape: tuple[int, ...]) -> UncertaintyBudget:
    """Join the budgets of curves over the same lines to the budget of values of a shape (lines, outputs, inputs)."""
    names = dict.fromkeys((cause.name, cause.evaluation) for budget in budgets for cause in budget.contributions)
    lines = shape[0]

    def join(columns: Sequence[Array | None]) -> Array:
        values = [np.zeros(lines) if column is None else column for column in columns]
        return np.stack(values, axis=1).reshape(shape)

    contributions = []
    for name, evaluation in names:
        by_curve = [next((cause for cause in budget.contributions if cause.name == name), None) for budget in budgets]
        contributions.append(
            Contribution(
                name,
                evaluation,
                join([None if cause is None else cause.deviation for cause in by_curve]),
                join([None if cause is None else cause.degrees for cause in by_curve]) if evaluation == "A" else None,
            )
        )
    first, *others = (budget.errors for budget in budgets)
    other_errors = [errors for errors in others if errors is not None]
    joined = first.joined(other_errors) if first is not None and len(other_errors) == len(others) else None
    shared, clock, scale = (max(getattr(budget, name) for budget in budgets) for name in ("shared", "clock", "scale"))
    return UncertaintyBudget(tuple(contributions), joined, shared, clock, scale)


@dataclass(frozen=True)
class LineCovariance:
    """A `Covariance` of errors that are independent from line to line, except for `shared`."""

    lines: ComplexArray
    shared: float = 1.0
    reference: Array | None = field(default=None, init=False)

    def at(self, lines: Lines) -> LineCovariance:
        """Select some lines."""
        return replace(self, lines=self.lines[lines])

    def select(self, elements: Sequence[int]) -> LineCovariance:
        """Select some elements."""
        return replace(self, lines=self.lines[:, elements][:, :, elements])

    def of_sums(self, weights: ComplexArray) -> Array:
        """Return the covariance of weighted sums over lines and elements."""
        complex_sum = np.einsum("kap,kac,kcq->pq", weights.conj(), self.lines, weights, optimize=True)
        return np.asarray(0.5 * self.shared * complex_sum.real)


@dataclass(frozen=True)
class BudgetTable:
    """Uncertainty budget of one value as text: contributions, type, standard uncertainty, share of the variance.

    `value`, `expanded`: magnitude and expanded uncertainty (radius of the 95 % circle), in `unit`.

    `rows`: name, type, standard uncertainty in `unit`, share of the combined variance; largest first.
    """

    title: str  # ratio and frequency of the value
    value: float
    expanded: float
    unit: str
    rows: tuple[tuple[str, str, float, float], ...]

    @property
    def combined(self) -> float:
        """Combined standard uncertainty (GUM 5.1.2)."""
        return float(np.linalg.norm([row[2] for row in self.rows]))

    def __str__(self) -> str:
        heading = ("contribution", "type", f"standard uncertainty / ({self.unit})", "share")
        body = [
            (name, evaluation, f"{standard:.2g}", "-" if np.isnan(share) else f"{100.0 * share:.1f} %")
            for name, evaluation, standard, share in self.rows
        ]
        body.append(("combined", "", f"{self.combined:.2g}", ""))
        widths = [max(len(row[k]) for row in (heading, *body)) for k in range(4)]
        lines = [
            "  ".join(
                cell.ljust(width) if k < 2 else cell.rjust(width)
                for k, (cell, width) in enumerate(zip(row, widths, strict=True))
            ).rstrip()
            for row in (heading, *body)
        ]
        magnitude = round_to_bound(self.value, self.expanded)
        expanded = round_to_bound(self.expanded, self.expanded) if np.isfinite(self.expanded) else "unbounded"
        return "\n".join([f"{self.title}: ({magnitude} ± {expanded}) {self.unit}, 95 % confidence", *lines])

    __repr__ = __str__


def coverage_factor(confidence: float, degrees: Array) -> Array:
    """Return the coverage factor of a complex mean: radius of its circle relative to the standard uncertainty.

    >>> coverage_factor(0.95, np.array([0.0, 1.0, 30.0])).round(2).tolist()
    [2.45, 19.97, 2.58]
    """
    # Fisher's F with two degrees of freedom of the numerator has a quantile in closed form.
    known = known_degrees(degrees)
    return np.asarray(np.sqrt(known * np.expm1(-2.0 / known * np.log1p(-confidence))))


def known_degrees(degrees: Array) -> Array:
    """Replace unknown degrees of freedom (0) with a number for which the distribution is normal (GUM G.3.4)."""
    return np.where(degrees > 0.0, np.maximum(degrees, 1.0), _NORMAL_DEGREES)
