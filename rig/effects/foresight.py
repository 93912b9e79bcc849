"""Predictions about a scene's test by packages that build on the rig, registered as entry points."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import entry_points
from typing import cast

from rig.scene.scene import Scene

#: Group of entry points for predictions about a test.
GROUP = "shotrig.foresight"


def foresights(scene: Scene) -> list[str]:
    """Return each package's predictions about a scene's test, as text."""
    points = sorted(entry_points(group=GROUP), key=lambda point: point.name)
    texts = [cast(Callable[[Scene], str], point.load())(scene) for point in points]
    return [text for text in texts if text]
