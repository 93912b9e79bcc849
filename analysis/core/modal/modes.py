"""Identified modes: natural frequencies, damping ratios, shapes, and the compliances of the modal model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from analysis.core.modal_models.lscf import ChartPole
from analysis.core.modal_models.pole_residue import modal_receptance
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import SceneError
from rig.core.base.figure_types import Axes
from rig.core.base.renamed import renamed
from rig.core.results import (
    Result,
    complete_style,
    format_frequency,
    format_interval,
    format_percent,
    format_quantity,
)
from rig.core.results.response import Response
from rig.core.results.table import Table
from rig.core.results.uncertainty import expand

# A damping ratio is determined if its relative standard uncertainty is at most a third: the ratio then differs from
# zero by three standard uncertainties. Otherwise only an upper limit of the ratio is stated, and the pole counts as a
# mode only if it has a distinct peak.
MAX_RELATIVE_UNCERTAINTY = 1.0 / 3.0


#: A stable pole belongs to a mode if their frequencies differ by at most this fraction.
MODE_WIDTH = 0.05
# Markers of the kinds of poles in the stabilization diagram, with their colors and the colors inside.
_POLE_STYLES = {
    "new pole": ("x", "#bbbbbb", "#bbbbbb"),
    "stable": ("o", "#333333", "#333333"),
    "stable, no mode": ("o", "#333333", "none"),
}


class BodyShapes(NamedTuple):
    """Mode shapes with a component for each body, scaled to largest component 1, with standard uncertainties."""

    names: tuple[str, ...]
    shapes: ComplexArray  # shape (bodies, modes)
    errors: Array  # standard uncertainties, shape (bodies, modes)
    places: tuple[str, ...] = ()  # locations of the sensors: "body 2"

    def with_signs_of(self, reference: BodyShapes) -> BodyShapes:
        """Return the shapes with the signs of the most similar shapes of the same bodies in a reference."""
        if self.names != reference.names or not reference.shapes.size:
            return self
        similar = reference.shapes[:, mac(self.shapes, reference.shapes).argmax(axis=1)]
        is_opposite = np.sum(self.shapes.conj() * similar, axis=0).real < 0.0
        return self._replace(shapes=self.shapes * np.where(is_opposite, -1.0, 1.0))


class UncertainMode(NamedTuple):
    """A pole that may be a mode or may represent an error of the curves, with standard uncertainties."""

    frequency: float  # undamped natural frequency [Hz]
    frequency_std: float  # Hz
    damping: float  # damping ratio
    damping_std: float
    reason: str  # why the pole is not counted as a mode

    def frequency_text(self) -> str:
        """Write the natural frequency with its expanded uncertainty (95 %)."""
        return _frequency_text(self.frequency, self.frequency_std)

    def frequency_label(self) -> str:
        """Write the natural frequency for a label, see `Modes.frequency_label`."""
        return format_frequency(self.frequency, float(expand(self.frequency_std)))

    def damping_text(self) -> str:
        """Write the damping ratio with its expanded uncertainty (95 %), or an upper limit."""
        return _damping_text(self.damping, self.damping_std)

    def cells(self) -> tuple[str, str]:
        """Write natural frequency [Hz] and damping ratio, %, without their units, for a table."""
        return _cells(self.frequency, self.frequency_std, self.damping_text())

    def without_exponential_window(self, time_constant: float) -> UncertainMode:
        """Remove the damping of an exponential window, see `Modes.without_exponential_window`."""
        frequency, damping, damping_std = _without_window(
            np.array(self.frequency), np.array(self.damping), np.array(self.damping_std), time_constant
        )
        return self._replace(frequency=float(frequency), damping=float(damping), damping_std=float(damping_std))


@dataclass(frozen=True, repr=False)
class Modes(Result):
    """Identified modes.

    Attributes
    ----------
    frequency, frequency_std : ndarray, shape (modes,)
        Undamped natural frequency abs(p)/2 pi and its standard uncertainty [Hz]; all uncertainties are NaN if a file
        states none.
    damping, damping_std : ndarray, shape (modes,)
        Damping ratio and its standard uncertainty; if this is more than a third of the ratio, only an upper limit is
        known: ``damping + 2 damping_std``.
    shape_std : ndarray, shape (responses, modes)
        Standard uncertainty of each entry of `shapes`, from the uncertainty of the curves at the resonance, including
        sensor tolerances.
    residue : ndarray of complex, shape (responses, modes)
        R in the compliance R/(s - p) + conj(R)/(s - conj(p)), m/(N s).
    responses : tuple of str
        Channels.
    chart : tuple of ChartPole
        Stabilization diagram.
    lower : ndarray, shape (responses,)
        Contribution of modes below the band: lower / s², m/N.
    upper : ndarray, shape (responses, 3)
        Contribution of modes above the band: upper[0] + upper[1] s + upper[2] s², m/N.
    model_error : float
        Residual of the modal model, relative to the neighboring peaks; 0 if the residual is consistent with the
        uncertainties of the curves.
    label : str
        Scene and setting.
    warnings : tuple of str
        Warnings about the results, in full sentences.
    input : str
        Excitation and its location, such as ``force at body 1``.
    places : tuple of str
        Location of each channel: name of its body, or ``body 1``; empty if unknown.
    bodies : tuple of int
        Number of the body of each channel, from 1; 0 for any other location.
    uncertain : tuple of UncertainMode
        Poles that are not counted as modes, each with the reason, in ascending order of frequency.
    """

    frequency: Array
    frequency_std: Array
    damping: Array
    damping_std: Array
    shape_std: Array
    residue: ComplexArray
    responses: tuple[str, ...]
    chart: tuple[ChartPole, ...]
    lower: Array
    upper: Array
    model_error: float
    label: str
    warnings: tuple[str, ...]
    input: str = ""
    places: tuple[str, ...] = ()
    bodies: tuple[int, ...] = ()
    uncertain: tuple[UncertainMode, ...] = ()

    frequency_error = renamed("frequency_error", "frequency_std")
    damping_error = renamed("damping_error", "damping_std")
    shape_error = renamed("shape_error", "shape_std")

    def summary(self) -> str:
        """List frequency and damping ratio of each mode, with their 95 % intervals, and count the uncertain modes."""
        modes = range(self.frequency.size)
        texts = [f"{self.frequency_text(k)}, damping ratio {self.damping_text(k)}" for k in modes]
        if self.uncertain:
            texts.append(f"uncertain: {', '.join(each.frequency_text() for each in self.uncertain)}")
        return f"{self.label}: {'; '.join(texts)}"

    def uncertain_count_text(self) -> str:
        """Return the number of uncertain modes for the end of a heading, such as ``, 2 uncertain``; empty if 0."""
        return f", {len(self.uncertain)} uncertain" if self.uncertain else ""

    def frequency_text(self, mode: int) -> str:
        """Write a natural frequency with its expanded uncertainty (95 %)."""
        return _frequency_text(self.frequency[mode], self.frequency_std[mode])

    def frequency_label(self, mode: int) -> str:
        """Write a natural frequency for a label: two decimals, or fewer if its interval (95 %) has fewer.

        A label that would be that of two modes has two decimals.
        """
        labels = [*map(format_frequency, self.frequency, expand(self.frequency_std))]
        return labels[mode] if labels.count(labels[mode]) == 1 else f"{self.frequency[mode]:.2f} Hz"

    def damping_text(self, mode: int) -> str:
        """Write a damping ratio with its expanded uncertainty (95 %), or an upper limit if it is poorly determined."""
        return _damping_text(self.damping[mode], self.damping_std[mode])

    def cells(self, mode: int) -> tuple[str, str]:
        """Write natural frequency [Hz] and damping ratio, %, without their units, for a table."""
        return _cells(self.frequency[mode], self.frequency_std[mode], self.damping_text(mode))

    def table(self, mac_texts: Sequence[str] = (), damping_notes: Sequence[str] = ()) -> Table:
        """Return frequency, damping ratio and shape of each mode, then the uncertain modes with their reasons.

        `mac_texts`: similarity with shapes of the scene; `damping_notes`: text after each damping ratio.
        """
        bodies = self.of_bodies()
        shapes = zip(bodies.shapes.T.real, expand(bodies.errors).T, strict=True)
        empty = [""] * self.frequency.size
        rows = [
            (frequency, damping + note, mac_text, *map(_component_text, *shape), "")
            for (frequency, damping), note, mac_text, shape in zip(
                map(self.cells, range(self.frequency.size)), damping_notes or empty, mac_texts or empty, shapes,
                strict=True,
            )
        ]  # fmt: skip
        rows += [(*each.cells(), "", *[""] * len(bodies.names), each.reason) for each in self.uncertain]
        places = (f"at {name}" for name in bodies.names)
        heading = ("frequency / Hz", "damping ratio / %", "MAC with scene", *places, "uncertain because")
        return Table(heading, ">" * (len(heading) - 1) + "<", rows)

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return frequency, damping ratio, and the shape at each response, with standard uncertainties."""
        return {
            "frequency_Hz": self.frequency,
            "frequency_std_Hz": self.frequency_std,
            "damping_ratio": self.damping,
            "damping_ratio_std": self.damping_std,
            **{f"shape_{name}": row for name, row in zip(self.responses, self.shapes, strict=True)},
            **{f"shape_{name}_std": row for name, row in zip(self.responses, self.shape_std, strict=True)},
        }

    def draw(self, ax: Axes, **style: Any) -> None:
        """Draw the shape of each mode along the bodies."""
        bodies = self.of_bodies()
        for f, shape in zip(self.frequency, bodies.shapes.T, strict=True):
            ax.plot(bodies.names, shape.real, "o-", **complete_style(style, label=f"{f:.4g} Hz"))
        ax.set(ylabel="mode shape")

    def plot_stabilization(self, ax: Axes | None = None) -> Axes:
        """Draw the stabilization diagram: poles of models of increasing order, and a line at each identified mode.

        A mode of the structure is a column of stable poles. Computational poles, which represent noise, scatter.

        Parameters
        ----------
        ax : matplotlib Axes, optional
            Axes to draw into; omitted: new axes of pyplot.

        Returns
        -------
        matplotlib Axes
        """
        if ax is None:
            import matplotlib.pyplot as plt

            ax = plt.subplots(layout="constrained")[1]
        for kind, poles in pole_kinds(self).items():
            marker, color, inside = _POLE_STYLES[kind]
            ax.plot(*poles, marker, ms=2.6, color=color, mfc=inside, label=kind, ls="")
        for natural in self.frequency:
            ax.axvline(natural, color="#777777", lw=0.7, ls=":", zorder=0)
        for number, mode in enumerate(self.uncertain):
            name = "uncertain mode" if number == 0 else None
            ax.axvline(mode.frequency, color="#bb5500", lw=0.7, ls="--", zorder=0, label=name)
        ax.set(xlabel="frequency / Hz", ylabel="order")
        # The legend is above the axes because poles can lie anywhere inside.
        ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=4, borderaxespad=0.0, borderpad=0.0)
        return ax

    @property
    def shapes(self) -> ComplexArray:
        """Return the shapes scaled to largest component 1, shape (responses, modes)."""
        largest = np.argmax(abs(self.residue), axis=0)
        return self.residue / self.residue[largest, np.arange(self.residue.shape[1])]

    def of_bodies(self) -> BodyShapes:
        """Return a component of each shape for each body, in the order of bodies: the weighted mean of its sensors."""
        places = self.places or ("",) * len(self.responses)
        # A channel with an unknown location is a separate point.
        keys = [place or f"channel {name}" for place, name in zip(places, self.responses, strict=True)]
        number = dict(zip(keys, self.bodies or (0,) * len(keys), strict=True))
        names, shapes, errors = [], [], []
        # The largest component scales a shape without uncertainty; it gets the weight of the most precise other.
        smallest_error = np.min(self.shape_std, axis=0, initial=np.inf, where=self.shape_std > 0.0)
        weights = 1.0 / np.where(np.isfinite(smallest_error), np.maximum(self.shape_std, smallest_error), 1.0) ** 2
        ordered = sorted(number, key=lambda key: number[key] or inf)
        for key in ordered:
            rows = [row for row, other in enumerate(keys) if other == key]
            ratio = weights[rows] / weights[rows].sum(axis=0)
            # A body without a name and with one sensor, or an unknown location, has the name of the channel.
            is_unnamed = len(rows) == 1 and (not places[rows[0]] or places[rows[0]].startswith("body "))
            names.append(self.responses[rows[0]] if is_unnamed else key)
            shapes.append((ratio * self.shapes[rows]).sum(axis=0))
            errors.append(np.sqrt(((ratio * self.shape_std[rows]) ** 2).sum(axis=0)))
        shape, error = np.array(shapes), np.array(errors)
        largest, modes = np.argmax(abs(shape), axis=0), np.arange(shape.shape[1])
        error[largest, modes] = 0.0
        shape, error = shape / shape[largest, modes], error / abs(shape[largest, modes])
        return BodyShapes(tuple(names), shape, error, tuple(ordered))

    def without_exponential_window(self, time_constant: float) -> Modes:
        """Remove the damping that an exponential window of the analyzer has added.

        The window exp(-t / `time_constant`) on force and response, with the force at its beginning, moves each pole by
        -1 / `time_constant` along the real axis; damped natural frequencies and shapes do not change (D. J. Ewins,
        Modal Testing, 2nd ed., Research Studies Press 2000, section 3.8).

        Parameters
        ----------
        time_constant : float
            Time in s after which the window is 1/e. A window that falls to the fraction p at the time T has
            -T / ln(p).

        Returns
        -------
        Modes
            With damping ratios, undamped natural frequencies and the uncertainty of the damping without the window.

        Raises
        ------
        SceneError
            If the window has more damping than a mode.
        """
        if not time_constant > 0.0:
            raise SceneError(f"exponential window: got a time constant of {time_constant} s; expected above 0 s")
        frequency, damping, damping_std = _without_window(self.frequency, self.damping, self.damping_std, time_constant)
        if (excessive := np.flatnonzero(damping + expand(damping_std) <= 0.0)).size:
            k = int(excessive[0])
            share = 1.0 / (2 * np.pi * time_constant * self.frequency[k])
            raise SceneError(
                f"exponential window: a time constant of {time_constant:.4g} s alone gives a damping ratio of "
                f"{format_percent(share)} at {self.frequency[k]:.5g} Hz, where the curves have {self.damping_text(k)}. "
                "Give the time constant of the window in s."
            )
        note = (
            f"The damping of an exponential window (time constant {time_constant:.4g} s) is removed. Other warnings "
            "apply to the curves with the window."
        )
        return replace(
            self,
            frequency=frequency,
            damping=damping,
            damping_std=damping_std,
            warnings=(*self.warnings, note),
            uncertain=tuple(each.without_exponential_window(time_constant) for each in self.uncertain),
        )

    @property
    def poles(self) -> ComplexArray:
        """Poles of the modes [rad/s], shape (modes,)."""
        return _poles(self.frequency, self.damping)

    def receptance(self, frequency: Array) -> ComplexArray:
        """Compute the compliance of the modal model [m/N], shape (responses, frequencies); frequencies in Hz."""
        terms = np.column_stack([self.lower, self.upper])
        return modal_receptance(np.asarray(frequency, dtype=float), self.poles, self.residue, terms)

    @property
    def collinearity(self) -> Array:
        """Compute the modal phase collinearity: 1 if all points move in phase or in antiphase, 0 for a traveling wave.

        The collinearity is abs(r^T r)^2 / (r^H r)^2 for the residues r (J.-N. Juang, R. S. Pappa, J. Guid. Control
        Dyn. 8 (1985)).
        """
        return np.array([(abs(np.sum(shape**2)) / np.sum(abs(shape) ** 2)) ** 2 for shape in self.residue.T])


