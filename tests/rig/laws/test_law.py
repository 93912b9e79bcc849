"""The declarations of contact laws are complete, and the check of a declaration finds each fault."""

from functools import partial
from math import inf

import pytest

from rig.core.laws.law import GAP, HOLD, Law, Regime, Signal, Transition, faults
from rig.core.laws.particle_bed import particle_bed
from rig.core.laws.spring_mass import spring_mass
from rig.core.laws.wall_contact import wall_contact

STAY = Transition(("rest",))


@pytest.mark.parametrize("clearance", [1e-3, inf])
@pytest.mark.parametrize("restitution", [0.0, 0.4])
def test_laws_have_no_faults(clearance: float, restitution: float) -> None:
    assert faults(particle_bed(restitution, clearance)) == []
    assert faults(wall_contact((1e4, 2e4), (0.0, 1.0), clearance)) == []


@pytest.mark.parametrize(("below", "above"), [(None, inf), (None, 1e-3), (0.0, inf), (inf, 1e-3)])
@pytest.mark.parametrize("walls", [partial(particle_bed, 0.4), partial(wall_contact, (1e4, 2e4), (0.0, 1.0))])
def test_walls_around_a_spring_have_no_faults(walls, below, above):
    assert faults(spring_mass(walls, below, above)) == []


@pytest.mark.parametrize(
    ("regime", "fault"),
    [
        (Regime((Signal(GAP, 0.0, inf, Transition(("flight",))),)), "'flight' has no regime"),
        (Regime((Signal(GAP, 1.0, 0.0, STAY, STAY),)), "is empty"),
        (Regime((Signal(HOLD, 0.0, inf, STAY),)), "not held"),
        (Regime((Signal(GAP, 0.0, inf, STAY),), None), "constant while"),
        (Regime((Signal(GAP, 0.0),)), "does not agree"),
    ],
)
def test_fault_of_declaration_is_found(regime: Regime, fault: str) -> None:
    [found] = faults(Law({"rest": regime}, "rest"))
    assert fault in found


def test_unknown_start_is_a_fault() -> None:
    assert faults(Law({"rest": Regime(())}, "flight")) == ["the start 'flight' is not a regime"]


def test_rest_on_both_walls_shares_tables() -> None:
    law = particle_bed(0.0, 1e-3)
    assert law.force_indices == {"flight": 0, "floor": 1, "ceiling": 1} and law.forces[1] is None


def test_equal_walls_have_separate_forces() -> None:
    numbers = [
        list(wall_contact((1e4, 1e4), (0.0, 0.0), clearance).force_indices.values()) for clearance in (1e-3, inf)
    ]
    assert numbers == [[0, 1, 2, 0, 0]] * 2
