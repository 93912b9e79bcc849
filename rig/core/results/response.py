"""Frequency responses, measured, computed or read from a file: their summary, tables, files and drawings.

`response_values` contains the values, and `response_arithmetic` the computations with them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rig.core.base.errors import SceneError
from rig.core.base.figure_types import Axes
from rig.core.base.palette import location_styles, recording_styles
from rig.core.results.points import MOTIONS, Point, body_number
from rig.core.results.response_arithmetic import MAX_PEAK_UNCERTAINTY_RATIO, ResponseArithmetic
from rig.core.results.response_values import stack
from rig.core.results.result import complete_style, missing_package
from rig.core.results.table import Table
from rig.core.results.text import format_interval, format_percent, format_quantity
from rig.core.results.uncertainty import SCATTER
from rig.core.results.universal_file import universal_file, write_curve

if TYPE_CHECKING:
    import xarray

# Curves with more points than this are drawn without markers.
MAX_MARKERS = 120


@dataclass(frozen=True, repr=False, eq=False)
class Response(ResponseArithmetic, Sequence["Response"]):
    """Frequency responses of several outputs to several inputs, or the curve of one output and one input.

    Indexing by a name selects, as in xarray: ``response["body3"]`` is the curve of that output, whose arrays have one
    axis. With several inputs, ``response["body3"]`` has one output and all inputs, and ``response["body3", "force2"]``
    is a curve. Iteration and integer indices give the entries as curves, output by output.

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
    loading : ndarray, shape (n,), or None
        Motion at each line relative to that at which a damper or joint ends the linear motion, as a bed at 1 g. The sum
        of simultaneous tones; None if it is unknown.
    omitted : ndarray, shape (m,)
        Frequencies of the test without a line [Hz].
    resolution : float
        Bandwidth of each line, over which leakage averages the response [Hz]; 0 for steady tones.
    label : str
        Scene and setting, for legends.
    warnings : tuple of str
        Restrictions on the use of the values, in full sentences.
    test : str
        Kind of the measured test, such as ``"hits"`` or ``"tones"``; empty if it is unknown.
    """

    def summary(self) -> str:
        """Return the ratios in words; for a curve also the peak, and the largest contribution to its uncertainty."""
        if not self.is_curve:
            by_inputs = f" by {self.input}" if len(self.inputs) > 1 else ""
            return (
                f"{self.label}: {self.name} of {self.response}{by_inputs}, "
                f"{self.frequency.size} points, {self.frequency.min():.4g} to {self.frequency.max():.4g} Hz"
            )
        heading = f"{self.label}, {self.ratio}: {self.name}, {self.frequency.size} points"
        if not np.isfinite(self.value).any():
            return heading
        magnitude, expanded, at, force, cause = self.highest_value()
        unit, contribution = self.shown_in[0], ""
        height = format_quantity(magnitude, expanded, unit) if cause else f"{magnitude:.4g} {unit}"
        if cause:
            contribution = f"; {'largest contribution' if np.isfinite(expanded) else 'unbounded by'}: {cause}"
        return (
            f"{heading}, {self.frequency.min():.4g} to {self.frequency.max():.4g} Hz, highest {height} "
            f"at {at} Hz{f' under {force} N' * bool(force)}{contribution}{'; '.join(['', *self.uncertain_peak()])}"
        )

    def table(self) -> Table:
        """Return the highest value of each curve with its 95 % interval, and its largest uncertainty."""
        rows: list[tuple[str, ...]] = []
        for curve in self.curves():
            name = curve.response if len(self.inputs) == 1 else curve.ratio
            if np.isfinite(curve.value).any():
                magnitude, expanded, *texts = curve.highest_value()
                rows.append((name, format_interval(magnitude, expanded), *texts))
            else:
                rows.append((name, "no value", "", "", ""))
        heading = ("response", f"highest / ({self.shown_in[0]})", "at / Hz", "force / N", "largest uncertainty")
        return Table(heading, "<>>><", rows)

    def highest_value(self) -> tuple[float, float, str, str, str]:
        """Return magnitude, expanded uncertainty, frequency, force and largest contribution at the peak line."""
        peak, factor = self.peak_line(), self.shown_in[1]
        expanded = factor * float(self.expanded()[peak])
        force = "" if self.amplitude is None or self.reference != "force" else f"{self.amplitude[peak]:.4g}"
        cause = self.largest_contributions()[peak] if expanded > 0.0 else ""
        return factor * float(abs(self.value[peak])), expanded, f"{self.frequency[peak]:.4g}", force, cause

    def peak_line(self) -> int:
        """Return the index of the largest value of a curve among the values with a small uncertainty.

        At low frequencies, where noise is divided by the square of frequency, the largest value may be noise.
        """
        magnitude = abs(self.value)
        is_certain = ~(self.bound() > MAX_PEAK_UNCERTAINTY_RATIO * magnitude)
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
            f"the highest value is too uncertain to be reported as the peak: {factor * magnitude:.4g} {unit} at "
            f"{self.frequency[line]:.4g} Hz (expanded uncertainty {uncertainty}, {self.largest_contributions()[line]})"
        ]

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return frequency, value, bound (with 95 % coverage) and, for a curve, coherence."""
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
        """Write a Universal File with a data set 58 for each entry.

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
                f"{self.response}: UFF 58 files are written for responses to a force, not to the "
                f"{self.reference}. Choose another format, such as CSV."
            )
        if nodes is None:
            nodes = [body_number(point.place) or k for k, point in enumerate(self.outputs, 1)]
        file = universal_file(Path(path), self.label, [*nodes, *driven])
        node_pairs = [(node, force_node) for node in nodes for force_node in driven]
        for count, (curve, (node, force_node)) in enumerate(zip(self.sorted().curves(), node_pairs, strict=True), 1):
            write_curve(
                file, count, node, force_node, f"{curve.response}: {curve.name}", (curve.label, curve.ratio),
                curve.motion, curve.resolution, curve.frequency, curve.value, curve.error,
                curve.expanded_systematic() if curve.limits else None,
            )  # fmt: skip
        return Path(path)

    def plot(self, ax: Axes | Response | None = None, *others: Response, **style: Any) -> Axes:
        """Draw the magnitudes of this and other responses in the same axes: ``a.plot(b)`` or ``a.plot(ax, b)``."""
        if isinstance(ax, Response):
            others, ax = (ax, *others), None
        # Compared responses have the colors of recordings; this response has the color of the reference.
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
        """Draw the magnitude with its expanded uncertainty, both axes logarithmic, for each entry."""
        if not self.is_curve:
            place_colors = location_styles([curve.outputs[0].at for curve in self.curves()])
            for curve, (color, *_) in zip(self.curves(), place_colors, strict=True):
                by_input = f" by {curve.inputs[0].name}" if len(self.inputs) > 1 else ""
                curve.draw(ax, **complete_style(style, color=color, label=f"{curve.response}{by_input}"))
            return
        curve, (unit, factor) = self.with_gaps(), self.shown_in
        magnitude, expanded = factor * abs(curve.value), factor * np.nan_to_num(curve.expanded())
        color, *_ = location_styles([self.outputs[0].at])[0]
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


__all__ = ["MAX_MARKERS", "MOTIONS", "SCATTER", "Point", "Response", "stack"]
