"""Changes of a scene before its validation: from `--set test.force=5N` on a command line, or a mapping in Python."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from rig.core.base.errors import SceneError
from rig.core.scene.yaml_reader import read_yaml
from rig.core.settings.problems import KeyPath
from rig.core.settings.quantity_field import shorten

_STEP = re.compile(r"([A-Za-z_]\w*)((?:\[\d{1,6}\])*)")


@dataclass(frozen=True)
class Change:
    """One change of a scene."""

    key: str  # as written, with items numbered from 1
    steps: KeyPath  # path of the key: names, and list positions from 0
    value: Any  # new value
    option: str = ""  # command-line option of the change; empty from Python

    def __str__(self) -> str:
        return shorten(self.option or f"{self.key}={self.value}")

    def apply_to(self, node: Any, steps: KeyPath | None = None) -> Any:
        """Return content with the new value; a list key without a number applies to every item.

        `steps`: path of the key in `node`; None: `self.steps`. Raises `SceneError` if the item does not exist.
        """
        steps = self.steps if steps is None else steps
        # Content is copied, not changed in place, because an alias in the file makes two places share one object.
        if not steps:
            return self.value
        step, remaining = steps[0], steps[1:]
        if isinstance(node, list):
            indices = range(len(node)) if isinstance(step, str) else [step]  # a key applies to every item
            if not node or indices[0] >= len(node):
                number = step + 1 if isinstance(step, int) else 1
                raise SceneError(
                    f"{self}: item {number} does not exist. The list has {len(node)} item{'s' * (len(node) != 1)}, "
                    "numbered from 1."
                )
            remaining = steps if isinstance(step, str) else remaining
            return [self.apply_to(item, remaining) if k in indices else item for k, item in enumerate(node)]
        if isinstance(step, int):
            # [1] is allowed: a key that takes one item or a list contains one item.
            if step > 0 or node is None:
                raise SceneError(f"{self}: the value of this key is not a list. Remove [{step + 1}].")
            return self.apply_to(node, remaining)
        mapping = node if isinstance(node, dict) else {}
        # Masses may be a mapping from names of bodies, which replaces a list.
        if step == "masses" and remaining and isinstance(mapping.get(step), dict):
            remaining = _use_body_name(remaining, list(mapping[step]))
        if not remaining and self.value is None:
            return {key: value for key, value in mapping.items() if key != step}
        return {**mapping, step: self.apply_to(mapping.get(step), remaining)}

    def covers(self, key_path: KeyPath) -> bool:
        """Return whether the value at a key path is changed.

        >>> Change("dampers.mass", ("dampers", "mass"), "1").covers(("dampers", 1, "mass"))
        True
        """
        remaining = list(key_path)
        for step in self.steps:
            while isinstance(step, str) and remaining and isinstance(remaining[0], int):
                del remaining[0]
            if not remaining or remaining.pop(0) != step:
                return False
        return True


def parse_changes(changes: Mapping[str, Any]) -> list[Change]:
    """Read changes from a mapping.

    `changes`: values by key, such as ``"dampers[2].clearance"``; items of lists are numbered from 1. Raises
    `SceneError` if a key is invalid.

    >>> parse_changes({"dampers[2].clearance": "1 mm"})[0].steps
    ('dampers', 1, 'clearance')
    """
    return [Change(str(key), _parse_key(str(key)), value) for key, value in changes.items()]


def parse_options(settings: Iterable[str]) -> list[Change]:
    """Read changes from the `--set` options of a command line.

    `settings`: texts ``KEY=VALUE``, with the value as in a scene file; an empty value or `null` removes the key.
    Raises `SceneError` if a string does not have this form.

    >>> [change.value for change in parse_options(["test.force=5N", "structure.masses=[1 kg, 2 kg]", "dampers="])]
    ['5N', ['1 kg', '2 kg'], None]
    """
    changes = []
    for setting in settings:
        key, equals, value = setting.partition("=")
        document = read_yaml(value)
        if not equals or document.problems:
            reason = f" ({document.problems[0][1].message})" if document.problems else ""
            raise SceneError(f"--set {setting[:60]}: expected KEY=VALUE such as test.force=5N{reason}")
        steps = _parse_key(key, f"--set {setting[:60]}: ")
        changes.append(Change(key, steps, document.content, f"--set {setting}"))
    return changes


def _use_body_name(steps: KeyPath, names: list[str]) -> KeyPath:
    """Return a key path with the body's name, such as ("arm",), instead of its index."""
    number = steps[0]
    return (names[number], *steps[1:]) if isinstance(number, int) and number < len(names) else steps


def _parse_key(key: str, prefix: str = "") -> KeyPath:
    steps: list[int | str] = []
    for step in key.split("."):
        match = _STEP.fullmatch(step.strip())
        numbers = [] if match is None else [int(n) for n in re.findall(r"\d+", match[2])]
        if match is None or 0 in numbers:
            raise SceneError(
                f"{prefix}no key {key[:60]!r}; expected a key such as test.force, structure.masses[1] (items are "
                "numbered from 1), or dampers.clearance for all dampers"
            )
        steps += [match[1], *(n - 1 for n in numbers)]
    return tuple(steps)
