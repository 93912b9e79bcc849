"""Periodic orbits with finite-duration contact, compared with simulations and with instantaneous impacts.

An orbit is the exact periodic motion at a frequency. Its plan is the sequence of contact events in a period.
"""

import numpy as np
import pytest

import rig
from rig.core.orbits import event_kinds as kinds
from rig.core.orbits.periodic_orbit import set_to_orbit, simulate_cycle, start_propagator
from rig.core.orbits.problem import OrbitProblem
from rig.core.scene.scene import Scene
from tests.rig.orbits.scenes import finite_contact_scene


def fig9(**contact: float) -> Scene:
    """Return the scene of Fig. 9 with finite-duration contact: `duration` in s, or `stiffness` and `damping` in SI."""
    return finite_contact_scene("fig9", contact)


def test_short_contacts_converge_to_instantaneous_impact() -> None:
    instant = rig.periodic_orbit(rig.load("fig9"), 49.7)
    deviations = [
        float(np.abs(rig.periodic_orbit(fig9(duration=duration), 49.7).compliance / instant.compliance - 1).max())
        for duration in (1e-3, 2.5e-4, 6.25e-5)
    ]
    assert deviations[2] < 5e-3
    assert deviations[1] < 0.5 * deviations[0]
    assert deviations[2] < 0.5 * deviations[1]


@pytest.mark.parametrize(
    ("contact", "frequency", "force"),
    [({"stiffness": 1800.0, "damping": 17.0}, 40.3, 4.1), ({"stiffness": 2.1e5, "damping": 115.0}, 41.7, 6.0)],
)
def test_contact_force_may_return_during_overlap(contact: dict[str, float], frequency: float, force: float) -> None:
    # The contact force falls to zero and rises again (PRESS_FLOOR) while the damper still overlaps its floor.
    scene = fig9(**contact).replace(test={"kind": "sine", "frequency": frequency, "force": force})
    orbit = rig.periodic_orbit(scene, frequency)
    propagator, steps = start_propagator(OrbitProblem(scene), orbit.operating_point)
    set_to_orbit(propagator, orbit)
    plan, unknowns = simulate_cycle(propagator, steps, orbit.repetition)
    # The margin is the distance to a change of the sequence of events.
    assert kinds.PRESS_FLOOR in orbit.plan.sequence.kind
    assert orbit.margin > 1e-6
    assert plan.label == orbit.plan.label
    # The last unknowns of an orbit are the times of its events, s.
    np.testing.assert_allclose(unknowns[-len(orbit.events) :], orbit.unknowns[-len(orbit.events) :], atol=1e-12)


def test_orbits_of_every_branch_have_small_residuals() -> None:
    curve = rig.follow_orbits(fig9(duration=4e-3), "frequency", (47.0, 50.0), searches=2)
    # At frequencies without a stable orbit the motion is not periodic, which is reported as a failure.
    assert all("no periodic motion at" in failure for failure in curve.failures)
    assert sum(len(branch.orbits) for branch in curve.branches) > 20
    for branch in curve.branches:
        for orbit in branch.orbits:
            assert orbit.residual < 1e-10
