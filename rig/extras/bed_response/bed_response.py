"""Steady-state motion of beds of grains at each frequency, compared with single-mass models, for `rig grains`.

A *bed* is the particles of one damper; LAMMPS moves its grains by the discrete element method. Worker processes compute
the motion at each frequency, and a table stores it.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.core.base.errors import SceneError
from rig.core.base.figure_types import Axes
from rig.core.base.progress import CountProgress
from rig.core.base.study import Study, digest
from rig.core.results import Result, complete_style, format_decimals
from rig.core.scene.loading import SceneLike, scene_of
from rig.core.scene.scene import Scene
from rig.core.settings.quantities import FREQUENCY, count, positive_values
from rig.core.system.spheres import spheres_of
from rig.extras.bed_response.steady_bed import SteadyBed, steady_grains, steady_mass
from rig.extras.grains.lammps_library import lammps_version
from rig.extras.grains.packing import settled_positions

#: The results are averaged over blocks of this number of periods of the drive.
PERIODS = 20
#: Maximum number of simulated blocks: grains may rearrange for hours without a steady state.
MAX_BLOCKS = 20


class _Case(NamedTuple):
    """Arguments of `steady_grains` at one frequency."""

    scene: Scene
    frequency: float  # Hz
    periods: int


@dataclass(frozen=True, repr=False)
class BedResponse(Result):
    """Steady-state motion at each frequency, with beds of grains and with each bed modeled as one mass.

    Attributes
    ----------
    frequency : ndarray, shape (frequencies,)
        Hz.
    grains, mass : tuple of SteadyBed
        Motion at each frequency with beds of grains, and with each bed modeled as one mass.
    """

    frequency: NDArray[np.float64]
    grains: tuple[SteadyBed, ...]
    mass: tuple[SteadyBed, ...]

    def summary(self) -> str:
        """Describe the largest deviation of the compliance with one mass from the compliance with grains."""
        grains, mass = (np.abs([each.compliance for each in motions]) for motions in (self.grains, self.mass))
        deviation = mass / grains - 1.0
        k, body = np.unravel_index(np.argmax(np.abs(deviation)), deviation.shape)
        n_steady = [sum(each.steady for each in motions) for motions in (self.grains, self.mass)]
        return (
            f"{len(deviation)} frequencies; steady motion at {n_steady[0]} of them with grains, at {n_steady[1]} with "
            "one mass. Largest deviation of the compliance with one mass from the compliance with grains: "
            f"{100 * deviation[k, body]:+.3g} % (body {body + 1}, {self.frequency[k]:.6g} Hz)"
        )

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return all quantities of both models, named with unit and number of the body or bed."""
        table: dict[str, NDArray[Any]] = {"frequency_Hz": self.frequency}
        for model, motions in (("grains", self.grains), ("mass", self.mass)):
            for name, attribute in (
                ("compliance_m/N", "compliance"),
                ("floor_impulse_N*s", "floor_impulse"),
                ("ceiling_impulse_N*s", "ceiling_impulse"),
                ("energy_J", "energy"),
                ("landing_deg", "landing"),
                ("flight_share", "flight"),
                ("motion_type", "motion_type"),
            ):
                values = np.array([getattr(each, attribute) for each in motions])
                for row in range(values.shape[1]):
                    table[f"{model} {name} {row + 1}"] = values[:, row]
            table[f"{model} steady"] = np.array([each.steady for each in motions])
        return table

    def draw(self, ax: Axes, **style: Any) -> None:
        """Draw the compliance of each body, with grains as points and with one mass as a line."""
        for body in range(len(self.mass[0].compliance)):
            mass = [1e6 * abs(each.compliance[body]) for each in self.mass]
            (line,) = ax.semilogy(
                self.frequency, mass, **complete_style(style, label=f"body {body + 1}, bed as one mass")
            )
            grains = [1e6 * abs(each.compliance[body]) for each in self.grains]
            ax.plot(self.frequency, grains, "o", color=line.get_color(), label=f"body {body + 1}, grains")
        ax.set(xlabel="frequency / Hz", ylabel="compliance / (µm/N)")


