"""The moving rig for viewers that know nothing of this project: a robot description, and transforms for it.

The parts have the sizes of the drawing of `daq.drawing.rig_view`; springs have no form here. Every displacement and
gap is multiplied by one exaggeration, which is chosen before anything has moved.
"""

from __future__ import annotations

import math
import struct
from typing import TYPE_CHECKING
from xml.sax.saxutils import quoteattr

import numpy as np

from daq.drawing.palette import DRIVE, GROUND, LEAD, Colour, body_colour
from daq.drawing.rig_view import (
    COIL_LENGTH,
    DAMPER_HEIGHT,
    DEPTH,
    HEADROOM,
    PLATE,
    PLINTH,
    SOLID_HEIGHT,
    SPRING_LENGTH,
    WALL,
    WIDTH,
)
from daq.recording.protobuf import Schema, descriptors, varint, varint_sizes, varints

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from rig.scene.scene import Scene

    Box = tuple[tuple[float, float, float], tuple[float, float, float]]

WORLD = "world"
# Displacements of the rig are millimetres near a resonance; this draws one of them as two centimetres.
EXAGGERATION = 20.0

TRANSFORMS_SCHEMA = Schema(
    "foxglove.FrameTransforms",
    "protobuf",
    descriptors(
        "foxglove",
        (
            ("Vector3", (("x", "double"), ("y", "double"), ("z", "double"))),
            ("Quaternion", (("x", "double"), ("y", "double"), ("z", "double"), ("w", "double"))),
            (
                "FrameTransform",
                (
                    ("timestamp", "google.protobuf.Timestamp"),
                    ("parent_frame_id", "string"),
                    ("child_frame_id", "string"),
                    ("translation", "foxglove.Vector3"),
                    ("rotation", "foxglove.Quaternion"),
                ),
            ),
            ("FrameTransforms", (("transforms", "foxglove.FrameTransform[]"),)),
        ),
    ),
    "protobuf",
)
_HEIGHT = 8
# Translation: x and y, and what stands before z.
_ABOVE = b"\x22\x1b" + struct.pack("<BdBdB", 0x09, 0.0, 0x11, 0.0, 0x19)
_UPRIGHT = b"\x2a\x09\x21" + struct.pack("<d", 1.0)


def exaggeration(scene: Scene) -> float:
    """Give the factor on displacements and gaps: 20, or less where a cavity would not fit the drawing.

    Parameters
    ----------
    scene : Scene
        Its finite clearances are drawn at most `HEADROOM` high, by 1, 2 or 5 times a power of ten.
    """
    clearances = [damper.clearance for damper in scene.dampers if math.isfinite(damper.clearance)]
    limit = min([EXAGGERATION, *(HEADROOM / clearance for clearance in clearances if clearance > 0)])
    decade = 10.0 ** math.floor(math.log10(limit))
    return next(step * decade for step in (5.0, 2.0, 1.0) if step * decade <= limit)


