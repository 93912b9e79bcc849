"""Maximum-likelihood estimate of modes, with the covariance of the responses' errors.

Order selection weights each response individually. Noise of the reference is common to all responses at a line, so
the last step uses their complete covariance (generalized least squares). The errors of the poles are propagated from
those of the readings to first order [1]_.

References
----------
.. [1] R. Pintelon, J. Schoukens, System Identification: A Frequency Domain Approach, 2nd ed., Wiley 2012, chapter 9.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from analysis.modal.pole_residue import ABOVE, Curves, Fit, residual_terms
from analysis.responses.systematic import MODEL, REFERENCE_NOISE
from rig.results.uncertainty import Covariance

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# Limits of Gauss-Newton steps and of halvings of each step, and the final step in standard deviations.
_STEPS, _HALVINGS, _SETTLED = 12, 6, 1e-3
# Elements of the Jacobian in memory at a time, and the number of multiplications above which the refinement is
# omitted.
_AT_ONCE, _MOST = 1 << 20, 5e10


@dataclass(frozen=True)
class Refined:
    """Modes fitted with the covariance of all responses.

    Attributes
    ----------
    model : Fit
        Refined model; its `misfit`, `rest` and `slope` are those for the weights of the curves.
    covariance : ndarray, shape (2 modes, 2 modes)
        Of the logarithms of the decay rates, then the damped frequencies in decay rates.
    parts : tuple of str
        Systematic parts of the curves that the covariance includes.
    """

    model: Fit
    covariance: Array
    parts: tuple[str, ...]


def refined(curves: Curves, model: Fit, errors: Covariance, rough: Array) -> Refined | None:
    """Refine a model; None if the problem is too large, or if the iteration does not converge.

    Parameters
    ----------
    curves : Curves
        Curves at the lines of `errors`.
    model : Fit
        Initial model.
    errors : Covariance
        Covariance of the random errors.
    rough : ndarray, shape (responses, n)
        Standard deviation of either quadrature of other errors that differ from line to line.
    """
    problem = _Likelihood(curves, errors, rough)
    count = 2 * model.poles.size
    size = count + curves.value.shape[0] * (count + 1 + curves.above)
    if not count or curves.value.size * size**2 > _MOST:
        return None
    misfit = problem.misfit(model)
    for _ in range(_STEPS):
        normal, right = problem.equations(model)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
        inverse = scale[:, None] * np.linalg.pinv(normal * np.outer(scale, scale), hermitian=True) * scale
        step = inverse @ right
        for halving in range(_HALVINGS):
            tried = _moved(curves, model, step * 0.5**halving)
            if (there := problem.misfit(tried)) <= misfit:
                break
        else:
            break
        model, misfit = tried, there
        if step @ right < _SETTLED**2:
            break
    normal, _ = problem.equations(model)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    inverse = scale[:, None] * np.linalg.pinv(normal * np.outer(scale, scale), hermitian=True) * scale
    weights = problem.weights(model, inverse[:, :count])
    deviation = rough.T[..., None] * weights
    scatter = errors.of_sums(weights)
    scatter += errors.shared * np.einsum("kap,kaq->pq", deviation.conj(), deviation).real
    covariance = scatter * max(1.0, misfit / curves.degrees(model.poles.size))
    parts: tuple[str, ...] = (MODEL,)
    if errors.reference is not None:
        # Bias of all responses by noise of the reference, which may vary over a peak.
        lower = curves.value.T * errors.reference[:, None]
        moved = np.einsum("kap,ka->p", weights.conj(), lower).real / np.sqrt(3.0)
        covariance, parts = covariance + np.outer(moved, moved), (MODEL, REFERENCE_NOISE)
    return Refined(model, covariance, parts) if np.isfinite(covariance).all() else None


class _Likelihood:
    """Weighted misfit of all responses and its normal equations."""

    def __init__(self, curves: Curves, errors: Covariance, rough: Array) -> None:
        self.curves = curves
        half = errors.lines / 2.0
        index = np.arange(len(rough))
        half[:, index, index] += rough.T**2
        self.information = np.linalg.inv(half)
        self.s = 2j * np.pi * curves.frequency
        self.terms = np.stack(residual_terms(self.s)[: 1 + curves.above], axis=1)

    def rest(self, model: Fit) -> ComplexArray:
        """Compute measured less model values, shape (n, responses)."""
        direct = 1.0 / (self.s[:, None] - model.poles)
        mirror = 1.0 / (self.s[:, None] - model.poles.conj())
        known = np.column_stack([model.lower, model.upper[:, : self.curves.above]])
        predicted = direct @ model.residue.T + mirror @ model.residue.conj().T + self.terms @ known.T
        return np.asarray(self.curves.value.T - predicted)

    def misfit(self, model: Fit) -> float:
        """Compute the sum of squares in standard deviations."""
        rest = self.rest(model)
        return float(np.einsum("ka,kab,kb->", rest.conj(), self.information, rest, optimize=True).real)

    def _slopes(self, model: Fit) -> Iterator[tuple[slice, ComplexArray]]:
        """Differentiate the model, some lines at a time: lines, shape (lines, responses, parameters)."""
        modes, responses = model.poles.size, self.curves.value.shape[0]
        each = 2 * modes + 1 + self.curves.above
        size = 2 * modes + responses * each
        step = max(1, _AT_ONCE // (responses * size))
        for begin in range(0, self.s.size, step):
            part = slice(begin, begin + step)
            s = self.s[part, None]
            direct, mirror = 1.0 / (s - model.poles), 1.0 / (s - model.poles.conj())
            slopes = np.zeros((s.size, responses, size), dtype=complex)
            up = direct[:, None] ** 2 * model.residue
            down = mirror[:, None] ** 2 * model.residue.conj()
            slopes[:, :, :modes] = model.poles.real * (up + down)
            slopes[:, :, modes : 2 * modes] = -1j * model.poles.real * (up - down)
            own = np.concatenate([direct + mirror, 1j * (direct - mirror), self.terms[part]], axis=1)
            for k in range(responses):
                first = 2 * modes + k * each
                slopes[:, k, first : first + each] = own
            yield part, slopes

    def equations(self, model: Fit) -> tuple[Array, Array]:
        """Compute the normal matrix and the right-hand side of a step."""
        rest, normal, right = self.rest(model), np.zeros(()), np.zeros(())
        for part, slopes in self._slopes(model):
            weighted = self.information[part] @ slopes
            flat = weighted.conj().reshape(-1, slopes.shape[2]).T
            normal = normal + (flat @ slopes.reshape(-1, slopes.shape[2])).real
            right = right + (flat @ rest[part].ravel()).real
        return normal, right

    def weights(self, model: Fit, rows: Array) -> ComplexArray:
        """Compute the weights of the errors in combinations of the parameters; shape (n, responses, combinations)."""
        return np.concatenate(
            [self.information[part] @ (slopes @ rows) for part, slopes in self._slopes(model)]
        )


def _moved(curves: Curves, model: Fit, step: Array) -> Fit:
    modes, responses = model.poles.size, curves.value.shape[0]
    decay = -model.poles.real
    poles = -decay * np.exp(np.clip(step[:modes], -1.0, 1.0)) + 1j * (
        model.poles.imag + decay * step[modes : 2 * modes]
    )
    own = step[2 * modes :].reshape(responses, -1)
    upper = np.zeros((responses, ABOVE))
    upper[:, : curves.above] = own[:, 2 * modes + 1 :]
    return replace(
        model,
        poles=poles,
        residue=model.residue + own[:, :modes] + 1j * own[:, modes : 2 * modes],
        lower=model.lower + own[:, 2 * modes],
        upper=model.upper + upper,
    )
