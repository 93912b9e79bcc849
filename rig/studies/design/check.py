"""The check of a design: a stepped-sine test around the largest peaks, and its expected results."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rig.core.base.arrays import Array
from rig.core.base.workers import Workers
from rig.core.scene.excitation import FORCE_TOLERANCE
from rig.core.scene.measurement_chain import Channel, Hammer
from rig.core.scene.presets import complete_from_preset
from rig.core.scene.scene import Scene
from rig.core.steady_response.frequency_response import frequency_response
from rig.studies.design.choice import Objective, Trial
from rig.studies.design.worst_peak import Peak

#: Number of successive test frequencies for the motion at a peak, each continued from the previous frequency; the last
#: frequency is that of the peak.
APPROACH_FREQUENCIES = 3
#: A motion is in steady state if it changes by at most this fraction.
STEADY_TOLERANCE = 1e-4
#: The wait for steady state ends after this number of periods.
MAX_WAIT_PERIODS = 2000
#: Number of test frequencies around each peak: enough to resolve it between the points of the search.
POINTS_PER_PEAK = 25
#: The outermost test frequencies differ from the peak by this fraction.
PEAK_HALF_WIDTH = 0.04


@dataclass(frozen=True)
class Expected:
    """Expected measurement at a peak.

    `magnitudes`: minimum, nominal value and maximum of the response over the tolerances of force control and steady
    state. These values are computed with the scene's own shaker, whose coil spring adds harmonics to the force; `peak`
    is for a purely sinusoidal force. They are None if no steady-state motion was reached within `MAX_WAIT_PERIODS`
    periods.
    """

    peak: Peak  # peak as computed by the design
    magnitudes: tuple[float, float, float] | None
    closing_speed: tuple[float, ...]  # largest closing speed of each damper to a wall at the peak [m/s]


def scene_with_check(scene: Scene, trial: Trial, objective: Objective) -> Scene:
    """Return the scene with the dampers of a trial, and a test around the largest peaks with and without dampers."""
    peaks = [*(peak.frequency for peak in trial.peaks), objective.bare_peak.frequency]
    test = {
        "kind": "stepped_sine",
        "frequencies": _frequencies_around(peaks, objective.band).tolist(),
        objective.level.name: list(objective.levels),
        "shaker": None if scene.test is None else scene.test.driven,
    }
    check_scene = scene.replace(dampers=trial.choice.dampers(objective.impact_law), test=test)
    missing = missing_channels(check_scene, trial.peak.body)
    return check_scene.replace(channels=[*(check_scene.channels or ()), *missing]) if missing else check_scene


def missing_channels(scene: Scene, body: int) -> list[Channel]:
    """Return channels that a check needs and the scene lacks: the reference, and the body with the largest peak.

    A force sensor at the shaker is the reference. Without one, a shaker without a coil spring gets one that fills half
    of the converter's range; with a coil spring, the force follows from the displacements of both ends of the spring.
    New motion channels have the sensor and amplifier of the scene's first accelerometer.
    """
    if scene.channels is None:
        return []
    shaker = scene.driven_shaker
    assert shaker is not None
    force_locations = sorted(shaker.force_terms(scene.at_driven("shaker"), scene.at_driven("table")))
    measured_locations = {channel.at for channel in scene.channels}
    reference = force_locations or [scene.at_driven("table")]
    needed_locations = [f"body {body}", *([] if scene.at_driven("shaker") in measured_locations else reference)]
    names = {channel.name for channel in scene.channels}
    template = next((channel for channel in scene.channels if channel.accelerometer is not None), None)
    new_channels = []
    for location in dict.fromkeys(needed_locations):
        if location in measured_locations:
            continue
        name = location.replace("shaker", "force").replace(" ", "")
        name = name if name not in names else f"{name}.check"
        if location.startswith("shaker"):
            converter = None if scene.converter is None else complete_from_preset(scene.converter)
            sensor = None
            if converter is not None and converter.range is not None:
                assert scene.test is not None
                sensor = Hammer(sensitivity=float(f"{0.5 * converter.range / max(scene.test.levels):.2g}"))
            new_channels.append(Channel(name=name, at=location, hammer=sensor))
        else:
            sensors = (None, None) if template is None else (template.accelerometer, template.integrator)
            new_channels.append(Channel(name=name, at=location, accelerometer=sensors[0], integrator=sensors[1]))
    return new_channels


def _frequencies_around(peaks: Sequence[float], band: tuple[float, float]) -> Array:
    """Return ascending frequencies around each peak; where ranges overlap, the frequencies are not closer together."""
    frequencies: list[float] = []
    for peak in sorted(peaks):
        low, high = max(peak * (1.0 - PEAK_HALF_WIDTH), band[0]), min(peak * (1.0 + PEAK_HALF_WIDTH), band[1])
        step = 2.0 * PEAK_HALF_WIDTH * peak / (POINTS_PER_PEAK - 1)
        low = max([low, *(last + step for last in frequencies[-1:])])
        frequencies += np.linspace(low, high, max(1 + round((high - low) / step), 1)).tolist()
    return np.unique([_rounded(frequency) for frequency in [*frequencies, *peaks]])


def _rounded(frequency: float) -> float:
    """Round a frequency to six digits, which resolve a peak with a damping ratio of 0.01 %."""
    return float(f"{frequency:.6g}")


def expected_results(scene: Scene, trial: Trial, workers: Workers) -> tuple[Expected, ...]:
    """Compute the expected results of a check at the largest peak of each level.

    `scene`: as returned by `scene_with_check`; `trial`: the dampers of the scene, and their peaks.
    """
    results = dict(workers.compute(_expected_result, [(scene, peak) for peak in trial.peaks]))
    return tuple(results[number] for number in range(len(trial.peaks)))


def _expected_result(scene_and_peak: tuple[Scene, Peak]) -> Expected:
    scene, peak = scene_and_peak
    test = scene.test
    assert test is not None
    frequencies = [frequency for frequency in test.dwells if frequency <= _rounded(peak.frequency)][
        -APPROACH_FREQUENCIES:
    ]
    magnitudes, closing_speed, is_steady = [], np.zeros(len(scene.dampers)), True
    # Only a force level is controlled, and has a tolerance.
    tolerances = (0.0, -FORCE_TOLERANCE, FORCE_TOLERANCE) if scene.level_key == "force" else (0.0,)
    for deviation in tolerances:
        controlled = scene.replace(channels=None, test=test.at_level((1.0 + deviation) * peak.level))
        response = frequency_response(controlled, frequencies, tolerance=STEADY_TOLERANCE, longest=MAX_WAIT_PERIODS)
        closing_speed = np.maximum(closing_speed, response.closing_speed[: len(scene.dampers), -1])
        is_steady = bool(response.converged[-1])
        if not is_steady:
            break
        magnitudes.append(float(abs(response.frf[peak.body - 1, -1])))
    tolerance = test.steady_state.tolerance
    limits = None
    if is_steady:
        limits = min(magnitudes) * (1.0 - tolerance), magnitudes[0], max(magnitudes) * (1.0 + tolerance)
    return Expected(peak, limits, tuple(closing_speed.tolist()))