def mac(first: NDArray[np.generic] | Modes, second: NDArray[np.generic] | Modes) -> Array:
    """Compute the modal assurance criterion between the columns of two shape matrices, or between identified modes.

    Parameters
    ----------
    first, second : ndarray of shape (points, shapes), or Modes
        Shapes at the same points.

    Returns
    -------
    ndarray, shape (shapes of first, shapes of second)
        Values from 0 to 1; 1 for equal shapes.

    Raises
    ------
    SceneError
        If an argument is neither a matrix nor modes, or if the numbers of points differ.

    Examples
    --------
    >>> mac(np.eye(2), np.array([[1.0, 1.0], [0.0, 1.0]])).round(6).tolist()
    [[1.0, 0.5], [0.0, 0.5]]
    """
    a, b = (_shape_matrix(shapes) for shapes in (first, second))
    if a.ndim != 2 or b.ndim != 2 or len(a) != len(b):
        raise SceneError(
            f"mac: got arrays of shape {a.shape} and {b.shape}; expected two matrices with one row for each point"
        )
    cross = abs(a.conj().T @ b) ** 2
    return cross / np.outer(np.sum(abs(a) ** 2, axis=0), np.sum(abs(b) ** 2, axis=0))


def _frequency_text(frequency: float, error: float) -> str:
    if np.isnan(error):
        return f"{frequency:.6g} Hz"
    return format_quantity(frequency, float(expand(error)), "Hz")


