"""Predict at which frequencies dampers leave their floors (fly) in a test, and list the modes outside its band.

A damper leaves its floor if the acceleration of the body exceeds gravity, and a sliding mass slips if it exceeds the
product of friction and gravity.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from daq.core.prediction.linear import test_frequencies
from daq.core.prediction.rehearsal import Rehearsal
from rig.core.base.arrays import Array
from rig.core.base.errors import SceneError
from rig.core.results import format_frequencies, format_number
from rig.core.scene.scene import Scene
from rig.core.system.hybrid_system import HybridSystem
from rig.core.system.open_loop_drive import accelerations_per_level
from rig.core.system.structural_model import structural_model

# Maximum number of modes that a text lists; a longer list would hide the remedy.
_MAX_LISTED_MODES = 5


def onset_level(scene: Scene, system: HybridSystem) -> float:
    """Return the lowest level at which a damper leaves its floor in a tone or sweep; infinite for other tests."""
    accelerations = _acceleration_per_level(scene, system, test_frequencies(scene.test))
    with np.errstate(divide="ignore"):
        levels = system.separation_acceleration[:, None] / accelerations if accelerations.size else accelerations
    return float(levels.min(initial=np.inf))


def _acceleration_per_level(scene: Scene, system: HybridSystem, frequencies: Array) -> Array:
    """Return the acceleration amplitude under resting dampers per level [m/s²]; (dampers, frequencies) or empty."""
    if not system.dampers or scene.test is None or not scene.test.single_tone:
        return np.zeros((0, 0))
    try:
        return accelerations_per_level(scene, system, 2.0 * np.pi * frequencies)[system.damper_coordinate]
    except SceneError:
        return np.zeros((0, 0))


def flying_tones(scene: Scene, system: HybridSystem, level: float, tones: Array) -> NDArray[np.bool_]:
    """Return for each tone [Hz] whether the linear response makes a damper fly; `level`: level of the tones."""
    accelerations = level * _acceleration_per_level(scene, system, tones)
    if not accelerations.size:
        return np.zeros(tones.size, dtype=bool)
    return np.asarray((accelerations > system.separation_acceleration[:, None]).any(axis=0))


def flight_lines(scene: Scene, system: HybridSystem, level: float, rehearsals: Sequence[Rehearsal]) -> tuple[str, ...]:
    """Return lines that state for each damper whether, where and when it flies in `rehearsals` of the test."""
    frequencies = test_frequencies(scene.test)
    accelerations = level * _acceleration_per_level(scene, system, frequencies)
    exceeds_gravity = accelerations > (system.separation_acceleration[:, None] if accelerations.size else np.inf)
    names_by_range: dict[tuple[str, bool], list[str]] = {}
    for row, number in enumerate(system.damper_number.tolist()):
        if np.isinf(system.separation_acceleration[row]):
            continue
        impacts = [(rehearsal, time) for rehearsal in rehearsals for time in rehearsal.impact_times[number - 1]]
        flight_range = ""
        if exceeds_gravity.size:
            # A damper flies where the linear response exceeds gravity, or where a rehearsal contains an impact.
            at_impacts = {rehearsal.frequency_at(round(time * rehearsal.rate)) for rehearsal, time in impacts} - {None}
            has_impact = [any(abs(f - tone) < 1e-3 * f for tone in at_impacts if tone) for f in frequencies]
            flies = exceeds_gravity[row] | np.array(has_impact)
            flight_range = f" at {format_frequencies(frequencies.tolist(), flies.tolist())}" if flies.any() else ""
        elif impacts:
            flight_range = f" first at {min(time for _, time in impacts):.2f} s"
        damper = scene.dampers[number - 1]
        key = flight_range, damper.friction is not None
        names_by_range.setdefault(key, []).append(f"damper {number} ({scene.structure.label(damper.body)})")
    lines = []
    for (flight_range, slides), names in names_by_range.items():
        verb, plural = ("slips", "slip") if slides else ("flies", "fly")
        if not flight_range:
            verb, plural = ("sticks", "stick") if slides else ("stays on its floor", "stay on their floors")
        lines.append(f"{' and '.join(names)} {verb if len(names) == 1 else plural}{flight_range}")
    return tuple(lines)


def outside_band(scene: Scene) -> tuple[str, ...]:
    """Return a line of text with the natural frequencies outside the test's band; empty if there are none."""
    band = None if scene.test is None else scene.test.band
    if band is None or band[0] == band[1]:
        return ()
    modes = structural_model(scene).modes.frequency
    modes_outside = [(k, mode) for k, mode in enumerate(modes.tolist(), 1) if not band[0] <= mode <= band[1]]
    if not modes_outside:
        return ()
    listed = ", ".join(f"{k} at {mode:.4g} Hz" for k, mode in modes_outside[:_MAX_LISTED_MODES])
    remainder = f" and {len(modes_outside) - _MAX_LISTED_MODES} more" if len(modes_outside) > _MAX_LISTED_MODES else ""
    return (f"outside {format_number(band[0])} to {format_number(band[1])} Hz: mode {listed}{remainder}",)
