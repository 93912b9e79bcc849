"""Predict at which frequencies dampers and joints act in a test, and list the modes outside its band.

A bed leaves its floor (flies) if its acceleration exceeds gravity, and a sliding mass slips if it exceeds the product
of friction and gravity. A mass on a spring hits a wall, a stop closes and a friction joint slips at a displacement.
"""

import math
from collections.abc import Sequence
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from daq.core.prediction.linear import test_frequencies
from daq.core.prediction.rehearsal import Rehearsal
from rig.core.base.arrays import Array
from rig.core.base.errors import SceneError
from rig.core.numerics.runs import runs_of
from rig.core.results import format_frequencies, format_number
from rig.core.scene.excitation import Test
from rig.core.scene.scene import Scene
from rig.core.system.hybrid_system import Element, HybridSystem
from rig.core.system.open_loop_drive import loadings_per_level
from rig.core.system.structural_model import structural_model

# Maximum number of modes that a text lists; a longer list would hide the remedy.
_MAX_LISTED_MODES = 5
# Relative spacing of the frequencies between points: a quarter of the half-power width of a mode with 0.2 % damping.
_GRID_STEP = 1e-3
# Maximum number of these frequencies, to limit the time.
_MAX_GRID_POINTS = 20_000


def onset_level(scene: Scene, system: HybridSystem) -> float:
    """Return the lowest level at which a damper or joint acts in a tone or sweep; infinite for other tests."""
    loadings = _loadings_per_level(scene, system, test_frequencies(scene.test))
    with np.errstate(divide="ignore"):
        return float((1.0 / loadings).min(initial=np.inf))


def _loadings_per_level(scene: Scene, system: HybridSystem, frequencies: Array) -> Array:
    """Return loadings of dampers and joints in linear motion, see `loadings_per_level`; (elements, frequencies)."""
    test = scene.test
    if test is None or not test.single_tone or not test.levels or not system.elements:
        return np.zeros((0, 0))
    try:
        return loadings_per_level(scene, system, 2.0 * np.pi * frequencies)
    except SceneError:
        return np.zeros((0, 0))


def flying_tones(scene: Scene, system: HybridSystem, level: float, tones: Array) -> NDArray[np.bool_]:
    """Return for each tone [Hz] whether the linear response makes a damper or joint act; `level`: of the tones."""
    loadings = level * _loadings_per_level(scene, system, tones)
    return np.asarray((loadings > 1.0).any(axis=0)) if loadings.size else np.zeros(tones.size, dtype=bool)


def flight_lines(scene: Scene, system: HybridSystem, level: float, rehearsals: Sequence[Rehearsal]) -> tuple[str, ...]:
    """Return a line for each damper and joint that states whether and where it acts in `rehearsals` of the test.

    Action in a steady state, action in the wait before it, and action between the points of a stepped sine are stated
    separately.
    """
    test, frequencies = scene.test, test_frequencies(scene.test)
    loadings = level * _loadings_per_level(scene, system, frequencies)
    grid = _grid_between(test, frequencies) if loadings.size else frequencies[:0]
    grid_loadings = level * _loadings_per_level(scene, system, grid)
    lines = []
    for row, element in enumerate(system.elements):
        # A mass on a spring without walls is linear.
        if not element.law.starts_at_rest and element.distance == np.inf:
            continue
        place, (acts, rests) = _place_and_action(scene, element)
        phrases, remedy = [], ""
        if loadings.size:
            is_steady, is_transient = _actions_at(frequencies, loadings[row] > 1.0, row, rehearsals)
            if is_steady.any():
                phrases.append(f"at {format_frequencies(frequencies.tolist(), is_steady.tolist())}")
            if is_transient.any():
                tones = format_frequencies(frequencies.tolist(), is_transient.tolist())
                phrases.append(f"only before the steady state at {tones}")
            if grid.size and test is not None:
                is_between = _without_points(grid_loadings[row] > 1.0, np.isin(grid, frequencies))
                if bands := runs_of(is_between):
                    phrases.append(f"between points at {format_frequencies(grid.tolist(), is_between.tolist())}")
                    remedy = ". " + test.remedy_between([(grid[first - 1], grid[stop]) for first, stop in bands])
        elif times := [(time, each) for each in rehearsals for time in each.event_times[row]]:
            time, rehearsal = min(times, key=itemgetter(0))
            frequency = rehearsal.frequency_at(round(time * rehearsal.rate))
            phrases.append(f"first at {time:.2f} s" if frequency is None else f"first at {frequency:.4g} Hz")
        lines.append(f"{place} {acts} {'; '.join(phrases)}{remedy}" if phrases else f"{place} {rests}")
    return tuple(lines)


def _place_and_action(scene: Scene, element: Element) -> tuple[str, tuple[str, str]]:
    """Return the name of a damper or joint with its place, and what it does at a high and at a low level."""
    label = scene.structure.label
    if element.is_joint:
        joint = scene.joints[element.number - 1]
        return f"joint {element.number} ({joint.locations(label)})", joint.action
    damper = scene.dampers[element.number - 1]
    return f"damper {element.number} ({label(damper.body)})", damper.action


def _actions_at(
    frequencies: Array, is_predicted: NDArray[np.bool_], row: int, rehearsals: Sequence[Rehearsal]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return at which frequencies an element acts in the measurement, and where it acts only in the wait before it.

    A rehearsed measurement replaces the linear prediction. `row`: index of the element in the system.
    """
    is_steady, is_transient = is_predicted.copy(), np.zeros(frequencies.size, dtype=bool)

    def index_of(frequency: float | None) -> int:
        return 0 if frequency is None else int(np.argmin(abs(frequencies - frequency)))

    for rehearsal in rehearsals:
        measured = [index_of(step.frequency) for step in rehearsal.steps if step.is_measurement and step.is_evaluated]
        is_steady[measured] = False
    for rehearsal in rehearsals:
        for time in rehearsal.event_times[row]:
            sample = round(time * rehearsal.rate)
            actions = is_steady if rehearsal.is_measured(sample) else is_transient
            frequency = rehearsal.frequency_at(sample)
            if frequency is not None or frequencies.size == 1:
                actions[index_of(frequency)] = True
    return is_steady, is_transient & ~is_steady


def _grid_between(test: Test | None, tones: Array) -> Array:
    """Return the tones of a test with dwells and frequencies between them, ascending [Hz]; empty for other tests."""
    if test is None or not test.dwells or tones.size < 2:
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
