"""The impact law of a design: its dampers have the restitution and contact of those in the scene."""

from dataclasses import replace
from typing import Any

import pytest

import rig
from rig.core.base.errors import SceneError
from rig.studies.design.check import scene_with_check
from rig.studies.design.choice import INSTANTANEOUS, Choice, Trial, impact_law_of
from rig.studies.design.request import parse_request

FINITE_CONTACT = {"contact": {"duration": "4 ms"}, "restitution": 0.2}


def with_dampers(*changes: dict[str, Any]) -> rig.Scene:
    """Return the scene of Fig. 9 with a damper in body 2 for each change of its settings."""
    return rig.load(
        "fig9", {"dampers": [{"body": 2, "mass": "50 g", "clearance": "1 mm"} | change for change in changes]}
    )


def test_new_dampers_have_the_contact_of_the_scene() -> None:
    scene = with_dampers(FINITE_CONTACT, FINITE_CONTACT)
    objective, _ = parse_request(scene, bodies=[2], levels=[3.3], band=(48.5, 50.5), watched=[2])
    assert str(objective.impact_law) == "impacts of the new dampers: duration 4 ms, restitution 0.2 (as in the scene)"
    choice = Choice((2,), (0.1,), (1e-3,))
    peak = objective.worst(choice)
    trial = Trial(choice, (peak,))
    checked = scene_with_check(scene, trial, objective)
    assert [(damper.restitution, damper.contact) for damper in checked.dampers] == [(0.2, scene.dampers[0].contact)]
    instant = replace(objective, impact_law=INSTANTANEOUS)
    assert instant.digest != objective.digest and instant.worst(choice).magnitude != pytest.approx(
        peak.magnitude, rel=1e-3
    )


def test_contact_of_the_first_damper_is_used() -> None:
    impact_law = impact_law_of(with_dampers(FINITE_CONTACT, {}).dampers)
    assert (impact_law.restitution, impact_law.origin) == (
        0.2,
        "as in the first damper of the scene; other dampers differ",
    )
    walls = {"contact": {"floor": {"duration": "4 ms"}, "ceiling": {"duration": "1 ms"}}}
    assert "duration 4 ms on floors and 1 ms on ceilings" in str(impact_law_of(with_dampers(walls).dampers))
    assert impact_law_of(()) == INSTANTANEOUS and "instantaneous, restitution 0" in str(INSTANTANEOUS)


def test_contact_by_stiffness_is_rejected() -> None:
    scene = with_dampers({"contact": {"stiffness": "100 kN/m", "damping": "5 N s/m"}})
    with pytest.raises(SceneError, match=r"dampers\[1\]\.contact: .* Give a contact duration"):
        impact_law_of(scene.dampers)
