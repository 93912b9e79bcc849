"""A test that checks a design on the rig, and its expected results."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rig.arrays import Array
from rig.damper_design.choice import Question, Trial
from rig.damper_design.worst_peak import Peak
from rig.scene.excitation import FORCE_TOLERANCE, SteppedSine
from rig.scene.measurement_chain import Channel, Hammer
from rig.scene.presets import complete_from_preset
from rig.scene.scene import Scene
from rig.scene.shaker import ForceShaker
from rig.steady_response.frequency_response import frequency_response

#: Number of test frequencies through which the motion is continued up to a peak.
APPROACH = 3
#: Relative distance at which a motion counts as steady.
NEAR = 1e-4
#: Longest wait for steady motion, periods.
LONGEST = 2000
#: Number of test frequencies around each peak.
POINTS = 25
#: Distance of the outermost points from the peak, relative.
REACH = 0.04


@dataclass(frozen=True)
class Expected:
    """Expected measurement at a peak.

    `sizes`: compliance with the scene's own shaker, whose spring adds harmonics to the force, m/N: minimum, nominal
    value and maximum over the tolerances of force control and steady state. None if no steady motion was reached
    within `LONGEST` periods.
    """

    peak: Peak  # as computed by the design, under a purely sinusoidal force
    sizes: tuple[float, float, float] | None
    closing_speed: tuple[float, ...]  # largest approach speed of each damper to a wall at the peak, m/s


def check(scene: Scene, trial: Trial, question: Question) -> Scene:
    """Add dampers to a scene, with a test around the largest peaks with and without them at every level."""
    peaks = [*(peak.frequency for peak in trial.peaks), question.bare.frequency]
    test = {
        "kind": "stepped_sine",
        "frequencies": _around(peaks, question.band).tolist(),
        "force": list(question.levels),
        "shaker": getattr(scene.test, "shaker", None),
    }
    checked = scene.replace(dampers=trial.choice.dampers(question.landings), test=test)
    missing = missing_channels(checked, trial.peak.body)
    return checked.replace(channels=[*(checked.channels or ()), *missing]) if missing else checked


def missing_channels(scene: Scene, body: int) -> list[Channel]:
    """Return channels that a check needs and the scene lacks: the force, and the body with the largest peak.

    The force is measured directly, or from the displacements of both ends of the coil spring. New channels have the
    sensor and amplifier of the scene's first accelerometer, or a force sensor whose output fills half of the
    converter's range.
    """
    if scene.channels is None:
        return []
    shaker = scene.driven_shaker
    assert shaker is not None
    needed = [f"body {body}"]
    if isinstance(shaker, ForceShaker):
        needed.append(scene.at_driven("shaker"))
    else:
        needed += [f"body {shaker.bodies[0]}", scene.at_driven("table")]
    present = {channel.at for channel in scene.channels}
    names = {channel.name for channel in scene.channels}
    like = next((channel for channel in scene.channels if channel.accelerometer is not None), None)
    found = []
    for at in dict.fromkeys(needed):
        if at in present:
            continue
        name = at.replace("shaker", "force").replace(" ", "")
        name = name if name not in names else f"{name}.check"
        if at.startswith("shaker"):
            converter = None if scene.converter is None else complete_from_preset(scene.converter)
            sensor = None
            if converter is not None and converter.range is not None:
                assert isinstance(scene.test, SteppedSine)
                sensor = Hammer(sensitivity=float(f"{0.5 * converter.range / max(scene.test.levels):.2g}"))
            found.append(Channel(name=name, at=at, hammer=sensor))
        else:
            sensors = (None, None) if like is None else (like.accelerometer, like.integrator)
            found.append(Channel(name=name, at=at, accelerometer=sensors[0], integrator=sensors[1]))
    return found


def _around(peaks: Sequence[float], band: tuple[float, float]) -> Array:
    """Frequencies around each peak, rising; overlapping ranges are merged without a finer step."""
    frequencies: list[float] = []
    for peak in sorted(peaks):
        low, high = max(peak * (1.0 - REACH), band[0]), min(peak * (1.0 + REACH), band[1])
        step = 2.0 * REACH * peak / (POINTS - 1)
        low = max([low, *(last + step for last in frequencies[-1:])])
        frequencies += np.linspace(low, high, max(1 + round((high - low) / step), 1)).tolist()
    return np.unique([*frequencies, *peaks])


def expected(scene: Scene, trial: Trial) -> tuple[Expected, ...]:
    """Describe what a check should measure at the largest peak of each level.

    `scene`: as returned by `check`; `trial`: the dampers of the scene, and their peaks.
    """
    assert isinstance(scene.test, SteppedSine)
    return tuple(_expected(scene, scene.test, peak) for peak in trial.peaks)


def _expected(scene: Scene, test: SteppedSine, peak: Peak) -> Expected:
    frequencies = [frequency for frequency in test.order if frequency <= peak.frequency][-APPROACH:]
    sizes, closing_speed, steady = [], np.zeros(len(scene.dampers)), True
    for share in (1.0, 1.0 - FORCE_TOLERANCE, 1.0 + FORCE_TOLERANCE):
        held = scene.replace(channels=None, test=test.replace(force=share * peak.level))
        response = frequency_response(held, frequencies, tolerance=NEAR, longest=LONGEST)
        closing_speed = np.maximum(closing_speed, response.closing_speed[:, -1])
        steady = bool(response.converged[-1])
        if not steady:
            break
        sizes.append(float(abs(response.compliance[peak.body - 1, -1])))
    unsteady = test.settle.tolerance
    found = (min(sizes) * (1.0 - unsteady), sizes[0], max(sizes) * (1.0 + unsteady)) if steady else None
    return Expected(peak, found, tuple(closing_speed.tolist()))