def _cells(frequency: float, error: float, damping_text: str) -> tuple[str, str]:
    return format_interval(frequency, float(expand(error))), damping_text.strip("(%) ")


def _damping_text(damping: float, error: float) -> str:
    ratio, expanded = 100.0 * damping, 100.0 * float(expand(error))
    if np.isnan(expanded):
        return f"{ratio:.4g} %"
    if error < MAX_RELATIVE_UNCERTAINTY * damping:
        return format_quantity(ratio, expanded, "%")
    # The damping is not determined at all if the interval extends to 100 %.
    return f"below {format_percent(0.01 * (ratio + expanded))}" if ratio + expanded < 100.0 else "not determined"


def _without_window(
    frequency: Array, damping: Array, damping_std: Array, time_constant: float
) -> tuple[Array, Array, Array]:
    """Remove the damping of an exponential window from natural frequencies [Hz] and damping ratios."""
    poles = _poles(frequency, damping) + 1.0 / time_constant
    natural = np.asarray(abs(poles) / (2 * np.pi))
    return natural, np.asarray(-poles.real / abs(poles)), damping_std * frequency / natural


def _poles(frequency: Array, damping: Array) -> ComplexArray:
    return np.asarray(2 * np.pi * frequency * (-damping + 1j * np.sqrt(1.0 - damping**2)))


