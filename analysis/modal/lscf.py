"""Least-squares complex frequency-domain estimation: poles of a common-denominator model, order by order."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from rig.arrays import Array, ComplexArray

# Poles with a larger damping ratio are not resonances.
MOST_DAMPING = 0.25
# A column of a chart is stable if it contains at least this number of stable poles.
OFTEN = 4


@dataclass(frozen=True)
class ChartPole:
    """One pole of the stabilisation chart."""

    order: int  # number of modes of its model
    frequency: float
    damping: float  # Hz and damping ratio
    stable: bool  # whether the previous order has a pole within a quarter of the half-power width

    @property
    def pole(self) -> complex:
        """Pole, rad/s."""
        size = 2 * np.pi * self.frequency
        return complex(-self.damping * size, size * np.sqrt(1.0 - self.damping**2))


def poles_by_order(
    frequency: Array, value: ComplexArray, weight: Array, orders: range
) -> Iterator[tuple[int, ComplexArray]]:
    """Estimate poles by common-denominator models of rising order, fitted to all responses.

    The model is H_o = B_o(z) / A(z) with z = exp(-i pi (f - f_min) / (f_max - f_min)), complex coefficients, and the
    highest coefficient of A set to 1. With this constraint the poles due to noise are unstable, and the chart is
    clear (P. Guillaume et al., A poly-reference implementation of the least-squares complex frequency-domain
    estimator, IMAC XXI, 2003). The frequencies need not be evenly spaced. `weight`: inverse standard deviations of
    `value`, shape (outputs, n). Yields stable poles inside the band, rad/s.
    """
    low, high = float(frequency.min()), float(frequency.max())
    phase = np.pi * (frequency - low) / (high - low)
    basis = np.exp(-1j * phase[:, None] * np.arange(max(orders) + 1))
    pieces = [
        (basis * scale[:, None], -basis * (row * scale)[:, None])
        for row, scale in zip(value, weight, strict=True)
    ]
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
        # Poles in the outermost hundredth of the band are spurious, because the polynomial is poorly determined
        # there.
        edge = 0.01 * (high - low)
        wanted = (s.real < 0) & (s.imag > 2 * np.pi * (low + edge)) & (s.imag < 2 * np.pi * (high - edge))
        yield order, s[wanted]


def chart(frequency: Array, value: ComplexArray, weight: Array, most: int = 24) -> list[ChartPole]:
    """Compute the stabilisation chart of models with 2 to `most` poles."""
    out: list[ChartPole] = []
    before: list[complex] = []
    spacing = float(np.median(np.diff(frequency)))
    for order, poles in poles_by_order(frequency, value, weight, range(2, most + 1)):
        here = sorted((p for p in poles if -p.real < MOST_DAMPING * abs(p)), key=lambda p: p.imag)
        for p in here:
            known = any(_same(p, q, spacing) for q in before)
            out.append(ChartPole(order, float(abs(p) / (2 * np.pi)), float(-p.real / abs(p)), known))
        before = here
    return out


def columns(frequency: Array, charts: Sequence[list[ChartPole]]) -> tuple[ComplexArray, ComplexArray]:
    """Merge the poles of charts, rad/s; return the stable poles, the most frequent first, and all poles."""
    spacing = float(np.median(np.diff(frequency)))
    seen: list[tuple[complex, int]] = []
    for one in charts:
        for pole in one:
            p = pole.pole
            near = [i for i, (q, _) in enumerate(seen) if _same(p, q, spacing)]
            if near:
                index = min(near, key=lambda i: abs(seen[i][0] - p))
                q, times = seen[index]
                # The last pole is from the highest order, in which other poles represent the other modes and the
                # noise.
                seen[index] = (p if pole.stable else q, times + pole.stable)
            else:
                seen.append((p, int(pole.stable)))
    seen.sort(key=lambda one: -one[1])
    return (
        np.array([p for p, times in seen if times >= OFTEN], dtype=complex),
        np.array([p for p, _ in seen], dtype=complex),
    )


def _same(p: complex, q: complex, spacing: float) -> bool:
    """Whether two poles are nearer to each other than a quarter of the half-power width, or of the spacing of lines."""
    return abs(p - q) < max(0.5 * max(-p.real, -q.real), 0.5 * np.pi * spacing)
