"""The help of every command: options in groups, and an example that the command accepts."""

import inspect
import shlex
from importlib import import_module

import pytest
import typer.testing

import analysis
import rig
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


@pytest.mark.parametrize(
    ("call", "name", "text"),
    [
        (analysis.srs, "q", "Quality factor of the oscillators, 1 / (2 damping ratio)."),
        (analysis.frf, "response", "Response channels. Default: all channels on bodies. May be repeated."),
        (rig.response, "last", "Highest frequency, such as '80 Hz'. Default: as in the scene's test."),
    ],
)
def test_option_is_declared_by_its_call(call, name, text):
    option = next(each for each in command(call.__module__.split(".")[0], call.__name__).params if each.name == name)
    assert (option.help, option.default) == (text, inspect.signature(call).parameters[name].default)


def test_option_rejects_numbers_below_the_minimum_of_its_call():
    with pytest.raises(typer.BadParameter, match="greater than or equal to 1"):
        command("rig", "design").make_context("design", ["fig9", "--dampers", "0"])
