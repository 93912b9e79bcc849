"""YAML reader for scene files, with the line number of each value.

Every plain scalar is returned as text (`null`, `~` and an empty value as None). The settings convert the text to the
type that the key requires. So `1e-5` is a number, `name: off` is a name, and no scalar becomes a date or a base-60
number, as it would in YAML 1.1.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import yaml

from rig.core.settings.problems import KeyPath, Problem

# Text after a decimal comma. In a list, where a comma may also separate two numbers, this text must have a unit.
_FRACTION = re.compile(r"\d+(\s*[^\d\s.,].*)?")
_FRACTION_WITH_UNIT = re.compile(r"\d+\s*[^\d\s.,eE].*")
# Maximum number of characters of a scene file, so a wrong file does not exhaust the memory.
MAX_CHARACTERS = 64_000_000
# Largest nesting depth.
MAX_DEPTH = 20
_TOO_DEEP = f"more than {MAX_DEPTH} levels of nesting. Check the indentation."
# Maximum number of nodes that aliases may add; a few nested aliases could otherwise expand to billions.
MAX_ALIAS_NODES = 20_000
_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_NULLS = ("", "~", "null", "Null", "NULL")


@dataclass
class Document:
    """Content of a file as dicts, lists, strings and None, with the line of each key path."""

    content: Any = None
    lines: dict[KeyPath, int] = field(default_factory=dict)
    problems: list[tuple[int, Problem]] = field(default_factory=list)

    def line(self, key_path: KeyPath) -> int:
        """Return the line of a key path in the file, from 1, or else of the innermost key around it."""
        while key_path and key_path not in self.lines:
            key_path = key_path[:-1]
        return self.lines.get(key_path, 1)


class _Unreadable(Exception):
    """Error that ends the reading, with the line of its cause."""

    def __init__(self, line: int, message: str) -> None:
        super().__init__(message)
        self.line = line


def read_yaml(text: str) -> Document:
    """Read a YAML text; `problems` of the returned content list duplicate keys and invalid YAML."""
    document = Document()
    try:
        if len(text) > MAX_CHARACTERS:
            raise _Unreadable(1, f"the file has {len(text)} characters; expected a scene of at most {MAX_CHARACTERS}")
        _Reader(text, document).run()
    except UnicodeEncodeError as error:
        message = "invalid YAML: an incomplete character, or bytes that are not UTF-8. Save the file as UTF-8."
        document.problems.append((text.count("\n", 0, error.start) + 1, Problem((), message)))
    except _Unreadable as error:
        document.problems.append((error.line, Problem((), str(error))))
    except yaml.MarkedYAMLError as error:
        line, message = _parser_message(error, text.splitlines())
        document.problems.append((line, Problem((), message)))
    except yaml.YAMLError as error:
        document.problems.append((1, Problem((), f"invalid YAML: {str(error).splitlines()[0]}")))
    return document


def _parser_message(error: yaml.MarkedYAMLError, lines: Sequence[str]) -> tuple[int, str]:
    """Convert a YAML parser error to a line number and a message with the cause and the remedy."""
    mark = error.problem_mark or error.context_mark
    line = 1 if mark is None else mark.line + 1
    start_line = line if error.context_mark is None else error.context_mark.line + 1
    line_text = lines[line - 1] if line <= len(lines) else ""
    detail, context = str(error.problem), str(error.context or "")
    if "\t" in line_text[: len(line_text) - len(line_text.lstrip())]:
        return line, "a tab in the indentation; expected spaces"
    if "mapping values are not allowed" in detail:
        return (line, 'a second ": " in one value. Put "..." around text with a colon, or correct the indentation.')
    if "expected ':'" in detail:
        return start_line, 'a line without ": " after its key; expected key: value'
    if "expected ',' or" in detail:
        return (
            start_line,
            f"the list or mapping has no closing {detail[-2]}; expected items with commas between, then {detail[-2]}",
        )
    if "expected key" in detail or "expected <block end>" in detail or "'-' indicator" in detail:
        return (line, "the indentation does not match any line above. Align the keys of one section.")
    if "nesting depth" in detail:
        return line, _TOO_DEEP  # limit of the parser, which ends before it reports an event of this depth
    if "unexpected end of stream" in detail:
        return start_line, "a quotation mark is not closed; expected another one at the end of the text"
    return line, f"invalid YAML: {detail}{f' ({context})' if context else ''}"


class _Reader:
    """Builder of the content from the parser's events."""

    def __init__(self, text: str, document: Document) -> None:
        self.events: Iterator[Any] = iter(yaml.parse(text, Loader=_LOADER))
        self.document = document
        self.anchors: dict[str, Any] = {}
        self.alias_nodes = 0

    def run(self) -> None:
        documents = 0
        for event in self.events:
            if isinstance(event, yaml.DocumentStartEvent):
                documents += 1
                if documents > 1:
                    line = _line(event)
                    raise _Unreadable(line, "a second document begins here (---); expected one scene in a file")
                self.document.content = self._node(next(self.events), ())

    def _node(self, event: Any, key_path: KeyPath) -> Any:
        line = _line(event)
        # Only lines that differ from the line of the enclosing key are stored: a matrix may have a million entries.
        if line != self.document.line(key_path):
            self.document.lines[key_path] = line
        if len(key_path) > MAX_DEPTH:
            raise _Unreadable(line, _TOO_DEEP)
        if isinstance(event, yaml.AliasEvent):
            return self._alias(event, line)
        if event.tag is not None and event.tag != "!":
            raise _Unreadable(line, f"got the YAML tag {event.tag}; expected values without tags")
        if isinstance(event, yaml.ScalarEvent):
            value: Any = None if event.implicit[0] and event.value in _NULLS else event.value
        elif isinstance(event, yaml.SequenceStartEvent):
            value = self._sequence(key_path)
        else:
            value = self._mapping(key_path)
        if event.anchor is not None:
            self.anchors[event.anchor] = value
        return value

    def _alias(self, event: Any, line: int) -> Any:
        if event.anchor not in self.anchors:
            raise _Unreadable(line, f"alias *{event.anchor} is not defined above; expected &{event.anchor} before it")
        value = self.anchors[event.anchor]
        self.alias_nodes += _count_nodes(value, MAX_ALIAS_NODES)
        if self.alias_nodes > MAX_ALIAS_NODES:
            raise _Unreadable(
                line, f"aliases (*name) repeat more than {MAX_ALIAS_NODES} values. Write the values without aliases."
            )
        return value

    def _sequence(self, key_path: KeyPath) -> list[Any]:
        values: list[Any] = []
        previous: Any = None
        for event in self.events:
            if isinstance(event, yaml.SequenceEndEvent):
                break
            if _is_decimal_part(previous, event, _FRACTION_WITH_UNIT):
                values[-1] = f"{values[-1]},{event.value}"
            else:
                values.append(self._node(event, (*key_path, len(values))))
            previous = event
        return values

    def _mapping(self, key_path: KeyPath) -> dict[str, Any]:
        values: dict[str, Any] = {}
        key, value = "", None
        for event in self.events:
            if isinstance(event, yaml.MappingEndEvent):
                break
            line = _line(event)
            if not isinstance(event, yaml.ScalarEvent):
                raise _Unreadable(
                    line, "the key is a list or a mapping; expected a word as the key, in the form key: value"
                )
            previous, value = value, next(self.events)
            if getattr(value, "value", None) == "" and _is_decimal_part(previous, event, _FRACTION):
                values[key] = f"{values[key]},{event.value}"
                continue
            key, item_path = event.value, (*key_path, event.value)
            if key in values:
                message = f"given twice, first on line {self.document.line(item_path)}; expected each key once"
                self.document.problems.append((line, Problem(item_path, message)))
                self._node(value, item_path)
                continue
            if line != self.document.line(item_path):
                self.document.lines[item_path] = line
            values[key] = self._node(value, item_path)
        return values


def _is_decimal_part(previous: Any, event: Any, pattern: re.Pattern[str]) -> bool:
    """Return whether a scalar is the second part of a number with a decimal comma, as YAML splits {mass: 1,5 kg}."""
    return (
        isinstance(previous, yaml.ScalarEvent)
        and isinstance(event, yaml.ScalarEvent)
        and previous.implicit[0]
        and event.implicit[0]
        and re.fullmatch(r"[+-]?\d+", previous.value) is not None
        and pattern.fullmatch(event.value) is not None
        and _index(event.start_mark) == _index(previous.end_mark) + 1
    )


def _index(mark: Any) -> int:
    """Return the position of a mark in the text, in characters from 0."""
    return int(mark.index)


def _line(event: Any) -> int:
    """Return the line of the file on which an event starts, from 1."""
    return int(event.start_mark.line) + 1


def _count_nodes(value: Any, limit: int) -> int:
    """Count the values in nested content; stop as soon as the count exceeds `limit`."""
    count, pending = 0, [value]
    while pending and count <= limit:
        node = pending.pop()
        count += 1
        if isinstance(node, dict):
            pending.extend(node.values())
        elif isinstance(node, list):
            pending.extend(node)
    return count
