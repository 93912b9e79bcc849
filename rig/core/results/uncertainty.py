"""Uncertainty as in the GUM, for all results, and the uncertainty budget of a frequency response.

A contribution of type A has a standard uncertainty u and its degrees of freedom. A contribution of type B is a limit of
error ±a with a rectangular distribution, ``u = a / sqrt(3)``. The combined standard uncertainty u_c is the root sum of
squares; errors with the same source are added before they are squared. The expanded uncertainty of a real quantity is
``U = k u_c`` with k = 2, or Student's 95 % quantile for fewer than 50 effective degrees of freedom. U is at most the
sum of the largest limits and of the expanded uncertainty of the other contributions, because no error exceeds its
limit.

The true value of a complex quantity lies within a circle. The radius is computed with the coverage factor 2.45 for type
A. It includes the sum of the limits of all tolerances of data sheets.

A line is one frequency of the response; an entry is one output over one input.

References
----------
JCGM 100:2008, Guide to the expression of uncertainty in measurement (GUM), sections 4.2, 4.3, 5.1, 5.2, 6.3, G.4.
JCGM 102:2011, GUM Supplement 2, section 6.5.2: circular coverage region of two components, k = 2.45.
J. S. Bendat, A. G. Piersol, Random Data, 4th ed., Wiley 2010, section 9.2.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import SceneError
from rig.core.numerics.memory import require_memory_with_program
from rig.core.results.table import Table
from rig.core.results.text import format_quantity, round_to_uncertainty

Lines = NDArray[np.bool_] | NDArray[np.intp]
# Change of a response if an error source is at its limit, by the identity of the source; complex, shape (lines,).
Sources = Mapping[str, ComplexArray]

SCATTER = "scatter"
_ROOT_3 = float(np.sqrt(3.0))
#: Coverage factor of an expanded uncertainty with many degrees of freedom, for a coverage of about 95 % (GUM 6.3.3).
COVERAGE_FACTOR = 2.0
# Number of arrays of the size of a covariance that are in memory at a time while it is computed (measured).
_COVARIANCE_COPIES = 6
# Smaller contributions to a combined uncertainty, relative to it, are listed as an upper limit.
_NEGLIGIBLE_RATIO = 1e-3
# Effective degrees of freedom below which the coverage factor is Student's. Above, k = 2 differs from Student's factor
# by at most 2 %: 2.009 at 50 degrees of freedom, 1.960 in the limit.
_MIN_NORMAL_DEGREES = 50.0
# Degrees of freedom above which Student's t and Fisher's F have their limits to four digits.
_NORMAL_DEGREES = 1e6
#: Names of contributions that are tolerances of data sheets, or contain tolerances. In the radius of a complex value
#: these contributions are added linearly, because clock and sensors of a test may deviate by the full tolerance at the
#: same time.
CLOCK, SENSITIVITY = "sample clock", "sensors' sensitivity"
#: Name of the sum of all systematic errors, if a file gives no separate contributions.
SYSTEMATIC = "systematic errors"
TOLERANCES = (CLOCK, SENSITIVITY, SYSTEMATIC)


class Covariance(Protocol):
    """Covariance of the random errors e of a response, over its entries and lines."""

    @property
    def lines(self) -> ComplexArray:
        """``E[e e^H]`` at each line, shape (lines, entries, entries)."""

    @property
    def shared(self) -> float:
        """Number of adjacent lines that have the same error, because they are computed from the same samples."""

    @property
    def reference(self) -> Array | None:
        """Noise power of the reference, relative to its power, shape (lines,); None if it is not estimated."""

    def at(self, lines: Lines) -> Covariance:
        """Return a copy with only the selected lines."""

    def select(self, entries: Sequence[int]) -> Covariance:
        """Return a copy with only the selected entries of the response matrix."""

    def of_sums(self, weights: ComplexArray) -> Array:
        """Return the covariance of ``Re(sum(conj(weights) e))``, (sums, sums); weights (lines, entries, sums)."""


class RandomErrors(Protocol):
    """Random errors of a response's entries, computed from the errors of the readings; entries may share readings."""

    def at(self, lines: Lines) -> RandomErrors:
        """Return a copy with only the selected lines."""

    def select(self, entries: Sequence[int]) -> RandomErrors:
        """Return a copy with only the selected entries of the response matrix."""

    def scaled(self, factor: ComplexArray) -> RandomErrors:
        """Multiply by a factor at each line."""

    def joined(self, others: Sequence[RandomErrors]) -> RandomErrors | None:
        """Join with the errors of other entries; None if they depend on different readings."""

    def covariance(self, error: Array, shared: float) -> Covariance:
        """Return the covariance over entries, given each entry's standard uncertainty, shape (lines, entries)."""


