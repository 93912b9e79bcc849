"""The common ground of a scene's settings: frozen models that report all their mistakes together.

A mistake carries its place (a tuple of keys and 0-based positions) and, in one sentence, the value found and
what was expected. `rig.scene.loading` turns the place into a line of the file.
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
    """One thing wrong in a scene: where, and what."""

    place: Place
    message: str
    #: Key of the absent part of the scene that is the reason, if any: not reported where that key is misspelt.
    absent: str = ""


def mistakes_of(error: ValidationError) -> list[Mistake]:
    """List what a pydantic error holds, in our own words."""
    return [Mistake(item["loc"], _in_words(item)) for item in error.errors(include_url=False)]


def describe(mistakes: Iterable[Mistake], where: str, line: Callable[[Place], int] | None = None) -> str:
    """Write mistakes one to a line: where, on which line of it, at which place, what.

    >>> describe([Mistake(("dampers", 1, "clearance"), "missing")], "a.yaml", lambda place: 12)
    'a.yaml:12: dampers[2].clearance: missing'
    """
    lines = []
    for wrong in mistakes:
        start = where if line is None else f"{where}:{line(wrong.place)}"
        lines.append(": ".join(filter(None, [start, dotted(wrong.place), wrong.message])))
    return "\n".join(lines)


def dotted(place: Place) -> str:
    """Write a place as a user counts, from 1.

    >>> dotted(("dampers", 1, "clearance"))
    'dampers[2].clearance'
    """
    return "".join(f"[{key + 1}]" if isinstance(key, int) else f".{key[:60]}" for key in place).lstrip(".")


def report(title: str, mistakes: Iterable[Mistake]) -> ValidationError:
    """Make one pydantic error of several mistakes."""
    lines = [InitErrorDetails(type=mistake(m.message, m.absent), loc=m.place, input=None) for m in mistakes]
    return ValidationError.from_exception_data(title, lines)


if TYPE_CHECKING:
    _Model = BaseModel
else:

    class _RaisesSceneError(type(BaseModel)):
        """Makes settings that are built in Python raise the error that a scene file raises."""

        def __call__(cls, *args: Any, **fields: Any) -> Any:
            try:
                return super().__call__(*args, **fields)
            except ValidationError as error:
                raise SceneError(describe(mistakes_of(error), cls.__name__)) from None

    class _Model(BaseModel, metaclass=_RaisesSceneError):
        """Base that type checkers see as pydantic's."""


