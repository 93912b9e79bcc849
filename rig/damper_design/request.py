"""Parse and check a design request, with defaults from the scene."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rig.damper_design.choice import Question, Space, landings_from, variants
from rig.errors import SceneError
from rig.motion_map.grid import columns
from rig.scene.body_names import body_number
from rig.scene.quantities import FORCE, FREQUENCY, LENGTH, MASS, RATIO, Kind, number, parse, positive_values
from rig.scene.scene import Scene
from rig.scene.shaker import ForceShaker
from rig.system.open_loop_drive import level_of, with_ideal_force
from rig.system.structural_model import structural_model

#: Default force levels of the optimization, relative to the level of the scene's test.
LEVELS = (0.5, 1.0, 2.0)
#: Default range of clearances, relative to the largest displacement without dampers at the smallest and largest
#: level. Effective dampers reduce the displacement to a tenth to a third of that, and need about twice as much
#: clearance.
NARROWEST = 0.03
WIDEST = 1.5
#: Default limit of the added mass, as a share of the structure's mass.
BUDGET = 0.05


def mass_of(budget: float | str | None, scene: Scene) -> float:
    """Return the mass limit [kg] from a mass, a share of the structure's mass, or the default.

    Raises `SceneError` if it is not one of these.
    """
    if budget is None:
        return BUDGET * total_mass(scene)
    if not isinstance(budget, str):
        return budget
    try:
        if budget.rstrip().endswith("g"):
            return parse(budget, MASS)
        if not budget.rstrip().endswith("%"):
            # A bare number is ambiguous: kilograms or a share.
            raise ValueError
        return parse(budget, RATIO) * total_mass(scene)
    except ValueError:
        raise SceneError(
            f"budget: got {budget[:60]}; expected a mass such as '50 g', or a share such as '5 %'"
        ) from None


def _bodies(given: Sequence[int | str] | None, scene: Scene, name: str) -> tuple[int, ...]:
    everywhere = range(1, scene.structure.bodies + 1)
    listed = [given] if isinstance(given, int | str) else given
    try:
        return tuple(
            sorted(body_number(one, scene.structure.names, len(everywhere)) for one in listed or everywhere)
        )
    except SceneError as error:
        raise SceneError(f"{name}: {error}") from None


def _range(given: Sequence[float | str], kind: Kind, name: str) -> tuple[float, float]:
    ends = positive_values(given, kind, name).tolist()
    if len(ends) != 2 or not ends[0] < ends[1]:
        raise SceneError(f"{name}: got {', '.join(map(str, given))}; expected two, the smaller one first")
    return ends[0], ends[1]


def _under_force(scene: Scene, levels: Sequence[float | str] | None) -> Scene:
    """Replace a drive level of the test by a controlled force, because the levels are forces."""
    if getattr(scene.test, "drive", None) is None or isinstance(scene.driven_shaker, ForceShaker):
        return scene
    if levels is None:
        raise SceneError(
            "levels: not given, and the test of the scene states a drive, not a force. Give forces, as in --levels 3N."
        )
    assert scene.test is not None
    return scene.replace(test=scene.test.replace(drive=None, force=levels[0]))


def total_mass(scene: Scene) -> float:
    """Return the mass of the structure without dampers, kg."""
    return float(np.trace(structural_model(scene).mass))


def parse_request(
    scene: Scene,
    *,
    budget: float | str | None = None,
    bodies: Sequence[int | str] | None = None,
    dampers: int = 1,
    clearance: Sequence[float | str] | None = None,
    levels: Sequence[float | str] | None = None,
    band: Sequence[float | str] | None = None,
    watched: Sequence[int | str] | None = None,
    uncertain: Sequence[float | str] = (0.0, 0.0),
) -> tuple[Question, Space]:
    """Fill in defaults and check the request; parameters as of `rig.design`.

    Raises `SceneError` if no candidate designs remain, or nothing drives the structure.
    """
    may_carry, count = _bodies(bodies, scene, "bodies"), tuple(sorted({*_bodies(watched, scene, "watched")}))
    if not 1 <= dampers <= len(may_carry):
        raise SceneError(
            f"dampers: got {dampers}; expected 1 to {len(may_carry)}, one for each body that may carry "
            "one. Name a body twice for two dampers in it."
        )
    shares = tuple(number(share, RATIO, "uncertain") for share in uncertain)
    if len(shares) != 2 or not all(0.0 <= share < 0.9 for share in shares):
        raise SceneError(f"uncertain: got {shares}; expected two shares from 0 to below 90 %")
    total, most = total_mass(scene), mass_of(budget, scene)
    if not 0.0 < most < total:
        raise SceneError(
            f"budget: got {most:g} kg; expected more than 0 and less than the structure's mass of {total:g} kg"
        )
    if scene.gravity == 0.0:
        raise SceneError(
            "gravity: got 0; expected more than 0, because dampers without weight do not return to their floor"
        )
    landings = landings_from(scene.dampers)
    plain = with_ideal_force(_under_force(scene.replace(dampers=[], channels=None), levels))
    usual = [level_of(plain) * factor for factor in LEVELS]
    forces = tuple(sorted(positive_values(levels or usual, FORCE, "levels").tolist()))
    ends = _range(band or tuple(columns(plain, points=2).tolist()), FREQUENCY, "band")
    places = Space.places_of(may_carry, dampers)
    question = Question(variants(plain, *shares), forces, ends, count, landings)
    if clearance is not None:
        return question, Space(places, most, _range(clearance, LENGTH, "clearance"), without_ceiling=False)
    motion = question.bare.size
    return question, Space(places, most, (NARROWEST * motion * forces[0], WIDEST * motion * forces[-1]))
