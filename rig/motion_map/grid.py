"""The grid of a map: levels from below the first take-off, or clearances, and frequencies close where it resonates."""

from __future__ import annotations

import numpy as np

from rig.engine.trajectory import Array
from rig.errors import SceneError
from rig.scene.excitation import Multisine, Random, Sine, SteppedSine, SweptSine
from rig.scene.quantities import FORCE, LENGTH, VOLTAGE
from rig.scene.scene import Scene
from rig.scene.shaker import TableShaker
from rig.system.assembly import assemble
from rig.system.open_loop_drive import accelerations_per_level, level_of
from rig.system.structural_model import structural_model

#: What a level or a clearance measures, by its unit.
KIND_OF_UNIT = {"N": FORCE, "V": VOLTAGE, "m": LENGTH}
#: Default number of frequencies.
POINTS = 48
#: Default number of rows.
ROWS = 36
#: What counts as close to a natural frequency, as a share of it.
CLOSE = 0.02


def vertical_axis(scene: Scene, over: str | None) -> tuple[str, str]:
    """Say what changes from row to row, and its unit (N, V or m).

    Parameters
    ----------
    over : {"force", "drive", "clearance"} or None
        None: the level that the scene's test gives.

    Raises
    ------
    SceneError
        If it is neither that level nor the clearance, or nothing changes along it: no level, no damper that moves.
    """
    level_of(scene)
    if not assemble(scene).dampers:
        raise SceneError(
            f"scene {scene.name!r} has no damper that moves: its response is linear everywhere (see: rig response)"
        )
    own = "force" if getattr(scene.test, "force", None) is not None else "drive"
    over = over if over is not None else own
    if over not in (own, "clearance"):
        raise SceneError(
            f"over: got {over!r}; expected {own}, which is what the scene's test gives, or clearance"
        )
    if over == "force":
        return over, "N"
    return over, "m" if over == "clearance" or isinstance(scene.driven_shaker, TableShaker) else "V"


def columns(scene: Scene, low: float | None = None, high: float | None = None, points: int = POINTS) -> Array:
    """Frequencies from low to high, half of them evenly and half close to the natural frequencies, Hz.

    Parameters
    ----------
    low, high : float, optional
        Hz; None: the ends of the test's range, or a fifth from its single tone.

    Raises
    ------
    SceneError
        If that is no range.
    """
    if low is None or high is None:
        usual = _range_of_test(scene)
        low, high = usual[0] if low is None else low, usual[1] if high is None else high
    if not 0.0 < low < high or points < 2:
        raise SceneError(
            f"frequencies: got {low:g} to {high:g} Hz in {points} points; expected the lower end first, above zero, "
            "and 2 points at least"
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
    """Natural frequencies between two, Hz, without the dampers that move and with them riding.

    Working dampers leave a resonance between the two.
    """
    model = structural_model(scene)
    loads = [model.with_riding(), model.with_riding(range(1, len(scene.dampers) + 1))]
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
    raise SceneError("the test has no frequency of its own; give a range with --from and --to")


def take_off(scene: Scene, frequency: Array) -> Array:
    """Level at which the linear structure with all dampers riding accelerates one of them at gravity.

    Parameters
    ----------
    frequency : ndarray, shape (frequencies,)
        Hz.

    Returns
    -------
    ndarray, shape (frequencies,)
        N, or the drive's unit.
    """
    return assemble(scene).gravity / _dampers_accelerations(scene, frequency)


def _dampers_accelerations(scene: Scene, frequency: Array) -> Array:
    """Largest acceleration at a damper for one unit of level, all of them riding, m/s^2; shape (frequencies,)."""
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
    """Levels or clearances, even in the logarithm.

    Parameters
    ----------
    over : {"force", "drive", "clearance"}
    frequency : ndarray
        Hz.
    least, most : float, optional
        The ends. None, for levels: from below the first take-off to well above it; for clearances: from where a damper
        hardly moves to where it hardly meets its ceiling. Unless both are given, one row is the scene's own value.

    Raises
    ------
    SceneError
        If the ends are no range.
    """
    own, usual = (_clearances if over == "clearance" else _levels)(scene, frequency)
    low, high = usual[0] if least is None else least, usual[1] if most is None else most
    if not 0.0 < low < high or rows < 2:
        raise SceneError(
            f"{over}: got {low:.4g} to {high:.4g} in {rows} rows; expected the lower end first, above zero, and 2 "
            "rows at least (--least, --most, --rows)"
        )
    step = np.log(high / low) / (rows - 1)
    if least is not None and most is not None:
        return np.geomspace(low, high, rows)
    # Shifted by less than half a row, so that one row is the scene's own.
    shift = (np.log(own / low) / step + 0.5) % 1.0 - 0.5
    return np.asarray(low * np.exp(step * (np.arange(rows) + shift)))


def _levels(scene: Scene, frequency: Array) -> tuple[float, tuple[float, float]]:
    """Give the scene's own level and the ends of a range."""
    own = level_of(scene)
    first = float(take_off(scene, frequency).min()) or own
    return own, (min(0.5 * first, 0.5 * own), max(20.0 * first, 4.0 * own))


def _clearances(scene: Scene, frequency: Array) -> tuple[float, tuple[float, float]]:
    """Give the scene's own clearance (their mean if there are several) and the ends of a range, m."""
    accelerations = _dampers_accelerations(scene, frequency)
    hardest = int(np.argmax(accelerations))
    motion = level_of(scene) * float(accelerations[hardest]) / (2.0 * np.pi * frequency[hardest]) ** 2
    given = assemble(scene).clearance
    given = given[np.isfinite(given)]
    own = float(np.exp(np.log(given).mean())) if len(given) else motion
    return own, (min(0.1 * motion, 0.1 * own), max(3.0 * motion, 5.0 * own))
