"""A recording in the rerun viewer: the rig in motion next to its channels, dampers and markers."""

import math
from collections.abc import Callable, Sequence
from functools import cached_property

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from daq.core.drawing.rig_view import Extremes, RigView
from daq.core.recording.layout import require_ordered_times
from daq.core.recording.recording import Recording
from daq.extras.viewer.blueprint import OVERLOAD_ENTITY, layout
from daq.extras.viewer.description import markdown_page
from daq.extras.viewer.marker_log import LabeledSegment, log_lines, overloads, phases
from daq.extras.viewer.recorded_motion import BLOCK_SAMPLES, RecordedMotion
from daq.extras.viewer.viewer_stream import CurveSender, plots
from rig.core.base.errors import SceneError
from rig.core.base.progress import FractionProgress

# Maximum number of drawn positions per second of the recording: enough for 50 Hz in slow motion.
_MAX_FRAMES_PER_S = 1000.0
# Smallest number of frames per second of the recording.
_MIN_FRAMES_PER_S = 100.0
# Modes below this frequency [Hz], such as rigid-body modes, do not determine the time range of the plots.
_MIN_MODE_HZ = 1.0
# A column is a few pixels wide; the envelopes of noise do not hide each other.
_ENVELOPE_COLUMNS = 300
# The frame rate is reduced above this number of frames, to limit the memory of the viewer.
_MAX_FRAMES = 60_000


