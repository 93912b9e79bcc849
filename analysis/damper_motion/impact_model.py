"""Response of a channel to a velocity jump, and the matched filters that detect the jump.

Matched filters for a known signal in white noise: S. M. Kay, *Fundamentals of Statistical Signal Processing II:
Detection Theory*, 1998, ch. 4. A step and a kink of the acceleration and a polynomial are nuisance signals; the
filters are orthogonal to them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.arrays import Array
from rig.results.response import MOTIONS

if TYPE_CHECKING:
    from analysis.damper_motion.landing_pulse import Pulse
    from daq.signal_chain.channel import ChannelInfo, Quantity


# Maximum distance of a jump from the middle of its window, samples.
MAX_SHIFT = 4
# Polynomial orders of the smooth acceleration around a jump.
ORDERS = (2, 4, 6, 8)
# Minimum number of samples on either side of a jump that determine the smooth motion.
_SIDE_SAMPLES = 6
# Minimum duration of these samples in velocity and displacement channels.
_SIDE_TIME_S = 1e-3
# Maximum phase change of a resonance between two sub-sample times, rad.
_MAX_PHASE_STEP = 0.5
# Minimum number of sub-sample times in a sample.
_MIN_INSTANTS = 8
# The search uses every eighth sub-sample time if the sensor has a resonance.
_RESONANCE_STRIDE = 8
# The search uses every fourth sub-sample time with a decimation filter.
_FILTER_STRIDE = 4
# Poles above this angular frequency, rad per sample, affect the shape of a jump; slower poles only cause a slow
# curvature after it.
_FAST_POLE = 0.3
# Number of decay times after which the response of a resonance has decayed to 1e-6.
_DECAY_TIMES = 14.0
# Number of these decay times within the window.
_WINDOW_DECAY_TIMES = 3.0
# Length of a decimation filter's impulse response on either side.
_FILTER_SPAN_SAMPLES = 40
# Part of that impulse response within the window.
_FILTER_WINDOW_SAMPLES = 12
# Singular values of the filters below this share of the largest are rounding errors.
_RANK_TOLERANCE = 1e-12


class UnitReadings(NamedTuple):
    """Differenced readings of unit jump, step and kink at a sub-sample time."""

    begin: int
    """Index of the first difference."""
    units: Array
    """Shape (3, length)."""
    slopes: Array
    """Derivatives of `units` with respect to time, per sample; shape (3, length)."""


@dataclass(frozen=True, eq=False)
class ImpactModel:
    """Readings of unit velocity jump, acceleration step and acceleration kink, and the filters that estimate them.

    All arrays are differences of the readings, of an order two higher than the number of integrations in the channel,
    so that the response to a jump is short. The fit itself is least squares in the readings, whose noise is white.
    """

    difference: int
    """Order of the differences."""
    instants: int
    """Number of sub-sample times in a sample."""
    stride: int
    """The search uses every `stride`-th sub-sample time."""
    filters: Array
    """Filters for the kink, for the step orthogonal to the kink, and for the jump orthogonal to both, each with unit
    noise gain. Row g is for a jump (g + 1/2) / instants - MAX_SHIFT samples after the window's sample 0.
    Shape (2 MAX_SHIFT instants, 3, window)."""
    r_factors: Array
    """Upper triangular matrices from kink, step and jump to filter outputs; shape (2 MAX_SHIFT instants, 3, 3)."""
    window_start: int
    """Index of the window's first difference relative to its sample 0."""
    shapes: Array
    """Differenced readings of unit jump, step and kink; shape (2 MAX_SHIFT instants, 3, length)."""
    shape_start: int
    """Index of the first difference of `shapes` relative to sample 0."""
    order: int
    """Polynomial order of the smooth motion in the readings of a window."""
    contact_samples: int
    """Contact duration of an impact, samples; 0: instant."""

    @cached_property
    def search_basis(self) -> tuple[Array, Array]:
        """Orthonormal basis of the search's jump filters and their weights; shapes (rank, window), (filters, rank).

        The numerical rank of a few dozen filters is about ten.
        """
        first = MAX_SHIFT * self.instants + self.stride // 2
        filters = self.filters[first : first + self.instants : self.stride, 2]
        left, singular, basis = np.linalg.svd(filters, full_matrices=False)
        rank = int(np.sum(singular > _RANK_TOLERANCE * singular[0]))
        return np.ascontiguousarray(basis[:rank]), left[:, :rank] * singular[:rank]

    @cached_property
    def _coarse_filters(self) -> Array:
        rows = self.filters[self.stride // 2 :: self.stride]
        return np.ascontiguousarray(rows).reshape(-1, self.window)

    @cached_property
    def _to_sizes(self) -> Array:
        """Matrices from filter outputs to jump, step and kink; shape (2 MAX_SHIFT instants, 3, 3)."""
        return np.asarray(np.linalg.inv(self.r_factors)[:, ::-1], dtype=np.float64)

    @cached_property
    def templates(self) -> Array:
        """Readings of unit jump, step and kink without smooth motion; shape (2 MAX_SHIFT instants, 3, window)."""
        begin = self.window_start - self.shape_start
        return self.readings(self.shapes[..., begin : begin + self.window])

    @cached_property
    def window(self) -> int:
        """Number of differences in one window."""
        return int(self.filters.shape[-1])

    @cached_property
    def separation(self) -> int:
        """Minimum distance of two jumps whose windows do not overlap, samples."""
        return self.window + self.difference

    @cached_property
    def settling(self) -> int:
        """Samples until the reading of a jump has decayed."""
        return int(self.shapes.shape[-1])

    @cached_property
    def noise_gain(self) -> float:
        """Standard deviation of a jump for unit noise of the readings at the worst sub-sample time, m/s."""
        middle = slice(MAX_SHIFT * self.instants, (MAX_SHIFT + 1) * self.instants)
        return float(1.0 / abs(self.r_factors[middle, 2, 2]).min())

    @cached_property
    def template_norm(self) -> float:
        """Root sum of squares of the readings of a 1 m/s jump in the middle of a window."""
        row = np.zeros(self.window)
        unit = self.placed(self.difference - self.window_start + 0.5)
        low = max(0, -unit.begin)
        part = unit.units[0, low : low + self.window - max(unit.begin, 0)]
        row[max(unit.begin, 0) : max(unit.begin, 0) + part.size] = part
        return float(np.linalg.norm(self.readings(row)))

    def order_over(self, length: int) -> int:
        """Return the polynomial order for a number of differences: higher if they exceed a window."""
        return self.order + max(0, (self.order - 1) * (length - self.window) // self.window)

    def readings(self, differences: Array, order: int | None = None) -> Array:
        """Integrate differences to readings and remove the smooth motion; shape (..., differences).

        `order`: polynomial order; default: `order_over` for the length.
        """
        length = differences.shape[-1]
        for _ in range(self.difference):
            differences = np.cumsum(differences, axis=-1)
        smooth = legendre_basis(length, self.order_over(length) if order is None else order)
        # A single projection leaves rounding errors, because the polynomials are much larger than the readings of a
        # jump.
        for _ in range(2):
            differences = differences - (differences @ smooth) @ smooth.T
        return differences

    def locate(self, time: Array | float) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
        """Return the sample before a time, the preceding row of `shapes`, and the weight of the following row."""
        sample = np.floor(time)
        position = (time - sample) * self.instants - 0.5 + MAX_SHIFT * self.instants
        row = np.clip(np.floor(position), 0, len(self.shapes) - 2)
        return sample.astype(np.intp), row.astype(np.intp), np.asarray(position - row)

    def placed(self, time: float) -> UnitReadings:
        """Return the differenced readings of unit jump, step and kink at a time in samples."""
        sample, row, weight = self.locate(np.float64(time))
        left, right = self.shapes[row], self.shapes[row + 1]
        return UnitReadings(
            int(sample) + self.shape_start - self.difference,
            left + weight * (right - left),
            (right - left) * self.instants,
        )

    def best_instant(self, window: Array, noise: float) -> tuple[float, Array, float, float]:
        """Estimate the time of the jump that best explains a window of differences.

        Returns `instant`, time of the jump after the window's sample 0, samples; `sizes`, shape (3,), jump [m/s],
        step [m/s²], kink [m/s³]; `error`, standard deviation of the jump, m/s; `explained`, reduction of the sum of
        squares by jump, step and kink, in noise variances.
        """
        stride = self.stride
        outputs = (self._coarse_filters @ window).reshape(-1, 3)
        best_row = int(np.argmax(np.einsum("ij,ij->i", outputs, outputs))) * stride + stride // 2
        low = max(best_row - stride, 0)
        rows = self.filters[low : best_row + stride + 1]
        outputs_nearby = (rows.reshape(-1, self.window) @ window).reshape(-1, 3)
        explained = np.einsum("ij,ij->i", outputs_nearby, outputs_nearby) / noise**2
        best_row = int(np.argmax(explained))
        row, offset = low + best_row, 0.0
        if 0 < best_row < explained.size - 1:
            left, middle, right = explained[best_row - 1 : best_row + 2]
            curvature = left - 2.0 * middle + right
            offset = min(max(0.5 * (left - right) / curvature, -0.5), 0.5) if curvature < 0 else 0.0
        sizes = self._to_sizes[row] @ outputs_nearby[best_row]
        if offset:
            direction = 1 if offset > 0 else -1
            neighbor = self._to_sizes[row + direction] @ outputs_nearby[best_row + direction]
            sizes = (1.0 - abs(offset)) * sizes + abs(offset) * neighbor
        error = noise / abs(self.r_factors[row, 2, 2])
        return (row + offset + 0.5) / self.instants - MAX_SHIFT, sizes, error, float(explained[best_row])


@lru_cache(maxsize=32)
def with_order(model: ImpactModel, order: int) -> ImpactModel:
    """Return a model with another polynomial order in `readings`; the filters do not change."""
    return model if order == model.order else replace(model, order=order)


@lru_cache(maxsize=256)
def legendre_basis(length: int, degree: int) -> Array:
    """Return an orthonormal polynomial basis on `length` points; its leading columns span the lower degrees."""
    basis = np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, length), degree)
    return np.asarray(np.linalg.qr(basis)[0], dtype=np.float64)


