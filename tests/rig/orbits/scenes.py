"""Scenes for the tests of periodic orbits: with an ideal force, a driven table, or finite-duration contact."""

import rig
from rig.core.scene.scene import Scene
from rig.core.system.open_loop_drive import with_ideal_force


def scene_with(name: str, force: float, mass_ratio: float, clearance: float, restitution: float = 0.0) -> Scene:
    """Return a bundled scene driven by an ideal force [N], with changed dampers (clearance in m)."""
    scene = with_ideal_force(rig.load(name))
    changes = {"mass": None, "mass_ratio": mass_ratio, "clearance": clearance, "restitution": restitution}
    test = {"kind": "stepped_sine", "frequencies": [49.0], "force": force}
    return scene.replace(dampers=[damper.replace(**changes) for damper in scene.dampers], test=test)


def driven_table_scene() -> Scene:
    """Return the scene of Fig. 9 with a table that is driven with an amplitude of 1 mm."""
    return rig.load("fig9").replace(
        shaker={"kind": "table", "body": 1, "spring": 6600.0},
        test={"kind": "stepped_sine", "frequencies": [51.0], "drive": 1.0e-3},
    )


def finite_contact_scene(name: str, contact: dict[str, object], only_last: bool = False, **changes: float) -> Scene:
    """Return a bundled scene with finite-duration contact in all dampers or in the last.

    `contact`, `changes`: keys of a damper, as in a scene file.
    """
    scene = rig.load(name)
    dampers = [damper.replace(contact=contact, **changes) for damper in scene.dampers]
    return scene.replace(dampers=[*scene.dampers[:-1], dampers[-1]] if only_last else dampers)
