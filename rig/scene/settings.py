"""Base classes of a scene's settings: frozen pydantic models that report all their problems together.

A problem has a key path and a message. The key path is a tuple of keys and positions from 0, such as ("dampers", 1,
"clearance"). The message contains the given and the expected value. `rig.scene.loading` converts the key path to a line
of the file.
"""

from __future__ import annotations

import ast
import inspect
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache, cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Any, ClassVar, Self, get_args

from pydantic import (
    BaseModel,
    ConfigDict,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    TypeAdapter,
    ValidationError,
    model_validator,
)
from pydantic.fields import FieldInfo
from pydantic_core import CoreSchema, InitErrorDetails, core_schema

from rig.errors import SceneError, suggestion
from rig.scene.quantities import Kind, parse
from rig.scene.quantity_field import (
    Quantity,
    quantity_of,
    unexpected_value_error,
    unexpected_value_message,
    validation_error,
)

KeyPath = tuple[int | str, ...]


@dataclass(frozen=True)
class Problem:
    """A problem in a scene: its key path and its message."""

    key_path: KeyPath
    message: str
    absent: str = ""  # missing key that causes the problem; the problem is not reported if the key is only misspelled


def problems_of(error: ValidationError) -> list[Problem]:
    """Return the problems in a pydantic error, with the messages of this package."""
    return [Problem(item["loc"], _message(item)) for item in error.errors(include_url=False)]


def describe(problems: Iterable[Problem], where: str, line: Callable[[KeyPath], int] | None = None) -> str:
    """Write one line for each problem: file, line, key path and message.

    >>> describe([Problem(("dampers", 1, "clearance"), "missing")], "a.yaml", lambda path: 12)
    'a.yaml:12: dampers[2].clearance: missing'
    """
    lines = []
    for problem in problems:
        location = where if line is None else f"{where}:{line(problem.key_path)}"
        lines.append(": ".join(filter(None, [location, dotted(problem.key_path), problem.message])))
    return "\n".join(lines)


def dotted(key_path: KeyPath) -> str:
    """Write a key path with positions counted from 1.

    >>> dotted(("dampers", 1, "clearance"))
    'dampers[2].clearance'
    """
    return "".join(f"[{key + 1}]" if isinstance(key, int) else f".{key[:60]}" for key in key_path).lstrip(".")


def combined_error(title: str, problems: Iterable[Problem]) -> ValidationError:
    """Combine several problems into one pydantic error."""
    details = [
        InitErrorDetails(type=validation_error(item.message, item.absent), loc=item.key_path, input=None)
        for item in problems
    ]
    return ValidationError.from_exception_data(title, details)


if TYPE_CHECKING:
    _Model = BaseModel
else:

    class _RaisesSceneError(type(BaseModel)):
        """Metaclass: settings created in Python raise the same error as a scene file."""

        def __call__(cls, *args: Any, **fields: Any) -> Any:
            try:
                return super().__call__(*args, **fields)
            except ValidationError as error:
                raise SceneError(describe(problems_of(error), cls.__name__)) from None

    class _Model(BaseModel, metaclass=_RaisesSceneError):
        """Base class that type checkers treat as a pydantic model."""


