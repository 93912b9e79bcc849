"""A joint with friction between two bodies, or a body and the ground: a spring in series with a Coulomb slider.

The gap g of the law is the relative displacement of the bodies, and u is the *slider displacement*.
The force is -k (g - u). While the joint sticks, u is constant; when the force reaches the slip force, the slider moves
with the bodies and the force is constant, until the relative speed of the bodies is zero. This is the Jenkins element.

References
----------
Jenkins, G. M., "Analysis of the stress-strain relationships in reactor grade graphite", British Journal of Applied
Physics 13 (1962) 30-32.
"""

from rig.core.laws.events import SLIP, STOP
from rig.core.laws.law import SPEED, Law, Regime, Row, Signal, Transition


def friction_joint(stiffness: float, slip_displacement: float) -> Law:
    """Declare the law of a joint that sticks at the start.

    `stiffness`: stiffness of the spring [N/m]; `slip_displacement`: elongation of the spring at which the slider moves,
    m.
    """
    spring, slip_force = Row(gap=-stiffness, slider=stiffness), stiffness * slip_displacement
    stop = Transition(("sticks",), STOP)
    slip_up, slip_down = Transition(("slips up",), SLIP), Transition(("slips down",), SLIP)
    return Law(
        {
            "sticks": Regime((Signal(spring, -slip_force, slip_force, slip_up, slip_down),), spring),
            "slips up": Regime((Signal(SPEED, low=0.0, at_low=stop),), Row(constant=-slip_force)),
            "slips down": Regime((Signal(SPEED, high=0.0, at_high=stop),), Row(constant=slip_force)),
        },
        "sticks",
    )
