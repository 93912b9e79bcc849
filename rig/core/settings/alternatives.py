"""Fields of settings with several forms: classes that a key selects, and one item or a list of items."""

from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any, get_args

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler, TypeAdapter, ValidationError
from pydantic_core import CoreSchema, core_schema

from rig.core.base.errors import suggestion
from rig.core.settings.problems import Problem, combined_error, problems_of
from rig.core.settings.quantity_field import unexpected_value_error, unexpected_value_message, validation_error
from rig.core.settings.settings import Settings

Classes = tuple[type[Settings], ...]


class _DeferredSchema:
    """Annotation whose values are read by `read`; the schema of its type is built only for the JSON schema.

    Pydantic takes a millisecond to build the schema of a class. Only the classes that a scene uses are built.
    """

    source: Any

    def read(self, value: Any) -> Any:
        """Convert given content to settings."""
        raise NotImplementedError

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        self.source = source
        return core_schema.no_info_plain_validator_function(self.read)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        return handler(TypeAdapter(self.source).core_schema)


class Alternatives(_DeferredSchema):
    """Annotation `Annotated[A | B, Alternatives(by_kind)]`: settings of the class that matches the given keys.

    Unlike with a plain union, problems are reported only for the matching class.
    """

    def __init__(self, choose: Callable[[Mapping[str, Any], Classes], type[Settings]]) -> None:
        self.choose = choose

    def read(self, value: Any) -> Settings:
        """Convert given content to settings of the chosen class."""
        classes: Classes = get_args(self.source)
        if isinstance(value, classes):
            return type(value).model_validate(value)
        if not isinstance(value, Mapping):
            raise unexpected_value_error(value, f"keys and values, with {_selecting_keys(classes)}")
        chosen = self.choose(value, classes)
        try:
            return chosen.model_validate(value)
        except ValidationError as error:
            problems = [_name_other_kinds(problem, chosen, classes) for problem in problems_of(error)]
            raise combined_error(chosen.__name__, problems) from None


def _selecting_keys(classes: Classes) -> str:
    """Return the keys that select one of the classes, or the values of the key `kind`."""
    kinds = [str(cls.model_fields["kind"].default) for cls in classes if "kind" in cls.model_fields]
    return f"kind: {', '.join(kinds)}" if kinds else f"one of the keys {', '.join(_own_keys(classes))}"


def _own_keys(classes: Classes) -> dict[str, type[Settings]]:
    """Map a key to each class: the first of its keys that no other class has."""
    keys = [cls.keys() for cls in classes]
    return {
        next(key for key in own if sum(key in others for others in keys) == 1): cls
        for own, cls in zip(keys, classes, strict=True)
    }


def _name_other_kinds(problem: Problem, chosen: type[Settings], classes: Classes) -> Problem:
    """Add the kinds that have an unknown key to the message about this key."""
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


class OneOrSeveral(_DeferredSchema):
    """Annotation `Annotated[A | tuple[A, ...], OneOrSeveral(A)]`: settings, or a list of settings.

    Unlike with a plain union, problems are reported only for the form that was given.
    """

    def __init__(self, item_type: Any) -> None:
        self.item_type = item_type

    @cached_property
    def adapter(self) -> TypeAdapter[Any]:
        """Validator of one setting, alone or in the list."""
        return TypeAdapter(self.item_type)

    def read(self, value: Any) -> Any:
        """Convert given content to settings, or to a tuple of settings."""
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
    """Choose the class by its first key that no other class has."""
    first_keys = _own_keys(classes)
    given_keys = [key for key in first_keys if key in content]
    if len(given_keys) == 1:
        return first_keys[given_keys[0]]
    names = f"exactly one of the keys {', '.join(first_keys)}"
    hint = suggestion(" ".join(map(str, content)), first_keys)
    raise validation_error(unexpected_value_message(dict(content), names) + (hint and f". {hint}"))
