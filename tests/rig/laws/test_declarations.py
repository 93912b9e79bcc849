"""The engine moves as the laws declare: same events, times, speeds and states as an oracle with dense matrices."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import rig
from rig.core.engine.propagator import tone_propagator
from rig.core.system.assembly import assemble
from rig.core.system.open_loop_drive import tone_drive
from tests.rig.laws.dense import DenseMotion

PERIODS = 8
REBOUND = {"restitution": 0.4}
CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "A": ("reference-A", {}),
    "B": ("reference-B", {}),
    "C": ("reference-C", {}),
    "B with rebound": ("reference-B", REBOUND),
    "B with contact of 2 ms": ("reference-B", {"contact": {"duration": 2e-3}}),
    "A with contact of 1 ms": ("reference-A", {"contact": {"duration": 1e-3}}),
    "B with rebound in 2 ms": ("reference-B", {"contact": {"duration": 2e-3}, **REBOUND}),
}


@pytest.mark.parametrize("case", CASES)
def test_motion_is_that_of_the_declaration(case: str) -> None:
    name, changes = CASES[case]
    scene = rig.load(name)
    scene = scene.replace(dampers=[damper.replace(**changes) for damper in scene.dampers])
    system = assemble(scene)
    tone = tone_drive(scene, system)
    assert tone is not None
    propagator, steps = tone_propagator(system, tone.amplitudes, tone.omega)
    propagator.set_state(tone.state, np.array([1.0, 0.0]))
    oracle = DenseMotion(system, propagator.drive, np.concatenate([tone.state, [1.0, 0.0]]))
    energy = oracle.stored_energy()
    trajectory = propagator.propagate_tone(np.array([steps]), np.full(PERIODS, -1), np.ones(1, dtype=bool))
    oracle.advance(PERIODS * 2.0 * np.pi / tone.omega)

    computed = np.array(oracle.events)
    times = trajectory.event_segment * steps * propagator.tables.step + trajectory.event_offset
    assert len(computed) > 10
    np.testing.assert_array_equal(computed[:, 1:3], np.stack([trajectory.event_damper, trajectory.event_kind], 1))
    np.testing.assert_allclose(computed[:, 0], times, rtol=0, atol=1e-12)
    is_impact = trajectory.event_speed > 0.0
    np.testing.assert_allclose(computed[is_impact, 3], trajectory.event_speed[is_impact], rtol=0, atol=1e-11)
    n, bodies = oracle.n, system.coordinates
    state = np.concatenate([oracle.state[:bodies], oracle.state[n : n + bodies]])
    np.testing.assert_allclose(state, propagator.state.z[: 2 * bodies], rtol=0, atol=1e-11 * np.abs(state).max())
    residual = oracle.work - (oracle.stored_energy() - energy) - oracle.lost
    assert abs(residual) < 1e-13 * max(abs(oracle.work), oracle.lost, energy)
