"""Showing a recording in the rerun viewer: the rig in motion beside its channels, dampers and test marks."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from daq.about import about
from daq.blueprint import TIMELINE, Content, layout
from daq.marks import log_lines, phases
from daq.palette import body_colour, channel_colour
from daq.rig_motion import BLOCK, RecordedMotion
from daq.rig_view import Extremes, RigView
from rig.errors import SceneError

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

    from daq.channel import ChannelInfo
    from daq.recording import Recording

# Instants drawn in 3D: enough for slow motion of a 50 Hz tone in a short recording, fewer in a long one.
MOST_FRAMES_PER_S = 1000.0
LEAST_FRAMES_PER_S = 100.0
SLOWEST_HZ = 1.0
FRAMES = 60_000
CONTACTS = ("flight", "floor", "ceiling", "lost")
CONTACT_COLOURS = (0x3B82C4FF, 0x8A5A2BFF, 0xC4453BFF, 0x404040FF)
# Quantities in the order of interest to somebody who looks at a structure, and the factor to the shown unit.
SHOWN = {
    "displacement": (1e3, "mm"),
    "acceleration": (1.0, "m/s²"),
    "velocity": (1.0, "m/s"),
    "force": (1.0, "N"),
}

Progress = Callable[[float, str], None]


class Replay:
    """A stretch of a recording, ready to be sent to a viewer or a file.

    Parameters
    ----------
    recording : Recording
        Open recording.
    begin_s, end_s : float or None
        The stretch, seconds from the start of the recording; None means from its start, to its end.
    speed : float
        Speed at which the viewer plays, 1 is real time.

    Raises
    ------
    SceneError
        If the stretch holds no sample, or the speed is not positive.
    """

    def __init__(
        self,
        recording: Recording,
        begin_s: float | None = None,
        end_s: float | None = None,
        speed: float = 1.0,
    ) -> None:
        from rig.structure import natural_modes, structure_matrices

        if not (math.isfinite(speed) and speed > 0):
            raise SceneError(f"--speed {speed:g}: expected a positive factor, such as 0.1 for slow motion")
        self.recording = recording
        self.speed = speed
        rate = recording.rate
        self.start = 0 if begin_s is None else max(0, math.ceil(begin_s * rate))
        self.stop = (
            recording.samples if end_s is None else min(recording.samples, math.floor(end_s * rate) + 1)
        )
        if self.stop <= self.start:
            raise SceneError(
                f"nothing to replay: the recording lasts {recording.samples / rate:.3f} s, and "
                f"--from {begin_s} --to {end_s} leave no sample of it"
            )
        seconds = (self.stop - self.start) / rate
        frames_per_s = min(MOST_FRAMES_PER_S, max(LEAST_FRAMES_PER_S, FRAMES / seconds))
        self.step = max(1, round(rate / frames_per_s))
        scene = recording.scene
        mass, _, stiffness = structure_matrices(scene.structure)
        natural_hz = natural_modes(mass, stiffness)[0] / (2 * np.pi)
        # A structure that is not held has modes at 0 Hz, which set no time scale.
        self.lowest_hz = float(min(natural_hz[natural_hz > SLOWEST_HZ], default=SLOWEST_HZ))
        self.motion = RecordedMotion(recording)

    @cached_property
    def _survey(self) -> tuple[Extremes, int]:
        """Largest motions, and the sample at which there is most to see; reads the whole stretch."""
        driven = RigView.driven_body(self.recording.scene)
        extremes, liveliest, most = Extremes(), self.start, 0.0
        for instants, motion in self.motion.stretches(self.start, self.stop, self.step):
            extremes = extremes.widened(motion, driven)
            # Dampers in flight are what a picture should show; without them, bodies far out.
            sight = np.abs(motion.displacement).max(axis=0) if motion.gap is None else motion.gap.sum(axis=0)
            if instants.size and sight.max() > most:
                most, liveliest = float(sight.max()), int(instants[sight.argmax()])
        return extremes, liveliest

    @cached_property
    def view(self) -> RigView:
        """The drawing of the rig, its exaggeration fit to the motion of this stretch."""
        return RigView(self.recording.scene, self._survey[0], self.motion.gaps_known)

    @property
    def liveliest_s(self) -> float:
        """Seconds from the start of the recording to where dampers fly highest, or bodies are far out."""
        return self._survey[1] / self.recording.rate

    @property
    def values(self) -> int:
        """Samples of channels and gaps that a viewer would hold."""
        series = len(self.recording.channels) + (
            len(self.recording.scene.dampers) if self.motion.gaps_known else 0
        )
        return (self.stop - self.start) * series

    def groups(self) -> dict[str, list[tuple[str, ChannelInfo]]]:
        """Channels by quantity, in the order in which they are shown."""
        groups: dict[str, list[tuple[str, ChannelInfo]]] = {}
        for quantity in SHOWN:
            members = [(n, info) for n, info in self.recording.channels.items() if info.quantity == quantity]
            if members:
                groups[quantity] = members
        return groups

    def blueprint(self) -> rrb.Blueprint:
        """Layout for this recording."""
        dampers = len(self.recording.scene.dampers) if self.motion.gaps_known else 0
        plots = [(f"channels/{quantity}", f"{quantity} [{SHOWN[quantity][1]}]") for quantity in self.groups()]
        return layout(Content(plots, dampers, self.lowest_hz, self.view.eye, self.speed))

    def send(
        self, stream: rr.RecordingStream, drain: Callable[[], object], progress: Progress | None = None
    ) -> None:
        """Send everything to a stream.

        Parameters
        ----------
        stream : rerun RecordingStream
            Its sink is set.
        drain : callable
            Waits until the sink has taken what was sent; called often, so that nothing piles up in memory.
        progress : callable or None
            Told the share that is done.
        """
        import rerun as rr

        from daq.spectrum import spectrum_picture

        stream.send_recording_name(self.recording.scene.name)
        for path, part in self.view.still_parts():
            stream.log(path, part, static=True)
        stream.log(
            "about",
            rr.TextDocument(about(self.recording, self.motion, self.view), media_type="text/markdown"),
            static=True,
        )
        stream.log(
            "spectrum",
            rr.EncodedImage(
                contents=spectrum_picture(self.recording, self.start, self.stop), media_type="image/png"
            ),
            static=True,
        )
        self._send_marks(stream)
        self._send_styles(stream)
        total = self.stop - self.start
        contacts = _Changes()
        for first in range(self.start, self.stop, BLOCK):
            last = min(first + BLOCK, self.stop)
            self._send_channels(stream, first, last)
            if self.motion.gaps_known:
                self._send_dampers(stream, first, last, contacts)
            drain()
            if progress is not None:
                progress(0.8 * (last - self.start) / total, "channels")
        for instants, motion in self.motion.stretches(self.start, self.stop, self.step):
            if not instants.size:
                continue
            for path, translation, scale in self.view.moving_parts(motion):
                columns = (
                    rr.Transform3D.columns(translation=translation)
                    if scale is None
                    else rr.Transform3D.columns(translation=translation, scale=scale)
                )
                stream.send_columns(path, [self._times(instants)], columns)
            drain()
            if progress is not None:
                progress(0.8 + 0.2 * (int(instants[-1]) - self.start) / total, "motion")

    def _times(self, samples: NDArray[np.int64]) -> rr.TimeColumn:
        import rerun as rr

        # Durations stay far below the 2^53 ns up to which a double holds every nanosecond.
        nanoseconds = np.round(samples * (1e9 / self.recording.rate)).astype("timedelta64[ns]")
        return rr.TimeColumn(TIMELINE, duration=nanoseconds)

    def _send_styles(self, stream: rr.RecordingStream) -> None:
        import rerun as rr

        for quantity, members in self.groups().items():
            for name, info in members:
                style = rr.SeriesLines(
                    colors=[channel_colour(info.at)], names=[name], widths=[1.2], aggregation_policy="MinMax"
                )
                stream.log(f"channels/{quantity}/{name}", style, static=True)
        if not self.motion.gaps_known:
            return
        for place, damper in enumerate(self.recording.scene.dampers, start=1):
            name = f"damper {place} (body {damper.body})"
            style = rr.SeriesLines(
                colors=[body_colour(damper.body)], names=[name], widths=[1.2], aggregation_policy="MinMax"
            )
            stream.log(f"dampers/gap_mm/damper_{place}", style, static=True)
            lane = rr.StateConfiguration(
                values=list(CONTACTS),
                labels=list(CONTACTS),
                colors=np.array(CONTACT_COLOURS, dtype=np.uint32),
            )
            stream.log(f"dampers/contact/damper_{place}", lane, static=True)

    def _send_channels(self, stream: rr.RecordingStream, first: int, last: int) -> None:
        import rerun as rr

        times = self._times(np.arange(first, last))
        for quantity, members in self.groups().items():
            for name, _ in members:
                values = self.recording.read(name, first, last) * SHOWN[quantity][0]
                stream.send_columns(
                    f"channels/{quantity}/{name}", [times], rr.Scalars.columns(scalars=values)
                )

    def _send_dampers(self, stream: rr.RecordingStream, first: int, last: int, contacts: _Changes) -> None:
        import rerun as rr

        samples = np.arange(first, last)
        gap = self.recording.truth("gap", first, last) * 1e3
        contact = self.recording.truth("contact", first, last)
        contact = np.where(np.isnan(contact), CONTACTS.index("lost"), contact).astype(np.int8)
        for place in range(len(self.recording.scene.dampers)):
            stream.send_columns(
                f"dampers/gap_mm/damper_{place + 1}",
                [self._times(samples)],
                rr.Scalars.columns(scalars=gap[place]),
            )
            places, states = contacts.of(place, contact[place])
            if places.size:
                stream.send_columns(
                    f"dampers/contact/damper_{place + 1}",
                    [self._times(samples[places])],
                    rr.StateChange.columns(state=[CONTACTS[int(state)] for state in states]),
                )

    def _send_marks(self, stream: rr.RecordingStream) -> None:
        import rerun as rr

        lines = log_lines(self.recording, self.start, self.stop)
        if lines:
            text = rr.TextLog.columns(
                text=[line.text for line in lines], level=[line.level for line in lines]
            )
            stream.send_columns("test/marks", [self._times(np.array([line.sample for line in lines]))], text)
        spans = phases(self.recording, self.start, self.stop)
        if not spans:
            return
        # Each phase is a state of its own, so that each can have its label; between phases the lane is empty.
        states = [str(number) for number in range(len(spans))]
        lane = rr.StateConfiguration(
            values=[*states, "none"],
            labels=[*(span.label for span in spans), ""],
            colors=np.array([*(span.colour for span in spans), 0], dtype=np.uint32),
            visible=[True] * len(spans) + [False],
        )
        stream.log("test/phase", lane, static=True)
        changes = {span.stop: "none" for span in spans}
        changes |= {span.start: state for span, state in zip(spans, states, strict=True)}
        at = np.array(sorted(changes))
        stream.send_columns(
            "test/phase",
            [self._times(at)],
            rr.StateChange.columns(state=[changes[int(sample)] for sample in at]),
        )


class _Changes:
    """Finds where the contact state of each damper changes, across blocks."""

    def __init__(self) -> None:
        self._last: dict[int, int] = {}

    def of(self, damper: int, contact: NDArray[np.int8]) -> tuple[NDArray[np.intp], NDArray[np.int8]]:
        """Give the places in this block at which a new state begins, and the states."""
        before = np.concatenate([[self._last.get(damper, -1)], contact[:-1]])
        places = np.nonzero(contact != before)[0]
        self._last[damper] = int(contact[-1])
        return places, contact[places]
