"""The facts of a recorded scene that describe a recording without loading its scene.

Loading a scene takes longer than everything else in `daq info`. A recording therefore repeats these facts in its
metadata record `run`; the scene of a recording without them is loaded.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rig.scene.scene import Scene


@dataclass(frozen=True)
class SceneOutline:
    """Facts of a scene."""

    scene: str
    test: str  # Its kind; "none" without a test
    bodies: tuple[str, ...]  # Names, body 1 first; empty where they have none
    dampers: int
    # Places whose motion determines the shaker's force where no channel measures it; empty without a shaker, or where
    # the test needs none.
    force_places: tuple[str, ...]

    @classmethod
    def of(cls, scene: Scene) -> SceneOutline:
        """Take the facts of a scene."""
        test = "none" if scene.test is None else scene.test.kind
        return cls(
            scene.name, test, scene.structure.names or (), len(scene.dampers), force_places(scene, test)
        )

    @classmethod
    def from_metadata(cls, run: Mapping[str, str]) -> SceneOutline | None:
        """Read the facts of the metadata record `run`; None where it does not state them."""
        try:
            bodies, places = (tuple(json.loads(run[key])) for key in ("bodies", "force_places"))
            return cls(run["scene"], run["test"], bodies, int(run["dampers"]), places)
        except (KeyError, ValueError, TypeError):
            return None

    def to_metadata(self) -> dict[str, str]:
        """Write the facts as fields of the metadata record `run`."""
        lists = {key: json.dumps(getattr(self, key)) for key in ("bodies", "force_places")}
        return {"scene": self.scene, "test": self.test, "dampers": str(self.dampers)} | lists

    def label(self, place: str) -> str:
        """Name the body at a place such as ``body 2``, where bodies have names."""
        number = place.removeprefix("body ")
        named = self.bodies and place != number and 1 <= int(number) <= len(self.bodies)
        return self.bodies[int(number) - 1] if named else place

    def missing_force_places(self, measured: Collection[str], force_measured: bool) -> list[str]:
        """List the places whose motion is not measured although it would determine the shaker's force."""
        return [] if force_measured else [place for place in self.force_places if place not in measured]


def force_places(scene: Scene, test: str) -> tuple[str, ...]:
    """Places of the channels that determine the shaker's force."""
    shaker = scene.driven_shaker
    if shaker is None or test in ("impulse", "free"):
        return ()
    if shaker.kind == "force":
        return (scene.at_driven("shaker"),)
    return (scene.at_driven("table"), f"body {shaker.body}")
