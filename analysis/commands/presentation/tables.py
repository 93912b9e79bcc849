"""CSV tables of the results; the heading of each column states quantity and unit."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from analysis.core.modal.modes import Modes
from rig.core.base.escaping import escape_cell, escape_terminal
from rig.core.base.output_files import atomic_write
from rig.core.results import round_to_uncertainty
from rig.core.results.response import Response
from rig.core.results.uncertainty import expand

if TYPE_CHECKING:
    from analysis.core.decays.free_decay import Decay

Row = Sequence[str | float | int]

# Approximate number of rows of an envelope table; the recording itself contains every sample.
_ENVELOPE_ROWS = 400


def write_table(path: Path, heading: Sequence[str], rows: Iterable[Row]) -> Path:
    """Write a table with nine significant digits and empty cells for missing values; return its path."""
    with atomic_write(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(map(escape_cell, heading))
        for row in rows:
            writer.writerow([_cell(value) for value in row])
    return path


def _cell(value: str | float | int) -> str:
    if isinstance(value, str):
        # The label can be a file name, which is not necessarily valid UTF-8.
        return escape_cell(escape_terminal(value))
    if isinstance(value, int | np.integer):
        return str(value)
    return "" if np.isnan(value) else f"{value:.9g}"


def frf_table(path: Path, frfs: Sequence[Response]) -> Path:
    """Write a table with a row for each curve and frequency; omitted frequencies have no values."""
    unit = frfs[0].unit.replace("²", "^2")
    heading = [
        "scene", "response", "reference", "frequency_Hz", f"real {unit}", f"imag {unit}", f"magnitude {unit}",
        "phase_deg", f"magnitude_std {unit}", "coherence",
        f"systematic {unit}", "steady", "resolution_Hz",
    ]  # fmt: skip
    rows: list[Row] = []
    for frf in frfs:
        # Omitted frequencies have rows without values, so a line drawn from the table is interrupted there.
        curve = frf.with_gaps() if frf.omitted.size else frf
        systematic = curve.expanded_systematic() if curve.limits else np.full(curve.frequency.size, np.nan)
        measured = np.isfinite(curve.value)
        rows += [
            (
                curve.label, curve.response, curve.input, curve.frequency[i], value.real, value.imag, abs(value),
                float(np.degrees(np.angle(value))), curve.error[i], curve.coherence[i],
                systematic[i] if measured[i] else np.nan,
                "" if curve.unsteady is None or not measured[i] else "no" if curve.unsteady[i] else "yes",
                curve.resolution,
            )
            for i, value in enumerate(curve.value)
        ]  # fmt: skip
    return write_table(path, heading, rows)


def envelope_table(path: Path, decays: Sequence[Decay]) -> Path:
    """Write a table of envelopes against time: largest magnitude and energy in each of about 400 intervals."""
    heading = ["scene", "channel", "hit", "time_s", "peak m/s^2", "envelope m/s^2", "schroeder_dB"]
    rows: list[Row] = []
    for decay in decays:
        step = max(1, decay.time.size // _ENVELOPE_ROWS)
        for start in range(0, decay.time.size - step + 1, step):
            interval = slice(start, start + step)
            largest = float(abs(decay.acceleration[interval]).max()), float(decay.envelope[interval].max())
            rows.append((decay.label, decay.channel, decay.impact, decay.time[start], *largest, decay.energy[start]))
    return write_table(path, heading, rows)


def damping_table(path: Path, decays: Sequence[Decay]) -> Path:
    """Write a table of damping ratio and natural frequency against amplitude for each mode."""
    heading = [
        "scene", "channel", "hit", "mode_Hz", "amplitude m/s^2", "damping_ratio", "damping_ratio_std",
        "log_decrement", "frequency_Hz", "frequency_std_Hz",
    ]  # fmt: skip
    rows: list[Row] = []
    for decay in decays:
        for mode in decay.modes:
            columns = mode.damping, mode.damping_std, mode.decrement, mode.natural_frequency, mode.natural_frequency_std
            cells = zip(mode.amplitude, *columns, strict=True)
            rows += [(decay.label, decay.channel, decay.impact, mode.frequency, *row) for row in cells]
    return write_table(path, heading, rows)


def modes_table(path: Path, sweeps: Sequence[Modes]) -> Path:
    """Write a table of natural frequencies, damping ratios and mode shapes.

    Frequencies and damping ratios have the digits of their 95 % intervals, as in all other outputs. Uncertain modes
    have no number and no shape.
    """
    channels = list(dict.fromkeys(name for modes in sweeps for name in modes.of_bodies().names))
    heading = [
        "scene", "reference", "mode", "frequency_Hz", "frequency_std_Hz", "omega_rad_s", "damping_ratio",
        "damping_ratio_std",
        *(f"shape {name}" for name in channels), *(f"shape {name} std" for name in channels), "phase_collinearity",
        "uncertain_because",
    ]  # fmt: skip
    rows: list[Row] = []
    for modes in sweeps:
        bodies = modes.of_bodies()
        for i, frequency in enumerate(modes.frequency):
            shape = dict(zip(bodies.names, bodies.shapes[:, i].real, strict=True))
            error = dict(zip(bodies.names, bodies.errors[:, i], strict=True))
            rows.append((
                modes.label, modes.input, i + 1,
                *_modal_cells(frequency, modes.frequency_std[i], modes.damping[i], modes.damping_std[i]),
                *(shape.get(name, np.nan) for name in channels),
                *(error.get(name, np.nan) for name in channels), modes.collinearity[i], "",
            ))  # fmt: skip
        unknown_shape = [np.nan] * (2 * len(channels) + 1)
        rows += [
            (modes.label, modes.input, "", *_modal_cells(*each[:4]), *unknown_shape, each.reason)
            for each in modes.uncertain
        ]
    return write_table(path, heading, rows)


def _modal_cells(frequency: float, frequency_std: float, damping: float, damping_std: float) -> Sequence[float]:
    """Round a natural frequency in Hz and in rad/s, and a damping ratio, with their standard uncertainties."""
    omega, _ = _rounded(2 * np.pi * frequency, 2 * np.pi * frequency_std)
    return *_rounded(frequency, frequency_std), omega, *_rounded(damping, damping_std)


def _rounded(value: float, error: float) -> tuple[float, float]:
    """Round a value to the digits of its 95 % interval, and its standard uncertainty to two digits."""
    return float(round_to_uncertainty(value, float(expand(error)))), float(f"{error:.2g}")
