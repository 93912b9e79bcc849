"""Text of `rig design` on the check of a design with grains, and how well the single-mass model agrees with them."""

from collections.abc import Sequence
from pathlib import Path
from shlex import quote
from typing import NamedTuple

import numpy as np

from rig.core.results import format_number
from rig.core.scene.damper import Damper
from rig.studies.design.check import Expected


class Agreement(NamedTuple):
    """Number of operating points at which the compliances of a bed as one mass and as grains agree within 10 %."""

    agreeing: int
    settings: int


# Agreement from the table of `analysis beds`; a test compares these figures with the table.
WITHOUT_CEILING = Agreement(21, 36)
BELOW_CEILING = Agreement(6, 61)
#: Below a ceiling, the deviations of grains from one mass have this interquartile range, percent.
INTERQUARTILE_RANGE = (-50, -16)
#: Diameter of the shot in the grain simulation [m].
_SHOT_DIAMETER = 2e-3
#: Half-width of the band of the grain simulation around the peak, relative.
_BAND_HALF_WIDTH = 0.01
#: Number of frequencies in that band.
_BAND_POINTS = 3


def grain_check(dampers: Sequence[Damper], expected: Sequence[Expected], scene: Path) -> list[str]:
    """Report how well the single-mass model agrees with grains, and the command that simulates the grains.

    `dampers`: the dampers of the design; `expected`: expected results of the check; the command uses the largest peak
    among them; `scene`: file of the check.
    """
    peak = max(result.peak for result in expected)
    beds = ", ".join(_as_shot(damper) for damper in dampers)
    low, high = (f"{peak.frequency * (1.0 + offset):.4g}Hz" for offset in (-_BAND_HALF_WIDTH, _BAND_HALF_WIDTH))
    without, below = WITHOUT_CEILING, BELOW_CEILING
    largest_decrease, smallest_decrease = (-deviation for deviation in INTERQUARTILE_RANGE)
    return [
        "these results are for beds that move as one mass. Simulated beds of grains (analysis beds) had the same",
        f"compliance within 10 % in {without.agreeing} of {without.settings} cases without a ceiling, and in "
        f"{below.agreeing} of {below.settings} cases with a ceiling.",
        f"With a ceiling, the compliance with grains was typically {smallest_decrease} to {largest_decrease} % lower "
        "(interquartile range).",
        f"To simulate these dampers with shot of {format_number(1e3 * _SHOT_DIAMETER)} mm (which may take hours), run:",
        f"rig grains {quote(str(scene))} --set {quote(f'dampers=[{beds}]')} "
        f"--set test.force={format_number(peak.level)}N --from {low} --to {high} --points {_BAND_POINTS} "
        f"-o {quote(str(scene.with_name(f'{scene.stem}-grains.csv')))}",
    ]


def _as_shot(damper: Damper) -> str:
    assert damper.mass is not None  # every damper of a design has a mass
    mass, shot = (format_number(1e3 * value) for value in (damper.mass, _SHOT_DIAMETER))
    clearance = ".inf" if np.isinf(damper.clearance) else f"{format_number(1e3 * damper.clearance)} mm"
    return f"{{body: {damper.body}, mass: {mass} g, clearance: {clearance}, grains: {{diameter: {shot} mm}}}}"
