"""Response of a channel to a velocity jump of its body, and the matched filters that detect the jump.

A damper's impact causes a *jump* of the body's velocity, and a *step* and a *slope change* of its
acceleration. The responses of a channel follow from its data sheet. The responses are computed at *sub-sample
instants*, because an impact occurs between samples.

Matched filters for a known signal in white noise: S. M. Kay, *Fundamentals of Statistical Signal Processing II:
Detection Theory*, 1998, ch. 4. Step, slope change and a polynomial for the smooth motion are nuisance signals; the
filters are orthogonal to them.
"""

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from analysis.core.damper_motion.landing_pulse import Pulse
from daq.core.signal_chain.channel import ChannelInfo, Quantity
from rig.core.base.arrays import Array
from rig.core.results.response import MOTIONS

# A jump is at most this distance from the middle of its window [samples].
MAX_SHIFT = 4
# Polynomial orders of the smooth acceleration around a jump.
ORDERS = (2, 4, 6, 8)
# Minimum number of samples on either side of a jump: they must outnumber the coefficients of the smooth motion.
_SIDE_SAMPLES = 6
# Shortest duration of the samples on either side of a jump in velocity and displacement channels, whose noise is large
# in derivatives.
_SIDE_TIME_S = 1e-3
# Largest phase change [rad] of a resonance between two sub-sample instants; the interpolation is then accurate.
_MAX_PHASE_STEP = 0.5
# Minimum number of sub-sample instants in a sample interval, for channels without a fast resonance.
_MIN_INSTANTS_PER_SAMPLE = 8
# A fit has this number of sub-sample instants for each instant of the search, if the sensor has a resonance.
_RESONANCE_STRIDE = 8
# A fit has this number of sub-sample instants for each instant of the search, with a decimation filter.
_FILTER_STRIDE = 4
# Poles above this angular frequency [rad per sample] affect the response to a jump. Slower poles cause only a slow
# curvature after the jump, which the polynomial represents.
_FAST_POLE = 0.3
# Decay times after which the response of a resonance has decayed to 1e-6: exp(-14).
_DECAY_TIMES = 14.0
# The window includes this number of decay times of a resonance.
_WINDOW_DECAY_TIMES = 3.0
# Length of a decimation filter's impulse response on either side.
_FILTER_SPAN_SAMPLES = 40
# The window includes this part of the impulse response of a decimation filter [samples].
_FILTER_WINDOW_SAMPLES = 12
# Number of rows whose filters are computed together: small enough for the cache.
_BLOCK_ROWS = 1000
# Singular values of the filters below this fraction of the largest are rounding errors.
_RANK_TOLERANCE = 1e-12


class UnitResponses(NamedTuple):
    """Differenced responses to unit jump, step and slope change at one instant."""

    begin: int
    """Index of the first difference."""
    responses: Array
    """Jump of 1 m/s, step of 1 m/s², slope change of 1 m/s³; shape (3, length)."""
    time_derivatives: Array
    """Derivatives of `responses` with respect to the instant, per sample; shape (3, length)."""


