"""The list of active effects agrees with the compiled system, and disabled effects add nothing."""

import re

import pytest

import rig
from rig.core.base.errors import SceneWarning
from rig.core.scene.scene_files import bundled_scenes
from rig.core.system.assembly import assemble


@pytest.mark.parametrize("name", bundled_scenes())
def test_motion_states_equal_those_of_the_system(name: str) -> None:
    scene = rig.load(name)
    system = assemble(scene)
    # The states of a damper whose gap is a coordinate are among those of the system.
    separate = int(system.detached.sum())
    assert rig.explain(scene).states["motion"] == system.states + 2 * separate


def test_removed_effects_remove_their_states_and_inputs() -> None:
    fig9 = rig.load("fig9")
    without_coil_current = fig9.replace(
        shaker={"kind": "electrodynamic", "body": 1, "spring": fig9.shaker.spring, "amplifier": {"mode": "current"}}
    )
    no_damper = fig9.replace(dampers=())
    force_driven_structure = rig.load("bare-structure").replace(shaker=None, test=None, channels=None)
    # Two states a body, two for the table, one for the coil current.
    assert [assemble(scene).states for scene in (fig9, without_coil_current, force_driven_structure)] == [9, 8, 6]
    assert assemble(no_damper).dampers == 0
    assert assemble(force_driven_structure).inputs == ()
    names = {effect.name for effect in rig.explain(no_damper).effects if effect.part == "motion"}
    assert names == {"structure", "coil spring and table", "coil current"}
    assert {"particle dampers", "ceilings", "restitution"} <= set(rig.explain(no_damper).absent)


def test_each_channel_is_listed_with_its_stages() -> None:
    ideal = rig.explain(rig.load("fig9").replace(channels=None, converter={}))
    measured = rig.explain("fig9")
    part = "channel body1 (displacement at body 1)"
    # Sensor: 2 states of the resonance, 1 of the low cut-off; integrator: 1 of each of two stages.
    assert measured.states[part] == 5
    assert [effect.name for effect in measured.effects if effect.part == part][:2] == ["resonance", "low cut-off"]
    assert "quantization" not in {effect.name for effect in ideal.effects}
    assert "truth" not in {effect.name for effect in measured.effects}


def test_channels_with_equal_effects_share_one_list() -> None:
    text = str(rig.explain("fig8-three-dampers"))
    assert text.count("quantization") == 1
    assert text.count("channel body") == 3


def test_natural_frequencies_are_listed_first_and_last() -> None:
    nine_bodies = rig.load("bare-structure").replace(
        structure={"masses": [1.0] * 9, "springs": [4e3] * 9}, channels=None
    )
    assert "13.04, 34.78, 49.66 Hz" in str(rig.explain("fig9"))
    with pytest.warns(SceneWarning, match="1e\\+09 kg"):
        extreme_masses = rig.load("bare-structure", {"structure.masses": [1e-9, 1e9, 1.0]})
    assert "0.0005395, 22.4, 1.081e+06 Hz" in str(rig.explain(extreme_masses))
    assert re.search(r"9 bodies on springs, ([\d.]+, ){6}\.\.\., 19\.\d+ Hz", str(rig.explain(nine_bodies)))


def test_frequencies_with_attached_coil_spring_are_listed() -> None:
    bench = {"kind": "table", "body": 1, "spring": "3 kN/m"}
    structure = {"masses": ["1 kg"], "springs": ["1 kN/m"]}
    one_body = rig.Scene(structure=structure, shaker=bench)
    # sqrt(1 kN/m / 1 kg) and sqrt(4 kN/m / 1 kg), over 2 pi
    assert "1 body on springs, 5.033 Hz" in str(rig.explain(one_body))
    assert "with this spring and the table at rest 10.07 Hz" in str(rig.explain(one_body))


def test_next_rate_of_module_is_stated() -> None:
    scene = rig.load("fig9", {"converter": {"preset": "NI 9234", "rate": "5 kHz"}})
    assert "5120 Hz, the next rate of the NI 9234 above 5000 Hz" in str(rig.explain(scene))
