"""Contact law of finite duration: floor and ceiling are springs with dashpots, without adhesion.

While the mass penetrates a wall at the gap g_w, the wall pushes it away with the force -k (g - g_w) - c g'. The wall
releases the mass when this force falls to zero; with a dashpot the mass then still penetrates the wall. The contact is
in a state named *recovers* until the penetration is zero. If the wall pushes the mass away again before that, the
contact resumes.
"""

from math import inf

from rig.core.laws.events import CEILING, CEILING_TOUCH, FLOOR, FLOOR_TOUCH, RELEASE
from rig.core.laws.law import GAP, Law, Regime, Row, Signal, Transition, Wall


def wall_contact(
    stiffness: tuple[float, float], damping: tuple[float, float], clearance: float, floor_gap: float = 0.0
) -> Law:
    """Declare the law for stiffness [N/m] and damping [N s/m] of floor and ceiling.

    `clearance`, `floor_gap`: gaps at the ceiling and at the floor [m]; infinite if there is no such wall.
    """
    has_ceiling, has_floor = clearance < inf, floor_gap > -inf
    floor = Row(gap=-stiffness[0], speed=-damping[0], rest=floor_gap if has_floor else 0.0)
    ceiling = Row(gap=-stiffness[1], speed=-damping[1], rest=clearance if has_ceiling else 0.0)
    touch_floor, touch_ceiling = Transition(("on floor",), FLOOR_TOUCH), Transition(("on ceiling",), CEILING_TOUCH)
    leave_floor = Transition(("recovers from floor", "free"), RELEASE)
    leave_ceiling = Transition(("recovers from ceiling", "free"), RELEASE)
    return Law(
        {
            "free": Regime(
                (
                    Signal(
                        GAP,
                        floor_gap,
                        clearance,
                        touch_floor if has_floor else None,
                        touch_ceiling if has_ceiling else None,
                    ),
                )
            ),
            "on floor": Regime((Signal(floor, low=0.0, at_low=leave_floor),), floor, FLOOR),
            "on ceiling": Regime((Signal(ceiling, high=0.0, at_high=leave_ceiling),), ceiling, CEILING),
            "recovers from floor": Regime(
                (
                    Signal(GAP, high=floor_gap if has_floor else 0.0, at_high=Transition(("free",))),
                    Signal(floor, high=0.0, at_high=touch_floor),
                )
            ),
            "recovers from ceiling": Regime(
                (
                    Signal(GAP, low=clearance if has_ceiling else 0.0, at_low=Transition(("free",))),
                    Signal(ceiling, low=0.0, at_low=touch_ceiling),
                )
            ),
        },
        "on floor",
        (Wall(floor_gap, stiffness[0], damping[0]), Wall(clearance, stiffness[1], damping[1])),
    )
