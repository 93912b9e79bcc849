"""Study of the single-mass model with contacts of finite duration (`analysis contacts`), fitted to beds of grains.

At the settings of `bed_study` at 50 Hz, a single mass is simulated with several restitutions and contact durations. A
fraction of the mass of the bed moves, and the rest is fixed to the body. The dissipated energy is proportional to this
fraction. Over all settings with a ceiling, the fitted contact minimizes the deviation of the compliance of the body
from the compliance with grains. Without a ceiling, instantaneous contact is closer. The deviation is cross-validated:
for each acceleration, the contact is fitted to the other accelerations.
"""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from analysis.studies.paper.bed_study import (
    BEDS,
    FREQUENCY,
    SETTINGS,
    Setting,
    compliance_at_peak,
    describe_clearance,
    scene_of_bed,
)
from analysis.studies.paper.store import Arrays
from analysis.studies.paper.stored_table import Row, Table, complete
from rig.core.base.arrays import Array
from rig.core.scene.scene import Scene
from rig.core.simulation.simulate import Run, simulate
from rig.core.system.assembly import assemble
from rig.extras.bed_response.steady_bed import as_one_mass

#: Restitutions of the contacts.
RESTITUTIONS = (0.0, 0.05, 0.1, 0.2, 0.35, 0.5)
#: Nominal contact durations [s].
DURATIONS = (1e-3, 2e-3, 3e-3, 4e-3, 5e-3, 7e-3)
#: Fractions of the mass of the bed that move as a single mass.
SHARES = tuple(np.round(np.arange(0.5, 1.001, 0.05), 2).tolist())
#: Number of periods before averaging, in which the transient decays.
_SETTLING_PERIODS = 40
#: Number of periods over which results are averaged.
_AVERAGED_PERIODS = 40
#: Number of samples in a period.
_SAMPLES_PER_PERIOD = 128
TABLE = Table(
    ("level", "clearance_m", "restitution", "duration_s", "energy", "ceiling_impulse"),
    "the single-mass model with contacts of finite duration",
    "contacts.csv",
)


class ContactPoint(NamedTuple):
    """Motion and contact at which the beds are compared with a single mass."""

    level: float  # acceleration of the body [g]
    clearance: float  # m
    restitution: float
    duration: float  # s


class FittedContact(NamedTuple):
    """Contact of a single mass that dissipates as beds of grains do."""

    restitution: float
    duration: float  # s
    share: float  # share of the bed's mass that moves; the remaining mass is fixed to the body


def contacts() -> list[ContactPoint]:
    """Return all points, ordered by contact."""
    return [
        ContactPoint(level, clearance, restitution, duration)
        for restitution in RESTITUTIONS
        for duration in DURATIONS
        for level, clearances in SETTINGS.items()
        for clearance in clearances
    ]


def follow(path: Path, print_line: Callable[[str], None], cluster: str | None = None) -> None:
    """Simulate the single mass with every contact at every setting; see `stored_table.complete`."""
    complete(path, TABLE.study(simulate_contact, _contact_of), contacts(), _describe_row, print_line, cluster)


def simulate_contact(contact: ContactPoint) -> Row:
    """Simulate the single mass with a contact; return a row of the table.

    The energy that is dissipated in a period is relative to the weight of the bed times 1 mm. The ceiling impulse is
    relative to the weight of the bed times a period.
    """
    scene = scene_on_contact(contact)
    mass = scene.dampers[0].mass
    assert mass is not None
    weight = mass * scene.gravity
    settling_run, complete_run = (
        simulate(scene, periods / FREQUENCY, _SAMPLES_PER_PERIOD * FREQUENCY, frequency=FREQUENCY)
        for periods in (_SETTLING_PERIODS, _SETTLING_PERIODS + _AVERAGED_PERIODS)
    )
    energy = (complete_run.energy.contacts - settling_run.energy.contacts) / _AVERAGED_PERIODS
    values = (energy / (weight * 1e-3), _ceiling_force(scene, complete_run) / weight)
    cells = [*(repr(float(value)) for value in contact), *(f"{value:.5g}" for value in values)]
    return dict(zip(TABLE.header, cells, strict=True))


def scene_on_contact(contact: ContactPoint) -> Scene:
    """Build the scene of a point."""
    scene = as_one_mass(scene_of_bed(Setting(contact.level, contact.clearance, min(BEDS), 1)))
    walls = {"duration": contact.duration}
    dampers = [damper.replace(contact=walls, restitution=contact.restitution) for damper in scene.dampers]
    return scene.replace(dampers=dampers)


