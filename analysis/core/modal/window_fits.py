"""Identification of modes in windows of lines around peaks, for curves without stated uncertainty.

Such curves have errors of unknown size (leakage, double impacts, a nonlinear structure). In a model of the whole band
these errors change every mode, so the result depends on the limits of the band. A model of the lines around a peak is
independent of the other lines; residual terms represent the other modes. A pole is a mode if it contributes an
essential part of a curve at its frequency, if its frequency and its damping ratio are determined, and if each of four
parts of the lines confirms it (see `band_choice`). The other poles are uncertain modes, which are listed with their
values and the reason. Poles without a peak are uncertain modes, too, if most orders of the stabilization diagrams of
the whole band have them.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from analysis.core.modal.band_choice import Part, band_choice, end_parts, half_parts
from analysis.core.modal.modal_fit import MODEL_ERRORS, FittedModes, fit_modes, remove_unbounded
from analysis.core.modal.modes import MAX_RELATIVE_UNCERTAINTY, UncertainMode
from analysis.core.modal.peak_windows import Window, peak_windows
from analysis.core.modal.pole_errors import pole_errors, systematic_pole_errors
from analysis.core.modal_models.lscf import ChartPole, merge_charts
from analysis.core.modal_models.order_selection import are_in_band, are_narrower_than_resolution, half_width
from analysis.core.modal_models.pole_residue import Curves
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import RecordingError
from rig.core.results.response import Response
from rig.core.results.uncertainty import expand, standard_of_limit

# A mode contributes at least this part of a curve at its natural frequency. Smaller poles represent errors of the
# curves, such as the ripple due to an echo of the force. On a measured milling tool, such poles contributed up to 0.17;
# modes contributed 0.29 or more, and 0.96 or more in 14 simulated sets.
_MIN_SHARE = 0.2
# The curve at a frequency is the root mean square of this number of lines.
_SHARE_LINES = 31
# Smallest standard uncertainty of a frequency, relative to the half-width, and of a damping ratio, relative to the
# ratio. An error of the curves that is common to all lines does not appear in the differences between parts of the
# lines.
_MIN_UNCERTAINTY = 1e-3
# The expanded uncertainty of a natural frequency is at most this fraction of the half-width. Otherwise the pole
# represents a part of the noise or of an error of the curves. Tuned on measured curves of a milling tool and of a ruler
# and two simulated sets: modes had ratios up to 0.59, computational poles from 0.7 on.
_MAX_FREQUENCY_RATIO = 0.6
_UNDETERMINED = "frequency is uncertain"
_UNDETERMINED_DAMPING = "damping is uncertain"
_NO_PEAK = "no distinct peak"
# A pole without a peak is listed if this fraction of the models of the stabilization diagrams have it.
_MIN_STABLE_SHARE = 0.5
# Maximum number of fitted lines of a window, about 80 per half-width; of more, every second, third, ... is fitted.
_MAX_LINES = 1000


class IdentifiedPoles(NamedTuple):
    """Identified poles in ascending order of frequency."""

    poles: ComplexArray  # rad/s, shape (modes,)
    residue: ComplexArray  # shape (responses, modes)
    frequency_std: Array  # standard uncertainties [Hz]
    damping_std: Array  # standard uncertainties
    model_error: float  # largest model error of the windows; 0 if the residuals are consistent with noise
    rejected: list[float]  # frequencies of poles whose damping or height is not determined [Hz]
    uncertain: list[UncertainMode]  # poles that parts of the lines do not confirm
    value: ComplexArray  # fitted or measured curves [m/N], shape (responses, lines)


class _WindowFit(NamedTuple):
    """Model of the lines of a window, before its poles are confirmed."""

    curves: list[Response]  # all lines of the window
    fitted: FittedModes
    accepted: NDArray[np.bool_]  # whether each pole of the model may be a mode of the window
    rejected: list[float]  # frequencies of poles whose damping or height is not determined [Hz]

    @property
    def poles(self) -> ComplexArray:
        """Poles that may be modes [rad/s]."""
        return self.fitted.model.poles[self.accepted]


def identify_windows(
    curves: Sequence[Response], measured: Curves, charts: Sequence[list[ChartPole]], count: int | None
) -> IdentifiedPoles:
    """Identify the modes of curves at equal frequencies, in ascending order; at most `count`: the highest peaks.

    `measured`: lines of the stabilization diagrams `charts`.
    """
    fits = list(_window_fits(curves))
    candidates = _all_poles(fits)

    def poles_of(lines: NDArray[np.intp]) -> ComplexArray:
        return _all_poles(_window_fits([curve.at(lines) for curve in curves], candidates))

    halves = list(half_parts(curves[0].frequency, poles_of))
    parts = [no_poles(measured.value), *(_confirm(fit, halves) for fit in fits)]
    poles, residue, frequency_std, damping_std = (
        np.concatenate(column, axis=-1) for column in list(zip(*parts, strict=True))[:4]
    )
    rejected = [each for part in parts for each in part.rejected]
    uncertain = [each for part in parts for each in part.uncertain]
    known = np.concatenate([abs(poles) / (2 * np.pi), rejected, [each.frequency for each in uncertain]])
    # Heights of peaks are compared as accelerations, because displacements would favor low frequencies. A peak without
    # width, such as mains hum, counts only with its height at the resolution of the lines.
    resolution = max(curve.resolution for curve in curves)
    height = np.linalg.norm(residue, axis=0) * abs(poles) ** 2 / np.maximum(-poles.real, np.pi * resolution)
    highest = np.argsort(-height, kind="stable")[:count]
    chosen = highest[np.argsort(poles[highest].imag)]
    return IdentifiedPoles(
        poles[chosen],
        residue[:, chosen],
        frequency_std[chosen],
        damping_std[chosen],
        max(part.model_error for part in parts),
        rejected,
        uncertain + stable_without_peak(measured.frequency, charts, known),
        measured.value,
    )


def _all_poles(fits: Iterable[_WindowFit]) -> ComplexArray:
    return np.concatenate([np.zeros(0, dtype=complex), *(fit.poles for fit in fits)])


def _window_fits(curves: Sequence[Response], required: ComplexArray | None = None) -> Iterator[_WindowFit]:
    """Fit a model to each window, or only to the windows that contain one of some poles [rad/s]."""
    frequency = curves[0].frequency
    for window in peak_windows(frequency, [curve.value for curve in curves]):
        low, high = max(window.low, frequency[window.first]), min(window.high, frequency[window.stop - 1])
        if required is not None:
            natural = abs(required) / (2 * np.pi)
            if not ((natural >= low) & (natural <= high)).any():
                continue
        step = -(-(window.stop - window.first) // _MAX_LINES)  # rounded up
        lines = np.arange(window.first, window.stop, step)
        try:
            yield _fit_window([curve.at(lines) for curve in curves], window, frequency.size)
        except RecordingError:
            # Too few lines of the window have a value.
            continue


def _fit_window(curves: list[Response], window: Window, n_lines: int) -> _WindowFit:
    """Fit a model to a window; `n_lines`: number of lines of the whole band."""
    fitted = fit_modes(remove_unbounded(curves))
    poles, frequency = fitted.model.poles, fitted.weighted.frequency
    natural, half = abs(poles) / (2 * np.pi), half_width(poles)
    accepted = are_in_band(fitted.weighted, poles) & (natural > window.low) & (natural <= window.high)
    accepted &= _largest_shares(fitted) >= _MIN_SHARE
    # A pole whose half-power band extends to the lines of other windows represents their modes.
    low = frequency[0] if window.first > 0 else 0.0
    high = frequency[-1] if window.stop < n_lines else np.inf
    accepted &= (natural - half > low) & (natural + half < high)
    rejected = [each for each in fitted.rejected if window.low < each <= window.high]
    return _WindowFit(curves, fitted, accepted, rejected)


def _confirm(window: _WindowFit, halves: Sequence[Part]) -> IdentifiedPoles:
    """Return the poles of a window that the halves of all lines and the parts of the window confirm."""
    curves, fitted, poles = window.curves, window.fitted, window.fitted.model.poles
    if not window.accepted.any():
        return no_poles(fitted.measured.value)._replace(rejected=window.rejected)
    # A part of the lines may need a larger model error, for example if a mode at the limit is missing.
    assumed_errors = [each for each in MODEL_ERRORS if each >= fitted.assumed_error]

    def identify(lines: NDArray[np.intp]) -> ComplexArray:
        part = fit_modes(remove_unbounded([curve.at(lines) for curve in curves]), None, assumed_errors)
        return part.model.poles[are_in_band(part.weighted, part.model.poles)]

    choice = band_choice(poles, [*end_parts(curves[0].frequency, identify), *halves])
    systematic = [standard_of_limit(each) for each in systematic_pole_errors(remove_unbounded(curves), poles)]
    of_choice = choice.frequency_std, choice.damping_std
    smallest = -_MIN_UNCERTAINTY * poles.real / np.stack([np.full(poles.size, 2 * np.pi), abs(poles)])
    errors = np.linalg.norm([pole_errors(fitted.weighted, fitted.model), systematic, of_choice, smallest], axis=0)
    natural, damping = abs(poles) / (2 * np.pi), -poles.real / abs(poles)
    is_narrow = are_narrower_than_resolution(fitted.weighted, poles)
    is_uncertain = ~is_narrow & (expand(errors[0]) >= _MAX_FREQUENCY_RATIO * half_width(poles))
    is_damping_uncertain = ~is_narrow & (errors[1] >= MAX_RELATIVE_UNCERTAINTY * damping)
    texts = np.where(is_uncertain, _UNDETERMINED, np.where(is_damping_uncertain, _UNDETERMINED_DAMPING, ""))
    reasons = [
        f"not identified {' or '.join(missing)}" if missing else text
        for missing, text in zip(choice.missing, texts.tolist(), strict=True)
    ]
    confirmed = window.accepted & np.array([not reason for reason in reasons])
    rows = zip(*(each.tolist() for each in (natural, errors[0], damping, errors[1])), reasons, strict=True)
    uncertain = [
        UncertainMode(*row) for row, accepted in zip(rows, window.accepted, strict=True) if accepted and row[-1]
    ]
    return IdentifiedPoles(
        poles[confirmed],
        fitted.model.residue[:, confirmed],
        errors[0, confirmed],
        errors[1, confirmed],
        fitted.model_error if confirmed.any() else 0.0,
        window.rejected,
        uncertain,
        fitted.measured.value,
    )


def stable_without_peak(frequency: Array, charts: Sequence[list[ChartPole]], known: Array) -> list[UncertainMode]:
    """List poles that most orders of the stabilization diagrams have, and that are not among known frequencies [Hz].

    `frequency`: of the lines [Hz]. The standard uncertainties are the scatter between the orders.
    """
    stable = [(k, each) for k, chart in enumerate(charts) for each in chart if each.stable]
    poles = np.array([each.pole for _, each in stable], dtype=complex)
    min_count = _MIN_STABLE_SHARE * sum(len({each.order for each in chart}) for chart in charts)
    found: list[UncertainMode] = []
    for pole in merge_charts(frequency, charts)[0]:
        rows = np.flatnonzero(abs(poles - pole) < -0.5 * pole.real).tolist()
        same, n_models = poles[rows], len({(stable[row][0], stable[row][1].order) for row in rows})
        natural, damping = abs(same) / (2 * np.pi), -same.real / abs(same)
        distances = abs(np.append(known, [each.frequency for each in found]) - np.median(natural))
        if n_models >= min_count and (distances > float(half_width(pole))).all():
            values = [float(of(each)) for each in (natural, damping) for of in (np.median, np.std)]
            found.append(UncertainMode(values[0], values[1], values[2], values[3], _NO_PEAK))
    return found


def no_poles(value: ComplexArray) -> IdentifiedPoles:
    """Return a result without poles; `value`: curves, shape (responses, lines)."""
    no_mode = np.zeros((len(value), 0), dtype=complex)
    return IdentifiedPoles(np.zeros(0, dtype=complex), no_mode, np.zeros(0), np.zeros(0), 0.0, [], [], value)


def _largest_shares(fitted: FittedModes) -> Array:
    """Return the largest ratio over the responses of the peak of each mode to the local rms of the curve."""
    poles = fitted.model.poles
    if not poles.size:
        return np.zeros(0)
    # A single line may lie in an antiresonance.
    power = scipy.ndimage.uniform_filter1d(abs(fitted.measured.value) ** 2, _SHARE_LINES, axis=1, mode="nearest")
    lines = np.abs(fitted.measured.frequency[:, None] - abs(poles) / (2 * np.pi)).argmin(axis=0)
    height = abs(fitted.model.residue) / -poles.real
    return np.asarray(np.max(height / np.sqrt(np.maximum(power[:, lines], 1e-300)), axis=0))
