"""Maximum-likelihood estimate of modes, with the covariance of the responses' errors.

Order selection weights each response individually. Noise of the reference is common to all responses at a line, so
the last step uses their complete covariance (generalized least squares). The errors of the readings are propagated to
the poles to first order [1]_.

References
----------
.. [1] R. Pintelon, J. Schoukens, System Identification: A Frequency Domain Approach, 2nd ed., Wiley 2012, chapter 9.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from analysis.modal.pole_residue import UPPER_TERMS, Curves, Fit, residual_terms
from analysis.responses.systematic import MODEL, REFERENCE_NOISE
from rig.arrays import Array, ComplexArray
from rig.results.uncertainty import Covariance

# Limit of Gauss-Newton steps.
_MAX_STEPS = 12
# Limit of halvings of each step.
_MAX_HALVINGS = 6
# The iteration has converged if a step is smaller than this number of standard deviations.
_MAX_FINAL_STEP = 1e-3
# Limit of the elements of arrays of lines in memory.
_MAX_ELEMENTS = 1 << 20
# The refinement is omitted if a step needs more multiplications.
_MAX_MULTIPLICATIONS = 5e10


@dataclass(frozen=True)
class Refinement:
    """Modes fitted with the covariance of all responses.

    `covariance`: covariance of the logarithms of the decay rates, then of the damped frequencies in decay rates, shape
    (2 modes, 2 modes).
    """

    model: Fit  # refined model, with `misfit`, `residual` and `jacobian` for the weights of the curves
    covariance: Array
    parts: tuple[str, ...]  # systematic parts of the curves that the covariance includes


def refine(curves: Curves, model: Fit, errors: Covariance, rough: Array) -> Refinement | None:
    """Refine a model; return None if the problem is too large, or if the iteration does not converge.

    `errors`: covariance of the random errors; `rough`, shape (responses, n): standard deviation of either quadrature of
    other errors that differ from line to line.
    """
    problem = Likelihood(curves, errors, rough)
    count = 2 * model.poles.size
    if (
        not count
        or curves.value.size * curves.value.shape[0] * (count + 1 + curves.upper_terms) ** 2 > _MAX_MULTIPLICATIONS
    ):
        return None
    misfit = problem.misfit(model)
    for _ in range(_MAX_STEPS):
        normal, right = problem.equations(model)
        step = _inverse(normal) @ right
        for halving in range(_MAX_HALVINGS):
            next_model = take_step(curves, model, step * 0.5**halving)
            if (next_misfit := problem.misfit(next_model)) <= misfit:
                break
        else:
            break
        model, misfit = next_model, next_misfit
        if step @ right < _MAX_FINAL_STEP**2:
            break
    weights = problem.weights(model, _inverse(problem.equations(model)[0])[:, :count])
    deviation = rough.T[..., None] * weights
    scatter = errors.of_sums(weights)
    scatter += errors.shared * np.einsum("kap,kaq->pq", deviation.conj(), deviation).real
    covariance = scatter * max(1.0, misfit / curves.degrees(model.poles.size))
    parts: tuple[str, ...] = (MODEL,)
    if errors.reference is not None:
        # Noise of the reference causes a bias of all responses, which may vary over a peak.
        bias = curves.value.T * errors.reference[:, None]
        shift = np.einsum("kap,ka->p", weights.conj(), bias).real / np.sqrt(3.0)
        covariance, parts = covariance + np.outer(shift, shift), (MODEL, REFERENCE_NOISE)
    return Refinement(model, covariance, parts) if np.isfinite(covariance).all() else None


class Likelihood:
    """Weighted misfit of all responses and its normal equations."""

    def __init__(self, curves: Curves, errors: Covariance, rough: Array) -> None:
        self.curves = curves
        covariance = errors.lines / 2.0
        index = np.arange(len(rough))
        covariance[:, index, index] += rough.T**2
        self.information = np.linalg.inv(covariance)
        self.s = 2j * np.pi * curves.frequency
        self.terms = np.stack(residual_terms(self.s)[: 1 + curves.upper_terms], axis=1)

    def residual(self, model: Fit) -> ComplexArray:
        """Compute measured less model values, shape (n, responses)."""
        direct = 1.0 / (self.s[:, None] - model.poles)
        mirror = 1.0 / (self.s[:, None] - model.poles.conj())
        factors = np.column_stack([model.lower, model.upper[:, : self.curves.upper_terms]])
        predicted = direct @ model.residue.T + mirror @ model.residue.conj().T + self.terms @ factors.T
        return np.asarray(self.curves.value.T - predicted)

    def misfit(self, model: Fit) -> float:
        """Compute the sum of squares in standard deviations."""
        residual = self.residual(model)
        return float(np.einsum("ka,kab,kb->", residual.conj(), self.information, residual, optimize=True).real)

    def _slopes(self, model: Fit, part: slice) -> tuple[ComplexArray, ComplexArray]:
        """Differentiate the model at some lines.

        Returns the slopes by the poles, shape (lines, responses, 2 modes), and by the residues and residual terms,
        shape (lines, unknowns of a response), which are equal for all responses.
        """
        s = self.s[part, None]
        direct, mirror = 1.0 / (s - model.poles), 1.0 / (s - model.poles.conj())
        direct_slope = direct[:, None] ** 2 * model.residue
        mirror_slope = mirror[:, None] ** 2 * model.residue.conj()
        by_pole = np.concatenate(
            [model.poles.real * (direct_slope + mirror_slope), -1j * model.poles.real * (direct_slope - mirror_slope)],
            axis=2,
        )
        return by_pole, np.concatenate([direct + mirror, 1j * (direct - mirror), self.terms[part]], axis=1)

    def _parts(self, model: Fit) -> Iterator[slice]:
        """Split the lines so that the arrays of each part remain small."""
        responses = self.curves.value.shape[0]
        step = max(1, _MAX_ELEMENTS // (responses * (responses + 2 * model.poles.size)))
        return (slice(begin, begin + step) for begin in range(0, self.s.size, step))

    def equations(self, model: Fit) -> tuple[Array, Array]:
        """Compute the normal matrix and the right-hand side of a step."""
        residual, responses = self.residual(model), self.curves.value.shape[0]
        poles = 2 * model.poles.size
        n_unknowns = poles + self.terms.shape[1]
        right_poles, right_residues = np.zeros(poles), np.zeros((responses, n_unknowns))
        pole_block, coupling_block = np.zeros((poles, poles)), np.zeros((poles, responses, n_unknowns))
        residue_block = np.zeros((n_unknowns, n_unknowns, responses, responses))
        for part in self._parts(model):
            by_pole, by_residue = self._slopes(model, part)
            information = self.information[part]
            weighted = information @ by_pole
            flat = by_pole.reshape(-1, poles)
            pole_block += (weighted.conj().reshape(-1, poles).T @ flat).real
            coupling_block += (
                weighted.conj().transpose(2, 1, 0).reshape(-1, len(by_residue)) @ by_residue
            ).real.reshape(coupling_block.shape)
            # The information is Hermitian, so the real part of the product needs two real products only.
            pairs = (by_residue.conj()[:, :, None] * by_residue[:, None]).reshape(len(by_residue), -1).T
            lines = information.reshape(len(by_residue), -1)
            residue_block += (pairs.real @ lines.real - pairs.imag @ lines.imag).reshape(residue_block.shape)
            weighted_residual = (information @ residual[part, :, None])[..., 0]
            right_poles += (flat.conj().T @ weighted_residual.ravel()).real
            right_residues += (weighted_residual.T @ by_residue.conj()).real
        size = responses * n_unknowns
        normal = np.empty((poles + size,) * 2)
        normal[:poles, :poles] = pole_block
        normal[:poles, poles:] = coupling_block.reshape(poles, size)
        normal[poles:, :poles] = normal[:poles, poles:].T
        normal[poles:, poles:] = residue_block.transpose(2, 0, 3, 1).reshape(size, size)
        return normal, np.concatenate([right_poles, right_residues.ravel()])

    def weights(self, model: Fit, rows: Array) -> ComplexArray:
        """Compute the weights of the errors in combinations of the parameters; shape (n, responses, combinations)."""
        poles, responses = 2 * model.poles.size, self.curves.value.shape[0]
        pole_rows, residue_rows = rows[:poles], rows[poles:].reshape(responses, -1, rows.shape[1])
        out = []
        for part in self._parts(model):
            by_pole, by_residue = self._slopes(model, part)
            change = by_pole @ pole_rows + (by_residue @ residue_rows).transpose(1, 0, 2)
            out.append(self.information[part] @ change)
        return np.concatenate(out)


def _inverse(normal: Array) -> Array:
    """Invert a normal matrix, scaled to unit diagonal; dependent unknowns get the smallest values."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    return np.asarray(scale[:, None] * np.linalg.pinv(normal * np.outer(scale, scale), hermitian=True) * scale)


def take_step(curves: Curves, model: Fit, step: Array) -> Fit:
    """Change poles, residues and residual terms by a step of the parameters."""
    modes, responses = model.poles.size, curves.value.shape[0]
    decay = -model.poles.real
    poles = -decay * np.exp(np.clip(step[:modes], -1.0, 1.0)) + 1j * (
        model.poles.imag + decay * step[modes : 2 * modes]
    )
    linear_step = step[2 * modes :].reshape(responses, -1)
    upper = np.zeros((responses, UPPER_TERMS))
    upper[:, : curves.upper_terms] = linear_step[:, 2 * modes + 1 :]
    return replace(
        model,
        poles=poles,
        residue=model.residue + linear_step[:, :modes] + 1j * linear_step[:, modes : 2 * modes],
        lower=model.lower + linear_step[:, 2 * modes],
        upper=model.upper + upper,
    )
