"""The true motion of the rig in a recording, and the topics of this motion.

The truth is the simulated motion itself, which no sensor measures (true quantity values, VIM 2.11).
"""

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.core.mcap_file.protobuf import Schema
from daq.core.mcap_file.writer import Message
from daq.core.recording.layout import EVENTS, MAX_DISPLAY_GROUPS, TRUTH, Timebase
from daq.core.recording.markers import event_schema, event_to_json
from daq.core.recording.sample_block import SCHEMAS, block_schema
from daq.core.recording.sample_groups import Group, Grouping
from daq.core.signal_chain.channel import UNITS
from rig.core.base.arrays import Array
from rig.core.scene.scene import Scene
from rig.core.simulation.motion import Motion

# Function that adds a topic of a given name, schema and metadata to the file, and returns its channel number.
Register = Callable[[str, Schema, Mapping[str, str]], int]

# Recorded quantities of the motion of each point.
MOTION_QUANTITIES = ("displacement", "velocity", "acceleration")


def points_of(scene: Scene) -> tuple[str, ...]:
    """Return the moving points of a scene's rig: its bodies, and the tables of its shakers."""
    bodies = tuple(f"body {body}" for body in range(1, scene.structure.bodies + 1))
    return (*bodies, *(name for name, _ in scene.tables))


def dampers_of(scene: Scene) -> tuple[str, ...]:
    """Return the names under which a scene's dampers are recorded."""
    return tuple(f"damper {number}" for number in range(1, len(scene.dampers) + 1))


class Truth:
    """Collects the motion of each point, the gap and contact of each damper, and the contact events.

    `part_names` are the points and dampers, the rows of `positions`. `streams` are two series of groups: real numbers
    (motion of the points, then gaps), and contacts. `chunks` lists the topics of each chunk of the file, each as (index
    in `streams`, row, channel number).
    """

    def __init__(self, scene: Scene, clock: Timebase, group_samples: int, register: Register) -> None:
        self._clock = clock
        self.points = points_of(scene)
        points, dampers = len(self.points), len(scene.dampers)
        self.part_names = (*self.points, *dampers_of(scene))
        self.streams = (
            Grouping(len(MOTION_QUANTITIES) * points + dampers, group_samples, np.dtype("<f8")),
            Grouping(dampers, group_samples, np.dtype("<i4")),
        )
        self._events: deque[tuple[Any, ...]] = deque()
        self._n_events = 0
        # The last groups of displacements and gaps, by group number.
        self._recent_groups: dict[int, Group] = {}
        # Rows of the displacements and the gaps in the stream of real numbers.
        self._position_rows = np.r_[
            :points, len(MOTION_QUANTITIES) * points : len(MOTION_QUANTITIES) * points + dampers
        ]
        self._last_positions = np.zeros(len(self.part_names))
        real_schema, integer_schema = block_schema(SCHEMAS["float64"][0]), block_schema(SCHEMAS["counts"][0])
        self.chunks: list[list[tuple[int, int, int]]] = []

        def topic(point: str, quantity: str, unit: str, schema: Schema = real_schema, **metadata: str) -> int:
            fields = {"point": point, "quantity": quantity, "unit": unit, **metadata}
            return register(f"{TRUTH}{point.replace(' ', '_')}/{quantity}", schema, fields)

        for row, point in enumerate(self.points):
            motion = [topic(point, quantity, UNITS[quantity]) for quantity in MOTION_QUANTITIES]
            self.chunks.append([(0, index * points + row, number) for index, number in enumerate(motion)])
        for damper, point in enumerate(dampers_of(scene)):
            gap, contact_values = topic(point, "gap", "m"), "0 flight, 1 floor, 2 ceiling"
            contact = topic(point, "contact", "", integer_schema, values=contact_values)
            self.chunks.append([(0, len(MOTION_QUANTITIES) * points + damper, gap), (1, damper, contact)])
        has_friction = any(damper.friction is not None for damper in scene.dampers)
        has_friction |= any(joint.slip_force is not None for joint in scene.joints)
        self._event_fields = ["time", "damper", "kind", "speed", *(["joint"] if scene.joints else [])]
        schema = event_schema(has_friction, bool(scene.joints))
        self._topic = register(EVENTS, schema, {}) if dampers or scene.joints else 0

    @property
    def position(self) -> int:
        """Index of the next sample."""
        return self.streams[0].position

    def add(self, motion: Motion) -> None:
        """Add the motion at the next samples."""
        if motion.first != self.position:
            raise ValueError(f"motion: got sample {motion.first} first; expected {self.position}.")
        parts = (motion.displacement, motion.velocity, motion.acceleration, motion.gap)
        self.streams[0].add(np.concatenate(parts))
        self.streams[1].add(motion.contact)
        self._events += motion.events[self._event_fields].tolist()

    def take(self, number: int) -> tuple[Group | None, Group | None]:
        """Return and remove the groups of motion and of contacts with a number; None if they have no samples.

        The displacements and gaps of the last groups remain available to `positions`.
        """
        motion, contacts = (stream.complete.pop(number, None) for stream in self.streams)
        if motion is not None:
            oldest = number - MAX_DISPLAY_GROUPS
            self._recent_groups = {n: group for n, group in self._recent_groups.items() if n >= oldest}
            self._recent_groups[number] = replace(motion, samples=motion.samples[self._position_rows])
        return motion, contacts

    def events_before(self, stop: float) -> list[Message]:
        """Return and remove the messages of the events before sample index `stop`.

        Events within a sample of `stop` remain, so rounded times do not change the order of writing.
        """
        messages = []
        while self._events:
            time = self._events[0][0]
            if math.ceil(time * self._clock.rate) + 1 >= stop:
                break
            content = event_to_json(*self._events.popleft())
            time_ns = self._clock.start_ns + round(time * 1e9)
            messages.append(Message(self._topic, time_ns, time_ns, content, self._n_events))
            self._n_events += 1
        return messages

    def positions(self, samples: NDArray[np.int64]) -> Array:
        """Return displacements of points and gaps [m] of dampers at the next samples, (points + dampers, samples).

        Samples outside the last groups repeat the previous value.
        """
        positions = np.empty((len(self.part_names), 1 + samples.size))
        positions[:, 0] = self._last_positions
        latest_known = np.zeros(1 + samples.size, dtype=np.int64)
        for group in self._recent_groups.values():
            for start, stop in group.spans:
                (inside,) = np.nonzero((start <= samples) & (samples < stop))
                latest_known[1 + inside] = 1 + inside
                positions[:, 1 + inside] = group.samples[:, samples[inside] - group.first]
        positions = positions[:, np.maximum.accumulate(latest_known)]
        self._last_positions = positions[:, -1]
        return positions[:, 1:]
