"""Functions that other packages register as entry points: effects and test predictions.

The functions are imported when they are called, so the package `rig` does not depend on these packages.
"""

from functools import cache
from importlib.metadata import entry_points
from typing import Any


def registered_functions(group: str) -> list[Any]:
    """Load the functions of a group of entry points such as "shotrig.effects", in the order of their names."""
    return [point.load() for point in sorted(_entry_points().select(group=group), key=lambda point: point.name)]


@cache
def _entry_points() -> Any:
    """Return the entry points of all installed packages, whose metadata are read only once."""
    return entry_points()


def test_predictions(scene: Any) -> list[str]:
    """Return the predictions that each package prints about a scene's test, such as overloads and durations."""
    texts = [predict(scene) for predict in registered_functions("shotrig.foresight")]
    return [text for text in texts if text]
