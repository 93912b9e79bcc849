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

from daq.drawing.cavities import DEPTH, HEADROOM, HOLLOW_HEIGHT, WALL, WIDTH, Cavity, cavities, walls
from daq.drawing.palette import DRIVE, GROUND, LEAD, Colour, body_colour
from daq.drawing.rig_view import COIL_LENGTH, PLATE, PLINTH, SOLID_HEIGHT, SPRING_LENGTH
from daq.recording.protobuf import Schema, descriptors, varint, varints

if TYPE_CHECKING:
    from collections.abc import Sequence

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
# Field 1, a google.protobuf.Timestamp: seconds and nanoseconds in five bytes each, whatever they are, so that all
# messages have one size.
_WIDE = 5
_STAMP = bytes([0x0A, 2 + 2 * _WIDE, 0x08, *bytes(_WIDE), 0x10, *bytes(_WIDE)])
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
        # A message, and where in it the stamp and the height of each part are.
        self._message, self._places = b"", list[tuple[int, int]]()
        points: list[str] = []
        self._link(WORLD, [((0, 0, -0.01), (0.62, 0.30, 0.02))], GROUND)
        hung = {shaker.body for _, shaker in scene.tables}
        bottom, below, at = 0.0, dict[int, float](), dict[int, Cavity]()
        for body in range(1, scene.structure.bodies + 1):
            bottom += PLINTH + PLATE + COIL_LENGTH if body == 1 and body in hung else SPRING_LENGTH
            below[body] = bottom
            points.append(f"body {body}")
            height, boxes = SOLID_HEIGHT, [((0.0, 0.0, SOLID_HEIGHT / 2), (WIDTH, DEPTH, SOLID_HEIGHT))]
            inside = cavities(scene.dampers, body, self.exaggeration)
            if inside:
                height, boxes = HOLLOW_HEIGHT, walls(inside)
            at |= {cavity.place: cavity for cavity in inside}
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
            (x, y, z), size = at[number - 1].damper
            self._link(f"damper_{number}", [((x, y, z - WALL), size)], LEAD)
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
        before = _STAMP + _string(2, parent) + _string(3, child) + _ABOVE
        self._message += b"\x0a" + varint(len(before) + _HEIGHT + len(_UPRIGHT))
        self._places.append((len(self._message), len(self._message) + len(before)))
        self._message += before + bytes(_HEIGHT) + _UPRIGHT

    def urdf(self) -> str:
        """Give the description as URDF; the robot's name states the exaggeration."""
        name = quoteattr(f"rig, motion drawn x {self.exaggeration:g}")
        return f'<?xml version="1.0"?><robot name={name}>{"".join(self._links + self._joints)}</robot>'

    def transforms(
        self, times_ns: NDArray[np.uint64], displacements: NDArray[np.float64]
    ) -> NDArray[np.uint8]:
        """Encode messages foxglove.FrameTransforms.

        Parameters
        ----------
        times_ns : ndarray of uint64, (messages,)
            Nanoseconds since the epoch of the recording.
        displacements : ndarray, (points, messages)
            Of each of `points`, metres; for a damper its gap.

        Returns
        -------
        ndarray of uint8, (messages, bytes)
        """
        heights = np.array(self._rest)[:, None] + self.exaggeration * displacements
        seconds, rest_ns = np.divmod(times_ns, np.uint64(10**9))
        messages = np.empty((times_ns.size, len(self._message)), np.uint8)
        messages[:] = np.frombuffer(self._message, np.uint8)
        whole, rest = varints(seconds, _WIDE), varints(rest_ns, _WIDE)
        for (stamp, height), row in zip(self._places, np.ascontiguousarray(heights, "<f8"), strict=True):
            messages[:, stamp + 3 : stamp + 3 + _WIDE] = whole
            messages[:, stamp + 4 + _WIDE : stamp + len(_STAMP)] = rest
            messages[:, height : height + _HEIGHT] = row.view(np.uint8).reshape(-1, _HEIGHT)
        return messages


def _numbers(values: Sequence[float]) -> str:
    return " ".join(f"{value:g}" for value in values)


def _field(number: int, content: bytes) -> bytes:
    return bytes([number << 3 | 2]) + varint(len(content)) + content


def _string(number: int, text: str) -> bytes:
    return _field(number, text.encode())
