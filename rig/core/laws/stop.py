"""A stop between two bodies, or a body and the ground: a spring with a dashpot that acts while its gap is closed.

The gap of the law is the displacement of the upper body relative to the lower body. The force is that of a wall with
finite stiffness (`rig.core.laws.wall_contact`), but the stop limits the motion in one direction only. Without a dashpot
it is a bilinear spring.

References
----------
Shaw, S. W., Holmes, P. J., "A periodically forced piecewise linear oscillator", Journal of Sound and Vibration 90
(1983) 129-155.
"""

from math import inf

from rig.core.laws.law import Law
from rig.core.laws.wall_contact import wall_contact


def stop(stiffness: float, damping: float, closes_upwards: bool, gap: float) -> Law:
    """Declare the law of an open stop.

    `stiffness`, `damping`: of spring and dashpot, N/m and N s/m; `closes_upwards`: whether the relative displacement is
    positive at contact; `gap`: magnitude of the relative displacement at contact [m].
    """
    wall_above, wall_below = (gap, -inf) if closes_upwards else (inf, -gap)
    law = wall_contact((stiffness, stiffness), (damping, damping), wall_above, wall_below)
    return law._replace(start="free").reachable()
