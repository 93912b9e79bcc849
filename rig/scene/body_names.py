"""Names of bodies in a scene, and their replacement by the body numbers that the settings store.

A *place* is the path of a key in the scene (`rig.scene.settings`); a *location* is a point on the bench.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from rig.errors import SceneError, suggestion
from rig.scene.settings import Mistake, Place, value_at

_NAME = re.compile(r"[^\W\d][\w.-]{0,39}")
#: Words with another meaning where a scene names a body.
RESERVED_NAMES = ("body", "table", "hammer", "shaker", "drive", "ground")
# Locations without a name of a body: a body by its number, or another location on the bench.
_UNNAMED_LOCATION = re.compile(r"(body \d+|hammer|(table|shaker|drive)( \d+)?)")


def check_names(names: Sequence[str], n_bodies: int) -> Iterator[tuple[int | None, str]]:
    """Yield each mistake in the names: the index of the name (None: all names) and the message."""
    if len(names) != n_bodies:
        yield None, f"got {len(names)} names; expected {n_bodies}, one for each body"
    for k, name in enumerate(names):
        if not _NAME.fullmatch(name):
            yield (k, f'"{name[:60]}" is not a name for a body; expected a letter, then letters, digits, _, - and .')
        elif name in RESERVED_NAMES:
            yield k, f'"{name}" already means another place of the bench; expected another name'
        elif name in names[:k]:
            yield k, f'"{name}" is the name of body {names.index(name) + 1}; expected each name once'


def body_number(body: int | str, names: Sequence[str] | None, n_bodies: int) -> int:
    """Return the number of a body, from 1, given as a number or a name in an option or argument.

    Raises `SceneError` if the body does not exist; the message suggests the nearest name.

    >>> body_number("arm", ("base", "arm"), 2), body_number("body 1", None, 2), body_number("2", None, 2)
    (2, 1, 2)
    """
    text = str(body).strip().removeprefix("body ")
    if text.isdecimal() or isinstance(body, int):
        if not 1 <= int(text) <= n_bodies:
            raise SceneError(f"body {text} does not exist; expected 1 to {n_bodies}")
        return int(text)
    if names is not None and text in names:
        return names.index(text) + 1
    raise SceneError(_unknown_name(text, names, n_bodies))


def replace_names(scene: Mapping[str, Any]) -> tuple[dict[str, Any], list[Mistake]]:
    """Replace each name of a body in a scene by its number, and check the number.

    Returns the scene with body numbers, and a mistake for each name or number without a body.
    """
    names, n_bodies = _names(scene.get("structure"))
    mistakes: list[Mistake] = []

    def check_number(number: Any, place: Place) -> None:
        if n_bodies and str(number).isdecimal() and int(number) > n_bodies:
            mistakes.append(Mistake(place, missing_body_message(int(number), n_bodies)))

    def replace_body(value: Any, place: Place) -> Any:
        if isinstance(value, list | tuple):
            return [replace_body(item, (*place, k)) for k, item in enumerate(value)]
        if not isinstance(value, str) or re.fullmatch(r"[-+\d.,\s]*", value):
            check_number(value, place)
            return value
        if names is not None and value in names:
            return names.index(value) + 1
        if not n_bodies:
            # The structure is invalid, which is reported elsewhere; any number avoids a second message.
            return 1
        mistakes.append(Mistake(place, _unknown_name(value, names, n_bodies)))
        return value

    def replace_location(value: Any, place: Place) -> Any:
        if not isinstance(value, str) or _UNNAMED_LOCATION.fullmatch(value) or (n_bodies and names is None):
            check_number(str(value).removeprefix("body "), place)
            return value
        if names is None:
            return "body 1"
        name = value.removeprefix("body ")
        if name in names:
            return f"body {names.index(name) + 1}"
        mistakes.append(Mistake(place, _unknown_name(name, names, n_bodies)))
        return value

    def replace_value(section: Any, key: str, replace: Any, place: Place) -> Any:
        if isinstance(section, list | tuple):
            return [replace_value(item, key, replace, (*place, k)) for k, item in enumerate(section)]
        if not isinstance(section, Mapping) or key not in section:
            return section
        return {**section, key: replace(section[key], (*place, key))}

    replacements = {
        "dampers": ("body", replace_body),
        "shaker": ("body", replace_body),
        "test": ("body", replace_body),
        "channels": ("at", replace_location),
    }
    replaced = {
        name: replace_value(section, *replacements[name], (name,)) if name in replacements else section
        for name, section in scene.items()
    }
    return replaced, mistakes


def missing_body_message(number: int, n_bodies: int) -> str:
    """Return the message that a body number does not exist."""
    return f"body {number} does not exist; expected a body of the structure, 1 to {n_bodies}"


def _names(structure: Any) -> tuple[list[str] | None, int]:
    """Return the names of the bodies (None if unnamed) and their number (0 if unknown) of an unchecked structure."""
    masses = value_at(structure, ("masses",))
    names = list(masses) if isinstance(masses, Mapping) else value_at(structure, ("names",))
    texts = [str(name) for name in names] if isinstance(names, list | tuple) else None
    lists: tuple[Any, ...] = (masses, value_at(structure, ("matrices", "mass")), texts)
    lengths = (len(values) for values in lists if hasattr(values, "__len__") and not isinstance(values, str))
    return texts, next(lengths, 0)


def _unknown_name(name: str, names: Sequence[str] | None, n_bodies: int) -> str:
    if names is None:
        alternatives = f"its number, 1 to {n_bodies}" if n_bodies > 1 else "its number, from 1"
        return f"no body has the name {name[:60]!r}: the bodies have no names; expected {alternatives}"
    listed_names = ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")
    hint = suggestion(name, names)
    return f"no body has the name {name[:60]!r}" + (f". {hint}" if hint else f"; expected one of {listed_names}")
