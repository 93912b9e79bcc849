"""Outputs and inputs of a response: channels with their quantity and location, and their selection by name."""

from collections.abc import Sequence
from dataclasses import dataclass

from rig.core.base.errors import SceneError, suggestion

MOTIONS = ("displacement", "velocity", "acceleration")


@dataclass(frozen=True)
class Point:
    """Output or input of a response: channel, quantity and location.

    `quantity`: ``"displacement"``, ``"velocity"``, ``"acceleration"``, ``"force"``, ``"table"`` (displacement of the
    table), or ``"ratio"`` (ratio of two responses).
    """

    name: str  # channel or body
    quantity: str = "displacement"
    place: str = ""  # name of the body, or ``body 1``; empty if unknown
    body: int = 0  # number of the body; 0 if unknown

    @property
    def at(self) -> str:
        """Location without names: ``body 1``."""
        return f"body {self.body}" if self.body else self.place


def body_number(place: str) -> int:
    """Return the number of the body at a location without names, such as ``body 3``; 0 for any other location."""
    number = place.removeprefix("body ")
    return int(number) if number != place and number.isdecimal() else 0


def index_of(points: Sequence[Point], name: str, kind: str) -> int:
    """Return the index of the point called `name` or, if `name` is a location, of the only point there."""
    if not isinstance(name, str):
        raise SceneError(
            f"{kind}: got {name!r:.60}; expected a name, such as {points[0].name!r}. Iteration gives curves; keys() "
            "lists the names, and items() names with curves."
        )
    matches = [k for k, point in enumerate(points) if point.name == name]
    for place in (name.removeprefix("body "), name):
        matches = matches or [k for k, point in enumerate(points) if point.place == place]
    if len(matches) == 1:
        return matches[0]
    if matches:
        channels = " or ".join(points[k].name for k in matches)
        raise SceneError(f"{len(matches)} {kind}s are at {name}. Select one by its channel: {channels}.")
    names = [point.name for point in points]
    hint = suggestion(name, [*names, *(point.place for point in points)], f"Give one of {', '.join(names)}.")
    raise SceneError(f"no {kind} {name!r}. {hint}")