def impact_models(info: ChannelInfo, pulse: Pulse | None = None, decimation: int = 1) -> tuple[ImpactModel, ...]:
    """Compute the response of a channel to a jump from its data sheet; one model for each of `ORDERS`.

    `info`: acceleration, velocity or displacement channel; `pulse`: force pulse of finite-duration contact, which
    smooths jump, step and kink alike. None: instant; `decimation`: number of samples that are averaged to one
    reading.
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
    from daq.signal_chain.channel import ChannelInfo

    quantity, full_rate, gain, zeros, poles, average = response
    info = ChannelInfo(
        "", "", quantity, 1.0, full_rate, zeros=zeros, poles=poles, gain=gain, average=average,
        filter=dict(decimation_filter),
    )  # fmt: skip
    integrations, rate = 2 - MOTIONS.index(quantity), full_rate / decimation
    # A decimation filter removes resonances above half the sample rate.
    fastest = np.pi * full_rate if info.filter else np.inf
    fast = [pole for pole in poles if _FAST_POLE * rate < abs(pole) < fastest]
    phase_rate = max((abs(pole.imag) for pole in fast), default=0.0) / rate if pulse is None else 0.0
    decay_samples = max((-rate / pole.real for pole in fast), default=0.0)
    contact = 0 if pulse is None else int(np.ceil(pulse.duration * rate))
    stride = _RESONANCE_STRIDE if phase_rate else _FILTER_STRIDE if info.filter and decimation == 1 else 1
    instants = max(_MIN_INSTANTS, int(np.ceil(phase_rate / _MAX_PHASE_STEP))) * stride
    side = _SIDE_SAMPLES if integrations == 0 else max(_SIDE_SAMPLES, round(_SIDE_TIME_S * rate))
    filter_samples = int(np.ceil(_FILTER_WINDOW_SAMPLES / decimation)) if info.filter else 0
    before = MAX_SHIFT + side + filter_samples
    after = MAX_SHIFT + side + integrations + filter_samples + contact
    after += int(np.ceil(min(_WINDOW_DECAY_TIMES * decay_samples, 4 * side)))
    margin = int(np.ceil(_FILTER_SPAN_SAMPLES / decimation)) if info.filter else 2
    decayed = after + int(np.ceil(_DECAY_TIMES * decay_samples)) + margin
    readings = _readings(info, integrations, instants, before + margin, decayed, pulse, decimation)
    shapes = np.diff(readings, 2, axis=-1) / rate**integrations
    inside = readings[..., margin : margin + before + after]
    filters = _filters(inside, integrations, rate)
    return tuple(
        ImpactModel(
            difference=integrations + 2,
            instants=instants,
            stride=stride,
            filters=rows,
            r_factors=r_factors,
            window_start=3 - before,
            shapes=shapes,
            shape_start=3 - before - margin,
            order=order + integrations,
            contact_samples=contact,
        )
        for order, (rows, r_factors) in zip(ORDERS, filters, strict=True)
    )


def _readings(
    info: ChannelInfo, integrations: int, instants: int, before: int, after: int, pulse: Pulse | None, decimation: int
) -> Array:
    """Compute samples 1 - before to after of unit jump, step and kink at each sub-sample time, as acceleration."""
    from scipy import fft

    rate = info.rate / decimation
    size = 2 * fft.next_fast_len(before + after + 2 * MAX_SHIFT + 2)
    frequency = fft.rfftfreq(size * instants, 1.0 / (rate * instants))
    with np.errstate(divide="ignore", invalid="ignore"):
        response = replace(info, average=False).response(frequency)
    # High-pass filters have no effect in the short time around a jump, so the response at zero frequency is set to 1.
    response[0] = 1.0
    if info.filter:
        # The filter blocks these frequencies, and its tabulated response ends there.
        response[frequency > info.rate] = 0.0
    if pulse is not None:
        # Velocity change within half a sub-sample interval on either side.
        edges = (np.arange(size * instants + 1) - 0.5) / (rate * instants)
        response *= fft.rfft(np.diff(pulse.velocity_change_ratio(edges)))
    averages = integrations + int(info.average)
    if not info.average:
        # The mean of interval averages is an average over a longer interval; point samples are summed explicitly.
        delays = np.exp(-2j * np.pi * np.outer(np.arange(decimation), frequency) / info.rate)
        response *= delays.mean(axis=0)
    # Half a sub-sample interval for each average that is not applied: the sums below cover whole intervals.
    response *= np.exp(2j * np.pi * frequency * 0.5 * (1 - averages) / (rate * instants))
    impulse_response = fft.irfft(response, size * instants) * rate * instants
    for _ in range(averages):
        total = np.cumsum(np.concatenate([impulse_response[-instants:], impulse_response]))
        impulse_response = (total[instants:] - total[:-instants]) / instants
    impulse_response = np.roll(impulse_response, (before + MAX_SHIFT) * instants)
    step = (np.cumsum(impulse_response) - 0.5 * impulse_response) / (rate * instants)
    kink = (np.cumsum(step) - 0.5 * step) / (rate * instants)
    instant = np.arange(-MAX_SHIFT * instants, MAX_SHIFT * instants)
    sample = np.arange(1 - before, after + 1)
    indices = (before + MAX_SHIFT + sample) * instants - instant[:, None] - 1
    return np.stack([part[indices] for part in (impulse_response, step, kink)], axis=1)


def _filters(readings: Array, integrations: int, rate: float) -> list[tuple[Array, Array]]:
    """Compute least-squares filters for the differenced readings and their triangular matrices for each of `ORDERS`."""
    shape = (*readings.shape[:-1], integrations)
    rows = np.concatenate([np.zeros(shape), readings], axis=-1)
    for _ in range(integrations):
        rows = np.cumsum(rows, axis=-1) / rate
    columns = np.swapaxes(rows[:, ::-1], 1, 2)
    out = []
    for order in ORDERS:
        smooth = legendre_basis(rows.shape[-1], order + integrations)
        without_smooth = columns
        # A single projection leaves rounding errors, because the polynomials are much larger than the readings of a
        # jump.
        for _ in range(2):
            without_smooth = without_smooth - smooth @ (smooth.T @ without_smooth)
        basis, r_factors = np.linalg.qr(without_smooth)
        filters = np.swapaxes(basis, 1, 2)
        for _ in range(integrations + 2):
            filters = -np.cumsum(filters, axis=-1)[..., :-1]
        out.append((np.ascontiguousarray(filters), r_factors))
    return out