def _shape_matrix(shapes: NDArray[np.generic] | Modes) -> ComplexArray:
    if isinstance(shapes, Modes):
        return shapes.shapes
    is_matrix = isinstance(shapes, np.ndarray | Sequence) and not isinstance(shapes, Response)
    if not is_matrix or any(isinstance(row, Response) for row in shapes):
        raise SceneError(
            f"mac: got {type(shapes).__name__}; expected modes or their shapes, such as analysis.identify(frfs)"
        )
    return np.asarray(shapes, dtype=complex)


def _component_text(component: float, expanded: float) -> str:
    """Write a component of a shape with its interval, unless this contains all components from -1 to 1.

    >>> _component_text(-0.31, 0.05), _component_text(0.2, 45.0)
    ('-0.310 ± 0.050', 'not determined')
    """
    return "not determined" if expanded >= 1.0 + abs(component) else format_interval(component, expanded)


def pole_kinds(modes: Modes) -> dict[str, Array]:
    """Return frequencies [Hz] and model orders of the poles in a stabilization diagram, shape (2, poles), by kind."""
    poles = [(pole.frequency, pole.order, pole.stable) for pole in sorted(modes.chart, key=lambda pole: pole.frequency)]
    frequency, order, stable = np.array(poles).reshape(-1, 3).T
    is_near = (abs(frequency[:, None] / modes.frequency - 1.0) <= MODE_WIDTH).any(axis=1)
    kinds = {"new pole": stable == 0, "stable": (stable > 0) & is_near, "stable, no mode": (stable > 0) & ~is_near}
    return {kind: np.array([frequency[is_kind], order[is_kind]]) for kind, is_kind in kinds.items() if is_kind.any()}
