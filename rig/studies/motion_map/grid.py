"""The grid of a map: levels or clearances (rows), and frequencies with a finer spacing near resonances (columns)."""

import numpy as np

from rig.core.base.arrays import Array
from rig.core.base.errors import SceneError
from rig.core.scene.scene import Scene
from rig.core.settings.quantities import FORCE, LENGTH, Kind, count
from rig.core.system.assembly import assemble
from rig.core.system.open_loop_drive import damper_accelerations, gaps_per_level, level_of, separation_levels
from rig.core.system.structural_model import structural_model

#: Default number of frequencies.
DEFAULT_POINTS = 48
#: Default number of rows.
DEFAULT_ROWS = 36
#: Frequencies are finely spaced within this fraction of a natural frequency on either side.
RESONANCE_HALF_WIDTH = 0.02
#: The default range of levels includes these multiples of the lowest separation level.
LEVEL_TO_SEPARATION_RATIOS = (0.5, 20.0)
#: The default range of levels includes these multiples of the level of the scene.
LEVEL_TO_SCENE_LEVEL_RATIOS = (0.5, 4.0)
#: The default range of clearances includes these multiples of the displacement amplitude of a damper on its floor.
CLEARANCE_TO_DISPLACEMENT_RATIOS = (0.1, 3.0)
#: The default range of clearances includes these multiples of the clearance in the scene.
CLEARANCE_TO_SCENE_CLEARANCE_RATIOS = (0.1, 5.0)


def vertical_axis(scene: Scene, over: str | None) -> tuple[str, Kind]:
    """Return the name of the vertical axis, and its kind of quantity.

    `over`: "force", "drive" or "clearance". None: the level of the scene's test. Raises `SceneError` if it is
    neither that level nor the clearance of a damper, or the scene has no level or is linear.
    """
    level_of(scene)
    if scene.is_linear:
        raise SceneError(
            f"scene {scene.name!r} has no joint, and no damper that can hit a wall or slide, so its response is "
            "linear. Use rig response."
        )
    level_quantity = scene.level_key
    over = over if over is not None else level_quantity
    if over not in (level_quantity, "clearance"):
        raise SceneError(f"over: got {over!r}; expected {level_quantity} (the level of the scene's test) or clearance")
    if over == "clearance" and not any(damper.has_walls and damper.moves for damper in scene.dampers):
        raise SceneError(f"over: scene {scene.name!r} has no damper with a wall. Use {level_quantity}.")
    if over == "drive":
        assert scene.driven_shaker is not None
        return over, scene.driven_shaker.drive_quantity
    return over, FORCE if over == "force" else LENGTH


def select_frequencies(
    scene: Scene, low: float | None = None, high: float | None = None, points: int = DEFAULT_POINTS
) -> Array:
    """Select frequencies from low to high, half evenly spaced and half near the natural frequencies [Hz].

    `low`, `high`: Hz; None: the ends of the test's range, or 20 % below and above its single frequency. Raises
    `SceneError` if the ends are not a valid range.
    """
    if low is None or high is None:
        default = _test_range(scene)
        low, high = default[0] if low is None else low, default[1] if high is None else high
    points = count(points, 2, "points")
    if not 0.0 < low < high:
        raise SceneError(f"frequencies: got {low:g} to {high:g} Hz; expected an ascending range above 0")
    natural = natural_frequencies(scene, low, high)
    grid = np.linspace(low, high, 20_001)
    # Uniform density plus a Lorentzian at each natural frequency.
    density = np.full(grid.shape, 1.0 / (high - low))
    for center in natural:
        half_width = RESONANCE_HALF_WIDTH * center
        density += 1.0 / (len(natural) * np.pi * half_width * (1.0 + ((grid - center) / half_width) ** 2))
    cumulative_density = np.concatenate([[0.0], np.cumsum(density[1:] + density[:-1])])
    frequencies = np.interp(np.linspace(0.0, cumulative_density[-1], points), cumulative_density, grid)
    frequencies[0], frequencies[-1] = low, high
    return np.asarray(frequencies)


