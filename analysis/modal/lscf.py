"""Least-squares complex frequency-domain estimation: poles of a common-denominator model, order by order."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class ChartPole:
    """One pole of the stabilisation chart."""

    order: int
    """Number of modes in the model it comes from."""
    frequency: float
    damping: float
    """Hz and damping ratio."""
    stable: bool
    """Found again, within 1 % in frequency and 10 % in damping, from the order before."""


def poles_by_order(
    frequency: Array, value: ComplexArray, weight: Array, orders: range
) -> Iterator[tuple[int, ComplexArray]]:
    """Poles of scalar-denominator models of rising order fitted to all responses at once.

    The model is H_o = B_o(z) / A(z) with z = exp(-i pi (f - f_min) / (f_max - f_min)), complex
    coefficients and the highest coefficient of A set to one, which makes the poles of noise unstable and
    the chart clear [1]_. The frequencies need not be evenly spaced.

    Parameters
    ----------
    frequency : ndarray, shape (n,)
        Hz.
    value : ndarray of complex, shape (outputs, n)
        Frequency responses.
    weight : ndarray, shape (outputs, n)
        Inverse standard deviations.

    Yields
    ------
    poles : ndarray of complex
        In rad/s, those with a positive frequency inside the band and a negative real part.

    References
    ----------
    .. [1] P. Guillaume et al., A poly-reference implementation of the least-squares complex frequency-domain
       estimator, IMAC XXI, 2003.
    """
    low, high = float(frequency.min()), float(frequency.max())
    most = max(orders)
    phase = np.pi * (frequency - low) / (high - low)
    basis = np.exp(-1j * phase[:, None] * np.arange(most + 1))
    reduced = np.zeros((most + 1, most + 1), dtype=complex)
    pieces = []
    for row, scale in zip(value, weight, strict=True):
        numerator = basis * scale[:, None]
        denominator = -basis * (row * scale)[:, None]
        pieces.append((numerator, denominator))
    for order in orders:
        reduced = np.zeros((order + 1, order + 1), dtype=complex)
        for numerator, denominator in pieces:
            orthogonal, _ = np.linalg.qr(numerator[:, : order + 1])
            rest = denominator[:, : order + 1]
            rest = rest - orthogonal @ (orthogonal.conj().T @ rest)
            reduced += rest.conj().T @ rest
        head = np.linalg.lstsq(reduced[:order, :order], -reduced[:order, order], rcond=None)[0]
        roots = np.roots(np.append(head, 1.0)[::-1])
        with np.errstate(divide="ignore"):
            # z = exp(-s T) along s = i w, with T = 1 / (2 (f_max - f_min)) and the band's start folded in.
            s = -np.log(roots[roots != 0]) * 2.0 * (high - low) + 2j * np.pi * low
        # Poles in the outermost hundredth of the band are where a polynomial swings free, not where a mode
        # is.
        edge = 0.01 * (high - low)
        wanted = (s.real < 0) & (s.imag > 2 * np.pi * (low + edge)) & (s.imag < 2 * np.pi * (high - edge))
        yield order, s[wanted]


def chart(frequency: Array, value: ComplexArray, weight: Array, most: int = 24) -> list[ChartPole]:
    """Stabilisation chart of models with 2 to `most` poles."""
    out: list[ChartPole] = []
    before: list[tuple[float, float]] = []
    for order, poles in poles_by_order(frequency, value, weight, range(2, most + 1)):
        here = [(abs(p) / (2 * np.pi), float(-p.real / abs(p))) for p in poles]
        for f, zeta in sorted(here):
            known = any(abs(f - g) < 0.01 * f and abs(zeta - y) < 0.1 * zeta for g, y in before)
            out.append(ChartPole(order, f, zeta, known))
        before = here
    return out


def stable_poles(poles: list[ChartPole], most_damping: float = 0.2) -> list[tuple[float, float]]:
    """Frequencies [Hz] and damping ratios of the columns of a chart that stay from order to order.

    A column counts when it is stable in at least a third of the orders from its first appearance on and in at
    least three.
    """
    stable = sorted((p for p in poles if p.stable and p.damping < most_damping), key=lambda p: p.frequency)
    groups: list[list[ChartPole]] = []
    for pole in stable:
        if groups and pole.frequency < 1.01 * groups[-1][-1].frequency:
            groups[-1].append(pole)
        else:
            groups.append([pole])
    highest = max((p.order for p in poles), default=0)
    out = []
    for group in groups:
        seen = {p.order for p in group}
        if len(seen) >= max(3, (highest - min(seen) + 1) / 3):
            out.append(
                (float(np.median([p.frequency for p in group])), float(np.median([p.damping for p in group])))
            )
    return out
