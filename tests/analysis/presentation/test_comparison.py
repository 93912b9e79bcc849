"""Recordings are compared if they have the same responses; otherwise the error states the difference."""

from __future__ import annotations

from pathlib import Path

import pytest

from analysis.presentation.comparison import MeasurementPoints
from rig.errors import SceneError

FIRST = MeasurementPoints(Path("a.mcap"), (1,), {"base": "body 1", "tip": "body 3"})


def test_same_places_are_comparable() -> None:
    MeasurementPoints(Path("b.mcap"), (1,), {"tip": "body 3", "other": "body 2"}).comparable_with(FIRST)


@pytest.mark.parametrize(
    ("force_on", "channels", "message"),
    [
        ((3,), {"tip": "body 3"}, r"b\.mcap: driven at body 3, a\.mcap at body 1, .* on the same body"),
        ((1,), {"tip": "body 2"}, r"b\.mcap: tip is at body 2, but at body 3 in a\.mcap"),
        ((1,), {"top": "body 3"}, r"b\.mcap: has .*top \(at body 3\), but none .* base \(at body 1\), tip"),
    ],
)
def test_other_places_are_explained(force_on: tuple[int, ...], channels: dict[str, str], message: str) -> None:
    with pytest.raises(SceneError, match=message):
        MeasurementPoints(Path("b.mcap"), force_on, channels).comparable_with(FIRST)


def test_shared_sensors_are_named() -> None:
    first = MeasurementPoints(Path("a.mcap"), (1,), {}, {"base": "one", "tip": "two"})
    second = MeasurementPoints(Path("b.mcap"), (1,), {}, {"base": "one", "tip": "another", "mid": "three"})
    assert second.same_sensors(first) == ["base"]
