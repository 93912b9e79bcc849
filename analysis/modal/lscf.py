"""Initial poles by least-squares complex frequency-domain estimation (LSCF), and their stabilization chart.

The poles of common-denominator models of rising order are compared. A pole that recurs at the next order is *stable*.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from rig.arrays import Array, ComplexArray

# Largest damping ratio of a resonance.
MAX_DAMPING = 0.25
# Smallest number of stable poles in a stable column of a chart.
_MIN_STABLE_POLES = 4


@dataclass(frozen=True)
class ChartPole:
    """One pole of the stabilization chart."""

    order: int  # number of modes of its model
    frequency: float  # Hz
    damping: float  # damping ratio
    stable: bool  # whether the previous order has a pole within a quarter of the half-power bandwidth

    @property
    def pole(self) -> complex:
        """Return the pole, rad/s."""
        omega = 2 * np.pi * self.frequency
        return complex(-self.damping * omega, omega * np.sqrt(1.0 - self.damping**2))


def poles_by_order(
    frequency: Array, value: ComplexArray, weight: Array, orders: range
) -> Iterator[tuple[int, ComplexArray]]:
    """Estimate poles by common-denominator models of rising order, fitted to all responses.

    The model is H_o = B_o(z) / A(z) with z = exp(-i pi (f - f_min) / (f_max - f_min)), complex coefficients, and the
    highest coefficient of A set to 1. With this constraint the poles due to noise are unstable, and the chart is
    clear (P. Guillaume et al., A poly-reference implementation of the least-squares complex frequency-domain
    estimator, IMAC XXI, 2003). The frequencies need not be evenly spaced. `weight`: inverse standard deviations of
    `value`, shape (outputs, n). Yields the order and the stable poles inside the band, rad/s.
    """
    low, high = float(frequency.min()), float(frequency.max())
    phase = np.pi * (frequency - low) / (high - low)
    basis = np.exp(-1j * phase[:, None] * np.arange(max(orders) + 1))
    bases = [
        (basis * scale[:, None], -basis * (row * scale)[:, None]) for row, scale in zip(value, weight, strict=True)
    ]
    for order in orders:
        # Normal matrix of the denominator; the numerators are eliminated.
        reduced = np.zeros((order + 1, order + 1), dtype=complex)
        for numerator, denominator in bases:
            orthogonal, _ = np.linalg.qr(numerator[:, : order + 1])
            projected = denominator[:, : order + 1]
            projected = projected - orthogonal @ (orthogonal.conj().T @ projected)
            reduced += projected.conj().T @ projected
        coefficients = np.linalg.lstsq(reduced[:order, :order], -reduced[:order, order], rcond=None)[0]
        roots = np.roots(np.append(coefficients, 1.0)[::-1])
        with np.errstate(divide="ignore"):
            # z = exp(-s T) along s = i w, with T = 1 / (2 (f_max - f_min)) and the band's start folded in.
            s = -np.log(roots[roots != 0]) * 2.0 * (high - low) + 2j * np.pi * low
        # The polynomial is poorly determined in the outermost hundredth of the band, so that poles there are spurious.
        edge = 0.01 * (high - low)
        inside = (s.real < 0) & (s.imag > 2 * np.pi * (low + edge)) & (s.imag < 2 * np.pi * (high - edge))
        yield order, s[inside]


def stabilization_chart(frequency: Array, value: ComplexArray, weight: Array) -> list[ChartPole]:
    """Compute the stabilization chart of models with 2 to 24 poles; `weight` as in `poles_by_order`."""
    chart: list[ChartPole] = []
    previous: list[complex] = []
    spacing = float(np.median(np.diff(frequency)))
    for order, poles in poles_by_order(frequency, value, weight, range(2, 25)):
        current = sorted((p for p in poles if -p.real < MAX_DAMPING * abs(p)), key=lambda p: p.imag)
        for p in current:
            stable = any(_same_pole(p, q, spacing) for q in previous)
            chart.append(ChartPole(order, float(abs(p) / (2 * np.pi)), float(-p.real / abs(p)), stable))
        previous = current
    return chart


def merge_charts(frequency: Array, charts: Sequence[list[ChartPole]]) -> tuple[ComplexArray, ComplexArray]:
    """Merge equal poles of charts to columns; return the poles of stable columns and of all columns, rad/s.

    Columns with the most stable poles are first.
    """
    spacing = float(np.median(np.diff(frequency)))
    columns: list[tuple[complex, int]] = []  # last pole and number of stable poles of each column
    for chart_pole in itertools.chain(*charts):
        p = chart_pole.pole
        same = [i for i, (q, _) in enumerate(columns) if _same_pole(p, q, spacing)]
        if same:
            index = min(same, key=lambda i: abs(columns[i][0] - p))
            q, n_stable = columns[index]
            # The last pole is the most accurate, because at its order other poles represent the noise.
            columns[index] = (p if chart_pole.stable else q, n_stable + chart_pole.stable)
        else:
            columns.append((p, int(chart_pole.stable)))
    columns.sort(key=lambda column: -column[1])
    return (
        np.array([p for p, n_stable in columns if n_stable >= _MIN_STABLE_POLES], dtype=complex),
        np.array([p for p, _ in columns], dtype=complex),
    )


def _same_pole(p: complex, q: complex, spacing: float) -> bool:
    """Return whether two poles are closer than a quarter of the half-power bandwidth or of the line spacing."""
    return abs(p - q) < max(0.5 * max(-p.real, -q.real), 0.5 * np.pi * spacing)
