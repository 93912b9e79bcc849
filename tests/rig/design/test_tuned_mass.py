"""The best tuned mass damper of an undamped body is that of Den Hartog, and is compared with particle dampers."""

from math import sqrt
from typing import Any

import numpy as np
import pytest

import rig
from rig.core.system.structural_model import receptance
from rig.studies.design.choice import Objective
from rig.studies.design.tuned_mass import best_tuned_mass

MASS, STIFFNESS = 1.0, 4e3


def objective(structure: dict[str, Any], band: tuple[float, float], bodies: tuple[int, ...]) -> Objective:
    scene = rig.load(
        {
            "structure": structure,
            "shaker": {"kind": "force", "body": 1},
            "test": {"kind": "stepped_sine", "from": band[0], "to": band[1], "points": 3, "force": 1.0},
        }
    )
    return Objective((scene,), (1.0, 4.0), band, bodies)


@pytest.mark.parametrize("ratio", [0.01, 0.1])
def test_best_damper_of_one_body_is_that_of_den_hartog(ratio: float) -> None:
    question = objective({"masses": [MASS], "springs": [STIFFNESS], "damping": {"modal": 1e-6}}, (5.0, 16.0), (1,))
    best = best_tuned_mass(question, [1], ratio * MASS)
    assert best is not None and best.damper.spring is not None
    omega = sqrt(best.damper.spring / best.damper.mass)
    assert omega / sqrt(STIFFNESS / MASS) == pytest.approx(1.0 / (1.0 + ratio), rel=2e-3)
    assert best.damping_ratio == pytest.approx(sqrt(3.0 * ratio / (8.0 * (1.0 + ratio))), rel=0.05)
    assert best.peak.magnitude * STIFFNESS == pytest.approx(sqrt(1.0 + 2.0 / ratio), rel=5e-3)


def test_peak_is_that_of_the_scene_with_the_damper() -> None:
    bare = rig.load("fig9", {"shaker": {"kind": "force", "body": 1}, "channels": None, "dampers": []})
    question = Objective((bare,), (3.3,), (46.0, 54.0), (2,))
    best = best_tuned_mass(question, [1, 2, 3], 0.0426)
    assert best is not None
    damped = bare.replace(dampers=[best.damper])
    compliance = np.abs(receptance(damped, np.linspace(42.0, 60.0, 5001))[1])
    assert compliance.max() == pytest.approx(best.peak.magnitude, rel=1e-4)
    assert best.peak.reduction_from(question.bare_peak) > 10.0
    assert 42.0 < best.frequency < 50.0


def test_body_at_rest_has_no_tuned_mass_damper() -> None:
    question = objective({"masses": [1.0], "springs": [STIFFNESS]}, (50.0, 60.0), (1,))
    assert best_tuned_mass(question, [1], 0.05) is None
