"""Candidate designs, the impact law of their dampers, the search space, and the objective."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, product

import numpy as np

from rig.core.base.arrays import Array
from rig.core.base.errors import SceneError
from rig.core.base.study import digest
from rig.core.orbits.problem import Axis, OrbitProblem
from rig.core.results import format_number
from rig.core.results.ratio_names import frf_display
from rig.core.scene.damper import Contact, Damper, SpringDamper, TimedContact, walls_of
from rig.core.scene.scene import Scene
from rig.core.system.structural_model import structural_model
from rig.studies.design.worst_peak import Peak, linear_peak, peak_at
from rig.studies.motion_map.grid import natural_frequencies, select_frequencies

#: Number of frequencies per natural frequency during the search, which only ranks the designs.
COARSE_DENSITY = 20
#: Number of frequencies per natural frequency in the comparison of the best designs, whose peaks must be resolved.
FINE_DENSITY = 60


@dataclass(frozen=True)
class ImpactLaw:
    """Restitution and contact of all new dampers."""

    restitution: float = 0.0  # ratio of rebound speed to closing speed
    contact: Contact | None = None  # finite-duration contact with floor and ceiling; None: instantaneous impact
    origin: str = "the scene has no dampers"  # origin of restitution and contact, for messages

    def __str__(self) -> str:
        """Describe the impact law.

        >>> print(ImpactLaw(0.2, origin="as in the scene"))
        impacts of the new dampers: instantaneous, restitution 0.2 (as in the scene)
        """
        contact, restitution = _format_contact(self.contact), format_number(self.restitution)
        return f"impacts of the new dampers: {contact}, restitution {restitution} ({self.origin})"


#: Impact law for scenes without dampers: perfectly plastic and instantaneous.
INSTANTANEOUS = ImpactLaw()


def impact_law_of(dampers: Sequence[Damper]) -> ImpactLaw:
    """Return the impact law of the dampers of a scene; if the laws differ, the law of the first damper.

    Raises `SceneError` if the contact is given by stiffness and damping, which suit one damper mass only.
    """
    if not dampers:
        return INSTANTANEOUS
    first = dampers[0]
    contact = first.contact
    if any(isinstance(wall, SpringDamper) for wall in walls_of(contact)):
        raise SceneError(
            "dampers[1].contact: stiffness and damping apply to one damper mass, but the design varies the mass. Give "
            "a contact duration instead, such as --set 'dampers[1].contact={duration: 4 ms}'."
        )
    identical = all(
        (damper.restitution, damper.contact, damper.grains) == (first.restitution, contact, first.grains)
        for damper in dampers
    )
    origin = "as in the scene" if identical else "as in the first damper of the scene; other dampers differ"
    if first.grains is not None:
        origin = "as in the scene; its beds of grains are treated as single masses"
    return ImpactLaw(first.restitution, contact, origin)


def _format_contact(contact: Contact | None) -> str:
    timed = [wall for wall in walls_of(contact) if isinstance(wall, TimedContact)]
    durations = [f"{format_number(1e3 * wall.duration)} ms" for wall in timed]
    if len(durations) == 2:
        return f"duration {durations[0]} on floors and {durations[1]} on ceilings"
    return f"duration {durations[0]}" if durations else "instantaneous"


def mass_unit(mass: float) -> tuple[float, str]:
    """Return (units per kilogram, unit) for the display of a mass [kg]."""
    return (1e3, "g") if mass < 1.0 else (1.0, "kg")


def rounded(length: float) -> float:
    """Round a length to four digits, so the length in the scene file is exactly the length of the computed design.

    >>> rounded(0.001631850779875702)
    0.001632
    """
    return float(f"{length:.4g}")


@dataclass(frozen=True, order=True)
class Choice:
    """A candidate design: body (from 1), mass [kg] and clearance [m, infinite without a ceiling] of each damper.

    >>> print(Choice((2,), (0.0451,), (1.18e-3,)))
    45.1 g in body 2, clearance 1.18 mm
    """

    bodies: tuple[int, ...]
    masses: tuple[float, ...]
    clearances: tuple[float, ...]

    def __str__(self) -> str:
        texts = []
        for mass, body, clearance in zip(self.masses, self.bodies, self.clearances, strict=True):
            factor, unit = mass_unit(mass)
            ceiling = "no ceiling" if np.isinf(clearance) else f"clearance {format_number(1e3 * clearance)} mm"
            texts.append(f"{format_number(factor * mass)} {unit} in body {body}, {ceiling}")
        return "; ".join(texts)

    @property
    def mass(self) -> float:
        """Total added mass [kg]."""
        return sum(self.masses)

    @property
    def has_ceiling(self) -> bool:
        """Whether any damper has a ceiling."""
        return bool(np.isfinite(self.clearances).any())

    def without_ceiling(self) -> Choice:
        """Remove all ceilings."""
        return self.with_clearance(np.inf)

    def with_clearance(self, clearance: float) -> Choice:
        """Set all clearances to the same value."""
        return replace(self, clearances=(clearance,) * len(self.clearances))

    def scale_clearances(self, factor: float) -> Choice:
        """Multiply all clearances by a factor."""
        return replace(self, clearances=tuple(rounded(factor * clearance) for clearance in self.clearances))

    @property
    def heaviest_index(self) -> int:
        """Index of the heaviest damper, from 0; the first of equally heavy dampers."""
        return self.masses.index(max(self.masses))

    def without_lightest(self) -> Choice:
        """Remove the lightest damper, and distribute its mass over the other dampers in proportion to their masses.

        >>> print(Choice((3, 4), (0.0002, 0.0698), (8e-3, 7e-3)).without_lightest())
        70 g in body 4, clearance 7 mm
        """
        rows = list(zip(self.bodies, self.masses, self.clearances, strict=True))
        del rows[self.masses.index(min(self.masses))]
        bodies, masses, clearances = zip(*rows, strict=True)
        factor = self.mass / sum(masses)
        return Choice(bodies, tuple(factor * mass for mass in masses), clearances)

    def dampers(self, impact_law: ImpactLaw) -> list[Damper]:
        """Return the dampers as objects of a scene."""
        rows = zip(self.bodies, self.masses, self.clearances, strict=True)
        properties = {"restitution": impact_law.restitution, "contact": impact_law.contact}
        return [Damper(body=b, mass=m, clearance=c, **properties) for b, m, c in rows]


@dataclass(frozen=True)
class Trial:
    """A candidate design with its computed peaks."""

    choice: Choice  # the dampers
    peaks: tuple[Peak, ...]  # worst peak at each level, in the order of the objective's levels

    @property
    def peak(self) -> Peak:
        """Worst peak over all levels."""
        return max(self.peaks)

    @property
    def mean_peak(self) -> float:
        """Geometric mean of the peaks at all levels (the mean in dB), as `Peak.magnitude`."""
        return float(np.exp(np.mean(np.log([peak.magnitude for peak in self.peaks]))))


@dataclass(frozen=True)
class SearchSpace:
    """The space of candidate designs."""

    locations: tuple[tuple[int, ...], ...]  # bodies of the dampers in each allowed arrangement, fewest dampers first
    max_mass: float  # largest added mass [kg]
    clearance: tuple[float, float]  # smallest and largest [m]
    allows_no_ceiling: bool = True  # whether designs without ceilings belong to the space

    @property
    def max_dampers(self) -> int:
        """Maximum number of dampers."""
        return max(map(len, self.locations))

    @staticmethod
    def locations_of(bodies: tuple[int, ...], dampers: int) -> tuple[tuple[int, ...], ...]:
        """List the arrangements of up to `dampers` dampers; a body that is named n times may carry n dampers.

        >>> SearchSpace.locations_of((1, 2, 2), 2)
        ((1,), (2,), (1, 2), (2, 2))
        """
        return tuple(
            location for count in range(1, dampers + 1) for location in sorted(set(combinations(bodies, count)))
        )


@dataclass(frozen=True)
class Objective:
    """The objective of a design: its worst peak over structures, levels, frequencies and bodies."""

    scenes: tuple[Scene, ...]  # nominal structure without dampers first, then its variants
    levels: tuple[float, ...]  # force amplitudes [N], or drives
    band: tuple[float, float]  # lowest and highest frequency [Hz]
    bodies: tuple[int, ...]  # bodies whose peaks are evaluated, from 1
    impact_law: ImpactLaw = INSTANTANEOUS  # restitution and contact of the dampers
    density: int = COARSE_DENSITY  # number of frequencies per natural frequency in the band

    @property
    def level(self) -> Axis:
        """The level as an axis: its name, unit and label."""
        return OrbitProblem(self.scenes[0]).axis("drive")

    @property
    def response_display(self) -> tuple[str, str, float]:
        """Name of the response, the unit in which it is printed, and the factor from SI to that unit."""
        return frf_display(self.scenes[0].reference)

    @cached_property
    def bare_peak(self) -> Peak:
        """Worst peak without dampers, which is the same at every level."""
        return max(linear_peak(scene, self.levels[0], self.frequencies(scene), self.bodies) for scene in self.scenes)

    @cached_property
    def subproblems(self) -> tuple[Objective, ...]:
        """Objectives for one structure at one level each, in the order of structures, then levels."""
        return tuple(
            replace(self, scenes=(scene,), levels=(level,)) for scene, level in product(self.scenes, self.levels)
        )

    @cached_property
    def digest(self) -> str:
        """Digest of everything that affects the results."""
        scenes = [scene.to_si_yaml() for scene in self.scenes]
        impact_law = self.impact_law.restitution, self.impact_law.contact
        return digest((scenes, self.levels, self.band, self.bodies, impact_law, self.density))

    def worst(self, choice: Choice) -> Peak:
        """Compute the worst peak of a design at all levels, for all structures."""
        peaks = []
        for scene in self.scenes:
            damped = scene.replace(dampers=choice.dampers(self.impact_law))
            problem, frequencies = OrbitProblem(damped), self.frequencies(damped)
            peaks += [peak_at(problem, level, frequencies, self.bodies) for level in self.levels]
        return max(peaks)

    def frequencies(self, scene: Scene) -> Array:
        """Return frequencies, dense between the resonances without dampers and with resting dampers."""
        low, high = self.band
        natural = natural_frequencies(scene, low, high)
        if not len(natural):
            raise SceneError(
                f"band: got {low:g} to {high:g} Hz; expected a band that contains a natural frequency of the structure "
                "(see rig explain)"
            )
        points = 8 + self.density * -(-len(natural) // 2)  # rounded up
        return np.unique(np.concatenate([select_frequencies(scene, low, high, points), natural]))


def variants(scene: Scene, damping: float, stiffness: float) -> tuple[Scene, ...]:
    """Return the nominal scene, then variants with the largest relative deviations of `damping` and `stiffness`."""
    nominal = structural_model(scene)
    factors = product(*({1.0 - uncertainty, 1.0 + uncertainty} for uncertainty in (damping, stiffness)))
    variations = [
        scene.replace(
            structure={
                "matrices": {
                    "mass": nominal.mass.tolist(),
                    "damping": (damping_scale * nominal.damping).tolist(),
                    "stiffness": (stiffness_scale * nominal.stiffness).tolist(),
                }
            }
        )
        for damping_scale, stiffness_scale in sorted(factors)
        if (damping_scale, stiffness_scale) != (1.0, 1.0)
    ]
    return (scene, *variations)
