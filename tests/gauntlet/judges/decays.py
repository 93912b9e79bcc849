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
_HALF = 3.0 / 20.0 * np.log(10.0)
FEWEST_INSIDE = 0.8


def judge(case: Case, kind: str) -> list[Verdict]:
    """Compare the mode of a single body; the points are its levels."""
    if kind != DECAY:
        return []
    decay = analysis.decay(case.recording, channel="a1")
    [mode] = decay.modes
    true = np.array([_damping(level, *_maxima(case.scene), case.scene) for level in mode.amplitude])
    known = np.isfinite(true)
    inside = abs(mode.damping - true)[known] <= 1.96 * mode.damping_error[known]
    worst = float(np.max(abs(mode.damping / true - 1.0)[known], initial=0.0))
    outcome = (
        "right" if inside.sum() >= FEWEST_INSIDE * inside.size else "warned" if decay.warnings else "wrong"
    )
    bound = float(np.median((1.96 * mode.damping_error / mode.damping)[known])) if known.any() else np.nan
    note = f"largest error {worst:.2%}, median bound {bound:.2%}" + "".join(
        f" [{text}]" for text in decay.warnings
    )
    return [Verdict("decays", kind, outcome, int(inside.sum()), inside.size, note=note)]


def _maxima(scene: rig.Scene) -> tuple[Array, Array, Array]:
    """Times of the maxima of the displacement, amplitudes (half of peak to peak), and periods."""
    run = rig.simulate(scene, scene.test.duration, _RATE)
    place, speed = run.displacement[0], run.velocity[0]
    tops, lows = (np.flatnonzero((s * speed[:-1] > 0.0) & (s * speed[1:] <= 0.0)) for s in (1.0, -1.0))
    count = min(tops.size, lows.size)

    def turning(k: NDArray[np.int64]) -> tuple[Array, Array]:
        part = speed[k] / (speed[k] - speed[k + 1]) / _RATE
        return run.time[k] + part, place[k] + 0.5 * part * speed[k]

    (top_time, top), (low_time, low) = turning(tops[:count]), turning(lows[:count])
    return 0.5 * (top_time + low_time), 0.5 * (top - low), np.gradient(top_time)


def _damping(level: float, time: Array, swing: Array, period: Array, scene: rig.Scene) -> float:
    """Damping ratio at an acceleration amplitude; NaN with fewer than four maxima around it."""
    [damper], ratio = scene.dampers, scene.structure.damping.modal
    if level * np.exp(_HALF) < GRAVITY:
        return float(ratio / np.sqrt(1.0 + damper.mass_ratio))
    angular = 2.0 * np.pi / period
    around = abs(np.log(np.maximum(swing * angular**2, 1e-300) / level)) < _HALF
    if around.sum() < 4:
        return float("nan")
    fall = -float(np.polyfit(time[around], np.log(swing[around]), 1)[0])
    return fall / float(np.mean(angular[around]))
