"""Advice if the impacts of dampers, and not the level of the test, overload accelerometers."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rig.core.scene.scene import Scene


def instantaneous_impact_remedy(scene: Scene) -> str:
    """Return the setting to change if a damper of the scene has impacts of zero duration; otherwise ''."""
    for number, damper in enumerate(scene.dampers, start=1):
        if damper.impacts_instantaneously and damper.friction is None:  # a sliding mass has no `contact`
            return (
                "A damper impact of zero duration overloads most real sensors. "
                f"Set dampers[{number}].contact: {{duration: 2 ms}}, which is typical of shot."
            )
    return ""
