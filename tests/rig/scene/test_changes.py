"""Changes to a scene as it is loaded, from Python and from the command lines."""

from importlib import import_module
from pathlib import Path

import pytest
import typer

import rig
from rig.commands.arguments import load_scene
from rig.core.base.errors import SceneError

# Two dampers share their settings by a YAML alias.
SCENE_WITH_ALIAS = """
structure: {masses: [1 kg, 2 kg], springs: [1 kN/m, 2 kN/m]}
dampers:
  - &damper {body: 1, mass: 10 g, clearance: 1 mm}
  - *damper
"""


@pytest.fixture
def file(tmp_path):
    """Return the path of a scene file with two dampers."""
    path = tmp_path / "mine.yaml"
    path.write_text(SCENE_WITH_ALIAS)
    return str(path)


def test_changes_load_as_if_written_in_the_file(file) -> None:
    changes = ["structure.masses[2]=3kg", "dampers[2].body=2", "dampers.clearance=.inf", "recording.truth=true"]
    scene = load_scene(file, changes)
    text = SCENE_WITH_ALIAS.replace("2 kg]", "3 kg]").replace("1 mm", ".inf") + "recording: {truth: true}\nname: mine\n"
    assert scene == rig.loads(text.replace("*damper", "{body: 2, mass: 10 g, clearance: .inf}"))
    assert load_scene(file, ["dampers="]).dampers == () == rig.load(file, {"dampers": None}).dampers


def test_change_of_a_shared_damper_affects_it_alone(file) -> None:
    scene = rig.load(file, {"dampers[1].clearance": 2e-3, "dampers[2].body": 2})
    assert [damper.clearance for damper in scene.dampers] == [2e-3, 1e-3]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("dampers[2].clearance=1kg", 'dampers[2].clearance=1kg: dampers[2].clearance: got "1kg"; expected a len'),
        ("dampers.clearence=1mm", "dampers[2].clearence: unknown key 'clearence'. Did you mean 'clearance'?"),
        ("dampers[3].mass=1kg", "item 3 does not exist. The list has 2 items, numbered from 1."),
        ("channels[1].name=a", "the value of this key is not a list. Remove [1]."),
        ("dampers[0].mass=1kg", "items are numbered from 1"),
        ("test..force=1N", "no key"),
        ("gravity", "expected KEY=VALUE such as test.force=5N"),
        ("name=\udcff", "bytes that are not UTF-8"),
        ("structure.masses=[1 kg", "expected KEY=VALUE"),
    ],
)
def test_invalid_change_is_rejected_with_its_expectation(file, change, message) -> None:
    with pytest.raises(SceneError) as raised:
        load_scene(file, [change])
    assert message in str(raised.value)


@pytest.mark.parametrize("package", ["rig", "daq", "analysis"])
def test_scene_commands_have_the_changes_option(package) -> None:
    group = typer.main.get_command(import_module(f"{package}.commands.cli").app)
    for name, command in group.commands.items():
        keys = {parameter.name for parameter in command.params}
        assert ("changes" in keys) == bool(keys & {"scene", "scenes"}), name


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("structure.springs=[1 kN/m]", "with --set structure.springs=[1 kN/m]: structure.springs: got 1 springs"),
        ("structure.masses=[1 kg]", "with --set structure.masses=[1 kg]: structure.springs: got 2 springs"),
        ("gravity=9,81", '--set gravity=9,81: gravity: got "9,81"; expected a decimal point: 9.81'),
        ("structure.masses=1kg,2kg", 'got "1kg,2kg"; expected a list in brackets: [1kg, 2kg]'),
        ("structure.damping.modal=1%,2%", "a ratio such as 10 %, or a list in brackets: [1%, 2%]"),
        ("dampers[0].mass=1kg", "--set dampers[0].mass=1kg: no key"),
        ("dampers[3].mass=1kg", "--set dampers[3].mass=1kg: item 3 does not exist"),
    ],
)
def test_mistake_of_an_option_names_the_option(file, change, message) -> None:
    with pytest.raises(SceneError) as raised:
        load_scene(file, [change])
    assert message in str(raised.value) and "mine.yaml:" not in str(raised.value)


def test_mistake_of_the_file_keeps_its_line(file) -> None:
    Path(file).write_text(SCENE_WITH_ALIAS + "seed: many\n")
    with pytest.raises(SceneError, match=r"mine.yaml:6: seed"):
        load_scene(file, ["gravity=1 kg"])


def test_scene_loads_from_mapping_or_scene(file) -> None:
    scene = rig.load(file)
    assert rig.load({"structure": {"masses": [1], "springs": ["1 kN/m"]}}).structure.springs == (1e3,)
    assert rig.load(scene) is scene
    assert rig.load(scene, {"gravity": "1 m/s^2"}) == scene.replace(gravity=1.0)


@pytest.mark.parametrize(
    ("scene", "changes", "message"),
    [
        ({"structur": 1}, None, "scene: structur: unknown key 'structur'. Did you mean 'structure'?"),
        (7, None, "scene: got 7; expected a name, a path, a mapping or a rig.Scene"),
        ("fig9", "test.force=5N", "changes: got 'test.force=5N'; expected a mapping"),
        ("fig9", {"test.force": "5 kg"}, 'with test.force=5 kg: test.force: got "5 kg"; expected a force'),
    ],
)
def test_mistakes_from_python_are_named(scene, changes, message) -> None:
    with pytest.raises(SceneError) as raised:
        rig.load(scene, changes)
    assert message in str(raised.value) and "\n" not in str(raised.value)