@dataclass(frozen=True, eq=False)
class ImpactModel:
    """Responses to unit velocity jump, acceleration step and slope change, and the filters that estimate them.

    `unit_differences` and windows are differences of successive readings, so the response to a jump is short. The order
    of the differences is two higher than the number of integrations in the channel. The fit itself is a least-squares
    fit of the readings, because the noise of the readings is white. `responses` and `filters` have the reverse order:
    slope change, step, jump.

    The arrays have one row for each of 2 `MAX_SHIFT` `instants_per_sample` instants. Row g is for a jump
    (g + 1/2) / `instants_per_sample` - `MAX_SHIFT` samples after sample 0 of a window.
    """

    difference_order: int
    """Order of the differences."""
    instants_per_sample: int
    """Number of sub-sample instants in a sample interval."""
    search_stride: int
    """The search uses every n-th sub-sample instant, with this n; 1: all."""
    responses: Array
    """Readings in a window after unit slope change, step and jump; shape (3, rows, window + `difference_order`)."""
    filter_order: int
    """Order of the polynomial to which the filters are orthogonal."""
    window_start: int
    """Index of the window's first difference relative to its sample 0."""
    unit_differences: Array
    """Differenced responses to unit jump, step and slope change until they have decayed; shape (rows, 3, length)."""
    unit_start: int
    """Index of the first of `unit_differences` relative to sample 0."""
    polynomial_order: int
    """Order of the polynomial for the smooth motion in the readings of a window."""
    contact_samples: int
    """Contact duration of an impact [samples]; 0: instantaneous."""

    @cached_property
    def _filters(self) -> tuple[Array, Array]:
        """`filters` and `r_factors`; computed for the models that the search chooses only."""
        rows = range(0, self.responses.shape[1], _BLOCK_ROWS)
        blocks = [self._filters_of(self.responses[:, first : first + _BLOCK_ROWS]) for first in rows]
        filters, r_factors = zip(*blocks, strict=True)
        return np.concatenate(filters), np.concatenate(r_factors)

    @property
    def filters(self) -> Array:
        """Filters for the slope change, for the step orthogonal to it, and for the jump orthogonal to both.

        Each has unit noise gain; shape (rows, 3, window).
        """
        return self._filters[0]

    @property
    def r_factors(self) -> Array:
        """Upper triangular matrices from slope change, step and jump to filter outputs; shape (rows, 3, 3)."""
        return self._filters[1]

    @cached_property
    def middle_filter(self) -> Array:
        """Filter for a jump in the middle of a window; shape (window,)."""
        row = (2 * MAX_SHIFT + 1) * self.instants_per_sample // 2
        return self._filters_of(self.responses[:, row : row + 1])[0][0, 2]

    def _filters_of(self, responses: Array) -> tuple[Array, Array]:
        count = responses.shape[-1]
        basis, r_factors = _orthogonalize(_without_polynomial(responses, self.filter_order))
        # By summation by parts, these sums of a basis and the differences give the same outputs as the basis and the
        # responses.
        sums = np.linalg.matrix_power(-np.triu(np.ones((count, count))), self.difference_order)
        return np.swapaxes(basis @ sums[:, : -self.difference_order], 0, 1), r_factors

    @cached_property
    def search_basis(self) -> tuple[Array, Array]:
        """Orthonormal basis of the search's jump filters and their weights; shapes (rank, window), (filters, rank).

        The basis is small, because the numerical rank of a few dozen filters is about ten.
        """
        first = MAX_SHIFT * self.instants_per_sample + self.search_stride // 2
        filters = self.filters[first : first + self.instants_per_sample : self.search_stride, 2]
        left, singular, basis = np.linalg.svd(filters, full_matrices=False)
        rank = int(np.sum(singular > _RANK_TOLERANCE * singular[0]))
        return np.ascontiguousarray(basis[:rank]), left[:, :rank] * singular[:rank]

    @cached_property
    def _coarse_filters(self) -> Array:
        """Filters at the instants that the search uses; shape (3 instants, window)."""
        rows = self.filters[self.search_stride // 2 :: self.search_stride]
        return np.ascontiguousarray(rows).reshape(-1, self.window_length)

    def _amplitudes(self, row: int, outputs: Array) -> Array:
        """Return jump, step and slope change from the filter outputs of a row."""
        return np.asarray(np.linalg.solve(self.r_factors[row], outputs)[::-1], dtype=np.float64)

    def responses_in_window(self, rows: NDArray[np.intp]) -> Array:
        """Return responses to unit jump, step and slope change, minus their smooth part; shape (rows, 3, window)."""
        begin = self.window_start - self.unit_start
        return self.readings(self.unit_differences[rows, :, begin : begin + self.window_length])

    @cached_property
    def window_length(self) -> int:
        """Number of differences in one window."""
        return self.responses.shape[-1] - self.difference_order

    @cached_property
    def min_separation(self) -> int:
        """Minimum distance of two jumps whose windows do not overlap [samples]."""
        return self.window_length + self.difference_order

    @cached_property
    def settling_samples(self) -> int:
        """Samples until the response to a jump has decayed."""
        return int(self.unit_differences.shape[-1])

    @cached_property
    def noise_gain(self) -> float:
        """Largest standard uncertainty of a jump at any sub-sample instant [m/s] for readings with unit noise."""
        middle = slice(MAX_SHIFT * self.instants_per_sample, (MAX_SHIFT + 1) * self.instants_per_sample)
        return float(1.0 / self._filters_of(self.responses[:, middle])[1][:, 2, 2].min())

    @cached_property
    def jump_norm(self) -> float:
        """Root sum of squares of the response to a 1 m/s jump in the middle of a window."""
        window = np.zeros(self.window_length)
        unit = self.unit_responses_at(self.difference_order - self.window_start + 0.5)
        low, begin = max(0, -unit.begin), max(unit.begin, 0)
        inside = unit.responses[0, low : low + self.window_length - begin]
        window[begin : begin + inside.size] = inside
        return float(np.linalg.norm(self.readings(window)))

    def polynomial_order_for(self, length: int) -> int:
        """Return the polynomial order for `length` differences: higher if `length` exceeds a window."""
        return self.polynomial_order + max(
            0, (self.polynomial_order - 1) * (length - self.window_length) // self.window_length
        )

    def readings(self, differences: Array, order: int | None = None) -> Array:
        """Integrate differences to readings, and subtract the best polynomial of an `order`; (..., differences)."""
        for _ in range(self.difference_order):
            differences = np.cumsum(differences, axis=-1)
        return _without_polynomial(
            differences, self.polynomial_order_for(differences.shape[-1]) if order is None else order
        )

    def locate(self, time: Array | float) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
        """Return the sample before a `time` [samples], the preceding row, and the weight of the following row."""
        sample = np.floor(time)
        position = (time - sample) * self.instants_per_sample - 0.5 + MAX_SHIFT * self.instants_per_sample
        row = np.clip(np.floor(position), 0, len(self.unit_differences) - 2)
        return sample.astype(np.intp), row.astype(np.intp), np.asarray(position - row)

    def unit_responses_at(self, time: float) -> UnitResponses:
        """Return the differenced responses to unit jump, step and slope change at a time [samples]."""
        sample, row, weight = self.locate(np.float64(time))
        left, right = self.unit_differences[row], self.unit_differences[row + 1]
        return UnitResponses(
            int(sample) + self.unit_start - self.difference_order,
            left + weight * (right - left),
            (right - left) * self.instants_per_sample,
        )

    def fit_jump(self, window: Array, noise: float) -> tuple[float, Array, float, float]:
        """Fit the jump that best explains a window of differences; `noise`: standard deviation of a reading.

        Returns `time`, time of the jump after the window's sample 0, samples; `amplitudes`, shape (3,), jump [m/s],
        step [m/s²], slope change [m/s³]; `error`, standard uncertainty of the jump [m/s]; `explained`, reduction of the
        sum of squares by jump, step and slope change, in noise variances.
        """
        stride = self.search_stride
        coarse_outputs = (self._coarse_filters @ window).reshape(-1, 3)
        coarse_row = int(np.argmax(np.einsum("ij,ij->i", coarse_outputs, coarse_outputs))) * stride + stride // 2
        # All sub-sample instants around the best instant of the coarse search.
        first_row = max(coarse_row - stride, 0)
        filters = self.filters[first_row : coarse_row + stride + 1]
        outputs = (filters.reshape(-1, self.window_length) @ window).reshape(-1, 3)
        explained = np.einsum("ij,ij->i", outputs, outputs) / noise**2
        best = int(np.argmax(explained))
        row, offset = first_row + best, 0.0
        if 0 < best < explained.size - 1:
            # Vertex of the parabola through the highest value and its neighbors.
            left, middle, right = explained[best - 1 : best + 2]
            curvature = left - 2.0 * middle + right
            offset = min(max(0.5 * (left - right) / curvature, -0.5), 0.5) if curvature < 0 else 0.0
        amplitudes = self._amplitudes(row, outputs[best])
        if offset:
            direction = 1 if offset > 0 else -1
            neighbor_amplitudes = self._amplitudes(row + direction, outputs[best + direction])
            amplitudes = (1.0 - abs(offset)) * amplitudes + abs(offset) * neighbor_amplitudes
        error = noise / self.r_factors[row, 2, 2]
        time = (row + offset + 0.5) / self.instants_per_sample - MAX_SHIFT
        return time, amplitudes, error, float(explained[best])


@lru_cache(maxsize=32)
def with_order(model: ImpactModel, order: int) -> ImpactModel:
    """Return a model with a different polynomial order in `readings`; the filters do not change."""
    return model if order == model.polynomial_order else replace(model, polynomial_order=order)


@lru_cache(maxsize=256)
def legendre_basis(length: int, degree: int) -> Array:
    """Return an orthonormal polynomial basis, shape (length, degree + 1); leading columns span the lower degrees."""
    basis = np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, length), degree)
    return np.asarray(np.linalg.qr(basis)[0], dtype=np.float64)


