"""Load the functions that other packages register as entry points: effects, cost estimates, test predictions."""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import Any

from rig.scene.scene import Scene


def registered_functions(group: str) -> list[Any]:
    """Load the functions of a group of entry points, in the order of their names."""
    return [point.load() for point in sorted(entry_points(group=group), key=lambda point: point.name)]


def foresights(scene: Scene) -> list[str]:
    """Return each package's predictions about a scene's test, as text."""
    texts = [predict(scene) for predict in registered_functions("shotrig.foresight")]
    return [text for text in texts if text]
