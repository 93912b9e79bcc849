"""The reference of scene files, generated from their JSON Schema: meaning and values of every key."""

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from textwrap import fill
from typing import Any

from rig.core.base.errors import SceneError, suggestion

_SCHEMA = Path(__file__).parent / "data" / "scene.schema.json"
# Characters in a line of help: readable on a terminal of the usual width.
_WIDTH = 100
# Text before the unit of a number without a unit.
_BARE_NUMBER = "; a bare number is in "
# Text for the default of a key whose value is a mapping.
_DEFAULTS_OF_INNER_KEYS = "the defaults of its keys"
_INTRODUCTION = (
    "Write quantities with units (0.98 mm, 6.6 kN/m, 5 %). A number without a unit is in SI, a frequency in Hz. An "
    "effect whose key is omitted and has no default is not modeled, and takes no computing time. The names of effects "
    "are those of `rig explain SCENE`, which lists the state variables that each adds."
)
#: Effect of a key under its name in `rig explain`, and the number of added states (None: it depends on the scene).
EFFECTS: dict[str, tuple[str, int | None]] = {
    "structure.masses": ("structure", 2),
    "dampers.body": ("particle dampers", 2),
    "dampers.clearance": ("ceilings", 0),
    "dampers.restitution": ("restitution", 0),
    "dampers.spring": ("masses on springs", 2),
    "dampers.friction": ("sliding masses", 2),
    "dampers.contact": ("finite-duration contact", 0),
    "dampers.locked": ("locked dampers", 0),
    "joints.between": ("joints", 0),
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
    "converter.bits": ("quantization", 0),
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
    """One key of scene files, with its meaning, its allowed values, and its default."""

    name: str  # dotted, with [] after a key whose value is a list of keys: ``dampers[].clearance``
    kinds: tuple[str, ...]  # the kinds (of shaker, test, ...) with this key; empty: all kinds
    meaning: str
    values: str
    default: str

    @property
    def effect(self) -> str:
        """Effect and number of added states; empty for most keys."""
        if _dotted(self.name) not in EFFECTS:
            return ""
        effect, n_states = EFFECTS[_dotted(self.name)]
        count = "many states" if n_states is None else f"{n_states or 'no'} state{'s' * (n_states > 1)}"
        return f"{effect}, {count}"


@cache
def keys() -> tuple[Key, ...]:
    """List all keys of scene files, in the order of the scene.

    Keys that several kinds have in common are listed once.

    >>> next(key for key in keys() if key.name == "dampers[].clearance").values
    'a length such as 0.98 mm, at least 0; a bare number is in m'
    """
    schema = json.loads(_SCHEMA.read_text(encoding="utf-8"))
    merged: dict[tuple[str, ...], Key] = {}
    for key in _keys_below(schema, schema, "", ()):
        identity = (key.name, key.meaning, key.values, key.default)
        kinds = dict.fromkeys((*merged[identity].kinds, *key.kinds)) if identity in merged else key.kinds
        merged[identity] = replace(key, kinds=tuple(kinds))
    return tuple(merged.values())


def _keys_below(schema: Any, node: Any, path: str, kinds: tuple[str, ...]) -> Iterator[Key]:
    """Yield the keys below a node at a dotted `path`: of an object, an alternative, or the items of a list."""
    node = _resolve(schema, node)
    for choice in node.get("anyOf", ()):
        is_list = choice.get("type") == "array"
        # If a single item and a list are allowed, both have the same keys.
        if not (is_list and len(node["anyOf"]) > 1):
            yield from _keys_below(schema, choice, path, kinds)
    if node.get("type") == "array":
        yield from _keys_below(schema, _item(node), f"{path}[]", kinds)
    properties = node.get("properties", {})
    kind = properties.get("kind", {}).get("const")
    # Groups of keys of which exactly one is required (`Settings.one_of`).
    groups = [
        [alternative["required"][0] for alternative in group["oneOf"]]
        for group in node.get("allOf", ())
        if "oneOf" in group
    ]
    for name, field in properties.items():
        if name == "kind":
            continue
        key_kinds = kinds if kind is None else (kind,)
        # A description is "meaning. None: default. Give allowed values."
        meaning, _, allowed = field.get("description", "").partition(" Give ")
        meaning = meaning or _resolve(schema, _item(field)).get("description", "")
        meaning, _, default_text = re.sub(r"[;,.] None: ", "\0", meaning.replace("`", "")).partition("\0")
        default = field.get("default")
        alternatives = next((" or ".join(group) for group in groups if name in group), None)
        if alternatives is not None:
            default = f"{alternatives} is required"
        elif name in node.get("required", ()):
            default = "required"
        elif isinstance(default, dict):
            default = _DEFAULTS_OF_INNER_KEYS
        elif default is None or isinstance(default, list):
            default = default_text.rstrip(".") or "none"
        else:
            default = json.dumps(default).strip('"')
        full_name = f"{path}.{name}".lstrip(".")
        yield Key(
            full_name,
            key_kinds,
            meaning.rstrip(".") + ".",
            allowed.rstrip(".") or _allowed_values(schema, field),
            default,
        )
        yield from _keys_below(schema, field, full_name, key_kinds)


def _resolve(schema: Any, node: Any) -> Any:
    reference = node.get("$ref")
    return node if reference is None else {**schema["$defs"][reference.rpartition("/")[2]], **node}


def _item(node: Any) -> Any:
    """Return the node of the items of a list, or of the first item of a list of fixed length; else the node."""
    return node.get("items") or next(iter(node.get("prefixItems", ())), node)


def _allowed_values(schema: Any, node: Any) -> str:
    """Describe the allowed values of a key that is not a quantity."""
    node = _resolve(schema, node)
    choices = [_resolve(schema, choice) for choice in node.get("anyOf", ())]
    kinds = [choice["properties"]["kind"]["const"] for choice in choices if "kind" in choice.get("properties", {})]
    if kinds:
        return f"keys, with kind: {', '.join(kinds)}"
    if choices:
        return " or ".join(dict.fromkeys(_allowed_values(schema, choice) for choice in choices))
    if "properties" in node:
        return f"keys {', '.join(node['properties'])}"
    if "const" in node:
        return str(node["const"])
    if "enum" in node:
        return f"one of {', '.join(node['enum'])}"
    if node["type"] == "array":
        item = _item(node).get("description") or _allowed_values(schema, _item(node))
        return f"a list, each {'with ' * item.startswith('keys')}{item}"
    minimum, maximum = node.get("minimum"), node.get("maximum")
    limits = f"{'' if minimum is None else f', at least {minimum}'}{'' if maximum is None else f', at most {maximum}'}"
    text_type = "a .npy file next to the scene file" if "npy" in node.get("pattern", "") else "text"
    types = {"integer": "a whole number", "number": "a number", "boolean": "true or false", "string": text_type}
    return types[node["type"]] + limits


def help_on(key: str | None = None) -> str:
    """Explain a key: meaning, allowed values, default, and the keys inside.

    `key`: full dotted name or only its end (``clearance``); item numbers are ignored. None: all top-level keys.
    Raises `SceneError` if the key does not exist.
    """
    if key is None:
        lines = [_key_line(entry, entry.name) for entry in keys() if "." not in entry.name]
        return "\n".join([_wrap(_INTRODUCTION, ""), "", *lines, "", "more: rig help KEY, such as test.force"])
    # The kinds of test and shaker are listed with their section.
    dotted_key = _dotted(key).removesuffix(".kind")
    by_name: dict[str, list[Key]] = {}
    for entry in keys():
        by_name.setdefault(_dotted(entry.name), []).append(entry)
    matches = [dotted_key] if dotted_key in by_name else [name for name in by_name if name.endswith(f".{dotted_key}")]
    if not matches and (kind_help := _help_on_kind(*dotted_key.rpartition(".")[::2])):
        return kind_help
    if not matches and (of_kind := _key_of_kind(dotted_key, by_name)):
        return "\n\n".join("\n".join(_describe_key(entry, _dotted(entry.name))) for entry in of_kind)
    if not matches:
        kinds = [f"{_dotted(section)}.{kind}" for section, kind in _kinds()]
        names = [*by_name, *(name.rpartition(".")[2] for name in by_name), *kinds]
        hint = suggestion(dotted_key, names, "`rig help` lists the top-level keys.", n=3)
        raise SceneError(f"no key {key[:60]!r} in scene files. {hint}")
    return "\n\n".join("\n".join(_describe_key(entry, name)) for name in matches for entry in by_name[name])


@cache
def _kinds() -> dict[tuple[str, str], str]:
    """Return the description of each kind of a section, such as ("test", "sine")."""
    schema = json.loads(_SCHEMA.read_text(encoding="utf-8"))
    sections = {section: _resolve(schema, field) for section, field in schema["properties"].items()}
    choices = [
        (section, _resolve(schema, choice)) for section, field in sections.items() for choice in field.get("anyOf", ())
    ]
    return {
        (section, choice["properties"]["kind"]["const"]): choice["description"]
        for section, choice in choices
        if "kind" in choice.get("properties", {})
    }


def _help_on_kind(section: str, kind: str) -> str:
    """Explain a kind of a section (test.stepped_sine, or only stepped_sine) with its keys; empty if unknown."""
    paragraphs = []
    for (full_section, entry), meaning in _kinds().items():
        if entry == kind and section in ("", full_section):
            inner = [key for key in keys() if re.fullmatch(rf"{full_section}\.\w+", key.name) and kind in key.kinds]
            lines = [f"  {_key_line(key, key.name.rpartition('.')[2], _default_note(key))}" for key in inner]
            header = [f"{full_section}: {{kind: {kind}, ...}}", _wrap(meaning, "  "), "  keys:"]
            hint = f"  more: rig help {full_section}.KEY, such as {inner[0].name}"
            paragraphs.append("\n".join([*header, *lines, hint]))
    return "\n\n".join(paragraphs)


def _key_of_kind(dotted_key: str, by_name: Mapping[str, list[Key]]) -> list[Key]:
    """Return the entries of a key whose name contains the kind of its section, such as test.impulse.peak."""
    section, _, rest = dotted_key.partition(".")
    kind, _, inner = rest.partition(".")
    if (section, kind) not in _kinds():
        return []
    return [entry for entry in by_name.get(f"{section}.{inner}", ()) if kind in entry.kinds]


def _default_note(key: Key) -> str:
    """Return a note that a key is required, or its default."""
    if "required" in key.default:
        return f"   ({key.default})"
    return "" if key.default in ("none", _DEFAULTS_OF_INNER_KEYS) else f"   (default: {key.default})"


def _describe_key(key: Key, dotted_name: str) -> Iterator[str]:
    yield f"{key.name}{_kinds_note(key)}"
    yield _wrap(key.meaning, "  ")
    yield _wrap(f"values: {key.values}", "  ")
    yield f"  default: {key.default}"
    if key.effect:
        yield f"  effect: {key.effect}"
    kinds = {kind: meaning for (section, kind), meaning in _kinds().items() if section == dotted_name}
    inner = [entry for entry in keys() if re.fullmatch(rf"{re.escape(dotted_name)}\.\w+", _dotted(entry.name))]
    if kinds:
        yield "  kinds:"
        yield from (f"  {_key_line(replace(key, meaning=meaning), kind)}" for kind, meaning in kinds.items())
        yield f"  more: rig help {dotted_name}.KIND, such as {dotted_name}.{next(iter(kinds))}"
    elif inner:
        yield "  keys:"
        yield from (f"  {_key_line(entry, entry.name.rpartition('.')[2])}" for entry in inner)


def _key_line(key: Key, name: str, note: str | None = None) -> str:
    # The first sentence ends at a full stop before a space; the text after a colon is the meaning of the key.
    first_sentence = re.split(r"(?<=[\w\])%`])[.;](?:\s|$)", key.meaning)[0]
    note = _kinds_note(key) if note is None else note
    return fill(f"{first_sentence}{note}", _WIDTH, initial_indent=f"  {name:{18}} ", subsequent_indent=" " * 21)


def _kinds_note(key: Key) -> str:
    return f"   ({', '.join(key.kinds)})" if key.kinds else ""


def _wrap(text: str, indent: str) -> str:
    return fill(text, _WIDTH, initial_indent=indent, subsequent_indent=indent + "  " * bool(indent))


def _dotted(name: str) -> str:
    return re.sub(r"\[\d*\]", "", name).strip()


def reference_page() -> str:
    """Return the whole reference as Markdown."""
    lines = ["# Scene files", "", f"{_INTRODUCTION} The column *unit* has the unit of a bare number."]
    for key in keys():
        if "." not in key.name:
            lines += ["", f"## {key.name}", "", key.meaning, "", f"Values: {key.values}. Default: {key.default}."]
            inner = [entry for entry in keys() if _dotted(entry.name).startswith(f"{_dotted(key.name)}.")]
            if inner:
                lines += ["", "| key | meaning | values | unit | default | effect |", "|---|---|---|---|---|---|"]
            for entry in inner:
                values, _, unit = entry.values.partition(_BARE_NUMBER)
                name = f"`{entry.name.partition('.')[2]}`{_kinds_note(entry)}"
                lines.append(f"| {name} | {entry.meaning} | {values} | {unit} | {entry.default} | {entry.effect} |")
    return "\n".join(lines) + "\n"
