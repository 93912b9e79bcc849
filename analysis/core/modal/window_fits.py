"""Identification of modes in windows of lines around peaks, for curves without stated uncertainty.

Such curves have errors of unknown size (leakage, double impacts, a nonlinear structure). In a model of the whole band
these errors change every mode, so the result depends on the limits of the band. A model of the lines around a peak is
independent of the other lines; residual terms represent the other modes. A pole is physical if it contributes an
essential part of a curve at its frequency, and if it is also identified from parts of the window's lines (see
`band_choice`).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from analysis.core.modal.band_choice import band_choice
from analysis.core.modal.line_choice import reduce_lines
from analysis.core.modal.modal_fit import MODEL_ERRORS, FittedModes, fit_modes, remove_unbounded
from analysis.core.modal.modes import MAX_RELATIVE_UNCERTAINTY
from analysis.core.modal.order_selection import are_in_band, are_narrower_than_resolution, half_width
from analysis.core.modal.peak_windows import Window, peak_windows
from analysis.core.modal.pole_errors import pole_errors, systematic_pole_errors
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
# Maximum number of fitted lines of a window, about 80 per half-width. If a window has more, every second, third, ...
# line is fitted.
_MAX_LINES = 1000


class IdentifiedPoles(NamedTuple):
    """Identified poles in ascending order of frequency."""

    poles: ComplexArray  # rad/s, shape (modes,)
    residue: ComplexArray  # shape (responses, modes)
    frequency_error: Array  # standard uncertainties, Hz
    damping_error: Array  # standard uncertainties
    model_error: float  # largest model error of the windows; 0 if noise explains the residuals
    rejected: list[float]  # frequencies of poles whose damping or height is not determined, Hz
    unconfirmed: list[float]  # frequencies of poles that parts of the lines do not confirm, Hz
    value: ComplexArray  # fitted or measured curves, m/N, shape (responses, lines)


def identify_windows(curves: Sequence[Response], value: ComplexArray, count: int | None) -> IdentifiedPoles:
    """Identify the modes of curves at equal frequencies, in ascending order; at most `count`: the highest peaks."""
    frequency = curves[0].frequency
    parts = [no_poles(value)]
    for window in peak_windows(frequency, [curve.value for curve in curves]):
        step = -(-(window.stop - window.first) // _MAX_LINES)  # rounded up
        lines = np.arange(window.first, window.stop, step)
        try:
            part = _identify_window([curve.at(lines) for curve in curves], window, frequency.size)
        except RecordingError:
            # Too few lines of the window have a value.
            continue
        parts.append(part)
    poles = np.concatenate([part.poles for part in parts])
    residue = np.concatenate([part.residue for part in parts], axis=1)
    # Heights of peaks are compared as accelerations, because displacements would favor low frequencies. A peak without
    # width, such as mains hum, counts only with its height at the resolution of the lines.
    resolution = max(curve.resolution for curve in curves)
    height = np.linalg.norm(residue, axis=0) * abs(poles) ** 2 / np.maximum(-poles.real, np.pi * resolution)
    highest = np.argsort(-height, kind="stable")[:count]
    chosen = highest[np.argsort(poles[highest].imag)]
    return IdentifiedPoles(
        poles[chosen],
        residue[:, chosen],
        np.concatenate([part.frequency_error for part in parts])[chosen],
        np.concatenate([part.damping_error for part in parts])[chosen],
        max(part.model_error for part in parts),
        [each for part in parts for each in part.rejected],
        [each for part in parts for each in part.unconfirmed],
        value,
    )


def _identify_window(curves: Sequence[Response], window: Window, n_lines: int) -> IdentifiedPoles:
    """Identify the modes of a window; `n_lines`: number of lines of the whole band."""
    reduced = remove_unbounded(reduce_lines(curves))
    fitted = fit_modes(reduced)
    model, weighted = fitted.model, fitted.weighted
    natural = abs(model.poles) / (2 * np.pi)
    accepted = are_in_band(weighted, model.poles) & (natural > window.low) & (natural <= window.high)
    rejected = [each for each in fitted.rejected if window.low < each <= window.high]
    if not model.poles.size:
        return no_poles(fitted.measured.value)._replace(rejected=rejected)
    accepted &= _largest_shares(fitted) >= _MIN_SHARE
    # A pole whose half-power band extends to the lines of other windows represents their modes.
    low = weighted.frequency[0] if window.first > 0 else 0.0
    high = weighted.frequency[-1] if window.stop < n_lines else np.inf
    accepted &= (natural - half_width(model.poles) > low) & (natural + half_width(model.poles) < high)

    # A part of the lines may need a larger model error than all lines of the window, for example if a mode at the limit
    # is missing.
    assumed_errors = [each for each in MODEL_ERRORS if each >= fitted.assumed_error]

    def identify(lines: NDArray[np.intp]) -> ComplexArray:
        part = remove_unbounded(reduce_lines([curve.at(lines) for curve in curves]))
        fitted_part = fit_modes(part, None, assumed_errors)
        return fitted_part.model.poles[are_in_band(fitted_part.weighted, fitted_part.model.poles)]

    if not accepted.any():
        return no_poles(fitted.measured.value)._replace(rejected=rejected)
    choice = band_choice(curves[0].frequency, model.poles, identify)
    systematic = [standard_of_limit(each) for each in systematic_pole_errors(reduced, model.poles)]
    of_choice = choice.frequency_error, choice.damping_error
    smallest = -_MIN_UNCERTAINTY * model.poles.real / np.stack([np.full(model.poles.size, 2 * np.pi), abs(model.poles)])
    errors = np.linalg.norm([pole_errors(weighted, model), systematic, of_choice, smallest], axis=0)
    is_determined = (errors[1] < MAX_RELATIVE_UNCERTAINTY * -model.poles.real / abs(model.poles)) & (
        expand(errors[0]) < _MAX_FREQUENCY_RATIO * half_width(model.poles)
    )
    confirmed = choice.confirmed & (is_determined | are_narrower_than_resolution(weighted, model.poles))
    kept = accepted & confirmed
    return IdentifiedPoles(
        model.poles[kept],
        model.residue[:, kept],
        errors[0, kept],
        errors[1, kept],
        fitted.model_error if kept.any() else 0.0,
        rejected,
        natural[accepted & ~confirmed].tolist(),
        fitted.measured.value,
    )


def no_poles(value: ComplexArray) -> IdentifiedPoles:
    """Return a result without poles; `value`: curves, shape (responses, lines)."""
    no_mode = np.zeros((len(value), 0), dtype=complex)
    return IdentifiedPoles(np.zeros(0, dtype=complex), no_mode, np.zeros(0), np.zeros(0), 0.0, [], [], value)


def _largest_shares(fitted: FittedModes) -> Array:
    """Return the largest ratio over the responses of the peak of each mode to the local rms of the curve."""
    poles = fitted.model.poles
    # A single line may lie in an antiresonance.
    power = scipy.ndimage.uniform_filter1d(abs(fitted.measured.value) ** 2, _SHARE_LINES, axis=1, mode="nearest")
    lines = np.abs(fitted.measured.frequency[:, None] - abs(poles) / (2 * np.pi)).argmin(axis=0)
    height = abs(fitted.model.residue) / -poles.real
    return np.asarray(np.max(height / np.sqrt(np.maximum(power[:, lines], 1e-300)), axis=0))
