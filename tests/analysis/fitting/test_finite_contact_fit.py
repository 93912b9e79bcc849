"""Fits of dampers with finite-duration contact: the contact's parameters are estimated from frequency responses."""

import numpy as np
import pytest

import analysis
import daq
import rig
from analysis.core.fitting.parameters import free_parameters, with_values

# A body near its resonance, whose damper hits floor and ceiling.
SCENE = """
structure: {masses: [2.2 kg], springs: [95 kN/m], damping: {modal: [0.006]}}
shaker: {kind: force, body: 1}
dampers: [{body: 1, mass: 90 g, clearance: 0.8 mm, %s}]
test: {kind: stepped_sine, frequencies: [26, 29, 31, 32, 32.4, 32.6, 32.8, 33, 33.2, 36], force: 6 N}
channels: [{name: a, at: body 1}, {name: f, at: shaker}]
recording: {display: false}
"""


@pytest.mark.parametrize(
    ("contact", "free"),
    [
        ("contact: {duration: 3 ms}, restitution: 0.1", None),
        ("contact: {stiffness: 120 kN/m, damping: 150 N s/m}", ["dampers"]),
    ],
)
def test_finite_duration_contact_is_fitted(contact: str, free: list[str] | None, tmp_path) -> None:
    scene = rig.loads(SCENE % contact)
    daq.record(scene.replace(dampers=()), tmp_path / "bare.mcap")
    daq.record(scene, tmp_path / "damped.mcap")
    parameters = free_parameters(scene, free)
    deviations = np.where(np.arange(len(parameters)) % 2, 1.15, 1 / 1.15)
    initial_scene = with_values(
        scene,
        {
            parameter.key_path: parameter.start * deviation
            for parameter, deviation in zip(parameters, deviations, strict=True)
        },
    )

    result = analysis.fit([tmp_path / "bare.mcap", tmp_path / "damped.mcap"], initial_scene, free)

    assert not result.misfit
    assert any(parameter.key.startswith("dampers[1].contact") for parameter in result.parameters)
    for parameter, true_parameter in zip(result.parameters, parameters, strict=True):
        assert parameter.value == pytest.approx(true_parameter.start, rel=5e-3), parameter.key


def test_contact_parameters_are_those_of_the_scene() -> None:
    contact = "contact: {floor: {duration: 4 ms}, ceiling: {stiffness: 200 kN/m, damping: 90 N s/m}}"
    keys = [parameter.key for parameter in free_parameters(rig.loads(SCENE % contact))]
    assert keys[-3:] == [
        "dampers[1].contact.floor.duration",
        "dampers[1].contact.ceiling.stiffness",
        "dampers[1].contact.ceiling.damping",
    ]