@dataclass(frozen=True)
class Contribution:
    """One cause of uncertainty.

    `deviation`, with the shape of the values, is the standard uncertainty of the real and of the imaginary part for
    type A (NaN where there is a single average, without scatter), and the limit of error a for type B (infinite where
    it is unbounded).
    """

    name: str
    evaluation: Literal["A", "B"]  # by statistics of the readings, or by other knowledge (GUM 4.2, 4.3)
    deviation: Array
    degrees_of_freedom: Array | None = None  # degrees of freedom of type A
    # Type B only: for each entry in C order, the change of its value if the error of a source (sensor or clock)
    # equals its limit; complex, shape (lines,). The key identifies the source, because other responses may have the
    # same source. Empty: the source is unknown.
    sources: tuple[Sources, ...] = ()

    @property
    def degrees(self) -> Array:
        """`degrees_of_freedom`; 0 where they are unknown."""
        return np.zeros(self.deviation.shape) if self.degrees_of_freedom is None else self.degrees_of_freedom

    def standard(self) -> Array:
        """Return the standard uncertainty; type B has a rectangular distribution (GUM 4.3.7)."""
        return self.deviation if self.evaluation == "A" else standard_of_limit(np.linalg.norm(self.limits(), axis=0))

    def limits(self) -> Array:
        """Return the limits of error of the independent sources of type B, (sources, *shape of the values).

        The sum of the limits is `deviation`. It exceeds the sum of the changes in `sources` where the effect is not
        linear.
        """
        if not any(self.sources):
            return self.deviation[None]
        count = max(map(len, self.sources))
        sizes = np.zeros((count, len(self.deviation), len(self.sources)))
        for entry, sources in enumerate(self.sources):
            for number, change in enumerate(sources.values()):
                sizes[number, :, entry] = abs(change)
        total = sizes.sum(axis=0)
        is_known = (total > 0.0) & np.isfinite(total)
        shares = np.where(is_known, sizes, 0.0) / np.where(is_known, total, 1.0)
        shares[0] += ~is_known
        shares = shares.reshape(count, *self.deviation.shape)
        # A source without effect has the limit 0, even if the limits of other sources are infinite.
        return np.multiply(shares, self.deviation, where=shares > 0.0, out=np.zeros_like(shares))

    def changed(self, change: Callable[[NDArray[Any]], NDArray[Any]]) -> Contribution:
        """Apply a function to the lines of all arrays."""
        return replace(
            self,
            deviation=change(self.deviation),
            degrees_of_freedom=None if self.degrees_of_freedom is None else change(self.degrees_of_freedom),
            sources=tuple({key: change(array) for key, array in entry.items()} for entry in self.sources),
        )


