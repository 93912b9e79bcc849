"""The modal model: poles shared by all responses, a residue for each; fitted by weighted least squares."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from rig.arrays import Array, ComplexArray

# Limit of evaluations: a fit from good initial values converges within it, and a fit from poor initial values is
# stopped.
_EVALUATIONS = 25
# Terms of the series that represents modes above the band: fewer lines determine only the first term.
ABOVE, _LINES = 3, 20
# Rounding error of the squared norm of a unit column.
_DEPENDENT = 1e-20


@dataclass(frozen=True)
class Curves:
    """Curves to which a modal model is fitted."""

    frequency: Array  # Hz, rising, shape (n,)
    value: ComplexArray  # receptances, m/N, shape (responses, n)
    weight: Array  # inverse standard deviations, shape (responses, n)
    shared: float = 1.0  # number of neighbouring lines with a common error
    resolution: float = 0.0  # Hz: leakage bandwidth of each line

    @property
    def numbers(self) -> int:
        """Count the measured real numbers."""
        return 2 * self.value.size

    @property
    def above(self) -> int:
        """Count the terms of the series for modes above the band that the lines can determine."""
        return ABOVE if self.frequency.size >= _LINES else 1

    def unknowns(self, poles: int) -> int:
        """Count the real parameters of a model with `poles` poles: poles, residues, and residual terms."""
        return 2 * poles + self.value.shape[0] * (2 * poles + 1 + self.above)

    def degrees(self, poles: int) -> int:
        """Count the degrees of freedom of the misfit of a model with `poles` poles."""
        return max(self.numbers - self.unknowns(poles), 1)


@dataclass(frozen=True)
class Fit:
    """Best modal model of some curves for a number of poles."""

    poles: ComplexArray  # rad/s, by rising frequency; shape (modes,)
    residue: ComplexArray  # m/(N s), shape (responses, modes)
    lower: Array  # lower / s² represents modes below the band; shape (responses,)
    upper: Array  # upper[0] + upper[1] s + upper[2] s² represents modes above the band; shape (responses, 3)
    misfit: float  # sum of squared weighted differences
    rest: ComplexArray  # weighted differences, measured less model; shape (responses, n)
    # derivative of `rest` by the logarithms of the decay rates, then by the damped frequencies in units of the
    # decay rates; shape (2 modes, responses, n)
    slope: ComplexArray


def fit(curves: Curves, start: ComplexArray) -> Fit:
    """Fit the poles by weighted nonlinear least squares; the linear unknowns are eliminated (variable projection)."""
    problem = Projection(curves, start)
    x = np.zeros(2 * start.size)
    if start.size:
        x = scipy.optimize.least_squares(
            lambda x: problem.reduced(x)[:, -1], x, lambda x: problem.reduced(x)[:, :-1],
            xtol=1e-9, ftol=1e-9, gtol=1e-12, max_nfev=_EVALUATIONS,
        ).x  # fmt: skip
    poles = problem.poles(x)
    unknown, rest = problem.unknowns(x), problem.misfit(x)
    order = np.argsort(poles.imag)
    count, shape = start.size, curves.value.shape
    upper = np.zeros((shape[0], ABOVE))
    upper[:, : curves.above] = unknown[:, 2 * count + 1 :]
    residue = unknown[:, 0 : 2 * count : 2] + 1j * unknown[:, 1 : 2 * count : 2]
    slope = np.empty((0, *shape), dtype=complex)
    if count:
        both = np.concatenate([order, order + count])
        rows = np.moveaxis(problem.slopes(x)[:, :, both], 2, 0)
        slope = rows[:, :, : shape[1]] + 1j * rows[:, :, shape[1] :]
    halves = rest.reshape(shape[0], 2, shape[1])
    return Fit(
        poles[order], residue[:, order], unknown[:, 2 * count], upper, float(np.sum(rest**2)),
        halves[:, 0] + 1j * halves[:, 1], slope,
    )  # fmt: skip


def residual_terms(s: NDArray[np.complexfloating]) -> list[NDArray[np.complexfloating]]:
    """Return the residual terms of modes outside the band, each with a real factor: first terms of series in 1/s or s.

    Above the band ``R / (s² + 2 ζ w s + w²)`` bends over its width by ``(s/w)²`` of itself, and its damping turns it by
    ``2 ζ s/w``. Fewer terms would bias the damping of a peak that is measured only on its flank or with much noise.
    """
    return [1.0 / s**2, *(s**power for power in range(ABOVE))]


def misfits_with(curves: Curves, poles: ComplexArray, added: ComplexArray) -> Array:
    """Compute the misfit with one more pole, for each of the added poles, with the best residues; shape (added,).

    An added pole lowers the misfit by the projection of the residual on the component of its two columns that is
    orthogonal to all other columns.
    """
    problem = Projection(curves, poles)
    x = np.zeros(2 * poles.size)
    basis, rest = problem.factors(x).basis, problem.misfit(x).reshape(len(curves.value), -1, 1)
    count = 2 * added.size
    more = _stacked(problem.columns(added)[:, :count] * curves.weight[:, :, None], 1)
    size = np.linalg.norm(more, axis=1, keepdims=True)
    more = more / np.where(size > 0.0, size, 1.0)
    # Orthogonalize twice, because rounding dominates the first result for columns close to those of other poles.
    for _ in range(2):
        more = more - basis @ (np.swapaxes(basis, 1, 2) @ more)
    scores = (np.swapaxes(more, 1, 2) @ rest)[..., 0]
    first, second = more[..., ::2], more[..., 1::2]
    a, b, c = (
        np.einsum("ojk,ojk->ok", one, two) for one, two in ((first, first), (first, second), (second, second))
    )
    u, v = scores[:, ::2], scores[:, 1::2]
    along = np.where(a > _DEPENDENT, u**2 / np.maximum(a, _DEPENDENT), 0.0)
    left = c - np.where(a > _DEPENDENT, b**2 / np.maximum(a, _DEPENDENT), 0.0)
    across = v - b * u / np.maximum(a, _DEPENDENT)
    along += np.where(left > _DEPENDENT, across**2 / np.maximum(left, _DEPENDENT), 0.0)
    return np.asarray(np.sum(rest**2) - np.sum(along, axis=0))


def misfits_without(curves: Curves, poles: ComplexArray) -> Array:
    """Compute the misfit without each of the poles in turn, with the best residues; shape (poles,).

    Without the unknowns u, of covariance C, the misfit rises by ``u^T C^-1 u``.
    """
    problem = Projection(curves, poles)
    x = np.zeros(2 * poles.size)
    factors = problem.factors(x)
    inverse = np.linalg.pinv(factors.triangle, rcond=1e-13)
    unknown = (inverse @ factors.projection)[..., 0]
    pairs = inverse[:, : 2 * poles.size].reshape(len(inverse), poles.size, 2, -1)
    covariance = pairs @ np.swapaxes(pairs, 2, 3)
    both = unknown[:, : 2 * poles.size].reshape(len(inverse), poles.size, 2)
    rise = np.einsum("oki,okij,okj->k", both, np.linalg.pinv(covariance, rcond=1e-13), both)
    return np.asarray(np.sum(problem.misfit(x) ** 2) + rise)


class _Factors(NamedTuple):
    """QR factors of the weighted basis of each response, columns scaled to unit length."""

    basis: Array  # shape (responses, 2 n, unknowns), orthonormal columns
    triangle: Array  # shape (responses, unknowns, unknowns)
    size: Array  # shape (responses, 1, unknowns), lengths of the columns
    projection: Array  # shape (responses, unknowns, 1), of the target on the basis
    target: Array  # shape (responses, 2 n, 1), weighted readings


class Projection:
    """Misfit of the best linear unknowns for given poles, and its derivative (variable projection [1]_).

    References
    ----------
    .. [1] L. Kaufman, A variable projection method for solving separable nonlinear least squares problems,
       BIT 15 (1975) 49-57.
    """

    def __init__(self, curves: Curves, start: ComplexArray) -> None:
        self.s = 2j * np.pi * curves.frequency
        self.value, self.weight, self.start = curves.value, curves.weight, start
        self.above = curves.above
        self.scale = -start.real
        self._factorized: tuple[Array, _Factors] | None = None
        self._reduced: tuple[Array, Array] | None = None

    def poles(self, x: Array) -> ComplexArray:
        """Convert parameters to poles: logarithm of the decay rate (for stability), frequency in decay rates."""
        count = self.start.size
        return np.asarray(
            -self.scale * np.exp(np.clip(x[:count], -30.0, 30.0))
            + 1j * (self.start.imag + self.scale * x[count:])
        )

    def columns(self, poles: ComplexArray) -> ComplexArray:
        """Return the basis for real unknowns: Re R, Im R of each mode, then lower and upper residuals."""
        out = []
        for p in poles:
            direct, mirror = 1.0 / (self.s - p), 1.0 / (self.s - p.conjugate())
            out += [direct + mirror, 1j * (direct - mirror)]
        return np.stack([*out, *residual_terms(self.s)[: 1 + self.above]], axis=1)

    def factors(self, x: Array) -> _Factors:
        """Factorize the weighted basis of every response; the last result is stored."""
        if self._factorized is None or not np.array_equal(self._factorized[0], x):
            basis = _stacked(self.columns(self.poles(x)) * self.weight[:, :, None], 1)
            target = _stacked(self.value * self.weight, 1)[..., None]
            size = np.linalg.norm(basis, axis=1, keepdims=True)
            q, r = np.linalg.qr(basis / size)
            self._factorized = x.copy(), _Factors(q, r, size, np.swapaxes(q, 1, 2) @ target, target)
        return self._factorized[1]

    def unknowns(self, x: Array) -> Array:
        """Return the best linear unknowns, shape (responses, unknowns)."""
        factors = self.factors(x)
        diagonal = abs(np.einsum("oii->oi", factors.triangle))
        if diagonal.min() > 1e-10 * diagonal.max():
            found = np.linalg.solve(factors.triangle, factors.projection)
        else:
            # Coinciding poles leave their residues undetermined: take the smallest ones.
            found = np.linalg.pinv(factors.triangle, rcond=1e-13) @ factors.projection
        return np.asarray((found / np.swapaxes(factors.size, 1, 2))[..., 0])

    def misfit(self, x: Array) -> Array:
        """Return the weighted residuals of all responses in sequence."""
        factors = self.factors(x)
        return np.asarray((factors.target - factors.basis @ factors.projection).ravel())

    def reduced(self, x: Array) -> Array:
        """Return the triangular factor of Jacobian and residuals side by side, which has all that a step needs.

        Its last column has the norm of the residuals, and both give the same products as the rows of all lines.
        """
        if self._reduced is None or not np.array_equal(self._reduced[0], x):
            slopes = self.slopes(x)
            rows = np.concatenate([slopes, self.misfit(x).reshape(*slopes.shape[:2], 1)], axis=2)
            triangles = np.asarray(np.linalg.qr(rows, mode="r"))
            whole = np.asarray(np.linalg.qr(triangles.reshape(-1, rows.shape[2]), mode="r"))
            self._reduced = x.copy(), whole
        return self._reduced[1]

    def slopes(self, x: Array) -> Array:
        """Differentiate the residuals by the parameters, shape (responses, 2 n, parameters)."""
        unknown, q = self.unknowns(x), self.factors(x).basis
        count = self.start.size
        poles = self.poles(x)[:, None]
        residue = (unknown[:, 0 : 2 * count : 2] + 1j * unknown[:, 1 : 2 * count : 2])[..., None]
        direct = residue / (self.s - poles) ** 2
        mirror = residue.conj() / (self.s - poles.conj()) ** 2
        change = np.concatenate(
            [poles.real * (direct + mirror), 1j * self.scale[:, None] * (direct - mirror)], axis=1
        )
        block = _stacked(np.swapaxes(change * self.weight[:, None], 1, 2), 1)
        return np.asarray(q @ (np.swapaxes(q, 1, 2) @ block) - block)


def _stacked(rows: ComplexArray, axis: int) -> Array:
    return np.concatenate([rows.real, rows.imag], axis=axis)
