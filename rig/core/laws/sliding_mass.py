"""A mass that slides between two walls with Coulomb friction: a horizontal particle damper or impact damper.

The gap is the displacement of the mass from the middle between its walls. While the mass *sticks*, it is held by a
friction force below the slip force; it slips when the force that holds it reaches this limit. A sliding mass
experiences the slip force against its motion, until its speed is zero. At rest on a wall, friction only resists motion
away from the wall.

References
----------
Den Hartog, J. P., "Forced vibrations with combined Coulomb and viscous friction", Transactions of the ASME 53 (1931)
107-115.
"""

from math import inf

from rig.core.laws.events import CEILING, CEILING_IMPACT, FLOOR, FLOOR_IMPACT, SLIP, STOP
from rig.core.laws.law import GAP, HOLD, SPEED, Law, Regime, Row, Signal, Transition, Wall
from rig.core.laws.particle_bed import particle_bed


def sliding_mass(slip_force: float, restitution: float, clearance: float) -> Law:
    """Declare the law of a mass that starts in the middle between its walls.

    `slip_force`: largest friction force, N, 0 without friction; `clearance`: free distance between the walls, m,
    infinite without walls.
    """
    half, has_walls = 0.5 * clearance, clearance < inf
    if slip_force == 0.0 and has_walls:
        return particle_bed(restitution, half, -half)._replace(start="flight")
    if slip_force == 0.0:
        return Law({"flight": Regime(())}, "flight")
    slip_up, slip_down, stop = (
        Transition(("slips up",), SLIP),
        Transition(("slips down",), SLIP),
        Transition(("sticks",), STOP),
    )
    rebounds = restitution > 0.0
    floor = Transition(("slips up", "floor") if rebounds else ("floor",), FLOOR_IMPACT, restitution)
    ceiling = Transition(("slips down", "ceiling") if rebounds else ("ceiling",), CEILING_IMPACT, restitution)
    # Only the wall towards which the mass moves, because the mass stops before it can reach the other wall.
    wall_above = (Signal(GAP, high=half, at_high=ceiling),) if has_walls else ()
    wall_below = (Signal(GAP, low=-half, at_low=floor),) if has_walls else ()
    regimes = {
        "sticks": Regime((Signal(HOLD, -slip_force, slip_force, slip_up, slip_down),), None),
        "slips up": Regime((*wall_above, Signal(SPEED, low=0.0, at_low=stop)), Row(constant=-slip_force)),
        "slips down": Regime((*wall_below, Signal(SPEED, high=0.0, at_high=stop)), Row(constant=slip_force)),
    }
    walls = {
        "floor": Regime((Signal(HOLD, low=-slip_force, at_low=slip_up),), None, FLOOR, -half),
        "ceiling": Regime((Signal(HOLD, high=slip_force, at_high=slip_down),), None, CEILING, half),
    }
    return Law(regimes | walls if has_walls else regimes, "sticks", (Wall(-half), Wall(half)) if has_walls else ())
