"""The engine moves as the laws declare: same events, times, speeds and states as an oracle with dense matrices."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import rig
from rig.core.engine.propagator import tone_propagator
from rig.core.laws.events import CEILING_IMPACT, FLOOR_IMPACT
from rig.core.system.assembly import assemble
from rig.core.system.open_loop_drive import tone_drive
from tests.rig.laws.dense import DenseMotion

PERIODS = 8
#: Slower impacts belong to the end of infinitely many rebounds, m/s.
SLOWEST_IMPACT = 1e-6
#: Events at this distance or less are simultaneous, s.
SIMULTANEOUS_S = 1e-14
#: Largest distance of other events from such an impact, which are of the same end of rebounds, s.
LAST_REBOUNDS_S = 3e-6
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
    assert assert_motion_as_declared(scene, PERIODS) > 10


def assert_motion_as_declared(scene: rig.Scene, periods: int, tolerance: float = 1e-12) -> int:
    """Compare a motion under a tone with the oracle, times within a tolerance, s; return the number of events."""
    system = assemble(scene)
    tone = tone_drive(scene, system)
    assert tone is not None
    propagator, steps = tone_propagator(system, tone.amplitudes, tone.omega)
    propagator.set_state(tone.state, np.array([1.0, 0.0]))
    oracle = DenseMotion(system, propagator.drive, np.concatenate([tone.state, [1.0, 0.0]]))
    energy = oracle.stored_energy()
    trajectory = propagator.propagate_tone(np.array([steps]), np.full(periods, -1), np.ones(1, dtype=bool))
    oracle.advance(periods * 2.0 * np.pi / tone.omega)

    times = trajectory.event_segment * steps * propagator.tables.step + trajectory.event_offset
    log = np.stack([times, trajectory.event_damper, trajectory.event_kind, trajectory.event_speed], axis=1)
    declared, computed = without_last_rebounds(np.array(oracle.events).reshape(-1, 4), log)
    np.testing.assert_array_equal(computed[:, 1:3], declared[:, 1:3])
    np.testing.assert_allclose(computed[:, 0], declared[:, 0], rtol=0, atol=tolerance)
    np.testing.assert_allclose(computed[:, 3], declared[:, 3], rtol=0, atol=10 * tolerance)
    n, bodies = oracle.n, system.coordinates
    state = np.concatenate([oracle.state[:bodies], oracle.state[n : n + bodies]])
    np.testing.assert_allclose(
        state, propagator.state.z[: 2 * bodies], rtol=0, atol=10 * tolerance * np.abs(state).max()
    )
    residual = oracle.work - (oracle.stored_energy() - energy) - oracle.lost
    assert abs(residual) < 1e-13 * max(oracle.exchanged, oracle.lost, energy)
    return len(computed)


def without_last_rebounds(*logs: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Return logs of one motion without events near impacts so slow that the number of events depends on rounding.

    The speed of events other than impacts is set to zero. Events of one instant are in the order of the dampers.
    """
    slow = np.concatenate([log[is_impact(log) & (log[:, 3] <= SLOWEST_IMPACT), 0] for log in logs])
    results = []
    for log in logs:
        events = log[np.argsort(log[:, 0], kind="stable")]
        instant = np.cumsum(np.diff(events[:, 0], prepend=0.0) > SIMULTANEOUS_S)
        events = events[np.lexsort((events[:, 1], instant))]
        events = np.where(is_impact(events)[:, None] | (np.arange(4) < 3), events, 0.0)
        results.append(events[(np.abs(events[:, :1] - slow) > LAST_REBOUNDS_S).all(axis=1)])
    return results


def is_impact(events: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return whether each event is an impact."""
    return np.isin(events[:, 2], (FLOOR_IMPACT, CEILING_IMPACT))
