"""Cost study of a scene: of methods, or of models of its beds of grains."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rig.grain_beds.spheres import spheres_of
from rig.results import Result
from rig.scene.scene import Scene
from rig.system.assembly import assemble
from rig.work_precision.motion_study import MotionStudy, Point, hardest_frequency, motion_study
from rig.work_precision.steady_study import SteadyStudy, steady_study

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, repr=False)
class Cost(Result):
    """Error and computing time of methods or models.

    Attributes
    ----------
    scene : Scene
    motion : MotionStudy or None
        Methods for the motion; None for models of beds of grains, which are compared in steady motion only.
    steady : SteadyStudy
        Methods for the steady state, or models of the beds.
    """

    scene: Scene
    motion: MotionStudy | None
    steady: SteadyStudy

    @property
    def points(self) -> tuple[tuple[str, Point], ...]:
        """Return all methods and settings, each with the computed quantity."""
        motion = () if self.motion is None else self.motion.points
        return (
            *(("motion, a period", point) for point in motion),
            *(("steady state", point) for point in self.steady.points),
        )

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return quantity, method, setting, CPU time, errors and event correctness of each point."""
        quantities = [quantity for quantity, _ in self.points]
        points = [point for _, point in self.points]
        return {
            "quantity": np.array(quantities, dtype=str),
            "method": np.array([point.method for point in points], dtype=str),
            "setting": np.array([point.setting for point in points], dtype=str),
            "cpu_s": np.array([point.cpu for point in points]),
            "error": np.array([point.error for point in points]),
            "event_time_error_s": np.array([point.event_error for point in points]),
            "right": np.array([point.right for point in points], dtype=bool),
        }

    def summary(self) -> str:
        """Summarize scene, frequency and number of methods."""
        methods = len({point.method for _, point in self.points})
        return f"{self.scene.name}: cost of {methods} methods at {self.steady.frequency:.6g} Hz"

    def __str__(self) -> str:
        """Return the tables that `rig cost` prints."""
        from rig.work_precision.figure import models_table, table

        if self.motion is None:
            return models_table(self.scene, self.steady)
        return table(self.motion, self.steady)

    def draw(self, ax: Axes, **style: Any) -> None:
        """Draw error against CPU time, for the motion or for models of beds."""
        from rig.work_precision.figure import draw_points

        draw_points(ax, (self.motion or self.steady).points, "CPU time / s")
        ax.set(ylabel="relative error")

    def write(self, folder: Path) -> list[Path]:
        """Write figure and table, cost-<scene>.png, .svg and .csv, into a folder; return the files.

        Raises
        ------
        SceneError
            If a file cannot be written.
        """
        from rig.work_precision.figure import write, write_models

        if self.motion is None:
            return write_models(self.scene, self.steady, folder)
        return write(self.motion, self.steady, folder)


def cost(
    scene: Scene, frequency: float | None, periods: int, say: Callable[[str], None] | None = None
) -> Cost:
    """Measure every method on a scene; for a scene with moving beds of grains, every model of them.

    Parameters
    ----------
    frequency : float or None
        Drive frequency, Hz; None: see `rig.work_precision.motion_study.hardest_frequency`.
    periods : int
        Length of the motion; grains are simulated until their motion is steady.
    say : callable, optional
        Called with the name of the next computation.
    """
    say = say or (lambda text: None)
    if spheres_of(scene):
        # Imported here because LAMMPS is optional; scenes with single masses do not need it.
        from rig.work_precision.bed_models import bed_models

        tone = hardest_frequency(scene, assemble(scene)) if frequency is None else frequency
        return Cost(scene, None, bed_models(scene, tone, say))
    motion = motion_study(scene, frequency, periods, say)
    return Cost(scene, motion, steady_study(scene, motion.frequency, say))
