"""Kinds of events of all laws, their names for users, and the contact with a wall that results is made of."""

from __future__ import annotations

import numpy as np

#: Contact of a damper in results: none, with its floor, or with its ceiling.
FLIGHT, FLOOR, CEILING = 0, 1, 2
#: Kinds of events. A touch starts a contact of finite duration, which a release ends. A slip starts sliding with
#: friction, which a stop ends.
SEPARATION, FLOOR_IMPACT, CEILING_IMPACT, FLOOR_TOUCH, CEILING_TOUCH, RELEASE, SLIP, STOP = 0, 1, 2, 3, 4, 5, 6, 7
#: The mode changes without an event, because neither velocities nor forces jump.
NO_EVENT = -1
#: Kinds of events at which an element comes into contact with a wall.
CONTACT_EVENTS = (FLOOR_IMPACT, CEILING_IMPACT, FLOOR_TOUCH, CEILING_TOUCH)
#: Name of each kind of event.
EVENT_NAMES = np.array(["separation", "floor", "ceiling", "touch", "touch", "release", "slip", "stop"])