@dataclass(frozen=True)
class UncertaintyBudget:
    """Contributions to the uncertainty of a response.

    `errors`: random errors of the entries, for their covariance; None: they are independent. `shared`: number of
    adjacent lines that have the same error, because they are computed from the same samples. `clock`: limit of the
    relative error of the sample clock, and therefore of all frequencies; its effect on the values is one of the
    contributions.
    """

    contributions: tuple[Contribution, ...] = ()  # empty if the response is exact
    errors: RandomErrors | None = None
    shared: float = 1.0
    clock: float = 0.0
    scale: float = 0.0  # limit of the relative error of the reference's sensor, common to all values

    @classmethod
    def of(
        cls,
        error: Array,
        degrees_of_freedom: Array,
        limits: Mapping[str, Array] | None = None,
        sources: Mapping[str, Sources] | None = None,
        **fields: Any,
    ) -> UncertaintyBudget:
        """Make the budget of a curve from the scatter, and from limits of error with their sources by name."""
        by_name = sources or {}
        contributions = [
            Contribution(name, "B", limit, sources=(by_name[name],) if name in by_name else ())
            for name, limit in (limits or {}).items()
        ]
        return cls((Contribution(SCATTER, "A", error, degrees_of_freedom), *contributions), **fields)

    @property
    def limits(self) -> dict[str, Array]:
        """Limits of error (type B) by name."""
        return {cause.name: cause.deviation for cause in self.contributions if cause.evaluation == "B"}

    @property
    def scatter(self) -> Contribution | None:
        """Contribution of type A."""
        return next((cause for cause in self.contributions if cause.evaluation == "A"), None)

    def combined(self) -> Array | float:
        """Return the combined standard uncertainty u_c of the real and of the imaginary part (GUM 5.1.2)."""
        standard = [cause.standard() for cause in self.contributions]
        return np.asarray(np.linalg.norm(standard, axis=0)) if standard else 0.0

    def expanded(self) -> Array | float:
        """Return the expanded uncertainty U of a real quantity, such as the magnitude or a component of the values."""
        limits = [limit for cause in self.contributions if cause.evaluation == "B" for limit in cause.limits()]
        scatter = self.scatter
        return expand(0.0, limits) if scatter is None else expand(scatter.deviation, limits, scatter.degrees)

    def random_bound(self, confidence: float = 0.95) -> Array | float:
        """Return the radius of the circle that contains the errors of type A.

        The real and imaginary parts have equal, independent errors, so the squared deviation of a complex mean is
        F-distributed with 2 and `degrees_of_freedom` degrees of freedom.
        """
        scatter = self.scatter
        return 0.0 if scatter is None else scatter.deviation * circle_factor(confidence, scatter.degrees)

    def expanded_systematic(self) -> Array | float:
        """Return the expanded uncertainty of the contributions of type B, plus the tolerances of data sheets."""
        return self._radius(0.0)

    def bound(self, confidence: float = 0.95) -> Array | float:
        """Return the radius of the circle with the true value; infinite where a contribution is unbounded."""
        return self._radius(self.random_bound(confidence))

    def _radius(self, random_bound: Array | float) -> Array | float:
        limits = self.limits
        others = [limit for name, limit in limits.items() if name not in TOLERANCES]
        tolerances = sum(limits[name] for name in TOLERANCES if name in limits)
        return np.asarray(expand(np.asarray(random_bound) / COVERAGE_FACTOR, others) + tolerances)

    def largest_contributions(self) -> list[str]:
        """Return the name of the contribution with the largest share of the variance at each line of a curve."""
        standard = np.nan_to_num([cause.standard() for cause in self.contributions], posinf=np.inf)
        return [self.contributions[index].name for index in np.argmax(standard, axis=0)]

    def covariance(self, shape: tuple[int, ...]) -> Covariance:
        """Return the covariance of the random errors over the entries of a response of a given shape.

        Raises `RunError` if its arrays would exceed the memory limit.
        """
        error = np.zeros(shape) if self.scatter is None else self.scatter.deviation
        error = np.reshape(error, (shape[0], -1))
        n_lines, entries = error.shape
        purpose = f"the covariance of {entries} responses at {n_lines} frequencies"
        require_memory_with_program(_COVARIANCE_COPIES * 16.0 * n_lines * entries**2, purpose)
        if self.errors is not None:
            return self.errors.covariance(error, self.shared)
        lines = np.einsum("ka,ab->kab", 2.0 * error**2, np.eye(error.shape[1])).astype(complex)
        return LineCovariance(lines, self.shared)

    def at(self, lines: Any) -> UncertaintyBudget:
        """Return a copy with only the selected lines."""
        return self.with_arrays(lambda array: array[lines], None if self.errors is None else self.errors.at(lines))

    def scaled(self, factor: ComplexArray) -> UncertaintyBudget:
        """Return the budget of the values times a factor at each line."""
        errors = None if self.errors is None else self.errors.scaled(factor)

        def multiply(cause: Contribution) -> Contribution:
            size = np.reshape(abs(factor), (-1, *[1] * (cause.deviation.ndim - 1)))
            sources = tuple({key: change * factor for key, change in entry.items()} for entry in cause.sources)
            return replace(cause, deviation=cause.deviation * size, sources=sources)

        return replace(self, contributions=tuple(map(multiply, self.contributions)), errors=errors)

    def with_limits(self, limits: Mapping[str, Array]) -> UncertaintyBudget:
        """Add limits of systematic errors by name, or replace limits of the same name."""
        unchanged = tuple(cause for cause in self.contributions if cause.name not in limits)
        return replace(
            self, contributions=(*unchanged, *(Contribution(name, "B", bound) for name, bound in limits.items()))
        )

    def without(self, *names: str) -> UncertaintyBudget:
        """Return the budget without the contributions of these names."""
        return replace(self, contributions=tuple(cause for cause in self.contributions if cause.name not in names))

    def with_gaps(self, lines: NDArray[np.intp]) -> UncertaintyBudget:
        """Insert a line of NaN before each of the given lines."""
        return self.with_arrays(lambda array: np.insert(array, lines, np.nan, axis=0), None)

    def with_arrays(
        self, change: Callable[[NDArray[Any]], NDArray[Any]], errors: RandomErrors | None
    ) -> UncertaintyBudget:
        """Return the budget with a function applied to the lines of all arrays, and with new `errors`."""
        contributions = tuple(cause.changed(change) for cause in self.contributions)
        return replace(self, contributions=contributions, errors=errors)

    def select(self, selection: Any, entries: Sequence[int]) -> UncertaintyBudget:
        """Select entries; `selection`: index of the arrays, `entries`: the same entries, counted in C order."""
        contributions = tuple(
            replace(
                cause,
                deviation=cause.deviation[selection],
                degrees_of_freedom=None if cause.degrees_of_freedom is None else cause.degrees_of_freedom[selection],
                sources=tuple(cause.sources[k] for k in entries) if cause.sources else (),
            )
            for cause in self.contributions
        )
        return replace(
            self, contributions=contributions, errors=None if self.errors is None else self.errors.select(entries)
        )

    def of_ratio(self, other: UncertaintyBudget, value: ComplexArray, other_value: ComplexArray) -> UncertaintyBudget:
        """Return the budget of the ratio of two curves at the same lines.

        Relative changes by a common source, and random errors of common readings, are subtracted before they are
        squared (GUM 5.2.2). Tolerances of unknown sources are added. All other errors are treated as independent.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            relative = self.scaled(1.0 / value), other.scaled(1.0 / other_value)
            causes = [cause for budget in relative for cause in budget.contributions]
            joined = [
                _ratio_of([cause for cause in causes if cause.name == name])
                for name in dict.fromkeys(cause.name for cause in causes)
            ]
            difference = _standard_of_difference(*relative)
            if difference is not None:
                joined = [replace(c, deviation=difference) if c.evaluation == "A" else c for c in joined]
            return UncertaintyBudget(tuple(joined), shared=max(self.shared, other.shared)).scaled(value / other_value)


def _standard_of_difference(first: UncertaintyBudget, second: UncertaintyBudget) -> Array | None:
    """Return the standard uncertainty of the difference of two curves; None unless they share their readings."""
    joined = None if first.errors is None or second.errors is None else first.errors.joined([second.errors])
    if joined is None or first.scatter is None or second.scatter is None:
        return None
    error = np.stack([first.scatter.deviation, second.scatter.deviation], axis=1)
    lines = joined.covariance(error, first.shared).lines
    variance = 0.5 * (lines[:, 0, 0] + lines[:, 1, 1] - 2.0 * lines[:, 0, 1]).real
    return np.sqrt(np.maximum(variance, 0.0))


def _ratio_of(causes: Sequence[Contribution]) -> Contribution:
    """Combine the relative contributions of the same name from numerator and denominator of a ratio."""
    first, *others = causes
    if not others:
        return first
    deviations = [cause.deviation for cause in causes]
    if all(cause.sources for cause in causes):
        (numerator,), (denominator,) = (cause.sources for cause in causes)
        zero = np.zeros(first.deviation.shape, dtype=complex)
        changes = {key: numerator.get(key, zero) - denominator.get(key, zero) for key in {**numerator, **denominator}}
        total = np.linalg.norm(list(changes.values()), ord=1, axis=0)
        return replace(first, deviation=total, sources=(changes,))
    total = np.sum(deviations, axis=0) if first.name in TOLERANCES else np.linalg.norm(deviations, axis=0)
    degrees_of_freedom = [cause.degrees_of_freedom for cause in causes if cause.degrees_of_freedom is not None]
    return replace(
        first,
        deviation=total,
        degrees_of_freedom=np.min(degrees_of_freedom, axis=0) if degrees_of_freedom else None,
        sources=(),
    )


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
        deviation = join([None if cause is None else cause.deviation for cause in by_curve])
        degrees = join([None if cause is None else cause.degrees_of_freedom for cause in by_curve])
        sources = tuple(cause.sources[0] if cause is not None and cause.sources else {} for cause in by_curve)
        known_sources = sources if any(sources) else ()
        contributions.append(
            Contribution(name, evaluation, deviation, degrees if evaluation == "A" else None, known_sources)
        )
    first, *others = (budget.errors for budget in budgets)
    other_errors = [errors for errors in others if errors is not None]
    joined = first.joined(other_errors) if first is not None and len(other_errors) == len(others) else None
    shared, clock, scale = (max(getattr(budget, name) for budget in budgets) for name in ("shared", "clock", "scale"))
    return UncertaintyBudget(tuple(contributions), joined, shared, clock, scale)


@dataclass(frozen=True)
class LineCovariance:
    """A `Covariance` of errors that are independent from line to line, except for `shared` adjacent lines."""

    lines: ComplexArray
    shared: float = 1.0
    reference: Array | None = field(default=None, init=False)

    def at(self, lines: Lines) -> LineCovariance:
        """Return a copy with only the selected lines."""
        return replace(self, lines=self.lines[lines])

    def select(self, entries: Sequence[int]) -> LineCovariance:
        """Return a copy with only the selected entries of the response matrix."""
        return replace(self, lines=self.lines[:, entries][:, :, entries])

    def of_sums(self, weights: ComplexArray) -> Array:
        """Return the covariance of weighted sums over lines and entries."""
        complex_sum = np.einsum("kap,kac,kcq->pq", weights.conj(), self.lines, weights, optimize=True)
        return np.asarray(0.5 * self.shared * complex_sum.real)


@dataclass(frozen=True)
class BudgetTable:
    """Uncertainty budget of one value as text: contributions, type, standard uncertainty, share of the variance.

    `value`, `expanded`: magnitude and its expanded uncertainty U, in `unit`.

    `rows`: name, type, standard uncertainty in `unit`, share of the combined variance; largest first.
    """

    title: str  # ratio and frequency of the value
    value: float
    expanded: float
    unit: str
    rows: tuple[tuple[str, str, float, float], ...]
    missing: tuple[str, ...] = ()  # contributions of unknown size

    @property
    def combined(self) -> float:
        """Combined standard uncertainty (GUM 5.1.2)."""
        return float(np.linalg.norm([row[2] for row in self.rows]))

    @property
    def heading(self) -> str:
        """Ratio and frequency, with the value and its 95 % interval."""
        return f"{self.title}: {format_quantity(self.value, self.expanded, self.unit)} (95 %)"

    def table(self) -> Table:
        """Return the contributions, their combined standard uncertainty and the expanded uncertainty."""
        least = float(f"{_NEGLIGIBLE_RATIO * self.combined:.1g}") if np.isfinite(self.combined) else 0.0
        rows = [
            (
                name, evaluation, f"< {least:g}" if standard < least else round_to_uncertainty(standard, standard),
                f"{100.0 * share:.0f} %" if np.isfinite(share) else "–",
            )
            for name, evaluation, standard, share in self.rows
        ]  # fmt: skip
        rows += [(name, "B", "not included", "–") for name in self.missing]
        factor = self.expanded / self.combined if self.combined else COVERAGE_FACTOR
        combined, expanded = (round_to_uncertainty(each, each) for each in (self.combined, self.expanded))
        rows.append(("combined, u", "", combined, ""))
        rows.append((f"expanded, U = k u, k = {factor:.2f}", "", expanded, ""))
        heading = ("contribution", "type (GUM)", f"standard uncertainty / ({self.unit})", "share of the variance")
        return Table(heading, "<<>>", rows)

    def __str__(self) -> str:
        return "\n".join([self.heading, *self.table().lines()])

    __repr__ = __str__


def expand(standard: ArrayLike, limits: Sequence[ArrayLike] = (), degrees_of_freedom: ArrayLike = 0.0) -> Array:
    """Return the expanded uncertainty U of a real quantity, for a coverage of about 95 %.

    `standard`: standard uncertainty u of all contributions without a limit; `limits`: limits of error a of independent
    contributions, in the shape of `standard`; `degrees_of_freedom`: those of `standard`, 0 where they are unknown.

    The scatter of ten readings; two limits of error; and a single limit, which is never exceeded:

    >>> [round(float(expand(*of)), 3) for of in ((1.0, (), 9), (0.0, (1.0, 1.0)), (0.0, (1.0,)))]
    [2.262, 1.633, 1.0]
    """
    # The 95 % quantile of a rectangular distribution is below its limit. The largest limits are therefore added, too.
    standard, *limits = np.broadcast_arrays(np.asarray(standard, dtype=float), *limits)
    descending = -np.sort([-limit for limit in limits], axis=0)
    whole: Array = np.zeros(standard.shape)
    expanded = np.full(standard.shape, np.inf)
    for count in range(len(descending) + 1):
        combined = np.linalg.norm([standard, *standard_of_limit(descending[count:])], axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            # Welch-Satterthwaite formula (GUM G.4.1).
            effective = np.nan_to_num(degrees_of_freedom * (combined / standard) ** 4, nan=0.0, posinf=_NORMAL_DEGREES)
        expanded = np.minimum(expanded, whole + coverage_factor(effective) * combined)
        if count < len(descending):
            whole = whole + descending[count]
    return np.asarray(expanded)


def standard_of_limit(limit: ArrayLike) -> Array:
    """Return the standard uncertainty of an error within ±limit, with a rectangular distribution (GUM 4.3.7)."""
    return np.asarray(limit, dtype=float) / _ROOT_3


def coverage_factor(degrees_of_freedom: ArrayLike, confidence: float = 0.95) -> Array:
    """Return the coverage factor k of an expanded uncertainty (GUM 6.3.3, G.4); degrees of freedom 0: unknown.

    >>> coverage_factor([0.0, 3.0, 30.0, 100.0]).round(2).tolist()
    [2.0, 3.18, 2.04, 2.0]
    """
    known = known_degrees(np.asarray(degrees_of_freedom, dtype=float))
    factor = np.full(known.shape, COVERAGE_FACTOR)
    has_own_factor = (known < _MIN_NORMAL_DEGREES) | (confidence != 0.95)
    scipy.special.stdtrit(known, 0.5 + confidence / 2.0, out=factor, where=has_own_factor)
    return factor


def circle_factor(confidence: float, degrees_of_freedom: Array) -> Array:
    """Return the coverage factor of a complex mean: radius of the circle over standard uncertainty of a component.

    >>> circle_factor(0.95, np.array([0.0, 1.0, 30.0])).round(2).tolist()
    [2.45, 19.97, 2.58]
    """
    if not (isinstance(confidence, float) and 0.0 < confidence < 1.0):
        raise SceneError(f"confidence: got {confidence}; expected a probability between 0 and 1, such as 0.95")
    # Fisher's F with two degrees of freedom of the numerator has a quantile in closed form.
    known = known_degrees(degrees_of_freedom)
    return np.asarray(np.sqrt(known * np.expm1(-2.0 / known * np.log1p(-confidence))))


def known_degrees(degrees_of_freedom: Array) -> Array:
    """Replace unknown degrees of freedom (0) with a number so large that the distribution is normal (GUM G.3.4)."""
    return np.where(degrees_of_freedom > 0.0, np.maximum(degrees_of_freedom, 1.0), _NORMAL_DEGREES)
