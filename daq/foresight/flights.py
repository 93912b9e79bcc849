"""Dampers in flight during a test, and modes outside its band."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from daq.foresight.linear import test_band, test_frequencies
from daq.foresight.rehearsal import Rehearsal
from rig.arrays import Array
from rig.errors import SceneError
from rig.results import format_frequencies, format_number
from rig.scene.excitation import Sine, SteppedSine, SweptSine
from rig.scene.scene import Scene
from rig.system.hybrid_system import HybridSystem
from rig.system.open_loop_drive import accelerations_per_level
from rig.system.structural_model import structural_model

# Frequencies of a sweep at which the acceleration is compared with gravity.
_POINTS = 400
# Modes that are listed at most.
_LISTED = 5


def onset_level(scene: Scene, system: HybridSystem) -> float:
    """Return the lowest level of a tone or sweep at which a damper leaves its floor; infinite for other tests."""
    accelerations = _at_dampers(scene, system, test_frequencies(scene.test, _POINTS))
    return float(system.gravity / accelerations.max()) if accelerations.max(initial=0.0) > 0.0 else np.inf


def _at_dampers(scene: Scene, system: HybridSystem, frequencies: Array) -> Array:
    """Accelerations under each damper that moves, all on their floors, per unit of level; (dampers, frequencies)."""
    if not system.dampers or not isinstance(scene.test, Sine | SteppedSine | SweptSine):
        return np.zeros((0, 0))
    try:
        return accelerations_per_level(scene, system, 2.0 * np.pi * frequencies)[system.damper_coordinate]
    except SceneError:
        return np.zeros((0, 0))


def flight_lines(
    scene: Scene, system: HybridSystem, level: float, parts: Sequence[Rehearsal]
) -> tuple[str, ...]:
    """State for each moving damper whether it flies, and at which frequencies or time."""
    frequencies = test_frequencies(scene.test, _POINTS)
    above = level * _at_dampers(scene, system, frequencies) > system.gravity
    by_place: dict[str, list[str]] = {}
    for row, number in enumerate(system.damper_number.tolist()):
        strikes = [(part, time) for part in parts for time in part.strikes[number - 1]]
        where = ""
        if above.size:
            # By the linear response, or by an impact in the rehearsal.
            tones = {part.frequency_at(round(time * part.rate)) for part, time in strikes} - {None}
            near = [any(abs(f - tone) < 1e-3 * f for tone in tones if tone) for f in frequencies]
            flags = above[row] | np.array(near)
            where = f" at {format_frequencies(frequencies.tolist(), flags.tolist())}" if flags.any() else ""
        elif strikes:
            where = f" first at {min(time for _, time in strikes):.2f} s"
        by_place.setdefault(where, []).append(f"damper {number} (body {scene.dampers[number - 1].body})")
    lines = []
    for where, names in by_place.items():
        verb, plural = ("flies", "fly") if where else ("stays on its floor", "stay on their floors")
        lines.append(f"{' and '.join(names)} {verb if len(names) == 1 else plural}{where}")
    return tuple(lines)


def outside_band(scene: Scene) -> tuple[str, ...]:
    """List the natural frequencies of the structure outside a test's band."""
    band = test_band(scene.test)
    if band is None or isinstance(scene.test, Sine):
        return ()
    modes = structural_model(scene).modes.frequency
    left = [(k, mode) for k, mode in enumerate(modes.tolist(), 1) if not band[0] <= mode <= band[1]]
    if not left:
        return ()
    listed = ", ".join(f"{k} at {mode:.4g} Hz" for k, mode in left[:_LISTED])
    more = f" and {len(left) - _LISTED} more" if len(left) > _LISTED else ""
    return (f"outside {format_number(band[0])} to {format_number(band[1])} Hz: mode {listed}{more}",)
