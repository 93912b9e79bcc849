"""Predict at which frequencies dampers leave their floors (fly) in a test, and list the modes outside its band.

A damper leaves its floor if the acceleration of the body exceeds gravity, and a sliding mass slips if it exceeds the
product of friction and gravity.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from daq.core.prediction.linear import test_frequencies
from daq.core.prediction.rehearsal import Rehearsal
from rig.core.base.arrays import Array
from rig.core.base.errors import SceneError
from rig.core.numerics.runs import runs_of
from rig.core.results import format_frequencies, format_number
from rig.core.scene.excitation import Test
from rig.core.scene.excitation.stepped_sine import SteppedTest
from rig.core.scene.scene import Scene
from rig.core.system.hybrid_system import HybridSystem
from rig.core.system.open_loop_drive import damper_accelerations
from rig.core.system.structural_model import structural_model

# Maximum number of modes that a text lists; a longer list would hide the remedy.
_MAX_LISTED_MODES = 5
# Relative spacing of the frequencies between points: a quarter of the half-power width of a mode with 0.2 % damping.
_GRID_STEP = 1e-3
# Maximum number of these frequencies, to limit the time.
_MAX_GRID_POINTS = 20_000


def onset_level(scene: Scene, system: HybridSystem) -> float:
    """Return the lowest level at which a damper leaves its floor in a tone or sweep; infinite for other tests."""
    loadings = _loadings_per_level(scene, system, test_frequencies(scene.test))
    with np.errstate(divide="ignore"):
        return float((1.0 / loadings).min(initial=np.inf))


def _loadings_per_level(scene: Scene, system: HybridSystem, frequencies: Array) -> Array:
    """Return accelerations of resting dampers per level, relative to separation; (dampers, frequencies) or empty."""
    if not system.dampers or scene.test is None or not scene.test.single_tone:
        return np.zeros((0, 0))
    try:
        accelerations = damper_accelerations(scene, system, 2.0 * np.pi * frequencies)
    except SceneError:
        return np.zeros((0, 0))
    return np.asarray(accelerations / system.separation_acceleration[:, None])


def flying_tones(scene: Scene, system: HybridSystem, level: float, tones: Array) -> NDArray[np.bool_]:
    """Return for each tone [Hz] whether the linear response makes a damper fly; `level`: level of the tones."""
    loadings = level * _loadings_per_level(scene, system, tones)
    return np.asarray((loadings > 1.0).any(axis=0)) if loadings.size else np.zeros(tones.size, dtype=bool)


def flight_lines(scene: Scene, system: HybridSystem, level: float, rehearsals: Sequence[Rehearsal]) -> tuple[str, ...]:
    """Return lines that state for each damper whether, where and when it flies in `rehearsals` of the test.

    Flights in a steady state, flights in the waits before it, and flights between the points of a stepped sine are
    stated separately.
    """
    test, frequencies = scene.test, test_frequencies(scene.test)
    loadings = level * _loadings_per_level(scene, system, frequencies)
    grid = _grid_between(test, frequencies) if loadings.size else frequencies[:0]
    grid_loadings = level * _loadings_per_level(scene, system, grid)
    names_by_text: dict[tuple[str, bool], list[str]] = {}
    for row, number in enumerate(system.damper_number.tolist()):
        if np.isinf(system.separation_acceleration[row]):
            continue
        phrases, remedy = [], ""
        if loadings.size:
            is_steady, is_transient = _flights_at(frequencies, loadings[row] > 1.0, number - 1, rehearsals)
            if is_steady.any():
                phrases.append(f"at {format_frequencies(frequencies.tolist(), is_steady.tolist())}")
            if is_transient.any():
                tones = format_frequencies(frequencies.tolist(), is_transient.tolist())
                phrases.append(f"only before the steady state at {tones}")
            if grid.size and isinstance(test, SteppedTest):
                is_between = _without_points(grid_loadings[row] > 1.0, np.isin(grid, frequencies))
                if bands := runs_of(is_between):
                    phrases.append(f"between points at {format_frequencies(grid.tolist(), is_between.tolist())}")
                    remedy = ". " + test.remedy_between([(grid[first - 1], grid[stop]) for first, stop in bands])
        elif times := [time for rehearsal in rehearsals for time in rehearsal.impact_times[number - 1]]:
            phrases.append(f"first at {min(times):.2f} s")
        damper = scene.dampers[number - 1]
        key = "; ".join(phrases) + remedy, damper.friction is not None
        names_by_text.setdefault(key, []).append(f"damper {number} ({scene.structure.label(damper.body)})")
    lines = []
    for (text, slides), names in names_by_text.items():
        verb, plural = ("slips", "slip") if slides else ("flies", "fly")
        if not text:
            verb, plural = ("sticks", "stick") if slides else ("stays on its floor", "stay on their floors")
        lines.append(f"{' and '.join(names)} {verb if len(names) == 1 else plural} {text}".rstrip())
    return tuple(lines)


def _flights_at(
    frequencies: Array, is_predicted: NDArray[np.bool_], damper: int, rehearsals: Sequence[Rehearsal]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return at which frequencies a damper flies in the measurement, and where it flies only in the wait before it.

    A rehearsed measurement replaces the linear prediction. `damper`: index of the damper in the scene.
    """
    is_steady, is_transient = is_predicted.copy(), np.zeros(frequencies.size, dtype=bool)

    def index_of(frequency: float | None) -> int:
        return 0 if frequency is None else int(np.argmin(abs(frequencies - frequency)))

    for rehearsal in rehearsals:
        measured = [index_of(step.frequency) for step in rehearsal.steps if step.is_measurement and step.is_evaluated]
        is_steady[measured] = False
    for rehearsal in rehearsals:
        for time in rehearsal.impact_times[damper]:
            sample = round(time * rehearsal.rate)
            flights = is_steady if rehearsal.is_measured(sample) else is_transient
            flights[index_of(rehearsal.frequency_at(sample))] = True
    return is_steady, is_transient & ~is_steady


def _grid_between(test: Test | None, tones: Array) -> Array:
    """Return the tones of a stepped sine and frequencies between them, ascending [Hz]; empty for other tests."""
    if not isinstance(test, SteppedTest) or tones.size < 2:
        return tones[:0]
    points = min(_MAX_GRID_POINTS, math.ceil(math.log(tones[-1] / tones[0]) / _GRID_STEP))
    return np.union1d(tones, np.geomspace(tones[0], tones[-1], points))


def _without_points(flags: NDArray[np.bool_], is_point: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the flags without the runs that contain a point."""
    remaining = flags.copy()
    for first, stop in runs_of(flags):
        remaining[first:stop] &= not is_point[first:stop].any()
    return remaining


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
