"""Maximum-likelihood estimate of modes, with the covariance of the responses' errors.

Order selection weights each response individually. Noise of the reference is common to all responses at a line, so
the last step uses their complete covariance (generalized least squares). The errors of the readings are propagated to
the poles to first order [1]_.

References
----------
.. [1] R. Pintelon, J. Schoukens, System Identification: A Frequency Domain Approach, 2nd ed., Wiley 2012, chapter 9.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from analysis.core.modal_models.pole_residue import UPPER_TERMS, Curves, ModalModel, residual_terms
from analysis.core.responses.errors.systematic import MODEL, REFERENCE_NOISE
from rig.core.base.arrays import Array, ComplexArray
from rig.core.results.uncertainty import Covariance, standard_of_limit

# Maximum number of Gauss-Newton steps: the start is near the minimum, so the limit is reached only without convergence.
_MAX_STEPS = 12
# Maximum number of halvings of a step that increases the misfit; a step of 1/64 increases it only by rounding.
_MAX_HALVINGS = 6
# The iteration has converged if its step is at most this value, in standard deviations of the unknowns.
_MAX_FINAL_STEP = 1e-3
# Maximum number of array elements in memory for a block of lines: 16 MB of complex values.
_MAX_ELEMENTS = 1 << 20
# Maximum number of multiplications in a step, some ten seconds; larger problems are not refined.
_MAX_MULTIPLICATIONS = 5e10


@dataclass(frozen=True)
class Refinement:
    """Modes fitted with the covariance of all responses."""

    model: ModalModel  # refined model; its `misfit` and `residual` are those of the initial model
    # covariance of the logarithms of the decay rates, then of the damped natural frequencies in units of the decay
    # rates; shape (2 modes, 2 modes)
    covariance: Array
    included: tuple[str, ...]  # systematic errors of the curves that the covariance includes


def refine(curves: Curves, model: ModalModel, errors: Covariance, line_deviation: Array) -> Refinement | None:
    """Refine a model; return None if the problem is too large, or if the covariance is not finite.

    `errors`: covariance of the random errors; `line_deviation`, shape (responses, n): standard deviation of the real or
    imaginary part of other errors that differ from line to line.
    """
    problem = Likelihood(curves, errors, line_deviation)
    n_pole_parameters = 2 * model.poles.size
    multiplications = curves.value.size * curves.value.shape[0] * (n_pole_parameters + 1 + curves.upper_terms) ** 2
    if not n_pole_parameters or multiplications > _MAX_MULTIPLICATIONS:
        return None
    misfit = problem.misfit(model)
    for _ in range(_MAX_STEPS):
        normal_matrix, right = problem.equations(model)
        step = _inverse(normal_matrix) @ right
        for halving in range(_MAX_HALVINGS):
            next_model = take_step(curves, model, step * 0.5**halving)
            if (next_misfit := problem.misfit(next_model)) <= misfit:
                break
        else:
            break
        model, misfit = next_model, next_misfit
        if step @ right < _MAX_FINAL_STEP**2:
            break
    weights = problem.weights(model, _inverse(problem.equations(model)[0])[:, :n_pole_parameters])
    deviation = line_deviation.T[..., None] * weights
    scatter = errors.of_sums(weights)
    scatter += errors.shared * np.einsum("kap,kaq->pq", deviation.conj(), deviation).real
    covariance = scatter * max(1.0, misfit / curves.degrees_of_freedom(model.poles.size))
    included: tuple[str, ...] = (MODEL,)
    if errors.reference is not None:
        # Noise of the reference biases all responses by at most this ratio, perhaps differently over a peak. The shift
        # of a pole is therefore a limit with a rectangular distribution.
        bias = curves.value.T * errors.reference[:, None]
        shift = standard_of_limit(np.einsum("kap,ka->p", weights.conj(), bias).real)
        covariance, included = covariance + np.outer(shift, shift), (MODEL, REFERENCE_NOISE)
    return Refinement(model, covariance, included) if np.isfinite(covariance).all() else None


class Likelihood:
    """Misfit of all responses, weighted by the inverse covariance of each line, and its normal equations."""

    def __init__(self, curves: Curves, errors: Covariance, line_deviation: Array) -> None:
        self.curves = curves
        covariance = errors.lines / 2.0
        index = np.arange(len(line_deviation))
        covariance[:, index, index] += line_deviation.T**2
        self.information = np.linalg.inv(covariance)
        self.s = 2j * np.pi * curves.frequency
        self.terms = np.stack(residual_terms(self.s)[: 1 + curves.upper_terms], axis=1)

    def residual(self, model: ModalModel) -> ComplexArray:
        """Compute measured less model values, shape (n, responses)."""
        direct = 1.0 / (self.s[:, None] - model.poles)
        mirror = 1.0 / (self.s[:, None] - model.poles.conj())
        factors = np.column_stack([model.lower, model.upper[:, : self.curves.upper_terms]])
        predicted = direct @ model.residue.T + mirror @ model.residue.conj().T + self.terms @ factors.T
        return np.asarray(self.curves.value.T - predicted)

    def misfit(self, model: ModalModel) -> float:
        """Compute the sum of squares of the normalized residuals."""
        residual = self.residual(model)
        return float(np.einsum("ka,kab,kb->", residual.conj(), self.information, residual, optimize=True).real)

    def _derivatives(self, model: ModalModel, lines: slice) -> tuple[ComplexArray, ComplexArray]:
        """Differentiate the model at given lines.

        Returns the derivatives with respect to the parameters of the poles, shape (lines, responses, 2 modes), and with
        respect to residues and residual terms, shape (lines, unknowns). The derivatives with respect to residues and
        residual terms are equal for all responses.
        """
        s = self.s[lines, None]
        direct, mirror = 1.0 / (s - model.poles), 1.0 / (s - model.poles.conj())
        by_pole = direct[:, None] ** 2 * model.residue
        by_mirror = mirror[:, None] ** 2 * model.residue.conj()
        by_decay = model.poles.real * (by_pole + by_mirror)
        by_frequency = -1j * model.poles.real * (by_pole - by_mirror)
        by_residue = np.concatenate([direct + mirror, 1j * (direct - mirror), self.terms[lines]], axis=1)
        return np.concatenate([by_decay, by_frequency], axis=2), by_residue

    def _line_blocks(self, model: ModalModel) -> Iterator[slice]:
        """Split the lines so that the arrays of each block remain small."""
        responses = self.curves.value.shape[0]
        step = max(1, _MAX_ELEMENTS // (responses * (responses + 2 * model.poles.size)))
        return (slice(begin, begin + step) for begin in range(0, self.s.size, step))

    def equations(self, model: ModalModel) -> tuple[Array, Array]:
        """Compute normal matrix and right-hand side of a step: pole parameters, then residues and residual terms."""
        residual, responses = self.residual(model), self.curves.value.shape[0]
        poles = 2 * model.poles.size
        n_unknowns = poles + self.terms.shape[1]
        right_poles, right_residues = np.zeros(poles), np.zeros((responses, n_unknowns))
        pole_block, coupling_block = np.zeros((poles, poles)), np.zeros((poles, responses, n_unknowns))
        residue_block = np.zeros((n_unknowns, n_unknowns, responses, responses))
        for lines in self._line_blocks(model):
            by_pole, by_residue = self._derivatives(model, lines)
            information = self.information[lines]
            weighted = information @ by_pole
            flat = by_pole.reshape(-1, poles)
            pole_block += (weighted.conj().reshape(-1, poles).T @ flat).real
            coupling_block += (
                weighted.conj().transpose(2, 1, 0).reshape(-1, len(by_residue)) @ by_residue
            ).real.reshape(coupling_block.shape)
            # The information matrix is Hermitian: two real products give the real part of the product.
            pairs = (by_residue.conj()[:, :, None] * by_residue[:, None]).reshape(len(by_residue), -1).T
            flat_information = information.reshape(len(by_residue), -1)
            block = pairs.real @ flat_information.real - pairs.imag @ flat_information.imag
            residue_block += block.reshape(residue_block.shape)
            weighted_residual = (information @ residual[lines, :, None])[..., 0]
            right_poles += (flat.conj().T @ weighted_residual.ravel()).real
            right_residues += (weighted_residual.T @ by_residue.conj()).real
        n_residue_unknowns = responses * n_unknowns
        matrix = np.empty((poles + n_residue_unknowns,) * 2)
        matrix[:poles, :poles] = pole_block
        matrix[:poles, poles:] = coupling_block.reshape(poles, n_residue_unknowns)
        matrix[poles:, :poles] = matrix[:poles, poles:].T
        matrix[poles:, poles:] = residue_block.transpose(2, 0, 3, 1).reshape(n_residue_unknowns, n_residue_unknowns)
        return matrix, np.concatenate([right_poles, right_residues.ravel()])

    def weights(self, model: ModalModel, rows: Array) -> ComplexArray:
        """Compute the weights of the errors of the responses in linear combinations of the unknowns.

        `rows`: factors of the unknowns, shape (unknowns, combinations). The weights have the shape (n, responses,
        combinations).
        """
        poles, responses = 2 * model.poles.size, self.curves.value.shape[0]
        pole_rows, residue_rows = rows[:poles], rows[poles:].reshape(responses, -1, rows.shape[1])
        weights = []
        for lines in self._line_blocks(model):
            by_pole, by_residue = self._derivatives(model, lines)
            change = by_pole @ pole_rows + (by_residue @ residue_rows).transpose(1, 0, 2)
            weights.append(self.information[lines] @ change)
        return np.concatenate(weights)


def _inverse(normal_matrix: Array) -> Array:
    """Return the pseudoinverse of a normal matrix, scaled to unit diagonal, because unknowns may be dependent."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal_matrix), 1e-300))
    return np.asarray(scale[:, None] * np.linalg.pinv(normal_matrix * np.outer(scale, scale), hermitian=True) * scale)


def take_step(curves: Curves, model: ModalModel, step: Array) -> ModalModel:
    """Change poles, residues and residual terms by a step of the unknowns, in the order of `Likelihood.equations`."""
    modes, responses = model.poles.size, curves.value.shape[0]
    decay_rate = -model.poles.real
    damped = model.poles.imag + decay_rate * step[modes : 2 * modes]
    # A step changes a decay rate by at most a factor of e, because the model is linearized.
    poles = -decay_rate * np.exp(np.clip(step[:modes], -1.0, 1.0)) + 1j * damped
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
