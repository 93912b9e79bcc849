"""Arguments of `rig design`: parsed, checked, and completed with defaults from the scene."""

from collections.abc import Sequence

import numpy as np

from rig.core.base.errors import SceneError
from rig.core.scene.body_names import body_number
from rig.core.scene.scene import Scene
from rig.core.settings.quantities import (
    FREQUENCY,
    LENGTH,
    MASS,
    RATIO,
    ascending_pair,
    count,
    number,
    parse,
    positive_values,
)
from rig.core.system.open_loop_drive import level_of, with_ideal_force
from rig.core.system.structural_model import structural_model
from rig.studies.design.choice import Objective, SearchSpace, impact_law_of, variants
from rig.studies.motion_map.grid import select_frequencies

#: Default force levels of the optimization, relative to the level of the scene's test.
DEFAULT_LEVEL_RATIOS = (0.5, 1.0, 2.0)
#: Default smallest clearance, relative to the largest displacement without dampers at the smallest level.
MIN_CLEARANCE_RATIO = 0.03
#: Default largest clearance, relative to the largest displacement without dampers at the largest level. Effective
#: dampers reduce the displacement to a tenth to a third of this value, and need about twice the reduced displacement as
#: clearance.
MAX_CLEARANCE_RATIO = 1.5
#: By default, the added mass (`budget`) is at most this fraction of the mass of the structure.
DEFAULT_MASS_RATIO = 0.05
#: Argument of both uncertainties in messages.
_UNCERTAINTIES = "`uncertain`"


def mass_limit(budget: float | str | None, scene: Scene) -> float:
    """Return the limit of the added mass [kg] from a mass or a share of the structure's mass; None: the default."""
    if budget is None:
        return DEFAULT_MASS_RATIO * total_mass(scene)
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
            f"budget: got {budget[:60]}; expected a mass such as '50 g', or a percentage such as '5 %'"
        ) from None


def _bodies(requested: Sequence[int | str] | None, scene: Scene, name: str) -> tuple[int, ...]:
    """Return body numbers from numbers or names, sorted; all bodies by default. `name`: the argument."""
    all_bodies = range(1, scene.structure.bodies + 1)
    names = [requested] if isinstance(requested, int | str) else requested
    try:
        return tuple(sorted(body_number(body, scene.structure.names, len(all_bodies)) for body in names or all_bodies))
    except SceneError as error:
        raise SceneError(f"{name}: {error}") from None


def _with_controlled_force(scene: Scene, levels: Sequence[float | str] | None) -> Scene:
    """Replace a drive level of the test [V or m] with a controlled force if the reference is a force."""
    if scene.level_key != "drive" or scene.reference == "table":
        return scene
    if levels is None:
        raise SceneError(
            "levels: not given, and the scene's test specifies a drive instead of a force. Give force amplitudes, such "
            "as `levels` 3N."
        )
    assert scene.test is not None
    return scene.replace(test=scene.test.replace(drive=None, force=levels[0]))


def total_mass(scene: Scene) -> float:
    """Return the mass of the structure without dampers [kg]."""
    return float(np.trace(structural_model(scene).mass))


def parse_request(
    scene: Scene,
    budget: float | str | None = None,
    bodies: Sequence[int | str] | None = None,
    dampers: int = 1,
    clearance: Sequence[float | str] | None = None,
    levels: Sequence[float | str] | None = None,
    band: Sequence[float | str] | None = None,
    watched: Sequence[int | str] | None = None,
    uncertain: Sequence[float | str] = (0.0, 0.0),
) -> tuple[Objective, SearchSpace]:
    """Return complete arguments of `rig.design`; `SceneError` if invalid or if nothing drives the structure."""
    damper_bodies = _bodies(bodies, scene, "bodies")
    evaluated_bodies = tuple(sorted({*_bodies(watched, scene, "watched")}))
    if count(dampers, 1, "dampers") > len(damper_bodies):
        raise SceneError(
            f"dampers: got {dampers}; expected 1 to {len(damper_bodies)}, at most one for each body listed in bodies. "
            "List a body twice for two dampers in it."
        )
    uncertainties = tuple(number(uncertainty, RATIO, _UNCERTAINTIES) for uncertainty in uncertain)
    if len(uncertainties) != 2 or not all(0.0 <= uncertainty < 0.9 for uncertainty in uncertainties):
        raise SceneError(
            f"{_UNCERTAINTIES}: got {', '.join(f'{100 * value:g} %' for value in uncertainties)}; expected two "
            "relative uncertainties, of damping and stiffness, each from 0 to below 90 %"
        )
    structure_mass, max_mass = total_mass(scene), mass_limit(budget, scene)
    if not 0.0 < max_mass < structure_mass:
        raise SceneError(
            f"budget: got {max_mass:g} kg; expected more than 0 and less than the structure's mass, "
            f"{structure_mass:g} kg"
        )
    if scene.gravity == 0.0:
        raise SceneError(
            "gravity: got 0; expected more than 0, because dampers without weight do not return to their floors"
        )
    if scene.joints:
        raise SceneError(
            "joints: a design compares dampers at all levels with one peak without dampers, which depends on the level "
            "in a structure with joints. Remove the joints, or compare dampers of your choice by `rig response` at "
            "each level."
        )
    impact_law = impact_law_of(scene.dampers)
    bare = with_ideal_force(_with_controlled_force(scene.with_ideal_channels(dampers=[]), levels))
    default_levels = [level_of(bare) * factor for factor in DEFAULT_LEVEL_RATIOS]
    shaker = bare.driven_shaker
    assert shaker is not None  # a test with a level has a shaker
    values = tuple(sorted(positive_values(levels or default_levels, shaker.drive_quantity, "levels").tolist()))
    band_limits = ascending_pair(band or select_frequencies(bare, points=2), FREQUENCY, "band")
    locations = SearchSpace.locations_of(damper_bodies, dampers)
    objective = Objective(variants(bare, *uncertainties), values, band_limits, evaluated_bodies, impact_law)
    if clearance is not None:
        return objective, SearchSpace(
            locations, max_mass, ascending_pair(clearance, LENGTH, "clearance"), allows_no_ceiling=False
        )
    peak = objective.bare_peak
    displacement = peak.acceleration / peak.level / (2.0 * np.pi * peak.frequency) ** 2  # m per level
    return objective, SearchSpace(
        locations,
        max_mass,
        (MIN_CLEARANCE_RATIO * displacement * values[0], MAX_CLEARANCE_RATIO * displacement * values[-1]),
    )