class Settings(_Model):
    """Base class of all settings: frozen, without unknown keys, with all problems reported together."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_by_name=True, validate_by_alias=True)

    # Groups of keys; exactly one key of each group must be given.
    one_of: ClassVar[tuple[tuple[str, ...], ...]] = ()

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some fields changed, validated like the original.

        Raises
        ------
        SceneError
            If the changed settings are invalid; the message has one line for each problem.
        """
        fields = {name: getattr(self, name) for name in self.model_fields_set}
        try:
            variant = type(self).model_validate({**fields, **changes})
        except ValidationError as error:
            raise SceneError(describe(problems_of(error), type(self).__name__)) from None
        variant.__dict__["written"] = {**self.written, **variant.written}
        return variant

    def with_valid(self, **changes: Any) -> Self:
        """Return a copy with new values that are known to be valid; faster than `replace`, which validates them."""
        variant = self.model_copy(update=changes)
        variant.__dict__["written"] = {name: text for name, text in self.written.items() if name not in changes}
        return variant

    @cached_property
    def written(self) -> Mapping[str, Any]:
        """Quantities as the user wrote them, by field; they affect only how the settings are written."""
        return {}

    def check_consistency(self) -> Iterable[Problem]:
        """Return the problems in combinations of fields whose values are valid individually."""
        return ()

    @classmethod
    def kinds_from_other_keys(cls, content: Mapping[str, Any]) -> Mapping[KeyPath, Kind]:
        """Return the required kind of the quantities whose kind depends on other keys, by key path."""
        return {}

    def discard_notation(self) -> None:
        """Discard the user's notation, and treat values equal to their defaults as not given.

        This is for scenes from recordings, which contain every value in SI.
        """
        self.__dict__.pop("written", None)
        for name, field in type(self).model_fields.items():
            value = getattr(self, name)
            if value == field.default:
                self.model_fields_set.discard(name)
            for part in value if isinstance(value, tuple) else (value,):
                if isinstance(part, Settings):
                    part.discard_notation()

    @classmethod
    def prepare(cls, content: Mapping[str, Any]) -> tuple[Mapping[str, Any], list[Problem]]:
        """Convert short forms in a file to the form of the fields; return the content, and problems in short forms."""
        return content, []

    @classmethod
    def key_path_as_given(cls, key_path: KeyPath, content: Mapping[str, Any]) -> KeyPath:
        """Convert a key path in the prepared content to the key path in the given content; the inverse of `prepare`."""
        return key_path

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        """Add to pydantic's schema: mutually exclusive keys, the required kind, and bounds."""
        reference = handler(schema)
        class_schema = handler.resolve_ref_schema(reference)
        class_schema["description"] = str(cls.__doc__).split("\n\n")[0]
        if cls.one_of:
            class_schema["allOf"] = [{"oneOf": [{"required": [key]} for key in group]} for group in cls.one_of]
        if "kind" in cls.model_fields:
            class_schema["required"] = ["kind", *class_schema.get("required", ())]
        for name, field in cls.model_fields.items():
            description = descriptions(cls).get(name)
            if description:
                quantity = quantity_at(field)
                property_schema = class_schema["properties"][field.alias or name]
                types = [choice.get("type") for choice in (property_schema, *property_schema.get("anyOf", ()))]
                list_prefix = "a list, each " if "array" in types and quantity and not quantity.listed else ""
                quantity_help = "" if quantity is None else f" Give {list_prefix}{quantity.help_text}."
                property_schema["description"] = f"{description}{quantity_help}"
        return reference

    @model_validator(mode="wrap")
    @classmethod
    def _report_together(cls, data: Any, handler: Callable[[Any], Self]) -> Self:
        if not isinstance(data, Mapping):
            return cls._validate_all(data, handler, [])
        prepared, problems = cls.prepare(data)
        try:
            settings = cls._validate_all(prepared, handler, problems)
        except ValidationError as error:
            problems = problems_of(error)
            raise combined_error(
                cls.__name__, [Problem(cls.key_path_as_given(item.key_path, data), item.message) for item in problems]
            ) from None
        texts = {name: prepared.get(key, prepared.get(name)) for name, key in _quantities(cls).items()}
        settings.__dict__["written"] = {name: text for name, text in texts.items() if _is_text(text)}
        return settings

    @classmethod
    def _validate_all(cls, data: Any, handler: Callable[[Any], Self], problems: list[Problem]) -> Self:
        known_paths = {item.key_path for item in problems}
        settings = None
        try:
            settings = handler(data)
        except ValidationError as error:
            items = [item for item in error.errors(include_url=False) if not _is_consequence(item)]
            new_problems = [cls._explain(item) for item in items if not cls._is_misspelled(item, items)]
            problems = problems + [item for item in new_problems if item.key_path not in known_paths]
        if isinstance(data, Mapping):
            problems = problems + list(cls._check_groups(data))
            problems = problems + list(cls._check_kinds(data, {item.key_path for item in problems}))
        if settings is not None and not problems:
            problems = list(settings.check_consistency())
        if problems or settings is None:
            raise combined_error(cls.__name__, problems)
        return settings

    @classmethod
    def keys(cls) -> list[str]:
        """Return the keys as written in a scene file."""
        return [field.alias or name for name, field in cls.model_fields.items()]

    @classmethod
    def _is_misspelled(cls, item: Any, items: Iterable[Any]) -> bool:
        """Return whether a key or part is missing only because it is misspelled, which is reported separately."""
        unknown_keys = [str(other["loc"][0]) for other in items if other["type"] == "extra_forbidden"]
        intended = {nearest_key(key, cls.keys()) for key in unknown_keys if key}
        if item["type"] == "missing" and len(item["loc"]) == 1:
            return item["loc"][0] in intended
        return item.get("ctx", {}).get("absent", "") in intended

    @classmethod
    def _explain(cls, item: Any) -> Problem:
        """Convert a pydantic error to a problem with this package's message."""
        key_path, value = item["loc"], item["input"]
        if item["type"] == "extra_forbidden" and len(key_path) == 1:
            return Problem(key_path, unknown_key_message(str(key_path[0]), cls.keys()))
        if item["type"] == "missing" and len(key_path) == 1:
            return Problem(key_path, f"missing; expected {cls._expected_value(str(key_path[0]))}")
        if item["type"] == "model_type" and not key_path:
            return Problem(key_path, unexpected_value_message(value, f"keys such as {', '.join(cls.keys()[:4])}"))
        if item["type"] == "string_pattern_mismatch" and len(key_path) == 1:
            return Problem(key_path, unexpected_value_message(value, cls._expected_value(str(key_path[0]))))
        return Problem(key_path, _message(item))

    @classmethod
    def _expected_value(cls, key: str) -> str:
        name, field = next((n, f) for n, f in cls.model_fields.items() if key in (n, f.alias))
        quantity = quantity_at(field)
        if quantity is not None:
            return quantity.description
        description = " ".join(descriptions(cls).get(name, "a value").split()).rstrip(".")
        return description[0].lower() + description[1:]

    @classmethod
    def _check_groups(cls, data: Mapping[str, Any]) -> Iterable[Problem]:
        for group in cls.one_of:
            given_keys = [key for key in group if data.get(key) is not None]
            misspelled = {nearest_key(str(key), cls.keys()) for key in data if key not in cls.keys()}  # noqa: SIM118
            if len(given_keys) != 1 and not (not given_keys and misspelled.intersection(group)):
                alternatives = " or ".join(group)
                reason = f"{' and '.join(given_keys)} given together" if given_keys else f"{alternatives} missing"
                yield Problem((), f"{reason}; expected exactly one of {alternatives}")

    @classmethod
    def _check_kinds(cls, data: Mapping[str, Any], known_paths: set[KeyPath]) -> Iterable[Problem]:
        for key_path, kind in cls.kinds_from_other_keys(data).items():
            values = value_at(data, key_path)
            for value in values if isinstance(values, list | tuple) else [values]:
                if not isinstance(value, str) or key_path in known_paths:
                    continue
                try:
                    parse(value, kind)
                except ValueError:
                    yield Problem(key_path, unexpected_value_message(value, f"{kind.noun} such as {kind.example}"))


