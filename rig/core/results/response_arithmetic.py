"""Responses computed from responses: other quantities, ratios, and values between lines, with their uncertainty."""

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import SceneError
from rig.core.results.interpolation import interpolate_curve, nearest_lines
from rig.core.results.points import MOTIONS, Point
from rig.core.results.response_values import ResponseValues, any_unsteady
from rig.core.results.text import format_frequencies
from rig.core.results.uncertainty import SENSITIVITY, SYSTEMATIC, BudgetTable, stack_budgets
from rig.core.settings.quantities import FREQUENCY, number, positive_values

# Largest relative expanded uncertainty of the highest value if it counts as the peak; otherwise it may be noise.
MAX_PEAK_UNCERTAINTY_RATIO = 0.5
# Largest relative step between neighboring lines that is drawn as a straight line without visible error.
_MAX_STEP = 0.1
# Number of intervals into which interpolated points divide the distance of two lines: the drawn curve looks smooth.
_POINTS_BETWEEN = 16
# Recommended spacing, relative to the spacing of lines between which dampers start to move.
_FINER = 0.25
# Minimum number of lines for interpolation by a model; fewer lines are joined by straight lines.
_MIN_CONTINUED = 12


@dataclass(frozen=True, repr=False, eq=False)
class ResponseArithmetic(ResponseValues):
    """A response that can be converted, divided and interpolated."""

    def to(self, motion: str) -> Self:
        """Express the outputs as displacement, velocity or acceleration.

        Examples
        --------
        >>> import rig
        >>> frf = rig.Response.curve(np.array([10.0]), np.array([1e-3j]), "body3")
        >>> print(frf.to("velocity").name, f"{frf.to('velocity').value[0].real:.6f}")
        mobility -0.062832
        """
        if motion not in MOTIONS:
            raise SceneError(f"motion: got {motion!r}; expected {', '.join(MOTIONS)}")
        n_derivatives = MOTIONS.index(motion) - MOTIONS.index(self.motion)
        factor: ComplexArray = np.asarray((2j * np.pi * self.frequency) ** n_derivatives, dtype=complex)
        points = tuple(replace(point, quantity=motion) for point in self.outputs)
        return replace(self.scaled(factor), outputs=points)

    def scaled(self, factor: ComplexArray) -> Self:
        """Multiply by a factor at each line."""
        return replace(
            self,
            value=self.value * factor.reshape(-1, *[1] * (self.value.ndim - 1)),
            uncertainty=self.uncertainty.scaled(factor),
        )

    def __truediv__(self, other: Self) -> Self:
        """Return the ratio to another response of the same entries, at the lines of this response.

        The other response is interpolated; outside its frequency range the ratio is NaN. Errors of the same sensor, the
        same clock or the same readings affect both responses; they cancel or add up in the ratio.
        """
        if not isinstance(other, ResponseArithmetic):
            raise TypeError(f"a response is divided by a response, such as responses['body1'], not by {other!r}")
        if self.value.shape[1:] != other.value.shape[1:]:
            raise SceneError(
                f"cannot divide a response of {len(self.outputs)} outputs to {len(self.inputs)} inputs by a response "
                f"of {len(other.outputs)} outputs to {len(other.inputs)} inputs. Select the same outputs and inputs of "
                "both responses."
            )
        other, needed = other._interpolated(self.frequency)
        is_unresolved, notes = np.isfinite(needed), []
        if is_unresolved.any():
            other = replace(
                other, value=np.where(is_unresolved[(...,) + (None,) * (other.value.ndim - 1)], np.nan, other.value)
            )
            notes.append(
                f"No ratio at {format_frequencies(self.frequency.tolist(), is_unresolved.tolist())}: the lines of "
                f"{other.label or other.ratio} do not resolve it there. Measure it at the frequencies of this response."
            )
        with np.errstate(divide="ignore", invalid="ignore"):
            value = np.asarray(self.value / other.value)
        budgets = [
            first.uncertainty.of_ratio(second.uncertainty, first.value, second.value)
            for first, second in zip(self.curves(), other.curves(), strict=True)
        ]
        budget = budgets[0] if self.is_curve else stack_budgets(budgets, value.shape)
        return replace(
            self,
            value=value,
            outputs=tuple(replace(point, quantity="ratio") for point in self.outputs),
            inputs=tuple(
                Point(f"{numerator.name} over {denominator.name}", "ratio")
                for numerator, denominator in zip(self.inputs, other.inputs, strict=True)
            ),
            uncertainty=budget,
            coherence=None,  # type: ignore[arg-type]
            unsteady=any_unsteady((self, other)),
            label=f"{self.label} / {other.label}" if other.label else self.label,
            warnings=tuple(dict.fromkeys([*self.warnings, *other.warnings, *notes])),
        )

    def interpolated(self, frequency: ArrayLike) -> Self:
        """Return the response at one or several other frequencies, Hz or as ``"30 Hz"``; NaN outside its range.

        Between lines the response is a local rational function. The uncertainty includes the uncertainty of the lines,
        and the error of the interpolation (the contribution "spacing of the lines").

        Raises
        ------
        SceneError
            If the lines do not resolve the response at one of the frequencies; the message states the spacing that is
            needed.

        Examples
        --------
        >>> import rig
        >>> lines = np.linspace(10.0, 20.0, 41)
        >>> frf = rig.Response.curve(lines, 1.0 / (15.1**2 - lines**2 + 0.3j * lines), "body3")
        >>> abs(frf.interpolated(15.1).value).round(4).tolist()
        [0.2208]
        """
        result, needed = self._interpolated(positive_values(frequency, FREQUENCY, "frequency"))
        if np.isfinite(needed).any():
            raise SceneError(
                f"{self.label or self.ratio}: the lines do not resolve the response at "
                f"{format_frequencies(result.frequency.tolist(), np.isfinite(needed).tolist())}. Measure there with "
                f"lines at most {needed.min():.1g} Hz apart, or choose a frequency of a line."
            )
        return result

    def _interpolated(self, frequency: Array) -> tuple[Self, Array]:
        """Return `interpolated`, and the line spacing needed at each frequency [Hz]; infinite if the lines suffice."""
        ordered = self.sorted()
        lines, is_line = nearest_lines(ordered.frequency, frequency)
        if is_line.all():
            return ordered.at(lines), np.full(frequency.size, np.inf)
        curves = [
            interpolate_curve(curve.frequency, curve.value, curve.uncertainty, frequency) for curve in ordered.curves()
        ]
        known = [curve for curve in curves if curve is not None]
        if len(known) < len(curves):
            raise SceneError(
                f"{self.label or self.ratio}: fewer than 4 lines have a value, too few to interpolate. Choose a "
                "frequency of a line, or measure at more frequencies."
            )
        shape = (frequency.size, *self.value.shape[1:])

        def interpolate(column: NDArray[Any]) -> NDArray[Any]:
            flat = np.reshape(column, (column.shape[0], -1))
            rows = [np.interp(frequency, ordered.frequency, column, np.nan, np.nan) for column in flat.T]
            return np.stack(rows, axis=1).reshape(frequency.size, *column.shape[1:])

        budgets = [curve.uncertainty for curve in known]
        result = replace(
            ordered,
            frequency=frequency,
            value=np.stack([curve.value for curve in known], axis=1).reshape(shape),
            uncertainty=budgets[0] if self.is_curve else stack_budgets(budgets, shape),
            coherence=interpolate(ordered.coherence),
            unsteady=None if ordered.unsteady is None else interpolate(ordered.unsteady.astype(float)) > 0.0,
            amplitude=None if ordered.amplitude is None else interpolate(ordered.amplitude),
            loading=None if ordered.loading is None else interpolate(ordered.loading),
        )
        needed = [
            np.where(
                measured.loading_beyond(frequency, np.abs(curve.value)) > 0.0,
                _FINER * curve.spacing,
                curve.needed_spacing,
            )
            for measured, curve in zip(ordered.curves(), known, strict=True)
        ]
        return result, np.min(needed, axis=0)

    def continued(self, is_shown: NDArray[np.bool_]) -> tuple[Array, ComplexArray]:
        """Return frequencies and values of the curve through the lines, which are in ascending order, to draw it.

        `is_shown`: flags of the lines that the curve contains; its value is NaN at the other lines. Points are
        interpolated only where neighboring values differ; their value is NaN where the lines do not resolve the
        response.
        """
        f, value = self.frequency, np.where(is_shown, self.value, np.nan)
        with np.errstate(divide="ignore", invalid="ignore"):
            step = np.abs(np.diff(value)) / np.minimum(np.abs(value[1:]), np.abs(value[:-1]))
        is_steep = np.nan_to_num(step) > _MAX_STEP
        if self.resolution > 0.0 or not is_steep.any() or np.isfinite(self.value).sum() < _MIN_CONTINUED:
            return f, value
        fractions = np.linspace(0.0, 1.0, _POINTS_BETWEEN, endpoint=False)[1:]
        between = (f[:-1, None] + np.diff(f)[:, None] * fractions)[is_steep].ravel()
        inner, needed_spacing = self._interpolated(between)
        is_resolved = np.isinf(needed_spacing) & (inner.expanded() <= MAX_PEAK_UNCERTAINTY_RATIO * abs(inner.value))
        is_resolved = np.repeat(is_resolved.reshape(-1, fractions.size).all(axis=1), fractions.size)
        value = np.append(value, np.where(is_resolved, inner.value, np.nan))
        order = np.argsort(np.append(f, between), kind="stable")
        return np.append(f, between)[order], value[order]

    def budget(self, output: str, frequency: float | str, force: str | None = None) -> BudgetTable:
        """Return the uncertainty budget of one value, interpolated between lines as by `interpolated`.

        Parameters
        ----------
        output : str
            Channel or location.
        frequency : float or str
            Hz, or a string with a unit.
        force : str, optional
            Input, if there are several.

        Returns
        -------
        BudgetTable
            Contributions with type, standard uncertainty and share of the variance, as in the GUM; prints as a table.
        """
        curve = self[output] if force is None else self[output, force]
        if not curve.is_curve:
            raise SceneError(
                "force: missing, but the response has several inputs. Give one of "
                f"{', '.join(point.name for point in self.inputs)}."
            )
        at = number(frequency, FREQUENCY, "frequency")
        curve = curve.interpolated(at)
        if not np.isfinite(curve.value[0]):
            raise SceneError(
                f"budget: no value at {at:.6g} Hz; the response has lines from {self.frequency.min():.6g} to "
                f"{self.frequency.max():.6g} Hz."
            )
        unit, factor = curve.shown_in
        uncertainties = {
            (cause.name, cause.evaluation): factor * float(cause.standard()[0])
            for cause in curve.uncertainty.contributions
        }
        variance = sum(u**2 for u in uncertainties.values())
        rows = sorted(
            ((*name_and_type, u, u**2 / variance) for name_and_type, u in uncertainties.items() if u > 0.0),
            key=lambda row: -row[2],
        )
        return BudgetTable(
            f"{curve.ratio} at {at:.6g} Hz",
            factor * float(abs(curve.value[0])),
            factor * float(curve.expanded()[0]),
            unit,
            tuple(rows),
            () if not self.limits or {SENSITIVITY, SYSTEMATIC} & set(self.limits) else (SENSITIVITY,),
        )
