"""Local rational method: a response without leakage from the spectra of whole segments of a recording.

A *bin* is a frequency of the discrete Fourier transform; a *line* is a bin at which the response is estimated. Around
every line the response is a quotient of two polynomials of low order. The transients at the two ends of a segment,
which cause leakage, are another quotient with the same denominator. All polynomials are fitted to the neighboring bins
by least squares [1]_. No window widens the peaks, the response need not decay within the segment, and the residuals of
the fit determine the error bars.

The transfer function of sensor, amplifier and coupling is known and is not fitted. The transients of slow high-pass
filters vary too strongly near zero frequency for polynomials of low order, and are separate terms of the fit. The
denominator is omitted at lines where Schwarz's criterion prefers polynomials [3]_. The model error is estimated by
another fit with polynomials of the next higher order [2]_.

References
----------
.. [1] T. McKelvey, G. Guérin, Non-parametric frequency response estimation using a local rational model, 16th IFAC
   Symposium on System Identification, 2012.
.. [2] J. A. Hausman, Specification tests in econometrics, Econometrica 46 (1978) 1251-1271.
.. [3] G. Schwarz, Estimating the dimension of a model, Annals of Statistics 6 (1978) 461-464.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np
import scipy
from numpy.typing import NDArray

from rig.core.base.arrays import Array, ComplexArray

Lines = NDArray[np.int64]
Result = TypeVar("Result", "LocalFit", "_Unknown")

# Order of the polynomials of the numerator, the denominator and the transients. A fit of the next higher order gives
# the model error.
ORDER = 2
# Weight of the regularization towards small coefficients, and smallest magnitude of a denominator.
_REGULARIZATION = 1e-10
# Value that replaces zero power in a denominator.
_ZERO_POWER = 1e-300
#: 95th percentile of the noise power of a line, relative to its mean (two degrees of freedom).
POWER_RATIO_95 = 3.0
# A line gets a second Gauss-Newton step if the first step reduces the sum of squares by more than this fraction,
_MIN_REDUCTION = 1e-3
# and if the residual exceeds this share of the power of the output. The error after one step is proportional to it.
_MIN_RESIDUAL = 1e-5
# Maximum number of elements of the systems of equations that are solved at a time; their arrays fit into the cache.
_MAX_ELEMENTS = 1 << 16


@dataclass(frozen=True)
class OutputSpectra:
    """Spectra of a channel, the output of a local fit, in some segments."""

    # spectra of segments brought to equal length, without a window; complex, shape (segments, bins)
    spectra: ComplexArray
    response: ComplexArray  # response of the channel to the quantity that it measures; complex, shape (bins,)
    # spectra of the transients of its high-pass filters, ``1 / (s - pole)``; complex, shape (poles, bins)
    high_pass_transients: ComplexArray


class LocalFit(NamedTuple):
    """Result of the local fits, each at all lines."""

    value: ComplexArray  # response; NaN at lines without excitation; complex, shape (lines,)
    variance: Array  # variance of either quadrature component; shape (lines,)
    # share of the response power, transients excluded, that is explained by the reference; shape (lines,)
    coherence: Array
    degrees_of_freedom: Array  # degrees of freedom of the variance; shape (lines,)
    # variance of either quadrature component due to unit noise power in the reference; shape (lines,). The residuals
    # do not show this noise in a peak that is narrower than the fit, because the poles are fitted to it
    variance_per_reference_noise: Array
    # share of the reference power that is linearly independent of all other terms of the fit; shape (lines,). It is
    # large for noise, and small for a linear sweep, because its spectrum resembles a transient
    independent_share: Array
    noise_power: Array  # noise power of a bin, from the residual; squared unit of the output; shape (lines,)
    # change of the value per unit change of the output at each bin of the fit; shape (lines, segments, width)
    bin_weights: ComplexArray
    residual: ComplexArray  # residual of the output; shape (lines, segments, width)
    fitted_response: ComplexArray  # fitted output per unit of the reference; shape (lines, 1, width)
    first_bin: Lines  # first bin of each fit; shape (lines,)
    # value after one step, shape (lines,): noise changes the values of two orders alike up to there
    one_step_value: ComplexArray
    criterion: Array  # Schwarz's criterion: the model with the smallest value is the best [3]_; shape (lines,)
    # change of the value if the fit has the next higher order, at the line or as root mean square around it, less the
    # change due to noise [2]_; shape (lines,)
    model_error: Array


def local_fit(
    output: OutputSpectra,
    reference: ComplexArray,
    end_phases: ComplexArray,
    lines: Lines,
    half_width: int,
    measured_share: float = 1.0,
    other_inputs: ComplexArray | None = None,
) -> LocalFit:
    """Fit the response at some lines, each with `half_width` bins on either side.

    `reference`: true spectra of the input, shape (segments, bins). `end_phases`, shape (segments, bins), states how the
    transients of a segment are modeled. The value is the phase factor of the segment's first sample if the transients
    at its beginning and end are separate terms. The value is 1 if they are a single term, and 0 if the rig was at rest
    before the segment. `measured_share`: measured share of the samples; the other samples are zero padding, which
    correlates neighboring bins. `other_inputs`, shape (inputs, segments, bins): true spectra of other inputs, each with
    its own numerator and the common denominator.

    >>> random = np.random.default_rng(1)
    >>> bins = np.arange(200)
    >>> force = random.standard_normal((1, 200)) + 1j * random.standard_normal((1, 200))
    >>> pole = 1j * (bins - 100.0) + 2.0
    >>> output = OutputSpectra(force / pole + 5.0 / pole, np.ones(200), np.zeros((0, 200)))
    >>> fit = local_fit(output, force, np.zeros((1, 200)), np.array([100, 103]), 12)
    >>> np.allclose(fit.value, 1.0 / pole[[100, 103]])
    True
    """
    fits = []
    for order, poles in ((ORDER, 0), (ORDER, ORDER), (ORDER + 1, ORDER + 1)):
        inputs = 1 if other_inputs is None else 1 + len(other_inputs)
        unknowns = inputs * (order + 1) + poles + 2 * len(reference) * (order + 1 + len(output.high_pass_transients))
        step = max(1, _MAX_ELEMENTS // ((2 * half_width + 1) * unknowns))
        parts = [
            _fit(
                output, reference, end_phases, lines[start : start + step], half_width, measured_share, order, poles,
                other_inputs,
            )
            for start in range(0, lines.size, step)
        ]  # fmt: skip
        fits.append(LocalFit(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True))))
    polynomial, rational, higher_order = fits
    prefers_polynomial = polynomial.criterion < rational.criterion
    best = _select(prefers_polynomial, polynomial, rational)
    # The lower order is contained in the higher, so that the variance of the change is the difference of the variances.
    squared_change = abs(higher_order.one_step_value - best.one_step_value) ** 2
    change_variance = 2.0 * np.maximum(higher_order.variance - best.variance, 0.0)
    # Lines within half the width of a fit.
    n_lines = max(1, half_width // max(1, int(np.median(np.diff(lines)))) if lines.size > 1 else 1)
    local_mean = scipy.ndimage.uniform_filter1d(squared_change - change_variance, n_lines, mode="nearest")
    # A peak of one or two lines has a model error only at these lines. Noise exceeds this limit in 5 % of lines.
    at_line = squared_change - POWER_RATIO_95 * change_variance
    return best._replace(model_error=np.sqrt(np.maximum(np.maximum(local_mean, at_line), 0.0)))


def _fit(
    output: OutputSpectra,
    reference: ComplexArray,
    end_phases: ComplexArray,
    lines: Lines,
    half_width: int,
    measured_share: float,
    order: int,
    poles: int,
    other_inputs: ComplexArray | None,
) -> LocalFit:
    """Fit polynomials of one order, without the model error.

    `order`: order of numerator and transients; `poles`: order of the denominator; other arguments as in `local_fit`.
    """
    segments, width = len(reference), 2 * half_width + 1
    # Segments whose transients at the beginning and at the end are separate terms.
    separate = [s for s in range(segments) if np.any(end_phases[s]) and not np.all(end_phases[s] == 1.0)]
    first_bin = np.clip(lines - half_width, 0, reference.shape[1] - width)
    bins = first_bin[:, None] + np.arange(width)
    offset = ((bins - lines[:, None]) / half_width)[:, None, :]
    local_output, reference_input, phase = (
        np.moveaxis(spectra[:, bins], 1, 0) for spectra in (output.spectra, reference, end_phases)
    )
    channel = output.response[bins][:, None, :]
    reference_input = reference_input * channel
    output_rms, input_rms = (np.maximum(_rms(spectra), _ZERO_POWER) for spectra in (local_output, reference_input))
    local_output, reference_input = local_output / output_rms, reference_input / input_rms
    powers = np.stack([offset**k for k in range(order + 1)], axis=-1)
    columns = [powers]
    columns += [((local := decay[bins][:, None, :]) / _rms(local))[..., None] for decay in output.high_pass_transients]
    transients = np.concatenate(columns, axis=-1)
    if separate:
        # The columns are zero if a segment has no separate transient at its beginning; the regularization omits them.
        at_start = np.where(np.isin(np.arange(segments), separate)[:, None], phase, 0.0)[..., None]
        transients = np.concatenate(
            [np.broadcast_to(transients, (*local_output.shape, transients.shape[-1])), at_start * transients], axis=-1
        )
    numerator = [reference_input[..., None] * powers]
    for other in () if other_inputs is None else other_inputs:
        local_input = np.moveaxis(other[:, bins], 1, 0) * channel
        numerator.append((local_input / np.maximum(_rms(local_input), _ZERO_POWER))[..., None] * powers)
    terms = _Terms(np.concatenate(numerator, axis=-1), transients, offset[..., None] ** np.arange(1, poles + 1))
    # The first fit is linear, because the equations are multiplied by the denominator. The denominator thereby weights
    # the noise, and the poles are partly fitted to it, which widens peaks. Gauss-Newton steps correct both.
    unknown, bin_weights = _solve(terms, local_output, local_output)
    if poles:
        unknown, bin_weights, noisy = _improve(terms, unknown, bin_weights, local_output, np.arange(lines.size))
    one_step = unknown.numerator[:, 0]
    if poles == ORDER and noisy.size:
        unknown, bin_weights, _ = _improve(terms, unknown, bin_weights, local_output, noisy)
    residual = local_output - terms.quotient(unknown)[0]
    # Response at all bins of the fit: the model for a unit reference.
    reference_only = unknown._replace(numerator=unknown.numerator[:, : order + 1])
    fitted_response = terms._replace(numerator=powers).response(reference_only)
    variance_per_reference_noise = _sum_of_squares(bin_weights * fitted_response * channel) / 2.0
    # With the columns of the numerator alone, the constant would have the variance of a polynomial fit. Other columns
    # that are not independent of them increase this variance.
    polynomial_variance = np.linalg.inv(np.swapaxes(powers[:, 0], 1, 2) @ powers[:, 0])[:, 0, 0] / segments
    constant_variance, residual_squares = _sum_of_squares(bin_weights), _sum_of_squares(residual)
    independent_share = np.minimum(polynomial_variance / np.maximum(constant_variance, _ZERO_POWER), 1.0)
    excitation = np.where(input_rms > _ZERO_POWER, input_rms, np.nan)[:, 0, 0]
    scale = output_rms[:, 0, 0] / excitation
    constant = unknown.numerator[:, 0]
    # Zero padding correlates neighboring bins and reduces the degrees of freedom.
    equations = segments * width
    n_transients = (segments + len(separate)) * (order + 1 + len(output.high_pass_transients))
    unknowns = terms.numerator.shape[-1] + poles + n_transients
    n_free = max(measured_share * equations - unknowns, 0.5)
    noise_power = residual_squares / n_free
    # Noise contributes to the magnitude of the estimate even if the true response is zero.
    true_power = np.maximum(np.square(abs(constant)) - noise_power * constant_variance, 0.0)
    explained = true_power * independent_share * equations
    penalty = unknowns * np.log(2 * measured_share * equations)
    criterion = measured_share * equations * np.log(np.maximum(residual_squares, _ZERO_POWER)) + penalty
    return LocalFit(
        value=constant * scale,
        variance=0.5 * noise_power * constant_variance * scale**2,
        coherence=explained / np.maximum(explained + residual_squares, _ZERO_POWER),
        degrees_of_freedom=np.full(lines.size, 2.0 * n_free),
        variance_per_reference_noise=variance_per_reference_noise * (scale / excitation) ** 2,
        independent_share=independent_share,
        noise_power=noise_power * output_rms[:, 0, 0] ** 2,
        bin_weights=bin_weights / np.where(input_rms > _ZERO_POWER, input_rms, np.inf),
        residual=residual * output_rms,
        fitted_response=fitted_response * channel * (output_rms / input_rms),
        first_bin=np.asarray(first_bin),
        one_step_value=one_step * scale,
        criterion=criterion,
        model_error=np.zeros(lines.size),
    )


class _Unknown(NamedTuple):
    """Coefficients of the polynomials at each line."""

    numerator: ComplexArray  # shape (lines, order + 1)
    denominator: ComplexArray  # without its constant, which is 1; shape (lines, poles)
    transients: ComplexArray  # shape (lines, segments, terms)

    def at(self, lines: NDArray[np.intp]) -> _Unknown:
        """Select some lines."""
        return _Unknown(self.numerator[lines], self.denominator[lines], self.transients[lines])


class _Terms(NamedTuple):
    """Known columns of the linear system, at the bins around each line."""

    # inputs times powers of the frequency offset, for the common numerators of all segments; shape (lines, segments,
    # width, inputs (order + 1))
    numerator: ComplexArray | Array
    transients: ComplexArray | Array  # columns of each segment; shape (lines, segments or 1, width, terms)
    denominator: Array  # powers of the frequency offset; shape (lines, 1, width, poles)

    def at(self, lines: NDArray[np.intp]) -> _Terms:
        """Select some lines."""
        return _Terms(self.numerator[lines], self.transients[lines], self.denominator[lines])

    def response(self, unknown: _Unknown) -> ComplexArray:
        """Compute the quotient of the two polynomials; shape (lines, segments or 1, width)."""
        return self._numerator(unknown.numerator) / self._denominator(unknown.denominator)

    def quotient(self, unknown: _Unknown) -> tuple[ComplexArray, ComplexArray]:
        """Compute the model of the output at the bins, transients included, and its denominator."""
        denominator = self._denominator(unknown.denominator)
        transients = (self.transients @ unknown.transients[..., None])[..., 0]
        return self._numerator(unknown.numerator) / denominator + transients / denominator, denominator

    def _numerator(self, coefficients: ComplexArray) -> ComplexArray:
        return np.asarray((self.numerator @ coefficients[:, None, :, None])[..., 0])

    def _denominator(self, coefficients: ComplexArray) -> ComplexArray:
        value = 1.0 + (self.denominator @ coefficients[:, None, :, None])[..., 0]
        # A denominator of zero would be an undamped pole exactly on a bin.
        return np.where(abs(value) > _REGULARIZATION, value, _REGULARIZATION)


def _improve(
    terms: _Terms, unknown: _Unknown, bin_weights: ComplexArray, output: ComplexArray, lines: NDArray[np.intp]
) -> tuple[_Unknown, ComplexArray, NDArray[np.intp]]:
    """Improve the fits at some lines by a Gauss-Newton step; also return the lines that need another step."""
    part, current = terms.at(lines), unknown.at(lines)
    model, denominator = part.quotient(current)
    residual, divisor = output[lines] - model, denominator[..., None]
    linearized = part._replace(numerator=part.numerator / divisor, transients=part.transients / divisor)
    step, weights = _solve(linearized, model / denominator, residual)
    stepped = _Unknown(*(np.add(*pair) for pair in zip(current, step, strict=True)))
    before = _sum_of_squares(residual)
    after = _sum_of_squares(output[lines] - part.quotient(stepped)[0])
    improved = _Unknown(*(values.copy() for values in unknown))
    for values, new_values in zip(improved, stepped, strict=True):
        values[lines[after < before]] = new_values[after < before]
    improved_weights = bin_weights.copy()
    improved_weights[lines] = weights
    min_residual = _MIN_RESIDUAL * _sum_of_squares(output[lines])
    return improved, improved_weights, lines[(after < (1.0 - _MIN_REDUCTION) * before) & (after > min_residual)]


def _solve(terms: _Terms, model: ComplexArray, right: ComplexArray) -> tuple[_Unknown, ComplexArray]:
    """Solve by least squares; also return the weight of each element of `right` in the first unknown.

    The first unknown is the constant of the numerator: the response at the line itself, where the denominator is 1.
    The transients of each segment are eliminated by projection onto the orthogonal complement of their columns. The
    common unknowns are then estimated from the projected equations.

    If a lower order suffices, denominator, numerator and transients have an arbitrary common factor. A weak
    regularization towards small coefficients determines it without effect on the response at the line.
    `model`: factor of the denominator's columns; `right`: right-hand sides; both of shape (lines, segments, width).
    """
    lines, segments, width = right.shape
    count = terms.transients.shape[-1]
    q, r = np.linalg.qr(_regularize(terms.transients))
    adjoint = np.conj(np.swapaxes(q, 2, 3))
    common = np.concatenate([terms.numerator, -model[..., None] * terms.denominator], axis=-1)
    system = np.concatenate([common, right[..., None]], axis=-1)
    projection = adjoint[..., :width] @ system
    orthogonal = -(q @ projection)
    orthogonal[..., :width, :] += system
    unknowns = common.shape[-1]
    equations = orthogonal.reshape(lines, -1, unknowns + 1)
    q, r_common = np.linalg.qr(_regularize(equations[..., :unknowns]))
    adjoint = np.conj(np.swapaxes(q[:, : equations.shape[1]], 1, 2))
    solved = np.linalg.solve(r_common, adjoint @ equations[..., unknowns:])
    transients = np.linalg.solve(r, projection[..., unknowns:] - projection[..., :unknowns] @ solved[:, None])[..., 0]
    first_unit = np.broadcast_to(np.eye(unknowns, 1), (lines, unknowns, 1))
    first_row = np.swapaxes(np.linalg.solve(np.swapaxes(r_common, 1, 2), first_unit), 1, 2)
    bin_weights = (first_row @ adjoint).reshape(lines, segments, width + count)[..., :width]
    numerators = terms.numerator.shape[-1]
    return _Unknown(solved[:, :numerators, 0], solved[:, numerators:, 0], transients), bin_weights


def _select(lines: NDArray[np.bool_], first: Result, second: Result) -> Result:
    """Combine two results: the arrays of the first at the selected `lines`, of the second at all others."""
    pairs = zip(first, second, strict=True)
    return type(first)(*(np.where(lines.reshape(-1, *[1] * (pair[0].ndim - 1)), *pair) for pair in pairs))


def _regularize(system: ComplexArray | Array) -> ComplexArray:
    """Add the equations of a weak regularization towards small unknowns."""
    unknowns = system.shape[-1]
    weak = np.broadcast_to(_REGULARIZATION * np.eye(unknowns), (*system.shape[:-2], unknowns, unknowns))
    return np.concatenate([system, weak], axis=-2)


def _sum_of_squares(spectra: ComplexArray) -> Array:
    """Return the sum of squares over the bins of each line, shape (lines,)."""
    return np.asarray(np.sum(abs(spectra) ** 2, axis=(1, 2)))


def _rms(spectra: ComplexArray) -> Array:
    """Return the root mean square over the bins of each line, shape (lines, 1, 1)."""
    return np.sqrt(np.mean(abs(spectra) ** 2, axis=(1, 2), keepdims=True))
