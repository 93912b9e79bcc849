"""A single mass with finite-duration contact: its table of results, and the fit of the contact to beds of grains."""

import math

import numpy as np
import pytest

from analysis.studies.paper import bed_study
from analysis.studies.paper.bed_study import FREQUENCY, compliance_at_peak
from analysis.studies.paper.contact_study import (
    TABLE,
    ContactPoint,
    FittedContact,
    at_shaking_frequency,
    ceiling_impulse_on_contact,
    compliance_on_contact,
    contacts,
    cross_validated_deviation,
    deviation_on_contact,
    fit_contact,
    scene_on_contact,
    simulate_contact,
    table,
)
from rig.extras.bed_response.steady_bed import steady_mass


def test_fit_recovers_a_finite_contact() -> None:
    bundled_contacts, true_contact = table(), FittedContact(0.1, 3e-3, 0.85)
    # Accelerations, g, and clearances, m, of settings in the bundled table.
    level, clearance = np.array([(3.0, 3e-4), (4.5, 6e-4), (7.0, 2e-3), (7.0, math.inf)]).T
    beds = {"level": level, "clearance": clearance}
    beds["grains_compliance"] = compliance_on_contact(true_contact, beds, bundled_contacts)

    fitted = fit_contact(beds, bundled_contacts)

    assert fitted == true_contact
    assert deviation_on_contact(fitted, beds, bundled_contacts) == pytest.approx(np.zeros(4), abs=1e-12)
    assert cross_validated_deviation(beds, bundled_contacts) == pytest.approx(np.zeros(4), abs=1e-12)
    assert ceiling_impulse_on_contact(fitted, beds, bundled_contacts)[-1] == 0.0


def test_short_stiff_contact_equals_instant_impact(monkeypatch: pytest.MonkeyPatch) -> None:
    """At 4.5 g and a clearance of 0.3 mm the motion is periodic, so that a short computation is exact to 5 %."""
    for name in ("_SETTLING_PERIODS", "_AVERAGED_PERIODS"):
        monkeypatch.setattr(f"analysis.studies.paper.contact_study.{name}", 10)
    contact = ContactPoint(4.5, 3e-4, 0.0, 1e-4)
    row = simulate_contact(contact)

    scene = bed_study.scene_of_bed(bed_study.Setting(4.5, 3e-4, 2, 1))
    instant = steady_mass(scene, FREQUENCY)
    weight = scene.dampers[0].mass * scene.gravity
    assert float(row["energy"]) == pytest.approx(instant.energy[0] / (weight * 1e-3), rel=0.05)
    assert scene_on_contact(contact).dampers[0].contact.duration == 1e-4


def test_bundled_table_is_ordered_and_reproducible() -> None:
    rows = TABLE.read()
    points = contacts()
    index = points.index(ContactPoint(1.7, math.inf, 0.1, 3e-3))

    # The first four columns are the fields of a `ContactPoint`.
    assert [tuple(float(row[name]) for name in TABLE.header[:4]) for row in rows] == [tuple(point) for point in points]
    recomputed = simulate_contact(points[index])
    assert float(recomputed["energy"]) == pytest.approx(float(rows[index]["energy"]), rel=1e-3)


def test_mass_compliance_follows_from_energy() -> None:
    beds = at_shaking_frequency(bed_study.table())

    # The table rounds both values and uses the acceleration of the body.
    assert compliance_at_peak(beds["level"], beds["mass_energy"]) == pytest.approx(beds["mass_compliance"], rel=0.01)