def _ceiling_force(scene: Scene, run: Run) -> float:
    """Compute the mean force of the ceiling on the mass over the averaged periods [N]."""
    clearance = scene.dampers[0].clearance
    if math.isinf(clearance):
        return 0.0
    system = assemble(scene)
    stiffness, damping = system.wall_stiffness[0, 1], system.wall_damping[0, 1]
    force = stiffness * (run.gap[0] - clearance) + damping * np.gradient(run.gap[0], run.time)
    return float(
        np.where(run.contact[0] == 2, np.maximum(force, 0.0), 0.0)[-_AVERAGED_PERIODS * _SAMPLES_PER_PERIOD :].mean()
    )


def table(path: Path | None = None) -> Arrays:
    """Read a table of contacts: an array for each column, shape (points,)."""
    rows = TABLE.read(path)
    return {name: np.array([float(row[name]) for row in rows]) for name in TABLE.header}


def fit_contact(beds: Mapping[str, np.ndarray], contacts: Mapping[str, np.ndarray]) -> FittedContact:
    """Fit a contact to beds; minimize the mean magnitude of the logarithmic ratio of the compliances.

    `beds`: as returned by `analysis.studies.paper.bed_study.table`, or a selection of its settings; `contacts`: as
    returned by `table`.
    """
    candidates = [
        FittedContact(restitution, duration, share)
        for restitution in np.unique(contacts["restitution"]).tolist()
        for duration in np.unique(contacts["duration_s"]).tolist()
        for share in SHARES
    ]
    errors = [float(np.abs(np.log1p(deviation_on_contact(contact, beds, contacts))).mean()) for contact in candidates]
    return candidates[int(np.argmin(errors))]


def deviation_on_contact(
    contact: FittedContact, beds: Mapping[str, np.ndarray], contacts: Mapping[str, np.ndarray]
) -> Array:
    """Compute the deviation of the compliance with grains from the single mass with a contact, shape (settings,)."""
    return np.asarray(beds["grains_compliance"] / compliance_on_contact(contact, beds, contacts) - 1.0)


def compliance_on_contact(
    contact: FittedContact, beds: Mapping[str, np.ndarray], contacts: Mapping[str, np.ndarray]
) -> Array:
    """Compute the peak compliance of the body with the single mass with a contact, shape (settings,)."""
    energy = contact.share * _column_at_settings("energy", contact, beds, contacts)
    return compliance_at_peak(beds["level"], energy)


def ceiling_impulse_on_contact(
    contact: FittedContact, beds: Mapping[str, np.ndarray], contacts: Mapping[str, np.ndarray]
) -> Array:
    """Compute the ceiling impulse per period, relative to the bed's weight times a period, shape (settings,)."""
    return contact.share * _column_at_settings("ceiling_impulse", contact, beds, contacts)


def cross_validated_deviation(beds: Mapping[str, np.ndarray], contacts: Mapping[str, np.ndarray]) -> Array:
    """Compute `deviation_on_contact` with the contact fitted to the other accelerations, shape (settings,)."""
    deviations = np.empty(len(beds["level"]))
    for level in np.unique(beds["level"]):
        at_level = beds["level"] == level
        fitted = fit_contact(select(beds, ~at_level), contacts)
        deviations[at_level] = deviation_on_contact(fitted, select(beds, at_level), contacts)
    return deviations


def at_shaking_frequency(beds: Mapping[str, np.ndarray]) -> Arrays:
    """Select the settings at which contacts were simulated: the settings at 50 Hz."""
    return select(beds, beds["frequency"] == FREQUENCY)


def with_ceiling(beds: Mapping[str, np.ndarray]) -> Arrays:
    """Select the settings with a ceiling."""
    return select(beds, np.isfinite(beds["clearance"]))


def select(beds: Mapping[str, np.ndarray], selected: NDArray[np.bool_]) -> Arrays:
    """Return a selection of the settings of a table."""
    return {name: values[selected] for name, values in beds.items()}


def _column_at_settings(
    name: str, contact: FittedContact, beds: Mapping[str, np.ndarray], contacts: Mapping[str, np.ndarray]
) -> Array:
    """Return a column of a contact, from the table of `contacts`, at the settings of `beds`."""
    of_contact = (contacts["restitution"] == contact.restitution) & (contacts["duration_s"] == contact.duration)
    by_setting = {
        (level, clearance): value
        for level, clearance, value in zip(
            *(contacts[key][of_contact].tolist() for key in ("level", "clearance_m", name)), strict=True
        )
    }
    settings = zip(beds["level"].tolist(), beds["clearance"].tolist(), strict=True)
    return np.array([by_setting[setting] for setting in settings])


def _contact_of(row: Row) -> ContactPoint:
    return ContactPoint(*(float(row[name]) for name in TABLE.header[:4]))


def _describe_row(row: Row) -> str:
    level, clearance, restitution, duration = _contact_of(row)
    return (
        f"{level:g} g, {describe_clearance(clearance)}, restitution {restitution:g}, contact of {1e3 * duration:g} ms: "
        f"energy dissipated in a period, relative to the bed's weight times 1 mm: {row['energy']}"
    )
