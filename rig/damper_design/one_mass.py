"""The single-mass assumption of a design: its verified range, and how to check it with a grain simulation."""

from __future__ import annotations

from collections.abc import Sequence
from math import isinf
from pathlib import Path
from shlex import quote
from typing import NamedTuple

from rig.damper_design.check import Expected
from rig.results import format_number
from rig.scene.damper import Damper


class Agreement(NamedTuple):
    """Number of settings of a study in which one mass agreed with grains within 10 %."""

    near: int
    settings: int


# Agreement of grains with one mass, from the table of `analysis beds`; a test compares these figures with the table.
WITHOUT_CEILING = Agreement(21, 36)
BELOW_CEILING = Agreement(6, 61)
#: Interquartile range of the deviation below a ceiling, percent.
MIDDLE_HALF = (-50, -16)
#: Diameter of the shot in the grain simulation, m.
_SHOT_DIAMETER = 2e-3
#: Half-width of the band of the grain simulation around the peak, relative.
_HALF_WIDTH = 0.01
#: Number of frequencies in that band.
_POINTS = 3


def grain_check(dampers: Sequence[Damper], expected: Sequence[Expected], scene: Path) -> list[str]:
    """Report how well one mass agrees with grains, and the command that simulates these dampers as grains.

    `dampers`: the dampers of the design; `expected`: expected results of the check; the command uses the largest of
    these peaks; `scene`: the scene of the check.
    """
    peak = max(one.peak for one in expected)
    beds = ", ".join(_as_shot(damper) for damper in dampers)
    low, high = (f"{peak.frequency * (1.0 + side):.4g}Hz" for side in (-_HALF_WIDTH, _HALF_WIDTH))
    (near, settings), (near_below, below) = WITHOUT_CEILING, BELOW_CEILING
    less, least = (-off for off in MIDDLE_HALF)
    return [
        "these results are for beds that move as one mass. In a comparison with beds of grains (analysis beds)",
        f"the compliance was within 10 % in {near} of {settings} settings without a ceiling, and in {near_below} of "
        f"{below} with one,",
        f"where the middle half of the results with grains was {least} to {less} % lower. These dampers as shot of "
        f"{format_number(1e3 * _SHOT_DIAMETER)} mm, which may take hours:",
        f"rig grains {quote(str(scene))} --set {quote(f'dampers=[{beds}]')} "
        f"--set test.force={format_number(peak.level)}N --from {low} --to {high} --points {_POINTS} "
        f"-o {quote(str(scene.with_name(f'{scene.stem}-grains.csv')))}",
    ]


def _as_shot(damper: Damper) -> str:
    assert damper.mass is not None  # every damper of a design has a mass
    mass, shot = (format_number(1e3 * each) for each in (damper.mass, _SHOT_DIAMETER))
    clearance = ".inf" if isinf(damper.clearance) else f"{format_number(1e3 * damper.clearance)} mm"
    return f"{{body: {damper.body}, mass: {mass} g, clearance: {clearance}, grains: {{diameter: {shot} mm}}}}"
