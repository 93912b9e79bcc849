"""Frequency responses, measured, computed or read from a file: outputs over inputs, with uncertainty budgets.

A line is one frequency of a response. An element is one output over one input; a curve is a response of one element.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import SceneError, suggestion
from rig.core.base.palette import place_styles, recording_styles
from rig.core.results.interpolation import interpolate_curve, nearest_lines
from rig.core.results.ratio_names import display_unit, ratio_name
from rig.core.results.result import Result, complete_style, missing_package
from rig.core.results.text import format_frequencies, format_percent, format_quantity
from rig.core.results.uncertainty import (
    SCATTER,
    BudgetTable,
    Covariance,
    UncertaintyBudget,
    coverage_factor,
    stack_budgets,
)
from rig.core.results.universal_file import universal_file, write_curve
from rig.core.settings.quantities import FREQUENCY, number

if TYPE_CHECKING:
    import xarray
    from matplotlib.axes import Axes


# Curves with more points than this are drawn without markers.
MAX_MARKERS = 120
MOTIONS = ("displacement", "velocity", "acceleration")
# The highest value counts as the peak if its expanded uncertainty is at most this fraction of it.
_MAX_PEAK_UNCERTAINTY_RATIO = 0.5
# A curve between its lines is drawn with this number of points from line to line, where neighboring values differ by
# more than this fraction. With fewer lines than this in all, the lines are joined.
_POINTS_BETWEEN = 16
_MAX_STEP = 0.1
_MIN_CONTINUED = 12


@dataclass(frozen=True)
class Point:
    """Output or input of a response: channel, quantity and location.

    `quantity`: ``"displacement"``, ``"velocity"``, ``"acceleration"``, ``"force"``, ``"table"`` (its displacement),
    or ``"ratio"`` of two responses.
    """

    name: str  # channel or body
    quantity: str = "displacement"
    place: str = ""  # name of the body, or ``body 1``; empty if unknown
    body: int = 0  # number of the body; 0 if unknown

    @property
    def at(self) -> str:
        """Location without names: ``body 1``."""
        return f"body {self.body}" if self.body else self.place


@dataclass(frozen=True, repr=False, eq=False)
class Response(Result, Sequence["Response"]):
    """Frequency responses of several outputs to several inputs, or the curve of one output and one input.

    Indexing by a name selects, as in xarray: ``response["body3"]`` is the curve of that output, whose arrays have one
    axis. With several inputs, ``response["body3"]`` has one output and all inputs, and ``response["body3", "force2"]``
    is a curve. Iteration and integer indices give the elements as curves, output by output.

    Attributes
    ----------
    frequency : ndarray, shape (n,)
        Hz, in the order in which the lines were measured or computed.
    value : ndarray of complex, shape (n, outputs, inputs), or (n,) of a curve
        Output over input, in SI units, for motion Re(X e^{iwt}): a lagging response has a negative phase. NaN where
        it is not estimated.
    outputs, inputs : tuple of Point
    uncertainty : UncertaintyBudget
        Arrays of the shape of `value`; without contributions if the values are exact.
    coherence : ndarray, shape (n, outputs), or (n,) of a curve
        Multiple coherence (with one input: ordinary coherence), 0 to 1; NaN where it is unknown.
    unsteady : ndarray of bool, shape (n,), or None
        Lines at which the motion did not reach steady state; None if this does not apply.
    amplitude : ndarray, shape (n,), or None
        Amplitude of the input at each line, if it is a tone. With dampers, the value is valid at this amplitude only.
    omitted : ndarray, shape (m,)
        Frequencies of the test without a line, Hz.
    resolution : float
        Bandwidth of each line, over which leakage averages the response, Hz; 0 for steady tones.
    label : str
        Scene and setting, for legends.
    warnings : tuple of str
        Restrictions on the use of the values, in full sentences.
    test : str
        Kind of the measured test, such as ``"hits"`` or ``"tones"``; empty if it is unknown.
    """

    frequency: Array
    value: ComplexArray
    outputs: tuple[Point, ...]
    inputs: tuple[Point, ...] = (Point("force", "force"),)
    uncertainty: UncertaintyBudget = field(default_factory=UncertaintyBudget)
    coherence: Array = None  # type: ignore[assignment]  # omitted: NaN
    unsteady: NDArray[np.bool_] | None = None
    amplitude: Array | None = None
    omitted: Array = field(default_factory=lambda: np.empty(0))
    resolution: float = 0.0
    label: str = ""
    warnings: tuple[str, ...] = ()
    test: str = ""

    def __post_init__(self) -> None:
        shape = (self.frequency.size, len(self.outputs), len(self.inputs))
        if self.value.shape != (shape[:1] if self.is_curve and shape[1:] == (1, 1) else shape):
            raise ValueError(f"Response: value of shape {self.value.shape}; expected {shape}")
        if self.coherence is None:
            object.__setattr__(self, "coherence", np.full(self.value.shape[:2], np.nan))

    @classmethod
    def curve(
        cls,
        frequency: Array,
        value: ComplexArray,
        output: str,
        *,
        reference: str = "force",
        motion: str = "displacement",
        output_at: str = "",
        input_at: str = "",
        error: Array | None = None,
        degrees: Array | None = None,
        limits: Mapping[str, Array] | None = None,
        uncertainty: UncertaintyBudget | None = None,
        **fields: Any,
    ) -> Response:
        """Make the response of one output to one input.

        Parameters
        ----------
        output : str
            Channel.
        reference : {'force', 'table'}
            Quantity by which the output is divided.
        motion : {'displacement', 'velocity', 'acceleration'}
            Quantity of the output.
        output_at, input_at : str
            Places of output and input.
        error, degrees : ndarray, shape (n,), optional
            Standard uncertainty of either quadrature component from the scatter (omitted: 0), and its degrees of
            freedom (omitted: unknown).
        limits : mapping of str to ndarray, optional
            Bounds of the systematic errors by name.
        uncertainty : UncertaintyBudget, optional
            Instead of `error`, `degrees` and `limits`.
        """
        if uncertainty is None:
            zeros = np.zeros(np.shape(frequency))
            uncertainty = UncertaintyBudget.of(
                zeros if error is None else error, zeros if degrees is None else degrees, limits
            )
        return cls(
            frequency,
            value,
            (Point(output, motion, output_at),),
            (Point(reference, reference, input_at),),
            uncertainty,
            **fields,
        )

    @property
    def is_curve(self) -> bool:
        """Whether this is the response of one output to one input, with arrays of one axis."""
        return self.value.ndim == 1

    @property
    def response(self) -> str:
        """Channels of the outputs."""
        return ", ".join(point.name for point in self.outputs)

    @property
    def reference(self) -> str:
        """``"force"`` or ``"table"``."""
        return self.inputs[0].quantity

    @property
    def motion(self) -> str:
        """Quantity of the outputs."""
        return self.outputs[0].quantity

    @property
    def output_at(self) -> str:
        """Place of the output."""
        return self.outputs[0].place

    @property
    def input_at(self) -> str:
        """Place of the input."""
        return self.inputs[0].place

    @property
    def input(self) -> str:
        """Inputs and their locations: ``force at body 1``."""
        return " and ".join(
            f"{point.quantity} at {point.place}" if point.place else point.quantity for point in self.inputs
        )

    @property
    def ratio(self) -> str:
        """Outputs and inputs: ``arm / force at base``."""
        return f"{self.response} / {self.input}"

    @property
    def is_driving_point(self) -> bool:
        """Whether the output is at the location of the force (all directions are vertical)."""
        return self.reference == "force" and bool(self.input_at) and self.output_at == self.input_at

    @property
    def name(self) -> str:
        """Name of the ratio: compliance, mobility, accelerance, transmissibility."""
        return ratio_name(self.motion, self.reference)[0]

    @property
    def unit(self) -> str:
        """Unit of `value`."""
        return ratio_name(self.motion, self.reference)[1]

    @property
    def shown_in(self) -> tuple[str, float]:
        """Unit in which values are drawn and printed, and the factor from `unit` to it."""
        return display_unit(self.unit)

    @property
    def error(self) -> Array:
        """Standard uncertainty of either quadrature component from the scatter; of the shape of `value`."""
        scatter = self.uncertainty.scatter
        return np.zeros(self.value.shape) if scatter is None else scatter.deviation

    @property
    def degrees(self) -> Array:
        """Degrees of freedom of `error`; 0 where they are unknown, as in files."""
        scatter = self.uncertainty.scatter
        return np.zeros(self.value.shape) if scatter is None or scatter.degrees is None else scatter.degrees

    @property
    def limits(self) -> dict[str, Array]:
        """Bounds of the systematic errors by name."""
        return self.uncertainty.limits

    def bound(self, confidence: float = 0.95) -> Array:
        """Return the radius of the circle in the complex plane that contains the true value."""
        return np.broadcast_to(self.uncertainty.bound(confidence), self.value.shape).copy()

    def expanded(self) -> Array:
        """Return the expanded uncertainty U of the magnitude, with about 95 % coverage, of the shape of `value`."""
        return np.broadcast_to(self.uncertainty.expanded(), self.value.shape).copy()

    def random_bound(self, confidence: float = 0.95) -> Array:
        """Return the radius of the circle from the scatter alone."""
        return np.broadcast_to(self.uncertainty.random_bound(confidence), self.value.shape).copy()

    def systematic_bound(self) -> Array:
        """Return the expanded uncertainty from the systematic contributions alone."""
        return np.broadcast_to(self.uncertainty.systematic_bound(), self.value.shape).copy()

    def magnitude_bound(self, confidence: float = 0.95) -> Array:
        """Return the expanded uncertainty of the magnitude from the scatter alone."""
        return self.error * coverage_factor(self.degrees, confidence)

    def parts(self) -> list[str]:
        """Return the name of the largest contribution to the uncertainty at each line of a curve."""
        return self.uncertainty.largest_contributions()

    def covariance(self) -> Covariance:
        """Return the covariance of the random errors over outputs and inputs (in C order), and from line to line."""
        return self.uncertainty.covariance(self.value.shape)

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
        )

    def keys(self) -> tuple[str, ...]:
        """List the channels of the outputs, by which they are selected."""
        return tuple(point.name for point in self.outputs)

    def items(self) -> tuple[tuple[str, Response], ...]:
        """List each channel of the outputs with its response, which is a curve if there is one input."""
        return tuple((name, self[name]) for name in self.keys())

    @cached_property
    def _curves(self) -> tuple[Response, ...]:
        if self.is_curve:
            return (self,)
        return tuple(self._select([i], [k]) for i in range(len(self.outputs)) for k in range(len(self.inputs)))

    def curves(self) -> tuple[Response, ...]:
        """Return all elements as curves, output by output."""
        return self._curves

    def __len__(self) -> int:
        return len(self._curves)

    def __iter__(self) -> Iterator[Response]:
        return iter(self._curves)

    def __contains__(self, key: object) -> bool:
        """Return whether a name selects a response, or a curve is one of the elements."""
        if not isinstance(key, str | tuple):
            return any(curve is key for curve in self._curves)
        try:
            self[key]
        except SceneError:
            return False
        return True

    def __getitem__(self, key: int | str | slice | tuple[str, str]) -> Response:
        """Select an element by its index, outputs by name or slice, an input by its name.

        Raises `SceneError` for an unknown name or a key of another type, `IndexError` for an index out of range.
        """
        if isinstance(key, slice):
            return self._select(range(len(self.outputs))[key], range(len(self.inputs)), keep_axes=True)
        if isinstance(key, tuple) and len(key) == 2:
            output, force = _index(self.outputs, key[0], "response"), _index(self.inputs, key[1], "input")
            return self._select([output], [force])
        if isinstance(key, int | np.integer):
            count = len(self._curves)
            if not -count <= key < count:
                raise IndexError(
                    f"Response: no curve with index {key}. Give an index from 0 to {count - 1}, or one of the names "
                    f"{', '.join(self.keys())}."
                )
            return self._curves[key]
        index = _index(self.outputs, key, "response")
        return self._curves[index] if len(self.inputs) == 1 else self._select([index], range(len(self.inputs)))

    def _select(self, outputs: Sequence[int], inputs: Sequence[int], keep_axes: bool = False) -> Response:
        """Select elements; a single element becomes a curve unless `keep_axes`."""
        if self.is_curve:
            return self
        is_single = len(outputs) == len(inputs) == 1 and not keep_axes
        selection = (
            (slice(None), outputs[0], inputs[0]) if is_single else np.ix_(range(self.frequency.size), outputs, inputs)
        )
        elements = [i * len(self.inputs) + k for i in outputs for k in inputs]
        return replace(
            self,
            value=self.value[selection],
            outputs=tuple(self.outputs[k] for k in outputs),
            inputs=tuple(self.inputs[k] for k in inputs),
            uncertainty=self.uncertainty.select(selection, elements),
            coherence=self.coherence[:, outputs[0] if is_single else list(outputs)],
        )

    def summary(self) -> str:
        """Return the ratios in words; for a curve also its peak and the largest contribution there."""
        if not self.is_curve:
            return (
                f"{self.label}: {self.name} of {self.response}{self._inputs_if_several()}, "
                f"{self.frequency.size} points, {self.frequency.min():.4g} to {self.frequency.max():.4g} Hz"
            )
        heading = f"{self.label}, {self.ratio}: {self.name}, {self.frequency.size} points"
        if not np.isfinite(self.value).any():
            return heading
        peak, (unit, factor) = self.peak_line(), self.shown_in
        magnitude, bound = factor * float(abs(self.value[peak])), factor * float(self.expanded()[peak])
        height, contribution = f"{magnitude:.4g} {unit}", ""
        if bound > 0.0:
            height = format_quantity(magnitude, bound, unit)
            relation = "largest contribution" if np.isfinite(bound) else "unbounded by"
            contribution = f"; {relation}: {self.parts()[peak]}"
        amplitude = ""
        if self.amplitude is not None and self.reference == "force":
            amplitude = f" under {self.amplitude[peak]:.4g} N"
        return (
            f"{heading}, {self.frequency.min():.4g} to {self.frequency.max():.4g} Hz, highest {height} "
            f"at {self.frequency[peak]:.4g} Hz{amplitude}{contribution}{'; '.join(['', *self.uncertain_peak()])}"
        )

    def _inputs_if_several(self) -> str:
        return f" by {self.input}" if len(self.inputs) > 1 else ""

    def peak_line(self) -> int:
        """Return the index of the largest value of a curve among the values with a small uncertainty.

        At low frequencies, where noise is divided by the square of frequency, the largest value may be noise.
        """
        magnitude = abs(self.value)
        is_certain = ~(self.bound() > _MAX_PEAK_UNCERTAINTY_RATIO * magnitude)
        if np.isfinite(magnitude[is_certain]).any():
            magnitude = np.where(is_certain, magnitude, np.nan)
        return int(np.nanargmax(magnitude))

    def uncertain_peak(self) -> list[str]:
        """Describe the largest value of a curve if it is too uncertain to be the peak."""
        line, (unit, factor) = int(np.nanargmax(abs(self.value))), self.shown_in
        if line == self.peak_line():
            return []
        magnitude, expanded = float(abs(self.value[line])), float(self.expanded()[line])
        uncertainty = format_percent(expanded / magnitude) if np.isfinite(expanded) else "unbounded"
        return [
            f"ignored as too uncertain: {factor * magnitude:.4g} {unit} at {self.frequency[line]:.4g} Hz "
            f"(uncertainty {uncertainty}, {self.parts()[line]})"
        ]

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return frequency, value, 95 % bound and, for a curve, coherence."""
        if self.is_curve:
            return {
                "frequency_Hz": self.frequency,
                f"value_{self.unit}": self.value,
                f"bound_{self.unit}": self.bound(),
                "coherence": self.coherence,
            }
        columns: dict[str, NDArray[Any]] = {"frequency_Hz": self.frequency}
        bound = self.bound()
        for i, output in enumerate(self.outputs):
            for k, force in enumerate(self.inputs):
                name = output.name if len(self.inputs) == 1 else f"{output.name}/{force.name}"
                columns[f"{name}_{self.unit}"] = self.value[:, i, k]
                columns[f"{name}_bound_{self.unit}"] = bound[:, i, k]
        return columns

    def to_xarray(self) -> xarray.Dataset:
        """Return value, bound and coherence over frequency, output and input; for a curve, its columns."""
        if self.is_curve:
            return super().to_xarray()
        try:
            import xarray
        except ImportError:
            raise missing_package("xarray") from None
        dims = ("frequency", "output", "input")
        data = {
            "value": (dims, self.value), "bound": (dims, self.bound()), "coherence": (dims[:2], self.coherence)
        }  # fmt: skip
        names = [point.name for point in self.inputs]
        return xarray.Dataset(
            data, {"frequency": self.frequency, "output": list(self.keys()), "input": names}, {"unit": self.unit}
        )

    def to_uff(self, path: str | Path, nodes: Sequence[int] | None = None, driven: Sequence[int] = (0,)) -> Path:
        """Write a Universal File with a data set 58 for each element.

        Parameters
        ----------
        nodes : sequence of int, optional
            Nodes of the outputs; omitted: from their locations (``body 3`` is node 3), or numbered from 1.
        driven : sequence of int
            Nodes of the inputs.

        Raises
        ------
        SceneError
            If an input is not a force.
        RunError
            If pyuff is not installed.
        """
        if self.reference != "force":
            raise SceneError(
                f"{self.response}: UFF 58 files contain responses to a force, not to the {self.reference}. Choose "
                "another format, such as CSV."
            )
        if nodes is None:
            nodes = [_node(point.place, k) for k, point in enumerate(self.outputs, 1)]
        file = universal_file(Path(path), self.label, [*nodes, *driven])
        node_pairs = [(node, force_node) for node in nodes for force_node in driven]
        for count, (curve, (node, force_node)) in enumerate(zip(self.sorted().curves(), node_pairs, strict=True), 1):
            write_curve(
                file, count, node, force_node, f"{curve.response}: {curve.name}", (curve.label, curve.ratio),
                curve.motion, curve.resolution, curve.frequency, curve.value, curve.error,
                curve.systematic_bound() if curve.limits else None,
            )  # fmt: skip
        return Path(path)

    def plot(self, ax: Axes | Response | None = None, *others: Response, **style: Any) -> Axes:
        """Draw the magnitudes of this and other responses in the same axes: ``a.plot(b)`` or ``a.plot(ax, b)``."""
        if isinstance(ax, Response):
            others, ax = (ax, *others), None
        # A comparison has the colors of recordings, with this response as the reference.
        colors = [{"color": color} for color, *_ in recording_styles([True, *(False for _ in others)])]
        if not others or not self.is_curve:
            colors = [{} for _ in colors]
        axes = super().plot(ax, **colors[0] | style)
        for other, color in zip(others, colors[1:], strict=True):
            other.draw(axes, **color | style)
        if others:
            axes.legend()
        return axes

    def draw(self, ax: Axes, **style: Any) -> None:
        """Draw the magnitude with its expanded uncertainty, both axes logarithmic, for each element."""
        if not self.is_curve:
            place_colors = place_styles([curve.outputs[0].at for curve in self.curves()])
            for curve, (color, *_) in zip(self.curves(), place_colors, strict=True):
                curve.draw(
                    ax,
                    **complete_style(
                        style,
                        color=color,
                        label=curve.response
                        if len(self.inputs) == 1
                        else f"{curve.response} by {curve.inputs[0].name}",
                    ),
                )
            return
        curve, (unit, factor) = self.with_gaps(), self.shown_in
        magnitude, expanded = factor * abs(curve.value), factor * np.nan_to_num(curve.expanded())
        color, *_ = place_styles([self.outputs[0].at])[0]
        # Another curve of the same body gets the next color of the axes.
        default = None if any(line.get_color() == color for line in ax.lines) else color
        dense, through = curve.continued(np.ones(magnitude.size, dtype=bool))
        style = complete_style(style, color=default, label=f"{self.label} {self.response}".strip(), lw=1.0)
        markers = {"marker": "o", "ms": 2.5, "markevery": np.flatnonzero(np.isin(dense, curve.frequency)).tolist()}
        (line,) = ax.loglog(dense, factor * abs(through), **(markers if magnitude.size <= MAX_MARKERS else {}) | style)
        # A logarithmic axis needs positive values.
        lower_edge = np.maximum(magnitude - expanded, 1e-3 * magnitude)
        ax.fill_between(curve.frequency, lower_edge, magnitude + expanded, color=line.get_color(), alpha=0.2, lw=0)
        ax.set(xlabel="frequency / Hz", ylabel=f"|{self.name}| / ({unit})")

    def to(self, motion: str) -> Response:
        """Express the outputs as displacement, velocity or acceleration.

        Examples
        --------
        >>> frf = Response.curve(np.array([10.0]), np.array([1e-3j]), "body3")
        >>> print(frf.to("velocity").name, f"{frf.to('velocity').value[0].real:.6f}")
        mobility -0.062832
        """
        if motion not in MOTIONS:
            raise SceneError(f"motion: got {motion!r}; expected {', '.join(MOTIONS)}")
        n_derivatives = MOTIONS.index(motion) - MOTIONS.index(self.motion)
        factor: ComplexArray = np.asarray((2j * np.pi * self.frequency) ** n_derivatives, dtype=complex)
        points = tuple(replace(point, quantity=motion) for point in self.outputs)
        return replace(self.scaled(factor), outputs=points)

    def scaled(self, factor: ComplexArray) -> Response:
        """Multiply by a factor at each line."""
        return replace(
            self,
            value=self.value * factor.reshape(-1, *[1] * (self.value.ndim - 1)),
            uncertainty=self.uncertainty.scaled(factor),
        )

    def __truediv__(self, other: Response) -> Response:
        """Return the ratio to another response of the same elements, at the lines of this response.

        The other response is interpolated; outside its frequency range the ratio is NaN. Errors that both responses
        have in common cancel or add up: those of the same sensor, the same clock or the same readings.
        """
        if not isinstance(other, Response):
            return NotImplemented
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
            unsteady=_any_unsteady((self, other)),
            label=f"{self.label} / {other.label}" if other.label else self.label,
            warnings=tuple(dict.fromkeys([*self.warnings, *other.warnings, *notes])),
        )

    def interpolated(self, frequency: ArrayLike) -> Response:
        """Return the response at one or several other frequencies, Hz or as ``"30 Hz"``; NaN outside its range.

        Between lines it is a local rational function. The uncertainty contains the errors of the lines and the error
        of the interpolation, which is the contribution "spacing of the lines".

        Raises
        ------
        SceneError
            If the lines do not resolve the response at one of the frequencies; the message states the spacing that is
            needed.

        Examples
        --------
        >>> lines = np.linspace(10.0, 20.0, 41)
        >>> frf = Response.curve(lines, 1.0 / (15.1**2 - lines**2 + 0.3j * lines), "body3")
        >>> abs(frf.interpolated(15.1).value).round(4).tolist()
        [0.2208]
        """
        if isinstance(frequency, str):
            frequency = number(frequency, FREQUENCY, "frequency")
        result, needed = self._interpolated(np.atleast_1d(np.asarray(frequency, dtype=float)))
        if np.isfinite(needed).any():
            raise SceneError(
                f"{self.label or self.ratio}: the lines do not resolve the response at "
                f"{format_frequencies(result.frequency.tolist(), np.isfinite(needed).tolist())}. Measure there with "
                f"lines at most {needed.min():.1g} Hz apart, or choose a frequency of a line."
            )
        return result

    def _interpolated(self, frequency: Array) -> tuple[Response, Array]:
        """Return `interpolated`, and the spacing that is needed at each frequency, Hz; infinite if lines resolve it."""
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
            rows = [np.interp(frequency, ordered.frequency, element, np.nan, np.nan) for element in flat.T]
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
        )
        return result, np.min([curve.needed_spacing for curve in known], axis=0)

    def continued(self, is_shown: NDArray[np.bool_]) -> tuple[Array, ComplexArray]:
        """Return frequencies and values of the interpolated curve through the lines of an ordered curve, to draw it.

        `is_shown`: flags of the lines that it contains; the value at other lines is NaN. There are points between
        lines only where neighboring values differ; their value is NaN where the lines do not resolve the response.
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
        is_resolved = np.isinf(needed_spacing) & (inner.expanded() <= _MAX_PEAK_UNCERTAINTY_RATIO * abs(inner.value))
        is_resolved = np.repeat(is_resolved.reshape(-1, fractions.size).all(axis=1), fractions.size)
        value = np.append(value, np.where(is_resolved, inner.value, np.nan))
        order = np.argsort(np.append(f, between), kind="stable")
        return np.append(f, between)[order], value[order]

    def sorted(self) -> Response:
        """Order the lines by increasing frequency."""
        return self.at(np.argsort(self.frequency, kind="stable"))

    def with_gaps(self) -> Response:
        """Order the lines by increasing frequency; NaN at the omitted frequencies interrupts a drawn curve."""
        curve = self.sorted()
        omitted = np.sort(self.omitted)
        positions = np.searchsorted(curve.frequency, omitted)

        def insert(column: NDArray[Any], value: Any = np.nan) -> NDArray[Any]:
            return np.insert(column, positions, value, axis=0)

        return replace(
            curve,
            frequency=np.insert(curve.frequency, positions, omitted),
            value=insert(curve.value),
            uncertainty=curve.uncertainty.with_gaps(positions),
            coherence=insert(curve.coherence),
            unsteady=None if curve.unsteady is None else insert(curve.unsteady, False),
            amplitude=None if curve.amplitude is None else insert(curve.amplitude),
        )

    def band(self, low: float | str, high: float | str) -> Response:
        """Select the lines from `low` to `high`, in Hz or as strings with their unit.

        Raises `SceneError` if there is no line between them.
        """
        first, last = number(low, FREQUENCY, "low"), number(high, FREQUENCY, "high")
        if first > last:
            raise SceneError(f"band: got {first:g} to {last:g} Hz; expected the lower frequency first")
        lines = (self.frequency >= first) & (self.frequency <= last)
        if self.frequency.size and not lines.any():
            raise SceneError(
                f"band: no lines between {first:g} and {last:g} Hz; the response has lines from "
                f"{self.frequency.min():g} to {self.frequency.max():g} Hz. Select a wider band."
            )
        return self.at(lines)

    between = band

    def at(self, lines: NDArray[np.bool_] | NDArray[np.intp]) -> Response:
        """Return the response at some lines, given by indices or flags; `interpolated` takes frequencies."""
        if not isinstance(lines, slice) and (np.ndim(lines) != 1 or np.asarray(lines).dtype.kind not in "biu"):
            raise SceneError(
                f"at: got {lines!r:.60}; expected an array of indices or flags of lines. For the value at a frequency, "
                "use interpolated(39.0); for the measured lines around it, band(38, 40)."
            )
        return replace(
            self,
            frequency=self.frequency[lines],
            value=self.value[lines],
            uncertainty=self.uncertainty.at(lines),
            coherence=self.coherence[lines],
            unsteady=None if self.unsteady is None else self.unsteady[lines],
            amplitude=None if self.amplitude is None else self.amplitude[lines],
        )

    def with_limits(self, limits: Mapping[str, Array]) -> Response:
        """Add systematic contributions by name, or replace those of the same name."""
        return replace(self, uncertainty=self.uncertainty.with_limits(limits))

    def without(self, *names: str) -> Response:
        """Remove contributions to the uncertainty."""
        return replace(self, uncertainty=self.uncertainty.without(*names))

    def placed(self, output: str, force: str, body: int = 0) -> Response:
        """Set the locations of output and input of a curve, and the number of the output's body if it is known."""
        points = replace(self.outputs[0], place=output, body=body), replace(self.inputs[0], place=force)
        return replace(self, outputs=points[:1], inputs=points[1:])

    def warn(self, *sentences: str) -> Response:
        """Add warnings."""
        return replace(self, warnings=(*self.warnings, *sentences)) if sentences else self


