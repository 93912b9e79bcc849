"""Frequencies of modes whose resonances form one peak in the spectrum of a free decay.

Method: poles of a signal from the singular vectors of its Hankel matrix (HSVD; H. Barkhuijsen, R. de Beer, D. van
Ormondt, J. Magn. Reson. 73 (1987) 553). Linear modes give the same poles at every sufficient order. The decay of one
mode with a nonlinear damper is not the sum of a few exponentials, so its poles depend on the order.
"""

import numpy as np
import scipy

from rig.core.base.arrays import Array, ComplexArray

# Orders of the two fits that are compared: up to three modes, and one or three poles of noise or of distant modes.
_ORDERS = 4, 6
_MAX_MODES = 3
# Fewer samples than twice the poles of the larger fit in each third of the signal do not determine them.
_MIN_SAMPLES = 36
# The first samples of the signal suffice: the singular value decomposition takes 0.1 s for this number.
_MAX_SAMPLES = 600
# Smallest amplitude of a mode relative to the largest one. Tuned on linear structures: transients of the band-pass and
# distant modes remain below 1 %.
_MIN_AMPLITUDE_RATIO = 0.03
# Largest ratio of the residuals of the two fits for modes without a nonlinear damper. Tuned on the decays of the
# bundled scenes: up to 1.2 without dampers, and 1.4 to 9 with dampers.
_MAX_RESIDUAL_RATIO = 1.5
# Smaller residuals, relative to the signal, are those of the transients of the band-pass; with dampers they are 6e-3.
_MIN_RESIDUAL_RATIO = 1e-6
# Largest ratio of the damping ratios of close modes. Poles of a decay with particle dampers differ by about 6 or more.
_MAX_DAMPING_RATIO = 4.0
# Largest change of a frequency between the two fits, relative to the half-power half-width.
_MAX_FREQUENCY_CHANGE = 0.1
# Smallest ratio of successive samples of an exponential; smaller ones are rounding errors.
_MIN_TURN = 1e-12


def close_modes(baseband: ComplexArray, interval: float, max_offset: float) -> Array:
    """Return the frequencies of two or three close modes relative to the center of a band [Hz]; empty for one mode.

    Parameters
    ----------
    baseband : ndarray, shape (n,)
        Free decay after a band-pass, with the center of the band at 0 Hz.
    interval : float
        Sample interval [s].
    max_offset : float
        Largest distance of the modes from the center of the band [Hz].
    """
    signal = baseband[:_MAX_SAMPLES]
    if signal.size < _MIN_SAMPLES:
        return np.empty(0)
    fits = [_dominant_poles(signal, order, 2.0 * np.pi * interval * max_offset) for order in _ORDERS]
    (poles, residual), (other_poles, other_residual) = fits
    if not 2 <= poles.size <= _MAX_MODES or poles.size != other_poles.size:
        return np.empty(0)
    decay = -poles.real
    max_residual = max(_MAX_RESIDUAL_RATIO * other_residual, _MIN_RESIDUAL_RATIO * abs(signal).max())
    is_linear = residual <= max_residual and decay.max() <= _MAX_DAMPING_RATIO * decay.min()
    change = abs(poles.imag - other_poles.imag)
    if not is_linear or np.any(change > _MAX_FREQUENCY_CHANGE * decay):
        return np.empty(0)
    return np.asarray(poles.imag / (2.0 * np.pi * interval))


def _dominant_poles(signal: ComplexArray, order: int, max_angle: float) -> tuple[ComplexArray, float]:
    """Fit a sum of exponentials; return decaying poles of large amplitude, by frequency, and the rms residual."""
    rows = signal.size - signal.size // 3
    hankel = scipy.linalg.hankel(signal[:rows], signal[rows - 1 :])
    vectors = np.linalg.svd(hankel, full_matrices=False)[0][:, :order]
    turns = np.linalg.eigvals(np.linalg.lstsq(vectors[:-1], vectors[1:])[0])
    # A signal of fewer exponentials than poles has turns of zero.
    poles = np.log(np.where(abs(turns) > _MIN_TURN, turns, _MIN_TURN))
    exponentials = np.exp(np.outer(np.arange(signal.size), np.minimum(poles.real, 0.0) + 1j * poles.imag))
    amplitude = np.linalg.lstsq(exponentials, signal)[0]
    residual = float(np.sqrt(np.mean(abs(signal - exponentials @ amplitude) ** 2)))
    inside = (poles.real < 0.0) & (abs(poles.imag) <= max_angle)
    # Poles of noise have smaller amplitudes than the residual.
    dominant = inside & (abs(amplitude) >= max(_MIN_AMPLITUDE_RATIO * abs(amplitude).max(), residual))
    return poles[dominant][np.argsort(poles[dominant].imag)], residual
