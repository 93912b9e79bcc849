"""Effect of dampers on resonance peaks: height and frequency without and with dampers, with 95 % intervals.

The *bare* structure is the structure without dampers. Its modes define a frequency band for each peak. The interval of
a height is asymmetric where the points may miss the top of the peak; an end of the interval may be unbounded.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from math import floor, hypot, inf, isfinite, isinf, log10, sqrt
from typing import Literal

import numpy as np

from analysis.core.modal.modes import Modes
from rig.core.base.renamed import renamed
from rig.core.results import (
    format_decimals,
    format_frequency,
    format_interval,
    format_number,
    format_quantity,
    round_to_uncertainty,
)
from rig.core.results.resonances import MIN_LINES, Resonance, find_resonances
from rig.core.results.response import Response
from rig.core.results.uncertainty import CLOCK, COVERAGE_FACTOR, SENSITIVITY, SYSTEMATIC, expand

# A band extends this fraction below the natural frequency of the bare structure, and half as much above it.
_BAND_BELOW_RATIO = 0.15
# Largest relative deviation of a point from the prediction of its neighbors without a jump, even at a resonance.
_MAX_LEAVE_ONE_OUT_ERROR = 0.2
# Number of frequencies of the interpolated curve between the neighbors of the highest point, so its maximum needs no
# refinement.
_GRID_POINTS = 801
# Number of drawn frequencies of the interpolated curve: enough for a smooth line.
_DRAWN_POINTS = 41
# Tolerances at different frequencies are equal if their relative difference is at most this value (rounding).
_SAME_TOLERANCE = 1e-6
# Relative error of a displacement per relative error of the clock: the square of the frequency divides accelerations.
_CLOCK_ERRORS_IN_HEIGHT = 2.0
# The height of a peak is stated if its relative expanded uncertainty is at most this value.
_MAX_PEAK_UNCERTAINTY = 0.5
# Smallest ratio of lower to upper part of an interval that is stated as ±, which would otherwise be misleading.
_MIN_SYMMETRY = 0.9
# A peak above its highest measured point by more than half-power is extrapolated: the points are on its sides.
_HALF_POWER = sqrt(2.0)
# Represents an unbounded uncertainty [m/N]: products with infinity are undefined, the largest float overflows.
_UNBOUNDED = 1e100
# Compared heights are rounded to this fraction at the finest.
_HEIGHT_RESOLUTION = 0.005
# If the relative interpolation error at a peak exceeds this value, a smaller frequency spacing is recommended.
_MAX_INTERPOLATION_ERROR = 0.01


@dataclass(frozen=True)
class Peak:
    """A resonance peak of a measured compliance."""

    value: float  # height [m/N]; a lower bound of the height if `expanded` is infinite
    # expanded uncertainty of the height (95 %) without errors that are common to all frequencies [m/N]; infinite if the
    # curve has a jump or few points, or if a point next to the highest was omitted
    own_expanded: float
    frequency: float  # Hz
    lowest_frequency: float  # lower end of the 95 % interval of the frequency [Hz]
    highest_frequency: float  # upper end of the 95 % interval of the frequency [Hz]
    lower_limit: float = 0.0  # lower end of the 95 % interval of the highest measured point [m/N]
    interpolation_expanded: float = 0.0  # part of `own_expanded` due to interpolation between the points [m/N]
    step: float = 0.0  # largest frequency step next to the highest point [Hz]; 0 if there is no interpolation
    at_end: bool = False  # whether the highest point is at an end of the band, on the side of another peak
    # tolerances of the sensors, relative to the height; they are common to all frequencies and included in `expanded`
    tolerances: tuple[float, ...] = ()
    clock: float = (
        0.0  # largest relative error of the sample clock, included in `expanded` and in the limits of frequency
    )
    highest_point: float = inf  # magnitude of the highest measured point [m/N]; infinite if there is no interpolation
    # `Response.loading` of the interpolated peak, if it exceeds 1 and a point next to it does not: the peak is then
    # undetermined
    loading: float = 0.0

    bound = renamed("bound", "expanded")
    interpolation_bound = renamed("interpolation_bound", "interpolation_expanded")

    @property
    def is_extrapolated(self) -> bool:
        """Whether the peak exceeds its highest measured point by more than 3 dB (half-power)."""
        return self.value > _HALF_POWER * self.highest_point

    def label(self, frequency: float, least_digits: int = 0) -> str:
        """Write the frequency [Hz] of the peak or of its highest point with the digits of the interval of the peak."""
        expanded = max(self.highest_frequency - frequency, frequency - self.lowest_frequency)
        if least_digits:
            expanded = min(expanded, 10.0 ** (floor(log10(frequency)) + 1 - least_digits))
        return format_frequency(frequency, expanded)

    @property
    def expanded(self) -> float:
        """Expanded uncertainty of the height (95 %) with all errors [m/N]."""
        return self._expanded(self.own_expanded)

    @property
    def low(self) -> float:
        """Lower end of the 95 % interval of the height [m/N]."""
        if self.at_end:
            return 0.0
        return self.value if isinf(self.own_expanded) else self.value - self._expanded(self.value - self._own_low)

    @property
    def is_determined(self) -> bool:
        """Whether the height is known well enough to be stated, apart from errors common to all frequencies."""
        return self.own_expanded <= _MAX_PEAK_UNCERTAINTY * self.value

    @property
    def _own_low(self) -> float:
        """Lower end of the 95 % interval of the height without errors that are common to all frequencies [m/N]."""
        return max(self.value - self.own_expanded, self.lower_limit)

    def _expanded(self, own_expanded: float) -> float:
        """Add the errors common to all frequencies (sensors, clock) to an expanded uncertainty of the height."""
        limits = (*self.tolerances, _CLOCK_ERRORS_IN_HEIGHT * self.clock)
        return float(expand(own_expanded / COVERAGE_FACTOR, [self.value * limit for limit in limits]))

    @property
    def decibel_range(self) -> tuple[float, float]:
        """Distances of the ends of the 95 % interval from the height, in dB, without errors of sensors and clock."""
        if isinf(self.own_expanded):
            return inf if self.at_end else 0.0, inf
        low, high = self._own_low, self.value + self.own_expanded
        return (
            inf if low <= 0.0 else max(20.0 * log10(self.value / low), 0.0),
            max(20.0 * log10(high / self.value), 0.0),
        )

    def height_text(self, factor: float, unit: str = "") -> str:
        """Write the height times a factor with its interval, or only the lower end if the upper end is infinite.

        With a unit, the text is part of a sentence; without a unit, it is the cell of a table.

        >>> Peak(1e-3, 2e-3, 10.0, 9.9, 10.1).height_text(1e6)
        'not determined'
        >>> Peak(211e-6, 34e-6, 33.6, 33.3, 33.9, lower_limit=209e-6).height_text(1e6)
        '211 (209 to 245)'
        >>> Peak(5e-3, 2e-5, 13.0, 12.9, 13.1, highest_point=1e-3).height_text(1e6, "µm/N")
        '(5000 ± 20) µm/N, extrapolated'
        """
        ending = f" {unit}" * bool(unit)
        if isinf(self.expanded):
            return f"{'at least' if unit else '≥'} {factor * self.low:.4g}{ending}"
        if self.expanded > self.value:
            return "not determined"
        low, value, high = (factor * each for each in (self.low, self.value, self.value + self.expanded))
        if value - low < _MIN_SYMMETRY * (high - value):
            # The measured points are a lower limit of the peak.
            value_text, low_text, high_text = (round_to_uncertainty(each, high - value) for each in (value, low, high))
            text = f"{value_text} ({low_text} to {high_text}){ending}"
        else:
            text = format_quantity(value, high - value, unit) if unit else format_interval(value, high - value)
        return text + ", extrapolated" * self.is_extrapolated


def peak(frf: Response, band_low: float, band_high: float) -> Peak | None:
    """Estimate the peak of a compliance between two frequencies.

    Around a resonance the inverse 1/H of the compliance is nearly quadratic in frequency (k - m w^2 + i c w for one
    mode). Therefore 1/H is interpolated through the three points around the highest point, and through five points as a
    check. The errors of these points are propagated to height and frequency of the maximum to first order, the random
    errors with their covariance over frequency (GUM, section 5.2.2). They are combined (root sum of squares) with twice
    the difference of the two interpolations and the leave-one-out error of the points, because widely spaced points may
    miss the top of a peak with dampers. In a test on computed curves with dampers, with one to nine points in the
    half-power width, the interval contained the true peak in 98 % of cases. The interval of the frequency is
    limited to frequencies at which the curve is within the uncertainty of its peak, and includes all points that may be
    the highest. A tolerance of the sensors that is common to all frequencies changes the height only.

    `frf`: FRF with respect to force; `band_low`, `band_high`: limits of the band [Hz]. Returns None for fewer than
    three points in the band.
    """
    with_tolerances = _distinct_points(frf)
    valid = np.isfinite(with_tolerances.value) & (abs(with_tolerances.value) > 0)
    valid &= (with_tolerances.frequency >= band_low) & (with_tolerances.frequency <= band_high)
    with_tolerances = with_tolerances.at(valid)
    tolerances, clock = _common_tolerances(with_tolerances), with_tolerances.uncertainty.clock
    in_band = with_tolerances.without(*([SENSITIVITY] if tolerances else []), *([CLOCK] if clock else []))
    f, inverse_frf, magnitude = in_band.frequency, 1.0 / in_band.value, abs(in_band.value)
    if f.size < 3:
        return None
    random_bound = np.nan_to_num(in_band.random_bound(), posinf=_UNBOUNDED)
    point_bound = np.nan_to_num(in_band.bound(), posinf=_UNBOUNDED)
    highest = _highest_local_maximum(magnitude, random_bound)
    five_points = np.arange(max(highest - 2, 0), min(highest + 3, f.size))
    if highest in (0, f.size - 1):
        return Peak(
            float(magnitude[highest]), inf, float(f[highest]), float(f[0]), float(f[-1]), at_end=True,
            tolerances=tolerances, clock=clock,
        )  # fmt: skip
    three_points = slice(highest - 1, highest + 2)
    others = five_points[five_points != highest]
    predicted = _interpolate(f[others], inverse_frf[others], f[[highest]])
    has_jump = (
        five_points.size > 3 and abs(abs(1.0 / predicted[0]) / magnitude[highest] - 1.0) > _MAX_LEAVE_ONE_OUT_ERROR
    )
    if has_jump or f.size < 4 or is_next_to_omitted(in_band, f[highest]):
        return Peak(
            float(magnitude[highest]), inf, float(f[highest]), float(f[highest - 1]), float(f[highest + 1]),
            tolerances=tolerances, clock=clock,
        )  # fmt: skip
    grid = np.linspace(f[highest - 1], f[highest + 1], _GRID_POINTS)
    curve = abs(1.0 / _interpolate(f[three_points], inverse_frf[three_points], grid))
    curve_of_five = abs(1.0 / _interpolate(f[five_points], inverse_frf[five_points], grid))
    peak_index = int(np.argmax(curve))
    frequency, height = float(grid[peak_index]), float(curve[peak_index])
    [loading] = in_band.loading_beyond(grid[[peak_index]], curve[[peak_index]])
    if loading:
        return Peak(
            float(magnitude[highest]), inf, float(f[highest]), float(f[highest - 1]), float(f[highest + 1]),
            tolerances=tolerances, clock=clock, loading=float(loading),
        )  # fmt: skip
    sensitivity = _peak_sensitivity(f[three_points], inverse_frf[three_points], frequency)
    measured = _propagated_bounds(in_band.at(np.arange(f.size)[three_points]), sensitivity)
    leave_one_out_error = max(_leave_one_out_error(f, inverse_frf, random_bound / magnitude**2, highest), 0.0)
    difference = abs(curve_of_five.max() - height), abs(grid[np.argmax(curve_of_five)] - frequency)
    error_scales = height, float(np.linalg.norm(sensitivity[1] * magnitude[three_points]))
    interpolation = 2.0 * (np.array(difference) + leave_one_out_error * np.array(error_scales))
    expanded = hypot(measured[0], interpolation[0])
    possible = f[height - magnitude <= np.hypot(point_bound, expanded)]
    frequency_expanded = hypot(measured[1], interpolation[1]) + 0.5 * (grid[1] - grid[0])
    on_grid = grid[(curve >= height - expanded) | (curve_of_five >= curve_of_five.max() - expanded)]
    to_first_order = np.clip(
        [frequency - frequency_expanded, frequency + frequency_expanded], on_grid.min(), on_grid.max()
    )
    limits = np.append(possible, to_first_order)
    return Peak(
        height,
        expanded,
        frequency,
        float(limits.min()) * (1.0 - clock),
        float(limits.max()) * (1.0 + clock),
        lower_limit=float(magnitude[highest] - point_bound[highest]),
        interpolation_expanded=float(interpolation[0]),
        step=float(np.diff(f[three_points]).max()),
        tolerances=tolerances,
        clock=clock,
        highest_point=float(magnitude[highest]),
    )


def _distinct_points(frf: Response) -> Response:
    """Return a compliance in order of frequency; of a frequency that was measured repeatedly, the highest point."""
    curve = frf.to("displacement")
    ascending = np.lexsort([-abs(curve.value), curve.frequency])
    return curve.at(ascending[np.unique(curve.frequency[ascending], return_index=True)[1]])


def local_model(frf: Response, found: Peak) -> tuple[np.ndarray, np.ndarray]:
    """Return the interpolated curve of a `peak` between the neighbors of its highest point, to draw it: Hz and m/N."""
    curve = _distinct_points(frf)
    curve = curve.at(np.isfinite(curve.value) & (abs(curve.value) > 0))
    f, magnitude = curve.frequency, abs(curve.value)
    above = int(np.clip(np.searchsorted(f, found.frequency), 1, f.size - 1))
    highest = int(np.clip(above - (magnitude[above - 1] > magnitude[above]), 1, f.size - 2))
    points = slice(highest - 1, highest + 2)
    grid = np.linspace(f[highest - 1], f[highest + 1], _DRAWN_POINTS)
    return grid, abs(1.0 / _interpolate(f[points], 1.0 / curve.value[points], grid))


def resonance_peak(frf: Response, band_low: float, band_high: float) -> Peak | None:
    """Estimate a peak as `peak`, with the tolerances of the sensors as a common scale of the height.

    If the effect of the tolerances depends on frequency, as with a reference of several channels, it shifts the peak in
    frequency rather than in height: it resembles an error of stiffness. The scale is then the larger of that of the
    highest point with a small uncertainty and the median over all points, because errors of several channels may cancel
    on one side of the peak.
    """
    if SYSTEMATIC in frf.limits:
        # Tolerances are usually the largest part of the systematic errors, whose sum is all that a file contains.
        frf = frf.without(SYSTEMATIC).with_limits({SENSITIVITY: frf.limits[SYSTEMATIC]})
    estimate = peak(frf, band_low, band_high)
    if estimate is None or estimate.at_end or estimate.tolerances or SENSITIVITY not in frf.limits:
        return estimate
    independent = peak(frf.without(SENSITIVITY), band_low, band_high)
    assert independent is not None
    points = frf.between(band_low, band_high)
    line = points.peak_line()
    at_point = float(points.limits[SENSITIVITY][line] / abs(points.value[line]))
    tolerance = max(at_point, float(np.nanmedian(frf.limits[SENSITIVITY] / abs(frf.value))))
    if not isfinite(tolerance):
        return estimate
    return replace(independent, tolerances=(tolerance,))


def resonance_peaks(frf: Response) -> list[tuple[Resonance, Peak]]:
    """Return every resonance of a compliance with its `resonance_peak`, or its rational interpolation if better."""
    receptance = frf.without(SENSITIVITY, SYSTEMATIC, CLOCK).to("displacement")
    resonances = sorted(find_resonances(receptance), key=lambda resonance: resonance.frequency)
    frequency = np.array([resonance.frequency for resonance in resonances])
    between = np.sqrt(frequency[1:] * frequency[:-1])
    # A band has at least three lines on either side of a resonance, even for widely spaced lines.
    lines = np.sort(frf.frequency)
    position = np.searchsorted(lines, frequency)
    near = lines[np.maximum(position - 3, 0)], lines[np.minimum(position + 2, lines.size - 1)]
    low = np.maximum(np.minimum(frequency * (1.0 - _BAND_BELOW_RATIO), near[0]), np.append(0.0, between))
    high = np.minimum(np.maximum(frequency * (1.0 + _BAND_BELOW_RATIO), near[1]), np.append(between, inf))
    found = [resonance_peak(frf, *band) for band in zip(low.tolist(), high.tolist(), strict=True)]
    peaks = zip(resonances, found, strict=True)
    return [(resonance, _better(frf, resonance, estimate)) for resonance, estimate in peaks if estimate is not None]


def may_be_higher(resonance: Resonance, found: Peak) -> bool:
    """Return whether a peak may be higher than measured: its height is undetermined, or its width not resolved."""
    return not (found.is_determined and resonance.is_resolved)


def _better(frf: Response, resonance: Resonance, estimate: Peak) -> Peak:
    """Return the interpolated resonance as a peak if its uncertainty is smaller than that of an estimate."""
    # With few lines, dampers may move at the peak although they are at rest at the lines on both sides.
    is_known = resonance.is_interpolated and resonance.lines >= MIN_LINES
    is_known &= not is_next_to_omitted(frf, float(frf.frequency[resonance.line]))
    if not is_known or estimate.loading or estimate.own_expanded <= resonance.expanded:
        return estimate
    return replace(
        estimate, value=resonance.value, own_expanded=resonance.expanded, frequency=resonance.frequency,
        interpolation_expanded=0.0, at_end=False,
    )  # fmt: skip


def _common_tolerances(frf: Response) -> tuple[float, ...]:
    """Return the relative tolerances of the sensors of output and reference; empty if they depend on frequency."""
    limit = frf.limits.get(SENSITIVITY)
    if limit is None or not limit.size:
        return ()
    relative = limit / abs(frf.value)
    if not np.isfinite(relative).all() or np.ptp(relative) > _SAME_TOLERANCE * relative.max():
        return ()
    total, reference = float(relative.max()), min(frf.uncertainty.scale, float(relative.max()))
    return (1.0 + total) / (1.0 + reference) - 1.0, reference


def _peak_sensitivity(f: np.ndarray, inverse_frf: np.ndarray, frequency: float) -> np.ndarray:
    """Return the derivatives of height and frequency of the peak with respect to the FRF at three points, (2, 3)."""
    # A change e of the FRF changes them by Re(sensitivity @ e). Re(conj(g) g') of g = 1/H is zero at the peak.
    step = 1e-3 * np.ptp(f)
    at = frequency + step * np.arange(-1.0, 2.0)
    # Weights of the three points in g and its derivatives; a quadratic function has exact central differences.
    samples = _interpolate(f, np.eye(3), at)
    weights = samples[:, 1], (samples[:, 2] - samples[:, 0]) / (2.0 * step)
    curvature = (samples[:, 2] - 2.0 * samples[:, 1] + samples[:, 0]) / step**2
    g, slope, second = weights[0] @ inverse_frf, weights[1] @ inverse_frf, curvature @ inverse_frf
    height = np.conj(g) / abs(g) ** 3 * weights[0]
    shift = (weights[0] * np.conj(slope) + np.conj(g) * weights[1]) / (abs(slope) ** 2 + (np.conj(g) * second).real)
    return np.stack([height, shift]) * inverse_frf**2


def _propagated_bounds(points: Response, sensitivity: np.ndarray) -> np.ndarray:
    """Return the expanded uncertainties of height and frequency of a peak due to its points, shape (2,)."""
    variance = np.diag(points.covariance().of_sums(np.conj(sensitivity).T[:, None]))
    random_bound = expand(
        np.sqrt(np.maximum(np.nan_to_num(variance), 0.0)), degrees_of_freedom=points.degrees_of_freedom.min()
    )
    # Equal relative errors of all points change the height, but not the frequency.
    in_height, in_frequency = abs(sensitivity) * np.nan_to_num(points.expanded_systematic(), posinf=_UNBOUNDED)
    return np.hypot(random_bound, [in_height.sum(), np.linalg.norm(in_frequency)])


def _highest_local_maximum(magnitude: np.ndarray, random_bound: np.ndarray) -> int:
    """Return the index of the highest point or, if that is at an end, of the highest significant maximum, if any."""
    # A maximum is significant if it exceeds the minima on both sides by more than the random uncertainty of both.
    highest, best_maximum = int(np.argmax(magnitude)), -1
    if 0 < highest < magnitude.size - 1:
        return highest
    for k in range(1, magnitude.size - 1):
        is_maximum = magnitude[k] >= max(magnitude[k - 1], magnitude[k + 1])
        if not is_maximum or (best_maximum >= 0 and magnitude[k] <= magnitude[best_maximum]):
            continue
        minima = [int(np.argmin(magnitude[: k + 1])), k + int(np.argmin(magnitude[k:]))]
        if all(magnitude[k] - magnitude[minimum] > random_bound[k] + random_bound[minimum] for minimum in minima):
            best_maximum = k
    return highest if best_maximum < 0 else best_maximum


def _leave_one_out_error(f: np.ndarray, inverse_frf: np.ndarray, random_bound: np.ndarray, highest: int) -> float:
    """Estimate the relative error of the peak's three points as predicted by their neighbors, beyond `random_bound`."""
    errors = [0.0]
    for k in (highest - 1, highest, highest + 1):
        others = np.array([i for i in range(max(k - 2, 0), min(k + 3, f.size)) if i != k])
        if others.size < 4 and k != highest:
            continue
        weights = _interpolate(f[others], np.eye(others.size), f[[k]])[:, 0]
        predicted = weights @ inverse_frf[others]
        bound_of_difference = abs(weights) @ random_bound[others] + random_bound[k]
        errors.append(float((abs(predicted - inverse_frf[k]) - bound_of_difference) / abs(predicted)))
    return max(errors)


