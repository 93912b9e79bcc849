"""Simulated steady response against the closed form of linear structures."""

from __future__ import annotations

import numpy as np
import pytest

import rig
from rig.system.structural_model import receptance


@pytest.mark.parametrize("frequency", [0.02, 0.2, 14.0])
@pytest.mark.parametrize("shaker", [{"kind": "force", "body": 1}, {"kind": "table", "body": 1, "spring": 6600.0}])
def test_linear_response_is_exact_far_below_resonances(frequency: float, shaker: dict[str, object]) -> None:
    # The step of the engine follows the highest rate of the rig: a period has up to 10 000 steps.
    scene = rig.Scene(
        structure={"masses": [0.8, 0.7, 0.6], "springs": [26e3, 20e3, 20e3], "damping": {"modal": 0.01}},
        shaker=shaker,
        test={"kind": "sine", "frequency": frequency, "force": 1.0},
    )
    response = rig.frequency_response(scene, np.array([frequency]))
    by_force = receptance(scene.replace(shaker={"kind": "force", "body": 1}), np.array([frequency]))
    assert response.converged.all()
    np.testing.assert_allclose(response.compliance, by_force, rtol=1e-7)
