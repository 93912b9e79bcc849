"""Values of frequency responses with their uncertainty, and the selection of their entries and lines.

A line is one frequency of a response. An entry is one output over one input; a curve is a response of one entry.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import SceneError
from rig.core.results.points import Point, body_number, index_of
from rig.core.results.ratio_names import display_unit, ratio_name
from rig.core.results.result import Result
from rig.core.results.uncertainty import Covariance, UncertaintyBudget, coverage_factor, stack_budgets
from rig.core.settings.quantities import FREQUENCY, number

# A value between lines that exceeds both neighboring lines by at most this fraction counts as measured.
_MAX_EXCESS = 0.01


@dataclass(frozen=True, repr=False, eq=False)
class ResponseValues(Result):
    """Fields, entries and lines of a response; `Response` describes the fields."""

    frequency: Array
    value: ComplexArray
    outputs: tuple[Point, ...]
    inputs: tuple[Point, ...] = (Point("force", "force"),)
    uncertainty: UncertaintyBudget = field(default_factory=UncertaintyBudget)
    coherence: Array = None  # type: ignore[assignment]  # omitted: NaN
    unsteady: NDArray[np.bool_] | None = None
    amplitude: Array | None = None
    loading: Array | None = None
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
        degrees_of_freedom: Array | None = None,
        limits: Mapping[str, Array] | None = None,
        uncertainty: UncertaintyBudget | None = None,
        **fields: Any,
    ) -> Self:
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
            Locations of output and input.
        error, degrees_of_freedom : ndarray, shape (n,), optional
            Standard uncertainty of the real and of the imaginary part from the scatter (omitted: 0), and its degrees of
            freedom (omitted: unknown).
        limits : mapping of str to ndarray, optional
            Limits of the systematic errors by name.
        uncertainty : UncertaintyBudget, optional
            Instead of `error`, `degrees_of_freedom` and `limits`.
        """
        if uncertainty is None:
            zeros = np.zeros(np.shape(frequency))
            uncertainty = UncertaintyBudget.of(
                zeros if error is None else error, zeros if degrees_of_freedom is None else degrees_of_freedom, limits
            )
        return cls(
            frequency,
            value,
            (Point(output, motion, output_at, body_number(output_at)),),
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
        """Location of the output."""
        return self.outputs[0].place

    @property
    def input_at(self) -> str:
        """Location of the input."""
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
        """Unit in which values are drawn and printed, and the factor from `unit` to that unit."""
        return display_unit(self.unit)

    @property
    def error(self) -> Array:
        """Standard uncertainty of the real and of the imaginary part from the scatter; shape of `value`."""
        scatter = self.uncertainty.scatter
        return np.zeros(self.value.shape) if scatter is None else scatter.deviation

    @property
    def degrees_of_freedom(self) -> Array:
        """Degrees of freedom of `error`; 0 where they are unknown, as in files."""
        scatter = self.uncertainty.scatter
        return np.zeros(self.value.shape) if scatter is None else scatter.degrees

    @property
    def limits(self) -> dict[str, Array]:
        """Limits of the systematic errors by name."""
        return self.uncertainty.limits

    def bound(self, confidence: float = 0.95) -> Array:
        """Return the radius of the circle around each complex value that contains the true value.

        `confidence`: coverage probability.
        """
        return np.broadcast_to(self.uncertainty.bound(confidence), self.value.shape).copy()

    def expanded(self) -> Array:
        """Return the expanded uncertainty U (95 %) of the magnitude, with the shape of `value`."""
        return np.broadcast_to(self.uncertainty.expanded(), self.value.shape).copy()

    def random_bound(self, confidence: float = 0.95) -> Array:
        """Return the radius of the circle that contains the true value, from the scatter alone."""
        return np.broadcast_to(self.uncertainty.random_bound(confidence), self.value.shape).copy()

    def expanded_systematic(self) -> Array:
        """Return the expanded uncertainty from the systematic contributions alone."""
        return np.broadcast_to(self.uncertainty.expanded_systematic(), self.value.shape).copy()

    def expanded_random(self, confidence: float = 0.95) -> Array:
        """Return the expanded uncertainty of the magnitude from the scatter alone."""
        return self.error * coverage_factor(self.degrees_of_freedom, confidence)

    def largest_contributions(self) -> list[str]:
        """Return the name of the largest contribution to the uncertainty at each line of a curve."""
        return self.uncertainty.largest_contributions()

    def covariance(self) -> Covariance:
        """Return the covariance of the random errors between outputs and inputs (in C order), and between lines."""
        return self.uncertainty.covariance(self.value.shape)

    def keys(self) -> tuple[str, ...]:
        """List the channels of the outputs, by which they are selected."""
        return tuple(point.name for point in self.outputs)

    def items(self) -> tuple[tuple[str, Self], ...]:
        """List each channel of the outputs with its response; with one input, the response is a curve."""
        return tuple((name, self[name]) for name in self.keys())

    @cached_property
    def _curves(self) -> tuple[Self, ...]:
        if self.is_curve:
            return (self,)
        return tuple(self._select([i], [k]) for i in range(len(self.outputs)) for k in range(len(self.inputs)))

    def curves(self) -> tuple[Self, ...]:
        """Return all entries as curves, output by output."""
        return self._curves

    def __len__(self) -> int:
        return len(self._curves)

    def __iter__(self) -> Iterator[Self]:
        return iter(self._curves)

    def __contains__(self, key: object) -> bool:
        """Return whether a name selects a response, or a curve is one of the entries."""
        if not isinstance(key, str | tuple):
            return any(curve is key for curve in self._curves)
        try:
            self[key]
        except SceneError:
            return False
        return True

    def __getitem__(self, key: int | str | slice | tuple[str, str]) -> Self:
        """Select an entry by its index, outputs by name or slice, an input by its name.

        Raises `SceneError` for an unknown name or a key of a different type, `IndexError` for an index out of range.
        """
        if isinstance(key, slice):
            return self._select(range(len(self.outputs))[key], range(len(self.inputs)), keep_axes=True)
        if isinstance(key, tuple) and len(key) == 2:
            output, force = index_of(self.outputs, key[0], "response"), index_of(self.inputs, key[1], "input")
            return self._select([output], [force])
        if isinstance(key, int | np.integer):
            count = len(self._curves)
            if not -count <= key < count:
                raise IndexError(
                    f"Response: no curve with index {key}. Give an index from 0 to {count - 1}, or one of the names "
                    f"{', '.join(self.keys())}."
                )
            return self._curves[key]
        index = index_of(self.outputs, key, "response")
        return self._curves[index] if len(self.inputs) == 1 else self._select([index], range(len(self.inputs)))

    def _select(self, outputs: Sequence[int], inputs: Sequence[int], keep_axes: bool = False) -> Self:
        """Select entries; a single entry becomes a curve unless `keep_axes`."""
        if self.is_curve:
            return self
        is_single = len(outputs) == len(inputs) == 1 and not keep_axes
        selection = (
            (slice(None), outputs[0], inputs[0]) if is_single else np.ix_(range(self.frequency.size), outputs, inputs)
        )
        entries = [i * len(self.inputs) + k for i in outputs for k in inputs]
        return replace(
            self,
            value=self.value[selection],
            outputs=tuple(self.outputs[k] for k in outputs),
            inputs=tuple(self.inputs[k] for k in inputs),
            uncertainty=self.uncertainty.select(selection, entries),
            coherence=self.coherence[:, outputs[0] if is_single else list(outputs)],
        )

    def sorted(self) -> Self:
        """Order the lines by increasing frequency."""
        return self.at(np.argsort(self.frequency, kind="stable"))

    def loading_beyond(self, frequency: Array, magnitude: Array) -> Array:
        """Return the `loading` of interpolated magnitudes at which a damper starts to move, 0 at all others.

        The lines, in ascending order, do not determine such a magnitude: it is higher than both neighboring lines, and
        was interpolated from at least one line of linear motion.
        """
        if self.loading is None:
            return np.zeros(frequency.size)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = self.loading / abs(self.value)
        is_known = np.isfinite(ratio)
        if is_known.sum() < 2:
            return np.zeros(frequency.size)
        lines, value, at_lines = self.frequency[is_known], abs(self.value[is_known]), self.loading[is_known]
        above = np.clip(np.searchsorted(lines, frequency), 1, lines.size - 1)
        neighbors = np.stack([above - 1, above])
        loading = magnitude * np.interp(frequency, lines, ratio[is_known])
        is_linear = at_lines[neighbors].min(axis=0) < 1.0
        is_higher = magnitude > (1.0 + _MAX_EXCESS) * value[neighbors].max(axis=0)
        return np.where((loading > 1.0) & is_linear & is_higher, loading, 0.0)

    def with_gaps(self) -> Self:
        """Order the lines by increasing frequency; add NaN at omitted frequencies, which interrupts a drawn curve."""
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
            loading=None if curve.loading is None else insert(curve.loading),
        )

    def band(self, low: float | str, high: float | str) -> Self:
        """Select lines from `low` to `high` (Hz, or text with unit); raise `SceneError` if there are none."""
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

    def at(self, lines: NDArray[np.bool_] | NDArray[np.intp]) -> Self:
        """Return the response at selected lines, given by indices or flags; `interpolated` takes frequencies."""
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
            loading=None if self.loading is None else self.loading[lines],
        )

    def with_limits(self, limits: Mapping[str, Array]) -> Self:
        """Add systematic contributions by name, or replace contributions of the same name."""
        return replace(self, uncertainty=self.uncertainty.with_limits(limits))

    def without(self, *names: str) -> Self:
        """Return the response without these contributions to its uncertainty."""
        return replace(self, uncertainty=self.uncertainty.without(*names))

    def placed(self, output: str, force: str, body: int = 0) -> Self:
        """Set the locations of output and input of a curve, and the number of the output's body if it is known."""
        body = body or body_number(output)
        points = replace(self.outputs[0], place=output, body=body), replace(self.inputs[0], place=force)
        return replace(self, outputs=points[:1], inputs=points[1:])

    def warn(self, *sentences: str) -> Self:
        """Add warnings."""
        return replace(self, warnings=(*self.warnings, *sentences)) if sentences else self