def _without_polynomial(rows: Array, order: int) -> Array:
    """Subtract from rows (..., length) their least-squares polynomials of an order."""
    polynomials = legendre_basis(rows.shape[-1], order)
    # A single projection leaves rounding errors, because polynomials are much larger than the response to a jump.
    for _ in range(2):
        rows = rows - (rows @ polynomials) @ polynomials.T
    return rows


def impact_models(info: ChannelInfo, pulse: Pulse | None = None, decimation: int = 1) -> tuple[ImpactModel, ...]:
    """Compute the model of a channel from its data sheet, for each polynomial order of `ORDERS`.

    `info`: acceleration, velocity or displacement channel; `pulse`: force pulse of finite-duration contact, which
    smooths jump, step and slope change in the same way (None: instantaneous); `decimation`: number of samples in each
    average.
    """
    response = info.quantity, info.rate, info.gain, *map(tuple, (info.zeros, info.poles)), info.average
    return _impact_models(response, tuple(info.filter.items()), pulse, decimation)


@lru_cache(maxsize=4)
def _impact_models(
    response: tuple[Quantity, float, float, tuple[complex, ...], tuple[complex, ...], bool],
    decimation_filter: tuple[tuple[str, float], ...],
    pulse: Pulse | None,
    decimation: int,
) -> tuple[ImpactModel, ...]:
    quantity, full_rate, gain, zeros, poles, average = response
    info = ChannelInfo(
        "", "", quantity, 1.0, full_rate, zeros=zeros, poles=poles, gain=gain, average=average,
        filter=dict(decimation_filter),
    )  # fmt: skip
    integrations, rate = 2 - MOTIONS.index(quantity), full_rate / decimation
    # A decimation filter removes resonances above half the sample rate.
    max_frequency = np.pi * full_rate if info.filter else np.inf
    fast_poles = [pole for pole in poles if _FAST_POLE * rate < abs(pole) < max_frequency]
    phase_per_sample = max((abs(pole.imag) for pole in fast_poles), default=0.0) / rate if pulse is None else 0.0
    decay_samples = max((-rate / pole.real for pole in fast_poles), default=0.0)
    contact = 0 if pulse is None else int(np.ceil(pulse.duration * rate))
    stride = _RESONANCE_STRIDE if phase_per_sample else _FILTER_STRIDE if info.filter and decimation == 1 else 1
    instants_per_sample = max(_MIN_INSTANTS_PER_SAMPLE, int(np.ceil(phase_per_sample / _MAX_PHASE_STEP))) * stride
    side = _SIDE_SAMPLES if integrations == 0 else max(_SIDE_SAMPLES, round(_SIDE_TIME_S * rate))
    filter_samples = int(np.ceil(_FILTER_WINDOW_SAMPLES / decimation)) if info.filter else 0
    # Samples of the window before and after its sample 0.
    before = MAX_SHIFT + side + filter_samples
    after = MAX_SHIFT + side + integrations + filter_samples + contact
    after += int(np.ceil(min(_WINDOW_DECAY_TIMES * decay_samples, 4 * side)))
    # Additional samples in which the response of the filter decays.
    margin = int(np.ceil(_FILTER_SPAN_SAMPLES / decimation)) if info.filter else 2
    until_decayed = after + int(np.ceil(_DECAY_TIMES * decay_samples)) + margin
    responses = _acceleration_responses(
        info, integrations, instants_per_sample, before + margin, until_decayed, pulse, decimation
    )
    # A second difference belongs to the last of its three samples: the first to sample 3 - `before` - `margin`.
    unit_differences = np.diff(responses, 2, axis=-1) / rate**integrations
    in_window = responses[..., margin : margin + before + after]
    readings = np.concatenate([np.zeros((*in_window.shape[:-1], integrations)), in_window], axis=-1)
    for _ in range(integrations):
        readings = np.cumsum(readings, axis=-1) / rate
    readings = np.ascontiguousarray(np.moveaxis(readings, 1, 0)[::-1])
    return tuple(
        ImpactModel(
            difference_order=integrations + 2,
            instants_per_sample=instants_per_sample,
            search_stride=stride,
            responses=readings,
            filter_order=order + integrations,
            window_start=3 - before,
            unit_differences=unit_differences,
            unit_start=3 - before - margin,
            polynomial_order=order + integrations,
            contact_samples=contact,
        )
        for order in ORDERS
    )