def _interpolate(f: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Interpolate complex values at the frequencies f by the polynomial through all values."""
    middle, scale = f.mean(), np.ptp(f)
    powers = np.polynomial.polynomial.polyvander((f - middle) / scale, f.size - 1)
    return np.polynomial.polynomial.polyval((at - middle) / scale, np.linalg.solve(powers, values))


@dataclass(frozen=True)
class PeakChange:
    """Change of one resonance peak of one response."""

    response: str
    mode: float  # natural frequency of the mode of the bare structure [Hz]
    damping: float  # damping ratio of this mode
    baseline: Peak  # without dampers
    damped: Peak  # with dampers
    # both peaks without the sensitivity errors, which cancel in the change if the same sensors measured both
    without_sensitivity: tuple[Peak, Peak] | None = None
    name: str = ""  # of the mode: its natural frequency with the digits of its interval

    bare = renamed("bare", "baseline")

    @property
    def mode_label(self) -> str:
        """Natural frequency of the mode with the digits of its interval, if that is known."""
        return self.name or f"{format_decimals(self.mode, 2)} Hz"

    @property
    def _compared(self) -> tuple[Peak, Peak]:
        return self.without_sensitivity or (self.baseline, self.damped)

    @property
    def decibel(self) -> tuple[float, float, float]:
        """Change of the peak height in dB, and its limits (infinite: unbounded on that side)."""
        bare, damped = self._compared
        estimate = 20.0 * log10(damped.value / bare.value)
        (bare_below, bare_above), (damped_below, damped_above) = bare.decibel_range, damped.decibel_range
        limits = _decibel_limits(bare, damped)
        below, above = (
            float(expand(hypot(*bounds) / COVERAGE_FACTOR, limits))
            for bounds in ((damped_below, bare_above), (damped_above, bare_below))
        )
        return estimate, estimate - below, estimate + above

    @property
    def decibel_decimals(self) -> int:
        """Number of decimals of the change in dB: 1, or 2 if with 1 a limit would be 0 or equal to the other limit."""
        _, low, high = self.decibel
        rounded = (round(low, 1), round(high, 1))
        return 2 if 0.0 in rounded or rounded[0] == rounded[1] else 1

    @property
    def significance(self) -> Literal["yes", "no", "not bounded"]:
        """Whether the interval of the change in dB excludes zero."""
        _, low, high = self.decibel
        return "yes" if low > 0.0 or high < 0.0 else "no" if isfinite(low) and isfinite(high) else "not bounded"

    def height_texts(self, factor: float) -> tuple[str, ...]:
        """Write the heights times a factor, without and with dampers, with the digits of the larger uncertainty."""
        peaks = self.baseline, self.damped
        uncertainties = [peak.expanded for peak in peaks if peak.is_determined]
        expanded = factor * max([*uncertainties, _HEIGHT_RESOLUTION * max(peak.value for peak in peaks)])
        return tuple(
            "not determined"
            if isfinite(peak.expanded) and peak.low <= 0.0
            else f"≥ {round_to_uncertainty(factor * peak.low, expanded)}"
            if not peak.is_determined
            else f"{round_to_uncertainty(factor * peak.value, expanded)}{' (extrapolated)' * peak.is_extrapolated}"
            for peak in peaks
        )

    @property
    def shift(self) -> tuple[float, float, float]:
        """Frequency shift of the peak in Hz, and its limits."""
        bare, damped = self._compared
        estimate = damped.frequency - bare.frequency
        below = damped.frequency - damped.lowest_frequency, bare.highest_frequency - bare.frequency
        above = damped.highest_frequency - damped.frequency, bare.frequency - bare.lowest_frequency
        clock = tuple(compared.frequency * compared.clock for compared in (damped, bare))
        if isinf(bare.expanded + damped.expanded):
            # The peak may be at a limit of its range, next to a jump.
            return estimate, estimate - sum(below), estimate + sum(above)
        low, high = (
            float(expand(hypot(*np.subtract(limits, clock)) / COVERAGE_FACTOR, clock)) for limits in (below, above)
        )
        return estimate, estimate - low, estimate + high

    @property
    def shift_decimals(self) -> int:
        """Number of decimals that resolve the shift to a thousandth of the frequency or better."""
        return max(2, 3 - floor(log10(self.mode)))

    @property
    def equivalent_damping(self) -> float:
        """Viscous damping ratio with which the peak of the bare structure would be as low as that with dampers."""
        return self.damping * self.baseline.value / self.damped.value


def _decibel_limits(bare: Peak, damped: Peak) -> list[float]:
    """Return the limits of the ratio of two peaks due to the tolerances of different sensors and clocks [dB]."""
    limits = [
        limit
        for compared in (bare, damped)
        for limit in (*compared.tolerances, _CLOCK_ERRORS_IN_HEIGHT * compared.clock)
    ]
    return [20.0 * log10(1.0 + limit) for limit in limits]


def peak_changes(
    modes: Modes, bare: Sequence[Response], damped: Sequence[Response], same_sensors: Collection[str] = ()
) -> list[PeakChange]:
    """Compare each resonance peak of each response without and with dampers.

    `modes`: modes of the bare structure; `bare`, `damped`: all responses of a recording without dampers, and of a
    recording with dampers (or of two with different dampers); `same_sensors`: responses that were measured by the same
    sensors in both recordings, with the same force sensor. The changes are sorted by response, then by frequency.
    """
    frequency, low, high = peak_bands(modes)
    order = np.argsort(modes.frequency)
    damping, names = modes.damping[order], [modes.frequency_label(k) for k in order.tolist()]
    bare_by_name = by_name(bare)
    changes = []
    for name, curve in by_name(damped).items():
        if name not in bare_by_name:
            continue
        for f, text, zeta, band_low, band_high in zip(frequency, names, damping, low, high, strict=True):
            pair = bare_by_name[name], curve
            bare_peak, damped_peak = (peak(response, band_low, band_high) for response in pair)
            if bare_peak is None or damped_peak is None or bare_peak.at_end:
                continue
            may_be_missing = is_next_to_omitted(curve, damped_peak.frequency)
            if damped_peak.at_end and (may_be_missing or not covers(curve, bare_peak.frequency)):
                continue
            without_sensitivity = None
            if curve.response in same_sensors:
                bare_without, damped_without = (
                    peak(response.without(SENSITIVITY), band_low, band_high) for response in pair
                )
                assert bare_without is not None
                assert damped_without is not None
                without_sensitivity = bare_without, damped_without
            changes.append(PeakChange(name, float(f), float(zeta), bare_peak, damped_peak, without_sensitivity, text))
    return changes


def by_name(curves: Sequence[Response]) -> dict[str, Response]:
    """Return curves by the name of the response, or by the names of response and input if there are several inputs."""
    several = len({curve.input for curve in curves}) > 1
    return {curve.ratio if several else curve.response: curve for curve in curves}


def covers(curve: Response, frequency: float) -> bool:
    """Return whether a frequency lies in the measured range of a curve."""
    return bool(curve.frequency.min() <= frequency <= curve.frequency.max())


def is_next_to_omitted(curve: Response, frequency: float) -> bool:
    """Return whether frequencies next to a line at `frequency` [Hz] were omitted, which may contain a higher peak."""
    below, above = curve.frequency[curve.frequency < frequency], curve.frequency[curve.frequency > frequency]
    neighbors = below.max(initial=-inf), above.min(initial=inf)
    return bool(np.any((curve.omitted > neighbors[0]) & (curve.omitted < neighbors[1])))


def peak_bands(modes: Modes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the natural frequencies in ascending order, and the limits of the bands of their peaks [Hz]."""
    frequency = np.sort(modes.frequency)
    midpoints = np.sqrt(frequency[1:] * frequency[:-1])
    low = np.maximum(frequency * (1.0 - _BAND_BELOW_RATIO), np.append(0.0, midpoints))
    high = np.minimum(frequency * (1.0 + _BAND_BELOW_RATIO / 2), np.append(midpoints, inf))
    return frequency, low, high


def uncompared_highest_peaks(modes: Modes, bare: Sequence[Response]) -> list[str]:
    """Return a message for each response whose highest peak belongs to no compared mode."""
    _, low, high = peak_bands(modes)
    messages = []
    for curve in bare:
        receptance = curve.to("displacement").sorted()
        f, magnitude = receptance.frequency, np.nan_to_num(abs(receptance.value))
        highest = int(np.argmax(magnitude))
        in_compared_band = np.any((low <= f[:, None]) & (f[:, None] <= high), axis=1)
        if in_compared_band[highest] or not magnitude[highest] or highest in (0, f.size - 1):
            continue
        ratio = (
            f" ({magnitude[highest] / magnitude[in_compared_band].max():.2g} times as high as the compared peaks)"
            if magnitude[in_compared_band].any()
            else ""
        )
        messages.append(
            f"{curve.response}: the highest peak, at {format_decimals(f[highest], 2)} Hz{ratio}, is not compared, "
            "because no mode was identified there. `analysis frf` shows its height and uncertainty."
        )
    return messages


def coarse_step_warnings(peaks: Sequence[tuple[float, str, Peak]]) -> list[str]:
    """Return a message for each peak with too large a frequency step, with the step that is needed.

    `peaks`: natural frequency of the mode [Hz], name of the response, and the peak.
    """
    coarse: dict[float, dict[str, Peak]] = {}
    for mode, response, response_peak in peaks:
        if (
            not isinf(response_peak.expanded)
            and response_peak.interpolation_expanded > _MAX_INTERPOLATION_ERROR * response_peak.value
        ):
            coarse.setdefault(mode, {})[response] = response_peak
    messages = []
    for _, by_response in sorted(coarse.items()):
        worst = max(
            by_response.values(), key=lambda response_peak: response_peak.interpolation_expanded / response_peak.value
        )
        error = worst.interpolation_expanded / worst.value
        responses, deviation = ", ".join(by_response), format_number(float(f"{100 * error:.2g}"))
        # The error of interpolation falls at least with the square of the step.
        messages.append(
            f"{responses}, near {format_decimals(worst.frequency, 2)} Hz: the points are {worst.step:.2g} Hz "
            f"apart, and the height of the peak between them is uncertain by up to {deviation} %, which the interval "
            f"includes. Measure every {worst.step * sqrt(_MAX_INTERPOLATION_ERROR / error):.1g} Hz there."
        )
    return messages