@cache
def descriptions(cls: type[Settings]) -> dict[str, str]:
    """Return the field docstrings by field name, parsed on demand because pydantic's own parsing is slow."""
    texts: dict[str, str] = {}
    for base in reversed(cls.__mro__[: cls.__mro__.index(BaseModel)]):
        texts |= _module_descriptions(base.__module__)[base.__name__]
    return texts


@cache
def _module_descriptions(module: str) -> dict[str, dict[str, str]]:
    """Return the field docstrings of a module by class and field name."""
    texts: dict[str, dict[str, str]] = {}
    for cls in ast.walk(ast.parse(inspect.getsource(sys.modules[module]))):
        if isinstance(cls, ast.ClassDef):
            texts[cls.name] = {}
            for statement, following in pairwise(cls.body):
                match statement, following:
                    case ast.AnnAssign(target=ast.Name(name)), ast.Expr(ast.Constant(str(text))):
                        texts[cls.name][name] = inspect.cleandoc(text)
    return texts


def value_at(data: Any, key_path: KeyPath) -> Any:
    """Return the value at a key path, in settings or plain mappings; None if there is no value."""
    for key in key_path:
        data = data.get(key) if isinstance(data, Mapping) else getattr(data, str(key), None)
    return data


def unknown_key_message(key: str, keys: Iterable[str]) -> str:
    """Return the message for an unknown key, with the nearest valid key.

    >>> unknown_key_message("clearence", ["mass", "clearance"])
    "unknown key 'clearence'. Did you mean 'clearance'?"
    """
    keys = list(keys)
    hint = suggestion(key, keys)
    return f"unknown key {key[:60]!r}" + (f". {hint}" if hint else f"; expected one of {', '.join(keys)}")


def nearest_key(key: str, keys: Iterable[str]) -> str | None:
    """Return the valid key nearest to a misspelled key."""
    return next(iter(get_close_matches(key, list(keys), n=1, cutoff=0.6)), None)


def quantity_at(field: FieldInfo) -> Quantity | None:
    """Return the quantity of a field; None if the field is not a quantity."""
    return next(filter(None, map(quantity_of, (*field.metadata, field.annotation))), None)


@cache
def _quantities(cls: type[Settings]) -> dict[str, str]:
    """Return the fields that are quantities, each with its key."""
    fields = cls.model_fields.items()
    return {name: field.alias or name for name, field in fields if quantity_at(field) is not None}


def _is_text(value: Any) -> bool:
    items = value if isinstance(value, list | tuple) else (value,)
    return any(isinstance(item, str) for item in items)


def _is_consequence(item: Any) -> bool:
    """Return whether an error is only a consequence: a list is too short because its items are invalid."""
    return item["type"] == "too_short" and len(item["input"]) >= item["ctx"]["min_length"]


