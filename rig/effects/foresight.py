"""What packages above foresee of a scene's test, announced through entry points."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import entry_points
from typing import cast

from rig.scene.scene import Scene

#: Entry points under which packages that build on the rig say what a test will do.
GROUP = "shotrig.foresight"


def foresights(scene: Scene) -> list[str]:
    """List what each package foresees of a scene's test, as text."""
    points = sorted(entry_points(group=GROUP), key=lambda point: point.name)
    texts = [cast(Callable[[Scene], str], point.load())(scene) for point in points]
    return [text for text in texts if text]
