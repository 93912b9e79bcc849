"""A long chain with modal damping has full matrices: steps by a matrix product equal steps by power series."""

import tracemalloc

import numpy as np
import pytest

import rig
from rig.core.engine import flow_tables

BODIES = 205


def chain_displacement() -> np.ndarray:
    """Return the displacements of the chain with a damper in the driven body, m."""
    scene = rig.Scene(
        name="chain",
        structure={"masses": [1.0] * BODIES, "springs": [4e5] * BODIES, "damping": {"modal": 0.01}},
        dampers=[{"body": 1, "mass_ratio": 0.1, "clearance": "1 mm"}],
        shaker={"kind": "force", "body": 1},
        test={"kind": "sine", "frequency": 80.0, "force": 100.0},
    )
    return np.asarray(rig.simulate(scene, duration=0.03).displacement)


def test_steps_by_product_equal_steps_by_series(monkeypatch: pytest.MonkeyPatch) -> None:
    by_product = chain_displacement()
    monkeypatch.setattr(flow_tables, "MAX_STEP_MATRIX_BYTES", 0)
    by_series = chain_displacement()
    assert abs(by_product).max() > 1e-5
    np.testing.assert_allclose(by_product, by_series, atol=1e-10 * abs(by_series).max())


def test_terms_of_exponential_have_no_copies() -> None:
    matrix = np.random.default_rng(1).standard_normal((120, 120))
    tracemalloc.start()
    try:
        terms = flow_tables._exponential_terms(matrix)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 1.2 * terms.nbytes <= 1.2 * flow_tables.TERM_BYTES * matrix.size
