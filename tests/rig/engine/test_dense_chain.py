"""A long chain with modal damping, whose matrices are full: steps by one product equal the summed series."""

from __future__ import annotations

import numpy as np
import pytest

import rig
from rig.engine import flow_tables

BODIES = 205


def displacement() -> np.ndarray:
    scene = rig.Scene(
        name="chain",
        structure={"masses": [1.0] * BODIES, "springs": [4e5] * BODIES, "damping": {"modal": 0.01}},
        dampers=[{"body": 1, "mass_ratio": 0.1, "clearance": "1 mm"}],
        shaker={"kind": "force", "body": 1},
        test={"kind": "sine", "frequency": 80.0, "force": 100.0},
    )
    return np.asarray(rig.simulate(scene, duration=0.03).displacement)


def test_steps_by_one_product_equal_the_series(monkeypatch: pytest.MonkeyPatch) -> None:
    by_product = displacement()
    monkeypatch.setattr(flow_tables, "MAX_STEP_MATRIX_BYTES", 0)
    by_series = displacement()
    assert abs(by_product).max() > 1e-5
    np.testing.assert_allclose(by_product, by_series, atol=1e-10 * abs(by_series).max())
