"""What a scene turns on: the explanation agrees with the compiled system, and what is absent adds nothing."""

from __future__ import annotations

import re

import pytest

import rig
from rig.effects.effect_cost import effect_costs, text
from rig.scene.scene_files import bundled
from rig.system.assembly import assemble


@pytest.mark.parametrize("name", bundled())
def test_given_a_bundled_scene_when_explained_then_the_states_of_the_motion_are_those_of_its_system(
    name: str,
) -> None:
    scene = rig.load(name)
    system = assemble(scene)
    assert rig.explain(scene).states["motion"] == system.states + 2 * system.dampers


def test_given_effects_taken_away_one_by_one_when_compiled_then_states_and_inputs_go_with_them() -> None:
    full = rig.load("fig9")
    no_coil = full.replace(
        shaker={
            "kind": "electrodynamic",
            "body": 1,
            "spring": full.shaker.spring,
            "amplifier": {"mode": "current"},
        }
    )
    no_damper = full.replace(dampers=())
    bare = rig.load("bare-structure").replace(shaker=None, test=None, channels=None)
    sizes = [assemble(scene).states for scene in (full, no_coil, bare)]
    assert sizes == [9, 8, 6]
    assert assemble(no_damper).dampers == 0
    assert assemble(bare).inputs == ()
    names = {effect.name for effect in rig.explain(no_damper).effects if effect.part == "motion"}
    assert names == {"structure", "coil spring and table", "coil current"}
    assert {"particle dampers", "ceilings", "restitution"} <= set(rig.explain(no_damper).absent)


def test_given_channels_when_explained_then_each_is_listed_with_its_own_stages() -> None:
    ideal = rig.explain(rig.load("fig9").replace(channels=None, converter={}))
    sensed = rig.explain("fig9")
    part = "channel body1 (displacement at body 1)"
    assert sensed.states[part] == 5
    assert [e.name for e in sensed.effects if e.part == part][:2] == ["resonance", "low cut-off"]
    assert "quantisation" not in {effect.name for effect in ideal.effects}
    assert "truth" not in {effect.name for effect in sensed.effects}


def test_given_an_explanation_when_printed_then_channels_that_are_alike_share_one_list() -> None:
    text = str(rig.explain("fig8-three-dampers"))
    assert text.count("quantisation") == 1
    assert text.count("channel body") == 3


@pytest.mark.thorough
def test_given_a_scene_when_its_effects_are_measured_then_each_named_one_is_there_and_states_add_up() -> None:
    scene = rig.load("fig9")
    costs = effect_costs(scene)
    names = [cost.name for cost in costs]
    assert names == [
        "structure",
        "shaker",
        "particle dampers",
        "ceilings",
        "channels, ideal",
        "sensitivity",
        "sensor resonance",
        "sensor low cut-off",
        "sensor noise",
        "integrator",
        "quantisation",
        "recording",
        "display",
    ]
    assert sum(cost.states for cost in costs) == sum(rig.explain(scene).states.values())
    assert all(cost.total > 0.0 for cost in costs)
    assert text(costs).splitlines()[-1].startswith("everything on runs at")


def test_given_a_bare_scene_when_its_effects_are_measured_then_there_is_nothing_but_structure_and_ideal_channels() -> (
    None
):
    scene = rig.loads(
        "structure: {masses: [1 kg], springs: [4 kN/m]}\nrecording: {display: false}", where="test"
    )
    assert [cost.name for cost in effect_costs(scene)] == ["structure", "channels, ideal", "recording"]


def test_given_a_structure_when_explained_then_its_natural_frequencies_are_told_of_many_the_first_and_last() -> (
    None
):
    many = rig.load("bare-structure").replace(
        structure={"masses": [1.0] * 9, "springs": [4e3] * 9}, channels=None
    )
    assert "13.04, 34.78, 49.66 Hz" in str(rig.explain("fig9"))
    assert re.search(r"9 bodies on springs, ([\d.]+, ){6}\.\.\., 19\.\d+ Hz", str(rig.explain(many)))
