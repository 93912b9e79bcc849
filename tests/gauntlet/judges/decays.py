"""Damping ratio against amplitude of a free decay with a damper, compared with that of the exact motion.

With the damper at rest on the floor the truth is in closed form. In flight it is the slope of the engine's own
maxima over 6 dB around each amplitude, which is how the estimate is defined.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

import analysis
import rig
from rig.arrays import Array
from tests.gauntlet.cavities import DECAY, GRAVITY
from tests.gauntlet.verdict import Case, Verdict

# Sample rate of the exact motion, Hz: the error of a maximum is then 1e-7.
_RATE = 20480.0
# Half of the 6 dB range, in the logarithm of the amplitude.
_HALF_RANGE = 3.0 / 20.0 * np.log(10.0)
# Smallest fraction of the levels within their 95 % intervals.
MIN_COVERAGE = 0.8


def judge(case: Case, kind: str) -> list[Verdict]:
    """Compare the mode of a single body; the points are its levels."""
    if kind != DECAY:
        return []
    decay = analysis.decay(case.recording, channel="a1")
    [mode] = decay.modes
    true = np.array([_damping(level, *_cycle_amplitudes(case.scene), case.scene) for level in mode.amplitude])
    is_known = np.isfinite(true)
    inside = abs(mode.damping - true)[is_known] <= 1.96 * mode.damping_error[is_known]
    worst = float(np.max(abs(mode.damping / true - 1.0)[is_known], initial=0.0))
    outcome = "right" if inside.sum() >= MIN_COVERAGE * inside.size else "warned" if decay.warnings else "wrong"
    bound = float(np.median((1.96 * mode.damping_error / mode.damping)[is_known])) if is_known.any() else np.nan
    note = f"largest error {worst:.2%}, median bound {bound:.2%}" + "".join(f" [{text}]" for text in decay.warnings)
    return [Verdict("decays", kind, outcome, int(inside.sum()), inside.size, note=note)]


def _cycle_amplitudes(scene: rig.Scene) -> tuple[Array, Array, Array]:
    """Return times of the cycles of the displacement, amplitudes (half of peak to peak), and periods."""
    run = rig.simulate(scene, scene.test.duration, _RATE)
    displacement, speed = run.displacement[0], run.velocity[0]
    maxima, minima = (np.flatnonzero((s * speed[:-1] > 0.0) & (s * speed[1:] <= 0.0)) for s in (1.0, -1.0))
    count = min(maxima.size, minima.size)

    def extremes(k: NDArray[np.int64]) -> tuple[Array, Array]:
        offset = speed[k] / (speed[k] - speed[k + 1]) / _RATE
        return run.time[k] + offset, displacement[k] + 0.5 * offset * speed[k]

    (maximum_time, maximum), (minimum_time, minimum) = extremes(maxima[:count]), extremes(minima[:count])
    return 0.5 * (maximum_time + minimum_time), 0.5 * (maximum - minimum), np.gradient(maximum_time)


def _damping(level: float, time: Array, amplitude: Array, period: Array, scene: rig.Scene) -> float:
    """Return the damping ratio at an acceleration amplitude; NaN with fewer than four maxima around it."""
    [damper], ratio = scene.dampers, scene.structure.damping.modal
    if level * np.exp(_HALF_RANGE) < GRAVITY:
        return float(ratio / np.sqrt(1.0 + damper.mass_ratio))
    angular = 2.0 * np.pi / period
    is_in_range = abs(np.log(np.maximum(amplitude * angular**2, 1e-300) / level)) < _HALF_RANGE
    if is_in_range.sum() < 4:
        return float("nan")
    decay_rate = -float(np.polyfit(time[is_in_range], np.log(amplitude[is_in_range]), 1)[0])
    return decay_rate / float(np.mean(angular[is_in_range]))
