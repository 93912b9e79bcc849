"""Parameters of a fit: values of a scene by their keys, as in `--set`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import expit

from rig.errors import SceneError
from rig.scene.changes import parse_changes
from rig.scene.damper import Landing, SpringDamper, Walls
from rig.scene.scene import Scene
from rig.scene.settings import Place, Settings
from rig.scene.structure import Dashpots, ModalDamping, RayleighDamping

#: Keys that are free by default, where a scene gives them.
FREE = (
    "structure.masses", "structure.springs", "structure.damping", "dampers.mass", "dampers.mass_ratio",
    "dampers.clearance", "dampers.restitution", "dampers.contact",
)  # fmt: skip
_UNITS = {
    "masses": "kg", "springs": "N/m", "alpha": "1/s", "beta": "s", "dashpots": "N s/m", "mass": "kg",
    "clearance": "m", "duration": "s", "spring": "N/m", "stiffness": "N/m", "damping": "N s/m",
}  # fmt: skip
# Largest relative half width of the 95 % interval of a determined value.
_LIMITS = dict.fromkeys(("modal", "alpha", "beta", "dashpots"), 0.03)
_LIMITS |= dict.fromkeys(("restitution", "duration", "stiffness", "damping"), 0.05)
_LIMIT = 0.02
# Largest fit variable, below the overflow of exp at 709: intervals of undetermined values are unbounded.
_MAX_UNKNOWN = 600.0


@dataclass(frozen=True)
class Parameter:
    """A positive value of a scene that can be fitted."""

    key: str  # as `--set` names it: ``dampers[1].clearance``; lists count from 1
    place: Place  # the key as steps; positions count from 0
    start: float  # its value in the scene, in SI

    @property
    def quantity(self) -> str:
        """Name of the value: the last word of its key."""
        return next(str(step) for step in reversed(self.place) if isinstance(step, str))

    @property
    def unit(self) -> str:
        """Unit; "" for a ratio."""
        return _UNITS.get(self.quantity, "")

    @property
    def limit(self) -> float:
        """Largest relative half width of the 95 % interval of a determined value."""
        return _LIMITS.get(self.quantity, _LIMIT)

    @property
    def damper(self) -> int | None:
        """Index of its damper, from 0; None for other values."""
        return int(self.place[1]) if self.place[0] == "dampers" else None

    @property
    def below_one(self) -> bool:
        """Whether the value is a ratio below 1."""
        return self.quantity in ("restitution", "modal")

    def slope(self, value: float) -> float:
        """Return the relative derivative of the value with respect to its unknown."""
        return 1.0 - value if self.below_one else 1.0

    def unknown(self, value: float) -> float:
        """Convert a value to its unknown: its logarithm, or the log odds of a ratio below 1."""
        return float(np.log(value / (1.0 - value)) if self.below_one else np.log(value))

    def value(self, unknown: float) -> float:
        """Convert an unknown to its value."""
        return float(expit(unknown) if self.below_one else np.exp(min(unknown, _MAX_UNKNOWN)))


def with_ratio_per_mode(scene: Scene) -> Scene:
    """Return the scene with a damping ratio for each mode, also if it gives one for all modes."""
    damping = scene.structure.damping
    if isinstance(damping, ModalDamping) and not isinstance(damping.modal, tuple):
        ratios = (damping.modal,) * scene.structure.bodies
        return scene.replace(structure=scene.structure.replace(damping=ModalDamping(modal=ratios)))
    return scene


def free_parameters(scene: Scene, free: Sequence[str] | None = None) -> list[Parameter]:
    """List the free parameters.

    `scene`: from `with_ratio_per_mode`; `free`: keys, such as ``structure.masses`` for all masses or
    ``dampers[1].clearance``; if omitted, `FREE`. Raises `SceneError` if a key names nothing that can be fitted; the
    message lists the keys that can.

    >>> import rig
    >>> [parameter.key for parameter in free_parameters(rig.load("fig9"), ["structure.masses[1]", "dampers"])]
    ['structure.masses[1]', 'dampers[1].mass_ratio', 'dampers[1].clearance']
    """
    candidates = list(_candidates(scene))
    if free is None:
        chosen = parse_changes(dict.fromkeys(FREE))
    else:
        names = scene.structure.names or ()
        keys = [free] if isinstance(free, str) else free
        chosen = list(parse_changes(dict.fromkeys(keys)))
        for k, change in enumerate(chosen):
            if change.steps[:2] == ("structure", "masses") and change.steps[2:] and change.steps[2] in names:
                # The name of a body is replaced by its position.
                place = ("structure", "masses", names.index(str(change.steps[2])))
                chosen[k] = change = replace(change, steps=place)
            if not any(change.covers(candidate.place) for candidate in candidates):
                all_keys = (
                    ".".join(step for step in candidate.place if isinstance(step, str)) for candidate in candidates
                )
                offered = ", ".join(dict.fromkeys(all_keys))
                raise SceneError(
                    f"free: {change.key}: nothing in scene {scene.name!r} can be fitted under this key. Use one of "
                    f"{offered} ([1] and so on selects an item of a list; values of 0 or infinity cannot be fitted)."
                )
    selected = [candidate for candidate in candidates if any(change.covers(candidate.place) for change in chosen)]
    if free is None:
        # The coil spring calibrates the force; it is free only on request.
        selected = [candidate for candidate in selected if candidate.place[0] != "shaker"]
    if not selected:
        raise SceneError(f"scene {scene.name!r}: nothing to fit. Give masses, damping or dampers with values above 0.")
    return selected


def with_values(scene: Scene, values: Mapping[Place, float]) -> Scene:
    """Insert valid values into a scene, at places counted from 0."""
    parts: dict[str, dict[Place, float]] = {}
    for place, value in values.items():
        parts.setdefault(str(place[0]), {})[place[1:]] = value
    return scene.with_valid(**{name: _insert(getattr(scene, name), inside) for name, inside in parts.items()})


def _insert(node: Any, values: Mapping[Place, float]) -> Any:
    if () in values:
        return values[()]
    parts: dict[int | str, dict[Place, float]] = {}
    for place, value in values.items():
        parts.setdefault(place[0], {})[place[1:]] = value
    if isinstance(node, tuple):
        return tuple(_insert(item, parts[k]) if k in parts else item for k, item in enumerate(node))
    assert isinstance(node, Settings)
    return node.with_valid(**{str(name): _insert(getattr(node, str(name)), inside) for name, inside in parts.items()})


def _candidates(scene: Scene) -> Iterator[Parameter]:
    for place, value in _values(scene):
        if value is not None and 0.0 < value < np.inf:
            steps = [f"[{step + 1}]" if isinstance(step, int) else f".{step}" for step in place]
            if place[:2] == ("structure", "masses") and scene.structure.names is not None:
                steps[2] = f".{scene.structure.names[int(place[2])]}"
            yield Parameter("".join(steps).removeprefix("."), place, float(value))


def _values(scene: Scene) -> Iterator[tuple[Place, float | None]]:
    structure, damping = scene.structure, scene.structure.damping
    listed = {"masses": structure.masses, "springs": structure.springs}
    for name, items in listed.items():
        yield from ((("structure", name, k), value) for k, value in enumerate(items or ()))
    damping_place = ("structure", "damping")
    if isinstance(damping, ModalDamping) and isinstance(damping.modal, tuple):
        yield from (((*damping_place, "modal", k), value) for k, value in enumerate(damping.modal))
    elif isinstance(damping, Dashpots):
        yield from (((*damping_place, "dashpots", k), value) for k, value in enumerate(damping.dashpots))
    elif isinstance(damping, RayleighDamping):
        yield (*damping_place, "rayleigh", "alpha"), damping.rayleigh.alpha
        yield (*damping_place, "rayleigh", "beta"), damping.rayleigh.beta
    for k, damper in enumerate(scene.dampers):
        for name in ("mass", "mass_ratio"):
            yield ("dampers", k, name), getattr(damper, name)
        if damper.locked:
            continue
        for name in ("clearance", "restitution"):
            yield ("dampers", k, name), getattr(damper, name)
        yield from _wall_values(("dampers", k, "contact"), damper.contact)
    if len(scene.shakers) == 1 and not isinstance(scene.shaker, tuple):
        yield ("shaker", "spring"), scene.shakers[0].spring


def _wall_values(place: Place, wall: Landing | SpringDamper | Walls | None) -> Iterator[tuple[Place, float | None]]:
    names = {Landing: ("duration",), SpringDamper: ("stiffness", "damping")}
    if isinstance(wall, Walls):
        yield from _wall_values((*place, "floor"), wall.floor)
        yield from _wall_values((*place, "ceiling"), wall.ceiling)
    elif wall is not None:
        yield from (((*place, name), getattr(wall, name)) for name in names[type(wall)])
