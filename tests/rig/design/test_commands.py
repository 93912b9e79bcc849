"""The commands that a design prints can be run as printed, and name the required equipment."""

import shlex
from importlib import import_module
from pathlib import Path

import pytest
from typer.testing import CliRunner

import rig
from rig.studies.design.check import missing_channels, scene_with_check
from rig.studies.design.check_text import describe_check
from rig.studies.design.choice import Choice, Trial
from rig.studies.design.figure import write
from rig.studies.design.request import parse_request
from rig.studies.design.summary import summary
from rig.studies.design.worst_peak import Peak
from tests.rig.this_process import pieces_in_this_process, reduce_chart_and_check

# A scene without channels on the driven body and for the force.
BRACKET = """
name: bracket
structure: {masses: [4.2 kg, 1.1 kg], springs: [839 kN/m, 964 kN/m], damping: {modal: 2 %}}
shaker: {kind: SHAKER}
test: {kind: stepped_sine, from: 58 Hz, to: 66 Hz, points: 9, force: 4 N}
channels: [{name: arm, at: body 2, accelerometer: {sensitivity: 100 mV/g, saturation: 2 g}}]
converter: {rate: 4096 Hz, bits: 24, range: 10 V}
"""
FORCE, TABLE = "force, body: 1", "table, body: 1, spring: 60 kN/m"


def _bracket(shaker: str) -> rig.Scene:
    return rig.loads(BRACKET.replace("SHAKER", shaker))


@pytest.mark.thorough
@pytest.mark.parametrize("shaker", [FORCE, TABLE])
def test_printed_commands_run(shaker: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pieces_in_this_process() as patch:
        # The commands do not depend on the number of designs that are compared, nor on the figure.
        reduce_chart_and_check(patch, points_per_peak=7)
        patch.setattr("rig.studies.design.figure.save_figure", lambda figure, stem: [])
        patch.setattr("rig.studies.design.search.GRID_MASS_RATIOS", (1.0,))
        patch.setattr("rig.studies.design.search.GRID_CLEARANCES", 2)
        requested = {"bodies": [2], "levels": ["4 N"], "clearance": ("0.3 mm", "0.5 mm"), "budget": "30 g"}
        design = rig.design(_bracket(shaker), **requested)
        (scene,) = write(design, tmp_path)
    instructions = describe_check(design, scene)
    # The scene lacks channels, its sensor would be overloaded, and its second mode, at 170.97 Hz, is outside the band.
    assert "has in addition" in instructions and "channels[1].accelerometer.saturation=" in instructions
    assert ("the coil spring adds harmonics" in instructions) == (shaker is TABLE)
    assert "170.97" in summary(design) and "outside the band" in summary(design)
    commands = [shlex.split(line) for line in instructions.splitlines() if line.startswith(("daq ", "analysis "))]
    assert len(commands) == 4
    monkeypatch.chdir(tmp_path)
    for program, *arguments in commands:
        result = CliRunner().invoke(import_module(f"{program}.commands.cli").app, arguments)
        assert result.exit_code == 0, result.output


@pytest.mark.parametrize(("shaker", "added"), [(FORCE, ["body 1", "shaker"]), (TABLE, ["body 1", "table"])])
def test_channels_that_a_check_needs_are_added(shaker: str, added: list[str]) -> None:
    scene = _bracket(shaker)
    objective, _ = parse_request(scene)
    trial = Trial(Choice((2,), (0.1,), (1e-3,)), (Peak(1e-4, 62.0, 4.0, 1, 1.0, 0.0),))
    checked = scene_with_check(scene, trial, objective)
    channels = {channel.at: channel for channel in checked.channels or ()}
    assert list(channels) == ["body 2", *added]
    assert channels["body 1"].accelerometer == channels["body 2"].accelerometer
    assert not missing_channels(checked, 1)


def test_force_sensor_at_stinger_needs_no_table_channel() -> None:
    scene = _bracket(TABLE)
    force = {"name": "force", "at": "shaker", "hammer": {"sensitivity": "10 mV/N"}}
    assert not missing_channels(scene.replace(channels=[*(scene.channels or ()), force]), 2)
