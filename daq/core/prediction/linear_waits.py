"""Predict the waits for the steady state of a series of tones, from the linear response with all dampers riding.

A change of the tone leaves a transient in each mode, which decays freely. The steady state is reached when the sum of
the transients in the amplitude of every controlled or measured quantity is below the tolerance. Where the noise of a
quantity is larger than that, the detector has to average, after a correction of the force.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from daq.core.excitation.stepped_sine import expected_wait, extrapolate_drive
from daq.core.excitation.tones.lock_in import lock_in, whole_periods
from daq.core.excitation.tones.settling import MIN_OBSERVATIONS
from daq.core.excitation.tones.steady_tone import TRANSITION_S, WINDOW_S, Tone
from daq.core.prediction.linear import noise_density, states_per_level
from daq.core.signal_chain.channel import ChannelInfo
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import SceneError
from rig.core.scene.scene import Scene
from rig.core.system.assembly import force_row
from rig.core.system.hybrid_system import HybridSystem
from rig.core.system.open_loop_drive import riding_equations, riding_response

# The tones are represented by this number of samples per period of the highest frequency.
_SAMPLES_PER_PERIOD = 32
# Number of samples of transients that are in memory at a time.
_MAX_TRANSIENT_SAMPLES = 1 << 16
# Number of windows after the end of the transient until the detector has confirmed the steady state.
_CONFIRMING_WINDOWS = 2
# Shortest wait, s: beats of several modes have to be distinguished from noise.
_SHORTEST_WAIT_S = 2.0
# As in `daq.core.excitation.tones.settling`: incoherent changes are noise after this number of windows.
_NOISE_WINDOWS, _MIN_COHERENCE = 24, 0.8
# Noise above this fraction of the tolerance prevents that a few windows agree; the scatter of half of `_NOISE_WINDOWS`
# is averaged up to the second multiple of the tolerance, of all above it.
_FEW_WINDOWS_RATIO, _HALF_OF_WINDOWS_RATIO = 0.12, 3.0
# Number of windows until the force is predictable, with the change of the drive.
_CORRECTION_WINDOWS = MIN_OBSERVATIONS + 3
# Without modes that are this independent, the waits follow from the slowest mode.
_MAX_CONDITION = 1e13


def linear_waits(scene: Scene, system: HybridSystem, channels: Sequence[ChannelInfo]) -> Array:
    """Return the wait before each tone of a test at its highest level, in their order, shape (tones,), s.

    The wait before the first tone, which starts from rest, is assumed to be the mean of the others.
    """
    test = scene.test
    assert test is not None
    tones, steady_state = np.array(test.dwells), test.steady_state
    omega, name = 2.0 * np.pi * tones, scene.at_driven("shaker")
    descriptor, state_matrix, input_vector = riding_equations(system, name)
    poles, shapes = np.linalg.eig(np.linalg.solve(descriptor, state_matrix))
    usual = np.full(tones.size, expected_wait(scene, steady_state.longest))
    try:
        per_drive, (_, gain) = riding_response(system, name, omega), states_per_level(scene, system, tones)
    except SceneError:
        return usual
    if tones.size < 2 or np.linalg.cond(shapes) > _MAX_CONDITION:
        return usual
    to_modes = np.linalg.inv(shapes)
    modal_input = to_modes @ np.linalg.solve(descriptor, input_vector)
    quantities, noise = _quantities(scene, system, channels, tones)
    drive, rate = abs(gain) * max(test.levels), _SAMPLES_PER_PERIOD * float(tones.max())

    in_phase, in_quadrature = (to_modes @ part for part in (per_drive.imag, per_drive.real))

    def modes_at(index: int, amplitude: float, phase: float) -> ComplexArray:
        """Return the modal coordinates in the steady state of a tone at a phase of its drive."""
        parts = in_phase[:, index] * math.cos(phase), in_quadrature[:, index] * math.sin(phase)
        return np.asarray(amplitude * (parts[0] + parts[1]))

    windows = np.array([whole_periods(tone, rate, WINDOW_S) for tone in tones])
    changes = 2 * (np.maximum(round(TRANSITION_S * rate), windows) // 2)
    decay = np.exp(np.outer(poles, np.arange(changes.max() + 1) / rate))
    transients, points = np.zeros((tones.size, poles.size)), list(zip(tones.tolist(), drive.tolist(), strict=True))
    for index in range(1, tones.size):
        samples = changes[index]
        known = points[max(0, index - 3) : index]
        start = extrapolate_drive(known, tones[index]) if scene.controlled_terms else float(drive[index])
        tone = Tone(rate, tones[index - 1])
        tone.amplitude = float(drive[index - 1])
        wave = tone.transition(samples, tones[index], start)
        integrand = np.append(wave, start * np.sin(tone.phase)) * _simpson_weights(samples) / rate
        forced = modal_input * (decay[:, : samples + 1] @ integrand[::-1])
        end = decay[:, samples] * modes_at(index - 1, drive[index - 1], 0.0) + forced
        transients[index] = abs(end - modes_at(index, start, tone.phase))
    transients *= _amplitudes_in_window(poles, tones, np.round(tones * windows / rate).astype(int))
    amplitudes = abs(quantities @ per_drive).T * drive[:, None]
    limits = steady_state.tolerance * amplitudes
    counts = _windows_until(
        abs(quantities @ shapes) * transients[:, None], limits, poles, omega, windows / rate, steady_state.longest
    )
    averaged = _averaged_windows(noise * np.sqrt(2.0 * rate / windows), limits.T)
    # With noise, the force is corrected: its drive is extrapolated from the tones before.
    counts = np.maximum(counts, averaged) + (_CORRECTION_WINDOWS * (averaged > 0) if scene.controlled_terms else 0)
    waits = (changes + (counts + _CONFIRMING_WINDOWS) * windows) / rate
    waits[0] = waits[1:].mean()
    return np.clip(waits, min(_SHORTEST_WAIT_S, steady_state.longest), steady_state.longest)


def _quantities(
    scene: Scene, system: HybridSystem, channels: Sequence[ChannelInfo], tones: Array
) -> tuple[Array, Array]:
    """Return the quantities of the detector as products with the states, and their noise density at the tones.

    Shapes (quantities, states) and (quantities, tones). The first quantity is the controlled force, if any; the others
    are the displacements that channels measure.
    """
    settings = {channel.name: channel for channel in scene.channels or ()}
    rows, noises = [], []
    noise_at: dict[str, Array] = {}
    for info in channels:
        gain = abs(info.response(tones)) * (2.0 * np.pi * tones) ** (info.derivative or 0)
        noise = noise_density(scene, settings.get(info.name), info, tones) / np.maximum(gain, np.finfo(float).tiny)
        noise_at.setdefault(info.at, noise)
        if info.at in system.points and info.derivative is not None:
            rows.append(np.eye(system.states)[system.points.index(info.at)])
            noises.append(noise)
    if scene.controlled_terms:
        rows.insert(0, force_row(scene, system))
        terms = [factor * noise_at.get(at, np.zeros(tones.size)) for at, factor in scene.controlled_terms.items()]
        noises.insert(0, np.sqrt(np.sum(np.square(terms), axis=0)))
    return np.array(rows).reshape(-1, system.states), np.array(noises).reshape(-1, tones.size)


def _averaged_windows(scatter: Array, limits: Array) -> NDArray[np.intp]:
    """Return the number of windows over which the detector averages the noise of any quantity, (tones,).

    `scatter`: standard deviation of the amplitude in a window; `limits`: tolerance; both (quantities, tones).
    """
    ratio = (scatter / np.maximum(limits, np.finfo(float).tiny)).max(axis=0, initial=0.0)
    parts = np.where(ratio > _HALF_OF_WINDOWS_RATIO, _NOISE_WINDOWS, _NOISE_WINDOWS // 2)
    return np.where(ratio > _FEW_WINDOWS_RATIO, parts, 0)


@lru_cache(maxsize=4)
def _simpson_weights(samples: int) -> Array:
    """Return the weights of Simpson's rule over an even number of samples, shape (samples + 1,), in samples."""
    weights = np.where(np.arange(samples + 1) % 2, 4.0, 2.0) / 3.0
    weights[[0, -1]] = 1.0 / 3.0
    return weights


