"""Selection of the model order: poles are added while they reduce the misfit by more than noise and model error.

References
----------
.. [1] G. Schwarz, Estimating the dimension of a model, Annals of Statistics 6 (1978) 461-464.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from analysis.modal.lscf import MOST_DAMPING
from analysis.modal.pole_residue import Curves, Fit, fit, misfits_with, misfits_without
from rig.arrays import Array, ComplexArray

MOST_MODES = 12
# Fewest residual degrees of freedom; with fewer, a model fits any data.
_FEWEST_DEGREES = 8
# A pole must reduce the misfit by this multiple of the penalty in Schwarz's criterion [1]_.
_STRICTNESS = 2.0
# Two poles are resolved if their distance is at least this part of their mean half-power width.
LEAST_POLE_DISTANCE = 0.4
# Poles closer than this number of widths must fit the curve to within this multiple of its noise power, because two
# close poles can also fit the asymmetric peak of a nonlinear structure.
_NEAR, _EXPLAINED = 4.0, 4.0
# A window may split a narrow peak into two or three at a distance of a line. Poles closer than this multiple of the
# resolution are a single pole.
_SPLIT_PEAK_LINES = 1.5
# Number of candidates that are fully fitted at each step.
_FINALISTS = 4


def half_width(poles: ComplexArray) -> Array:
    """Compute half of the half-power widths, Hz."""
    return np.asarray(-poles.real / (2 * np.pi))


def in_band(curves: Curves, poles: ComplexArray) -> NDArray[np.bool_]:
    """Whether poles are inside the measured band."""
    f = poles.imag / (2 * np.pi)
    return np.asarray((f > curves.frequency[0]) & (f < curves.frequency[-1]))


def hidden(curves: Curves, poles: ComplexArray) -> NDArray[np.bool_]:
    """Whether peaks are narrower than the resolution: their widths are undetermined."""
    return np.asarray(2.0 * half_width(poles) < curves.resolution)


def select(curves: Curves, stable: ComplexArray, candidates: ComplexArray, most: int = MOST_MODES) -> Fit:
    """Select the best model with all significant poles [1]_, at most `most` of them inside the band; poles in rad/s."""
    model = fit(curves, stable)
    # Spurious poles are removed, the least significant first.
    while (among := doubtful(curves, model)).size:
        least = among[int(np.argmin(misfits_without(curves, model.poles)[among]))]
        model = fit(curves, np.delete(model.poles, least))
    current = _pruned(curves, model)
    # Poles below and above the band represent curvature that residual terms cannot represent.
    low, high = curves.frequency[0], curves.frequency[-1]
    places = np.array([0.5 * low, 0.8 * low, 0.95 * low, 1.05 * high, 1.25 * high, 2.0 * high])
    outside = np.asarray(2 * np.pi * places * (-0.01 + 1j), dtype=complex)
    while in_band(curves, current.poles).sum() < most:
        if curves.degrees(current.poles.size + 1) < _FEWEST_DEGREES:
            break
        pool = np.concatenate([candidates, _at_largest_rest(curves, current), outside])
        better = _best_addition(curves, current, pool)
        if better is None:
            break
        current = better
    return _pruned(curves, current)


def _best_addition(curves: Curves, current: Fit, pool: ComplexArray) -> Fit | None:
    """Return the best model with an additional pole that is significant and not spurious."""
    misfits = misfits_with(curves, current.poles, pool)
    best: Fit | None = None
    tried: list[complex] = []
    for index in np.argsort(misfits, kind="stable"):
        p = pool[index]
        if any(abs(p - q) < 0.5 * min(-p.real, -q.real) for q in tried):
            continue
        tried.append(p)
        model = fit(curves, np.append(current.poles, p))
        better = best is None or model.misfit < best.misfit
        if better and significant(curves, current, model) and not doubtful(curves, model).size:
            best = model
        if len(tried) == _FINALISTS:
            break
    return best


def significant(curves: Curves, less: Fit, more: Fit) -> bool:
    """Whether the additional poles of a model reduce the misfit by more than noise explains."""
    return _gain(curves, less.misfit, more, less.poles.size) > 0


def preferred(curves: Curves, one: Fit, other: Fit) -> Fit:
    """Return the model with more poles if they reduce the misfit by more than noise explains, otherwise the other."""
    less, more = sorted((one, other), key=lambda model: model.poles.size)
    if less.poles.size == more.poles.size:
        return min(one, other, key=lambda model: model.misfit)
    return more if significant(curves, less, more) else less


def _gain(curves: Curves, misfit: float, more: Fit, poles: int) -> float:
    """Misfit reduction by the additional poles of a model, less the reduction that noise explains."""
    unknowns = curves.unknowns(more.poles.size)
    added = unknowns - curves.unknowns(poles)
    scale = max(more.misfit / curves.degrees(more.poles.size), 1.0) * correlation(more.rest)
    return misfit - more.misfit - float(_STRICTNESS * added * np.log(curves.numbers) * scale)


def correlation(rest: ComplexArray) -> float:
    """Estimate the number of neighbouring lines with a common residual; 1 for independent noise."""
    power = float(np.sum(abs(rest) ** 2))
    if power == 0.0:
        return 1.0
    total = 1.0
    for lag in range(1, max(2, rest.shape[1] // 8)):
        common = float(np.sum((rest[:, lag:] * rest[:, :-lag].conj()).real)) / power
        if common < 0.1:
            break
        total += 2.0 * common
    return total


def doubtful(curves: Curves, model: Fit) -> NDArray[np.intp]:
    """Return spurious poles: overdamped, doubled, or fitted to the asymmetric peak of a nonlinear structure."""
    poles, width = model.poles, half_width(model.poles)
    inside = in_band(curves, poles)
    out = {int(i) for i in np.flatnonzero(inside & (-poles.real > MOST_DAMPING * abs(poles)))}
    order = [int(i) for i in np.argsort(poles.imag) if inside[i]]
    for low, high in pairwise(order):
        apart = (poles[high].imag - poles[low].imag) / (2 * np.pi)
        mean = width[low] + width[high]
        # A narrow peak that is split by the window is no wider than this.
        alike = mean < 2.0 * curves.resolution and apart < _SPLIT_PEAK_LINES * curves.resolution
        if (
            alike
            or apart < LEAST_POLE_DISTANCE * mean
            or (apart < _NEAR * mean and _local_misfit(curves, model, poles[[low, high]]) > _EXPLAINED)
        ):
            out |= {low, high}
    return np.array(sorted(out), dtype=np.intp)


def _local_misfit(curves: Curves, model: Fit, poles: ComplexArray) -> float:
    """Misfit around poles in variances of the noise."""
    width = 2.0 * half_width(poles)
    f = poles.imag / (2 * np.pi)
    near = (curves.frequency > np.min(f - 2 * width)) & (curves.frequency < np.max(f + 2 * width))
    numbers = 2 * near.sum() * curves.value.shape[0]
    free = max(numbers - curves.unknowns(poles.size), 0.3 * numbers, 1.0)
    return float(np.sum(abs(model.rest[:, near]) ** 2) / free)


def _pruned(curves: Curves, model: Fit) -> Fit:
    """Remove poles that are not significant."""
    while model.poles.size:
        poles = model.poles
        while poles.size:
            misfits = misfits_without(curves, poles)
            least = int(np.argmin(misfits))
            fewer = np.delete(poles, least)
            # Without a new fit of the other poles the loss is overestimated, so a pole that is not significant here
            # is not significant after a new fit.
            if _gain(curves, float(misfits[least]), model, fewer.size) > 0:
                break
            poles = fewer
        if poles.size < model.poles.size:
            model = fit(curves, poles)
            continue
        less = fit(curves, fewer)
        if significant(curves, less, model):
            return model
        model = less
    return model


def _at_largest_rest(curves: Curves, model: Fit) -> ComplexArray:
    """Return candidate poles of several widths at the largest residual of the model."""
    frequency = curves.frequency
    size = np.sum(abs(model.rest) ** 2, axis=0)
    out = []
    for index in np.argsort(size)[::-1][:3]:
        spacing = frequency[min(index + 1, frequency.size - 1)] - frequency[max(index - 1, 0)]
        for width in (0.5 * spacing, 2.0 * spacing, 0.003 * frequency[index], 0.02 * frequency[index]):
            out.append(2 * np.pi * (-width + 1j * frequency[index]))
    return np.array(out, dtype=complex)
