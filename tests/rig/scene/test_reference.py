"""The key reference (`rig help`, `rig schema --explain`) is complete, and names the right effects and states.

An effect is a physical property of the rig that a key activates, such as sensor noise. An effect may add states to the
equations of motion.
"""

import pytest

import rig
from rig.core.base.errors import SceneError
from rig.core.scene.reference import EFFECTS, help_on, keys, reference_page
from rig.core.scene.scene_files import bundled_scenes, scene_text
from rig.core.scene.yaml_reader import read_yaml


def test_every_key_is_explained_with_its_values() -> None:
    page = reference_page()
    for key in keys():
        assert len(key.meaning) > 5 and key.values and key.default, key
        assert "None" not in key.meaning + key.default and "`" not in key.meaning, key
        help_text = help_on(key.name)
        assert key.name in help_text and f"default: {key.default}" in help_text
        assert key.meaning in page


def test_keys_of_bundled_scenes_are_explained() -> None:
    explained_keys = {key.name.replace("[]", "") for key in keys()} | {"shaker.kind", "test.kind"}

    def full_names(node: object, path: str) -> set[str]:
        """Return the full names of all keys below a node of a scene, such as test.force."""
        if isinstance(node, list):
            return set().union(*(full_names(item, path) for item in node))
        if not isinstance(node, dict):
            return set()
        return set().union(*({f"{path}{key}"} | full_names(inner, f"{path}{key}.") for key, inner in node.items()))

    for name in bundled_scenes():
        assert full_names(read_yaml(scene_text(name)).content, "") <= explained_keys


@pytest.mark.parametrize(
    ("key", "expected_text"),
    [
        ("dampers[2].clearance", "values: a length such as 0.98 mm, at least 0; a bare number is in m"),
        ("clearance", "dampers[].clearance"),
        ("test.force", "default: force or drive is required"),
        ("settle", "tolerance"),
        ("direction", "one of up, down, both"),
        ("integrator.corner", "default: 0.0"),
        ("accelerometer.q", "default: 30"),
        ("shaker.electrodynamic.amplifier", "mode "),
        ("test.impulse.peak", "Peak force of the pulse"),
    ],
)
def test_key_is_explained_by_full_name_or_end(key, expected_text) -> None:
    assert expected_text in help_on(key)


def test_misspelled_key_names_the_nearest() -> None:
    with pytest.raises(SceneError, match="Did you mean 'clearance'"):
        help_on("clearence")


@pytest.mark.parametrize("key", ["test.stepped_sine", "stepped_sine"])
def test_kind_is_explained_with_its_keys(key: str) -> None:
    lines = [line.split() for line in help_on(key).splitlines()]
    listed = {words[0] for words in lines if words}
    keys_of_other_kinds = {"burst", "peak"}
    assert {"from", "points", "force", "settle"} <= listed and not keys_of_other_kinds & listed


def test_help_on_shaker_lists_its_kinds() -> None:
    assert "electrodynamic" in help_on("shaker") and "rig help shaker.KIND" in help_on("shaker")


def test_help_on_kind_is_help_on_section() -> None:
    assert help_on("test.kind") == help_on("test")


def test_misspelled_kind_names_the_nearest() -> None:
    with pytest.raises(SceneError, match=r"Did you mean 'test.stepped_sine'"):
        help_on("test.steped_sine")


