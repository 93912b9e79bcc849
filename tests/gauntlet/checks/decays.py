"""Check of decays: damping ratios as functions of amplitude, compared with exact values.

Linear structures are compared with the eigenvalues of their equations of motion. With a damper, the exact damping ratio
has a closed form below 1 g. Above 1 g, the exact ratio at a level is the mean decay rate of the simulated amplitude
within 3 dB of the level, divided by the mean angular frequency. The estimate has this definition.
"""

import numpy as np
from numpy.typing import NDArray

import analysis
import rig
from rig.core.base.arrays import Array
from rig.core.results.uncertainty import expand
from tests.gauntlet.instant_contact import DECAY, GRAVITY
from tests.gauntlet.linear_decays import LINEAR_DECAY, exact_modes
from tests.gauntlet.result import Case, CheckResult, Outcome

# Sample rate of the exact motion, Hz. Interpolated maxima then have a relative error of 1e-7.
_RATE = 20480.0
# Half of the 6 dB range, as natural logarithm of an amplitude ratio.
_HALF_RANGE_NEPER = 3.0 / 20.0 * np.log(10.0)
# The true damping ratio must lie within the 95 % interval at this fraction of the levels or more.
MIN_COVERAGE = 0.8
# Largest error of a value of a linear structure, in 95 % intervals: 5 standard uncertainties, as thousands of values
# are compared.
_MAX_ERROR = 2.5


def check(case: Case, kind: str) -> list[CheckResult]:
    """Compare the damping ratio of the single mode; each amplitude level counts as one point."""
    if kind == LINEAR_DECAY:
        return [_check_channel(case, channel) for channel in case.recording.channels]
    if kind != DECAY:
        return []
    decay = analysis.decay(case.recording, channel="a1")
    [mode] = decay.modes
    cycles = _cycle_amplitudes(case.scene)
    true = np.array([_damping_ratio(level, *cycles, case.scene) for level in mode.amplitude])
    is_known = np.isfinite(true)
    expanded = expand(mode.damping_std)
    inside = (abs(mode.damping - true) <= expanded)[is_known]
    worst = float(np.max(abs(mode.damping / true - 1.0)[is_known], initial=0.0))
    outcome: Outcome = "warned" if decay.warnings else "wrong"
    if inside.sum() >= MIN_COVERAGE * inside.size:
        outcome = "correct"
    bound = float(np.median((expanded / mode.damping)[is_known])) if is_known.any() else np.nan
    note = f"largest error {worst:.2%}, median bound {bound:.2%}" + "".join(f" [{text}]" for text in decay.warnings)
    return [CheckResult("decays", kind, outcome, int(inside.sum()), inside.size, note=note)]


def _check_channel(case: Case, channel: str) -> CheckResult:
    """Compare all modes of a channel: the natural frequency, and the damping ratio at each amplitude."""
    decay = analysis.decay(case.recording, channel=channel)
    frequencies, ratios = exact_modes(case.scene)
    errors = list[float]()
    for mode in decay.modes:
        measured, expanded = (
            np.append(mode.damping, mode.frequency),
            expand(np.append(mode.damping_std, mode.frequency_std)),
        )
        pairs = zip(frequencies, ratios, strict=True)
        # Close modes may differ more in damping than in frequency.
        possible = [(measured - np.append(np.full(mode.damping.size, ratio), f)) / expanded for f, ratio in pairs]
        errors += min(possible, key=lambda each: float(np.nanmax(abs(each), initial=0.0))).tolist()
    errors = [error for error in errors if np.isfinite(error)]
    inside = np.abs(errors) <= 1.0
    outcome: Outcome = "refused"
    if errors:
        # The errors at all amplitudes are related, so the fraction inside is judged over all scenes.
        outcome = "correct" if np.abs(errors).max() < _MAX_ERROR else "wrong"
    note = f"{channel}: largest error {np.abs(errors).max(initial=0.0):.1f} intervals"
    return CheckResult("decays", LINEAR_DECAY, outcome, int(inside.sum()), inside.size, note=note)


def _cycle_amplitudes(scene: rig.Scene) -> tuple[Array, Array, Array]:
    """Return times [s], amplitudes [m] (half of peak to peak) and periods [s] of the cycles of the displacement."""
    run = rig.simulate(scene, scene.test.duration, _RATE)
    displacement, velocity = run.displacement[0], run.velocity[0]
    maxima, minima = (
        np.flatnonzero((sign * velocity[:-1] > 0.0) & (sign * velocity[1:] <= 0.0)) for sign in (1.0, -1.0)
    )
    count = min(maxima.size, minima.size)

    def extremes(k: NDArray[np.int64]) -> tuple[Array, Array]:
        # The velocity is interpolated linearly to its zero after sample k.
        offset = velocity[k] / (velocity[k] - velocity[k + 1]) / _RATE
        return run.time[k] + offset, displacement[k] + 0.5 * offset * velocity[k]

    (maximum_time, maximum), (minimum_time, minimum) = extremes(maxima[:count]), extremes(minima[:count])
    return 0.5 * (maximum_time + minimum_time), 0.5 * (maximum - minimum), np.gradient(maximum_time)


def _damping_ratio(level: float, time: Array, amplitude: Array, period: Array, scene: rig.Scene) -> float:
    """Return the damping ratio at an acceleration amplitude [m/s^2]; NaN with fewer than four cycles around it."""
    [damper], undamped_ratio = scene.dampers, scene.structure.damping.modal
    if level * np.exp(_HALF_RANGE_NEPER) < GRAVITY:
        # The damper adds its mass; damping and stiffness stay the same.
        return float(undamped_ratio / np.sqrt(1.0 + damper.mass_ratio))
    omega = 2.0 * np.pi / period
    is_in_range = abs(np.log(np.maximum(amplitude * omega**2, 1e-300) / level)) < _HALF_RANGE_NEPER
    if is_in_range.sum() < 4:
        return float("nan")
    decay_rate = -float(np.polyfit(time[is_in_range], np.log(amplitude[is_in_range]), 1)[0])
    return decay_rate / float(np.mean(omega[is_in_range]))
