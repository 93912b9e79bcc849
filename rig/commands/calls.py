"""The commands of `rig` as Python functions with the same names and arguments.

Each function returns a result with `plot()`, `to_dataframe()` and a notebook display; the commands print and save it.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from rig.core.base.progress import CountProgress
from rig.core.scene.loading import SceneLike, scene_of
from rig.core.settings.quantities import FREQUENCY, finite_number

if TYPE_CHECKING:
    from rig.core.steady_response.frequency_response import SteadyResponse
    from rig.extras.bed_response.bed_response import BedResponse
    from rig.studies.cost.cost import Cost
    from rig.studies.motion_map.motion_map import MotionMap


def response(
    scene: SceneLike,
    first: float | str | None = None,
    last: float | str | None = None,
    points: int | None = None,
    direction: str | None = None,
    progress: CountProgress | None = None,
) -> SteadyResponse:
    """Compute the steady response at each frequency, at the level (amplitude of force or drive) of the scene's test.

    Parameters
    ----------
    scene : Scene, str, Path or mapping
        A scene, or an argument of `rig.load`.
    first : float or str, optional
        Lowest frequency, such as ``"8 Hz"``. Default: as in the scene's test.
    last : float or str, optional
        Highest frequency, such as ``"80 Hz"``. Default: as in the scene's test.
    points : int, at least 2, optional
        Number of frequencies. Default: as in the scene's test, or 101.
    direction : {'up', 'down', 'both'}, optional
        Order of the frequencies; both: first up, then down. Default: as in the scene's test.
    progress : callable, optional
        Called with the number of completed points and the total.

    Returns
    -------
    SteadyResponse
        Response of each body at each frequency, with types of motion.

    Raises
    ------
    SceneError
        If neither the arguments nor the test give frequencies, or the scene has no shaker or no level.
    """
    from rig.core.steady_response.frequency_response import frequency_response
    from rig.core.steady_response.response_output import sweep_frequencies

    scene = scene_of(scene)
    band = finite_number(first, FREQUENCY, "`first`"), finite_number(last, FREQUENCY, "`last`")
    frequencies, order = sweep_frequencies(scene, *band, points, direction)
    return frequency_response(scene, frequencies, direction=order, progress=progress)


def grains(
    scene: SceneLike,
    first: float | str | None = None,
    last: float | str | None = None,
    points: int | None = None,
    periods: int = 20,
    table: str | Path | None = None,
    cluster: str | None = None,
    progress: CountProgress | None = None,
) -> BedResponse:
    """Compare the steady-state motion of beds of grains with that of single-mass beds at each frequency.

    Parameters
    ----------
    scene, first, last, points : as in `rig.response`
        The scene, and its frequencies.
    periods : int, at least 1
        Number of drive periods in an average. The motion is steady when two successive averages agree within 1 %.
    table : str or Path, optional
        CSV file that stores the results; frequencies in this file are not recomputed.
    cluster : str, optional
        Address of a Dask scheduler; default: the processors of this machine.
    progress : callable, optional
        Called with the number of completed points and the total.

    Returns
    -------
    BedResponse
        Motion of both models at each frequency.

    Raises
    ------
    SceneError
        As `rig.response`, or if every bed of grains is locked.
    """
    from rig.core.steady_response.response_output import sweep_frequencies
    from rig.extras.bed_response.bed_response import bed_response

    scene = scene_of(scene)
    band = finite_number(first, FREQUENCY, "`first`"), finite_number(last, FREQUENCY, "`last`")
    frequencies, _ = sweep_frequencies(scene, *band, points, None)
    return bed_response(scene, frequencies, periods, None if table is None else Path(table), cluster, progress)


def map(
    scene: SceneLike,
    over: str | None = None,
    least: float | str | None = None,
    most: float | str | None = None,
    rows: int = 36,
    first: float | str | None = None,
    last: float | str | None = None,
    points: int = 48,
    cluster: str | None = None,
    kept: str | Path | None = None,
    progress: CountProgress | None = None,
) -> MotionMap:
    """Map types of motion and settling time against frequency (horizontal) and level or clearance (vertical).

    Parameters
    ----------
    scene : as in `rig.response`
        The scene.
    over : {'force', 'drive', 'clearance'}, optional
        Quantity that is varied in addition to the frequency. Default: the force or drive of the test.
    least : float or str, optional
        Lowest value of the varied quantity, such as ``"0.5 N"``. Default: below that of the scene, and below the lowest
        at which a damper lifts off.
    most : float or str, optional
        Highest value of the varied quantity, such as ``"20 N"``. Default: above that of the scene.
    rows : int, 2 to 1000
        Number of values of the varied quantity.
    first, last : as in `rig.response`
        Lowest and highest frequency.
    points : int, 2 to 1000
        Number of frequencies.
    cluster : str, optional
        Address of a Dask scheduler; default: the processors of this machine.
    kept : str or Path, optional
        CSV file to which each finished row is added; rows in this file are not recomputed.
    progress : callable, optional
        Called with the number of completed points and the total.

    Returns
    -------
    MotionMap
        Type of motion, response and settling time of each point.

    Raises
    ------
    SceneError
        If an argument is invalid, or no damper of the scene can move.
    """
    from rig.studies.motion_map.grid import select_frequencies, select_row_values, vertical_axis
    from rig.studies.motion_map.motion_map import map_motion

    scene = scene_of(scene)
    over, kind = vertical_axis(scene, over)
    band = finite_number(first, FREQUENCY, "`first`"), finite_number(last, FREQUENCY, "`last`")
    frequencies = select_frequencies(scene, *band, points)
    limits = (finite_number(least, kind, "`least`"), finite_number(most, kind, "`most`"))
    values = select_row_values(scene, over, frequencies, *limits, rows)
    return map_motion(scene, over, values, frequencies, progress, cluster, None if kept is None else Path(kept))


def cost(
    scene: SceneLike, frequency: float | str | None = None, periods: int = 20, say: Callable[[str], None] | None = None
) -> Cost:
    """Measure error and computing time of every integration method on a scene or, with grains, of every bed model.

    Parameters
    ----------
    scene : Scene, str, Path or mapping
        A scene, or an argument of `rig.load`.
    frequency : float or str, optional
        Excitation frequency, such as ``"49 Hz"``. Default: in the range of the test, the frequency of the largest
        acceleration with resting dampers.
    periods : int, at least 2
        Number of drive periods to simulate.
    say : callable, optional
        Called with the name of the next method.

    Returns
    -------
    Cost
        Error and time of each method.

    Raises
    ------
    SceneError
        If the scene has no shaker, or neither argument nor test gives a frequency.
    """
    from rig.studies.cost.cost import cost as measure_cost

    return measure_cost(scene_of(scene), finite_number(frequency, FREQUENCY, "`frequency`"), periods, say)
