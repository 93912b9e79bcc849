"""Uncertainty budget of a response: its contributions by name and type, as the GUM lists them, and their sums.

References
----------
JCGM 100:2008, Guide to the expression of uncertainty in measurement (GUM), sections 4.2, 4.3 and 5.1.
J. S. Bendat, A. G. Piersol, Random Data, 4th ed., Wiley 2010, section 9.2.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import special

from rig.arrays import Array, ComplexArray
from rig.results.text import rounded

Lines = NDArray[np.bool_] | NDArray[np.intp]

SCATTER = "scatter"
#: Tolerances of data sheets. They are added linearly, as a test's clock and sensors may differ by all of them.
CLOCK, SENSITIVITY = "sample clock", "sensors' sensitivity"
TOLERANCES = (CLOCK, SENSITIVITY)


class Covariance(Protocol):
    """Covariance of the random errors of a response's elements, at each line and from line to line."""

    @property
    def lines(self) -> ComplexArray:
        """``E[e e^H]`` at each line, shape (lines, elements, elements)."""

    @property
    def shared(self) -> float:
        """Number of neighbouring lines that have one error."""

    @property
    def reference(self) -> Array | None:
        """Noise in the reference as a share of its power, shape (lines,); None where it is not estimated."""

    def at(self, lines: Lines) -> Covariance:
        """Select some lines."""

    def select(self, elements: Sequence[int]) -> Covariance:
        """Select some elements."""

    def of_sums(self, weights: ComplexArray) -> Array:
        """Covariance of ``Re(sum(conj(weights) e))``; weights (lines, elements, sums), result (sums, sums)."""


class RandomErrors(Protocol):
    """Dependence of the random errors of a response's elements on those of the readings."""

    def at(self, lines: Lines) -> RandomErrors:
        """Select some lines."""

    def select(self, elements: Sequence[int]) -> RandomErrors:
        """Select some elements."""

    def scaled(self, factor: ComplexArray) -> RandomErrors:
        """Multiply by a factor at each line."""

    def joined(self, others: Sequence[RandomErrors]) -> RandomErrors | None:
        """Errors of these and other elements; None where they rest on different readings."""

    def covariance(self, error: Array, shared: float) -> Covariance:
        """Covariance over elements, given each element's standard uncertainty, shape (lines, elements)."""


@dataclass(frozen=True)
class Contribution:
    """One cause of uncertainty.

    `size`: type A: standard uncertainty of either quadrature component, NaN where one average gives no scatter. Type
    B: largest deviation, infinite where it is unbounded.
    """

    name: str
    evaluation: Literal["A", "B"]  # by statistics of the readings, or by other knowledge (GUM 4.2, 4.3)
    size: Array
    degrees: Array | None = None  # degrees of freedom of type A

    def standard(self) -> Array:
        """Give the standard uncertainty; a largest deviation counts as a uniform distribution (GUM 4.3.7)."""
        return self.size if self.evaluation == "A" else self.size / np.sqrt(3.0)

    def bound(self, confidence: float = 0.95) -> Array:
        """Radius of the circle in the complex plane that this contribution alone needs."""
        if self.evaluation == "B" or self.degrees is None:
            return self.size
        return self.size * radius(confidence, self.degrees)


