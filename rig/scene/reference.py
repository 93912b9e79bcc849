"""The reference of scene files, generated from their JSON Schema: meaning and values of every key."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from textwrap import fill
from typing import Any

from rig.errors import SceneError

_SCHEMA = Path(__file__).parent / "data" / "scene.schema.json"
_WIDTH = 100
_INTRODUCTION = (
    "Quantities carry units (0.98 mm, 6.6 kN/m, 5 %); a bare number is SI, a frequency Hz. What is left out and has no "
    "default is not modelled: it adds no state, runs no code and costs nothing. What a key turns on has the name that "
    "rig explain gives it; states are what it adds to the computation, timed by `rig explain SCENE --measure`."
)
#: Effect of a key under its name in `rig explain`, and the number of added states (None: it depends on the scene).
EFFECTS: dict[str, tuple[str, int | None]] = {
    "structure.masses": ("structure", 2),
    "dampers.body": ("particle dampers", 2),
    "dampers.clearance": ("ceilings", 0),
    "dampers.restitution": ("restitution", 0),
    "dampers.contact": ("finite-duration contact", 0),
    "dampers.locked": ("locked dampers", 0),
    "shaker.spring": ("coil spring and table", 2),
    "shaker.coil": ("coil current", 1),
    "shaker.amplifier.limit": ("amplifier clipping", 0),
    "channels.accelerometer.sensitivity_tolerance": ("sensitivity deviation", 0),
    "channels.accelerometer.resonance": ("resonance", 2),
    "channels.accelerometer.low_cutoff": ("low cut-off", 1),
    "channels.accelerometer.noise": ("noise", 0),
    "channels.accelerometer.noise_corner": ("1/f noise", None),
    "channels.accelerometer.bias": ("offset", 0),
    "channels.accelerometer.bias_settling": ("offset settling", 1),
    "channels.accelerometer.transverse": ("sensitivity deviation", 0),
    "channels.accelerometer.saturation": ("saturation", 0),
    "channels.accelerometer.overload_recovery": ("overload recovery", 1),
    "channels.accelerometer.temperature_drift": ("sensitivity deviation", 0),
    "channels.integrator": ("integration", 1),
    "channels.integrator.low_cutoff": ("amplifier low cut-off", 1),
    "channels.integrator.saturation": ("saturation", 0),
    "converter.bits": ("quantisation", 0),
    "converter.range": ("clipping", 0),
    "converter.noise": ("converter noise", 0),
    "converter.coupling": ("AC coupling", 1),
    "converter.jitter": ("jitter", 0),
    "converter.filter": ("decimation filter", None),
    "recording.display": ("display", 0),
    "recording.truth": ("truth", 0),
}


@dataclass(frozen=True)
class Key:
    """One key of scene files.

    Attributes
    ----------
    name : str
        Dotted name, with [] after a key whose value is a list of keys: ``dampers[].clearance``.
    kinds : tuple of str
        The kinds (of shaker, test, ...) with this key; empty: all kinds.
    about, takes, without : str
        Meaning, allowed values, and the default if it is omitted.
    """

    name: str
    kinds: tuple[str, ...]
    about: str
    takes: str
    without: str

    @property
    def turns_on(self) -> str:
        """Effect and number of added states; empty for most keys."""
        if _plain(self.name) not in EFFECTS:
            return ""
        effect, states = EFFECTS[_plain(self.name)]
        count = "many states" if states is None else f"{states or 'no'} state{'s' * (states > 1)}"
        return f"{effect}, {count}"


@cache
def keys() -> tuple[Key, ...]:
    """List all keys of scene files, in the order of the scene.

    Keys that several kinds have in common are listed once.

    >>> next(key for key in keys() if key.name == "dampers[].clearance").takes
    'a length such as 0.98 mm, at least 0; a bare number is in m'
    """
    schema = json.loads(_SCHEMA.read_text(encoding="utf-8"))
    found: dict[tuple[str, ...], Key] = {}
    for key in _inside(schema, schema, "", ()):
        same = (key.name, key.about, key.takes, key.without)
        kinds = dict.fromkeys((*found[same].kinds, *key.kinds)) if same in found else key.kinds
        found[same] = replace(key, kinds=tuple(kinds))
    return tuple(found.values())


def _inside(schema: Any, node: Any, path: str, kinds: tuple[str, ...]) -> Iterator[Key]:
    """Yield the keys below a node: keys of an object, of each alternative, or of the items of a list."""
    node = _resolved(schema, node)
    for choice in node.get("anyOf", ()):
        listed = choice.get("type") == "array"
        # If a single item is allowed as well as a list, both have the same keys.
        if not (listed and len(node["anyOf"]) > 1):
            yield from _inside(schema, choice, path, kinds)
    if node.get("type") == "array":
        yield from _inside(schema, node["items"], f"{path}[]", kinds)
    own = node.get("properties", {})
    kind = own.get("kind", {}).get("const")
    groups = [[one["required"][0] for one in group["oneOf"]] for group in node.get("allOf", ())]
    for name, field in own.items():
        if name == "kind":
            continue
        here = kinds if kind is None else (kind,)
        about, _, takes = field.get("description", "").partition(" Give ")
        about = about or _resolved(schema, field.get("items", field)).get("description", "")
        about, _, nothing = re.sub(r"[;,.] None: ", "\0", about.replace("`", "")).partition("\0")
        default = field.get("default")
        alternatives = next((" or ".join(group) for group in groups if name in group), None)
        if alternatives is not None:
            without = f"{alternatives} is needed"
        elif name in node.get("required", ()):
            without = "needed"
        elif isinstance(default, dict):
            without = "as its keys without a value"
        elif default is None or isinstance(default, list):
            without = nothing.rstrip(".") or "not there"
        else:
            without = json.dumps(default).strip('"')
        full = f"{path}.{name}".lstrip(".")
        yield Key(full, here, about.rstrip(".") + ".", takes.rstrip(".") or _takes(schema, field), without)
        yield from _inside(schema, field, full, here)


def _resolved(schema: Any, node: Any) -> Any:
    reference = node.get("$ref")
    return node if reference is None else {**schema["$defs"][reference.rpartition("/")[2]], **node}


def _takes(schema: Any, node: Any) -> str:
    """Describe the allowed values of a key that is not a quantity."""
    node = _resolved(schema, node)
    choices = [_resolved(schema, choice) for choice in node.get("anyOf", ())]
    named = [
        choice["properties"]["kind"]["const"] for choice in choices if "kind" in choice.get("properties", {})
    ]
    if named:
        return f"keys, with kind: {', '.join(named)}"
    if choices:
        return " or ".join(dict.fromkeys(_takes(schema, choice) for choice in choices))
    if "properties" in node:
        return f"keys {', '.join(node['properties'])}"
    if "const" in node:
        return str(node["const"])
    if "enum" in node:
        return f"one of {', '.join(node['enum'])}"
    if node["type"] == "array":
        inner = node["items"].get("description") or _takes(schema, node["items"])
        return f"a list, each {'with ' * inner.startswith('keys')}{inner}"
    least, most = node.get("minimum"), node.get("maximum")
    limits = f"{'' if least is None else f', at least {least}'}{'' if most is None else f', at most {most}'}"
    file = "the name of an .npy file beside the scene" if "npy" in node.get("pattern", "") else "text"
    return {"integer": "a whole number", "number": "a number", "boolean": "true or false", "string": file}[
        node["type"]
    ] + limits


def help_on(key: str | None = None) -> str:
    """Explain a key: meaning, allowed values, default, and the keys inside.

    `key`: full dotted name or only its end (``clearance``); item numbers are ignored. None: all top-level keys.
    Raises `SceneError` if the key does not exist.
    """
    if key is None:
        top = [_line(each, each.name) for each in keys() if "." not in each.name]
        return "\n".join(
            [_wrapped(_INTRODUCTION, ""), "", *top, "", "more: rig help KEY, such as test.force"]
        )
    wanted = _plain(key)
    by_name: dict[str, list[Key]] = {}
    for each in keys():
        by_name.setdefault(_plain(each.name), []).append(each)
    exact = [wanted] if wanted in by_name else [name for name in by_name if name.endswith(f".{wanted}")]
    if not exact and (of_kind := _help_on_kind(*wanted.rpartition(".")[::2])):
        return of_kind
    if not exact:
        kinds = [f"{_plain(part)}.{kind}" for part, kind in _kinds()]
        near = get_close_matches(
            wanted, [*by_name, *(name.rpartition(".")[2] for name in by_name), *kinds], n=3
        )
        hint = (
            f"did you mean {' or '.join(dict.fromkeys(near))}?" if near else "rig help lists those at the top"
        )
        raise SceneError(f"no key {key[:60]!r} in scene files; {hint}")
    return "\n\n".join("\n".join(_lines_about(each, name)) for name in exact for each in by_name[name])


@cache
def _kinds() -> dict[tuple[str, str], str]:
    """Return the description of each kind of a part, such as ("test", "sine")."""
    schema = json.loads(_SCHEMA.read_text(encoding="utf-8"))
    parts = {part: _resolved(schema, field) for part, field in schema["properties"].items()}
    choices = [
        (part, _resolved(schema, choice))
        for part, field in parts.items()
        for choice in field.get("anyOf", ())
    ]
    return {
        (part, choice["properties"]["kind"]["const"]): choice["description"]
        for part, choice in choices
        if "kind" in choice.get("properties", {})
    }


def _help_on_kind(part: str, kind: str) -> str:
    """Explain a kind of a part (test.stepped_sine, or only stepped_sine) with its keys; empty if unknown."""
    explained = []
    for (whole, each), about in _kinds().items():
        if each == kind and part in ("", whole):
            inside = [key for key in keys() if re.fullmatch(rf"{whole}\.\w+", key.name) and kind in key.kinds]
            lines = [f"  {_line(key, key.name.rpartition('.')[2], _needed(key))}" for key in inside]
            head = [f"{whole}: {{kind: {kind}, ...}}", _wrapped(about, "  "), "  keys:"]
            more = f"  more: rig help {whole}.KEY, such as {inside[0].name}"
            explained.append("\n".join([*head, *lines, more]))
    return "\n\n".join(explained)


def _needed(key: Key) -> str:
    """Return whether a key is required, or its default if it has one."""
    if "needed" in key.without:
        return f"   ({key.without})"
    return (
        "" if key.without in ("not there", "as its keys without a value") else f"   (default: {key.without})"
    )


def _lines_about(key: Key, plain: str) -> Iterator[str]:
    yield f"{key.name}{_of(key)}"
    yield _wrapped(key.about, "  ")
    yield _wrapped(f"takes: {key.takes}", "  ")
    yield f"  left out: {key.without}"
    if key.turns_on:
        yield f"  turns on: {key.turns_on}"
    kinds = {kind: about for (part, kind), about in _kinds().items() if part == plain}
    inside = [each for each in keys() if re.fullmatch(rf"{re.escape(plain)}\.\w+", _plain(each.name))]
    if kinds:
        yield "  kinds:"
        yield from (f"  {_line(replace(key, about=about), kind)}" for kind, about in kinds.items())
        yield f"  more: rig help {plain}.KIND, such as {plain}.{next(iter(kinds))}"
    elif inside:
        yield "  keys:"
        yield from (f"  {_line(each, each.name.rpartition('.')[2])}" for each in inside)


def _line(key: Key, name: str, after: str | None = None) -> str:
    # A full stop may be part of a name, and the text after a colon is the meaning of the key.
    first = re.split(r"(?<=[\w\])%`])[.;](?:\s|$)", key.about)[0]
    after = _of(key) if after is None else after
    return fill(f"{first}{after}", _WIDTH, initial_indent=f"  {name:{18}} ", subsequent_indent=" " * 21)


def _of(key: Key) -> str:
    return f"   ({', '.join(key.kinds)})" if key.kinds else ""


def _wrapped(text: str, indent: str) -> str:
    return fill(text, _WIDTH, initial_indent=indent, subsequent_indent=indent + "  " * bool(indent))


def _plain(name: str) -> str:
    return re.sub(r"\[\d*\]", "", name).strip()


def page() -> str:
    """Return the whole reference as Markdown."""
    lines = ["# Scene files", "", _INTRODUCTION]
    for key in keys():
        if "." not in key.name:
            lines += ["", f"## {key.name}", "", key.about, "", f"Takes {key.takes}. Left out: {key.without}."]
            inside = [each for each in keys() if _plain(each.name).startswith(f"{_plain(key.name)}.")]
            if inside:
                lines += ["", "| key | what it is | takes | left out | turns on |", "|---|---|---|---|---|"]
            lines += [
                f"| `{each.name.partition('.')[2]}`{_of(each)} | {each.about} | {each.takes} | {each.without} | "
                f"{each.turns_on} |"
                for each in inside
            ]
    return "\n".join(lines) + "\n"
