"""The help of every command: options in groups, and an example that the command accepts."""

import shlex
from importlib import import_module

import pytest
import typer.testing

from rig.core.scene.loading import load_with_options

COMMANDS = [
    (program, name)
    for program in ("rig", "daq", "analysis")
    for name in typer.testing._get_command(import_module(f"{program}.commands.cli").app).commands
]


def command(program, name):
    return typer.testing._get_command(import_module(f"{program}.commands.cli").app).commands[name]


@pytest.mark.parametrize(("program", "name"), COMMANDS)
def test_each_command_has_a_valid_example(program, name):
    tested = command(program, name)
    words = shlex.split(tested.epilog)
    assert words[:2] == [program, name]
    context = tested.make_context(name, words[2:])
    assert tested.epilog in tested.get_help(context)
    scenes, changes = context.params.get("scene"), context.params.get("changes")
    for scene in [scenes] if isinstance(scenes, str) else scenes or ():
        if not scene.endswith(".yaml"):
            load_with_options(scene, changes or ())


@pytest.mark.parametrize(("program", "name"), COMMANDS)
def test_summary_fits_the_list_of_commands(program, name):
    assert not command(program, name).get_short_help_str(65).endswith("...")


def test_many_options_are_listed_in_groups():
    text = command("rig", "design").get_help(command("rig", "design").make_context("design", ["fig9"]))
    parts = (
        "Scene:\n",
        "--set",
        "Dampers to choose from:\n",
        "--budget",
        "Criterion:\n",
        "--watched",
        "Output:\n",
        "--overwrite",
        "\nOptions:\n",
    )
    positions = [text.index(part) for part in (*parts, "--help")]
    assert positions == sorted(positions)


def test_few_options_need_no_groups():
    text = command("daq", "info").get_help(command("daq", "info").make_context("info", ["a.mcap"]))
    assert "\nOptions:\n" in text and "\nOutput:\n" not in text