SENSOR, INTEGRATOR = "channels[1].accelerometer", "channels[1].integrator"
# Changes that make a scene with few effects.
PLAIN = {
    "structure": {"masses": ["1 kg", "1 kg"], "springs": ["20 kN/m", "20 kN/m"]},
    "dampers": [{"body": 2, "mass": "10 g", "clearance": ".inf"}],
    "shaker": {"kind": "electrodynamic", "body": 1, "spring": "6 kN/m", "amplifier": {"mode": "current"}},
    "test": {"kind": "sine", "frequency": "10 Hz", "drive": "1 V"},
    "channels": [{"name": "a", "at": "body 1", "accelerometer": {"sensitivity": "100 mV/g"}}],
    "converter": {"rate": "5120 Hz"},
    "recording": {"display": False},
}
# For each key that activates an effect: changes of the plain scene without the effect, and with it.
CHANGES: dict[str, tuple[dict[str, object], dict[str, object]]] = {
    "structure.masses": ({}, {"structure": {"masses": ["1 kg"] * 3, "springs": ["20 kN/m"] * 3}}),
    "dampers.body": ({"dampers": None}, {}),
    "dampers.clearance": ({}, {"dampers[1].clearance": "1 mm"}),
    "dampers.restitution": ({}, {"dampers[1].restitution": 0.3}),
    "dampers.spring": ({"dampers": None}, {"dampers": [{"body": 2, "mass": "10 g", "spring": "40 N/m"}]}),
    "dampers.friction": (
        {"dampers": None},
        {"dampers": [{"body": 2, "mass": "10 g", "friction": 0.2, "clearance": ".inf"}]},
    ),
    "joints.between": ({}, {"joints": [{"between": [1, 2], "gap": "1 mm", "stiffness": "1 MN/m"}]}),
    "dampers.contact": ({}, {"dampers[1].contact": {"duration": "2 ms"}}),
    "dampers.locked": ({"dampers": None}, {"dampers[1].locked": True}),
    "shaker.spring": (
        {"shaker": {"kind": "force", "body": 1}, "test": {"kind": "sine", "frequency": "10 Hz", "force": "1 N"}},
        {},
    ),
    "shaker.coil": ({}, {"shaker.amplifier.mode": "voltage"}),
    "shaker.amplifier.limit": ({}, {"shaker.amplifier.limit": "2 A"}),
    f"{SENSOR}.sensitivity_tolerance": ({}, {f"{SENSOR}.sensitivity_tolerance": "5 %"}),
    f"{SENSOR}.resonance": ({}, {f"{SENSOR}.resonance": "30 kHz"}),
    f"{SENSOR}.low_cutoff": ({}, {f"{SENSOR}.low_cutoff": "1 Hz"}),
    f"{SENSOR}.noise": ({}, {f"{SENSOR}.noise": "1 ug/sqrt(Hz)"}),
    f"{SENSOR}.noise_corner": ({}, {f"{SENSOR}.noise": "1 ug/sqrt(Hz)", f"{SENSOR}.noise_corner": "10 Hz"}),
    f"{SENSOR}.bias": ({}, {f"{SENSOR}.bias": "1 V"}),
    f"{SENSOR}.bias_settling": ({}, {f"{SENSOR}.bias": "1 V", f"{SENSOR}.bias_settling": "1 s"}),
    f"{SENSOR}.transverse": ({}, {f"{SENSOR}.transverse": "5 %"}),
    f"{SENSOR}.saturation": ({}, {f"{SENSOR}.saturation": "50 g"}),
    f"{SENSOR}.overload_recovery": ({}, {f"{SENSOR}.saturation": "50 g", f"{SENSOR}.overload_recovery": "1 ms"}),
    f"{SENSOR}.temperature_drift": (
        {},
        {f"{SENSOR}.temperature_drift": "1 %/K", f"{SENSOR}.temperature_change": "10 K"},
    ),
    INTEGRATOR: ({}, {INTEGRATOR: {"order": 1}}),
    f"{INTEGRATOR}.low_cutoff": ({INTEGRATOR: {"order": 1}}, {INTEGRATOR: {"order": 1, "low_cutoff": "1 Hz"}}),
    f"{INTEGRATOR}.saturation": ({INTEGRATOR: {"order": 1}}, {INTEGRATOR: {"order": 1, "saturation": "5 V"}}),
    "converter.bits": ({}, {"converter": {"bits": 24, "range": "5 V"}}),
    "converter.range": ({}, {"converter.range": "5 V"}),
    "converter.noise": ({}, {"converter.noise": "1 uV/sqrt(Hz)"}),
    "converter.coupling": ({}, {"converter.coupling": "AC"}),
    "converter.jitter": ({}, {"converter.jitter": "1 ns"}),
    "converter.filter": ({}, {"converter.filter": "delta_sigma"}),
    "recording.display": ({}, {"recording.display": True}),
    "recording.truth": ({}, {"recording.truth": True}),
}


def test_every_optional_key_adds_its_effect_and_states() -> None:
    assert {key.replace("[1]", "") for key in CHANGES} == set(EFFECTS)
    for key, (initial_changes, effect_changes) in CHANGES.items():
        effect, states = EFFECTS[key.replace("[1]", "")]
        before, after = (
            {(effect.part, effect.name): effect.states for effect in rig.explain(rig.load("fig9", changes)).effects}
            for changes in ({**PLAIN, **initial_changes}, {**PLAIN, **effect_changes})
        )
        changed = {name for part, name in after if after[part, name] != before.get((part, name))}
        states_after, states_before = (
            sum(count for (_, name), count in effects.items() if name == effect) for effects in (after, before)
        )
        added_states = states_after - states_before
        assert effect in changed and (states is None or added_states == states), (key, changed, added_states)
        assert f"effect: {effect}" in help_on(key)
