"""Parameters of a fit: the values of a scene that can be fitted, by their keys as in `--set`.

A parameter is fitted as its *unknown*, which has no bounds: its logarithm, or the log odds of a ratio below 1.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.special import expit

from rig.core.base.errors import SceneError
from rig.core.scene.changes import parse_changes
from rig.core.scene.damper import SpringDamper, TimedContact, Walls
from rig.core.scene.scene import Scene
from rig.core.scene.structure import Dashpots, ModalDamping, RayleighDamping
from rig.core.settings.problems import KeyPath
from rig.core.settings.settings import Settings

#: Keys that are free by default, if the scene gives them. The coil spring is not free, because it calibrates the force.
FREE = (
    "structure.masses", "structure.springs", "structure.damping", "dampers.mass", "dampers.mass_ratio",
    "dampers.clearance", "dampers.clearance_below", "dampers.restitution", "dampers.contact", "dampers.spring",
    "dampers.damping",
)  # fmt: skip
_UNITS = {
    "masses": "kg", "springs": "N/m", "alpha": "1/s", "beta": "s", "dashpots": "N s/m", "mass": "kg",
    "clearance": "m", "clearance_below": "m", "duration": "s", "spring": "N/m", "stiffness": "N/m", "damping": "N s/m",
}  # fmt: skip
# A parameter is determined if its relative expanded uncertainty is at most this value, by quantity.
_MAX_RELATIVE_EXPANDED_OF = dict.fromkeys(("modal", "alpha", "beta", "dashpots"), 0.03)
_MAX_RELATIVE_EXPANDED_OF |= dict.fromkeys(("restitution", "duration", "stiffness", "damping"), 0.05)
# The limit of the half-width for all other quantities.
_MAX_RELATIVE_EXPANDED = 0.02
# Limit of unknowns before their conversion (exp overflows at 709), which undetermined parameters reach.
_MAX_UNKNOWN = 600.0


@dataclass(frozen=True)
class Parameter:
    """A positive value of a scene that can be fitted."""

    key: str  # as in `--set`, such as ``dampers[1].clearance``; lists count from 1
    key_path: KeyPath  # the parts of the key; lists count from 0
    start: float  # value in the scene, in SI units

    @cached_property
    def quantity(self) -> str:
        """Name of the value: the last word of its key."""
        return next(str(step) for step in reversed(self.key_path) if isinstance(step, str))

    @property
    def unit(self) -> str:
        """Unit; "" for a ratio."""
        return _UNITS.get(self.quantity, "")

    @property
    def max_relative_expanded(self) -> float:
        """Largest relative half width of the 95 % interval of a determined value."""
        return _MAX_RELATIVE_EXPANDED_OF.get(self.quantity, _MAX_RELATIVE_EXPANDED)

    @property
    def damper(self) -> int | None:
        """Index of the damper to which the value belongs, from 0; None for other values."""
        return int(self.key_path[1]) if self.key_path[0] == "dampers" else None

    @cached_property
    def is_ratio_below_one(self) -> bool:
        """Whether the value is a ratio below 1."""
        return self.quantity in ("restitution", "modal")

    def slope(self, value: float) -> float:
        """Return the derivative of the parameter's value with respect to its unknown, divided by the value."""
        return 1.0 - value if self.is_ratio_below_one else 1.0

    def unknown(self, value: float) -> float:
        """Return the unknown of the fit for a value: its logarithm, or its logit for a ratio below 1."""
        return float(np.log(value / (1.0 - value)) if self.is_ratio_below_one else np.log(value))

    def value(self, unknown: float) -> float:
        """Return the parameter's value for an unknown of the fit; inverse of `unknown`."""
        return float(expit(unknown) if self.is_ratio_below_one else np.exp(min(unknown, _MAX_UNKNOWN)))


def with_ratio_per_mode(scene: Scene) -> Scene:
    """Return the scene with one damping ratio for each mode; a common ratio is repeated."""
    damping = scene.structure.damping
    if isinstance(damping, ModalDamping) and not isinstance(damping.modal, tuple):
        ratios = (damping.modal,) * scene.structure.bodies
        return scene.replace(structure=scene.structure.replace(damping=ModalDamping(modal=ratios)))
    return scene


