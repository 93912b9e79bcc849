"""Kinds of events of all laws, their names for users, and the codes of contact with a wall."""

import numpy as np

#: Codes of a damper's contact in results: no contact, floor, ceiling.
FLIGHT, FLOOR, CEILING = 0, 1, 2
#: Kinds of events. A contact of finite duration begins with a touch and ends with a release. Sliding with friction
#: begins with a slip and ends with a stop.
SEPARATION, FLOOR_IMPACT, CEILING_IMPACT, FLOOR_TOUCH, CEILING_TOUCH, RELEASE, SLIP, STOP = 0, 1, 2, 3, 4, 5, 6, 7
#: A change of regime that is not an event, because neither velocities nor forces jump.
NO_EVENT = -1
#: Kinds of events at which an element comes into contact with a wall.
CONTACT_EVENTS = (FLOOR_IMPACT, CEILING_IMPACT, FLOOR_TOUCH, CEILING_TOUCH)
#: Name of each kind of event.
EVENT_NAMES = np.array(["separation", "floor", "ceiling", "touch", "touch", "release", "slip", "stop"])
