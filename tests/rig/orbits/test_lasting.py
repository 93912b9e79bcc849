"""Orbits are refused where contact lasts."""

import pytest

import rig
from rig.errors import SceneError


def test_given_contact_that_lasts_when_an_orbit_is_asked_for_then_it_is_refused_with_what_covers_it() -> None:
    scene = rig.load("fig9")
    scene = scene.replace(dampers=[d.replace(contact={"duration": 1e-3}) for d in scene.dampers])
    with pytest.raises(SceneError, match="has contact that lasts"):
        rig.periodic_orbit(scene, 49.1)
