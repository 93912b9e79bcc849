"""Description of the rig for general MCAP viewers as a robot (URDF); FrameTransforms in the recording move its parts.

The parts have the sizes and positions of `daq.core.drawing.stack`; springs are not drawn. Every displacement and gap is
multiplied by a factor, the exaggeration, which is chosen before the motion is known.
"""

import math
import struct
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from daq.core.drawing.palette import DAMPER, DRIVE, GROUND, Color, body_color
from daq.core.drawing.stack import DEPTH, HEADROOM, PLATE, WALL, WIDTH, Stack, round_factor, walls
from daq.core.mcap_file.protobuf import Schema, descriptor_set_bytes, text_field, varint, varints
from rig.core.base.arrays import Array
from rig.core.scene.scene import Scene

# Center and size of a box.
BoxGeometry = tuple[tuple[float, float, float], tuple[float, float, float]]
# Name of the fixed link of the robot, which does not move.
WORLD = "world"
# Largest exaggeration: displacements near a resonance are millimeters, and a millimeter is drawn as two centimeters.
EXAGGERATION = 20.0

TRANSFORMS_SCHEMA = Schema(
    "foxglove.FrameTransforms",
    "protobuf",
    descriptor_set_bytes(
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
# Size of a height (a double) in a message [bytes].
_HEIGHT_BYTES = 8
# Size of the seconds, and of the nanoseconds, in a google.protobuf.Timestamp [bytes]. The sizes are fixed, so all
# messages have the same size. Each number follows its tag (0x08, 0x10); the Timestamp follows its own tag and its size.
_TIME_BYTES = 5
_TIMESTAMP = bytes([0x0A, 2 + 2 * _TIME_BYTES, 0x08, *bytes(_TIME_BYTES), 0x10, *bytes(_TIME_BYTES)])
# Translation: x = y = 0, and the tag of z, the height.
_TRANSLATION = b"\x22\x1b" + struct.pack("<BdBdB", 0x09, 0.0, 0x11, 0.0, 0x19)
# Rotation: the quaternion w = 1.
_NO_ROTATION = b"\x2a\x09\x21" + struct.pack("<d", 1.0)


def exaggeration(scene: Scene) -> float:
    """Return the factor on displacements and gaps: at most 20, less if a finite clearance would not fit."""
    clearances = [damper.clearance for damper in scene.dampers if 0 < damper.clearance < math.inf]
    # A mass on a spring is drawn with half of the height on each side.
    clearances += [2 * max(damper.below, 0.0) for damper in scene.dampers if damper.spring and damper.impacts]
    clearances = [clearance for clearance in clearances if 0 < clearance < math.inf]
    return round_factor(min([EXAGGERATION, *(HEADROOM / clearance for clearance in clearances)]))


class RobotDescription:
    """The rig of a scene as parts (URDF links) moving up and down; dampers are included only if their motion is known.

    `points` names the parts in the order of `transforms`; `exaggeration` multiplies every displacement and gap.
    """

    def __init__(self, scene: Scene, with_dampers: bool) -> None:
        self.exaggeration = exaggeration(scene)
        self._links: list[str] = []
        self._joints: list[str] = []
        self._rest_heights: list[float] = []
        # A message, and the offsets of the time stamp and the height of each part in it.
        self._message_template, self._field_offsets = b"", list[tuple[int, int]]()
        stack, points = Stack(scene, self.exaggeration), list[str]()
        self._add_link(WORLD, [((0, 0, -0.01), (0.62, 0.30, 0.02))], GROUND)
        parts = zip(stack.cavities, stack.heights, stack.bottoms, strict=True)
        for body, (body_cavities, height, bottom) in enumerate(parts, 1):
            points.append(f"body {body}")
            boxes = walls(body_cavities) if body_cavities else [((0.0, 0.0, height / 2), (WIDTH, DEPTH, height))]
            self._add_link(f"body_{body}", boxes, body_color(body))
            self._add_joint(WORLD, f"body_{body}", bottom)
        for table in stack.tables:
            points.append(table.point)
            name = table.point.replace(" ", "_")
            self._add_link(name, [((0, 0, -PLATE / 2), (0.085, 0.085, PLATE))], DRIVE)
            self._add_joint(WORLD, name, table.top)
        cavity_of_damper = {cavity.damper_index: cavity for body_cavities in stack.cavities for cavity in body_cavities}
        for number, damper in enumerate(scene.dampers if with_dampers else (), start=1):
            points.append(f"damper {number}")
            (x, y, z), size = cavity_of_damper[number - 1].damper
            self._add_link(f"damper_{number}", [((x, y, z - WALL), size)], DAMPER)
            self._add_joint(f"body_{damper.body}", f"damper_{number}", WALL)
        self.points = tuple(points)

    def _add_link(self, name: str, boxes: Sequence[BoxGeometry], color: Color) -> None:
        """Add a part of boxes, each with center and size in m of the drawing."""
        rgba = " ".join(f"{component / 255:.3f}" for component in (*color, 255))
        visuals = "".join(
            f'<visual><origin xyz="{_join(center)}"/><geometry><box size="{_join(size)}"/></geometry>'
            f'<material name="{name}"><color rgba="{rgba}"/></material></visual>'
            for center, size in boxes
        )
        self._links.append(f'<link name="{name}">{visuals}</link>')

    def _add_joint(self, parent: str, child: str, rest_height: float) -> None:
        """Let a part move vertically relative to its parent, and append its transform to the message template."""
        self._joints.append(
            f'<joint name="{child}_moves" type="prismatic"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="0 0 {rest_height:g}"/><axis xyz="0 0 1"/>'
            '<limit lower="-1" upper="1" effort="0" velocity="0"/></joint>'
        )
        self._rest_heights.append(rest_height)
        head = _TIMESTAMP + text_field(2, parent) + text_field(3, child) + _TRANSLATION
        self._message_template += b"\x0a" + varint(len(head) + _HEIGHT_BYTES + len(_NO_ROTATION))
        self._field_offsets.append((len(self._message_template), len(self._message_template) + len(head)))
        self._message_template += head + bytes(_HEIGHT_BYTES) + _NO_ROTATION

    def urdf(self) -> str:
        """Return the description as URDF; the name of the robot specifies the exaggeration."""
        name = f"rig, motion drawn x {self.exaggeration:g}"
        return f'<?xml version="1.0"?><robot name="{name}">{"".join(self._links + self._joints)}</robot>'

    def transforms(self, times_ns: NDArray[np.uint64], displacements: Array) -> NDArray[np.uint8]:
        """Encode displacements in m (for a damper its gap), shape (points, messages), as foxglove.FrameTransforms."""
        heights = np.array(self._rest_heights)[:, None] + self.exaggeration * displacements
        seconds, nanoseconds = np.divmod(times_ns, np.uint64(10**9))
        messages = np.empty((times_ns.size, len(self._message_template)), np.uint8)
        messages[:] = np.frombuffer(self._message_template, np.uint8)
        seconds_bytes, nanoseconds_bytes = varints(seconds, _TIME_BYTES), varints(nanoseconds, _TIME_BYTES)
        for (stamp, height_offset), row in zip(self._field_offsets, np.ascontiguousarray(heights, "<f8"), strict=True):
            messages[:, stamp + 3 : stamp + 3 + _TIME_BYTES] = seconds_bytes
            messages[:, stamp + 4 + _TIME_BYTES : stamp + len(_TIMESTAMP)] = nanoseconds_bytes
            messages[:, height_offset : height_offset + _HEIGHT_BYTES] = row.view(np.uint8).reshape(-1, _HEIGHT_BYTES)
        return messages


def _join(values: Sequence[float]) -> str:
    return " ".join(f"{value:g}" for value in values)
