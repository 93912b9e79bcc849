"""Grains without LAMMPS."""

from __future__ import annotations

import sys

import pytest

import rig
from rig.errors import SceneError


def test_given_no_lammps_when_a_scene_names_grains_then_it_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "lammps", None)
    scene = rig.loads(
        "{structure: {masses: [1 kg], springs: [1 kN/m]}, "
        "dampers: [{body: 1, mass: 1 g, clearance: 1 mm, grains: {diameter: 2 mm}}]}"
    )

    with pytest.raises(SceneError, match=r"pip install 'shotrig\[grains\]'"):
        rig.simulate(scene, 0.01)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ("restitution: 0.5, grains: {diameter: 2 mm}", "expected it among grains"),
        ("contact: {duration: 2 ms}, grains: {diameter: 2 mm}", "expected one of the two"),
        ("grains: {diameter: 50 mm}", "largest grain"),
        ("grains: {diameter: 2 mm, modulus: 3 kg}", "a modulus such as 10 MPa"),
    ],
)
def test_given_settings_of_grains_that_contradict_when_loaded_then_the_mistake_is_named(
    changes: str, words: str
) -> None:
    text = (
        "{structure: {masses: [1 kg], springs: [1 kN/m]}, "
        f"dampers: [{{body: 1, mass: 1 g, clearance: 1 mm, {changes}}}]}}"
    )
    with pytest.raises(SceneError, match=words):
        rig.loads(text)


@pytest.mark.parametrize(
    ("bed", "words"),
    [
        ("mass: 1 g, clearance: 1 mm, grains: {diameter: 2 mm, time_step: 0.1 ms}", "expected at most"),
        ("mass: 1 mg, clearance: 1 mm, grains: {diameter: 2 mm}", "the mass of one grain"),
    ],
)
def test_given_a_bed_that_cannot_be_grains_when_it_is_explained_then_it_says_why(
    bed: str, words: str
) -> None:
    scene = rig.loads(f"{{structure: {{masses: [1 kg], springs: [1 kN/m]}}, dampers: [{{body: 1, {bed}}}]}}")

    with pytest.raises(SceneError, match=words):
        rig.explain(scene)
