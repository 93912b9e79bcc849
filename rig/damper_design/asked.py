"""What is asked of a design: read from words, filled in from the scene, and checked."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rig.damper_design.choice import Question, Space, variants
from rig.errors import SceneError
from rig.motion_map.grid import columns
from rig.scene.quantities import MASS, RATIO, Kind, parse
from rig.scene.scene import Scene
from rig.system.open_loop_drive import level_of, with_ideal_force
from rig.system.structure import structure_matrices

#: Levels that a design must do well at unless told, relative to that of the scene's test.
LEVELS = (0.5, 1.0, 2.0)
#: Clearances to choose from unless told, relative to the largest motion without dampers at the smallest and the largest
#: level: with dampers that do well the motion is a tenth to a third of it, and their clearance about twice that.
NARROWEST, WIDEST = 0.03, 1.5
#: Share of the structure's mass that may be added, unless told.
BUDGET = 0.05


def mass_of(text: str | None, scene: Scene) -> float | None:
    """Read a mass, or a share of the structure's [kg].

    Raises
    ------
    SceneError
        If it is neither.
    """
    if text is None:
        return None
    try:
        return parse(text, MASS) if text.rstrip().endswith("g") else parse(text, RATIO) * total_mass(scene)
    except ValueError:
        raise SceneError(
            f"--budget: got {text[:60]}; expected a mass such as '50 g', or a share such as '5 %'"
        ) from None


def bodies_of(text: str | None, name: str) -> tuple[int, ...] | None:
    """Read a list of bodies with commas between.

    Raises
    ------
    SceneError
        If it is none.
    """
    try:
        return None if text is None else tuple(int(word) for word in text.split(","))
    except ValueError:
        raise SceneError(
            f"{name}: got {text}; expected numbers of bodies with commas between, such as 1,3"
        ) from None


def quantities(text: str | None, kind: Kind, name: str) -> tuple[float, ...] | None:
    """Read a list of quantities with commas between.

    Raises
    ------
    SceneError
        If it is none.
    """
    try:
        return None if text is None else tuple(parse(word.strip(), kind) for word in text.split(","))
    except ValueError as error:
        raise SceneError(f"{name}: {error}") from None


def range_of(text: str | None, kind: Kind, name: str) -> tuple[float, float] | None:
    """Read two quantities with a comma between.

    Raises
    ------
    SceneError
        If there are not two.
    """
    found = quantities(text, kind, name)
    if found is None:
        return None
    if len(found) != 2:
        raise SceneError(f"{name}: got {len(found)} values; expected two, with a comma between")
    return found[0], found[1]


def total_mass(scene: Scene) -> float:
    """Give the mass of the structure without dampers, kg."""
    return float(np.trace(structure_matrices(scene.structure)[0]))


def asked(
    scene: Scene,
    budget: float | None,
    bodies: Sequence[int] | None,
    dampers: int,
    clearance: tuple[float, float] | None,
    levels: Sequence[float] | None,
    band: tuple[float, float] | None,
    watched: Sequence[int] | None,
    uncertain: tuple[float, float],
) -> tuple[Question, Space]:
    """Fill in what was not told, and check it; parameters as of `rig.design`.

    Raises
    ------
    SceneError
        If that leaves nothing to choose or nothing to drive the structure with.
    """
    everywhere = tuple(range(1, scene.structure.bodies + 1))
    may_carry, count = tuple(sorted(set(bodies or everywhere))), tuple(sorted(set(watched or everywhere)))
    for name, given in (("bodies", may_carry), ("watched", count)):
        if set(given) - set(everywhere):
            raise SceneError(f"{name}: got {given}; expected numbers from 1 to {everywhere[-1]}")
    if not 1 <= dampers <= len(may_carry):
        raise SceneError(
            f"dampers: got {dampers}; expected 1 to {len(may_carry)}, one for each body that may carry one"
        )
    if not all(0.0 <= share < 0.9 for share in uncertain):
        raise SceneError(f"uncertain: got {uncertain}; expected two shares from 0 to below 90 %")
    total = total_mass(scene)
    most = BUDGET * total if budget is None else budget
    if not 0.0 < most < total:
        raise SceneError(
            f"budget: got {most:g} kg; expected more than nothing and less than the structure's {total:g} kg"
        )
    if scene.gravity == 0.0:
        raise SceneError("gravity: got 0; expected more: beds that do not fall do not strike as these do")
    restitution = scene.dampers[0].restitution if scene.dampers else 0.0
    plain = with_ideal_force(scene.replace(dampers=[], channels=None))
    nominal = level_of(plain)
    forces = tuple(sorted(float(f) for f in (levels or [nominal * factor for factor in LEVELS])))
    if not all(np.isfinite(f) and f > 0.0 for f in forces):
        raise SceneError(f"levels: got {forces}; expected positive forces")
    ends = band or tuple(columns(plain, points=2).tolist())
    places = Space.places_of(may_carry, dampers)
    question = Question(variants(plain, *uncertain), forces, (ends[0], ends[1]), count, restitution)
    if clearance is None:
        motion = question.bare.size
        clearance = NARROWEST * motion * forces[0], WIDEST * motion * forces[-1]
    if not 0.0 < clearance[0] < clearance[1] < np.inf:
        raise SceneError(f"clearance: got {clearance}; expected the smaller one first, above zero")
    return question, Space(places, most, clearance)
