"""The rig as a bench sees it: drive samples go in, motion comes out."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rig.assembly import assemble
from rig.errors import RunError, SceneError
from rig.march import Array, Course, event_table, gaps_and_contacts, sampled_march
from rig.motion import Motion
from rig.scene import Scene


class Plant:
    """A scene's rig under sampled drive with first-order hold.

    The motion between samples is exact, contacts included, and does not depend on how the drive is cut into
    blocks.

    Parameters
    ----------
    scene : Scene
    rate : float
        Samples per second.

    Attributes
    ----------
    inputs, drive_units : tuple of str
        "shaker" and/or "hammer"; N, m (displacement commanded of the table), V (at the amplifier).
    points : tuple of str
        "body 1" ... and "table" if there is one.
    """

    def __init__(self, scene: Scene, rate: float) -> None:
        if not (np.isfinite(rate) and rate > 0.0):
            raise SceneError(f"rate: got {rate!r}; expected a positive number of samples per second")
        self.rate = float(rate)
        self.system = assemble(scene)
        self.inputs, self.drive_units, self.points = (
            self.system.inputs,
            self.system.drive_units,
            self.system.points,
        )
        self._march, self._steps = sampled_march(self.system, 1.0 / self.rate)
        self._limit = _drive_limits(scene, self.inputs)
        self._next = 0
        self._last = np.zeros((len(self.inputs), 1))

    @property
    def ambiguous(self) -> int:
        """Number of contact decisions so far that lay within rounding (they count as no contact)."""
        return self._march.ambiguous

    def advance(self, drive: ArrayLike) -> Motion:
        """Drive the rig on.

        Parameters
        ----------
        drive : array_like, shape (inputs, samples)
            Drive at the next samples. The very first one is the drive at t = 0, where the motion starts.

        Returns
        -------
        Motion
            At the same samples; sample k depends on drive up to k.

        Raises
        ------
        RunError
            If the drive has the wrong shape, or is not finite.
        """
        block = self._checked(drive)
        samples = block.shape[1]
        first = self._next
        if samples == 0:
            return self._motion(self._march.over_samples(self._last, self._steps), first, 0)
        lead = 0
        if first == 0:
            lead = 1
            start = np.concatenate([block[:, 0], np.zeros(len(self.inputs))])
            self._lifted = self._march.place(self.system.initial, start)
            self._last = block[:, :1]
            initial = self._march.standing()
            block = block[:, 1:]
        course = self._march.over_samples(np.hstack([self._last, block]), self._steps)
        if block.shape[1]:
            self._last = block[:, -1:].copy()
        self._next += samples
        if lead:
            course = _joined(initial, course)
        return self._motion(course, first, lead)

    def _checked(self, drive: ArrayLike) -> Array:
        block = np.asarray(drive, dtype=np.float64)
        if block.ndim != 2 or block.shape[0] != len(self.inputs):
            raise RunError(
                f"drive: got an array of shape {block.shape}; expected ({len(self.inputs)}, samples) for the "
                f"inputs {', '.join(self.inputs) or '(none)'}"
            )
        if not np.isfinite(block).all():
            row, column = np.argwhere(~np.isfinite(block))[0]
            raise RunError(
                f"drive: {block[row, column]} at sample {self._next + column} of input {self.inputs[row]}; "
                "expected finite numbers"
            )
        return np.clip(block, -self._limit, self._limit)

    def _motion(self, course: Course, first: int, lead: int) -> Motion:
        system, n = self.system, self.system.coordinates
        interval = 1.0 / self.rate
        gap, contact = gaps_and_contacts(course, system)
        # Segment s of this call ends at sample first + s, or one later if sample 0 was the initial state.
        ends = first + lead + course.break_segment
        before, after = course.before, course.after
        event_times = (first + lead + course.event_segment - 1) * interval + course.event_offset
        events = event_table(event_times, course.event_damper, course.event_kind, course.event_speed, system)
        if lead and len(self._lifted):
            zeros = np.zeros(len(self._lifted))
            events = np.concatenate(
                [event_table(zeros, self._lifted, zeros.astype(np.int64), zeros, system), events]
            )
        return Motion(
            first=first,
            displacement=np.ascontiguousarray(course.state[:, :n].T),
            velocity=np.ascontiguousarray(course.state[:, n : 2 * n].T),
            acceleration=self._march.accelerations(course.state, course.slot),
            gap=gap,
            contact=contact,
            break_sample=ends,
            break_offset=np.minimum(course.break_offset, interval),
            break_displacement=np.ascontiguousarray(before[:, :n].T),
            break_velocity=np.stack([before[:, n : 2 * n].T, after[:, n : 2 * n].T]),
            break_acceleration=np.stack(
                [
                    self._march.accelerations(before, course.before_slot),
                    self._march.accelerations(after, course.after_slot),
                ]
            ),
            events=events,
        )


def _drive_limits(scene: Scene, inputs: tuple[str, ...]) -> Array:
    """Largest drive that each input passes on: an amplifier clips."""
    limits = np.full((len(inputs), 1), np.inf)
    shaker = scene.shaker
    if shaker is not None and shaker.kind == "electrodynamic":
        limits[inputs.index("shaker")] = shaker.amplifier.limit / shaker.amplifier.gain
    return limits


def _joined(head: Course, tail: Course) -> Course:
    """Put a sample before a course."""
    return Course(
        *(np.concatenate([getattr(head, name), getattr(tail, name)]) for name in Course.__dataclass_fields__)
    )
