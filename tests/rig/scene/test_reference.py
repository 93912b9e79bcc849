"""The reference of scene files: all of it, and in words."""

from __future__ import annotations

import pytest

from rig.errors import SceneError
from rig.scene.loading import bundled, text_of
from rig.scene.reference import help_on, keys, page
from rig.scene.yaml_reader import read


def test_given_every_key_when_explained_then_its_meaning_and_values_are_told() -> None:
    whole = page()
    for key in keys():
        assert len(key.about) > 5 and key.takes and key.without, key
        assert "None" not in key.about + key.without and "`" not in key.about, key
        told = help_on(key.name)
        assert key.name in told and f"left out: {key.without}" in told
        assert key.about in whole


def test_given_the_bundled_scenes_when_their_keys_are_looked_up_then_all_are_explained() -> None:
    known = {key.name.replace("[]", "") for key in keys()} | {"shaker.kind", "test.kind"}

    def names(node: object, path: str) -> set[str]:
        if isinstance(node, list):
            return set().union(*(names(item, path) for item in node))
        if not isinstance(node, dict):
            return set()
        return set().union(*({f"{path}{key}"} | names(inner, f"{path}{key}.") for key, inner in node.items()))

    for name in bundled():
        assert names(read(text_of(name)).content, "") <= known


@pytest.mark.parametrize(
    ("key", "said"),
    [
        ("dampers[2].clearance", "takes: a length such as 0.98 mm, at least 0; a bare number is in m"),
        ("clearance", "dampers[].clearance"),
        ("test.force", "left out: force or drive is needed"),
        ("settle", "tolerance"),
        ("direction", "one of up, down, both"),
        ("integrator.corner", "left out: 0.0"),
        ("accelerometer.q", "left out: 30"),
    ],
)
def test_given_a_key_or_its_end_when_asked_then_it_is_explained(key, said) -> None:
    assert said in help_on(key)


def test_given_a_misspelt_key_when_asked_then_the_nearest_is_named() -> None:
    with pytest.raises(SceneError, match="did you mean clearance"):
        help_on("clearence")
