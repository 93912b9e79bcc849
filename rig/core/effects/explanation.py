"""Effects that a scene turns on, and the number of states that each adds to the simulation, for `rig explain`.

Effects that are not in the scene are not modeled.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.core.base.escaping import escape_html
from rig.core.base.extensions import registered_functions
from rig.core.base.figure_types import Axes
from rig.core.results import Result
from rig.core.scene.loading import SceneLike, scene_of
from rig.core.scene.scene import Scene
from rig.core.scene.shaker import Shaker
from rig.core.scene.structure import Dashpots, ModalDamping, RayleighDamping, Structure
from rig.core.system.assembly import assemble
from rig.core.system.hybrid_system import HybridSystem
from rig.core.system.spheres import spheres_of
from rig.core.system.structural_model import SpringMass, StructuralModel, structural_model

#: Maximum number of listed natural frequencies, so that the list fits into one line.
_MAX_LISTED = 7


@dataclass(frozen=True)
class Effect:
    """An effect that the scene turns on."""

    part: str
    """Part of the simulation: "motion", or a name from another package ("channel body1", "recording")."""
    name: str
    states: int  # Number of added states
    detail: str = ""  # Parameters in words


@dataclass(frozen=True, repr=False)
class Explanation(Result):
    """The effects of a scene, in the order of the signal path: motion, measurement channels, recording.

    `str` makes a table of them.

    Attributes
    ----------
    title : str
        The scene's name.
    absent : tuple of str
        Names of the effects on the motion that the scene does not turn on: they add no states and cost no CPU time.
    """

    title: str
    effects: tuple[Effect, ...]
    absent: tuple[str, ...]

    @property
    def states(self) -> dict[str, int]:
        """Number of states in each part of the signal path."""
        total: dict[str, int] = {}
        for effect in self.effects:
            total[effect.part] = total.get(effect.part, 0) + effect.states
        return total

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return part, name, number of states and details of each effect."""
        return {
            "part": np.array([effect.part for effect in self.effects], dtype=str),
            "effect": np.array([effect.name for effect in self.effects], dtype=str),
            "states": np.array([effect.states for effect in self.effects]),
            "detail": np.array([effect.detail for effect in self.effects], dtype=str),
        }

    def summary(self) -> str:
        """Return the numbers of effects and states in words."""
        return f"{self.title}: {len(self.effects)} effects, {sum(self.states.values())} states"

    def draw(self, ax: Axes, **style: Any) -> None:
        """Draw the number of states in each part of the signal path as bars."""
        ax.barh(list(self.states), list(self.states.values()), **style)
        ax.invert_yaxis()
        ax.set(xlabel="states", title=self.title)

    def _repr_html_(self) -> str:
        return f"<pre>{escape_html(str(self))}</pre>"

    def __str__(self) -> str:
        width = max(len(effect.name) for effect in self.effects) + 2
        # Parts with the same effects, such as the channels of a test, share one list.
        parts_of_rows: dict[tuple[str, ...], list[str]] = {}
        for part, states in self.states.items():
            rows = tuple(
                f"  {effect.name:{width}}{effect.states or '-':>3}  {effect.detail}".rstrip()
                for effect in self.effects
                if effect.part == part
            )
            parts_of_rows.setdefault(rows, []).append(f"{part}: {states} state{'' if states == 1 else 's'}")
        lines = [self.title]
        for rows, parts in parts_of_rows.items():
            lines += ["", *parts, *rows]
        if self.absent:
            lines += ["", f"not in the scene, so not modeled: {', '.join(self.absent)}"]
        return "\n".join(lines)


def explain(scene: SceneLike) -> Explanation:
    """List the effects that a scene turns on, and the number of states that each adds.

    Parameters
    ----------
    scene : Scene, str, Path or mapping
        A scene, or an argument of `rig.load`.

    Returns
    -------
    Explanation
        Effects with their states, and the effects that are off.

    Examples
    --------
    >>> import rig
    >>> rig.explain("reference-B").states["motion"]
    8
    """
    scene = scene_of(scene)
    effects = list(motion_effects(scene))
    names = {effect.name for effect in effects}
    optional_effects = (
        "particle dampers",
        "ceilings",
        "restitution",
        "finite-duration contact",
        "masses on springs",
        "grains",
        "coil spring and table",
        "coil current",
    )
    for registered_effects in registered_functions("shotrig.effects"):
        effects += registered_effects(scene)
    return Explanation(scene.name, tuple(effects), tuple(name for name in optional_effects if name not in names))