def _acceleration_responses(
    info: ChannelInfo, integrations: int, instants: int, before: int, after: int, pulse: Pulse | None, decimation: int
) -> Array:
    """Return responses to unit jump, step and slope change as accelerations, shape (instants, 3, before + after)."""
    # A row contains samples 1 - `before` to `after` for a jump at one of the sub-sample `instants`.
    from scipy import fft

    rate = info.rate / decimation
    n_samples = 2 * fft.next_fast_len(before + after + 2 * MAX_SHIFT + 2)
    frequency = fft.rfftfreq(n_samples * instants, 1.0 / (rate * instants))
    with np.errstate(divide="ignore", invalid="ignore"):
        response = replace(info, average=False).response(frequency)
    # High-pass filters have no effect in the short time around a jump, so the response at zero frequency is set to 1.
    response[0] = 1.0
    if info.filter:
        # The decimation filter blocks frequencies above the sample rate, where its response is not tabulated.
        response[frequency > info.rate] = 0.0
    if pulse is not None:
        # Velocity change within half a sub-sample interval on either side.
        edges = (np.arange(n_samples * instants + 1) - 0.5) / (rate * instants)
        response *= fft.rfft(np.diff(pulse.velocity_change_ratio(edges)))
    # A difference of successive samples is an average of the derivative over a sample interval.
    interval_averages = integrations + int(info.average)
    if not info.average:
        # The mean of interval averages is an average over a longer interval; point samples are summed explicitly.
        delays = np.exp(-2j * np.pi * np.outer(np.arange(decimation), frequency) / info.rate)
        response *= delays.mean(axis=0)
    # A jump occurs in the middle of a sub-sample interval; this phase corrects the missing delay of the running sum.
    response *= np.exp(2j * np.pi * frequency * 0.5 * (1 - interval_averages) / (rate * instants))
    jump = fft.irfft(response, n_samples * instants) * rate * instants
    for _ in range(interval_averages):
        total = np.cumsum(np.concatenate([jump[-instants:], jump]))
        jump = (total[instants:] - total[:-instants]) / instants
    jump = np.roll(jump, (before + MAX_SHIFT) * instants)
    step = (np.cumsum(jump) - 0.5 * jump) / (rate * instants)
    slope_change = (np.cumsum(step) - 0.5 * step) / (rate * instants)
    jump_time = np.arange(-MAX_SHIFT * instants, MAX_SHIFT * instants)
    sample = np.arange(1 - before, after + 1)
    indices = (before + MAX_SHIFT + sample) * instants - jump_time[:, None] - 1
    return np.stack([response[indices] for response in (jump, step, slope_change)], axis=1)


def _orthogonalize(columns: Array) -> tuple[Array, Array]:
    """Return orthonormal columns, shape (columns, rows, length), and upper triangular matrices, one for each row.

    Gram-Schmidt method with a second orthogonalization, for all rows together: numpy's QR decomposition of many small
    matrices takes six times as long.
    """
    basis, triangles = columns.copy(), np.zeros((columns.shape[1], len(columns), len(columns)))
    for k, column in enumerate(basis):
        for j in [*range(k)] * 2:
            product = np.einsum("ij,ij->i", basis[j], column)
            column -= product[:, None] * basis[j]
            triangles[:, j, k] += product
        triangles[:, k, k] = np.sqrt(np.einsum("ij,ij->i", column, column))
        column /= triangles[:, k, k, None]
    return basis, triangles
