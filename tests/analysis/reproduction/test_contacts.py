"""One mass with finite-duration contact: measures of the table, and the contact that is equivalent to a bed."""

from __future__ import annotations

import math

import numpy as np
import pytest

from analysis.reproduction import bed_study
from analysis.reproduction.bed_study import FREQUENCY, compliance_at_peak
from analysis.reproduction.contact_study import (
    TABLE,
    Contact,
    FittedContact,
    at_shaking_frequency,
    ceiling_impulse_on_contact,
    compliance_on_contact,
    contacts,
    cross_validated_deviation,
    deviation_on_contact,
    fit_contact,
    followed,
    scene_on_contact,
    table,
)
from rig.bed_response.steady_bed import steady_mass


def test_fit_recovers_a_finite_contact() -> None:
    kept_contacts, true = table(), FittedContact(0.1, 3e-3, 0.85)
    level, clearance = np.array([(3.0, 3e-4), (4.5, 6e-4), (7.0, 2e-3), (7.0, math.inf)]).T
    beds = {"level": level, "clearance": clearance}
    beds["grains_compliance"] = compliance_on_contact(true, beds, kept_contacts)

    found = fit_contact(beds, kept_contacts)

    assert found == true
    assert deviation_on_contact(found, beds, kept_contacts) == pytest.approx(np.zeros(4), abs=1e-12)
    assert cross_validated_deviation(beds, kept_contacts) == pytest.approx(np.zeros(4), abs=1e-12)
    assert ceiling_impulse_on_contact(found, beds, kept_contacts)[-1] == 0.0


def test_short_stiff_contact_equals_instant_landing() -> None:
    """At 4.5 g below 0.3 mm the motion is periodic, and is computed quickly to a few per cent."""
    contact = Contact(4.5, 3e-4, 0.0, 1e-4)
    row = followed(contact)

    scene = bed_study.scene_of_bed(bed_study.Setting(4.5, 3e-4, 2, 1))
    at_once = steady_mass(scene, FREQUENCY)
    weight = scene.dampers[0].mass * scene.gravity
    assert float(row["energy"]) == pytest.approx(at_once.energy[0] / (weight * 1e-3), rel=0.05)
    assert scene_on_contact(contact).dampers[0].contact.duration == 1e-4


def test_kept_table_is_ordered_and_reproducible() -> None:
    read = TABLE.read()
    points = contacts()
    place = points.index(Contact(1.7, math.inf, 0.1, 3e-3))

    assert [tuple(float(row[name]) for name in TABLE.header[:4]) for row in read] == [
        tuple(one) for one in points
    ]
    again = followed(points[place])
    assert float(again["energy"]) == pytest.approx(float(read[place]["energy"]), rel=1e-3)


def test_mass_compliance_follows_from_energy() -> None:
    beds = at_shaking_frequency(bed_study.table())

    # The table rounds both values and uses the acceleration of the body.
    assert compliance_at_peak(beds["level"], beds["mass_energy"]) == pytest.approx(
        beds["mass_compliance"], rel=0.01
    )
