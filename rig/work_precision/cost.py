"""The study of cost that a scene calls for, as text and files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from rig.grains.spheres import spheres_of
from rig.scene.scene import Scene
from rig.system.assembly import assemble
from rig.work_precision.figure import models_table, table, write, write_models
from rig.work_precision.motion_study import hardest_frequency, motion_study
from rig.work_precision.steady_study import steady_study


def cost(
    scene: Scene, frequency: float | None, periods: int, folder: Path, say: Callable[[str], None]
) -> tuple[str, list[Path]]:
    """Measure every way to compute a scene, or, where beds of grains can move in it, every model of them.

    Parameters
    ----------
    frequency : float or None
        Hz; None: see `rig.work_precision.motion_study.hardest_frequency`.
    periods : int
        Length of the motion; grains are followed until they are steady.
    folder : Path
        Where figure and table go.
    say : callable
        Called with what is computed next.

    Returns
    -------
    tuple
        The text, and the files.
    """
    if spheres_of(scene):
        # LAMMPS, which may be missing, is not for who studies one mass.
        from rig.work_precision.bed_models import bed_models

        tone = hardest_frequency(scene, assemble(scene)) if frequency is None else frequency
        models = bed_models(scene, tone, say)
        return models_table(scene, models), write_models(scene, models, folder)
    study = motion_study(scene, frequency, periods, say)
    steady = steady_study(scene, study.frequency, say)
    return table(study, steady), write(study, steady, folder)
