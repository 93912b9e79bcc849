"""Choice of dampers: the design with the smallest worst peak of a structure, and its comparison with other designs."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from rig.core.base.arrays import Array
from rig.core.base.figure_types import Axes
from rig.core.base.palette import BASELINE
from rig.core.base.progress import CountProgress
from rig.core.base.workers import Workers
from rig.core.results import Result, complete_style
from rig.core.scene.loading import SceneLike, scene_of
from rig.core.scene.scene import Scene
from rig.studies.design.check import Expected, expected_results, scene_with_check
from rig.studies.design.choice import FINE_DENSITY, Choice, Objective, SearchSpace, Trial, mass_unit
from rig.studies.design.evaluator import Evaluator
from rig.studies.design.flight import Flight, compute_flight, describe_shortfall, ineffective_levels
from rig.studies.design.other_modes import ModePeaks, mode_peaks, select_outside_band
from rig.studies.design.ranking import is_equally_good, pareto_front
from rig.studies.design.request import parse_request
from rig.studies.design.search import estimate_job_count, search
from rig.studies.design.tolerance import Tolerance, clearance_tolerance
from rig.studies.design.tuned_mass import TunedMass, best_tuned_mass
from rig.studies.design.worst_peak import Peak

#: Clearances of the chart (worst peak against clearance and force), relative to the clearances of the best design.
CHART_CLEARANCES = np.geomspace(0.25, 4.0, 7)
#: The levels of the chart extend beyond the requested levels by this factor.
CHART_MARGIN = 2.0
#: The levels of the chart extend above and below the middle level by at least this factor.
MIN_LEVEL_RATIO = 4.0
#: Neighboring levels of the chart have about this ratio.
LEVEL_STEP_RATIO = 2.0**0.5


@dataclass(frozen=True, repr=False)
class Design(Result):
    """Dampers that make the worst peak smallest.

    Attributes
    ----------
    scene : Scene
        Scene with these dampers. Its test checks the design: a stepped sine around the peaks at all levels.
    added_channels : tuple of str
        Channels that this test needs and that the given scene lacked.
    expected : tuple of Expected
        Expected results of that test at each level.
    best : Trial
        The dampers and their worst peak at each level.
    bare : Peak
        Worst peak without dampers.
    tolerance : Tolerance
        The interval of clearances with nearly the same worst peak.
    modes : tuple of ModePeaks
        Peaks of the modes in the band and next to it, with and without the dampers.
    flight : Flight
        Separation level and flight height of the dampers.
    tuned : TunedMass or None
        The best tuned mass damper (linear) with the total mass of the dampers; None if no mode moves its bodies.
    trials : tuple of Trial
        All designs computed; `front` is the Pareto front of peak against added mass.
    question : Objective
        The objective of the search; `space` is the space of candidate designs.
    levels : ndarray, shape (levels,)
        Forces of the chart, including the requested levels [N].
    clearance_factors : ndarray, shape (factors,)
        Clearances of the chart, relative to the clearances of `charted`.
    charted : Choice
        The best dampers; dampers without a ceiling get the largest clearance searched.
    chart : tuple of tuple of Peak
        Worst peak for each clearance (rows) and level.
    """

    scene: Scene
    added_channels: tuple[str, ...]
    expected: tuple[Expected, ...]
    best: Trial
    bare: Peak
    tolerance: Tolerance
    modes: tuple[ModePeaks, ...]
    flight: Flight
    tuned: TunedMass | None
    trials: tuple[Trial, ...]
    question: Objective
    space: SearchSpace
    levels: Array
    clearance_factors: Array
    charted: Choice
    chart: tuple[tuple[Peak, ...], ...]

    def summary(self) -> str:
        """Summarize the best dampers and their reduction of the worst peak."""
        reduction = self.reduction(self.best.peak)
        if not self.serves:
            return (
                f"{self.scene.name}: no design reduces the peak at every level (best design: {self.best.choice}, "
                f"largest peak {'reduced' if reduction >= 0.0 else 'increased'} by {abs(reduction):.1f} dB)"
            )
        return f"{self.scene.name}: {self.best.choice}, largest peak reduced by {reduction:.1f} dB"

    @property
    def serves(self) -> bool:
        """Whether the best dampers fly at every level, and reduce the peak by more than the search resolution."""
        return not ineffective_levels(self.best, self.bare, self.flight)

    @property
    def shortfall(self) -> list[str]:
        """Levels at which the best dampers have no effect, with the reason; empty if there are none."""
        row = self.chart[int(np.argmin(np.abs(np.log(self.clearance_factors))))]
        charted = dict(zip(self.levels.tolist(), row, strict=True))
        return describe_shortfall(self.best, self.bare, self.flight, charted, self.trials, self.question.level.kind.si)

    def columns(self) -> dict[str, Array]:
        """Return added mass and reduction of the worst peak for all computed designs."""
        return {
            "added_mass_kg": np.array([trial.choice.mass for trial in self.trials]),
            "reduction_dB": np.array([self.reduction(trial.peak) for trial in self.trials]),
        }

    def draw(self, ax: Axes, **style: Any) -> None:
        """Draw the reduction of the worst peak over added mass, for all computed designs."""
        mass, reduction = self.columns().values()
        factor, unit = mass_unit(float(mass.max()))
        best = [(factor * trial.choice.mass, self.reduction(trial.peak)) for trial in self.front]
        ax.plot(factor * mass, reduction, "o", color="#a0a0a0", ms=3, label="tried")
        ax.plot(
            *zip(*best, strict=True),
            **complete_style(style, marker="o", color=BASELINE, ms=5, ls=":", lw=0.8, label="best for its mass"),
        )
        ax.set(xlabel=f"added mass / {unit}", ylabel="reduction of the largest peak / dB", xlim=(0.0, None))
        ax.set_title("Added mass")

    @property
    def front(self) -> list[Trial]:
        """Pareto front of peak against added mass, from light to heavy."""
        return pareto_front(self.trials)

    def reduction(self, peak: Peak) -> float:
        """Return the reduction of a peak relative to the bare structure [dB]."""
        return peak.reduction_from(self.bare)


def design(
    scene: SceneLike,
    *,
    budget: float | str | None = None,
    bodies: Sequence[int | str] | None = None,
    dampers: int = 1,
    clearance: Sequence[float | str] | None = None,
    levels: Sequence[float | str] | None = None,
    band: Sequence[float | str] | None = None,
    watched: Sequence[int | str] | None = None,
    uncertain: Sequence[float | str] = (0.0, 0.0),
    cluster: str | None = None,
    table: Path | None = None,
    progress: CountProgress | None = None,
    say: Callable[[str], None] | None = None,
) -> Design:
    """Choose the dampers that make the worst peak over a band and a range of levels smallest.

    Designs within 0.05 dB of each other count as equal. Among these, the mean reduction over all levels in dB
    decides, then the reduction at the other modes of the structure.

    Parameters
    ----------
    scene : Scene, str, Path or mapping
        Structure, shaker and level. Its dampers are replaced; the new dampers have the restitution and contact of its
        first damper.
    budget : float or str, optional
        Largest total mass of the dampers, such as ``"50 g"``, or ``"5 %"`` of the structure's mass. Default: ``"5 %"``.
    bodies : sequence of int or str, optional
        Bodies that may contain a damper, by number from 1 or name. A body that is listed twice may contain two dampers;
        such designs take several times as long, because their coupled motion is simulated and averaged. Default: all.
    dampers : int, at least 1
        Largest number of dampers; fewer are chosen if they are as effective.
    clearance : (float, float) or (str, str), optional
        Range of clearances to search, such as ``0.2mm,3mm``. Default: dampers move little at the smallest clearance and
        barely reach the ceiling at the largest; designs without a ceiling are then included.
    levels : sequence of float or str, optional
        Force amplitudes for which dampers are designed, such as ``1N,3N``. Default: 0.5, 1 and 2 times the force of
        the test.
    band : (float, float) or (str, str), optional
        Frequency band in which the peaks are reduced, such as ``30Hz,60Hz``. Default: as in the scene's test.
    watched : sequence of int or str, optional
        Bodies whose peaks are reduced, by number from 1 or name. Default: all.
    uncertain : (float, float) or (str, str)
        Relative uncertainty of the structure's damping and stiffness; the worst combination decides.
    cluster : str, optional
        As for `rig.core.base.workers.Workers`.
    table : Path, optional
        CSV file of all trials. Results of the same search that are already in this file are reused.
    progress : callable, optional
        Called with the number of worst peaks computed (a design at a level on a structure) and the total.
    say : callable, optional
        Called with a description of the step after the search.

    Returns
    -------
    Design
        The chosen dampers, their effect, and all trials.

    Raises
    ------
    SceneError
        If an argument is invalid, or nothing drives the structure.
    RunError
        If a worker process ends unexpectedly.
    """
    scene = scene_of(scene)
    objective, space = parse_request(scene, budget, bodies, dampers, clearance, levels, band, watched, uncertain)
    forces = chart_levels(objective.levels)
    with Workers(cluster) as workers:
        job_count = estimate_job_count(objective, space) + CHART_CLEARANCES.size * forces.size
        evaluator = Evaluator(workers, table, progress, job_count)
        best, trials = search(objective, space, evaluator)
        preferred = select_outside_band(objective, trials, best, evaluator)
        if preferred != best:
            (refined,) = evaluator.compute(replace(objective, density=FINE_DENSITY), [preferred.choice])
            trials = [refined, *(trial for trial in trials if trial.choice != preferred.choice)]
            best = refined if is_equally_good(refined, best) else best
        modes = mode_peaks(objective, best, evaluator)
        tolerance = clearance_tolerance(objective, space, best, trials, evaluator)
        charted = best.choice if best.choice.has_ceiling else best.choice.with_clearance(space.clearance[1])
        chart_objective = replace(objective, scenes=objective.scenes[:1], levels=tuple(forces.tolist()))
        chart = evaluator.compute(
            chart_objective, [charted.scale_clearances(factor) for factor in CHART_CLEARANCES.tolist()]
        )
        nominal = replace(objective, scenes=objective.scenes[:1], density=FINE_DENSITY)
        (nominal_trial,) = evaluator.compute(nominal, [best.choice])
        evaluator.sort()
        if say is not None:
            say("preparing a test of the best design")
        check_scene = scene_with_check(scene, nominal_trial, nominal)
        expected = expected_results(check_scene, nominal_trial, workers)
    present = {channel.name for channel in scene.channels or ()}
    added = tuple(channel.name for channel in check_scene.channels or () if channel.name not in present)
    return Design(
        scene=check_scene,
        added_channels=added,
        expected=expected,
        best=best,
        bare=objective.bare_peak,
        tolerance=tolerance,
        modes=modes,
        flight=compute_flight(objective, best, is_ceiling_unreached=np.isinf(tolerance.high)),
        tuned=best_tuned_mass(
            objective, sorted({body for bodies in space.locations for body in bodies}), best.choice.mass
        ),
        trials=tuple(trials),
        question=objective,
        space=space,
        levels=forces,
        clearance_factors=CHART_CLEARANCES,
        charted=charted,
        chart=tuple(trial.peaks for trial in chart),
    )


def chart_levels(requested: Sequence[float]) -> Array:
    """Return the requested levels, with further levels between and beyond them [N].

    >>> chart_levels([1.0, 4.0]).round(2).tolist()
    [0.5, 0.71, 1.0, 1.41, 2.0, 2.83, 4.0, 5.66, 8.0]
    """
    middle = (requested[0] * requested[-1]) ** 0.5
    anchors = [
        min(requested[0] / CHART_MARGIN, middle / MIN_LEVEL_RATIO),
        *requested,
        max(requested[-1] * CHART_MARGIN, middle * MIN_LEVEL_RATIO),
    ]
    steps = [max(round(np.log(high / low) / np.log(LEVEL_STEP_RATIO)), 1) for low, high in pairwise(anchors)]
    inner = [np.geomspace(*ends, n + 1)[1:-1] for ends, n in zip(pairwise(anchors), steps, strict=True)]
    return np.unique(np.concatenate([anchors, *inner]))