@dataclass(frozen=True)
class UncertaintyBudget:
    """Contributions to the uncertainty of a response.

    `errors`: of the elements, for their covariance; omitted, they are independent; `shared`: number of neighbouring
    lines that rest on the same samples, so that they have one error; `clock`: largest relative error of all
    frequencies by the sample clock; its effect on values is a contribution.
    """

    contributions: tuple[Contribution, ...] = ()  # empty where a response is exact
    errors: RandomErrors | None = None
    shared: float = 1.0
    clock: float = 0.0
    scale: float = 0.0  # largest relative error that the sensor of the reference causes in all values alike

    @classmethod
    def of(
        cls, error: Array, degrees: Array, limits: Mapping[str, Array] | None = None, **fields: Any
    ) -> UncertaintyBudget:
        """Make a budget of the scatter and of limits by name."""
        parts = [Contribution(name, "B", limit) for name, limit in (limits or {}).items()]
        return cls((Contribution(SCATTER, "A", error, degrees), *parts), **fields)

    @property
    def limits(self) -> dict[str, Array]:
        """Largest deviations of type B by name."""
        return {each.name: each.size for each in self.contributions if each.evaluation == "B"}

    @property
    def scatter(self) -> Contribution | None:
        """Contribution of type A."""
        return next((each for each in self.contributions if each.evaluation == "A"), None)

    def random_bound(self, confidence: float = 0.95) -> Array | float:
        """Radius of the circle that contains the mean of many such measurements with the given confidence.

        A complex mean with equal, independent errors in its two components is F-distributed about the truth with 2 and
        the stated degrees of freedom.
        """
        return 0.0 if self.scatter is None else self.scatter.bound(confidence)

    def limit(self, names: Collection[str] | None = None, without: Collection[str] = ()) -> Array | float:
        """Root of the sum of squares of limits, all or those of some names."""
        sizes = [
            size
            for name, size in self.limits.items()
            if (names is None or name in names) and name not in without
        ]
        return np.asarray(np.linalg.norm(sizes, axis=0)) if sizes else 0.0

    def systematic_bound(self) -> Array | float:
        """Root of the sum of squares of the limits, plus the tolerances of data sheets."""
        return self.limit(without=TOLERANCES) + self._tolerances()

    def bound(self, confidence: float = 0.95) -> Array | float:
        """Radius of the circle that contains the true value with the given confidence; infinite where a part is."""
        uncertain = np.hypot(self.random_bound(confidence), self.limit(without=TOLERANCES))
        return np.asarray(uncertain + self._tolerances())

    def _tolerances(self) -> Array | float:
        limits = self.limits
        return np.asarray(sum(limits[name] for name in TOLERANCES if name in limits))

    def largest(self) -> list[str]:
        """Name of the largest contribution to the bound at each line of a curve."""
        sizes = np.nan_to_num([each.bound() for each in self.contributions], posinf=np.inf)
        return [self.contributions[index].name for index in np.argmax(sizes, axis=0)]

    def covariance(self, shape: tuple[int, ...]) -> Covariance:
        """Covariance of the random errors over the elements of a response of some shape."""
        error = np.zeros(shape) if self.scatter is None else self.scatter.size
        error = np.reshape(error, (shape[0], -1))
        if self.errors is not None:
            return self.errors.covariance(error, self.shared)
        lines = np.einsum("ka,ab->kab", 2.0 * error**2, np.eye(error.shape[1])).astype(complex)
        return LineCovariance(lines, self.shared)

    def at(self, lines: Any) -> UncertaintyBudget:
        """Select some lines."""
        return self.each(lambda part: part[lines], None if self.errors is None else self.errors.at(lines))

    def scaled(self, factor: ComplexArray) -> UncertaintyBudget:
        """Budget of the values times a factor at each line."""
        errors = None if self.errors is None else self.errors.scaled(factor)

        def times(size: Array) -> Array:
            return np.asarray(size * np.reshape(abs(factor), (-1, *[1] * (size.ndim - 1))))

        parts = tuple(replace(each, size=times(each.size)) for each in self.contributions)
        return replace(self, contributions=parts, errors=errors)

    def with_limits(self, limits: Mapping[str, Array]) -> UncertaintyBudget:
        """Add limits by name, or replace those of the same name."""
        kept = tuple(each for each in self.contributions if each.name not in limits)
        return replace(
            self, contributions=(*kept, *(Contribution(name, "B", size) for name, size in limits.items()))
        )

    def without(self, *names: str) -> UncertaintyBudget:
        """Remove contributions."""
        return replace(
            self, contributions=tuple(each for each in self.contributions if each.name not in names)
        )

    def with_gaps(self, places: NDArray[np.intp]) -> UncertaintyBudget:
        """Insert unknown lines in front of some lines."""
        return self.each(lambda part: np.insert(part, places, np.nan, axis=0), None)

    def each(self, change: Callable[[Array], Array], errors: RandomErrors | None) -> UncertaintyBudget:
        """Change the arrays of all contributions."""
        parts = tuple(
            replace(
                each, size=change(each.size), degrees=None if each.degrees is None else change(each.degrees)
            )
            for each in self.contributions
        )
        return replace(self, contributions=parts, errors=errors)


def stacked(budgets: Sequence[UncertaintyBudget], shape: tuple[int, ...]) -> UncertaintyBudget:
    """Join the budgets of curves over the same lines to that of a matrix of values of some shape."""
    names = dict.fromkeys((each.name, each.evaluation) for budget in budgets for each in budget.contributions)
    lines = shape[0]

    def together(columns: Sequence[Array | None]) -> Array:
        full = [np.zeros(lines) if column is None else column for column in columns]
        return np.stack(full, axis=1).reshape(shape)

    parts = []
    for name, evaluation in names:
        found = [
            next((each for each in budget.contributions if each.name == name), None) for budget in budgets
        ]
        parts.append(
            Contribution(
                name,
                evaluation,
                together([None if each is None else each.size for each in found]),
                together([None if each is None else each.degrees for each in found])
                if evaluation == "A"
                else None,
            )
        )
    first, *others = (budget.errors for budget in budgets)
    known = [each for each in others if each is not None]
    errors = first.joined(known) if first is not None and len(known) == len(others) else None
    shared, clock, scale = (
        max(getattr(budget, name) for budget in budgets) for name in ("shared", "clock", "scale")
    )
    return UncertaintyBudget(tuple(parts), errors, shared, clock, scale)


@dataclass(frozen=True)
class LineCovariance:
    """A `Covariance` of errors that are independent from line to line, but for `shared`."""

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
        """Covariance of weighted sums over lines and elements."""
        half = np.einsum("kap,kac,kcq->pq", weights.conj(), self.lines, weights, optimize=True)
        return np.asarray(0.5 * self.shared * half.real)


@dataclass(frozen=True)
class BudgetTable:
    """Uncertainty budget of one value as text: contributions, type, standard uncertainty, share of the variance.

    `value`, `expanded`: magnitude and radius of its 95 % circle, in `unit`.

    `rows`: name, type, standard uncertainty in `unit`, share of the combined variance; largest first.
    """

    title: str  # what the value is of
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
            (name, kind, f"{size:.2g}", "-" if np.isnan(share) else f"{share:.1%}")
            for name, kind, size, share in self.rows
        ]
        body.append(("combined", "", f"{self.combined:.2g}", ""))
        widths = [max(len(row[k]) for row in (heading, *body)) for k in range(4)]
        lines = [
            "  ".join(
                cell.ljust(w) if k < 2 else cell.rjust(w)
                for k, (cell, w) in enumerate(zip(row, widths, strict=True))
            ).rstrip()
            for row in (heading, *body)
        ]
        height = rounded(self.value, self.expanded)
        wide = rounded(self.expanded, self.expanded) if np.isfinite(self.expanded) else "unbounded"
        return "\n".join([f"{self.title}: ({height} ± {wide}) {self.unit}, 95 % confidence", *lines])

    __repr__ = __str__


def radius(confidence: float, degrees: Array) -> Array:
    """Radius of a circle about a complex mean that contains the truth, in standard deviations of a component."""
    return np.asarray(np.sqrt(2.0 * special.fdtri(2.0, np.maximum(degrees, 1.0), confidence)))
