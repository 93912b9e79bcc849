"""A mass on a spring and a dashpot in a body: a tuned mass damper or, between walls, an impact damper.

Spring and dashpot always act, and are therefore part of the linear structure. The law contains the walls, which are
those of a particle damper. The gap is the displacement of the mass from its position at rest, in which its spring
carries its weight.

References
----------
Den Hartog, J. P., "Mechanical Vibrations", 4th ed., McGraw-Hill 1956, section 3.3.
"""

from __future__ import annotations

from collections.abc import Callable
from math import inf

from rig.core.laws.law import Law, Mode


def spring_mass(declare_walls: Callable[[float, float], Law], below: float | None, clearance: float) -> Law:
    """Declare the law of a mass that starts at rest on its spring.

    `declare_walls`: law of the gaps at upper and lower wall, m, whose first mode is without contact; `clearance`,
    `below`: distance of the upper and of the lower wall, m, infinite without this wall; None: both are equal.
    """
    below = clearance if below is None else below
    if min(below, clearance) == inf:
        return Law({"on the spring": Mode(())}, "on the spring")
    law = declare_walls(clearance, -below)
    return law._replace(start=next(iter(law.modes)))
