"""Steady responses and orbits are relative to the force, or to the motion of a table that gives no force."""

import numpy as np
import pytest

import rig
from rig.core.base.errors import SceneError
from rig.core.orbits.branches import follow_orbits
from rig.core.orbits.periodic_orbit import periodic_orbit
from rig.core.scene.shaker import TableShaker
from rig.core.steady_response.response_output import csv_rows, format_response
from rig.core.system.assembly import assemble
from rig.core.system.open_loop_drive import riding_response

SCENE = {
    "structure": {"masses": [0.8, 0.7, 0.6], "springs": [26e3, 20e3, 20e3], "damping": {"modal": 0.01}},
    "dampers": [{"body": 3, "mass_ratio": 0.1, "clearance": 0.5e-3}],
    "shaker": {"kind": "table", "body": 1, "spring": 6600.0},
    "test": {"kind": "sine", "frequency": 14.0, "drive": 1e-3},
}


@pytest.fixture
def scene(monkeypatch: pytest.MonkeyPatch) -> rig.Scene:
    """A scene whose responses are relative to the displacement of the table."""
    monkeypatch.setattr(TableShaker, "references", ("table",))
    return rig.load(SCENE)


def test_transmissibility_of_linear_structure_is_exact(scene: rig.Scene) -> None:
    linear = scene.replace(dampers=[])
    response = rig.frequency_response(linear, [14.0, 30.0])
    system = assemble(linear)
    states = riding_response(system, "shaker", 2.0 * np.pi * response.frequency)
    table = states[system.points.index("table")]
    assert response.reference == "table"
    np.testing.assert_allclose(response.frf, states[:3] / table, rtol=1e-7)
    np.testing.assert_allclose(response.reference_amplitude, 1e-3 * abs(table), rtol=1e-7)


def test_orbits_have_the_same_reference(scene: rig.Scene) -> None:
    steady, orbits = rig.frequency_response(scene, [14.0]), rig.orbit_response(scene, [14.0])
    [orbit] = orbits.orbits
    assert orbit is not None and steady.reference == orbits.reference == orbit.reference == "table"
    np.testing.assert_allclose(orbits.frf, steady.frf, rtol=1e-6)
    assert orbit.reference_amplitude == pytest.approx(steady.reference_amplitude[0], rel=1e-6)
    [branch, *_] = follow_orbits(scene, "frequency", (13.9, 14.1), searches=1).branches
    assert "body 3_m/m" in branch.columns()


def test_compliance_requires_force(scene: rig.Scene) -> None:
    steady, orbits = rig.frequency_response(scene, [14.0]), rig.orbit_response(scene, [14.0])
    for result in (steady, orbits, orbits.orbits[0]):
        with pytest.raises(SceneError, match="displacement of the table"):
            _ = result.compliance


def test_outputs_name_transmissibility(scene: rig.Scene) -> None:
    response = rig.frequency_response(scene, [14.0, 30.0])
    header, _ = csv_rows(response)
    assert "body1_transmissibility_m_per_m" in header and "table_m" in header
    text = format_response(response, every_frequency=True)
    assert "peak / (m/m)" in text and "µm/N" not in text
    assert response.response["body 3"].name == "transmissibility"


def test_reference_amplitude_of_orbit_is_its_force() -> None:
    scene = rig.load("fig9")
    orbit = periodic_orbit(scene, 49.7)
    assert orbit.reference == "force" and orbit.reference_amplitude == pytest.approx(scene.test.levels[0], rel=1e-12)
    assert np.array_equal(orbit.compliance, orbit.frf)