class Replay:
    """The segment [begin_s, end_s] of a recording, in s from its start, to be sent to a viewer or a file.

    Raises `SceneError` if the segment contains no sample, or the playback speed (1 is real time) is not positive.
    """

    def __init__(
        self, recording: Recording, begin_s: float | None = None, end_s: float | None = None, speed: float = 1.0
    ) -> None:
        from rig.core.system.structural_model import structural_model

        if not (math.isfinite(speed) and speed > 0):
            raise SceneError(f"`speed` {speed:g}: expected a positive factor, such as 0.1 for slow motion")
        require_ordered_times(begin_s, end_s)
        self.recording = recording
        self.speed = speed
        rate = recording.rate
        self.start = 0 if begin_s is None else max(0, math.ceil(begin_s * rate))
        self.stop = recording.samples if end_s is None else min(recording.samples, math.floor(end_s * rate) + 1)
        if self.stop <= self.start:
            raise SceneError(
                "nothing to replay: no sample of the recording is between `from_s` and `to_s`; its length is "
                f"{recording.samples / rate:.3f} s. Choose times within this length."
            )
        seconds = (self.stop - self.start) / rate
        frames_per_s = min(_MAX_FRAMES_PER_S, max(_MIN_FRAMES_PER_S, _MAX_FRAMES / seconds))
        self.step = max(1, round(rate / frames_per_s))
        scene = recording.scene
        natural_hz = structural_model(scene).modes.frequency
        self.lowest_mode_hz = float(min(natural_hz[natural_hz > _MIN_MODE_HZ], default=_MIN_MODE_HZ))
        self.motion = RecordedMotion(recording)

    @cached_property
    def _largest_motion(self) -> tuple[Extremes, int]:
        """Largest motion of bodies, dampers and tables, and the sample index of the overall largest motion."""
        shaker_bodies = [shaker.first_body for _, shaker in self.recording.scene.tables]
        extremes, largest_sample, largest_size = Extremes(), self.start, 0.0
        for sample_numbers, motion in self.motion.segments(self.start, self.stop, self.step):
            extremes = extremes.extended_by(motion, shaker_bodies)
            # A picture should show dampers in flight or, without dampers, large displacements.
            motion_size = np.abs(motion.displacement).max(axis=0) if motion.gap is None else motion.gap.sum(axis=0)
            if sample_numbers.size and motion_size.max() > largest_size:
                largest_size, largest_sample = float(motion_size.max()), int(sample_numbers[motion_size.argmax()])
        return extremes, largest_sample

    @cached_property
    def view(self) -> RigView:
        """The drawing of the rig, with motion exaggerated for this segment."""
        unknown = [source.point for source in self.motion.sources if source.quantity == "nothing"]
        return RigView(self.recording.scene, self._largest_motion[0], self.motion.gaps_known, unknown)

    @property
    def largest_motion_s(self) -> float:
        """Time of the largest gaps or displacements, s from the start of the recording."""
        return self._largest_motion[1] / self.recording.rate

    @property
    def n_values(self) -> int:
        """Number of samples of channels and gaps in the viewer."""
        series = len(self.recording.channels) + (len(self.recording.scene.dampers) if self.motion.gaps_known else 0)
        return (self.stop - self.start) * series

    def blueprint(self) -> rrb.Blueprint:
        """Layout for this recording."""
        dampers = len(self.recording.scene.dampers) if self.motion.gaps_known else 0
        span = self.start / self.recording.rate, self.stop / self.recording.rate
        overloaded = len(overloads(self.recording, self.start, self.stop))
        curves = plots(self.recording.channels)
        is_whole = (self.start, self.stop) == (0, self.recording.samples)
        camera = self.view.camera
        return layout(curves, dampers, overloaded, self.lowest_mode_hz, camera, span, is_whole, self.speed)

    def send(
        self,
        stream: rr.RecordingStream,
        wait_until_received: Callable[[], object],
        progress: FractionProgress | None = None,
    ) -> None:
        """Send everything; `wait_until_received` limits the memory by a wait after each block."""
        from daq.extras.viewer.spectrum_picture import spectrum_picture

        stream.send_recording_name(self.recording.scene.name)
        for path, part in self.view.static_parts():
            stream.log(path, part, static=True)
        page = rr.TextDocument(markdown_page(self.recording, self.motion, self.view), media_type="text/markdown")
        stream.log("about", page, static=True)
        spectrum = spectrum_picture(self.recording, self.start, self.stop)
        stream.log("spectrum", rr.EncodedImage(contents=spectrum, media_type="image/png"), static=True)
        recording, dampers = self.recording, self.recording.scene.dampers if self.motion.gaps_known else ()
        sender = CurveSender(stream, recording.rate, recording.channels, dampers)
        lines = log_lines(recording, self.start, self.stop)
        if lines:
            text = rr.TextLog.columns(text=[line.text for line in lines], level=[line.level for line in lines])
            stream.send_columns("markers", [sender.time_column(np.array([line.sample for line in lines]))], text)
        if spans := phases(recording, self.start, self.stop):
            self._send_segments(stream, sender, "test", spans)
        for name, segments in overloads(recording, self.start, self.stop).items():
            self._send_segments(stream, sender, f"{OVERLOAD_ENTITY}/{name}", segments)
        total = self.stop - self.start
        for first in range(self.start, self.stop, BLOCK_SAMPLES):
            last = min(first + BLOCK_SAMPLES, self.stop)
            for name in recording.channels:
                samples = recording.read(name, first, last)
                sender.send_channel(name, first, samples)
                sender.send_envelope(name, first, samples, math.ceil(total / _ENVELOPE_COLUMNS))
            if dampers:
                gap, contact = (recording.truth(quantity, first, last) for quantity in ("gap", "contact"))
                sender.send_dampers(first, gap, contact)
            wait_until_received()
            if progress is not None:
                progress(0.8 * (last - self.start) / total, "channels")
        for sample_numbers, motion in self.motion.segments(self.start, self.stop, self.step):
            sender.send_motion(self.view, sample_numbers, motion)
            wait_until_received()
            if progress is not None and sample_numbers.size:
                progress(0.8 + 0.2 * (int(sample_numbers[-1]) - self.start) / total, "motion")

    @staticmethod
    def _send_segments(
        stream: rr.RecordingStream, sender: CurveSender, entity: str, segments: Sequence[LabeledSegment]
    ) -> None:
        # Each segment is a separate state with a label; between segments the timeline is empty.
        states = [str(number) for number in range(len(segments))]
        style = rr.StateConfiguration(
            values=[*states, "none"],
            labels=[*(segment.label for segment in segments), ""],
            colors=np.array([*(segment.color for segment in segments), 0], dtype=np.uint32),
            visible=[True] * len(segments) + [False],
        )
        stream.log(entity, style, static=True)
        changes = {segment.stop: "none" for segment in segments}
        changes |= {segment.start: state for segment, state in zip(segments, states, strict=True)}
        samples = np.array(sorted(changes))
        stream.send_columns(
            entity,
            [sender.time_column(samples)],
            rr.StateChange.columns(state=[changes[int(sample)] for sample in samples]),
        )