def _node(place: str, number: int) -> int:
    """Return the node of a location: 3 for ``body 3``, `number` for a body with a name."""
    last = place.rpartition(" ")[2]
    return int(last) if place.startswith("body ") and last.isdigit() else number


def _index(points: Sequence[Point], name: str, kind: str) -> int:
    """Return the index of the point with a name, or of the only point at a location."""
    if not isinstance(name, str):
        raise SceneError(
            f"{kind}: got {name!r:.60}; expected a name, such as {points[0].name!r}. Iteration gives curves; keys() "
            "lists the names, and items() names with curves."
        )
    matches = [k for k, point in enumerate(points) if point.name == name]
    for place in (name.removeprefix("body "), name):
        matches = matches or [k for k, point in enumerate(points) if point.place == place]
    if len(matches) == 1:
        return matches[0]
    if matches:
        channels = " or ".join(points[k].name for k in matches)
        raise SceneError(f"{len(matches)} {kind}s are at {name}. Select one by its channel: {channels}.")
    names = [point.name for point in points]
    hint = suggestion(name, [*names, *(point.place for point in points)], f"Give one of {', '.join(names)}.")
    raise SceneError(f"no {kind} {name!r}. {hint}")


def stack(curves: Sequence[Response]) -> Response:
    """Join responses to the same inputs to a response of all outputs; NaN at lines that a response does not have."""
    first = curves[0]
    if any(not np.array_equal(curve.frequency, first.frequency) for curve in curves):
        frequency = np.unique(np.concatenate([curve.frequency for curve in curves]))
        curves = [_with_added_lines(curve, frequency) for curve in curves]
    shape = (curves[0].frequency.size, len(curves), len(first.inputs))
    amplitudes = [curve.amplitude for curve in curves if curve.amplitude is not None]
    return replace(
        curves[0],
        value=np.stack([curve.value for curve in curves], axis=1).reshape(shape),
        outputs=tuple(curve.outputs[0] for curve in curves),
        uncertainty=stack_budgets([curve.uncertainty for curve in curves], shape),
        coherence=np.stack([curve.coherence for curve in curves], axis=1).reshape(shape[:2]),
        unsteady=_any_unsteady(curves),
        amplitude=np.fmax.reduce(amplitudes) if amplitudes else None,
        omitted=np.unique(np.concatenate([curve.omitted for curve in curves])),
        resolution=max(curve.resolution for curve in curves),
        warnings=tuple(dict.fromkeys(text for curve in curves for text in curve.warnings)),
    )


def _any_unsteady(curves: Sequence[Response]) -> NDArray[np.bool_] | None:
    """Return the lines at which a curve is not steady; None if no curve contains this information."""
    flags = [curve.unsteady for curve in curves if curve.unsteady is not None]
    return np.any(flags, axis=0) if flags else None


def _with_added_lines(curve: Response, lines: Array) -> Response:
    """Return a curve at a superset of its lines, NaN at the added lines."""
    positions = np.searchsorted(lines, curve.frequency)

    def fill_added_lines(column: NDArray[Any], value: Any = np.nan) -> NDArray[Any]:
        filled = np.full((lines.size, *column.shape[1:]), value, dtype=np.result_type(column, value))
        filled[positions] = column
        return filled

    return replace(
        curve,
        frequency=lines,
        value=fill_added_lines(curve.value),
        uncertainty=curve.uncertainty.with_arrays(fill_added_lines, None),
        coherence=fill_added_lines(curve.coherence),
        unsteady=None if curve.unsteady is None else fill_added_lines(curve.unsteady, False),
        amplitude=None if curve.amplitude is None else fill_added_lines(curve.amplitude),
    )


__all__ = ["MAX_MARKERS", "MOTIONS", "SCATTER", "Point", "Response", "stack"]
