"""One mass on floor and ceiling that give way: which contact stands best for a bed of grains, and how well.

At the settings of `analysis.paper.bed_study` at 50 Hz one mass is followed on contacts of several restitutions and
durations. Of a bed of which a share moves and the rest is held, the moving share takes its share of the energy. The
contact that stands for the bed is the one, of these and for all settings below a ceiling alike, with which the body's
compliance is nearest to that with grains; without a ceiling a landing at once is nearer. It is judged where it was not
fitted, too: each acceleration in turn by a fit to the others.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from analysis.paper.bed_study import BEDS, FREQUENCY, SETTINGS, Setting, compliance_at_peak, scene_of_bed
from analysis.paper.kept_study import Row, Table, complete
from analysis.paper.store import Arrays
from rig.bed_response.steady_bed import as_one_mass
from rig.scene.scene import Scene
from rig.simulation.simulate import Run, simulate
from rig.system.assembly import assemble

Values = NDArray[np.float64]

#: Of the contacts that are tried: ratio of separation to approach speed, and duration of a landing, s.
RESTITUTIONS = (0.0, 0.05, 0.1, 0.2, 0.35, 0.5)
DURATIONS = (1e-3, 2e-3, 3e-3, 4e-3, 5e-3, 7e-3)
#: Shares of the bed that move.
SHARES = tuple(np.round(np.arange(0.5, 1.001, 0.05), 2).tolist())
#: Periods in which the mass is let settle, and those looked at then; samples in a period.
_SETTLING, _WATCHED, _MARKS = 40, 40, 128
TABLE = Table(
    ("level", "clearance_m", "restitution", "duration_s", "energy", "ceiling_impulse"),
    "one mass on contacts that last",
    "contacts.csv",
)


class Contact(NamedTuple):
    """A point of the study: acceleration in g, clearance in m, restitution, duration in s."""

    level: float
    clearance: float
    restitution: float
    duration: float


class StandIn(NamedTuple):
    """A contact that stands for a bed: restitution, duration in s, share of the bed's mass that moves."""

    restitution: float
    duration: float
    share: float


def contacts() -> list[Contact]:
    """List all points, contact by contact."""
    return [
        Contact(level, clearance, restitution, duration)
        for restitution in RESTITUTIONS
        for duration in DURATIONS
        for level, clearances in SETTINGS.items()
        for clearance in clearances
    ]


def follow(path: Path, say: Callable[[str], None], cluster: str | None = None) -> None:
    """Follow one mass on every contact at every setting; see `analysis.paper.kept_study.complete`."""
    complete(path, TABLE.study(followed, _contact_of), contacts(), _words, say, cluster)


def followed(contact: Contact) -> Row:
    """Follow one mass on a contact; gives a row of the table.

    Energy taken in a period by the bed's weight over a millimetre, impulse of the ceiling by its weight over a period.
    """
    scene = scene_on_contact(contact)
    mass = scene.dampers[0].mass
    assert mass is not None
    weight = mass * scene.gravity
    settled, whole = (
        simulate(scene, periods / FREQUENCY, _MARKS * FREQUENCY, frequency=FREQUENCY)
        for periods in (_SETTLING, _SETTLING + _WATCHED)
    )
    energy = (whole.energy.contacts - settled.energy.contacts) / _WATCHED
    values = (energy / (weight * 1e-3), _ceiling_force(scene, whole) / weight)
    cells = [*(repr(float(value)) for value in contact), *(f"{value:.5g}" for value in values)]
    return dict(zip(TABLE.header, cells, strict=True))


def scene_on_contact(contact: Contact) -> Scene:
    """Make the scene of a point."""
    scene = as_one_mass(scene_of_bed(Setting(contact.level, contact.clearance, min(BEDS), 1)))
    wall = {"duration": contact.duration}
    dampers = [one.replace(contact=wall, restitution=contact.restitution) for one in scene.dampers]
    return scene.replace(dampers=dampers)


def _ceiling_force(scene: Scene, run: Run) -> float:
    """Mean force of the ceiling on the mass over the periods that are watched, N."""
    clearance = scene.dampers[0].clearance
    if math.isinf(clearance):
        return 0.0
    system = assemble(scene)
    stiffness, damping = system.wall_stiffness[0, 1], system.wall_damping[0, 1]
    push = stiffness * (run.gap[0] - clearance) + damping * np.gradient(run.gap[0], run.time)
    return float(np.where(run.contact[0] == 2, np.maximum(push, 0.0), 0.0)[-_WATCHED * _MARKS :].mean())


