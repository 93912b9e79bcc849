"""A mass on a spring and a dashpot in a body, without walls: a tuned mass damper.

References
----------
Den Hartog, J. P., "Mechanical Vibrations", 4th ed., McGraw-Hill 1956, section 3.3.
"""

from __future__ import annotations

from rig.core.laws.law import Law, Mode, Row


def spring_mass(stiffness: float, damping: float, weight: float, clearance: float) -> Law:
    """Declare the law of a mass; the gap is its displacement from the position in which its spring carries its weight.

    `stiffness`: N/m; `damping`: N s/m; `weight`: N; `clearance`: without effect, because there are no walls.
    """
    force = Row(gap=-stiffness, speed=-damping, rest=weight / stiffness)
    return Law({"on the spring": Mode((), force)}, "on the spring", account="dissipated")