def natural_frequencies(scene: Scene, low: float, high: float) -> Array:
    """Compute the natural frequencies [Hz] in a range: without moving dampers, and with resting dampers."""
    # With dampers in motion, each resonance is between its frequencies without moving dampers and with resting dampers.
    model = structural_model(scene)
    models = [model.with_damper_masses(), model.with_damper_masses(range(1, len(scene.dampers) + 1))]
    natural = np.concatenate([loaded_model.modes.frequency for loaded_model in models])
    return np.asarray(natural[(natural > low) & (natural < high)])


def _test_range(scene: Scene) -> tuple[float, float]:
    band = None if scene.test is None else scene.test.band
    if band is None:
        raise SceneError("test: has no frequency. Give `first` and `last`.")
    low, high = band
    return band if low < high else (0.8 * low, 1.2 * low)


def select_row_values(
    scene: Scene,
    over: str,
    frequency: Array,
    lowest: float | None = None,
    highest: float | None = None,
    rows: int = DEFAULT_ROWS,
) -> Array:
    """Select levels or clearances, evenly spaced in the logarithm.

    `over`: "force", "drive" or "clearance"; `frequency`: Hz; `lowest`, `highest`: ends of the range. The default
    range of levels contains the lowest separation level. In the default range of clearances, a damper moves little at
    the smallest and barely reaches its ceiling at the largest. Unless both ends are given, one row is the scene's
    value. Raises `SceneError` if the ends are not a valid range.
    """
    scene_value, default = (_clearances if over == "clearance" else _levels)(scene, frequency)
    low, high = default[0] if lowest is None else lowest, default[1] if highest is None else highest
    rows = count(rows, 2, "rows")
    if not 0.0 < low < high:
        raise SceneError(f"{over}: got {low:.4g} to {high:.4g}; expected an ascending range above 0 (`least`, `most`)")
    step = np.log(high / low) / (rows - 1)
    if lowest is not None and highest is not None:
        return np.geomspace(low, high, rows)
    # The rows are shifted by less than half a spacing, so one row has the scene's own value.
    shift = (np.log(scene_value / low) / step + 0.5) % 1.0 - 0.5
    return np.asarray(low * np.exp(step * (np.arange(rows) + shift)))


def _levels(scene: Scene, frequency: Array) -> tuple[float, tuple[float, float]]:
    """Return the scene's own level and the ends of the default range."""
    level = level_of(scene)
    lowest_separation = float(separation_levels(scene, frequency).min()) or level
    return level, _range_around(lowest_separation, LEVEL_TO_SEPARATION_RATIOS, level, LEVEL_TO_SCENE_LEVEL_RATIOS)


def _clearances(scene: Scene, frequency: Array) -> tuple[float, tuple[float, float]]:
    """Return the scene's own clearance (geometric mean of several) and the ends of the default range [m]."""
    system, level = assemble(scene), level_of(scene)
    omega, rests = 2.0 * np.pi * frequency, np.isfinite(system.separation_acceleration)
    displacement = level * float(gaps_per_level(scene, system, omega).max(initial=0.0))
    accelerations = damper_accelerations(scene, system, omega)[rests]
    if accelerations.size:
        accelerations = accelerations.max(axis=0)
        peak = int(np.argmax(accelerations))
        displacement = level * float(accelerations[peak]) / omega[peak] ** 2
    clearances = system.clearance[np.isfinite(system.clearance)]
    scene_clearance = float(np.exp(np.log(clearances).mean())) if len(clearances) else displacement
    return scene_clearance, _range_around(
        displacement, CLEARANCE_TO_DISPLACEMENT_RATIOS, scene_clearance, CLEARANCE_TO_SCENE_CLEARANCE_RATIOS
    )


def _range_around(
    first: float, first_ratios: tuple[float, float], second: float, second_ratios: tuple[float, float]
) -> tuple[float, float]:
    """Return the smallest range that contains both values times their ratios."""
    (first_low, first_high), (second_low, second_high) = first_ratios, second_ratios
    return min(first_low * first, second_low * second), max(first_high * first, second_high * second)
