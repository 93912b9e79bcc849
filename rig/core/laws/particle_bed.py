"""The bed of a particle damper with instantaneous contact: one mass between floor and ceiling of a cavity.

The bed flies, or rests on a wall until the contact force falls to zero. At an impact the velocities jump; the bed
rebounds, or stays on the wall if the restitution or the rebound is zero.
"""

from math import inf

from rig.core.laws.events import CEILING, CEILING_IMPACT, FLOOR, FLOOR_IMPACT, SEPARATION
from rig.core.laws.law import GAP, HOLD, Law, Regime, Signal, Transition, Wall


def particle_bed(restitution: float, clearance: float, floor_gap: float = 0.0) -> Law:
    """Declare the law of a bed; `clearance`, `floor_gap`: gaps at ceiling and floor, m, infinite without this wall."""
    rebound = ("flight",) if restitution > 0.0 else ()
    floor = Transition((*rebound, "floor"), FLOOR_IMPACT, restitution) if floor_gap > -inf else None
    ceiling = Transition((*rebound, "ceiling"), CEILING_IMPACT, restitution) if clearance < inf else None
    separation = Transition(("flight",), SEPARATION)
    return Law(
        {
            "flight": Regime((Signal(GAP, floor_gap, clearance, floor, ceiling),)),
            "floor": Regime((Signal(HOLD, low=0.0, at_low=separation),), None, FLOOR, floor_gap),
            "ceiling": Regime((Signal(HOLD, high=0.0, at_high=separation),), None, CEILING, clearance),
        },
        "floor",
        (Wall(floor_gap), Wall(clearance)),
    )