ValuesT = TypeVar("ValuesT", bound=ResponseValues)


def stack(curves: Sequence[ValuesT], n_inputs: int = 1) -> ValuesT:
    """Join the curves of all outputs and inputs, output by output; a curve is NaN at lines that it does not have."""
    first = curves[0]
    if any(not np.array_equal(curve.frequency, first.frequency) for curve in curves):
        frequency = np.unique(np.concatenate([curve.frequency for curve in curves]))
        curves = [_with_added_lines(curve, frequency) for curve in curves]
    shape = (curves[0].frequency.size, len(curves) // n_inputs, n_inputs)
    amplitudes = [curve.amplitude for curve in curves if curve.amplitude is not None]
    return replace(
        curves[0],
        value=np.stack([curve.value for curve in curves], axis=1).reshape(shape),
        outputs=tuple(curve.outputs[0] for curve in curves[::n_inputs]),
        inputs=tuple(curve.inputs[0] for curve in curves[:n_inputs]),
        uncertainty=stack_budgets([curve.uncertainty for curve in curves], shape),
        coherence=np.stack([curve.coherence for curve in curves[::n_inputs]], axis=1).reshape(shape[:2]),
        unsteady=any_unsteady(curves),
        amplitude=np.fmax.reduce(amplitudes) if amplitudes else None,
        omitted=np.unique(np.concatenate([curve.omitted for curve in curves])),
        resolution=max(curve.resolution for curve in curves),
        warnings=tuple(dict.fromkeys(text for curve in curves for text in curve.warnings)),
    )


def any_unsteady(curves: Sequence[ResponseValues]) -> NDArray[np.bool_] | None:
    """Return flags of the lines at which any of the curves is not steady; None if no curve has flags."""
    flags = [curve.unsteady for curve in curves if curve.unsteady is not None]
    return np.any(flags, axis=0) if flags else None


def _with_added_lines(curve: ValuesT, lines: Array) -> ValuesT:
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
        loading=None if curve.loading is None else fill_added_lines(curve.loading),
    )
