"""Kinds of events of an orbit, and wall states: the contact of a damper with a wall between two events."""

# Kinds of events: separation from a wall, impact on a wall after which the damper rests (FLOOR, CEILING), and bounces.
# In a bounce, a damper separates at the instant of impact, with the common velocity (osculating contact) or with its
# rebound velocity. `INDUCED_SEPARATION` is a separation that the previous event causes at the same instant.
SEPARATION, FLOOR, CEILING, FLOOR_BOUNCE, CEILING_BOUNCE, INDUCED_SEPARATION = 0, 1, 2, 3, 4, 5
# Finite-duration contact: a gap falls to zero (touch), a contact force falls to zero (release), or the force rises from
# zero again before the overlap has ended (press). All conditions are linear in the state. Such an event changes only
# the force, without a jump of velocities.
TOUCH_FLOOR, TOUCH_CEILING, PRESS_FLOOR, PRESS_CEILING, RELEASE = 6, 7, 8, 9, 10
# A mass that slides with friction: the force that holds it reaches its lower or its upper limit (slip), its speed falls
# to zero, after which it sticks (stop) or moves back immediately (reverse). It also hits walls.
SLIP_LOW, SLIP_HIGH, STOP, REVERSE = 11, 12, 13, 14
# Wall state in a segment between events: in flight, or at rest on a wall. If the gap is a coordinate: without
# contact force instead of in flight, and pressed on a wall in finite-duration contact. The remainder of a division of
# the wall state by 3 is the wall. The state of a mass that slides with friction is `REGIMES` plus the number of its
# regime.
FLYING, RIDES_FLOOR, RIDES_CEILING, WITHOUT_FORCE, ON_FLOOR, ON_CEILING, REGIMES = 0, 1, 2, 3, 4, 5, 6
