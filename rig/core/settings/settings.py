"""Base class of all settings: a frozen pydantic model that reports all its problems together.

Imports must be fast. `defer_build` therefore postpones the validator of a class to its first use, and modules with
settings have no `from __future__ import annotations`, with which pydantic would compile inherited annotations again for
each subclass.
"""

import ast
import inspect
import sys
from collections.abc import Callable, Iterable, Mapping
from functools import cache, cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Any, ClassVar, Self

from pydantic import BaseModel, ConfigDict, GetJsonSchemaHandler, ValidationError, model_validator
from pydantic.fields import FieldInfo
from pydantic_core import CoreSchema

from rig.core.base.errors import SceneError, suggestion
from rig.core.settings.problems import KeyPath, Problem, combined_error, describe, message_of, problems_of
from rig.core.settings.quantities import Kind, expected_quantity, parse
from rig.core.settings.quantity_field import Quantity, quantity_of, unexpected_value_message

if TYPE_CHECKING:
    _Model = BaseModel
else:

    class _RaisesSceneError(type(BaseModel)):
        """Metaclass: invalid settings created in Python raise the same error as an invalid scene file."""

        def __call__(cls, *args: Any, **fields: Any) -> Any:
            try:
                return super().__call__(*args, **fields)
            except ValidationError as error:
                raise SceneError(describe(problems_of(error), cls.__name__)) from None

    class _Model(BaseModel, metaclass=_RaisesSceneError):
        """Base class that type checkers treat as a pydantic model."""


class Settings(_Model):
    """Base class of all settings: frozen, without unknown keys, with all problems reported together."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", defer_build=True, validate_by_name=True, validate_by_alias=True
    )

    # Groups of keys; exactly one key of each group must be given.
    one_of: ClassVar[tuple[tuple[str, ...], ...]] = ()
    # Keys that must be given unless another key is given.
    required_unless: ClassVar[Mapping[str, str]] = {}

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
        """Quantities as the user wrote them, by field; used only when the settings are written."""
        return {}

    def check_consistency(self) -> Iterable[Problem]:
        """Return the problems in combinations of fields whose values are valid individually."""
        return ()

    @classmethod
    def kinds_from_other_keys(cls, content: Mapping[str, Any]) -> Mapping[KeyPath, Kind]:
        """Return the required physical kind of the quantities whose kind depends on other keys, by key path."""
        return {}

    def discard_notation(self) -> None:
        """Discard the user's notation and values equal to defaults; recordings contain every value in SI."""
        self.__dict__.pop("written", None)
        for name, field in type(self).model_fields.items():
            value = getattr(self, name)
            is_required = name in self.required_unless and getattr(self, self.required_unless[name]) is None
            if value == field.default and not is_required:
                self.model_fields_set.discard(name)
            for part in value if isinstance(value, tuple) else (value,):
                if isinstance(part, Settings):
                    part.discard_notation()

    @classmethod
    def prepare(cls, content: Mapping[str, Any]) -> tuple[Mapping[str, Any], list[Problem]]:
        """Convert short forms in a file to the form of the fields; return the content, and the problems detected."""
        return content, []

    @classmethod
    def key_path_as_given(cls, key_path: KeyPath, content: Mapping[str, Any]) -> KeyPath:
        """Convert a key path in the prepared content to the key path in the given content; the inverse of `prepare`."""
        return key_path

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        """Add to pydantic's schema: groups of alternative keys, the mandatory key `kind`, and field descriptions."""
        reference = handler(schema)
        class_schema = handler.resolve_ref_schema(reference)
        class_schema["description"] = str(cls.__doc__).split("\n\n")[0]
        if cls.one_of:
            class_schema["allOf"] = [{"oneOf": [{"required": [key]} for key in group]} for group in cls.one_of]
        for pair in cls.required_unless.items():
            class_schema.setdefault("allOf", []).append({"anyOf": [{"required": [key]} for key in pair]})
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
                cls.__name__,
                [Problem(cls.key_path_as_given(problem.key_path, data), problem.message) for problem in problems],
            ) from None
        texts = {name: prepared.get(key, prepared.get(name)) for name, key in _quantities(cls).items()}
        settings.__dict__["written"] = {name: text for name, text in texts.items() if _is_text(text)}
        return settings

    @classmethod
    def _validate_all(cls, data: Any, handler: Callable[[Any], Self], problems: list[Problem]) -> Self:
        known_paths = {problem.key_path for problem in problems}
        settings = None
        try:
            settings = handler(data)
        except ValidationError as error:
            details = [detail for detail in error.errors(include_url=False) if not _is_consequence(detail)]
            unknown_keys = [str(detail["loc"][0]) for detail in details if detail["type"] == "extra_forbidden"]
            intended = {nearest_key(key, cls.keys()) for key in unknown_keys if key}
            new_problems = [cls._explain(detail) for detail in details if not _is_misspelled(detail, intended)]
            problems = problems + [problem for problem in new_problems if problem.key_path not in known_paths]
        if isinstance(data, Mapping):
            problems = problems + list(cls._check_groups(data))
            problems = problems + list(cls._check_kinds(data, {problem.key_path for problem in problems}))
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
    def _explain(cls, detail: Any) -> Problem:
        """Convert an error of pydantic to a `Problem` with a message of this package."""
        key_path, value = detail["loc"], detail["input"]
        if detail["type"] == "extra_forbidden" and len(key_path) == 1:
            return Problem(key_path, unknown_key_message(str(key_path[0]), cls.keys()))
        if detail["type"] == "missing" and len(key_path) == 1:
            return Problem(key_path, f"missing; expected {cls._expected_value(str(key_path[0]))}")
        if detail["type"] == "model_type" and not key_path:
            return Problem(key_path, unexpected_value_message(value, f"keys such as {', '.join(cls.keys()[:4])}"))
        if detail["type"] == "string_pattern_mismatch" and len(key_path) == 1:
            return Problem(key_path, unexpected_value_message(value, cls._expected_value(str(key_path[0]))))
        return Problem(key_path, message_of(detail))

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
        misspelled = {nearest_key(str(key), cls.keys()) for key in data if key not in cls.keys()}  # noqa: SIM118
        for group in cls.one_of:
            given_keys = [key for key in group if data.get(key) is not None]
            if len(given_keys) != 1 and not (not given_keys and misspelled.intersection(group)):
                alternatives = " or ".join(group)
                reason = f"{' and '.join(given_keys)} given together" if given_keys else f"{alternatives} missing"
                yield Problem((), f"{reason}; expected exactly one of {alternatives}")
        for key, other in cls.required_unless.items():
            if data.get(key) is None and data.get(other) is None and not misspelled.intersection((key, other)):
                yield Problem((key,), f"missing; expected {cls._expected_value(key)}")

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
                    yield Problem(key_path, unexpected_value_message(value, expected_quantity(value, [kind])))


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
    from difflib import get_close_matches

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


def _is_misspelled(detail: Any, intended: set[str | None]) -> bool:
    """Return whether a missing key is among the `intended` keys: those nearest to unknown keys, which are reported."""
    if detail["type"] == "missing" and len(detail["loc"]) == 1:
        return detail["loc"][0] in intended
    return detail.get("ctx", {}).get("absent", "") in intended


def _is_consequence(detail: Any) -> bool:
    """Return whether an error is only a consequence: a list is too short because its items are invalid."""
    return detail["type"] == "too_short" and len(detail["input"]) >= detail["ctx"]["min_length"]
