"""Bodies may be given by their names: in scene files, changes, messages and Python."""

import pytest

import rig
from rig.core.base.errors import SceneError
from rig.core.scene.body_names import body_number
from rig.core.scene.structure import Structure

NAMED_BODIES = {
    "structure": {"masses": {"base": "4.2 kg", "arm": "1.1 kg"}, "springs": ["1.2 MN/m", "0.8 MN/m"]},
    "dampers": [{"body": "arm", "mass": "50 g", "clearance": "0.3 mm"}],
    "shaker": {"kind": "force", "body": ["base", 2]},
    "channels": [{"name": "a", "at": "arm"}, {"name": "b", "at": "body base"}, {"name": "c", "at": "body 2"}],
    "test": {"kind": "impulse", "body": "arm", "peak": "30 N", "width": "2 ms"},
}


def test_names_replace_numbers_everywhere() -> None:
    scene = rig.load(NAMED_BODIES)
    assert scene.structure.masses == (4.2, 1.1) and scene.structure.names == ("base", "arm")
    assert scene.dampers[0].body == scene.test.body == 2 and scene.shaker.bodies == (1, 2)
    assert [channel.at for channel in scene.channels] == ["body 2", "body 1", "body 2"]
    assert scene == rig.Scene(**NAMED_BODIES)


def test_bodies_of_matrices_have_names() -> None:
    matrices = {"mass": [[4.2, 0], [0, 1.1]], "stiffness": [[2e6, -8e5], [-8e5, 8e5]]}
    scene = rig.load(
        {"structure": {"matrices": matrices, "names": ["base", "arm"]}, "dampers": NAMED_BODIES["dampers"]}
    )
    assert scene.dampers[0].body == 2
    assert rig.loads(scene.to_yaml()) == scene == rig.loads(scene.to_si_yaml())


def test_label_is_the_name_or_the_number() -> None:
    named, unnamed = rig.load(NAMED_BODIES).structure, Structure(masses=(1.0,), springs=(1.0,))
    assert named.labels == ("base", "arm") and named.label("table") == "table" and named.label("body 2") == "arm"
    assert unnamed.labels == ("body 1",) and unnamed.label("body 1") == "body 1"


@pytest.mark.parametrize("key", ["structure.masses[2]", "structure.masses.arm"])
def test_mass_is_changed_by_number_or_name(key: str) -> None:
    assert rig.load(NAMED_BODIES, {key: "2 kg"}).structure.masses == (4.2, 2.0)


def test_unnamed_scene_text_has_no_names() -> None:
    scene = rig.load("fig9")
    assert scene.structure.names is None and "names" not in scene.to_si_yaml()


@pytest.mark.parametrize(
    ("given", "message"), [("amr", "Did you mean 'arm'"), (3, "body 3 does not"), ("body 0", "body 0 does not")]
)
def test_unknown_body_is_rejected(given: int | str, message: str) -> None:
    with pytest.raises(SceneError, match=message):
        body_number(given, ("base", "arm"), 2)


def test_str_of_a_scene_is_one_line() -> None:
    text = str(rig.load(NAMED_BODIES))
    assert "2 bodies (base, arm)" in text and "1 damper (arm)" in text and "\n" not in text and len(text) < 120
