"""A mass on a spring and a dashpot in a body: a tuned mass damper or, between walls, an impact damper.

Spring and dashpot always act, and are therefore part of the linear structure. The law describes only the walls, as for
a particle damper. The gap is the displacement of the mass from its position at rest, in which its spring carries its
weight.

References
----------
Den Hartog, J. P., "Mechanical Vibrations", 4th ed., McGraw-Hill 1956, section 3.3.
"""

from collections.abc import Callable
from math import inf

from rig.core.laws.law import Law, Regime


def spring_mass(declare_walls: Callable[[float, float], Law], below: float | None, clearance: float) -> Law:
    """Declare the law of a mass that starts at rest on its spring.

    `declare_walls`: returns the law of walls at an upper and a lower gap, m, whose first regime is without contact.
    `clearance`, `below`: distances of the mass at rest from ceiling and floor, m, infinite without this
    wall. If `below` is None, both distances are equal.
    """
    below = clearance if below is None else below
    if min(below, clearance) == inf:
        return Law({"on the spring": Regime(())}, "on the spring")
    law = declare_walls(clearance, -below)
    return law._replace(start=next(iter(law.regimes)))