class Settings(_Model):
    """Base of all settings: frozen, unknown keys refused, all mistakes reported together."""

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        validate_by_name=True,
        validate_by_alias=True,
    )

    # Groups of keys of which exactly one has to be given.
    one_of: ClassVar[tuple[tuple[str, ...], ...]] = ()

    def replace(self, **changes: Any) -> Self:
        """Make a variant with some fields changed, checked like the original.

        Raises
        ------
        SceneError
            With one line for each mistake, if there can be no such variant.
        """
        fields = {name: getattr(self, name) for name in self.model_fields_set}
        try:
            variant = type(self).model_validate({**fields, **changes})
        except ValidationError as error:
            raise SceneError(describe(mistakes_of(error), type(self).__name__)) from None
        variant.__dict__["written"] = {**self.written, **variant.written}
        return variant

    def with_valid(self, **changes: Any) -> Self:
        """Make a variant with fields whose new values are known to be valid, unchecked: for inner loops."""
        variant = self.model_copy(update=changes)
        variant.__dict__["written"] = {
            name: text for name, text in self.written.items() if name not in changes
        }
        return variant

    @cached_property
    def written(self) -> Mapping[str, Any]:
        """Quantities as the user wrote them, by field; of no effect but on how the settings are written."""
        return {}

    def relations(self) -> Iterable[Mistake]:
        """List what is wrong between fields that are right one by one."""
        return ()

    @classmethod
    def kind_by_neighbours(cls, given: Mapping[str, Any]) -> Mapping[Place, Kind]:
        """Say which kind a quantity has to be, by its place, where that depends on other keys."""
        return {}

    def forget_spelling(self) -> None:
        """Take the settings as given in SI, and what has its default as not given: so a recording holds them."""
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
        """Bring short forms into the form of the fields; with the mistakes met on the way."""
        return given, []

    @classmethod
    def place_as_given(cls, place: Place, given: Mapping[str, Any]) -> Place:
        """Give the place in what was given that belongs to a place among the fields."""
        return place

    @classmethod
    def __get_pydantic_json_schema__(
        cls, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Add what pydantic does not know: keys that exclude each other, that the kind is named, and bounds."""
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
        """List the keys as a scene file has them."""
        return [field.alias or name for name, field in cls.model_fields.items()]

    @classmethod
    def _misspelt(cls, item: Any, items: Iterable[Any]) -> bool:
        """Whether a key, or a part to refer to, is missing only because it is misspelt, which is reported itself."""
        unknowns = [str(other["loc"][0]) for other in items if other["type"] == "extra_forbidden"]
        meant = {nearest(key, cls.keys()) for key in unknowns if key}
        if item["type"] == "missing" and len(item["loc"]) == 1:
            return item["loc"][0] in meant
        return item.get("ctx", {}).get("absent", "") in meant

    @classmethod
    def _explain(cls, item: Any) -> Mistake:
        """Put one of pydantic's errors in our words, here where the keys are known."""
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
    """Give what the docstrings below the fields say, by name; read when asked for, as pydantic's own way takes long."""
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
    """Look up what is given at a place, among settings or plain mappings; None where there is nothing."""
    for key in place:
        data = data.get(key) if isinstance(data, Mapping) else getattr(data, str(key), None)
    return data


def unknown(key: str, keys: Iterable[str]) -> str:
    """Say that a key is unknown, with the nearest one there is.

    >>> unknown("clearence", ["mass", "clearance"])
    'unknown key "clearence"; did you mean "clearance"?'
    """
    keys = list(keys)
    near = nearest(key, keys)
    hint = f'did you mean "{near}"?' if near else f"expected one of {', '.join(keys)}"
    return f'unknown key "{key[:60]}"; {hint}'


def nearest(key: str, keys: Iterable[str]) -> str | None:
    """Find the key that a misspelt one was meant to be."""
    return next(iter(get_close_matches(key, list(keys), n=1, cutoff=0.6)), None)


def quantity_at(field: FieldInfo) -> Quantity | None:
    """Find the quantity that a field is; None where it is none."""
    return next(filter(None, map(quantity_of, (*field.metadata, field.annotation))), None)


@cache
def _quantities(cls: type[Settings]) -> dict[str, str]:
    """List the fields that are quantities, each with its key."""
    fields = cls.model_fields.items()
    return {name: field.alias or name for name, field in fields if quantity_at(field) is not None}


def _is_written(value: Any) -> bool:
    listed = value if isinstance(value, list | tuple) else (value,)
    return any(isinstance(item, str) for item in listed)


def _echo(item: Any) -> bool:
    """Whether an error only follows from others: a list counted as too short because its items are wrong."""
    return item["type"] == "too_short" and len(item["input"]) >= item["ctx"]["min_length"]


def _in_words(item: Any) -> str:
    """Phrase a pydantic error as value found and what was expected."""
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
    """What `Annotated[A | B, Alternatives(by_kind)]` accepts: the settings that the given keys call for.

    Unlike a plain union, mistakes are reported for the one kind that was meant.
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
    """Say of a key that only other kinds have which these are."""
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
    """What `Annotated[A | tuple[A, ...], OneOrSeveral(A)]` accepts: settings, or a list of such.

    Unlike with a plain union, mistakes are reported for what was meant.
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
    """Choose by the key `kind`."""
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
    """Choose by the one key that only one of them has, its first."""
    firsts = {cls.keys()[0]: cls for cls in classes}
    there = [key for key in firsts if key in given]
    if len(there) == 1:
        return firsts[there[0]]
    names = f"exactly one of the keys {', '.join(firsts)}"
    near = get_close_matches(" ".join(map(str, given)), firsts, n=1)
    hint = f' (nearest: "{near[0]}")' if near else ""
    raise mistake(expected(dict(given), names) + hint)
