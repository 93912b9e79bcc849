"""Initial poles by least-squares complex frequency-domain estimation (LSCF), and their stabilization diagram.

The poles of common-denominator models of increasing order are compared. A pole that recurs at the next order is
*stable*; a pole s with Re s < 0 is *decaying*.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rig.core.base.arrays import Array, ComplexArray

# A pole with a larger damping ratio is discarded: its half-power width exceeds half of its frequency, so it has no
# distinct peak.
MAX_DAMPING = 0.25
# A cluster represents a mode if it contains at least this number of stable poles.
_MIN_STABLE_POLES = 4


@dataclass(frozen=True)
class ChartPole:
    """One pole of the stabilization diagram."""

    order: int  # order of the denominator: number of poles of its model
    frequency: float  # Hz
    damping: float  # damping ratio
    stable: bool  # whether the previous order has nearly the same pole (see `_are_same_poles`)

    @property
    def pole(self) -> complex:
        """Return the pole [rad/s]."""
        omega = 2 * np.pi * self.frequency
        return complex(-self.damping * omega, omega * np.sqrt(1.0 - self.damping**2))


def poles_by_order(
    frequency: Array, value: ComplexArray, weight: Array, orders: range
) -> Iterator[tuple[int, ComplexArray]]:
    """Estimate poles by common-denominator models of increasing order, fitted to all responses.

    The model is H_o = B_o(z) / A(z) with z = exp(-i pi (f - f_min) / (f_max - f_min)), complex coefficients, and the
    highest coefficient of A set to 1. With this constraint the poles due to noise have Re s > 0, so they do not appear
    in the chart (P. Guillaume et al., A poly-reference implementation of the least-squares complex frequency-domain
    estimator, IMAC XXI, 2003). The frequencies need not be evenly spaced. `weight`: inverse standard deviations of
    `value`, shape (outputs, n). Yields the order and the decaying poles inside the band [rad/s].
    """
    f_min, f_max = float(frequency.min()), float(frequency.max())
    phase = np.pi * (frequency - f_min) / (f_max - f_min)
    basis = np.exp(-1j * phase[:, None] * np.arange(max(orders) + 1))
    reduced_normal_matrices = [np.zeros((order + 1, order + 1), dtype=complex) for order in orders]
    for row, scale in zip(value, weight, strict=True):
        # The numerator is eliminated from the normal equations. The orthonormal basis of an order contains the bases of
        # all lower orders, so each order removes one more direction from the columns.
        numerator_basis, residual = np.linalg.qr(basis * scale[:, None])[0], -basis * (row * scale)[:, None]
        removed = 0
        for order, normal_matrix in zip(orders, reduced_normal_matrices, strict=True):
            directions = numerator_basis[:, removed : order + 1]
            residual -= directions @ (directions.conj().T @ residual)
            used = residual[:, : order + 1]
            normal_matrix += used.conj().T @ used
            removed = order + 1
    for order, reduced_normal_matrix in zip(orders, reduced_normal_matrices, strict=True):
        matrix, right_side = reduced_normal_matrix[:order, :order], -reduced_normal_matrix[:order, order]
        coefficients = np.linalg.lstsq(matrix, right_side, rcond=None)[0]
        roots = np.roots(np.append(coefficients, 1.0)[::-1])
        with np.errstate(divide="ignore"):
            # z = exp(-(s - 2 pi i f_min) T) with T = 1 / (2 (f_max - f_min)).
            s = -np.log(roots[roots != 0]) * 2.0 * (f_max - f_min) + 2j * np.pi * f_min
        # In the outermost hundredths of the band the polynomial is poorly determined, and poles are computational.
        edge = 0.01 * (f_max - f_min)
        inside = (s.real < 0) & (s.imag > 2 * np.pi * (f_min + edge)) & (s.imag < 2 * np.pi * (f_max - edge))
        yield order, s[inside]


def stabilization_diagram(frequency: Array, value: ComplexArray, weight: Array) -> list[ChartPole]:
    """Compute the stabilization diagram of models of order 2 to 24; arguments as in `poles_by_order`."""
    chart: list[ChartPole] = []
    previous: ComplexArray = np.zeros(0, dtype=complex)
    spacing = float(np.median(np.diff(frequency)))
    for order, poles in poles_by_order(frequency, value, weight, range(2, 25)):
        moderate = poles[-poles.real < MAX_DAMPING * abs(poles)]
        current = moderate[np.argsort(moderate.imag)]
        stable = _are_same_poles(current, previous, spacing).any(axis=1)
        natural = abs(current)
        for row in np.column_stack([natural / (2 * np.pi), -current.real / natural, stable]).tolist():
            chart.append(ChartPole(order, row[0], row[1], bool(row[2])))
        previous = current
    return chart


def merge_charts(frequency: Array, charts: Sequence[list[ChartPole]]) -> tuple[ComplexArray, ComplexArray]:
    """Cluster the poles of charts; return a pole [rad/s] of each stable cluster, most stable first, and all poles."""
    spacing = float(np.median(np.diff(frequency)))
    chart_poles = list(itertools.chain(*charts))
    poles = np.array([each.pole for each in chart_poles], dtype=complex)
    distances = abs(poles[:, None] - poles)
    distances[~_are_same_poles(poles, poles, spacing)] = np.inf
    clusters: list[tuple[int, int]] = []  # last stable pole, otherwise first pole, and number of stable poles
    for index, (row, chart_pole) in enumerate(zip(distances.tolist(), chart_poles, strict=True)):
        nearest = min(range(len(clusters)), key=lambda k: row[clusters[k][0]], default=None)
        if nearest is None or row[clusters[nearest][0]] == np.inf:
            clusters.append((index, int(chart_pole.stable)))
        else:
            earlier, n_stable = clusters[nearest]
            # The last pole is the most accurate, because at the highest order other poles represent the noise.
            clusters[nearest] = (index if chart_pole.stable else earlier, n_stable + chart_pole.stable)
    clusters.sort(key=lambda cluster: -cluster[1])
    stable = [index for index, n_stable in clusters if n_stable >= _MIN_STABLE_POLES]
    return poles[stable], poles[[index for index, _ in clusters]]


def _are_same_poles(first: ComplexArray, second: ComplexArray, spacing: float) -> NDArray[np.bool_]:
    """Return whether two poles are closer than a quarter of the half-power width, or of the line spacing in Hz."""
    width = np.maximum(-first.real[:, None], -second.real)
    return np.asarray(abs(first[:, None] - second) < np.maximum(0.5 * width, 0.5 * np.pi * spacing))
