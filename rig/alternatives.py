"""Settings of several kinds in one place: a shaker, a test, a damping of the structure."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from difflib import get_close_matches
from typing import Any, get_args

from pydantic import GetCoreSchemaHandler
from pydantic_core import CoreSchema, core_schema

from rig.quantity_field import expected, mistake, refusal
from rig.settings import Mistake, Settings, report

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
            return self.choose(value, classes).model_validate(value)

        return core_schema.no_info_wrap_validator_function(read, handler(source))


def by_kind(given: Mapping[str, Any], classes: Classes) -> type[Settings]:
    """Choose by the key `kind`."""
    kinds = {cls.model_fields["kind"].default: cls for cls in classes}
    kind = given.get("kind")
    if kind in kinds:
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