def _amplitudes_in_window(poles: ComplexArray, tones: Array, periods: NDArray[np.intp]) -> Array:
    """Return the amplitude that the lock-in of each tone estimates for each transient of amplitude 1, (tones, poles).

    `periods`: those of each window. Windows of equally many periods have equal weights, whatever their frequency.
    """
    result = np.empty((tones.size, poles.size))
    for count in np.unique(periods):
        equal, samples = np.flatnonzero(periods == count), int(count) * _SAMPLES_PER_PERIOD
        tones_at_once = max(1, _MAX_TRANSIENT_SAMPLES // (samples * poles.size))
        for first in range(0, equal.size, tones_at_once):
            indices = equal[first : first + tones_at_once]
            steps = np.exp(poles / (_SAMPLES_PER_PERIOD * tones[indices, None])).reshape(-1, 1)
            transients = np.cumprod(np.repeat(steps, samples, axis=1), axis=1) / steps
            real, imaginary = lock_in(
                np.concatenate([transients.real, transients.imag]), 1.0, float(_SAMPLES_PER_PERIOD)
            ).reshape(2, -1, poles.size)
            result[indices] = abs(real + 1j * imaginary)
    return result


def _windows_until(
    transients: Array, limits: Array, poles: ComplexArray, omega: Array, window: Array, longest: float
) -> NDArray[np.intp]:
    """Return the number of windows of each tone until the transients are below the limits, by bisection, (tones,).

    `transients`: amplitudes in the first window, (tones, quantities, poles); `limits`: (tones, quantities); `window`:
    duration, s, (tones,); `longest`: limit of the wait, s.
    """
    # Beats of several modes are taken for noise after a number of windows.
    factors = np.exp((poles - 1j * omega[:, None]) * window[:, None])
    powers = (transients * abs(factors**_NOISE_WINDOWS * (factors - 1.0))[:, None]) ** 2
    in_phase = np.einsum("kqp,kp->kq", powers, np.exp(1j * np.angle(factors)))
    is_noise = abs(in_phase) ** 2 / np.maximum(powers.sum(axis=2) ** 2, 1e-280) < _MIN_COHERENCE
    low, high = np.zeros(window.size, dtype=int), (longest / window).astype(int) + 2
    while (low < high).any():
        middle = (low + high) // 2
        change = np.einsum("kqp,kp->kq", transients, np.exp(poles.real * (middle * window)[:, None]))
        is_steady = ((change < limits) | (is_noise & (middle >= _NOISE_WINDOWS)[:, None])).all(axis=1)
        low, high = np.where(is_steady, low, middle + 1), np.where(is_steady, middle, high)
    return low
