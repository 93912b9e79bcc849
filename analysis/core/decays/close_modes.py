"""Modes whose resonances form one peak in the spectrum of a free decay.

Method: poles of a signal from the singular vectors of its Hankel matrix (HSVD; H. Barkhuijsen, R. de Beer, D. van
Ormondt, J. Magn. Reson. 73 (1987) 553). Linear modes give the same poles at every sufficient order. The decay of one
mode with a nonlinear damper is not the sum of a few exponentials, so its poles depend on the order.
"""

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from rig.core.base.arrays import Array, ComplexArray

# Orders of the two fits that are compared: up to three modes, and one or three poles of noise or of distant modes.
_ORDERS = 4, 6
_MAX_MODES = 3
# Fewer samples than twice the poles of the larger fit in each third of the signal do not determine them.
_MIN_SAMPLES = 36
# The first samples of the signal suffice: the singular value decomposition takes 0.1 s for this number.
_MAX_SAMPLES = 600
# Smallest amplitude of a mode with a decay of its own, relative to the largest one. Tuned on linear structures:
# transients of the band-pass and distant modes remain below 1 %.
_MIN_AMPLITUDE_RATIO = 0.03
# Largest ratio of the residuals of the two fits for modes without a nonlinear damper. Tuned on the decays of the
# bundled scenes: up to 1.2 without dampers, and 1.4 to 9 with dampers.
_MAX_RESIDUAL_RATIO = 1.5
# Smaller residuals, relative to the signal, are those of the transients of the band-pass; with dampers they are 6e-3.
_MIN_RESIDUAL_RATIO = 1e-6
# Largest ratio of the damping ratios of close modes. Poles of a decay with particle dampers differ by about 6 or more.
_MAX_DAMPING_RATIO = 4.0
# Largest change of a mode's frequency between the two fits, relative to the half-power half-width.
_MAX_FREQUENCY_CHANGE = 0.1
# The same for a large mode that is too inaccurate for a decay of its own, but disturbs another one.
_MAX_CHANGE_OF_OVERLAP = 1.0
# Smallest ratio of successive samples of an exponential; smaller ones are rounding errors.
_MIN_TURN = 1e-12


@dataclass(frozen=True)
class Poles:
    """Decaying exponentials of which a band of a linear free decay consists; none if the decay is not linear."""

    rate: ComplexArray  # relative to the center of the band, shape (n,) [rad per sample]
    amplitude: Array  # at the first sample, shape (n,) [unit of the signal]
    is_mode: NDArray[np.bool_]  # modes with decays of their own: two, three or none, shape (n,)
    residual: float  # rms of the signal minus the exponentials [unit of the signal]

    def strongest(self) -> "Poles":
        """Return the pole of the largest amplitude as that of a single mode."""
        first = np.argsort(-self.amplitude)[:1]
        return Poles(self.rate[first], self.amplitude[first], np.zeros(first.size, dtype=bool), self.residual)


_NO_POLES = Poles(np.empty(0, dtype=complex), np.empty(0), np.empty(0, dtype=bool), 0.0)


def close_poles(baseband: ComplexArray, max_angle: float) -> Poles:
    """Return the poles of a free decay after a band-pass, with the center of the band at 0 Hz.

    `max_angle`: largest angular frequency of a pole relative to the center of the band [rad per sample].
    """
    signal = baseband[:_MAX_SAMPLES]
    if signal.size < _MIN_SAMPLES:
        return _NO_POLES
    fits = [_decaying_poles(signal, order, max_angle) for order in _ORDERS]
    (rate, amplitude, residual), (other_rate, other_amplitude, other_residual) = fits
    max_residual = max(_MAX_RESIDUAL_RATIO * other_residual, _MIN_RESIDUAL_RATIO * abs(signal).max())
    if residual > max_residual or not other_rate.size:
        return _NO_POLES
    change = abs(rate.imag[:, None] - other_rate.imag).min(axis=1)
    is_stable = change <= _MAX_FREQUENCY_CHANGE * -rate.real
    is_large = amplitude >= _MIN_AMPLITUDE_RATIO * amplitude.max(initial=0.0)
    other_is_large = other_amplitude >= _MIN_AMPLITUDE_RATIO * other_amplitude.max()
    is_found = is_stable | is_large & (change <= _MAX_CHANGE_OF_OVERLAP * -rate.real)
    decay_rate = -rate.real[is_large]
    are_modes = (
        2 <= decay_rate.size <= _MAX_MODES
        and decay_rate.size == other_is_large.sum()
        and is_stable[is_large].all()
        and decay_rate.max() <= _MAX_DAMPING_RATIO * decay_rate.min()
    )
    return Poles(rate[is_found], amplitude[is_found], np.asarray(is_large & are_modes)[is_found], residual)


def _decaying_poles(signal: ComplexArray, order: int, max_angle: float) -> tuple[ComplexArray, Array, float]:
    """Fit a sum of exponentials; return decaying poles and their amplitudes, by frequency, and the rms residual."""
    rows = signal.size - signal.size // 3
    hankel = scipy.linalg.hankel(signal[:rows], signal[rows - 1 :])
    vectors = np.linalg.svd(hankel, full_matrices=False)[0][:, :order]
    turns = np.linalg.eigvals(np.linalg.lstsq(vectors[:-1], vectors[1:])[0])
    # A signal of fewer exponentials than poles has turns of zero.
    poles = np.log(np.where(abs(turns) > _MIN_TURN, turns, _MIN_TURN))
    exponentials = np.exp(np.outer(np.arange(signal.size), np.minimum(poles.real, 0.0) + 1j * poles.imag))
    amplitude = np.linalg.lstsq(exponentials, signal)[0]
    residual = float(np.sqrt(np.mean(abs(signal - exponentials @ amplitude) ** 2)))
    # Poles of noise have smaller amplitudes than the residual.
    kept = np.flatnonzero((poles.real < 0.0) & (abs(poles.imag) <= max_angle) & (abs(amplitude) >= residual))
    kept = kept[np.argsort(poles.imag[kept])]
    return poles[kept], np.abs(amplitude[kept]), residual