def bed_response(
    scene: SceneLike,
    frequencies: Sequence[float] | Sequence[str],
    periods: int = PERIODS,
    table: Path | None = None,
    cluster: str | None = None,
    progress: CountProgress | None = None,
) -> BedResponse:
    """Simulate beds of grains at each frequency until their motion is steady, and each bed modeled as one mass.

    The result at each frequency is the mean of the two blocks of periods whose compliances agree within 1 %.
    `frequencies`: Hz, or strings with units; the other arguments are those of `rig.grains`. Raises `SceneError` if no
    damper is a bed of grains that can move, or LAMMPS is not installed. Raises `RunError` if the table cannot be read
    or written.
    """
    scene, periods = scene_of(scene), count(periods, 1, "periods")
    requested = np.asarray(positive_values(frequencies, FREQUENCY, "frequencies"), dtype=np.float64)
    if not spheres_of(scene):
        raise SceneError(
            f"scene {scene.name!r} has no bed of grains that can move. Add grains: {{diameter: 2 mm}} to a damper that "
            "is not locked."
        )
    if scene.reference == "table":
        raise SceneError(
            f"scene {scene.name!r}: the structure is excited at its base, so it has no compliance. Compare "
            "recordings of grains and of one mass with analysis compare, or use a shaker of a different kind."
        )
    cases = [_Case(scene, float(frequency), periods) for frequency in requested]

    def pack() -> None:
        # The beds are packed once and stored, so all workers can read them.
        for spheres in spheres_of(scene).values():
            settled_positions(spheres)

    motions = _STUDY.run(cases, table, cluster, progress, pack)
    return BedResponse(requested, tuple(grains for grains, _ in motions), tuple(mass for _, mass in motions))


def format_table(response: BedResponse) -> str:
    """Format a response as a table; each frequency has one row for the grains and one for the single mass."""
    titles = ("floor N s", 12), ("ceiling N s", 12), ("loss J", 11), ("landing", 9), ("flight", 8)
    lines = [f"{'Hz':>9}  {'bed':6}{'m/N':>11}{''.join(f'{title:>{width}}' for title, width in titles)}  type"]
    for frequency, *motions in zip(response.frequency, response.grains, response.mass, strict=True):
        for model, motion in zip(("grains", "mass"), motions, strict=True):
            largest = np.abs(motion.compliance).max()
            lines.append(
                f"{format_decimals(frequency, 4):>9}  {model:6}{largest:11.4g}{motion.floor_impulse[0]:12.4g}"
                f"{motion.ceiling_impulse[0]:12.4g}{motion.energy[0]:11.4g}{motion.landing[0]:8.1f}°"
                f"{100 * motion.flight[0]:6.1f} %  {motion.motion_type[0]}{'' if motion.steady else ', unsteady'}"
            )
    return "\n".join(
        [
            *lines,
            "m/N: compliance of the body with the largest motion; other columns: first bed, per period of the drive",
            "floor, ceiling: impulse on the bed; loss: energy that the bed dissipates",
            "landing: phase of the floor force after the upward zero crossing of the drive; flight: share of the time",
            "",
            response.summary(),
        ]
    )


def _compute(case: _Case) -> tuple[SteadyBed, SteadyBed]:
    scene, frequency, periods = case
    return steady_grains(scene, frequency, periods, MAX_BLOCKS), steady_mass(scene, frequency)


def _key(case: _Case) -> tuple[str, float]:
    inputs = case.scene.to_si_yaml(), case.frequency, case.periods, lammps_version()
    return digest(inputs), case.frequency


def _to_json_types(motion: SteadyBed) -> dict[str, Any]:
    stored = {name: np.asarray(value).tolist() for name, value in vars(motion).items()}
    stored["compliance"] = [[value.real, value.imag] for value in motion.compliance]
    return stored


def _parse_motion(stored: str) -> SteadyBed:
    values = json.loads(stored)
    values["compliance"] = [complex(*pair) for pair in values["compliance"]]
    lists = {name: np.array(value) for name, value in values.items() if isinstance(value, list)}
    return SteadyBed(**(values | lists))


def _to_row(key: tuple[str, float], motions: tuple[SteadyBed, SteadyBed]) -> list[str]:
    return [key[0], repr(key[1]), *(json.dumps(_to_json_types(motion)) for motion in motions)]


def _parse_row(row: list[str]) -> tuple[tuple[str, float], tuple[SteadyBed, SteadyBed]]:
    return (row[0], float(row[1])), (_parse_motion(row[2]), _parse_motion(row[3]))


_STUDY: Study[_Case, tuple[SteadyBed, SteadyBed]] = Study(
    "beds",
    ("question", "frequency_hz", "grains", "mass"),  # question: digest of all inputs
    _compute,
    _key,
    _to_row,
    _parse_row,
)
