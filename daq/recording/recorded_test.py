"""The kind of the test in a recording, and the facts of its scene that are needed without loading the scene.

Loading a scene takes longer than everything else in `daq info`. A recording therefore repeats these facts in its
metadata record `run`. For an imported or older recording, the kind is determined from the markers, and the facts from
the scene.
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
    """Kinds of tests, which are evaluated by different methods."""

    __test__ = False  # not a test for pytest

    TONES = "tones"
    """Tones held until steady state: sine, stepped sine, and the manually set tone of `daq bench`."""
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
    """The kind of a recorded test, and its settings in the scene; None if the scene has no test."""

    kind: TestKind
    settings: Test | None

    @property
    def name(self) -> str:
        """Description of the test, for error messages."""
        return "no test" if self.settings is None else f"a test of kind {self.settings.kind}"

    @property
    def drives(self) -> bool:
        """Whether a force drives the structure, so that frequency responses can be estimated."""
        return self.kind is not TestKind.FREE

    @property
    def decays(self) -> bool:
        """Whether the response is a free decay."""
        return self.kind in (TestKind.HITS, TestKind.FREE)


def kind_of_settings(test: Test | None) -> TestKind:
    """Return the kind of test with the given settings."""
    return TestKind.NONE if test is None else _KIND_OF_SETTINGS[test.kind]


def kind_from_markers(markers: Sequence[Marker], settings: Test | None) -> TestKind:
    """Return the kind of a test from its markers, for a recording that does not state it.

    >>> kind_from_markers([Marker("hit", 512)], None)
    <TestKind.HITS: 'hits'>
    """
    measure_markers = [marker for marker in markers if marker.kind == "measure"]
    fields = measure_markers[0].fields if measure_markers else {}
    for field, kind in (
        ("realisation", TestKind.MULTISINE), ("spacing", TestKind.SWEEP), ("from", TestKind.RANDOM),
        ("frequency", TestKind.TONES),
    ):  # fmt: skip
        if field in fields:
            return kind
    if any(marker.kind == "hit" for marker in markers):
        return TestKind.HITS
    is_free = settings is not None and settings.kind == "free"
    return kind_of_settings(settings) if measure_markers or is_free else TestKind.NONE


@dataclass(frozen=True)
class SceneOutline:
    """Facts of a scene that a recording repeats in its metadata."""

    scene: str  # name of the scene
    test: str  # kind of test; "none" without a test
    bodies: tuple[str, ...]  # names, body 1 first; empty if they have none
    dampers: int  # number of dampers
    # Positions whose motion determines the force of the shaker if no channel measures it; empty without a shaker, or if
    # the test does not use it.
    force_places: tuple[str, ...]

    @classmethod
    def of(cls, scene: Scene) -> SceneOutline:
        """Return the facts of a scene."""
        test = "none" if scene.test is None else scene.test.kind
        shaker, force_places = scene.driven_shaker, tuple[str, ...]()
        if shaker is not None and test not in ("impulse", "free"):
            table = (scene.at_driven("table"), f"body {shaker.body}")
            force_places = (scene.at_driven("shaker"),) if shaker.kind == "force" else table
        return cls(scene.name, test, scene.structure.names or (), len(scene.dampers), force_places)

    @classmethod
    def from_metadata(cls, run: Mapping[str, str]) -> SceneOutline | None:
        """Return the facts in the metadata record `run`; None if it does not state them."""
        try:
            bodies, force_places = (tuple(json.loads(run[key])) for key in ("bodies", "force_places"))
            return cls(run["scene"], run["test"], bodies, int(run["dampers"]), force_places)
        except (KeyError, ValueError, TypeError):
            return None

    def to_metadata(self) -> dict[str, str]:
        """Return the facts as fields of the metadata record `run`."""
        lists = {key: json.dumps(getattr(self, key)) for key in ("bodies", "force_places")}
        return {"scene": self.scene, "test": self.test, "dampers": str(self.dampers)} | lists

    def label(self, position: str) -> str:
        """Return the name of the body at a position such as ``body 2``, or the position if it has no name."""
        number = position.removeprefix("body ")
        has_name = self.bodies and position != number and 1 <= int(number) <= len(self.bodies)
        return self.bodies[int(number) - 1] if has_name else position

    def missing_force_places(self, channels: Collection[ChannelInfo]) -> list[str]:
        """Return the positions that need a channel for the force of the shaker, but have none; [] if it is measured."""
        if any(info.quantity == "force" for info in channels):
            return []
        measured = {info.at for info in channels}
        return [position for position in self.force_places if position not in measured]
