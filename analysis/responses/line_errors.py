"""Random errors of several responses of one test: their covariance at each line, and from line to line.

All responses are divided by one reference, whose noise puts all of them off by the same part of themselves; and
neighbouring lines of a local fit rest on the same bins. Both decide how far the parameters of a model fitted to many
lines scatter. Errors are linear in those of the readings, so they are propagated from there [1]_.

References
----------
.. [1] R. Pintelon, J. Schoukens, System Identification: A Frequency Domain Approach, 2nd ed., Wiley 2012, sections 2.5
   and 9.4.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from analysis.responses.error_parts import Lines, LocalErrors, MeanErrors
from analysis.responses.frf import Frf

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# Widths of a local fit over which noise of one kind is taken for even, and rounds of weighting.
_EVEN_WIDTHS, _ROUNDS = 5, 4
# Least noise of a response, as a share of what a local fit leaves; and what is no power, but has a square.
_LEAST, _NOTHING = 1e-6, 1e-40
# Share of each variance that responses do not have in common: errors of second order, and a covariance of few
# averages. Tuned on chains with 3 % of noise in the reference: with 0.1 %, values scattered by twice their bounds.
_SHRUNK = 0.05


@dataclass(frozen=True)
class ErrorCovariance:
    """Covariance of the random errors of several responses.

    Attributes
    ----------
    lines : ndarray of complex, shape (lines, responses, responses)
        ``E[e e^H]`` at each line.
    shared : float
        How many neighbouring lines have one error; where `local` says which, of what is not in it.
    local : sequence of LocalErrors
        Of each response, where lines share bins; else empty.
    noise : ndarray of complex, shape (bins, responses, responses)
        Of the readings, with `local`.
    reference : ndarray, shape (lines,), or None
        Noise in the reference as a share of its power; None where it is not estimated.
    """

    lines: ComplexArray
    shared: float
    local: Sequence[LocalErrors] = ()
    noise: ComplexArray | None = None
    reference: Array | None = None

    def at(self, lines: Lines) -> ErrorCovariance:
        """Keep some lines."""
        return replace(
            self,
            lines=self.lines[lines],
            local=[each.at(lines) for each in self.local],
            reference=None if self.reference is None else self.reference[lines],
        )

    def select(self, responses: Sequence[int]) -> ErrorCovariance:
        """Keep some responses."""
        return replace(
            self,
            lines=self.lines[:, responses][:, :, responses],
            local=[self.local[k] for k in responses] if self.local else (),
            noise=None if self.noise is None else self.noise[:, responses][:, :, responses],
        )

    def of_sums(self, weights: ComplexArray) -> Array:
        """Covariance of real sums ``Re(sum(conj(weights) e))`` over lines and responses.

        Parameters
        ----------
        weights : ndarray of complex, shape (lines, responses, sums)

        Returns
        -------
        ndarray, shape (sums, sums)
        """
        if self.noise is None:
            half = np.einsum("kap,kac,kcq->pq", weights.conj(), self.lines, weights, optimize=True)
            return np.asarray(0.5 * self.shared * half.real)
        from scipy.sparse import csr_array

        bins, width = len(self.noise), self.local[0].influence.shape[2]
        total = np.zeros((weights.shape[2],) * 2)
        for stretch in range(self.local[0].influence.shape[1]):
            through = []
            for k, each in enumerate(self.local):
                places = (each.first[:, None] + np.arange(width)).ravel()
                ends = np.arange(0, places.size + 1, width)
                spread = csr_array(
                    (each.influence[:, stretch].ravel(), places, ends), shape=(len(each.first), bins)
                )
                through.append((spread.T @ weights[:, k].conj()).T)
            onto = np.stack(through, axis=2)
            total += np.einsum("pbi,bij,qbj->pq", onto, self.noise, onto.conj(), optimize=True).real
        common = np.stack([each.common for each in self.local], axis=1)
        alike = np.einsum("kap,ka->p", weights.conj(), common)
        total *= 0.5 * self.local[0].shared / self.local[0].used
        own = np.einsum("kaa->ka", self.lines).real * (0.5 * self.shared * _SHRUNK / (1.0 + _SHRUNK))
        total += np.einsum("kap,ka,kaq->pq", weights.conj(), own, weights, optimize=True).real
        return np.asarray(total + np.outer(alike.real, alike.real) + np.outer(alike.imag, alike.imag))


def error_covariance(frfs: Sequence[Frf]) -> ErrorCovariance:
    """Estimate the covariance of the errors of responses of one test, at the same lines.

    Responses that say no more than the size of their errors are taken for independent.
    """
    errors = [frf.errors for frf in frfs]
    if all(isinstance(each, MeanErrors) for each in errors):
        return _of_means([each for each in errors if isinstance(each, MeanErrors)], frfs)
    local = [each for each in errors if isinstance(each, LocalErrors)]
    if len(local) == len(frfs) and all(
        np.array_equal(each.first, local[0].first) and each.residual.shape == local[0].residual.shape
        for each in local
    ):
        return _of_local(local, frfs)
    variance = np.stack([2.0 * frf.error**2 for frf in frfs], axis=1)
    diagonal = np.einsum("ka,ab->kab", variance, np.eye(len(frfs))).astype(complex)
    return ErrorCovariance(diagonal, max(frf.shared for frf in frfs))


def _of_means(errors: Sequence[MeanErrors], frfs: Sequence[Frf]) -> ErrorCovariance:
    weights = np.stack([each.weights for each in errors], axis=1)
    lines = np.einsum("kai,kij,kcj->kac", weights, errors[0].covariance, weights.conj(), optimize=True)
    # What the lines around say of variances of few degrees of freedom is in the responses' own.
    stated, own = np.stack([2.0 * frf.error**2 for frf in frfs], axis=1), np.einsum("kaa->ka", lines).real
    with np.errstate(invalid="ignore"):
        ratio = np.sqrt(np.divide(stated, own, out=np.ones_like(own), where=own > 0.0))
    lines = lines * ratio[:, :, None] * ratio[:, None]
    return ErrorCovariance(_shrunk(lines), max(frf.shared for frf in frfs))


def _of_local(errors: Sequence[LocalErrors], frfs: Sequence[Frf]) -> ErrorCovariance:
    residual = np.stack([each.residual.reshape(len(each.first), -1) for each in errors], axis=1)
    power = residual @ residual.conj().swapaxes(1, 2) / errors[0].free
    curve = np.stack([each.curve[:, 0] for each in errors], axis=1)
    first, width = errors[0].first, curve.shape[2]
    share: Array | None = None
    bins = int(first.max()) + width
    centre = first + width // 2
    nearest = np.clip(np.searchsorted(0.5 * (centre[1:] + centre[:-1]), np.arange(bins)), 0, len(first) - 1)
    if all(each.one_reference for each in errors):
        reference, own, share = _kinds_of_noise(power, curve, errors[0].drive, centre)
        within = np.clip(np.arange(bins) - first[nearest], 0, width - 1)
        there = curve[nearest, :, within]
        noise = reference[nearest, None, None] * there[:, :, None] * there[:, None].conj()
        index = np.arange(len(errors))
        noise[:, index, index] += own[nearest]
    else:
        noise = power[nearest]
    influence = np.stack([each.influence for each in errors], axis=1)
    around = noise[first[:, None] + np.arange(width)]
    lines = np.einsum("kasw,kwac,kcsw->kac", influence, around, influence.conj(), optimize=True)
    common = np.stack([each.common for each in errors], axis=1)
    lines = lines / errors[0].used + 2.0 * common[:, :, None] * common[:, None].conj()
    if share is None:
        # Of what is left over by chance too little remains where noise of a known size passes through the fit.
        stated = np.stack([2.0 * frf.error**2 for frf in frfs], axis=1)
        own = np.einsum("kaa->ka", lines).real
        more = np.sqrt(np.maximum(1.0, np.divide(stated, own, out=np.ones_like(own), where=own > 0.0)))
        lines = lines * more[:, :, None] * more[:, None]
    shared = max(frf.shared for frf in frfs)
    return ErrorCovariance(_shrunk(lines), shared, errors, noise, share)


def _shrunk(lines: ComplexArray) -> ComplexArray:
    own = np.einsum("kaa->ka", lines).real
    index = np.arange(own.shape[1])
    lines = lines.copy()
    lines[:, index, index] += _SHRUNK * own
    return lines


def _kinds_of_noise(
    power: ComplexArray, curve: ComplexArray, drive: Array, centre: NDArray[np.int64]
) -> tuple[Array, Array, Array]:
    """Separate noise of the reference, common to all responses, from that of each response.

    Weighted least squares of what local fits leave, over lines around each line: the cross-powers of residuals are
    those of the curves times the noise of the reference, plus that of each response.

    Returns
    -------
    reference : ndarray, shape (lines,)
    own : ndarray, shape (lines, responses)
    share : ndarray, shape (lines,)
        Of the reference's power that is noise.
    """
    lines, _, width = curve.shape
    step = float(np.median(np.diff(centre))) if lines > 1 else 1.0
    reach = min(1 + 2 * int(np.ceil(_EVEN_WIDTHS * width / step / 2.0)), max(lines, 1))
    followed = curve @ curve.conj().swapaxes(1, 2) / width
    own = np.einsum("kaa->ka", power).real
    by_curve = np.einsum("kaa->ka", followed).real

    def near(each: Array) -> Array:
        return np.asarray(scipy.ndimage.uniform_filter1d(each, reach, axis=0, mode="nearest"))

    size = np.maximum(scipy.ndimage.uniform_filter1d(own, 3, axis=0, mode="nearest"), _NOTHING)
    for _ in range(_ROUNDS):
        pairs = size[:, :, None] * size[:, None]
        both = near(np.sum(abs(followed) ** 2 / pairs, axis=(1, 2)))
        mixed, alone = near(by_curve / size**2), near(1.0 / size**2)
        right = near(np.sum((power * followed.conj()).real / pairs, axis=(1, 2)))
        right_own = near(own / size**2)
        left = both - np.sum(mixed**2 / alone, axis=1)
        known = left > 1e-6 * both
        reference = np.where(known, right - np.sum(mixed * right_own / alone, axis=1), 0.0)
        reference = np.maximum(reference / np.where(known, left, 1.0), 0.0)
        least = _LEAST * near(own)
        own_noise = np.maximum((right_own - mixed * reference[:, None]) / alone, least)
        size = np.maximum(reference[:, None] * by_curve + own_noise, _NOTHING)
    power_around = near(drive)
    share = np.divide(reference, power_around, out=np.zeros_like(drive), where=power_around > 0.0)
    return np.asarray(reference), np.asarray(own_noise), share
