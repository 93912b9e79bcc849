"""Messages about beds of grains: missing LAMMPS, contradictory and impossible settings."""

import sys

import pytest

import rig
from rig.core.base.errors import SceneError


def test_missing_lammps_names_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "lammps", None)
    scene = rig.loads(
        "{structure: {masses: [1 kg], springs: [1 kN/m]}, "
        "dampers: [{body: 1, mass: 1 g, clearance: 1 mm, grains: {diameter: 2 mm}}]}"
    )

    with pytest.raises(SceneError, match=r"pip install 'shotrig\[grains\]'"):
        rig.simulate(scene, 0.01)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ("restitution: 0.5, grains: {diameter: 2 mm}", "Move restitution into grains"),
        ("contact: {duration: 2 ms}, grains: {diameter: 2 mm}", "Remove contact or grains"),
        ("grains: {diameter: 50 mm}", "largest grain"),
        ("grains: {diameter: 2 mm, modulus: 3 kg}", "a modulus such as 10 MPa"),
    ],
)
def test_contradictory_grain_settings_are_named(keys: str, message: str) -> None:
    text = (
        "{structure: {masses: [1 kg], springs: [1 kN/m]}, "
        f"dampers: [{{body: 1, mass: 1 g, clearance: 1 mm, {keys}}}]}}"
    )
    with pytest.raises(SceneError, match=message):
        rig.loads(text)


@pytest.mark.filterwarnings("ignore:.*times the mass of its body")
@pytest.mark.parametrize(
    ("bed", "message"),
    [
        ("mass: 1 g, clearance: 1 mm, grains: {diameter: 2 mm, time_step: 0.1 ms}", "expected at most"),
        ("mass: 1 mg, clearance: 1 mm, grains: {diameter: 2 mm}", "the mass of one grain"),
    ],
)
def test_impossible_bed_of_grains_is_explained(bed: str, message: str) -> None:
    scene = rig.loads(f"{{structure: {{masses: [1 kg], springs: [1 kN/m]}}, dampers: [{{body: 1, {bed}}}]}}")

    with pytest.raises(SceneError, match=message):
        rig.explain(scene)
