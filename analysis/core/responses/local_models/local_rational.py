"""Local rational method: a response without leakage from the spectra of whole segments of a recording.

A *bin* is a frequency of the discrete Fourier transform; a *line* is a bin at which the response is estimated. Around
every line the response is a quotient of two polynomials of low order. The transients at the two ends of a segment,
which cause leakage, are another quotient with the same denominator. All polynomials are fitted to the neighboring bins
by least squares [1]_. No window widens the peaks, the response need not decay within the segment, and the residuals of
the fit determine the uncertainty.

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
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
import scipy
from numpy.typing import NDArray

from rig.core.base.arrays import Array, ComplexArray

Lines = NDArray[np.int64]
ValueT = TypeVar("ValueT")

# Order of the polynomials of numerator, denominator and transients; the next order gives the model error.
ORDER = 2
# Weight of the regularization towards small coefficients; also the smallest magnitude of a denominator.
_REGULARIZATION = 1e-10
# Value that replaces zero power in a denominator.
_ZERO_POWER = 1e-300
#: 95th percentile of the noise power of a line, relative to its mean: -ln 0.05, because the power has two degrees of
#: freedom (exponential distribution).
POWER_RATIO_95 = 3.0
# A line gets a second Gauss-Newton step if the first step reduces the sum of squares by more than this fraction,
_MIN_REDUCTION = 1e-3
# and if the residual exceeds this share of the output's power, because the error is proportional to the residual.
_MIN_RESIDUAL = 1e-5
# Maximum number of elements of the systems of equations that are solved at a time; their arrays fit into the cache.
_MAX_ELEMENTS = 1 << 17


@dataclass(frozen=True)
class OutputSpectra:
    """Spectra of a channel, the output of a local fit, in each segment."""

    # spectra of segments brought to equal length, without a window; complex, shape (segments, bins)
    spectra: ComplexArray
    response: ComplexArray  # response of the channel to the quantity that it measures; complex, shape (bins,)
    # spectra of the transients of its high-pass filters, ``1 / (s - pole)``; complex, shape (poles, bins)
    high_pass_transients: ComplexArray


class LocalFit(NamedTuple):
    """Result of the local fits, each at all lines."""

    value: ComplexArray  # response; NaN at lines without excitation; complex, shape (lines,)
    variance: Array  # variance of the real and of the imaginary part; shape (lines,)
    # share of the response power, without transients, that the reference explains (coherence); shape (lines,)
    coherence: Array
    degrees_of_freedom: Array  # degrees of freedom of the variance; shape (lines,)
    # variance of the real and of the imaginary part due to unit noise power in the reference; shape (lines,). The
    # residuals do not show this noise in a peak that is narrower than the fit, because the poles are fitted to it
    variance_per_reference_noise: Array
    # share of the reference power that is linearly independent of all other terms of the fit; shape (lines,). It is
    # large for noise, and small for a linear sweep, because the spectrum of a sweep resembles a transient
    independent_share: Array
    noise_power: Array  # noise power of a bin, from the residual; squared unit of the output; shape (lines,)
    # change of the value per unit change of the output at each bin of the fit; shape (lines, segments, width)
    bin_weights: ComplexArray
    residual: ComplexArray  # residual of the output; shape (lines, segments, width)
    fitted_response: ComplexArray  # fitted output per unit of the reference; shape (lines, 1, width)
    first_bin: Lines  # first bin of each fit; shape (lines,)
    # value after one Gauss-Newton step, (lines,), at which noise changes the values of both orders equally
    one_step_value: ComplexArray
    # change of the value with the next higher order of the fit, less the change due to noise [2]_: at the line, or root
    # mean square around it; shape (lines,)
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
    """Fit the response at given lines, each with `half_width` bins on either side.

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
    inputs = 1 if other_inputs is None else 1 + len(other_inputs)
    # Number of columns of the largest fit.
    columns = (ORDER + 2) * (inputs + 1) + 2 * (ORDER + 2 + len(output.high_pass_transients))
    step = max(1, _MAX_ELEMENTS // ((2 * half_width + 1) * len(reference) * columns))
    parts = []
    for start in range(0, lines.size, step):
        selected = lines[start : start + step]
        data = _LocalData.of(output, reference, end_phases, selected, half_width, other_inputs)
        parts.append(_fit(data, measured_share))
    best = LocalFit(*(np.concatenate(arrays) for arrays in zip(*(fit for fit, _, _ in parts), strict=True)))
    squared_change, change_variance = (np.concatenate(arrays) for arrays in list(zip(*parts, strict=True))[1:])
    # Lines within half the width of a fit.
    n_lines = max(1, half_width // max(1, int(np.median(np.diff(lines)))) if lines.size > 1 else 1)
    local_mean = scipy.ndimage.uniform_filter1d(squared_change - change_variance, n_lines, mode="nearest")
    # A peak of one or two lines has a model error only there; noise alone exceeds this limit at 5 % of the lines.
    at_line = squared_change - POWER_RATIO_95 * change_variance
    return best._replace(model_error=np.sqrt(np.maximum(np.maximum(local_mean, at_line), 0.0)))


class _LocalData(NamedTuple):
    """Spectra at the bins around each line, relative to their root mean square."""

    output: ComplexArray  # shape (lines, segments, width)
    inputs: tuple[ComplexArray, ...]  # readings due to the reference and to other inputs; each of the shape of `output`
    channel: ComplexArray  # response of the channel; shape (lines, 1, width)
    decays: tuple[ComplexArray, ...]  # transients of high-pass filters; each of shape (lines, 1, width)
    # phase factors of the separate transients at the beginning of the segments, or 0; shape (lines, segments, width)
    start_phases: ComplexArray
    n_separate: int  # number of segments whose transients at the beginning and at the end are separate terms
    # powers of the distance of a bin from the line, relative to half the width; shape (lines, 1, order + 1, width)
    powers: Array
    output_rms: Array  # shape (lines,)
    reference_rms: Array  # shape (lines,)
    first_bin: Lines  # shape (lines,)

    @classmethod
    def of(
        cls,
        output: OutputSpectra,
        reference: ComplexArray,
        end_phases: ComplexArray,
        lines: Lines,
        half_width: int,
        other_inputs: ComplexArray | None,
    ) -> _LocalData:
        """Select the bins around the lines; arguments as in `local_fit`."""
        width = 2 * half_width + 1
        separate = np.any(end_phases, axis=1) & ~np.all(end_phases == 1.0, axis=1)
        first_bin = np.clip(lines - half_width, 0, reference.shape[1] - width)
        bins = first_bin[:, None] + np.arange(width)
        powers = np.ones((lines.size, ORDER + 2, width))
        for k in range(1, ORDER + 2):
            powers[:, k] = powers[:, k - 1] * (bins - lines[:, None]) / half_width
        channel = output.response[bins][:, None, :]
        spectra = [reference, *(() if other_inputs is None else other_inputs)]
        inputs = [np.moveaxis(values[:, bins], 1, 0) * channel for values in spectra]
        local_output = np.moveaxis(output.spectra[:, bins], 1, 0)
        decays = [decay[bins][:, None, :] for decay in output.high_pass_transients]
        start_phases = np.moveaxis(end_phases[:, bins], 1, 0)
        return cls(
            local_output / (output_rms := np.maximum(_rms(local_output), _ZERO_POWER)),
            tuple(values / np.maximum(_rms(values), _ZERO_POWER) for values in inputs),
            channel,
            tuple(decay / _rms(decay) for decay in decays),
            np.where(separate[:, None], start_phases, 0.0) if separate.any() else start_phases[:, :0],
            int(separate.sum()),
            powers[:, None],
            output_rms[:, 0, 0],
            np.maximum(_rms(inputs[0]), _ZERO_POWER)[:, 0, 0],
            np.asarray(first_bin),
        )

    @property
    def scale(self) -> Array:
        """Return the factor of a response, NaN without excitation; shape (lines,)."""
        return self.output_rms / np.where(self.reference_rms > _ZERO_POWER, self.reference_rms, np.nan)

    def terms(self, order: int, poles: int) -> _Terms:
        """Return the columns of a fit: `order` of numerators and transients, number of `poles` of the denominator."""
        powers = self.powers[:, :, : order + 1]
        transients = np.concatenate([powers, *(decay[:, :, None] for decay in self.decays)], axis=2)
        if self.n_separate:
            # The columns are zero without a separate transient at the beginning; the regularization omits them.
            segments, width = self.output.shape[1:]
            at_end = np.broadcast_to(transients, (len(transients), segments, transients.shape[2], width))
            transients = np.concatenate([at_end, self.start_phases[:, :, None] * transients], axis=2)
        numerator = np.concatenate([values[:, :, None] * powers for values in self.inputs], axis=2)
        return _Terms(numerator, transients, powers[:, :, 1 : poles + 1])


class _Estimate(NamedTuple):
    """Polynomials of one order, at each line."""

    unknown: _Unknown
    point: _Unknown  # polynomials before the last step; the model is linearized there
    one_step: ComplexArray  # constant of the numerator after one step; shape (lines,)
    constant_variance: Array  # variance of the constant for errors of variance 1; shape (lines,)
    residual_squares: Array  # sum of squares of the residual; shape (lines,)
    order: int  # order of the numerators and transients
    poles: int  # order of the denominator
    n_free: float  # complex degrees of freedom of the residual
    criterion: Array  # Schwarz's criterion: the model with the smallest value is the best [3]_; shape (lines,)

    @property
    def noise_power(self) -> Array:
        """Return the noise power of a bin, shape (lines,)."""
        return self.residual_squares / self.n_free

    @property
    def variance(self) -> Array:
        """Return the variance of the real and of the imaginary part of the constant, shape (lines,)."""
        return 0.5 * self.noise_power * self.constant_variance


def _fit(data: _LocalData, measured_share: float) -> tuple[LocalFit, Array, Array]:
    """Fit all orders, and select one at each line; return the squared change by a higher order, and its variance."""
    polynomial, rational, higher_order = (
        _estimate(data, measured_share, order, poles)
        for order, poles in ((ORDER, 0), (ORDER, ORDER), (ORDER + 1, ORDER + 1))
    )
    prefers_polynomial = polynomial.criterion < rational.criterion
    choices = [np.flatnonzero(prefers_polynomial), np.flatnonzero(~prefers_polynomial)]
    fits = [
        _propagate(_at(data, lines), _at(estimate, lines))
        for lines, estimate in zip(choices, (polynomial, rational), strict=True)
        if lines.size
    ]
    order = np.argsort(np.concatenate(choices))
    best = LocalFit(*(np.concatenate(arrays)[order] for arrays in zip(*fits, strict=True)))
    # The higher order contains the lower, so the variance of the change is the difference of the variances.
    scale = data.scale
    squared_change = abs(higher_order.one_step * scale - best.one_step_value) ** 2
    return best, np.asarray(squared_change), 2.0 * np.maximum(higher_order.variance * scale**2 - best.variance, 0.0)


def _estimate(data: _LocalData, measured_share: float, order: int, poles: int) -> _Estimate:
    """Fit polynomials; `order`: order of numerators and transients; `poles`: order of the denominator."""
    terms = data.terms(order, poles)
    # The first fit is linear, because the equations are multiplied by the denominator. The denominator thereby weights
    # the noise, and the poles are partly fitted to the noise, which widens peaks. Gauss-Newton steps correct weights
    # and poles.
    unknown, variance = _solve(terms.multiplied_by_denominator(data.output), data.output)
    point = unknown
    if poles:
        unknown, variance, noisy = _improve(terms, point, data.output, np.arange(len(data.output)))
    one_step = unknown.numerator[:, 0]
    if poles == ORDER and noisy.size:
        is_noisy = np.isin(np.arange(len(data.output)), noisy)
        point = _Unknown(*(np.where(is_noisy, new.T, old.T).T for new, old in zip(unknown, point, strict=True)))
        unknown, variance[noisy], _ = _improve(terms, unknown, data.output, noisy)
    squares = _sum_of_squares(data.output - terms.quotient(unknown)[0])
    segments, width = data.output.shape[1:]
    # Zero padding correlates neighboring bins and reduces the degrees of freedom.
    equations = measured_share * segments * width
    n_transients = (segments + data.n_separate) * (order + 1 + len(data.decays))
    unknowns = terms.numerator.shape[2] + poles + n_transients
    n_free = max(equations - unknowns, 0.5)
    criterion = equations * np.log(np.maximum(squares, _ZERO_POWER)) + unknowns * np.log(2 * equations)
    return _Estimate(unknown, point, one_step, variance, squares, order, poles, n_free, criterion)


def _propagate(data: _LocalData, estimate: _Estimate) -> LocalFit:
    """Return an estimate with the propagation of errors, without the model error."""
    terms, powers = data.terms(estimate.order, estimate.poles), data.powers[:, :, : estimate.order + 1]
    segments, width = data.output.shape[1:]
    bin_weights = _bin_weights(terms.linearized(estimate.point)[0], segments)
    # Response at all bins of the fit: the model for a unit reference.
    unknown = estimate.unknown
    reference_only = unknown._replace(numerator=unknown.numerator[:, : estimate.order + 1])
    fitted_response = terms._replace(numerator=powers).response(reference_only) * data.channel
    constant_variance = _sum_of_squares(bin_weights)
    # With the columns of the numerator alone, the constant would have the variance of a polynomial fit. Other columns
    # that are not orthogonal to these columns increase the variance.
    polynomial_variance = np.linalg.inv(powers[:, 0] @ np.swapaxes(powers[:, 0], 1, 2))[:, 0, 0] / segments
    independent_share = np.minimum(polynomial_variance / np.maximum(constant_variance, _ZERO_POWER), 1.0)
    constant, noise_power, scale = unknown.numerator[:, 0], estimate.noise_power, data.scale
    has_excitation = data.reference_rms > _ZERO_POWER
    excitation = np.where(has_excitation, data.reference_rms, np.nan)
    # Noise contributes to the magnitude of the estimate even if the true response is zero.
    true_power = np.maximum(np.square(abs(constant)) - noise_power * constant_variance, 0.0)
    explained = true_power * independent_share * segments * width
    return LocalFit(
        value=constant * scale,
        variance=0.5 * noise_power * constant_variance * scale**2,
        coherence=explained / np.maximum(explained + estimate.residual_squares, _ZERO_POWER),
        degrees_of_freedom=np.full(len(constant), 2.0 * estimate.n_free),
        variance_per_reference_noise=_sum_of_squares(bin_weights * fitted_response) / 2.0 * (scale / excitation) ** 2,
        independent_share=independent_share,
        noise_power=noise_power * data.output_rms**2,
        bin_weights=bin_weights / np.where(has_excitation, data.reference_rms, np.inf)[:, None, None],
        residual=(data.output - terms.quotient(unknown)[0]) * data.output_rms[:, None, None],
        fitted_response=fitted_response * (data.output_rms / data.reference_rms)[:, None, None],
        first_bin=data.first_bin,
        one_step_value=estimate.one_step * scale,
        model_error=np.zeros(len(constant)),
    )


class _Unknown(NamedTuple):
    """Coefficients of the polynomials at each line."""

    numerator: ComplexArray  # shape (lines, order + 1)
    denominator: ComplexArray  # all coefficients but the constant one, which is 1; shape (lines, poles)
    transients: ComplexArray  # shape (lines, segments, terms)


class _Terms(NamedTuple):
    """Known columns of the linear system, at the bins around each line."""

    # columns of the coefficients of the numerator, which all segments share: each input times each power of the
    # distance from the line; shape (lines, segments or 1, inputs (order + 1), width)
    numerator: ComplexArray | Array
    transients: ComplexArray | Array  # columns of each segment; shape (lines, segments or 1, terms, width)
    # powers of the frequency offset, or the derivatives of the model; shape (lines, segments or 1, poles, width)
    denominator: ComplexArray | Array

    def response(self, unknown: _Unknown) -> ComplexArray:
        """Compute the quotient of the two polynomials; shape (lines, segments or 1, width)."""
        return self._numerator(unknown.numerator) / self._denominator(unknown.denominator)

    def multiplied_by_denominator(self, model: ComplexArray) -> _Terms:
        """Return the columns of equations that are multiplied by the denominator."""
        return self._replace(denominator=-model[:, :, None] * self.denominator)

    def linearized(self, unknown: _Unknown) -> tuple[_Terms, ComplexArray]:
        """Return the derivatives of the model of the output with respect to the unknowns, and this model."""
        model, denominator = self.quotient(unknown)
        divisor = denominator[:, :, None]
        divided = self._replace(numerator=self.numerator / divisor, transients=self.transients / divisor)
        return divided.multiplied_by_denominator(model / denominator), model

    def quotient(self, unknown: _Unknown) -> tuple[ComplexArray, ComplexArray]:
        """Compute the model of the output at the bins, transients included, and its denominator."""
        denominator = self._denominator(unknown.denominator)
        transients = (unknown.transients[:, :, None] @ self.transients)[:, :, 0]
        return self._numerator(unknown.numerator) / denominator + transients / denominator, denominator

    def _numerator(self, coefficients: ComplexArray) -> ComplexArray:
        return np.asarray((coefficients[:, None, None] @ self.numerator)[:, :, 0])

    def _denominator(self, coefficients: ComplexArray) -> ComplexArray:
        value = 1.0 + (coefficients[:, None, None] @ self.denominator)[:, :, 0]
        # A denominator of zero would be an undamped pole exactly on a bin.
        return np.where(abs(value) > _REGULARIZATION, value, _REGULARIZATION)


def _improve(
    terms: _Terms, unknown: _Unknown, output: ComplexArray, lines: NDArray[np.intp]
) -> tuple[_Unknown, Array, NDArray[np.intp]]:
    """Improve fits by a Gauss-Newton step; return the constant's variance, and the lines that need another step."""
    # Only lines that are improved are copied, because copies of all lines would take longer than the model.
    part, current, local_output = (
        (terms, unknown, output)
        if lines.size == len(output)
        else (_at(terms, lines), _at(unknown, lines), output[lines])
    )
    linearized, model = part.linearized(current)
    residual = local_output - model
    step, variance = _solve(linearized, residual)
    stepped = _Unknown(*(np.add(*pair) for pair in zip(current, step, strict=True)))
    before = _sum_of_squares(residual)
    after = _sum_of_squares(local_output - part.quotient(stepped)[0])
    improved = _Unknown(*(values.copy() for values in unknown))
    for values, new_values in zip(improved, stepped, strict=True):
        values[lines[after < before]] = new_values[after < before]
    min_residual = _MIN_RESIDUAL * _sum_of_squares(local_output)
    return improved, variance, lines[(after < (1.0 - _MIN_REDUCTION) * before) & (after > min_residual)]


def _solve(terms: _Terms, right: ComplexArray) -> tuple[_Unknown, Array]:
    """Solve by least squares; also return the variance of the first unknown for errors of variance 1.

    The first unknown is the constant of the numerator: the response at the line itself, where the denominator is 1.
    The transients of each segment are eliminated by a QR decomposition of its equations. The common unknowns are then
    estimated from the remaining equations of all segments. Only the triangular factors are computed, because the
    orthogonal factors take several times as long.

    If a lower order is sufficient, denominator, numerator and transients have an arbitrary common factor. A weak
    regularization towards small coefficients determines this factor without effect on the response at the line.
    `right`: right-hand sides, shape (lines, segments, width).
    """
    lines, segments, width = right.shape
    count, numerators = terms.transients.shape[2], terms.numerator.shape[2]
    unknowns = numerators + terms.denominator.shape[2]
    system = np.zeros((lines, segments, count + unknowns + 1, width + count), dtype=complex)
    equations = system[..., :width]
    equations[:, :, :count] = terms.transients
    equations[:, :, count : count + numerators] = terms.numerator
    equations[:, :, count + numerators : -1] = terms.denominator
    equations[:, :, -1] = right
    system[:, :, :count, width:] = _REGULARIZATION * np.eye(count)
    r = _triangular_factor(np.swapaxes(system, 2, 3))
    remaining = r[:, :, count:, count:].reshape(lines, -1, unknowns + 1)
    r_common = _triangular_factor(_regularize(remaining, unknowns))[:, :unknowns]
    solved = np.linalg.solve(r_common[..., :unknowns], r_common[..., unknowns:])
    right_of_transients = r[:, :, :count, -1:] - r[:, :, :count, count:-1] @ solved[:, None]
    transients = np.linalg.solve(r[:, :, :count, :count], right_of_transients)[..., 0]
    first_row = _first_row_of_inverse(r_common[..., :unknowns])
    variance = np.asarray(np.sum(abs(first_row) ** 2, axis=(1, 2)))
    coefficients = np.asarray(solved[..., 0])
    return _Unknown(coefficients[:, :numerators], coefficients[:, numerators:], np.asarray(transients)), variance


def _bin_weights(terms: _Terms, segments: int) -> ComplexArray:
    """Return the weight of each element of the right-hand sides of `_solve` in the first unknown."""
    numerator, transients, denominator = (np.swapaxes(columns, 2, 3) for columns in terms)
    lines, _, width, count = transients.shape
    common = np.concatenate(
        [np.broadcast_to(columns, (lines, segments, *columns.shape[2:])) for columns in (numerator, denominator)],
        axis=3,
    )
    q, _ = np.linalg.qr(_regularize(transients, count))
    orthogonal = -(q @ (np.conj(np.swapaxes(q, 2, 3))[..., :width] @ common))
    orthogonal[:, :, :width] += common
    unknowns = common.shape[3]
    q, r = np.linalg.qr(_regularize(orthogonal.reshape(lines, -1, unknowns), unknowns))
    weights = _first_row_of_inverse(r) @ np.conj(np.swapaxes(q, 1, 2))[:, :, : segments * (width + count)]
    return np.asarray(weights.reshape(lines, segments, width + count)[..., :width])


def _at(value: ValueT, lines: NDArray[np.intp]) -> ValueT:
    """Select lines in all arrays of a tuple; their first axis is that of the lines."""
    selected: Any = value
    if isinstance(value, np.ndarray):
        selected = value[lines]
    elif isinstance(value, tuple):
        parts = [_at(part, lines) for part in value]
        selected = type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    return cast(ValueT, selected)


def _triangular_factor(matrices: ComplexArray) -> ComplexArray:
    """Return the triangular factor of the QR decomposition of each matrix."""
    return np.asarray(np.linalg.qr(matrices, mode="r"))


def _first_row_of_inverse(matrices: ComplexArray) -> ComplexArray:
    """Return the first row of the inverse of each matrix, shape (lines, 1, columns)."""
    lines, unknowns = matrices.shape[:2]
    first_unit = np.broadcast_to(np.eye(unknowns, 1), (lines, unknowns, 1))
    return np.asarray(np.swapaxes(np.linalg.solve(np.swapaxes(matrices, 1, 2), first_unit), 1, 2))


def _regularize(system: ComplexArray | Array, unknowns: int) -> ComplexArray:
    """Add equations that weakly pull the unknowns, which are the first columns of the system, to zero."""
    weak = _REGULARIZATION * np.eye(unknowns, system.shape[-1])
    return np.concatenate([system, np.broadcast_to(weak, (*system.shape[:-2], *weak.shape))], axis=-2)


def _sum_of_squares(spectra: ComplexArray) -> Array:
    """Return the sum of squares over the bins of each line, shape (lines,)."""
    return np.asarray(np.sum(abs(spectra) ** 2, axis=(1, 2)))


def _rms(spectra: ComplexArray) -> Array:
    """Return the root mean square over the bins of each line, shape (lines, 1, 1)."""
    return np.sqrt(np.mean(abs(spectra) ** 2, axis=(1, 2), keepdims=True))
