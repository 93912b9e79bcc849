"""Predict the waits for the steady state of a series of tones, from the linear response with all dampers riding.

A change of the tone leaves a transient in each mode, which decays freely. The steady state is reached when the sum of
the transients in the amplitude of every controlled or measured quantity is below the tolerance.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from daq.core.excitation.stepped_sine import expected_wait, extrapolate_drive
from daq.core.excitation.tones.lock_in import lock_in, whole_periods
from daq.core.excitation.tones.steady_tone import TRANSITION_S, WINDOW_S, Tone
from daq.core.prediction.linear import states_per_level
from daq.core.signal_chain.channel import ChannelInfo
from rig.core.base.arrays import Array
from rig.core.base.errors import SceneError
from rig.core.scene.scene import Scene
from rig.core.system.assembly import force_row
from rig.core.system.hybrid_system import HybridSystem
from rig.core.system.open_loop_drive import riding_equations, riding_response

# The tones are represented by this number of samples per period of the highest frequency.
_SAMPLES_PER_PERIOD = 32
# Number of windows after the end of the transient until the detector has confirmed the steady state.
_CONFIRMING_WINDOWS = 2
# Shortest wait, s: beats of several modes have to be distinguished from noise.
_SHORTEST_WAIT_S = 2.0
# As in `daq.core.excitation.tones.settling`: incoherent changes are noise after this number of windows.
_NOISE_WINDOWS, _MIN_COHERENCE = 24, 0.8
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
    rows = [
        system.points.index(info.at) for info in channels if info.at in system.points and info.derivative is not None
    ]
    quantities = np.eye(system.states)[rows]
    if scene.controlled_terms:
        quantities = np.concatenate([force_row(scene, system)[None], quantities])
    drive, rate = abs(gain) * max(test.levels), _SAMPLES_PER_PERIOD * float(tones.max())

    def modes_at(index: int, amplitude: float, phase: float) -> Array:
        """Return the modal coordinates in the steady state of a tone at a phase of its drive."""
        return np.asarray(to_modes @ np.imag(per_drive[:, index] * amplitude * np.exp(1j * phase)))

    waits = np.empty(tones.size)
    lengths = [whole_periods(tone, rate, WINDOW_S) for tone in tones]
    # All transients decay by the same factors; the exponentials take most of the time.
    decay = np.exp(np.outer(poles, np.arange(max(*lengths, round(TRANSITION_S * rate)) + 1) / rate))
    decay_parts = np.concatenate([decay.real, decay.imag])
    for index in range(1, tones.size):
        window = lengths[index]
        samples = 2 * (max(round(TRANSITION_S * rate), window) // 2)
        known = [(tones[k], drive[k]) for k in range(max(0, index - 3), index)]
        start = extrapolate_drive(known, tones[index]) if scene.controlled_terms else float(drive[index])
        tone = Tone(rate, tones[index - 1])
        tone.amplitude = float(drive[index - 1])
        wave = tone.transition(samples, tones[index], start)
        # Simpson's rule.
        weights = np.where(np.arange(samples + 1) % 2, 4.0, 2.0)
        weights[[0, -1]] = 1.0
        integrand = np.append(wave, start * np.sin(tone.phase)) * weights / (3.0 * rate)
        forced = modal_input * (decay[:, : samples + 1] @ integrand[::-1])
        end = decay[:, samples] * modes_at(index - 1, drive[index - 1], 0.0) + forced
        transient = abs(end - modes_at(index, start, tone.phase))
        real, imaginary = np.split(lock_in(decay_parts[:, :window], tones[index], rate), 2)
        in_window = abs(real + 1j * imaginary)
        amplitudes = abs(quantities @ per_drive[:, index]) * drive[index]
        windows = np.arange(int(steady_state.longest * rate / window) + 2)
        remaining = abs(quantities @ shapes) * (transient * in_window)
        change = remaining @ np.exp(np.outer(poles.real, windows * window / rate))
        # Beats of several modes are taken for noise after a number of windows.
        factors = np.exp((poles - 1j * omega[index]) * window / rate)
        powers = (remaining * abs(factors**_NOISE_WINDOWS * (factors - 1.0))) ** 2
        coherence = abs(powers @ np.exp(1j * np.angle(factors))) ** 2 / np.maximum(powers.sum(axis=1) ** 2, 1e-280)
        is_noise = (coherence < _MIN_COHERENCE)[:, None] & (windows >= _NOISE_WINDOWS)
        is_steady = ((change < steady_state.tolerance * amplitudes[:, None]) | is_noise).all(axis=0)
        count = int(np.argmax(is_steady)) if is_steady.any() else windows.size
        waits[index] = (samples + (count + _CONFIRMING_WINDOWS) * window) / rate
    waits[0] = waits[1:].mean()
    return np.clip(waits, min(_SHORTEST_WAIT_S, steady_state.longest), steady_state.longest)