def table(path: Path | None = None) -> Arrays:
    """Read a table of contacts: an array for each column, shape (points,)."""
    read = TABLE.read(path)
    return {name: np.array([float(row[name]) for row in read]) for name in TABLE.header}


def stand_in(beds: Mapping[str, np.ndarray], contacts: Mapping[str, np.ndarray]) -> StandIn:
    """Give the contact that stands best for beds: least mean ratio of compliances, as logarithms.

    Parameters
    ----------
    beds : mapping
        As `analysis.paper.bed_study.table` gives it, or some of its settings.
    contacts : mapping
        As `table` gives it.
    """
    tried = [
        StandIn(restitution, duration, share)
        for restitution in np.unique(contacts["restitution"]).tolist()
        for duration in np.unique(contacts["duration_s"]).tolist()
        for share in SHARES
    ]
    misses = [float(np.abs(np.log1p(apart_on(one, beds, contacts))).mean()) for one in tried]
    return tried[int(np.argmin(misses))]


def apart_on(one: StandIn, beds: Mapping[str, np.ndarray], contacts: Mapping[str, np.ndarray]) -> Values:
    """Say by what share of the compliance on a contact that with grains is above it, shape (settings,)."""
    return np.asarray(beds["grains_compliance"] / on_contact(one, beds, contacts) - 1.0)


def on_contact(one: StandIn, beds: Mapping[str, np.ndarray], contacts: Mapping[str, np.ndarray]) -> Values:
    """Give the compliance of the body at its peak with one mass on a contact, shape (settings,)."""
    energy = one.share * _of_setting("energy", one, beds, contacts)
    return compliance_at_peak(beds["level"], energy)


def ceiling_on(one: StandIn, beds: Mapping[str, np.ndarray], contacts: Mapping[str, np.ndarray]) -> Values:
    """Impulse of the ceiling in a period by the bed's weight over a period, shape (settings,)."""
    return one.share * _of_setting("ceiling_impulse", one, beds, contacts)


def apart_unseen(beds: Mapping[str, np.ndarray], contacts: Mapping[str, np.ndarray]) -> Values:
    """Give `apart_on` where each acceleration is judged by the contact fitted to all others."""
    found = np.empty(len(beds["level"]))
    for level in np.unique(beds["level"]):
        own = beds["level"] == level
        fitted = stand_in(some(beds, ~own), contacts)
        found[own] = apart_on(fitted, some(beds, own), contacts)
    return found


def where_followed(beds: Mapping[str, np.ndarray]) -> Arrays:
    """Give the settings at which contacts were followed: those at 50 Hz."""
    return some(beds, beds["frequency"] == FREQUENCY)


def below_ceiling(beds: Mapping[str, np.ndarray]) -> Arrays:
    """Give the settings that have a ceiling."""
    return some(beds, np.isfinite(beds["clearance"]))


def some(beds: Mapping[str, np.ndarray], chosen: NDArray[np.bool_]) -> Arrays:
    """Give some of the settings."""
    return {name: values[chosen] for name, values in beds.items()}


def _of_setting(
    name: str, one: StandIn, beds: Mapping[str, np.ndarray], contacts: Mapping[str, np.ndarray]
) -> Values:
    same = (contacts["restitution"] == one.restitution) & (contacts["duration_s"] == one.duration)
    found = {
        (level, clearance): value
        for level, clearance, value in zip(
            *(contacts[key][same].tolist() for key in ("level", "clearance_m", name)), strict=True
        )
    }
    settings = zip(beds["level"].tolist(), beds["clearance"].tolist(), strict=True)
    return np.array([found[setting] for setting in settings])


def _contact_of(row: Row) -> Contact:
    return Contact(*(float(row[name]) for name in TABLE.header[:4]))


def _words(row: Row) -> str:
    level, clearance, restitution, duration = _contact_of(row)
    return (
        f"{level:g} g, clearance {1e3 * clearance:g} mm, restitution {restitution:g}, {1e3 * duration:g} ms: "
        f"{row['energy']} of the weight over a millimetre taken in a period"
    )