def motion_effects(scene: Scene) -> Iterable[Effect]:
    """List the effects on the motion; their states add up to those of the assembled system."""
    system = assemble(scene)
    bodies = scene.structure.bodies
    noun = "body" if bodies == 1 else "bodies"
    form = "given by matrices" if scene.structure.matrices is not None else "on springs"
    names = "" if scene.structure.names is None else f" ({', '.join(scene.structure.names[:_MAX_LISTED])})"
    detail = f"{bodies} {noun} {form}{names}, {_frequencies_text(structural_model(scene))}, {_damping_text(scene)}"
    yield Effect("motion", "structure", 2 * bodies, detail)
    if system.impacts_interact:
        has_shared_body = np.unique(system.damper_coordinate).size < system.dampers
        reason = "several dampers in a body" if has_shared_body else "full mass matrix"
        yield Effect("motion", "coupled impacts", 0, f"{reason}: all simultaneous contacts are solved together")
    for shaker in scene.shakers:
        yield from _shaker_effects(shaker, scene)
    yield from _damper_effects(scene, system)
    if scene.joints:
        texts = (joint.text(scene.structure.label) for joint in scene.joints)
        sliders = sum(element.slider >= 0 for element in system.elements)
        yield Effect("motion", "joints", 2 * sliders, "; ".join(texts))


def _frequencies_text(model: StructuralModel) -> str:
    """List the natural frequencies of a structure; they reveal a wrong unit in the scene."""
    texts = [f"{frequency:.4g}" for frequency in model.modes.frequency]
    if len(texts) > _MAX_LISTED:
        texts = [*texts[: _MAX_LISTED - 1], "...", texts[-1]]
    return f"{', '.join(texts)} Hz"


def _damping_text(scene: Scene) -> str:
    match scene.structure.damping:
        case ModalDamping(modal=ratio):
            ratios = ratio if isinstance(ratio, tuple) else (ratio,)
            return f"modal damping {', '.join(f'{100 * r:.3g} %' for r in ratios)}"
        case RayleighDamping(rayleigh=coefficients):
            return f"Rayleigh damping {coefficients.alpha:.3g} 1/s, {coefficients.beta:.3g} s"
        case Dashpots():
            return "dashpots along the chain"
    matrices = scene.structure.matrices
    return "undamped" if matrices is None or matrices.damping is None else "a damping matrix"


def _shaker_effects(shaker: Shaker, scene: Scene) -> Iterable[Effect]:

    def modes_at_rest() -> str:
        driven = [body - 1 for body in shaker.bodies]
        return _frequencies_text(structural_model(scene).with_ground_springs(driven, shaker.coil_spring or 0.0))

    for effect in shaker.effects(scene.structure.listed(shaker.bodies), modes_at_rest):
        yield Effect("motion", *effect)


