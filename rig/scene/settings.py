"""Base classes of a scene's settings: frozen models that report all their mistakes together.

A mistake has a place (a tuple of keys and 0-based positions) and a message with the given value and the expected
value. `rig.scene.loading` converts the place to a line of the file.
"""

from __future__ import annotations

import ast
import inspect
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache, cached_property
from itertools import pairwise
from textwrap import dedent
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

from rig.errors import SceneError
from rig.scene.quantities import Kind, parse
from rig.scene.quantity_field import Quantity, expected, mistake, quantity_of, refusal

Place = tuple[int | str, ...]


@dataclass(frozen=True)
class Mistake:
    """A mistake in a scene: its place and its message."""

    place: Place
    message: str
    #: Key of the absent part that causes the mistake, if any: the mistake is not reported if that key is misspelt.
    absent: str = ""


def mistakes_of(error: ValidationError) -> list[Mistake]:
    """Return the mistakes in a pydantic error, with the messages of this package."""
    return [Mistake(item["loc"], _in_words(item)) for item in error.errors(include_url=False)]


def describe(mistakes: Iterable[Mistake], where: str, line: Callable[[Place], int] | None = None) -> str:
    """Write one line for each mistake: file, line, place and message.

    >>> describe([Mistake(("dampers", 1, "clearance"), "missing")], "a.yaml", lambda place: 12)
    'a.yaml:12: dampers[2].clearance: missing'
    """
    lines = []
    for wrong in mistakes:
        start = where if line is None else f"{where}:{line(wrong.place)}"
        lines.append(": ".join(filter(None, [start, dotted(wrong.place), wrong.message])))
    return "\n".join(lines)


def dotted(place: Place) -> str:
    """Write a place with positions counted from 1.

    >>> dotted(("dampers", 1, "clearance"))
    'dampers[2].clearance'
    """
    return "".join(f"[{key + 1}]" if isinstance(key, int) else f".{key[:60]}" for key in place).lstrip(".")


def report(title: str, mistakes: Iterable[Mistake]) -> ValidationError:
    """Combine several mistakes into one pydantic error."""
    lines = [InitErrorDetails(type=mistake(m.message, m.absent), loc=m.place, input=None) for m in mistakes]
    return ValidationError.from_exception_data(title, lines)


if TYPE_CHECKING:
    _Model = BaseModel
else:

    class _RaisesSceneError(type(BaseModel)):
        """Metaclass: settings created in Python raise the same error as a scene file."""

        def __call__(cls, *args: Any, **fields: Any) -> Any:
            try:
                return super().__call__(*args, **fields)
            except ValidationError as error:
                raise SceneError(describe(mistakes_of(error), cls.__name__)) from None

    class _Model(BaseModel, metaclass=_RaisesSceneError):
        """Base class that type checkers treat as a pydantic model."""