def _message(item: Any) -> str:
    """Return the message of a pydantic error: the given value and the expected value."""
    context = item.get("ctx", {})
    expected_value = {
        "greater_than_equal": f"a whole number, at least {context.get('ge')}",
        "less_than_equal": f"a whole number, at most {context.get('le')}",
        "too_short": f"a list of at least {context.get('min_length')}",
        "too_long": f"a list of at most {context.get('max_length')}",
        "int_type": "a whole number",
        "int_parsing": "a whole number",
        "int_parsing_size": "a whole number with fewer digits",
        "int_from_float": "a whole number",
        "bool_type": "true or false",
        "bool_parsing": "true or false",
        "string_type": "text",
        "string_too_short": "some text",
        "string_too_long": f"at most {context.get('max_length')} characters",
        "literal_error": f"one of {str(context.get('expected')).replace(chr(39), '')}",
        "tuple_type": "a list",
    }.get(item["type"])
    return unexpected_value_message(item["input"], expected_value) if expected_value else str(item["msg"])


Classes = tuple[type[Settings], ...]


class Alternatives:
    """Annotation `Annotated[A | B, Alternatives(by_kind)]`: settings of the class that matches the given keys.

    Unlike with a plain union, problems are reported only for the matching class.
    """

    def __init__(self, choose: Callable[[Mapping[str, Any], Classes], type[Settings]]) -> None:
        self.choose = choose

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        classes: Classes = get_args(source)

        def read(value: Any, _: Any) -> Settings:
            if isinstance(value, classes):
                return type(value).model_validate(value)
            if not isinstance(value, Mapping):
                raise unexpected_value_error(value, "keys and values")
            chosen = self.choose(value, classes)
            try:
                return chosen.model_validate(value)
            except ValidationError as error:
                problems = [_name_other_kinds(problem, chosen, classes) for problem in problems_of(error)]
                raise combined_error(chosen.__name__, problems) from None

        return core_schema.no_info_wrap_validator_function(read, handler(source))


def _name_other_kinds(problem: Problem, chosen: type[Settings], classes: Classes) -> Problem:
    """Add to the problem of an unknown key the other kinds that have this key."""
    key, own_keys = str(problem.key_path[0]) if len(problem.key_path) == 1 else "", list(chosen.keys())
    kinds = [
        str(kind.default)
        for other in classes
        if key in other.keys() and (kind := other.model_fields.get("kind"))  # noqa: SIM118
    ]
    if key in own_keys or not kinds:
        return problem
    given_kind = chosen.model_fields["kind"].default
    return Problem(
        problem.key_path,
        f"unknown key {key!r} for kind {given_kind}, which has {', '.join(own_keys)}. Remove the key, or give kind: "
        f"{' or '.join(kinds)}.",
    )


class OneOrSeveral:
    """Annotation `Annotated[A | tuple[A, ...], OneOrSeveral(A)]`: settings, or a list of settings.

    Unlike with a plain union, problems are reported only for the form that was given.
    """

    def __init__(self, item_type: Any) -> None:
        self.adapter: TypeAdapter[Any] = TypeAdapter(item_type)

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_wrap_validator_function(self._read, handler(source))

    def _read(self, value: Any, _: Any) -> Any:
        if not isinstance(value, list | tuple):
            return self.adapter.validate_python(value)
        if not value:
            raise unexpected_value_error(value, "keys and values, or a list with at least one item")
        settings, problems = [], []
        for k, item in enumerate(value):
            try:
                settings.append(self.adapter.validate_python(item))
            except ValidationError as error:
                problems += [Problem((k, *item.key_path), item.message) for item in problems_of(error)]
        if problems:
            raise combined_error("list", problems)
        return tuple(settings)


def by_kind(content: Mapping[str, Any], classes: Classes) -> type[Settings]:
    """Choose the class by the key `kind`."""
    kinds = {cls.model_fields["kind"].default: cls for cls in classes}
    kind = content.get("kind")
    if isinstance(kind, str) and kind in kinds:
        return kinds[kind]
    names = f"one of {', '.join(kinds)}"
    hint = suggestion(str(kind), kinds)
    message = (
        f"missing; expected {names}" if kind is None else unexpected_value_message(kind, names) + (hint and f". {hint}")
    )
    raise combined_error("kind", [Problem(("kind",), message)])


def by_key(content: Mapping[str, Any], classes: Classes) -> type[Settings]:
    """Choose the class by its first key, which no other class has."""
    first_keys = {cls.keys()[0]: cls for cls in classes}
    given_keys = [key for key in first_keys if key in content]
    if len(given_keys) == 1:
        return first_keys[given_keys[0]]
    names = f"exactly one of the keys {', '.join(first_keys)}"
    hint = suggestion(" ".join(map(str, content)), first_keys)
    raise validation_error(unexpected_value_message(dict(content), names) + (hint and f". {hint}"))
