"""Restitution and contact of new dampers, taken from the dampers of the scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rig.errors import SceneError
from rig.results import format_number
from rig.scene.damper import Contact, Damper, Landing, SpringDamper, walls_of


@dataclass(frozen=True)
class Landings:
    """Restitution and contact of all new dampers.

    `contact`: floor and ceiling with finite-duration contact; None: instantaneous impact.
    """

    restitution: float = 0.0  # as of a `Damper`
    contact: Contact | None = None
    taken: str = "the scene has none to go by"  # origin of these values, for messages

    def __str__(self) -> str:
        """Describe the landings.

        >>> print(Landings(0.2, taken="as the scene's"))
        new dampers land at once, restitution 0.2: as the scene's
        """
        return f"new dampers land {_lasting(self.contact)}, restitution {format_number(self.restitution)}: {self.taken}"


#: Default for scenes without dampers: perfectly plastic and instantaneous.
INSTANT = Landings()


def landings_from(dampers: Sequence[Damper]) -> Landings:
    """Return the landings of the dampers of a scene; if these differ, those of the first damper.

    Raises `SceneError` if the contact is given by stiffness and damping, which depend on the mass of the bed.
    """
    if not dampers:
        return INSTANT
    first = dampers[0]
    contact = first.contact
    if any(isinstance(wall, SpringDamper) for wall in walls_of(contact)):
        raise SceneError(
            "dampers[1].contact: stiffness and damping belong to the mass of this bed and are not "
            "known for another mass. Give contact: {duration: ...} and restitution, such as --set "
            "'dampers[1].contact={duration: 4 ms}'"
        )
    alike = all(
        (each.restitution, each.contact, each.grains) == (first.restitution, contact, first.grains)
        for each in dampers
    )
    taken = "as the scene's" if alike else "as the scene's first; others of it differ"
    if first.grains is not None:
        taken = "as one mass each, not as the grains of the scene's"
    return Landings(first.restitution, contact, taken)


def _lasting(contact: Contact | None) -> str:
    durations = [
        f"{format_number(1e3 * wall.duration)} ms" for wall in walls_of(contact) if isinstance(wall, Landing)
    ]
    if len(durations) == 2:
        return f"in {durations[0]} on floors and {durations[1]} on ceilings"
    return f"in {durations[0]}" if durations else "at once"