class Settings(_Model):
    """Base class of all settings: frozen, without unknown keys, with all mistakes reported together."""

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        validate_by_name=True,
        validate_by_alias=True,
    )

    # Groups of keys; exactly one key of each group must be given.
    one_of: ClassVar[tuple[tuple[str, ...], ...]] = ()

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some fields changed, validated like the original.

        Raises
        ------
        SceneError
            If the changed settings are invalid; the message has one line for each mistake.
        """
        fields = {name: getattr(self, name) for name in self.model_fields_set}
        try:
            variant = type(self).model_validate({**fields, **changes})
        except ValidationError as error:
            raise SceneError(describe(mistakes_of(error), type(self).__name__)) from None
        variant.__dict__["written"] = {**self.written, **variant.written}
        return variant

    def with_valid(self, **changes: Any) -> Self:
        """Return a copy with valid new values, without validation: for inner loops."""
        variant = self.model_copy(update=changes)
        variant.__dict__["written"] = {
            name: text for name, text in self.written.items() if name not in changes
        }
        return variant

    @cached_property
    def written(self) -> Mapping[str, Any]:
        """The user's spelling of quantities, by field; it affects only how the settings are written."""
        return {}

    def relations(self) -> Iterable[Mistake]:
        """Return the mistakes in combinations of fields that are each valid."""
        return ()

    @classmethod
    def kind_by_neighbours(cls, given: Mapping[str, Any]) -> Mapping[Place, Kind]:
        """Return the required kind of each quantity, by place, that depends on other keys."""
        return {}

    def forget_spelling(self) -> None:
        """Discard the user's spelling and treat default values as not given, as in a recording."""
        self.__dict__.pop("written", None)
        for name, field in type(self).model_fields.items():
            value = getattr(self, name)
            if value == field.default:
                self.model_fields_set.discard(name)
            for part in value if isinstance(value, tuple) else (value,):
                if isinstance(part, Settings):
                    part.forget_spelling()

    @classmethod
    def prepare(cls, given: Mapping[str, Any]) -> tuple[Mapping[str, Any], list[Mistake]]:
        """Convert short forms to the form of the fields, and return the mistakes in them."""
        return given, []

    @classmethod
    def place_as_given(cls, place: Place, given: Mapping[str, Any]) -> Place:
        """Return the place in the given content that corresponds to a place among the fields."""
        return place

    @classmethod
    def __get_pydantic_json_schema__(
        cls, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Add to pydantic's schema: mutually exclusive keys, the required kind, and bounds."""
        reference = handler(schema)
        known = handler.resolve_ref_schema(reference)
        known["description"] = str(cls.__doc__).split("\n\n")[0]
        if cls.one_of:
            known["allOf"] = [{"oneOf": [{"required": [key]} for key in group]} for group in cls.one_of]
        if "kind" in cls.model_fields:
            known["required"] = ["kind", *known.get("required", ())]
        for name, field in cls.model_fields.items():
            about = descriptions(cls).get(name)
            if about:
                quantity = quantity_at(field)
                written = known["properties"][field.alias or name]
                forms = [choice.get("type") for choice in (written, *written.get("anyOf", ()))]
                each = "a list, each " if "array" in forms and quantity and not quantity.listed else ""
                offered = "" if quantity is None else f" Give {each}{quantity.offered}."
                written["description"] = f"{about}{offered}"
        return reference

    @model_validator(mode="wrap")
    @classmethod
    def _report_together(cls, data: Any, handler: Callable[[Any], Self]) -> Self:
        if not isinstance(data, Mapping):
            return cls._checked(data, handler, [])
        prepared, mistakes = cls.prepare(data)
        try:
            settings = cls._checked(prepared, handler, mistakes)
        except ValidationError as error:
            wrong = mistakes_of(error)
            raise report(
                cls.__name__, [Mistake(cls.place_as_given(m.place, data), m.message) for m in wrong]
            ) from None
        texts = {name: prepared.get(key, prepared.get(name)) for name, key in _quantities(cls).items()}
        settings.__dict__["written"] = {name: text for name, text in texts.items() if _is_written(text)}
        return settings

    @classmethod
    def _checked(cls, data: Any, handler: Callable[[Any], Self], mistakes: list[Mistake]) -> Self:
        known = {wrong.place for wrong in mistakes}
        settings = None
        try:
            settings = handler(data)
        except ValidationError as error:
            items = [item for item in error.errors(include_url=False) if not _echo(item)]
            found = [cls._explain(item) for item in items if not cls._misspelt(item, items)]
            mistakes = mistakes + [wrong for wrong in found if wrong.place not in known]
        if isinstance(data, Mapping):
            mistakes = mistakes + list(cls._presence(data))
            mistakes = mistakes + list(cls._wrong_kinds(data, {wrong.place for wrong in mistakes}))
        if settings is not None and not mistakes:
            mistakes = list(settings.relations())
        if mistakes or settings is None:
            raise report(cls.__name__, mistakes)
        return settings

    @classmethod
    def keys(cls) -> list[str]:
        """Return the keys as written in a scene file."""
        return [field.alias or name for name, field in cls.model_fields.items()]

    @classmethod
    def _misspelt(cls, item: Any, items: Iterable[Any]) -> bool:
        """Whether a key or part is missing only because it is misspelt, which is reported separately."""
        unknowns = [str(other["loc"][0]) for other in items if other["type"] == "extra_forbidden"]
        meant = {nearest(key, cls.keys()) for key in unknowns if key}
        if item["type"] == "missing" and len(item["loc"]) == 1:
            return item["loc"][0] in meant
        return item.get("ctx", {}).get("absent", "") in meant

    @classmethod
    def _explain(cls, item: Any) -> Mistake:
        """Convert a pydantic error to a mistake with this package's message."""
        place, found = item["loc"], item["input"]
        if item["type"] == "extra_forbidden" and len(place) == 1:
            return Mistake(place, unknown(str(place[0]), cls.keys()))
        if item["type"] == "missing" and len(place) == 1:
            return Mistake(place, f"missing; expected {cls._what(str(place[0]))}")
        if item["type"] == "model_type" and not place:
            return Mistake(place, expected(found, f"keys such as {', '.join(cls.keys()[:4])}"))
        if item["type"] == "string_pattern_mismatch" and len(place) == 1:
            return Mistake(place, expected(found, cls._what(str(place[0]))))
        return Mistake(place, _in_words(item))

    @classmethod
    def _what(cls, key: str) -> str:
        name, field = next((n, f) for n, f in cls.model_fields.items() if key in (n, f.alias))
        quantity = quantity_at(field)
        if quantity is not None:
            return quantity.plain
        about = " ".join(descriptions(cls).get(name, "a value").split()).rstrip(".")
        return about[0].lower() + about[1:]

    @classmethod
    def _presence(cls, data: Mapping[str, Any]) -> Iterable[Mistake]:
        for group in cls.one_of:
            there = [key for key in group if data.get(key) is not None]
            misspelt = {nearest(str(key), cls.keys()) for key in data if key not in cls.keys()}  # noqa: SIM118
            if len(there) != 1 and not (not there and misspelt.intersection(group)):
                names = " or ".join(group)
                problem = f"{' and '.join(there)} given together" if there else f"{names} missing"
                yield Mistake((), f"{problem}; expected exactly one of {names}")

    @classmethod
    def _wrong_kinds(cls, data: Mapping[str, Any], known: set[Place]) -> Iterable[Mistake]:
        for place, kind in cls.kind_by_neighbours(data).items():
            given = at(data, place)
            for value in given if isinstance(given, list | tuple) else [given]:
                if not isinstance(value, str) or place in known:
                    continue
                try:
                    parse(value, kind)
                except ValueError:
                    yield Mistake(place, expected(value, f"{kind.noun} such as {kind.example}"))


@cache
def descriptions(cls: type[Settings]) -> dict[str, str]:
    """Return the field docstrings by field name, parsed on demand because pydantic's own parsing is slow."""
    found: dict[str, str] = {}
    for each in reversed(cls.__mro__[: cls.__mro__.index(BaseModel)]):
        tree = ast.parse(dedent(inspect.getsource(each))).body[0]
        assert isinstance(tree, ast.ClassDef)
        for named, said in pairwise(tree.body):
            match named, said:
                case ast.AnnAssign(target=ast.Name(name)), ast.Expr(ast.Constant(str(text))):
                    found[name] = inspect.cleandoc(text)
    return found


def at(data: Any, place: Place) -> Any:
    """Return the value at a place, in settings or plain mappings; None if there is no value."""
    for key in place:
        data = data.get(key) if isinstance(data, Mapping) else getattr(data, str(key), None)
    return data


def unknown(key: str, keys: Iterable[str]) -> str:
    """Return the message for an unknown key, with the nearest valid key.

    >>> unknown("clearence", ["mass", "clearance"])
    'unknown key "clearence"; did you mean "clearance"?'
    """
    keys = list(keys)
    near = nearest(key, keys)
    hint = f'did you mean "{near}"?' if near else f"expected one of {', '.join(keys)}"
    return f'unknown key "{key[:60]}"; {hint}'


def nearest(key: str, keys: Iterable[str]) -> str | None:
    """Return the valid key nearest to a misspelt key."""
    return next(iter(get_close_matches(key, list(keys), n=1, cutoff=0.6)), None)


def quantity_at(field: FieldInfo) -> Quantity | None:
    """Return the quantity of a field; None if the field is not a quantity."""
    return next(filter(None, map(quantity_of, (*field.metadata, field.annotation))), None)


@cache
def _quantities(cls: type[Settings]) -> dict[str, str]:
    """Return the fields that are quantities, each with its key."""
    fields = cls.model_fields.items()
    return {name: field.alias or name for name, field in fields if quantity_at(field) is not None}


def _is_written(value: Any) -> bool:
    listed = value if isinstance(value, list | tuple) else (value,)
    return any(isinstance(item, str) for item in listed)


def _echo(item: Any) -> bool:
    """Whether an error is only a consequence: a list is too short because its items are invalid."""
    return item["type"] == "too_short" and len(item["input"]) >= item["ctx"]["min_length"]


def _in_words(item: Any) -> str:
    """Return the message of a pydantic error: the given value and the expected value."""
    context = item.get("ctx", {})
    what = {
        "greater_than_equal": f"a whole number, at least {context.get('ge')}",
        "less_than_equal": f"a whole number, at most {context.get('le')}",
        "too_short": f"a list of at least {context.get('min_length')}",
        "too_long": f"a list of at most {context.get('max_length')}",
        "int_type": "a whole number",
        "int_parsing": "a whole number",
        "int_parsing_size": "a whole number of ordinary size",
        "int_from_float": "a whole number",
        "bool_type": "true or false",
        "bool_parsing": "true or false",
        "string_type": "text",
        "string_too_short": "some text",
        "string_too_long": f"at most {context.get('max_length')} characters",
        "literal_error": f"one of {str(context.get('expected')).replace(chr(39), '')}",
        "tuple_type": "a list",
    }.get(item["type"])
    return expected(item["input"], what) if what else str(item["msg"])


Classes = tuple[type[Settings], ...]


class Alternatives:
    """What `Annotated[A | B, Alternatives(by_kind)]` accepts: the class of settings that matches the given keys.

    Unlike with a plain union, mistakes are reported only for the matching class.
    """

    def __init__(self, choose: Callable[[Mapping[str, Any], Classes], type[Settings]]) -> None:
        self.choose = choose

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        classes: Classes = get_args(source)

        def read(value: Any, _: Any) -> Settings:
            if isinstance(value, classes):
                return type(value).model_validate(value)
            if not isinstance(value, Mapping):
                raise refusal(value, "keys and values")
            chosen = self.choose(value, classes)
            try:
                return chosen.model_validate(value)
            except ValidationError as error:
                mistakes = [_of_another_kind(wrong, chosen, classes) for wrong in mistakes_of(error)]
                raise report(chosen.__name__, mistakes) from None

        return core_schema.no_info_wrap_validator_function(read, handler(source))


def _of_another_kind(wrong: Mistake, chosen: type[Settings], classes: Classes) -> Mistake:
    """Add to the mistake of an unknown key the other kinds that have this key."""
    key, own = str(wrong.place[0]) if len(wrong.place) == 1 else "", list(chosen.keys())
    kinds = [
        str(kind.default)
        for each in classes
        if key in each.keys() and (kind := each.model_fields.get("kind"))  # noqa: SIM118
    ]
    if key in own or not kinds:
        return wrong
    return Mistake(
        wrong.place,
        f'unknown key "{key}" for kind {chosen.model_fields["kind"].default}, which has {", ".join(own)}; it is for '
        f"{', '.join(kinds)}",
    )


class OneOrSeveral:
    """What `Annotated[A | tuple[A, ...], OneOrSeveral(A)]` accepts: settings, or a list of settings.

    Unlike with a plain union, mistakes are reported only for the form that was given.
    """

    def __init__(self, one: Any) -> None:
        self.one: TypeAdapter[Any] = TypeAdapter(one)

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_wrap_validator_function(self._read, handler(source))

    def _read(self, value: Any, _: Any) -> Any:
        if not isinstance(value, list | tuple):
            return self.one.validate_python(value)
        if not value:
            raise refusal(value, "keys and values, or a list of at least one such")
        found, mistakes = [], []
        for k, item in enumerate(value):
            try:
                found.append(self.one.validate_python(item))
            except ValidationError as error:
                mistakes += [Mistake((k, *wrong.place), wrong.message) for wrong in mistakes_of(error)]
        if mistakes:
            raise report("list", mistakes)
        return tuple(found)


def by_kind(given: Mapping[str, Any], classes: Classes) -> type[Settings]:
    """Choose the class by the key `kind`."""
    kinds = {cls.model_fields["kind"].default: cls for cls in classes}
    kind = given.get("kind")
    if isinstance(kind, str) and kind in kinds:
        return kinds[kind]
    names = f"one of {', '.join(kinds)}"
    near = get_close_matches(str(kind), kinds, n=1)
    hint = f' (nearest: "{near[0]}")' if near else ""
    message = f"missing; expected {names}" if kind is None else expected(kind, names) + hint
    raise report("kind", [Mistake(("kind",), message)])


def by_key(given: Mapping[str, Any], classes: Classes) -> type[Settings]:
    """Choose the class by its first key, which no other class has."""
    firsts = {cls.keys()[0]: cls for cls in classes}
    there = [key for key in firsts if key in given]
    if len(there) == 1:
        return firsts[there[0]]
    names = f"exactly one of the keys {', '.join(firsts)}"
    near = get_close_matches(" ".join(map(str, given)), firsts, n=1)
    hint = f' (nearest: "{near[0]}")' if near else ""
    raise mistake(expected(dict(given), names) + hint)
