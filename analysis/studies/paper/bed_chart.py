"""Color maps for claim C7 (a granular bed moves like a single mass), over acceleration, clearance and depth."""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from analysis.studies.paper.bed_claim import MAX_DEVIATION, deviation, deviation_error
from analysis.studies.paper.bed_study import FREQUENCY
from analysis.studies.paper.contact_study import (
    at_shaking_frequency,
    compliance_on_contact,
    deviation_on_contact,
    fit_contact,
    select,
    with_ceiling,
)
from analysis.studies.paper.figures import BLACK, Columns, Parts
from rig.core.base.figure_style import new_figure
from rig.core.base.figure_types import Axes, Figure

if TYPE_CHECKING:
    from matplotlib.image import AxesImage

# The color scale ends at this deviation [%].
_COLOR_LIMIT = 40.0


def beds(parts: Parts) -> Figure:
    """Draw the deviation of grains from the single mass at 50 Hz, for both kinds of contact, by number of layers."""
    data = at_shaking_frequency(parts["beds"])
    layers = np.unique(data["layers"])
    contact = fit_contact(with_ceiling(data), parts["contacts"])
    columns = (
        ("Compliance, instantaneous contact", deviation(data, "compliance"), deviation_error(data, "compliance")),
        ("Energy, instantaneous contact", deviation(data, "energy"), deviation_error(data, "energy")),
        (
            f"Compliance, contact of {1e3 * contact.duration:g} ms",
            deviation_on_contact(contact, data, parts["contacts"]),
            deviation_error(data, "compliance")
            * data["mass_compliance"]
            / compliance_on_contact(contact, data, parts["contacts"]),
        ),
    )
    with new_figure(2.3 * len(layers), 10.0) as figure:
        panels = figure.subplots(len(layers), len(columns), squeeze=False, sharex=True, sharey=True)
        for row, depth in zip(panels, layers, strict=True):
            at_depth = data["layers"] == depth
            for axes, (_, deviations, error) in zip(row, columns, strict=True):
                image = _draw_panel(axes, data, at_depth, 100.0 * deviations, 100.0 * error)
            row[0].set_ylabel(f"{depth:g} layers: acceleration / g")
        for axes, (title, *_) in zip(panels[0], columns, strict=True):
            axes.set_title(title)
        for axes in panels[-1]:
            axes.set_xlabel("clearance / mm")
        figure.colorbar(
            image, ax=list(panels.flat), label="deviation of grains from the single mass / %", extend="both", aspect=40
        )
    return figure


def modes(parts: Parts) -> Figure:
    """Draw the deviation of the compliance with grains from that with a single mass, by number of layers.

    The frequencies are those of all studied modes but the mode at 50 Hz.
    """
    other_modes = select(parts["beds"], parts["beds"]["frequency"] != FREQUENCY)
    frequencies, layers = np.unique(other_modes["frequency"]), np.unique(other_modes["layers"])
    with new_figure(2.3 * len(layers), 4.0 * len(frequencies)) as figure:
        panels = figure.subplots(len(layers), len(frequencies), squeeze=False)
        for (row, depth), (column, frequency) in product(enumerate(layers), enumerate(frequencies)):
            axes, data = panels[row, column], select(other_modes, other_modes["frequency"] == frequency)
            deviations, error = deviation(data, "compliance"), deviation_error(data, "compliance")
            image = _draw_panel(axes, data, data["layers"] == depth, 100.0 * deviations, 100.0 * error)
            axes.set(ylabel=f"{depth:g} layers: acceleration / g" if column == 0 else "")
            axes.set(xlabel="clearance / mm" if row == len(layers) - 1 else "")
            axes.set_title(f"Compliance at {frequency:g} Hz" if row == 0 else "")
        figure.colorbar(
            image, ax=list(panels.flat), label="deviation of grains from the single mass / %", extend="both", aspect=40
        )
    return figure


def _draw_panel(
    axes: Axes, data: Columns, at_depth: np.ndarray, deviations: np.ndarray, error: np.ndarray
) -> AxesImage:
    """Draw deviations in % as a color map, with values and uncertainties, against clearance and acceleration."""
    levels, clearances = np.unique(data["level"]), np.unique(data["clearance"])
    values = np.full((len(levels), len(clearances)), np.nan)
    for k in np.flatnonzero(at_depth):
        i, j = np.searchsorted(levels, data["level"][k]), np.searchsorted(clearances, data["clearance"][k])
        values[i, j] = deviations[k]
        if not np.isfinite(deviations[k]):
            continue
        error_label = f" ±{error[k]:.0f}" if np.isfinite(error[k]) else ""
        axes.text(
            j, i, f"{deviations[k]:+.0f}{error_label}", ha="center", va="center", fontsize=5.6,
            color="white" if abs(deviations[k]) > 0.65 * _COLOR_LIMIT else BLACK,
            weight="bold" if abs(deviations[k]) <= 100.0 * MAX_DEVIATION else "normal",
        )  # fmt: skip
    image = axes.imshow(values, origin="lower", aspect="auto", cmap="RdBu_r", vmin=-_COLOR_LIMIT, vmax=_COLOR_LIMIT)
    axes.grid(False)
    axes.set_xticks(range(len(clearances)), [f"{1e3 * c:g}" if np.isfinite(c) else "∞" for c in clearances])
    axes.set_yticks(range(len(levels)), [f"{level:g}" for level in levels])
    return image