def _damper_effects(scene: Scene, system: HybridSystem) -> Iterable[Effect]:
    """List the effects of the dampers; a locked damper cannot move in its cavity, and has no states."""
    locked = len(scene.dampers) - system.dampers
    if locked:
        yield Effect("motion", "locked dampers", 0, f"{locked}, part of their bodies' masses")
    if not system.dampers:
        return
    for row, spheres in spheres_of(scene).items():
        body = scene.structure.label(scene.dampers[row].body)
        yield Effect(
            "motion", "grains", 9 * spheres.count,
            f"in {body}: {spheres.count} of {1e3 * spheres.settings.diameter:.4g} mm, {1e3 * spheres.mass:.4g} g; "
            f"position, velocity and angular velocity of each; time step {1e6 * spheres.longest_step():.3g} µs",
        )  # fmt: skip
    on_springs = structural_model(scene).tuned
    if on_springs:
        texts = "; ".join(_spring_mass_text(mass, scene) for mass in on_springs)
        yield Effect("motion", "masses on springs", 2 * len(on_springs), texts)
    sliding = [j for j, number in enumerate(system.damper_number) if scene.dampers[number - 1].friction is not None]
    if sliding:
        texts = "; ".join(_sliding_mass_text(system, j, scene) for j in sliding)
        yield Effect("motion", "sliding masses", 2 * len(sliding), texts)
    # Dampers whose particles are modeled as one mass.
    one_mass = ~system.grains & ~np.isin(system.damper_number - 1, [mass.damper for mass in on_springs])
    one_mass[sliding] = False
    if one_mass.any():
        bodies = scene.structure.listed(int(row) + 1 for row in system.damper_coordinate[one_mass])
        masses = ", ".join(f"{1e3 * mass:.4g} g" for mass in system.damper_mass[one_mass])
        yield Effect(
            "motion", "particle dampers", 2 * int(one_mass.sum()),
            f"in {bodies}: {masses}; height and speed of each in flight; gravity {system.gravity:.6g} m/s²",
        )  # fmt: skip
    ceilings = np.isfinite(system.clearance) & one_mass
    if ceilings.any():
        clearances = ", ".join(f"{1e3 * clearance:.4g} mm" for clearance in system.clearance[ceilings])
        yield Effect("motion", "ceilings", 0, f"clearance {clearances}")
    if system.restitution.any():
        ratios = (
            f"{ratio:.3g} in {scene.structure.label(int(row) + 1)}"
            for ratio, row in zip(system.restitution, system.damper_coordinate, strict=True)
        )
        yield Effect("motion", "restitution", 0, ", ".join(ratios))
    if system.finite_contact[: system.dampers].any():
        yield Effect("motion", "finite-duration contact", 0, "; ".join(_wall_texts(system, scene.structure)))


def _spring_mass_text(mass: SpringMass, scene: Scene) -> str:
    """Describe a mass on a spring, with natural frequency and damping ratio on a body at rest, and its walls."""
    omega = math.sqrt(mass.stiffness / mass.mass)
    return (
        f"in {scene.structure.label(mass.body + 1)}: {1e3 * mass.mass:.4g} g on {mass.stiffness:.4g} N/m and "
        f"{mass.damping:.4g} N s/m ({omega / (2.0 * math.pi):.4g} Hz, damping ratio "
        f"{50.0 * mass.damping / (mass.mass * omega):.3g} %), {scene.dampers[mass.damper].walls_text}"
    )


def _sliding_mass_text(system: HybridSystem, j: int, scene: Scene) -> str:
    """Describe a mass that slides with friction: the slip force, and the acceleration at which it slips."""
    damper, mass = scene.dampers[system.damper_number[j] - 1], system.damper_mass[j]
    acceleration = (damper.friction or 0.0) * system.gravity
    friction = f"slips above {acceleration:.4g} m/s² ({mass * acceleration:.4g} N)" if acceleration else "no friction"
    walls = f"{1e3 * damper.clearance:.4g} mm between walls" if math.isfinite(damper.clearance) else "no walls"
    return f"in {scene.structure.label(damper.body)}: {1e3 * mass:.4g} g, {friction}, {walls}"


def _wall_texts(system: HybridSystem, structure: Structure) -> Iterable[str]:
    """Describe floor and ceiling of each damper with finite-duration contact."""
    for j in np.flatnonzero(system.finite_contact[: system.dampers]):
        texts = []
        for wall in (1, 2):  # floor, ceiling
            stiffness, damping = system.wall_stiffness[j, wall - 1], system.wall_damping[j, wall - 1]
            duration, restitution = system.duration_and_restitution(int(j), wall)
            texts.append(
                f"{stiffness:.4g} N/m, {damping:.4g} N s/m (contact duration {1e3 * duration:.4g} ms, restitution "
                f"{restitution:.3g})"
            )
        if not np.isfinite(system.clearance[j]):
            texts = [f"floor {texts[0]}"]
        elif texts[0] != texts[1]:
            texts = [f"floor {texts[0]}", f"ceiling {texts[1]}"]
        else:
            texts = [f"floor and ceiling {texts[0]}"]
        yield f"{structure.label(int(system.damper_coordinate[j]) + 1)}: {', '.join(texts)}"
