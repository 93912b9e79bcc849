"""Names of bodies in a scene, and their replacement by the body numbers that the settings store.

A *key path* is the position of a key in the scene (`rig.core.settings.settings`); a *location* is a point on the bench.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from rig.core.base.errors import SceneError, suggestion
from rig.core.settings.problems import KeyPath, Problem
from rig.core.settings.settings import value_at

_NAME = re.compile(r"[^\W\d][\w.-]{0,39}")
#: Locations of channels other than bodies.
LOCATIONS = ("table", "hammer", "shaker", "drive")
#: The end of a joint that is at rest.
GROUND = "ground"
#: Reserved words, which a body must not have as its name.
RESERVED_NAMES = ("body", GROUND, *LOCATIONS)
# Maximum number of unknown names for which a similar name is suggested; each is compared with all names.
_MAX_SUGGESTIONS = 20
# Locations without the name of a body: a body by its number, or another location on the bench.
_LOCATION_WITHOUT_NAME = re.compile(r"(body \d+|hammer|(table|shaker|drive)( \d+)?)")


def check_names(names: Sequence[str], n_bodies: int) -> Iterator[tuple[int | None, str]]:
    """Yield the problems of names: the index of the name (None: all names), and the message."""
    if len(names) != n_bodies:
        yield None, f"got {len(names)} names; expected {n_bodies}, one for each body"
    first: dict[str, int] = {}  # number of the first body of each name
    for k, name in enumerate(names):
        if not _NAME.fullmatch(name):
            yield (k, f'"{name[:60]}" is not a name for a body; expected a letter, then letters, digits, _, - and .')
        elif name in RESERVED_NAMES:
            yield k, f'"{name}" is reserved for another location on the bench. Choose another name.'
        elif name in first:
            yield k, f'"{name}" is the name of body {first[name]}; expected each name once'
        first.setdefault(name, k + 1)


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
    raise SceneError(_unknown_name(text, names, n_bodies, names or ()))


def replace_names(scene: Mapping[str, Any]) -> tuple[dict[str, Any], list[Problem]]:
    """Replace each name of a body in a scene with its number, and check the number.

    Returns the scene with body numbers, and a problem for each name or number that matches no body.
    """
    names, n_bodies = _names_and_count(scene.get("structure"))
    numbers = {name: k + 1 for k, name in reversed([*enumerate(names or ())])}
    problems: list[Problem] = []

    def report_unknown(name: str, key_path: KeyPath, locations: Sequence[str] = ()) -> None:
        similar_candidates = (*(names or ()), *locations) if len(problems) < _MAX_SUGGESTIONS else ()
        problems.append(Problem(key_path, _unknown_name(name, names, n_bodies, similar_candidates, locations)))

    def check_number(number: Any, key_path: KeyPath) -> None:
        if n_bodies and str(number).isdecimal() and int(number) > n_bodies:
            problems.append(Problem(key_path, missing_body_message(int(number), n_bodies)))

    def replace_body(value: Any, key_path: KeyPath) -> Any:
        if isinstance(value, list | tuple):
            return [replace_body(item, (*key_path, k)) for k, item in enumerate(value)]
        if not isinstance(value, str) or re.fullmatch(r"[-+\d.,\s]*", value):
            check_number(value, key_path)
            return value
        if value in numbers:
            return numbers[value]
        if not n_bodies:
            # The structure is invalid, which is reported elsewhere. Any number here avoids a second message.
            return 1
        report_unknown(value, key_path)
        return value

    def replace_end(value: Any, key_path: KeyPath) -> Any:
        if isinstance(value, list | tuple):
            return [replace_end(item, (*key_path, k)) for k, item in enumerate(value)]
        return value if value == GROUND else replace_body(value, key_path)

    def replace_location(value: Any, key_path: KeyPath) -> Any:
        if not isinstance(value, str) or _LOCATION_WITHOUT_NAME.fullmatch(value) or (n_bodies and names is None):
            check_number(str(value).removeprefix("body "), key_path)
            return value
        if names is None:
            return "body 1"  # any number avoids a second message, as in `replace_body`
        name = value.removeprefix("body ")
        if name in numbers:
            return f"body {numbers[name]}"
        report_unknown(name, key_path, LOCATIONS if name == value else ())
        return value

    def replace_value(section: Any, key: str, replace: Any, key_path: KeyPath) -> Any:
        if isinstance(section, list | tuple):
            return [replace_value(item, key, replace, (*key_path, k)) for k, item in enumerate(section)]
        if not isinstance(section, Mapping) or key not in section:
            return section
        return {**section, key: replace(section[key], (*key_path, key))}

    replacements = (
        ("dampers", "body", replace_body),
        ("joints", "between", replace_end),
        ("shaker", "body", replace_body),
        ("test", "body", replace_body),
        ("test", "at", replace_location),
        ("channels", "at", replace_location),
    )
    replaced = dict(scene)
    for name, key, replace in replacements:
        if name in replaced:
            replaced[name] = replace_value(replaced[name], key, replace, (name,))
    return replaced, problems


def missing_body_message(number: int, n_bodies: int) -> str:
    """Return the message that a body number does not exist."""
    return f"body {number} does not exist; expected a body of the structure, 1 to {n_bodies}"


def body_problems(valid: Mapping[str, Any], body: int, key_path: KeyPath) -> Iterator[Problem]:
    """Check that a body exists, if the section `structure` is valid; `valid`: the valid sections."""
    # `replace_names` reports most invalid numbers, but does not read the number of bodies from matrix files.
    n_bodies = valid["structure"].bodies if "structure" in valid else body
    if body > n_bodies:
        yield Problem(key_path, missing_body_message(body, n_bodies))


def _names_and_count(structure: Any) -> tuple[list[str] | None, int]:
    """Return the names (None if unnamed) and the count (0 if unknown) of the bodies of an unchecked structure."""
    masses = value_at(structure, ("masses",))
    names = list(masses) if isinstance(masses, Mapping) else value_at(structure, ("names",))
    texts = [str(name) for name in names] if isinstance(names, list | tuple) else None
    lists: tuple[Any, ...] = (masses, value_at(structure, ("matrices", "mass")), texts)
    lengths = (len(values) for values in lists if hasattr(values, "__len__") and not isinstance(values, str))
    return texts, next(lengths, 0)


def _unknown_name(
    name: str,
    names: Sequence[str] | None,
    n_bodies: int,
    similar_candidates: Sequence[str],
    locations: Sequence[str] = (),
) -> str:
    """Return the message for an unknown name; `locations`: further names that are allowed."""
    if names is None:
        alternatives = f"its number, 1 to {n_bodies}" if n_bodies > 1 else "its number, from 1"
        return f"no body has the name {name[:60]!r}: the bodies have no names; expected {alternatives}"
    listed_names = ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")
    listed_names += f" (bodies), {', '.join(locations)}" if locations else ""
    hint = suggestion(name, similar_candidates)
    return f"no body has the name {name[:60]!r}" + (f". {hint}" if hint else f"; expected one of {listed_names}")
