"""Natural frequencies, damping ratios and shapes from measured frequency responses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from analysis.modal.lscf import ChartPole, chart, stable_poles
from analysis.responses.frf import Frf
from rig.errors import RecordingError, SceneError

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# The smallest relative error credited to a point: keeps a handful of nearly perfect points from deciding
# alone.
LEAST_RELATIVE_ERROR = 1e-4
MOST_MODES = 10
# A Hann window's leakage widens a resonance; fitted, its damping ratio comes out too high by some 0.16 of
# (resolution over half the half-power width) squared: by 2 % at this ratio.
SMEARED = 0.36


@dataclass(frozen=True)
class Modes:
    """Identified modes.

    Attributes
    ----------
    frequency, frequency_error : ndarray, shape (modes,)
        Undamped natural frequency abs(p)/2 pi and its standard deviation, Hz.
    damping, damping_error : ndarray, shape (modes,)
        Damping ratio and its standard deviation.
    residue : ndarray of complex, shape (responses, modes)
        R in R/(s - p) + conj(R)/(s - conj(p)), receptance, m/(N s).
    responses : tuple of str
        Channels.
    chart : tuple of ChartPole
        Stabilisation chart.
    lower, upper : ndarray, shape (responses,)
        What modes below and above the band add: lower / s² + upper, m/N.
    label : str
        Scene and setting.
    warnings : tuple of str
        Doubts about the numbers, in full sentences.
    """

    frequency: Array
    frequency_error: Array
    damping: Array
    damping_error: Array
    residue: ComplexArray
    responses: tuple[str, ...]
    chart: tuple[ChartPole, ...]
    lower: Array
    upper: Array
    label: str
    warnings: tuple[str, ...]

    @property
    def shapes(self) -> ComplexArray:
        """Shapes scaled to largest element one, shape (responses, modes)."""
        top = np.argmax(abs(self.residue), axis=0)
        return self.residue / self.residue[top, np.arange(self.residue.shape[1])]

    def receptance(self, frequency: Array) -> ComplexArray:
        """Receptance of the modal model, m/N, shape (responses, frequencies); frequencies in Hz."""
        s = 2j * np.pi * np.asarray(frequency, dtype=float)
        omega = 2 * np.pi * self.frequency
        poles = omega * (-self.damping + 1j * np.sqrt(1.0 - self.damping**2))
        out = self.lower[:, None] / s**2 + self.upper[:, None]
        for p, residue in zip(poles, self.residue.T, strict=True):
            out = out + residue[:, None] / (s - p) + residue.conj()[:, None] / (s - p.conjugate())
        return np.asarray(out, dtype=complex)

    @property
    def collinearity(self) -> Array:
        """Modal phase collinearity: 1 when all points move in phase or in antiphase."""
        return np.array([abs(np.sum(shape**2)) / np.sum(abs(shape) ** 2) for shape in self.residue.T])


def mac(first: NDArray[np.generic], second: NDArray[np.generic]) -> Array:
    """Modal assurance criterion between the columns of two shape matrices.

    Examples
    --------
    >>> mac(np.eye(2), np.array([[1.0, 1.0], [0.0, 1.0]])).round(6).tolist()
    [[1.0, 0.5], [0.0, 0.5]]
    """
    a, b = np.asarray(first, dtype=complex), np.asarray(second, dtype=complex)
    cross = abs(a.conj().T @ b) ** 2
    return cross / np.outer(np.sum(abs(a) ** 2, axis=0), np.sum(abs(b) ** 2, axis=0))


def identify(frfs: Sequence[Frf], count: int | None = None) -> Modes:
    """Identify the modes that a set of frequency responses of one test share.

    Poles come from a stabilisation chart (least-squares complex frequency domain) and are then refined
    together with all residues by weighted least squares, every point weighted by its own error bar; the
    curvature of the fit gives the standard deviations.

    Parameters
    ----------
    frfs : sequence of Frf
        Several responses to one reference at the same frequencies.
    count : int, optional
        Number of modes; those stable over the most orders are kept. Omitted: all stable ones.
    """
    if count is not None and count < 1:
        raise SceneError(f"{count} modes asked for: expected at least 1")
    curves = [frf.to("displacement").sorted() for frf in frfs]
    frequency = curves[0].frequency
    if any(
        curve.frequency.shape != frequency.shape or np.any(curve.frequency != frequency) for curve in curves
    ):
        raise SceneError(
            "the responses were measured at different frequencies: identify one recording at a time"
        )
    if frequency.size < 8:
        raise RecordingError(
            f"{frequency.size} frequencies are too few for modes: measure at least 8, with several in each "
            "resonance"
        )
    value = np.stack([curve.value for curve in curves])
    sigma = _sigma(curves)
    weight = 1.0 / sigma
    # The chart is led by the resonances: absolute weights there, so that noise far from them counts little.
    poles_chart = chart(frequency, value, np.ones_like(weight) / abs(value).max(axis=1, keepdims=True))
    found = stable_poles(poles_chart)
    keep_most = count if count is not None else MOST_MODES
    if len(found) > keep_most:
        times = [sum(abs(p.frequency - f) < 0.01 * f for p in poles_chart if p.stable) for f, _ in found]
        keep = sorted(np.argsort(times, kind="stable")[::-1][:keep_most])
        found = [found[i] for i in keep]
    if not found:
        raise RecordingError(
            "no pole stays stable from order to order: the curves hold no resonance that their noise and "
            "resolution can show; measure more densely around the resonances or longer"
        )
    start = np.array([2 * np.pi * f * (-z + 1j * np.sqrt(1 - z * z)) for f, z in found])
    poles, covariance, residue, ends = _refine(frequency, value, weight, start)
    dropped: list[float] = []
    while poles.size > 1:
        # A pole that the fit drives to no damping, or whose damping it cannot tell, is no mode.
        spread = np.sqrt(np.maximum(np.diag(covariance)[: poles.size], 0.0))
        doubt = spread / -poles.real
        worst = int(np.argmax(doubt))
        if doubt[worst] < 0.5:
            break
        dropped.append(abs(poles[worst]) / (2 * np.pi))
        start = np.delete(start, int(np.argmin(abs(start.imag - poles[worst].imag))))
        poles, covariance, residue, ends = _refine(frequency, value, weight, start)
    # An exponential window moved every pole to the left by its own decay rate.
    poles = poles + curves[0].shift
    if np.any(poles.real >= 0):
        raise RecordingError("the exponential window outweighs the damping: record longer after each hit")
    omega, zeta = abs(poles), -poles.real / abs(poles)
    errors = _pole_errors(poles, covariance)
    result = Modes(
        frequency=np.asarray(omega / (2 * np.pi), dtype=float),
        frequency_error=errors[0],
        damping=zeta,
        damping_error=errors[1],
        residue=residue,
        responses=tuple(curve.response for curve in curves),
        chart=tuple(poles_chart),
        lower=ends[:, 0],
        upper=ends[:, 1],
        label=curves[0].label,
        warnings=(),
    )
    return _with_warnings(result, curves, count, dropped)


def _sigma(curves: Sequence[Frf]) -> Array:
    size = np.stack([abs(curve.value) for curve in curves])
    error = np.stack([curve.error for curve in curves])
    error = np.where(np.isfinite(error), error, 0.01 * np.median(size, axis=1, keepdims=True))
    return np.hypot(error, LEAST_RELATIVE_ERROR * size)


def _columns(s: NDArray[np.complexfloating], poles: ComplexArray) -> ComplexArray:
    """Basis of the modal model for real unknowns: Re R, Im R of each mode, then lower and upper residual."""
    out = []
    for p in poles:
        direct, mirror = 1.0 / (s - p), 1.0 / (s - p.conjugate())
        out += [direct + mirror, 1j * (direct - mirror)]
    return np.stack([*out, 1.0 / s**2, np.ones_like(s)], axis=1)


def _stacked(rows: ComplexArray) -> Array:
    return np.concatenate([rows.real, rows.imag])


class _Projection:
    """Misfit of the best linear unknowns for given poles, and its derivative (variable projection [1]_).

    References
    ----------
    .. [1] L. Kaufman, A variable projection method for solving separable nonlinear least squares problems,
       BIT 15 (1975) 49-57.
    """

    def __init__(self, frequency: Array, value: ComplexArray, weight: Array, start: ComplexArray) -> None:
        self.s = 2j * np.pi * frequency
        self.value, self.weight, self.start = value, weight, start
        self.scale = -start.real

    def poles(self, x: Array) -> ComplexArray:
        """Turn parameters into poles: logarithm of the decay (keeps them stable), frequency in decays."""
        count = self.start.size
        return -self.scale * np.exp(x[:count]) + 1j * (self.start.imag + self.scale * x[count:])

    def solve(self, x: Array) -> tuple[Array, Array, list[Array]]:
        """Best unknowns of every response, weighted misfit, and an orthonormal basis for each response."""
        columns = _columns(self.s, self.poles(x))
        unknown, rest, bases = [], [], []
        for row, scale in zip(self.value, self.weight, strict=True):
            basis, target = _stacked(columns * scale[:, None]), _stacked(row * scale)
            size = np.linalg.norm(basis, axis=0)
            q, r = np.linalg.qr(basis / size)
            unknown.append(np.linalg.solve(r, q.T @ target) / size)
            rest.append(target - q @ (q.T @ target))
            bases.append(q)
        return np.array(unknown), np.concatenate(rest), bases

    def misfit(self, x: Array) -> Array:
        """Weighted misfit."""
        return self.solve(x)[1]

    def jacobian(self, x: Array) -> Array:
        """Differentiate the misfit by the parameters."""
        unknown, _, bases = self.solve(x)
        poles, count = self.poles(x), self.start.size
        out = []
        for row, scale, q in zip(unknown, self.weight, bases, strict=True):
            part = []
            for k, p in enumerate(poles):
                residue = row[2 * k] + 1j * row[2 * k + 1]
                direct, mirror = (
                    residue / (self.s - p) ** 2,
                    residue.conjugate() / (self.s - p.conjugate()) ** 2,
                )
                part.append((p.real * (direct + mirror), 1j * self.scale[k] * (direct - mirror)))
            block = np.stack([_stacked(scale * pair[side]) for side in (0, 1) for pair in part], axis=1)
            out.append(q @ (q.T @ block) - block)
        return np.concatenate(out).reshape(-1, 2 * count)


def _refine(
    frequency: Array, value: ComplexArray, weight: Array, start: ComplexArray
) -> tuple[ComplexArray, Array, ComplexArray, Array]:
    """Weighted nonlinear least squares over the poles; the linear unknowns are solved for inside."""
    problem = _Projection(frequency, value, weight, start)
    fit = optimize.least_squares(
        problem.misfit,
        np.zeros(2 * start.size),
        problem.jacobian,
        xtol=1e-12,
        ftol=1e-12,
        gtol=1e-12,
        max_nfev=60,
    )
    poles = problem.poles(fit.x)
    unknown, rest, _ = problem.solve(fit.x)
    degrees = max(rest.size - unknown.size - fit.x.size, 1)
    spread = max(float(rest @ rest) / degrees, 1.0)
    inverse = np.linalg.pinv(fit.jac.T @ fit.jac) * spread
    jacobian = np.concatenate([-poles.real, problem.scale])
    covariance = inverse * np.outer(jacobian, jacobian)
    order = np.argsort(poles.imag)
    residue = unknown[:, 0 : 2 * start.size : 2] + 1j * unknown[:, 1 : 2 * start.size : 2]
    both = np.concatenate([order, order + start.size])
    return poles[order], covariance[np.ix_(both, both)], residue[:, order], unknown[:, -2:]


def _pole_errors(poles: ComplexArray, covariance: Array) -> tuple[Array, Array]:
    """Turn the covariance of (decay, damped frequency) into errors of frequency [Hz] and damping ratio."""
    count = poles.size
    decay, damped, size = -poles.real, poles.imag, abs(poles)
    f_error, z_error = np.empty(count), np.empty(count)
    for i in range(count):
        block = covariance[np.ix_([i, i + count], [i, i + count])]
        to_f = np.array([decay[i], damped[i]]) / size[i] / (2 * np.pi)
        to_z = np.array([damped[i] ** 2, -decay[i] * damped[i]]) / size[i] ** 3
        # Rounding can leave a variance of nothing slightly below it.
        f_error[i], z_error[i] = (np.sqrt(max(to @ block @ to, 0.0)) for to in (to_f, to_z))
    return f_error, z_error


def _with_warnings(modes: Modes, curves: Sequence[Frf], count: int | None, dropped: list[float]) -> Modes:
    notes: list[str] = []
    if dropped:
        notes.append(
            f"No mode at {', '.join(f'{f:.4g}' for f in sorted(dropped))} Hz, where a pole was stable: its "
            "damping cannot be told from these curves (dampers that strike make peaks without poles)."
        )
    frequency = curves[0].frequency
    if count is not None and len(modes.frequency) < count:
        notes.append(
            f"Only {len(modes.frequency)} of {count} modes are stable; the others are not in these curves."
        )
    for f, zeta, error in zip(modes.frequency, modes.damping, modes.damping_error, strict=True):
        half = zeta * f
        inside = int(np.sum(abs(frequency - f) < 2.0 * half))
        resolution = max(curve.resolution for curve in curves)
        if resolution > SMEARED * half:
            notes.append(
                f"{f:.4g} Hz: the resolution of {resolution:.3g} Hz smears a half-power width of "
                f"{2 * half:.3g} Hz, so that more than 2 % of the damping ratio {zeta:.3%} may be due to that; "
                f"use blocks of at least {1.5 / (SMEARED * half):.3g} s (a sweep so much slower), or burst "
                "random, multisine or stepped sine."
            )
        elif inside < 2:
            notes.append(
                f"{f:.4g} Hz: {inside} measured points lie within one half-power width of {2 * half:.3g} "
                "Hz, so the "
                f"damping ratio rests on the flanks; measure every {half / 2:.2g} Hz there."
            )
        if error > 0.02 * zeta:
            notes.append(
                f"{f:.4g} Hz: damping ratio {zeta:.3%} is uncertain by {error / zeta:.0%} (one standard "
                "deviation)."
            )
    return Modes(**{**modes.__dict__, "warnings": (*curves[0].warnings, *notes)})
