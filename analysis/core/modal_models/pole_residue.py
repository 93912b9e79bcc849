"""Modal model with common poles and a residue for each response, fitted by weighted least squares.

A compliance is the sum of R/(s - p) + conj(R)/(s - conj(p)) over the modes, with pole p and residue R, and of *residual
terms* for the modes outside the band. Poles are nonlinear parameters; residues and residual terms are linear.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from rig.core.base.arrays import Array, ComplexArray

# Maximum number of evaluations: a fit from good initial values converges earlier, others are stopped.
MAX_EVALUATIONS = 25
# A series with this number of terms represents the modes above the band, whose contributions are smooth in the band.
UPPER_TERMS = 3
# At least this number of lines is needed for all terms of the series; fewer lines determine only the first term.
_MIN_LINES = 20
# Maximum number of elements of the weighted terms in memory at a time: 64 MB of complex values.
_MAX_ELEMENTS = 1 << 22
# The remainder of a unit column after orthogonalization is a rounding error if its squared norm is below this value.
_ROUNDING = 1e-20


@dataclass(frozen=True)
class Curves:
    """Curves to which a modal model is fitted."""

    frequency: Array  # Hz, ascending, shape (n,)
    value: ComplexArray  # compliances [m/N], shape (responses, n)
    weight: Array  # inverse standard deviations of the real and of the imaginary part, shape (responses, n)
    shared: float = 1.0  # number of neighboring lines with a common error
    resolution: float = 0.0  # noise bandwidth of each line [Hz]; 0 without leakage
    references: int = 1  # number of inputs of the responses
    has_model_error: bool = False  # whether the weights contain an assumed error of the model
    are_errors_stated: bool = True  # False: the weights are estimated from the scatter of the lines

    @property
    def n_values(self) -> int:
        """Number of measured real numbers: two for each line of each response."""
        return 2 * self.value.size

    @property
    def upper_terms(self) -> int:
        """Return the number of terms of the series for modes above the band that the lines determine."""
        return UPPER_TERMS if self.frequency.size >= _MIN_LINES else 1

    def unknowns(self, poles: int) -> int:
        """Count the real parameters of a model with `poles` poles: poles, residues, and residual terms."""
        return 2 * poles + self.value.shape[0] * (2 * poles + 1 + self.upper_terms)

    def blocks(self, terms: int) -> Iterator[tuple[slice, "Curves"]]:
        """Split the responses so that a number of weighted terms of each block remains small."""
        step = max(1, _MAX_ELEMENTS // (2 * self.frequency.size * terms))
        for first in range(0, len(self.value), step):
            rows = slice(first, first + step)
            yield rows, replace(self, value=self.value[rows], weight=self.weight[rows])

    def degrees_of_freedom(self, poles: int) -> int:
        """Count the degrees of freedom of the misfit of a model with `poles` poles."""
        return max(self.n_values - self.unknowns(poles), 1)


@dataclass(frozen=True)
class ModalModel:
    """Modal model with a given number of poles that fits curves best."""

    poles: ComplexArray  # rad/s, in ascending order of frequency; shape (modes,)
    residue: ComplexArray  # m/(N s), shape (responses, modes)
    lower: Array  # lower / s² represents modes below the band; shape (responses,)
    upper: Array  # upper[0] + upper[1] s + upper[2] s² represents modes above the band; shape (responses, 3)
    misfit: float  # sum of squares of `residual`
    residual: ComplexArray  # weighted differences, measured less model; shape (responses, n)


def fit(curves: Curves, start: ComplexArray, max_evaluations: int = MAX_EVALUATIONS) -> ModalModel:
    """Fit the poles, initially `start` in rad/s, by weighted nonlinear least squares with variable projection."""
    problem = Projection(curves, start)
    x = np.zeros(2 * start.size)
    # With as many unknowns as values, the model fits the curves exactly for any poles.
    has_residual = problem.target.shape[1] > 2 * start.size + len(problem.residual_terms[0])
    if start.size and has_residual:
        # `least_squares` takes twice the time of these small problems.
        x = scipy.optimize.leastsq(
            problem.reduced_residual, x, (), problem.reduced_jacobian, full_output=True,
            xtol=1e-9, ftol=1e-9, gtol=1e-12, maxfev=max_evaluations, factor=1.0, diag=np.ones(x.size),
        )[0]  # fmt: skip
    poles = problem.poles(x)
    unknown, residual = problem.unknowns(x), problem.residual(x)
    count, shape = start.size, curves.value.shape
    upper = np.zeros((shape[0], UPPER_TERMS))
    upper[:, : curves.upper_terms] = unknown[:, 2 * count + 1 :]
    residue = unknown[:, 0 : 2 * count : 2] + 1j * unknown[:, 1 : 2 * count : 2]
    # A step may lead to the conjugate of a pole, which with the conjugate residue is the same mode.
    is_conjugate = poles.imag < 0.0
    poles[is_conjugate], residue[:, is_conjugate] = poles[is_conjugate].conj(), residue[:, is_conjugate].conj()
    order = np.argsort(poles.imag)
    return ModalModel(
        poles[order], residue[:, order], unknown[:, 2 * count], upper, float(np.sum(residual**2)),
        residual[:, : shape[1]] + 1j * residual[:, shape[1] :],
    )  # fmt: skip


def jacobian(curves: Curves, poles: ComplexArray) -> ComplexArray:
    """Differentiate the weighted residuals of the best model with given poles, shape (2 modes, responses, n).

    The parameters are the logarithms of the decay rates, then the damped natural frequencies in units of the decay
    rates.
    """
    rows = np.moveaxis(Projection(curves, poles).jacobian(np.zeros(2 * poles.size)), 2, 0)
    count = curves.frequency.size
    return np.asarray(rows[..., :count] + 1j * rows[..., count:])


def residual_terms(s: NDArray[np.complexfloating]) -> list[NDArray[np.complexfloating]]:
    """Return the residual terms, each with a real factor in the model: the first terms of series in 1/s and in s.

    Below its natural frequency w, a mode ``R / (s² + 2 ζ w s + w²)`` changes by about ``(s/w)²``, and its damping
    rotates the phase by ``2 ζ s/w``. Fewer terms would bias the damping of a peak that is measured only on one side or
    with much noise.
    """
    return [1.0 / s**2, *(s**power for power in range(UPPER_TERMS))]


def modal_receptance(frequency: Array, poles: ComplexArray, residue: ComplexArray, terms: Array) -> ComplexArray:
    """Compute compliances of modes with residual `terms` [m/N], shape (responses, frequencies); frequencies in Hz."""
    s = 2j * np.pi * frequency
    receptance = terms @ np.stack(residual_terms(s))
    for pole, factors in zip(poles, residue.T, strict=True):
        receptance = receptance + factors[:, None] / (s - pole) + factors.conj()[:, None] / (s - pole.conjugate())
    return np.asarray(receptance, dtype=complex)


def misfits_with(curves: Curves, poles: ComplexArray, added: ComplexArray) -> Array:
    """Compute the misfit with one more pole, for each of the poles `added`, and the best residues; shape (added,).

    A pole has two columns. It lowers the misfit by the squared projection of the residual onto the components of its
    columns that are orthogonal to all other columns.
    """
    parts = [_misfits_with(part, poles, added) for _, part in curves.blocks(2 * (poles.size + added.size))]
    return np.asarray(np.sum(parts, axis=0))


def _misfits_with(curves: Curves, poles: ComplexArray, added: ComplexArray) -> Array:
    """Compute the misfits of a few responses."""
    problem = Projection(curves, poles)
    x = np.zeros(2 * poles.size)
    basis, residual = np.linalg.qr(problem.basis(x))[0], problem.residual(x)[..., None]
    columns = _weighted(curves, terms_of_modes(problem.s, added, (1,))).swapaxes(1, 2)
    size = np.linalg.norm(columns, axis=1, keepdims=True)
    columns = columns / np.where(size > 0.0, size, 1.0)
    # Columns close to the columns of other poles are orthogonalized twice, because rounding dominates the first result.
    for _ in range(2):
        columns = columns - basis @ (np.swapaxes(basis, 1, 2) @ columns)
    scores = (np.swapaxes(columns, 1, 2) @ residual)[..., 0]
    first, second = columns[..., ::2], columns[..., 1::2]
    first_power, product, second_power = (
        np.einsum("ojk,ojk->ok", *pair) for pair in ((first, first), (first, second), (second, second))
    )
    first_score, second_score = scores[:, ::2], scores[:, 1::2]
    is_new, divisor = first_power > _ROUNDING, np.maximum(first_power, _ROUNDING)
    reduction = np.where(is_new, first_score**2 / divisor, 0.0)
    # Squared norm of the component of the second column that is orthogonal to the first, and its score.
    orthogonal = second_power - np.where(is_new, product**2 / divisor, 0.0)
    score = second_score - product * first_score / divisor
    reduction += np.where(orthogonal > _ROUNDING, score**2 / np.maximum(orthogonal, _ROUNDING), 0.0)
    return np.asarray(np.sum(residual**2) - np.sum(reduction, axis=0))


def misfits_without(curves: Curves, poles: ComplexArray) -> Array:
    """Compute the misfit without each of the poles in turn, with the best other residues; shape (poles,).

    The misfit rises by ``u^T C^-1 u`` if the unknowns u, of covariance C, are omitted.
    """
    problem = Projection(curves, poles)
    x = np.zeros(2 * poles.size)
    factors = problem.factors(x)
    inverse = np.linalg.pinv(factors.triangle, rcond=1e-13)
    unknown = (inverse @ factors.projection)[..., 0]
    pairs = inverse[:, : 2 * poles.size].reshape(len(inverse), poles.size, 2, -1)
    covariance = pairs @ np.swapaxes(pairs, 2, 3)
    residues = unknown[:, : 2 * poles.size].reshape(len(inverse), poles.size, 2)
    rise = np.einsum("oki,okij,okj->k", residues, np.linalg.pinv(covariance, rcond=1e-13), residues)
    return np.asarray(np.sum(factors.residual**2) + rise)


class _Factors(NamedTuple):
    """Triangular factor of the weighted basis of each response, its derivatives and its target, in parts."""

    triangle: Array  # factor of the basis, with columns of unit length, shape (responses, unknowns, unknowns)
    size: Array  # lengths of the columns of the basis, shape (responses, unknowns, 1)
    projection: Array  # part of the target along the basis, shape (responses, unknowns, 1)
    # Parts orthogonal to the basis.
    derivatives: Array  # shape (responses, rows, 2 modes): derivatives of the columns of the modes by their poles
    residual: Array  # shape (responses, rows, 1)


class Projection:
    """Residual with the best linear parameters for given poles, and its derivative (variable projection [1]_).

    The parameters x are those of `poles`, shape (2 poles,).

    References
    ----------
    .. [1] L. Kaufman, A variable projection method for solving separable nonlinear least squares problems,
       BIT 15 (1975) 49-57.
    """

    def __init__(self, curves: Curves, start: ComplexArray) -> None:
        self.s: ComplexArray = np.asarray(2j * np.pi * curves.frequency, dtype=complex)
        self.curves, self.start = curves, start
        self.target = real_rows(curves.value * curves.weight)
        self.residual_terms = _weighted(curves, np.stack(residual_terms(self.s)[: 1 + curves.upper_terms]))
        self.scale = -start.real
        self._factorized: tuple[Array, _Factors] | None = None

    def poles(self, x: Array) -> ComplexArray:
        """Convert parameters to poles [rad/s].

        The first half are changes of the logarithms of the decay rates, which therefore remain positive. The second
        half are changes of the damped natural frequencies in units of the initial decay rates.
        """
        count = self.start.size
        # A trial step changes a decay rate by at most a factor of 1e13, so exp does not overflow.
        return np.asarray(
            -self.scale * np.exp(np.maximum(np.minimum(x[:count], 30.0), -30.0))
            + 1j * (self.start.imag + self.scale * x[count:])
        )

    def basis(self, x: Array) -> Array:
        """Return weighted factors of Re R and Im R of each mode, then of residual terms; (responses, 2 n, unknowns)."""
        return self._basis(x, slice(None), self.curves)

    def _basis(self, x: Array, rows: slice, part: Curves) -> Array:
        """Return the basis of the responses in the slice `part`."""
        terms = _weighted(part, terms_of_modes(self.s, self.poles(x), (1,)))
        return np.concatenate([terms, self.residual_terms[rows]], axis=1).swapaxes(1, 2)

    def factors(self, x: Array) -> _Factors:
        """Factorize the weighted basis of every response; the last result is stored."""
        if self._factorized is None or not np.array_equal(self._factorized[0], x):
            mode_terms, count = terms_of_modes(self.s, self.poles(x), (1, 2)), x.size
            triangles = []
            for rows, part in self.curves.blocks(len(mode_terms) + self.residual_terms.shape[1] + 1):
                columns = _weighted(part, mode_terms)
                parts = [columns[:, :count], self.residual_terms[rows], columns[:, count:], self.target[rows, None]]
                # The orthogonal factor is not computed, because it is not needed and takes half of the time.
                triangles.append(_triangular_factor(np.concatenate(parts, axis=1).swapaxes(1, 2)))
            factor = np.concatenate(triangles)
            n = count + self.residual_terms.shape[1]
            size = np.linalg.norm(factor[:, :n, :n], axis=1)
            self._factorized = (
                x.copy(),
                _Factors(
                    factor[:, :n, :n] / size[:, None],
                    size[..., None],
                    factor[:, :n, -1:],
                    factor[:, n:, n:-1],
                    factor[:, n:, -1:],
                ),
            )
        return self._factorized[1]

    def unknowns(self, x: Array) -> Array:
        """Return the least-squares residues and residual terms for the poles `x`, shape (responses, unknowns)."""
        factors = self.factors(x)
        diagonal = abs(np.einsum("oii->oi", factors.triangle))
        if diagonal.min() > 1e-10 * diagonal.max():
            unknown = np.linalg.solve(factors.triangle, factors.projection)
        else:
            # Coinciding poles leave their residues undetermined; the smallest residues are used.
            unknown = np.linalg.pinv(factors.triangle, rcond=1e-13) @ factors.projection
        return np.asarray((unknown / factors.size)[..., 0])

    def residual(self, x: Array) -> Array:
        """Return the weighted residuals, shape (responses, 2 n): real and imaginary parts of each response."""
        unknowns, residual = self.unknowns(x)[..., None], self.target.copy()
        for rows, part in self.curves.blocks(unknowns.shape[1]):
            residual[rows] -= (self._basis(x, rows, part) @ unknowns[rows])[..., 0]
        return residual

    def reduced_residual(self, x: Array) -> Array:
        """Return the residuals after a rotation that makes all but the first zero; see `reduced_jacobian`."""
        reduced = np.zeros(x.size + 1)
        reduced[0] = np.linalg.norm(self.factors(x).residual)
        return reduced

    def reduced_jacobian(self, x: Array) -> Array:
        """Return the triangular factor of residuals and Jacobian, without its first column, which is for the residuals.

        This matrix is sufficient for a Gauss-Newton step, because the scalar products of its columns equal those of the
        complete Jacobian and residuals.
        """
        factors = self.factors(x)
        rows = np.concatenate([factors.residual, -self._by_parameter(x, factors.derivatives)], axis=2)
        # With few lines, there are fewer residuals than parameters.
        triangle = np.zeros((x.size + 1, x.size + 1))
        factor = _triangular_factor(rows.reshape(-1, rows.shape[2]))
        triangle[: len(factor)] = factor
        triangle[0] *= np.copysign(1.0, triangle[0, 0])
        return triangle[:, 1:]

    def jacobian(self, x: Array) -> Array:
        """Differentiate the residuals by the parameters, shape (responses, 2 n, parameters)."""
        mode_terms = terms_of_modes(self.s, self.poles(x), (2,))
        derivatives = np.empty((*self.target.shape, x.size))
        for rows, part in self.curves.blocks(2 * x.size + self.residual_terms.shape[1]):
            q = np.linalg.qr(self._basis(x, rows, part))[0]
            change = self._by_parameter(x, _weighted(part, mode_terms).swapaxes(1, 2), rows)
            derivatives[rows] = q @ (np.swapaxes(q, 1, 2) @ change) - change
        return derivatives

    def _by_parameter(self, x: Array, terms: Array, rows: slice = slice(None)) -> Array:
        """Convert derivatives of the terms of Re R and Im R by the poles to derivatives of the model by parameters."""
        unknown = self.unknowns(x)[rows, None, : x.size]
        real, imag = unknown[..., ::2], unknown[..., 1::2]
        first, second = terms[..., ::2], terms[..., 1::2]
        by_decay = self.poles(x).real * (real * first + imag * second)
        by_frequency = self.scale * (real * second - imag * first)
        return np.concatenate([by_decay, by_frequency], axis=2)


@lru_cache(maxsize=64)
def _upper_triangle(rows: int, columns: int) -> Array:
    return np.triu(np.ones((rows, columns)))


def _triangular_factor(matrix: Array) -> Array:
    """Return the triangular factor R of Q R; `np.linalg.qr` would build the mask of its zeros at each call."""
    householder = np.linalg.qr(matrix, mode="raw")[0].swapaxes(-1, -2)
    rows, columns = matrix.shape[-2:]
    size = min(rows, columns)
    return np.asarray(householder[..., :size, :] * _upper_triangle(size, columns))


def terms_of_modes(s: ComplexArray, poles: ComplexArray, powers: Sequence[int]) -> ComplexArray:
    """Return the factors of Re R and Im R in R / (s - p)^power + conj(R) / (s - conj(p))^power.

    Shape (powers x 2 modes, n).
    """
    direct, conjugate = 1.0 / (s - poles[:, None]), 1.0 / (s - poles.conj()[:, None])
    terms = np.empty((len(powers), poles.size, 2, s.size), dtype=complex)
    for k, power in enumerate(powers):
        first, second = direct**power, conjugate**power
        terms[k, :, 0], terms[k, :, 1] = first + second, 1j * (first - second)
    return terms.reshape(-1, s.size)


def _weighted(curves: Curves, terms: ComplexArray) -> Array:
    """Return weighted terms of each response, shape (responses, terms, 2 n): real parts, then imaginary parts."""
    return real_rows(terms) * np.concatenate([curves.weight, curves.weight], axis=1)[:, None]


def real_rows(rows: ComplexArray) -> Array:
    """Return real parts, then imaginary parts of each row."""
    return np.concatenate([rows.real, rows.imag], axis=-1)