class RobotDescription:
    """The rig of a scene as links that move up and down.

    Parameters
    ----------
    with_dampers : bool
        Whether the dampers' motion will be known; if not, they are not drawn.

    Attributes
    ----------
    points : tuple of str
        What moves, in the order in which `transforms` wants it: ``body 1``, ..., ``table``, ``damper 1``, ...
    exaggeration : float
        Factor on every displacement and gap.
    """

    def __init__(self, scene: Scene, with_dampers: bool) -> None:
        self.exaggeration = exaggeration(scene)
        self._links: list[str] = []
        self._joints: list[str] = []
        self._rest: list[float] = []
        self._frames: list[bytes] = []
        points: list[str] = []
        self._link(WORLD, [((0, 0, -0.01), (0.62, 0.30, 0.02))], GROUND)
        hung = {shaker.body for _, shaker in scene.tables}
        with_cavity = {damper.body: damper for damper in scene.dampers}
        bottom, below = 0.0, {}
        for body in range(1, scene.structure.bodies + 1):
            bottom += PLINTH + PLATE + COIL_LENGTH if body == 1 and body in hung else SPRING_LENGTH
            below[body] = bottom
            points.append(f"body {body}")
            height, boxes = SOLID_HEIGHT, [((0.0, 0.0, SOLID_HEIGHT / 2), (WIDTH, DEPTH, SOLID_HEIGHT))]
            if body in with_cavity:
                height = 2 * WALL + DAMPER_HEIGHT + HEADROOM
                boxes = _cavity(height, with_cavity[body].clearance * self.exaggeration)
            self._link(f"body_{body}", boxes, body_colour(body))
            self._joint(WORLD, f"body_{body}", bottom)
            bottom += height
        for point, shaker in scene.tables:
            points.append(point)
            name = point.replace(" ", "_")
            self._link(name, [((0, 0, -PLATE / 2), (0.085, 0.085, PLATE))], DRIVE)
            self._joint(WORLD, name, below[shaker.body] - COIL_LENGTH)
        for number, damper in enumerate(scene.dampers if with_dampers else (), start=1):
            points.append(f"damper {number}")
            size = (WIDTH - 2 * WALL - 0.006, DEPTH - WALL - 0.004, DAMPER_HEIGHT)
            self._link(f"damper_{number}", [((0, -WALL / 2, DAMPER_HEIGHT / 2), size)], LEAD)
            self._joint(f"body_{damper.body}", f"damper_{number}", WALL)
        self.points = tuple(points)

    def _link(self, name: str, boxes: Sequence[Box], colour: Colour) -> None:
        rgba = " ".join(f"{part / 255:.3f}" for part in (*colour, 255))
        visuals = "".join(
            f'<visual><origin xyz="{_numbers(centre)}"/><geometry><box size="{_numbers(size)}"/></geometry>'
            f'<material name="{name}"><color rgba="{rgba}"/></material></visual>'
            for centre, size in boxes
        )
        self._links.append(f'<link name="{name}">{visuals}</link>')

    def _joint(self, parent: str, child: str, rest: float) -> None:
        self._joints.append(
            f'<joint name="{child}_moves" type="prismatic"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="0 0 {rest:g}"/><axis xyz="0 0 1"/>'
            '<limit lower="-1" upper="1" effort="0" velocity="0"/></joint>'
        )
        self._rest.append(rest)
        self._frames.append(_string(2, parent) + _string(3, child) + _ABOVE)

    def urdf(self) -> str:
        """Give the description as URDF; the robot's name states the exaggeration."""
        name = quoteattr(f"rig, motion drawn x {self.exaggeration:g}")
        return f'<?xml version="1.0"?><robot name={name}>{"".join(self._links + self._joints)}</robot>'

    def transforms(
        self, times_ns: NDArray[np.uint64], displacements: NDArray[np.float64]
    ) -> Iterator[NDArray[np.uint8]]:
        """Encode messages foxglove.FrameTransforms.

        Parameters
        ----------
        times_ns : ndarray of uint64, (messages,)
            Nanoseconds since the epoch of the recording.
        displacements : ndarray, (points, messages)
            Of each of `points`, metres; for a damper its gap.

        Yields
        ------
        ndarray of uint8, (some messages, bytes)
            The messages in order, in runs of one size.
        """
        heights = np.array(self._rest)[:, None] + self.exaggeration * displacements
        if not times_ns.size:
            return
        seconds, rest_ns = np.divmod(times_ns, np.uint64(10**9))
        sizes = np.array([varint_sizes(seconds), varint_sizes(rest_ns)])
        edges = np.flatnonzero(np.diff(sizes, axis=1).any(axis=0)) + 1
        for run in np.split(np.arange(times_ns.size), edges):
            stamps = _stamps(seconds[run], rest_ns[run], *sizes[:, run[0]].tolist())
            yield self._stamped(stamps, heights[:, run])

    def _stamped(self, stamps: NDArray[np.uint8], heights: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Encode messages whose stamps take the same number of bytes: the rest of them has fixed places."""
        count, size = stamps.shape
        places, message = [], b""
        for frames in self._frames:
            message += b"\x0a" + varint(size + len(frames) + _HEIGHT + len(_UPRIGHT))
            places.append((len(message), len(message) + size + len(frames)))
            message += bytes(size) + frames + bytes(_HEIGHT) + _UPRIGHT
        messages = np.tile(np.frombuffer(message, np.uint8), (count, 1))
        for (stamp, height), row in zip(places, np.ascontiguousarray(heights, "<f8"), strict=True):
            messages[:, stamp : stamp + size] = stamps
            messages[:, height : height + _HEIGHT] = row.view(np.uint8).reshape(count, _HEIGHT)
        return messages


def _cavity(height: float, clearance: float) -> list[Box]:
    """Floor, sides and back of a body that is open to the front; the ceiling where it is in sight."""
    boxes: list[Box] = [
        ((0, 0, WALL / 2), (WIDTH, DEPTH, WALL)),
        ((-(WIDTH - WALL) / 2, 0, height / 2), (WALL, DEPTH, height)),
        (((WIDTH - WALL) / 2, 0, height / 2), (WALL, DEPTH, height)),
        ((0, (DEPTH - WALL) / 2, height / 2), (WIDTH, WALL, height)),
    ]
    ceiling = WALL + DAMPER_HEIGHT + clearance
    if ceiling < height:
        boxes.append(((0, 0, (ceiling + height) / 2), (WIDTH, DEPTH, height - ceiling)))
    return boxes


def _numbers(values: Sequence[float]) -> str:
    return " ".join(f"{value:g}" for value in values)


def _stamps(
    seconds: NDArray[np.uint64], rest_ns: NDArray[np.uint64], wide: int, rest_wide: int
) -> NDArray[np.uint8]:
    """Encode field 1 of so many messages, a google.protobuf.Timestamp; shape (messages, bytes)."""

    def same(*content: int) -> NDArray[np.uint8]:
        return np.tile(np.array(content, np.uint8), (len(seconds), 1))

    head, between = same(0x0A, 2 + wide + rest_wide, 0x08), same(0x10)
    return np.concatenate([head, varints(seconds, wide), between, varints(rest_ns, rest_wide)], axis=1)


def _field(number: int, content: bytes) -> bytes:
    return bytes([number << 3 | 2]) + varint(len(content)) + content


def _string(number: int, text: str) -> bytes:
    return _field(number, text.encode())
