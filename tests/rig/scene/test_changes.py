"""Changes to a scene as it is loaded, from Python and from the command lines."""

from __future__ import annotations

from importlib import import_module

import pytest
import typer

import rig
from rig.arguments import loaded
from rig.errors import SceneError

SHARED = """
structure: {masses: [1 kg, 2 kg], springs: [1 kN/m, 2 kN/m]}
dampers:
  - &one {body: 1, mass: 10 g, clearance: 1 mm}
  - *one
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(SHARED)
    return str(path)


def test_given_changes_when_loaded_then_the_scene_is_as_if_written_so(file) -> None:
    changes = [
        "structure.masses[2]=3kg",
        "dampers[2].body=2",
        "dampers.clearance=.inf",
        "recording.truth=true",
    ]
    scene = loaded(file, changes)
    text = SHARED.replace("2 kg]", "3 kg]").replace("1 mm", ".inf") + "recording: {truth: true}\nname: mine\n"
    assert scene == rig.loads(text.replace("*one", "{body: 2, mass: 10 g, clearance: .inf}"))
    assert loaded(file, ["dampers="]).dampers == () == rig.load(file, {"dampers": None}).dampers


def test_given_an_alias_when_one_of_its_places_is_changed_then_the_other_stays(file) -> None:
    scene = rig.load(file, {"dampers[1].clearance": 2e-3, "dampers[2].body": 2})
    assert [damper.clearance for damper in scene.dampers] == [2e-3, 1e-3]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            "dampers[2].clearance=1kg",
            'dampers[2].clearance=1kg: dampers[2].clearance: got "1kg"; expected a len',
        ),
        ("dampers.clearence=1mm", 'dampers[2].clearence: unknown key "clearence"; did you mean "clearance"?'),
        ("dampers[3].mass=1kg", "the scene has 2 of these, counted from 1"),
        ("channels[1].name=a", "no list there to choose item 1 of"),
        ("dampers[0].mass=1kg", "lists count from 1"),
        ("test..force=1N", "no key"),
        ("gravity", "expected KEY=VALUE such as test.force=5N"),
        ("name=\udcff", "bytes that are no UTF-8"),
        ("structure.masses=[1 kg", "expected KEY=VALUE"),
    ],
)
def test_given_a_wrong_change_when_loaded_then_it_is_named_with_what_was_expected(file, change, said) -> None:
    with pytest.raises(SceneError) as wrong:
        loaded(file, [change])
    assert said in str(wrong.value)


@pytest.mark.parametrize("package", ["rig", "daq", "analysis"])
def test_given_a_command_that_takes_a_scene_when_asked_then_it_takes_changes_too(package) -> None:
    group = typer.main.get_command(import_module(f"{package}.cli").app)
    for name, command in group.commands.items():
        keys = {parameter.name for parameter in command.params}
        assert ("changes" in keys) == bool(keys & {"scene", "scenes"}), name