def free_parameters(scene: Scene, free: Sequence[str] | None = None) -> list[Parameter]:
    """List the free parameters.

    `scene`: from `with_ratio_per_mode`; `free`: keys, such as ``structure.masses`` for all masses or
    ``dampers[1].clearance``; if omitted, `FREE`. Raises `SceneError`, with the possible keys, if no value under a key
    can be fitted.

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
                # The name of a body is replaced with its position.
                key_path = ("structure", "masses", names.index(str(change.steps[2])))
                chosen[k] = change = replace(change, steps=key_path)
            if not any(change.covers(candidate.key_path) for candidate in candidates):
                fittable_keys = (
                    ".".join(step for step in candidate.key_path if isinstance(step, str)) for candidate in candidates
                )
                offered = ", ".join(dict.fromkeys(fittable_keys))
                raise SceneError(
                    f"free: {change.key}: nothing in scene {scene.name!r} can be fitted under this key. Use one of "
                    f"{offered} ([1] and so on selects an item of a list; values of 0 or infinity cannot be fitted)."
                )
    selected = [candidate for candidate in candidates if any(change.covers(candidate.key_path) for change in chosen)]
    if not selected:
        raise SceneError(f"scene {scene.name!r}: nothing to fit. Give masses, damping or dampers with values above 0.")
    return selected


def with_values(scene: Scene, values: Mapping[KeyPath, float]) -> Scene:
    """Return a scene with other values at some key paths; the values must be valid."""
    changed: Scene = _replace(scene, values)
    return changed


def _replace(setting: Any, values: Mapping[KeyPath, float]) -> Any:
    """Return a setting, such as a list of masses, with other values at key paths inside it."""
    changes: dict[int | str, Any] = {}
    inner: dict[int | str, dict[KeyPath, float]] = {}
    for key_path, value in values.items():
        if len(key_path) == 1:
            changes[key_path[0]] = value
        else:
            inner.setdefault(key_path[0], {})[key_path[1:]] = value
    if isinstance(setting, tuple):
        changes |= {step: _replace(setting[int(step)], inner_values) for step, inner_values in inner.items()}
        return tuple(changes.get(k, item) for k, item in enumerate(setting))
    assert isinstance(setting, Settings)
    changes |= {step: _replace(getattr(setting, str(step)), inner_values) for step, inner_values in inner.items()}
    return setting.with_valid(**{str(name): value for name, value in changes.items()})


def _candidates(scene: Scene) -> Iterator[Parameter]:
    """Yield all parameters of a scene: its values that are positive and finite."""
    for key_path, value in _values(scene):
        if value is not None and 0.0 < value < np.inf:
            steps = [f"[{step + 1}]" if isinstance(step, int) else f".{step}" for step in key_path]
            if key_path[:2] == ("structure", "masses") and scene.structure.names is not None:
                steps[2] = f".{scene.structure.names[int(key_path[2])]}"
            yield Parameter("".join(steps).removeprefix("."), key_path, float(value))


def _values(scene: Scene) -> Iterator[tuple[KeyPath, float | None]]:
    """Yield the values of masses, springs, damping, dampers and coil spring with their key paths."""
    structure, damping = scene.structure, scene.structure.damping
    for name, items in {"masses": structure.masses, "springs": structure.springs}.items():
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
        for name in ("clearance", "clearance_below", "restitution", "spring", "damping"):
            yield ("dampers", k, name), getattr(damper, name)
        yield from _wall_values(("dampers", k, "contact"), damper.contact)
    if len(scene.shakers) == 1 and not isinstance(scene.shaker, tuple):
        yield ("shaker", "spring"), scene.shakers[0].coil_spring


def _wall_values(
    key_path: KeyPath, wall: TimedContact | SpringDamper | Walls | None
) -> Iterator[tuple[KeyPath, float | None]]:
    names = {TimedContact: ("duration",), SpringDamper: ("stiffness", "damping")}
    if isinstance(wall, Walls):
        yield from _wall_values((*key_path, "floor"), wall.floor)
        yield from _wall_values((*key_path, "ceiling"), wall.ceiling)
    elif wall is not None:
        yield from (((*key_path, name), getattr(wall, name)) for name in names[type(wall)])
