"""Scenes on a pure force, with a driven table, or with finite-duration contact."""

import rig
from rig.scene.scene import Scene
from rig.system.open_loop_drive import with_ideal_force


def scene_with(name: str, force: float, mass_ratio: float, clearance: float, restitution: float = 0.0) -> Scene:
    """Change what the paper's scenes have in common, on a pure force."""
    scene = with_ideal_force(rig.load(name))
    changes = {"mass": None, "mass_ratio": mass_ratio, "clearance": clearance, "restitution": restitution}
    test = {"kind": "stepped_sine", "frequencies": [49.0], "force": force}
    return scene.replace(dampers=[d.replace(**changes) for d in scene.dampers], test=test)


def driven_table_scene() -> Scene:
    """Drive the table of Fig 9 with a fixed amplitude, through its servo."""
    return rig.load("fig9").replace(
        shaker={"kind": "table", "body": 1, "spring": 6600.0},
        test={"kind": "stepped_sine", "frequencies": [51.0], "drive": 1.0e-3},
    )


def finite_contact_scene(name: str, contact: dict[str, object], only_last: bool = False, **changes: float) -> Scene:
    """A bundled scene with finite-duration contact in all dampers or in the last."""
    scene = rig.load(name)
    dampers = [d.replace(contact=contact, **changes) for d in scene.dampers]
    return scene.replace(dampers=[*scene.dampers[:-1], dampers[-1]] if only_last else dampers)
