"""Text about the predicted test for `rig explain` and `rig design`, and the check at the start of `daq record`."""

from daq.core.prediction.foresee import foresee
from daq.core.prediction.foresight import Foresight
from rig.core.base.errors import SceneError, ShotrigError
from rig.core.scene.scene import Scene


def foresight_text(scene: Scene) -> str:
    """Return the predicted test of a scene as text; empty for a scene without a test."""
    if scene.test is None:
        return ""
    try:
        return str(foresee(scene))
    except ShotrigError as error:
        return f"the test cannot be run: {error}"


def reject_certain_abort(name: str, foresight: Foresight) -> None:
    """Raise `SceneError` if the test will abort; `name`: name of the scene."""
    if foresight.aborts is None:
        return
    # If a test aborts within its limits, the reason already contains the remedy.
    remedy = "Raise the limit" if any(entry.share >= 1.0 for entry in foresight.expectations) else "Change the test"
    if foresight.limited_by is not None and foresight.largest_level < foresight.level:
        remedy = f"Lower {foresight.key}, raise the limit"
    reason = foresight.aborts.rstrip(".")
    raise SceneError(
        f"{name}: the test will abort: {reason}. {remedy}, or record the test up to the abort with --anyway."
    )
