"""Problems in settings, and their messages.

A problem has a key path and a message. The key path is a tuple of keys and positions from 0, such as ("dampers", 1,
"clearance"). The message contains the given and the expected value. `rig.core.scene.loading` converts the key path to
a line of the file.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError
from pydantic_core import InitErrorDetails

from rig.core.settings.quantity_field import in_brackets, shorten, unexpected_value_message, validation_error

KeyPath = tuple[int | str, ...]


@dataclass(frozen=True)
class Problem:
    """A problem in a scene: its key path and its message."""

    key_path: KeyPath
    message: str
    absent: str = ""  # missing key that causes the problem; the problem is not reported if the key is only misspelled


def problems_of(error: ValidationError) -> list[Problem]:
    """Return the problems in a pydantic error, with the messages of this package."""
    return [Problem(item["loc"], message_of(item)) for item in error.errors(include_url=False)]


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


def message_of(item: Any) -> str:
    """Return the message of a pydantic error: the given value and the expected value."""
    context = item.get("ctx", {})
    expected_value = {
        "greater_than_equal": f"a whole number, at least {context.get('ge')}",
        "less_than_equal": f"a whole number, at most {context.get('le')}",
        "too_short": f"a list of length {context.get('min_length')} or more",
        "too_long": f"a list of length {context.get('max_length')} or less",
        "int_type": "a whole number",
        "int_parsing": "a whole number",
        "int_parsing_size": "a whole number with fewer digits",
        "int_from_float": "a whole number",
        "bool_type": "true or false",
        "bool_parsing": "true or false",
        "string_type": "text",
        "string_too_short": "text that is not empty",
        "string_too_long": f"at most {context.get('max_length')} characters",
        "literal_error": f"one of {str(context.get('expected')).replace(chr(39), '')}",
        "tuple_type": "a list",
    }.get(item["type"])
    if item["type"] == "tuple_type" and (listed := in_brackets(item["input"])):
        expected_value = f"a list in brackets: {shorten(listed)}"
    return unexpected_value_message(item["input"], expected_value) if expected_value else str(item["msg"])
