"""The true motion in a recording: its topics, and its samples on their way to the file."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from daq.mcap_file.writer import Message
from daq.recording.layout import EVENTS, SHOWN_GROUPS, TRUTH, Timebase
from daq.recording.markers import EVENT_SCHEMA, event_to_json
from daq.recording.protobuf import Schema
from daq.recording.sample_block import SCHEMAS, block_schema
from daq.recording.sample_groups import Group, Grouping
from daq.signal_chain.channel import UNITS
from rig.arrays import Array

if TYPE_CHECKING:
    from rig.scene.scene import Scene
    from rig.simulation.motion import Motion

Register = Callable[[str, Schema, Mapping[str, str]], int]

MOTION = ("displacement", "velocity", "acceleration")


def points_of(scene: Scene) -> tuple[str, ...]:
    """Return the moving points of a scene's rig: its bodies, and the tables of its shakers."""
    bodies = tuple(f"body {body}" for body in range(1, scene.structure.bodies + 1))
    return (*bodies, *(name for name, _ in scene.tables))


def dampers_of(scene: Scene) -> tuple[str, ...]:
    """Return the names under which a scene's dampers are recorded."""
    return tuple(f"damper {number}" for number in range(1, len(scene.dampers) + 1))


class Truth:
    """Collects the true motion: of each point its motion, of each damper its gap and contact, and the events.

    `streams` are the real numbers (motion of the points, then gaps) and the contacts, `chunks` the (stream, row,
    channel number) of each series of a chunk; `drawn` names the parts of `positions`.
    """

    def __init__(self, scene: Scene, clock: Timebase, group: int, register: Register) -> None:
        self._clock, self._length = clock, group
        self.points = points_of(scene)
        points, dampers = len(self.points), len(scene.dampers)
        self.drawn = (*self.points, *dampers_of(scene))
        self.streams = (
            Grouping(len(MOTION) * points + dampers, group, np.dtype("<f8")),
            Grouping(dampers, group, np.dtype("<i4")),
        )
        self._events: deque[tuple[float, int, str, float]] = deque()
        self._n_sent = 0
        self._recent: dict[int, Group] = {}
        self._rows = np.r_[:points, len(MOTION) * points : len(MOTION) * points + dampers]
        self._last = np.zeros(len(self.drawn))
        real_schema, integer_schema = block_schema(SCHEMAS["float64"][0]), block_schema(SCHEMAS["counts"][0])
        self.chunks: list[list[tuple[int, int, int]]] = []

        def topic(point: str, quantity: str, unit: str, schema: Schema = real_schema, **more: str) -> int:
            fields = {"point": point, "quantity": quantity, "unit": unit, **more}
            return register(f"{TRUTH}{point.replace(' ', '_')}/{quantity}", schema, fields)

        for row, point in enumerate(self.points):
            motion = [topic(point, quantity, UNITS[quantity]) for quantity in MOTION]
            self.chunks.append([(0, kind * points + row, number) for kind, number in enumerate(motion)])
        for damper, point in enumerate(dampers_of(scene)):
            gap, states = topic(point, "gap", "m"), "0 flight, 1 floor, 2 ceiling"
            contact = topic(point, "contact", "", integer_schema, values=states)
            self.chunks.append([(0, len(MOTION) * points + damper, gap), (1, damper, contact)])
        self._topic = register(EVENTS, EVENT_SCHEMA, {}) if dampers else 0

    @property
    def position(self) -> int:
        """Number of the next sample."""
        return self.streams[0].position

    def add(self, motion: Motion) -> None:
        """Take the next samples."""
        if motion.first != self.position:
            raise ValueError(f"motion: got sample {motion.first} first; expected {self.position}.")
        parts = (motion.displacement, motion.velocity, motion.acceleration, motion.gap)
        self.streams[0].add(np.concatenate(parts))
        self.streams[1].add(motion.contact)
        self._events += motion.events[["time", "damper", "kind", "speed"]].tolist()

    def take(self, number: int) -> tuple[Group | None, Group | None]:
        """Remove and return the groups of a cell of the grid; `positions` still uses them."""
        real, positions = (stream.complete.pop(number, None) for stream in self.streams)
        if real is not None:
            self._recent = {n: each for n, each in self._recent.items() if n >= number - SHOWN_GROUPS}
            self._recent[number] = real
        return real, positions

    def events_before(self, stop: float) -> list[Message]:
        """Remove and return the events before a sample.

        The last of them is at least one sample earlier, so that rounded times do not change the order of writing.
        """
        due = []
        while self._events:
            time, damper, kind, speed = self._events[0]
            if math.ceil(time * self._clock.rate) + 1 >= stop:
                break
            self._events.popleft()
            at = self._clock.start_ns + round(time * 1e9)
            due.append(Message(self._topic, at, at, event_to_json(time, damper, kind, speed), self._n_sent))
            self._n_sent += 1
        return due

    def positions(self, samples: NDArray[np.int64]) -> Array:
        """Return the positions of the parts in `drawn`, (parts, samples), metres, at the next samples.

        At samples outside the last groups, the previous position is repeated.
        """
        positions = np.empty((len(self.drawn), 1 + samples.size))
        positions[:, 0] = self._last
        latest_known = np.zeros(1 + samples.size, dtype=np.int64)
        for group in self._recent.values():
            for start, stop in group.spans:
                (inside,) = np.nonzero((start <= samples) & (samples < stop))
                latest_known[1 + inside] = 1 + inside
                positions[:, 1 + inside] = group.samples[self._rows[:, None], samples[inside] - group.first]
        positions = positions[:, np.maximum.accumulate(latest_known)]
        self._last = positions[:, -1]
        return positions[:, 1:]
