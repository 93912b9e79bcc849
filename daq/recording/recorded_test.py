"""The kind of a recorded test: as the recording states it, or else deduced from its markers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

from daq.recording.markers import Marker

if TYPE_CHECKING:
    from rig.scene.excitation import Test


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
    """Give the kind of a scene's test."""
    return TestKind.NONE if test is None else _KIND_OF_SETTINGS[test.kind]


def kind_of_recording(stated: str, markers: Sequence[Marker], settings: Test | None) -> TestKind:
    """Give the kind of a recorded test: as stated, or deduced from its markers where it is imported or old.

    >>> kind_of_recording("", [Marker("hit", 512)], None)
    <TestKind.HITS: 'hits'>
    """
    return TestKind(stated) if stated in set(TestKind) else _kind_by_markers(markers, settings)


def _kind_by_markers(markers: Sequence[Marker], settings: Test | None) -> TestKind:
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
