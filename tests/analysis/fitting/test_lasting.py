"""Fits of dampers with finite-duration contact: duration and restitution are estimated from the curves."""

import numpy as np
import pytest

import analysis
import daq
import rig
from analysis.fitting.parameters import free_parameters, with_values

BENCH = """
structure: {masses: [2.2 kg], springs: [95 kN/m], damping: {modal: [0.006]}}
shaker: {kind: force, body: 1}
dampers: [{body: 1, mass: 90 g, clearance: 0.8 mm, %s}]
test: {kind: stepped_sine, frequencies: [26, 29, 31, 32, 32.4, 32.6, 32.8, 33, 33.2, 36], force: 6 N}
channels: [{name: a, at: body 1}, {name: f, at: shaker}]
recording: {display: false}
"""


@pytest.mark.parametrize(
    "contact",
    ["contact: {duration: 3 ms}, restitution: 0.1", "contact: {stiffness: 120 kN/m, damping: 150 N s/m}"],
)
def test_finite_duration_contact_is_fitted(contact: str, tmp_path) -> None:
    scene = rig.loads(BENCH % contact)
    daq.record(scene.replace(dampers=()), tmp_path / "bare.mcap")
    daq.record(scene, tmp_path / "damped.mcap")
    parameters = free_parameters(scene)
    off = np.where(np.arange(len(parameters)) % 2, 1.15, 1 / 1.15)
    guess = with_values(scene, {one.place: one.start * by for one, by in zip(parameters, off, strict=True)})

    found = analysis.fit([tmp_path / "bare.mcap", tmp_path / "damped.mcap"], guess)

    assert not found.misfit
    assert any(one.key.startswith("dampers[1].contact") for one in found.parameters)
    for one, true in zip(found.parameters, parameters, strict=True):
        assert one.value == pytest.approx(true.start, rel=5e-3), one.key


def test_free_wall_values_follow_the_scene() -> None:
    walls = "contact: {floor: {duration: 4 ms}, ceiling: {stiffness: 200 kN/m, damping: 90 N s/m}}"
    keys = [one.key for one in free_parameters(rig.loads(BENCH % walls))]
    assert keys[-3:] == [
        "dampers[1].contact.floor.duration",
        "dampers[1].contact.ceiling.stiffness",
        "dampers[1].contact.ceiling.damping",
    ]
