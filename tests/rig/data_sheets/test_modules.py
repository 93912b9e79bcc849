"""Input and output modules from data sheets: sample rates, and properties common to all modules.

A module has an input engine, an output engine, or both; an engine is the part with its own clock and sample rates.
"""

import pytest
from hypothesis import given
from hypothesis import strategies as st

import rig
from rig.core.base.errors import SceneError
from rig.core.data_sheets.data_sheets import data_sheets
from rig.core.data_sheets.modules import Module, Rates, module

NAMES = [name for name, sheet in data_sheets().items() if "module" in sheet.facts]


def rates_of(hardware: Module) -> list[Rates]:
    """Return the sample rates of the inputs and of the outputs, if the module has them."""
    return [engine.rates for engine in (hardware.inputs, hardware.outputs) if engine is not None]


@pytest.mark.parametrize("name", NAMES)
def test_module_facts_agree_with_scene_settings(name: str) -> None:
    hardware, sheet = module(name.lower()), data_sheets()[name]
    assert sheet.sources and hardware.product_type
    for engine, settings in ((hardware.inputs, "converter"), (hardware.outputs, "output")):
        assert (engine is None) == (settings not in sheet.settings)
        if engine is not None:
            assert sheet.settings[settings]["range"] == f"{engine.ranges[-1]:.12g} V"
            assert engine.rates.slowest < engine.rates.fastest
    if hardware.inputs is not None:
        assert sheet.settings["converter"]["excitation"] == f"{1e3 * hardware.inputs.supply[0]:g} mA"
        assert (sheet.settings["converter"].get("filter") == "delta_sigma") == (not hardware.inputs.on_demand)


@given(name=st.sampled_from(NAMES), fraction=st.floats(1e-3, 1.0))
def test_requested_rate_becomes_the_next_higher_clock_rate(name: str, fraction: float) -> None:
    for rates in rates_of(module(name)):
        requested = fraction * rates.fastest
        rate = rates.at_least(requested)
        assert rates.slowest <= rate <= rates.fastest
        # A rate that is lower by at most 0.01 % is accepted.
        assert rate >= requested * (1 - 1.0001e-4)
        assert rates.at_least(rate) == rate
        if rates.available:
            lower_rates = [available for available in rates.available if available < rate]
            assert not lower_rates or lower_rates[-1] < requested


@pytest.mark.parametrize(
    ("name", "rates"),
    [
        ("NI 9234", (51200.0, 25600.0, 51200.0 / 3, 51200.0 / 31)),
        ("NI 9250", (102400.0, 51200.0, 102400.0 / 3, 13107200.0 / 4 / 1024 / 12)),
    ],
)
def test_delta_sigma_rates_are_those_of_the_clock(name: str, rates: tuple[float, ...]) -> None:
    inputs = module(name).inputs
    assert inputs is not None and set(rates) <= set(inputs.rates.available)
    assert inputs.rates.available[-1] == rates[0] and inputs.rates.available[0] == rates[-1]


@pytest.mark.parametrize("rate", [0.0, -1.0, 60e3, float("nan")])
def test_message_about_impossible_rate_names_possible_rates(rate: float) -> None:
    inputs = module("NI 9234").inputs
    assert inputs is not None
    with pytest.raises(SceneError, match=r"expected 1651\.61 to 51200 Hz"):
        inputs.rates.at_least(rate)


def test_sensor_preset_is_not_a_module() -> None:
    with pytest.raises(SceneError, match="unknown module"):
        module("PCB 352C33")


def test_shaker_preset_fills_coil_and_armature() -> None:
    shaker = "{kind: electrodynamic, body: 1, spring: 6.6 kN/m, preset: LDS V203, armature: {mass: 40 g}}"
    scene = rig.loads(f"structure: {{masses: [1 kg], springs: [10 kN/m]}}\nshaker: {shaker}")
    # 3.744 N/A and 2897 N/m are values of the preset; the explicit key `mass` overrides it.
    assert scene.shaker.coil.force_factor == 3.744
    assert scene.shaker.armature.mass == 0.04 and scene.shaker.armature.stiffness == 2897.0


def test_presets_of_shakers_have_all_limits():
    limits = [sheet.settings["shaker"]["limits"] for sheet in data_sheets().values() if "shaker" in sheet.settings]
    assert limits and all(set(each) == {"current", "force", "travel", "velocity"} for each in limits)
