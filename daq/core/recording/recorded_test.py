"""The kind of the test in a recording, and a summary of the recorded scene that is read without loading the scene.

Loading a scene takes longer than everything else in `daq info`. A recording therefore repeats the summary in its
metadata record `run`. For an imported or older recording, the kind is determined from the markers, and the summary from
the scene.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

from daq.core.recording.markers import Marker
from daq.core.signal_chain.channel import ChannelInfo

if TYPE_CHECKING:
    from rig.core.scene.excitation import Test
    from rig.core.scene.scene import Scene


class TestKind(StrEnum):
    """Kinds of tests, which are evaluated by different methods; recordings state the values.

    The text after each value states what its estimator assumes, and the fields that the estimator requires in the
    markers of the measured intervals.
    """

    __test__ = False  # not a test for pytest

    TONES = "tones"
    """Tones in steady state, one at a time or simultaneously: sine, stepped sine, and the manually set tone of `daq
    bench`. Markers `measure`, one for each tone (for simultaneous tones, over the same samples): frequency [Hz],
    level, drive, settled; with several sweeps also direction."""
    SWEEP = "sweep"
    """One tone whose frequency changes slowly and steadily. Markers `measure`: from and to [Hz], spacing, duration,
    level."""
    MULTISINE = "multisine"
    """Periods that repeat exactly, at least two in steady state.

    Markers `measure`: realisation (from 1), period [samples], periods, lines (first and last driven spectral line),
    level, settled.
    """
    RANDOM = "random"
    """Stationary noise, or bursts of it, in a band. Markers `measure`: from and to [Hz], level; of bursts also
    burst (driven share of a block) and block [samples]."""
    HITS = "hits"
    """Pulses, such as those of a hammer, that end long before the next pulse. Markers `hit`: no fields are required."""
    FREE = "free"
    """A free decay without a force."""
    SHOCK = "shock"
    """Shocks with a prescribed motion of a channel."""
    NONE = "none"
    """No test, or a test without a measurement."""

    @property
    def field(self) -> str:
        """Field of `measure` markers that distinguishes this kind from all kinds listed after it; empty without one."""
        fields = {"tones": "frequency", "sweep": "spacing", "multisine": "realisation", "random": "from"}
        return fields.get(self.value, "")

    @property
    def drives(self) -> bool:
        """Whether frequency responses can be estimated if a force was measured: the test is not a free decay."""
        return self is not TestKind.FREE

    @property
    def decays(self) -> bool:
        """Whether the response is a free decay."""
        return self in (TestKind.HITS, TestKind.FREE)

    @property
    def steady(self) -> bool:
        """Whether the motion is measured in the steady state of a single tone."""
        return self is TestKind.TONES

    @property
    def spectrum(self) -> str:
        """Kind of spectrum that suits the signals: density of noise, transform of pulses, otherwise amplitude."""
        return {"random": "density", "hits": "transform", "free": "transform"}.get(self.value, "amplitude")

    @property
    def marked(self) -> bool:
        """Whether measured intervals require markers `measure`."""
        return self in (TestKind.SWEEP, TestKind.RANDOM, TestKind.MULTISINE)

    @property
    def hammered(self) -> bool:
        """Whether the force is that of a hammer."""
        return self is TestKind.HITS


@dataclass(frozen=True)
class ControlledTones:
    """Tones whose frequency or level a controller chose from the motion; such tests have their own analysis."""

    field: str  # field of their markers `measure` that only tests with this control write
    analysis: str  # command that evaluates the tones of this control

    def measured(self, markers: Iterable[Marker]) -> list[Marker]:
        """Return the markers of the measured tones; empty for any other test."""
        return [mark for mark in markers if mark.kind == "measure" and self.field in mark.fields]


FOLLOWED_CURVE = ControlledTones("distance", "continuation")
HELD_MOTION = ControlledTones("invasive", "surface")
HELD_PHASE = ControlledTones("phase", "backbone")


def own_analyses(markers: Sequence[Marker]) -> list[str]:
    """Return the commands of `analysis` that evaluate only the control of a test, the most specific first."""
    analyses = ["profile"] if {"identification", "measure"} <= {mark.kind for mark in markers} else []
    # A curve followed by continuation also consists of held motions; only the analysis of the curve is returned.
    tones = [each.analysis for each in (FOLLOWED_CURVE, HELD_MOTION, HELD_PHASE) if each.measured(markers)]
    return analyses + tones[:1]


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
        """Whether frequency responses can be estimated if a force was measured."""
        return self.kind.drives

    @property
    def decays(self) -> bool:
        """Whether the response is a free decay."""
        return self.kind.decays


def kind_of_settings(test: Test | None) -> TestKind:
    """Return the kind of test with the given settings."""
    return TestKind.NONE if test is None else TestKind(test.recorded_as)


def kind_from_markers(markers: Sequence[Marker], settings: Test | None) -> TestKind:
    """Return the kind of a test from its markers, for a recording that does not state the kind.

    >>> kind_from_markers([Marker("hit", 512)], None)
    <TestKind.HITS: 'hits'>
    """
    measure_markers = [marker for marker in markers if marker.kind == "measure"]
    fields = measure_markers[0].fields if measure_markers else {}
    for kind in TestKind:
        if kind.field in fields:
            return kind
    if any(marker.kind == "hit" for marker in markers):
        return TestKind.HITS
    stated = kind_of_settings(settings)
    return stated if measure_markers or not stated.drives else TestKind.NONE


def shocks_of(markers: Iterable[Marker], with_practice: bool = False) -> list[Marker]:
    """Return the markers of the shocks at full level, and those of the practice pulses if `with_practice`."""
    return [mark for mark in markers if mark.kind == "shock" or (with_practice and mark.kind == "practice")]


def deviation_unit(shock: Marker) -> tuple[float, str]:
    """Return factor and unit in which the deviation of a shock is shown: dB, or percent of a quantity."""
    unit = str(shock.fields["unit"])
    return (1.0, "dB") if unit == "dB" else (100.0, f"% {unit}")


@dataclass(frozen=True)
class SceneOutline:
    """Summary of a scene that a recording repeats in its metadata."""

    scene_name: str
    test_kind: str  # "none" without a test
    body_names: tuple[str, ...]  # names of the bodies, body 1 first; empty if the bodies have no names
    n_dampers: int
    # Points whose motion yields the force of the shaker if no channel measures it, such as the ends of its spring.
    # Empty without a shaker, or if the test does not use the shaker.
    force_points: tuple[str, ...]

    @classmethod
    def of(cls, scene: Scene) -> SceneOutline:
        """Return the summary of a scene."""
        test = "none" if scene.test is None else scene.test.kind
        shaker, force_points = scene.driven_shaker, tuple[str, ...]()
        if shaker is not None and (scene.test is None or scene.test.uses_shaker):
            force_points = tuple(shaker.force_terms(scene.at_driven("shaker"), scene.at_driven("table")))
        return cls(scene.name, test, scene.structure.names or (), len(scene.dampers), force_points)

    @classmethod
    def from_metadata(cls, run: Mapping[str, str]) -> SceneOutline | None:
        """Return the summary in the metadata record `run`; None if it is incomplete."""
        try:
            body_names, force_points = (tuple(json.loads(run[key])) for key in ("bodies", "force_places"))
            return cls(run["scene"], run["test"], body_names, int(run["dampers"]), force_points)
        except (KeyError, ValueError, TypeError):
            return None

    def to_metadata(self) -> dict[str, str]:
        """Return the summary as fields of the metadata record `run`."""
        lists = {"bodies": json.dumps(self.body_names), "force_places": json.dumps(self.force_points)}
        return {"scene": self.scene_name, "test": self.test_kind, "dampers": str(self.n_dampers)} | lists

    def label(self, position: str) -> str:
        """Return the name of the body at a location such as ``body 2``, or the location if the body has no name."""
        if not self.body_names or not position.startswith("body "):
            return position
        number = int(position.removeprefix("body "))
        return self.body_names[number - 1] if 1 <= number <= len(self.body_names) else position

    def missing_force_points(self, channels: Collection[ChannelInfo]) -> list[str]:
        """Return the `force_points` without a channel; an empty list if a channel measures the force."""
        if any(info.quantity == "force" for info in channels):
            return []
        measured = {info.at for info in channels}
        return [point for point in self.force_points if point not in measured]
