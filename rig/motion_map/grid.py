"""The grid of a map: levels or clearances, and frequencies with a finer spacing near resonances."""

from __future__ import annotations

import numpy as np

from rig.arrays import Array
from rig.errors import SceneError
from rig.scene.excitation import Multisine, Random, Sine, SteppedSine, SweptSine
from rig.scene.quantities import FORCE, LENGTH, VOLTAGE
from rig.scene.scene import Scene
from rig.scene.shaker import TableShaker
from rig.system.assembly import assemble
from rig.system.open_loop_drive import accelerations_per_level, level_of
from rig.system.structural_model import structural_model

#: Kind of quantity of a level or clearance, by its unit.
KIND_OF_UNIT = {"N": FORCE, "V": VOLTAGE, "m": LENGTH}
#: Default number of frequencies.
POINTS = 48
#: Default number of rows.
ROWS = 36
#: Relative half-width of the finely spaced band around a natural frequency.
CLOSE = 0.02


def vertical_axis(scene: Scene, over: str | None) -> tuple[str, str]:
    """Return the quantity of the vertical axis, and its unit (N, V or m).

    `over`: "force", "drive" or "clearance". None: the level of the scene's test. Raises `SceneError` if it is
    neither that level nor the clearance, or the scene has no level or no moving damper.
    """
    level_of(scene)
    if not assemble(scene).dampers:
        raise SceneError(
            f"scene {scene.name!r} has no damper that moves, so that its response is linear. Use rig "
            "response."
        )
    own = "force" if getattr(scene.test, "force", None) is not None else "drive"
    over = over if over is not None else own
    if over not in (own, "clearance"):
        raise SceneError(f"over: got {over!r}; expected {own} (the level of the scene's test) or clearance")
    if over == "force":
        return over, "N"
    return over, "m" if over == "clearance" or isinstance(scene.driven_shaker, TableShaker) else "V"


def columns(scene: Scene, low: float | None = None, high: float | None = None, points: int = POINTS) -> Array:
    """Select frequencies from low to high, half evenly spaced and half near the natural frequencies, Hz.

    `low`, `high`: Hz; None: the ends of the test's range, or 20 % below and above its single frequency. Raises
    `SceneError` if the ends are not a valid range.
    """
    if low is None or high is None:
        usual = _range_of_test(scene)
        low, high = usual[0] if low is None else low, usual[1] if high is None else high
    if not 0.0 < low < high or points < 2:
        raise SceneError(
            f"frequencies: got {low:g} to {high:g} Hz in {points} points; expected a rising range above "
            "0 and at least 2 points"
        )
    natural = natural_frequencies(scene, low, high)
    grid = np.linspace(low, high, 20_001)
    density = np.full(grid.shape, 1.0 / (high - low))
    for peak in natural:
        width = CLOSE * peak
        density += 1.0 / (len(natural) * np.pi * width * (1.0 + ((grid - peak) / width) ** 2))
    share = np.concatenate([[0.0], np.cumsum(density[1:] + density[:-1])])
    found = np.interp(np.linspace(0.0, share[-1], points), share, grid)
    found[0], found[-1] = low, high
    return np.asarray(found)


def natural_frequencies(scene: Scene, low: float, high: float) -> Array:
    """Compute the natural frequencies in a range, Hz, without the moving dampers and with these riding.

    With active dampers, each resonance is between these two values.
    """
    model = structural_model(scene)
    loads = [model.with_bed_masses(), model.with_bed_masses(range(1, len(scene.dampers) + 1))]
    natural = np.concatenate([each.modes.frequency for each in loads])
    return np.asarray(natural[(natural > low) & (natural < high)])


def _range_of_test(scene: Scene) -> tuple[float, float]:
    match scene.test:
        case Sine(frequency=alone):
            return 0.8 * alone, 1.2 * alone
        case SteppedSine() as test:
            low, high = min(test.order), max(test.order)
            return (low, high) if low < high else (0.8 * low, 1.2 * low)
        case SweptSine(from_=one, to=other) | Random(from_=one, to=other) | Multisine(from_=one, to=other):
            return min(one, other), max(one, other)
    raise SceneError("test: has no frequency. Give a range with --from and --to.")


def take_off(scene: Scene, frequency: Array) -> Array:
    """Compute the level at which a damper reaches 1 g in the linear structure with all dampers riding.

    `frequency`, shape (frequencies,): Hz. Returns shape (frequencies,), N, or the unit of the drive.
    """
    return assemble(scene).gravity / _dampers_accelerations(scene, frequency)


def _dampers_accelerations(scene: Scene, frequency: Array) -> Array:
    """Compute the largest acceleration of a riding damper per unit of level, m/s^2; shape (frequencies,)."""
    system = assemble(scene)
    places = system.damper_coordinate
    return np.array(
        [accelerations_per_level(scene, system, 2.0 * np.pi * f)[places].max() for f in frequency]
    )


def rows_of(
    scene: Scene,
    over: str,
    frequency: Array,
    least: float | None = None,
    most: float | None = None,
    rows: int = ROWS,
) -> Array:
    """Select levels or clearances, evenly spaced in the logarithm.

    `over`: "force", "drive" or "clearance"; `frequency`: Hz; `least`, `most`: ends of the range. Default for levels:
    from below the first take-off to well above it. Default for clearances: from a damper that hardly moves to a
    damper that hardly reaches its ceiling. Unless both are given, one row is the scene's own value. Raises
    `SceneError` if the ends are not a valid range.
    """
    own, usual = (_clearances if over == "clearance" else _levels)(scene, frequency)
    low, high = usual[0] if least is None else least, usual[1] if most is None else most
    if not 0.0 < low < high or rows < 2:
        raise SceneError(
            f"{over}: got {low:.4g} to {high:.4g} in {rows} rows; expected a rising range above 0 and "
            "at least 2 rows (--least, --most, --rows)"
        )
    step = np.log(high / low) / (rows - 1)
    if least is not None and most is not None:
        return np.geomspace(low, high, rows)
    # Shift by less than half a row, so that one row is the scene's own value.
    shift = (np.log(own / low) / step + 0.5) % 1.0 - 0.5
    return np.asarray(low * np.exp(step * (np.arange(rows) + shift)))


def _levels(scene: Scene, frequency: Array) -> tuple[float, tuple[float, float]]:
    """Return the scene's own level and the ends of the range."""
    own = level_of(scene)
    first = float(take_off(scene, frequency).min()) or own
    return own, (min(0.5 * first, 0.5 * own), max(20.0 * first, 4.0 * own))


def _clearances(scene: Scene, frequency: Array) -> tuple[float, tuple[float, float]]:
    """Return the scene's own clearance (mean of several) and the ends of the range, m."""
    accelerations = _dampers_accelerations(scene, frequency)
    hardest = int(np.argmax(accelerations))
    motion = level_of(scene) * float(accelerations[hardest]) / (2.0 * np.pi * frequency[hardest]) ** 2
    given = assemble(scene).clearance
    given = given[np.isfinite(given)]
    own = float(np.exp(np.log(given).mean())) if len(given) else motion
    return own, (min(0.1 * motion, 0.1 * own), max(3.0 * motion, 5.0 * own))
