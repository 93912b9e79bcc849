"""The kind of a recorded test, and the facts of its scene, as the recording states them.

Loading a scene takes longer than everything else in `daq info`. A recording therefore repeats these facts in its
metadata record `run`; the kind of an imported or older recording follows from its markers, the facts from its scene.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

from daq.recording.markers import Marker

if TYPE_CHECKING:
    from daq.signal_chain.channel import ChannelInfo
    from rig.scene.excitation import Test
    from rig.scene.scene import Scene


class TestKind(StrEnum):
    """Kinds of tests, by their measurement."""

    __test__ = False  # no test of pytest's

    TONES = "tones"
    """Held sines: sine, stepped sine, a tone turned by hand."""
    SWEEP = "sweep"
    RANDOM = "random"
    MULTISINE = "multisine"
    HITS = "hits"
    FREE = "free"
    NONE = "none"
    """No test, or a test without a measurement."""


_KIND_OF_SETTINGS = {
    "sine": TestKind.TONES,
    "stepped_sine": TestKind.TONES,
    "swept_sine": TestKind.SWEEP,
    "random": TestKind.RANDOM,
    "multisine": TestKind.MULTISINE,
    "impulse": TestKind.HITS,
    "free": TestKind.FREE,
}


@dataclass(frozen=True)
class RecordedTest:
    """The kind of a recording's test, and its settings in the recorded scene; None where that has no test."""

    kind: TestKind
    settings: Test | None

    @property
    def name(self) -> str:
        """The test in words, for messages."""
        return "no test" if self.settings is None else f"a test of kind {self.settings.kind}"

    @property
    def drives(self) -> bool:
        """Whether a force drives the structure, so that there are responses to it."""
        return self.kind is not TestKind.FREE

    @property
    def decays(self) -> bool:
        """Whether the structure decays freely."""
        return self.kind in (TestKind.HITS, TestKind.FREE)


def kind_of_settings(test: Test | None) -> TestKind:
    """Return the kind of a scene's test."""
    return TestKind.NONE if test is None else _KIND_OF_SETTINGS[test.kind]


def kind_by_markers(markers: Sequence[Marker], settings: Test | None) -> TestKind:
    """Deduce the kind of a test from its markers, where the recording does not state it.

    >>> kind_by_markers([Marker("hit", 512)], None)
    <TestKind.HITS: 'hits'>
    """
    measured = [marker for marker in markers if marker.kind == "measure"]
    fields = measured[0].fields if measured else {}
    for field, kind in (
        ("realisation", TestKind.MULTISINE), ("spacing", TestKind.SWEEP), ("from", TestKind.RANDOM),
        ("frequency", TestKind.TONES),
    ):  # fmt: skip
        if field in fields:
            return kind
    if any(marker.kind == "hit" for marker in markers):
        return TestKind.HITS
    free = settings is not None and settings.kind == "free"
    return kind_of_settings(settings) if measured or free else TestKind.NONE


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
        shaker, places = scene.driven_shaker, tuple[str, ...]()
        if shaker is not None and test not in ("impulse", "free"):
            table = (scene.at_driven("table"), f"body {shaker.body}")
            places = (scene.at_driven("shaker"),) if shaker.kind == "force" else table
        return cls(scene.name, test, scene.structure.names or (), len(scene.dampers), places)

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

    def missing_force_places(self, channels: Collection[ChannelInfo]) -> list[str]:
        """List the places that need a channel so that the channels determine the shaker's force."""
        if any(info.quantity == "force" for info in channels):
            return []
        measured = {info.at for info in channels}
        return [place for place in self.force_places if place not in measured]
