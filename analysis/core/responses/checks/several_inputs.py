"""Checks of responses to several inputs: whether the inputs can be separated, and whether the matrix is reciprocal.

Inputs are separated by their spectra. Two coherent forces, for example from one noise source, have the same spectrum up
to a factor. The condition number of their spectral matrix at unit power is then large.
"""

from dataclasses import dataclass

import numpy as np

from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import RecordingError
from rig.core.results import format_percent
from rig.core.results.response import Response

# Inputs can be separated if the condition number of their spectral matrix at unit power is at most this value.
MAX_CONDITION_NUMBER = 1e3
# Reciprocal responses must agree within their uncertainties at least at this share of the lines.
_MIN_RECIPROCAL_LINES = 0.8
COHERENT_INPUTS = (
    "The inputs are coherent at {lines} of {all} lines: at these lines the responses to them cannot be separated and "
    "have no value. Drive the shakers with uncorrelated noise, or with a multisine of orthogonal phases."
)


def unit_power(spectra: ComplexArray) -> tuple[ComplexArray, Array]:
    """Scale spectral matrices, shape (n, rows, rows), to unit power; return matrices and scale, shape (n, rows)."""
    scale = np.sqrt(np.maximum(np.einsum("nkk->nk", spectra).real, 1e-300))
    return np.asarray(spectra / (scale[:, :, None] * scale[:, None])), scale


def condition(spectra: ComplexArray) -> Array:
    """Compute the condition number of spectral matrices of inputs at unit power, shape (n,); 1 if uncorrelated."""
    return np.asarray(np.linalg.cond(unit_power(spectra)[0]))


@dataclass(frozen=True)
class Reciprocity:
    """Agreement of two responses that are equal by the Maxwell-Betti reciprocity theorem."""

    pair: tuple[str, str]  # locations of output and input; the other response has them exchanged
    within: float  # share of lines at which the difference is within the sum of the expanded uncertainties
    deviation: float  # median of the relative difference of the two responses


def reciprocity(response: Response) -> tuple[Reciprocity, ...]:
    """Compare pairs of responses with exchanged output and input, which reciprocity requires to be equal."""
    places = {point.place: a for a, point in enumerate(response.outputs)}
    uncertainty, pairs = response.bound(), []
    for k, input_k in enumerate(response.inputs):
        for m, input_m in enumerate(response.inputs[:k]):
            if input_k.place not in places or input_m.place not in places:
                continue
            a, b = places[input_k.place], places[input_m.place]
            first, second = response.value[:, a, m], response.value[:, b, k]
            valid = np.isfinite(first) & np.isfinite(second)
            difference, expanded = (abs(first - second)[valid], (uncertainty[:, a, m] + uncertainty[:, b, k])[valid])
            mean = np.maximum(0.5 * abs(first + second)[valid], 1e-300)
            within, deviation = float(np.mean(difference <= expanded)), float(np.median(difference / mean))
            pairs.append(Reciprocity((input_k.place, input_m.place), within, deviation))
    return tuple(pairs)


def check_matrix(response: Response) -> Response:
    """Warn of coherent inputs and of responses that are not reciprocal; reject inputs coherent at all lines."""
    n_coherent = int(np.sum(~np.isfinite(response.value).all(axis=(1, 2))))
    if n_coherent == response.frequency.size:
        raise RecordingError(COHERENT_INPUTS.format(lines=n_coherent, all=n_coherent))
    notes = [COHERENT_INPUTS.format(lines=n_coherent, all=response.frequency.size)] if n_coherent else []
    notes += [
        f"Not reciprocal: the responses between {pair.pair[0]} and {pair.pair[1]} differ by "
        f"{format_percent(pair.deviation)} (median), more than their uncertainties at "
        f"{format_percent(1.0 - pair.within)} of the lines. Check the sensors' directions, gains and locations."
        for pair in reciprocity(response)
        if pair.within < _MIN_RECIPROCAL_LINES
    ]
    return response.warn(*notes)
