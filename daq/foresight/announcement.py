"""Foresight for `rig explain`, `rig design` and the start of `daq record`."""

from __future__ import annotations

from daq.foresight.foresee import foresee
from daq.foresight.foresight import Foresight
from rig.errors import SceneError, ShotrigError
from rig.scene.scene import Scene


def foresight_text(scene: Scene) -> str:
    """Describe the predicted test of a scene; empty for a scene without a test."""
    if scene.test is None:
        return ""
    try:
        return str(foresee(scene))
    except ShotrigError as error:
        return f"the test cannot be run: {error}"


def refuse_certain_abort(name: str, foreseen: Foresight) -> None:
    """Reject a test that will abort."""
    if foreseen.aborts is None:
        return
    level = ""
    if foreseen.limited_by is not None and foreseen.largest_level < foreseen.level:
        level = f"Lower {foreseen.key}, raise the limit, or "
    raise SceneError(
        f"{name}: the test will abort ({foreseen.aborts}). {level or 'Raise the limit, or '}record it up to that "
        "point with --anyway."
    )
