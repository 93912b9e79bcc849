"""Local rational method: a response without leakage from the spectra of whole stretches of a recording.

Around every line the response is a quotient of two low polynomials, and what the two ends of a stretch add to its
spectrum (the transients, which are what leaks) is another one with the same denominator. All are fitted by least
squares to the lines nearby [1]_; no window smears the curve, nothing needs to have died away, and what the fit
leaves over gives the error bars.

References
----------
.. [1] T. McKelvey, G. Guérin, Non-parametric frequency response estimation using a local rational model, 16th IFAC
   Symposium on System Identification, 2012.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Lines = NDArray[np.int64]

# Orders of the polynomials of the response, above and below, and of the transients.
NUMERATOR, DENOMINATOR, TRANSIENT = 2, 2, 2
_FAINT, _NOTHING = 1e-10, 1e-300
# Elements of the systems of equations solved at a time.
_AT_ONCE = 1 << 20


@dataclass(frozen=True)
class LocalFit:
    """A response line by line."""

    value: ComplexArray
    """Response at each line; NaN where nothing was driven; complex, shape (lines,)."""
    variance: Array
    """Of either quadrature component; shape (lines,)."""
    coherence: Array
    """Share of the response's power that the fit gives to the reference; shape (lines,)."""
    degrees: float
    """Degrees of freedom behind the variance."""


def local_fit(
    response: ComplexArray,
    reference: ComplexArray,
    ends: ComplexArray,
    lines: Lines,
    side: int,
    used: float = 1.0,
) -> LocalFit:
    """Fit the response at some lines.

    Parameters
    ----------
    response, reference : ndarray of complex, shape (stretches, bins)
        Spectra of stretches brought to equal length, without a window.
    ends : ndarray of complex, shape (stretches, bins)
        Phase of the instant at which each stretch begins, where its transient does not join that of its end: 1
        throughout where it does, 0 where the rig was at rest.
    lines : ndarray of int, shape (lines,)
        Bins at which to fit.
    side : int
        Lines to either side that a fit takes in.
    used : float
        Share of the samples behind the spectra that was measured, the rest being zeros: neighbouring lines then
        depend on each other, and count for less.

    Examples
    --------
    >>> random = np.random.default_rng(1)
    >>> bins = np.arange(200)
    >>> force = random.standard_normal((1, 200)) + 1j * random.standard_normal((1, 200))
    >>> pole = 1j * (bins - 100.0) + 2.0
    >>> fit = local_fit(force / pole + 5.0 / pole, force, np.zeros((1, 200)), np.array([100, 103]), 12)
    >>> np.allclose(fit.value, 1.0 / pole[[100, 103]])
    True
    """
    begins = [s for s in range(len(response)) if np.any(ends[s]) and not np.all(ends[s] == 1.0)]
    unknowns = NUMERATOR + 1 + DENOMINATOR + (len(response) + len(begins)) * (TRANSIENT + 1)
    equations = len(response) * (2 * side + 1)
    step = max(1, _AT_ONCE // (equations * unknowns))
    parts = [
        _fit(response, reference, ends, begins, lines[first : first + step], side)
        for first in range(0, lines.size, step)
    ]
    value, variance, coherence = (np.concatenate(each) for each in zip(*parts, strict=True))
    # Zeros in front of a stretch make neighbouring lines depend on each other: they count for less.
    free = max(used * equations - unknowns, 0.5)
    return LocalFit(value, variance / free, coherence, 2.0 * free)


def _fit(
    response: ComplexArray,
    reference: ComplexArray,
    ends: ComplexArray,
    begins: list[int],
    lines: Lines,
    side: int,
) -> tuple[ComplexArray, Array, Array]:
    stretches, width = len(response), 2 * side + 1
    first = np.clip(lines - side, 0, response.shape[1] - width)
    near = first[:, None] + np.arange(width)
    at = ((near - lines[:, None]) / side)[:, None, :]
    x, f, e = (np.moveaxis(spectra[:, near], 1, 0) for spectra in (response, reference, ends))
    size, drive = (
        np.maximum(np.sqrt(np.mean(abs(each) ** 2, axis=(1, 2), keepdims=True)), _NOTHING) for each in (x, f)
    )
    x, f = x / size, f / drive
    columns = [f * at**order for order in range(NUMERATOR + 1)]
    columns += [-x * at**order for order in range(1, DENOMINATOR + 1)]
    for s in range(stretches):
        own = np.zeros((1, stretches, 1))
        own[0, s] = 1.0
        columns += [np.broadcast_to(own * at**order, x.shape) for order in range(TRANSIENT + 1)]
        if s in begins:
            columns += [own * e * at**order for order in range(TRANSIENT + 1)]
    system = np.stack(columns, axis=-1).reshape(lines.size, stretches * width, -1)
    right = x.reshape(lines.size, -1, 1)
    # Where lower orders do, denominator, numerator and transient have a factor in common, which could be anything:
    # a faint wish for small coefficients settles it, and leaves the response at the line as it is.
    wish = np.broadcast_to(_FAINT * np.eye(system.shape[2]), (lines.size, *2 * (system.shape[2],)))
    q, r = np.linalg.qr(np.concatenate([system, wish], axis=1))
    projected = np.conj(np.swapaxes(q[:, : system.shape[1]], 1, 2)) @ right
    solution = np.linalg.solve(r, projected)[..., 0]
    inverse = np.linalg.solve(r, np.broadcast_to(np.eye(r.shape[1]), r.shape))
    left = right[..., 0] - (system @ solution[..., None])[..., 0]
    noise = np.sum(abs(left) ** 2, axis=1)
    # Column 0 is the numerator's constant: the response at the line itself, where the denominator is one.
    variance = noise * np.sum(abs(inverse[:, 0]) ** 2, axis=1) / 2.0
    told = abs(solution[:, 0]) ** 2 * np.sum(abs(f) ** 2, axis=(1, 2))
    coherence = told / np.maximum(told + noise, _NOTHING)
    factor = np.where(drive > _NOTHING, size / drive, np.nan)[:, 0, 0]
    return solution[:, 0] * factor, variance * factor**2, coherence
