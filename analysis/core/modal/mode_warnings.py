"""Warnings about identified modes, each with its consequence and its remedy."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from analysis.core.modal.modes import MAX_RELATIVE_UNCERTAINTY, Modes
from analysis.core.modal.pole_errors import LEAKAGE_FACTOR
from analysis.core.modal.window_fits import IdentifiedPoles
from analysis.core.responses.estimator import estimator_of
from rig.core.base.arrays import Array
from rig.core.results import format_percent
from rig.core.results.response import Response
from rig.core.results.uncertainty import expand

#: Where extrapolated damping is valid.
EXTRAPOLATED_TO = "to the larger motion of the peak, at which dampers and joints may act that are at rest on the flanks"
# A larger relative standard uncertainty of a damping ratio causes a warning.
_MAX_DAMPING_UNCERTAINTY = 0.02
# Ratio of the resolution to half the half-power width at which leakage raises a damping ratio by the fraction
# `_MAX_DAMPING_UNCERTAINTY`.
_WIDENING_RATIO = float(np.sqrt(_MAX_DAMPING_UNCERTAINTY / LEAKAGE_FACTOR))
# For a linear structure with lightly damped modes, the residual is below this fraction of the peak height.
MAX_LINEAR_RESIDUAL = 0.005
# Noise bandwidth of a Hann window, in reciprocals of the block length: the resolution of a block.
_HANN_NOISE_BANDWIDTH = 1.5
_MAINS_FREQUENCIES = (50.0, 60.0)  # Hz
# Largest tested multiple of the mains frequency: hum at higher multiples is rarely distinct.
_MAX_MAINS_MULTIPLE = 10
# Tolerance of a coincidence, relative to the mains frequency, from which none is reported: at 5 %, nearly a fifth of
# random frequencies up to 500 Hz would match a multiple of 50 or 60 Hz.
_MAX_COINCIDENCE = 0.05


def mode_warnings(
    modes: Modes,
    curves: Sequence[Response],
    count: int | None,
    fitted_poles: IdentifiedPoles,
    uncertain_poles: Array,  # Hz: poles at which the uncertainty of the curves is too large
    unmeasured: Array,  # Hz: poles around which no line was measured
    unused_responses: Sequence[str],  # responses that were not used
) -> Iterator[str]:
    """Yield warnings about modes; `count` modes were requested."""
    for name in unused_responses:
        yield (
            f"{name} was omitted: its uncertainty is unbounded. Record again with a more sensitive sensor or a smaller "
            "converter range."
        )
    if modes.model_error:
        has_error_bars = any(np.isfinite(curve.error).any() for curve in curves)
        expected = "uncertainties of the points" if has_error_bars else "scatter"
        residual_text = (
            f"the best linear fit leaves a residual of {format_percent(modes.model_error)} of the peak height"
        )
        if modes.model_error > MAX_LINEAR_RESIDUAL:
            yield (
                f"The modes do not explain the response: {residual_text}, more than the {expected}. The "
                "structure may be nonlinear, as with dampers in flight; the modes are then its linear equivalent at "
                "this force level. Or it has a heavily damped mode, such as that of a shaker's armature, or modes "
                "closer than their half-power width: the interval of their common pole may contain none of them."
            )
        else:
            yield (
                f"Small model error: {residual_text}, more than the {expected}. "
                "The uncertainties of the modes include it."
            )
    yield from rejections(fitted_poles)
    if uncertain_poles.size:
        listed = _listed(uncertain_poles)
        yield f"Rejected the stable poles at {listed} Hz: the curves are too uncertain at these frequencies."
    if unmeasured.size:
        yield (
            f"Rejected the stable poles at {_listed(unmeasured)} Hz: the lines around them were omitted. There may be "
            "several modes there."
        )
    f, zeta, zeta_uncertainty = modes.frequency, modes.damping, modes.damping_std
    if count is not None and f.size < count:
        yield f"Identified only {f.size} of {count} requested modes: no other mode is significant in these curves."
    half_widths = zeta * f
    resolution = max(curve.resolution for curve in curves)
    widened = resolution > _WIDENING_RATIO * half_widths
    narrow = (zeta_uncertainty > MAX_RELATIVE_UNCERTAINTY * zeta) & (resolution > 2.0 * half_widths)
    if narrow.any():
        yield (
            f"{_listed(f[narrow])} Hz: the peak is narrower than the resolution of {resolution:.3g} Hz, so only an "
            "upper bound of the damping is known. Use much longer blocks, burst random, multisine or stepped sine."
        )
    peaks = [*zip(f[narrow], modes.frequency_std[narrow], strict=True)]
    peaks += [each[:2] for each in modes.uncertain if 2.0 * each.damping * each.frequency < resolution]
    hum = [
        f"{natural:.4g} Hz ({mains})"
        for natural, error in sorted(peaks)
        if (mains := mains_multiple(natural, max(float(expand(error)), 0.5 * resolution)))
    ]
    if hum:
        yield (
            f"{', '.join(hum)}: probably mains hum, not a mode, because the "
            "peak has no width and its frequency is a multiple of the mains frequency. Record without excitation to "
            "check it. Repair cables and grounding."
        )
    leaking = widened & ~narrow
    if leaking.any():
        yield (
            f"{_listed(f[leaking])} Hz: the resolution of {resolution:.3g} Hz widens the peaks (half-power widths "
            f"{_listed(2.0 * half_widths[leaking], 3)} Hz), which raises the damping ratios by more than "
            f"{format_percent(_MAX_DAMPING_UNCERTAINTY)}. Use blocks of at least "
            f"{_HANN_NOISE_BANDWIDTH / (_WIDENING_RATIO * half_widths[leaking].min()):.3g} s, burst random, multisine "
            "or stepped sine."
        )
    undersampled, estimator = extrapolates_damping(modes, curves), estimator_of(curves[0].test)
    if undersampled.any():
        narrowest = half_widths[undersampled].min()
        remedy = estimator.line_remedy(narrowest / 2.0)
        yield (
            f"{_listed(f[undersampled])} Hz: fewer than two measured points lie within a half-power width of "
            f"{_listed(2.0 * half_widths[undersampled], 3)} Hz on either side, so the damping is extrapolated from the "
            f"flanks {EXTRAPOLATED_TO}. {remedy}"
        )
    uncertain = (zeta_uncertainty > _MAX_DAMPING_UNCERTAINTY * zeta) & ~narrow
    if uncertain.any():
        parts = ", ".join(
            f"{format_percent(zeta_uncertainty[k] / zeta[k])} at {modes.frequency_label(k)}"
            for k in np.flatnonzero(uncertain).tolist()
        )
        yield f"Damping is poorly determined: standard uncertainty {parts}."


def extrapolates_damping(modes: Modes, curves: Sequence[Response]) -> NDArray[np.bool_]:
    """Return whether each damping ratio is extrapolated from the sides: the lines do not resolve the peak."""
    half_widths = modes.damping * modes.frequency
    # Lines within the half-power width on either side of the resonance.
    distance = abs(curves[0].frequency - modes.frequency[:, None])
    n_points = np.sum(distance < 2.0 * half_widths[:, None], axis=1)
    resolution = max(curve.resolution for curve in curves)
    undersampled = np.asarray((n_points < 2) & (resolution <= _WIDENING_RATIO * half_widths), dtype=bool)
    if estimator_of(curves[0].test).resolves_between_lines:
        undersampled &= modes.damping_std > _MAX_DAMPING_UNCERTAINTY * modes.damping
    return undersampled


def mains_multiple(frequency: float, tolerance: float) -> str:
    """Return the multiple of a mains frequency within `tolerance` of a frequency, both Hz, or "".

    With a tolerance of `_MAX_COINCIDENCE` or more, the result is "": many frequencies would match by coincidence.

    >>> mains_multiple(149.8, 0.7), mains_multiple(119.9, 0.2), mains_multiple(130.0, 0.7), mains_multiple(149.8, 9.0)
    ('3 x 50 Hz', '2 x 60 Hz', '', '')
    """
    for mains in _MAINS_FREQUENCIES:
        multiple = min(max(round(frequency / mains), 1), _MAX_MAINS_MULTIPLE)
        if abs(frequency - multiple * mains) <= tolerance < _MAX_COINCIDENCE * mains:
            return f"{multiple} x {mains:g} Hz"
    return ""


def rejections(fitted_poles: IdentifiedPoles) -> Iterator[str]:
    """Yield a sentence about stable poles of undetermined damping or height, and about uncertain modes."""
    if fitted_poles.rejected:
        yield (
            f"Rejected the stable poles at {_listed(np.sort(fitted_poles.rejected))} Hz: their damping or height is "
            "below the uncertainty of these curves. Damper impacts also cause such peaks, which are not modes."
        )
    if fitted_poles.uncertain:
        listed = ", ".join(f"{each.frequency_text()} ({each.reason})" for each in fitted_poles.uncertain)
        yield (
            f"Uncertain modes: {listed}. Leakage, double impacts, spikes of single lines and a nonlinear structure "
            "cause such poles. Measure with a smaller frequency spacing or more averages to identify modes there."
        )


def _listed(values: Array, digits: int = 4) -> str:
    return ", ".join(f"{value:.{digits}g}" for value in values)
