"""The live view of a bench in the viewer: the moving rig, curves of the readings, and the values of the tone."""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from daq.drawing.rig_view import Extremes, RigMotion, RigView, exaggeration
from daq.excitation.manual_tone import ToneEstimate
from daq.viewing.blueprint import live_layout
from daq.viewing.viewer_stream import CurveSender, plots
from rig.escaping import escape_markdown
from rig.results.text import format_decimals

if TYPE_CHECKING:
    import rerun as rr

    from daq.signal_chain.channel import ChannelInfo
    from daq.virtual_bench.bench import Block
    from rig.scene.scene import Scene

# Number of displayed positions of the rig per second.
_FRAMES_PER_S = 200.0
# The exaggeration is the factor on displacements and gaps in the drawing. It decreases at once with growing motion, and
# increases only by a factor of `_MIN_INCREASE` or more, after the motion has been small for `_SMALL_MOTION_S`.
_MIN_INCREASE = 4.0
_SMALL_MOTION_S = 2.0
# Maximum number of displayed estimates of the tone per second.
_ESTIMATES_PER_S = 5.0


class Screen:
    """Displays a bench in a viewer.

    The drawing shows the true motion of the rig and its dampers, as an observer would see it. The curves show the
    readings of the instrument. `stream` is connected to the viewer.
    """

    def __init__(self, stream: rr.RecordingStream, scene: Scene, channels: Sequence[ChannelInfo], rate: float) -> None:
        self._stream, self._scene, self._rate = stream, scene, rate
        self._channel_names = [info.name for info in channels]
        by_name = {info.name: info for info in channels}
        self._step = max(1, round(rate / _FRAMES_PER_S))
        self._recent_extremes: list[tuple[int, Extremes]] = []
        # Before the first block, motion of 1 mm is assumed.
        self._redraw(Extremes(body=1e-3, spring=1e-3, coil=1e-3, gap=1e-3))
        stream.send_blueprint(
            live_layout(plots(by_name), len(scene.dampers), self._view.camera), make_active=True, make_default=True
        )
        self._sender = CurveSender(stream, rate, by_name, scene.dampers)
        self._next_estimate = 0
        self._position = 0

    def show_block(self, block: Block, readings: NDArray[np.float64]) -> None:
        """Show a block: readings, shape (channels, samples), in the channels' units."""
        for name, samples in zip(self._channel_names, readings, strict=True):
            if samples.size:
                self._sender.send_channel(name, block.first, samples)
        motion = block.motion
        if self._scene.dampers:
            self._sender.send_dampers(motion.first, motion.gap, motion.contact)
        size = motion.displacement.shape[1]
        indices = np.arange((-motion.first) % self._step, size, self._step)
        bodies = self._scene.structure.bodies
        rig_motion = RigMotion(
            motion.displacement[:bodies, indices],
            motion.displacement[bodies : bodies + len(self._scene.tables), indices],
            motion.gap[:, indices] if self._scene.dampers else None,
        )
        self._position = motion.first + size
        if indices.size:
            self._adapt_exaggeration(rig_motion)
            self._sender.send_motion(self._view, motion.first + indices, rig_motion)

    def show_tone(self, estimate: ToneEstimate) -> None:
        """Show an estimate of the tone (its frequency, force and displacements), at most a few times per second."""
        import rerun as rr

        if self._position < self._next_estimate:
            return
        self._next_estimate = self._position + round(self._rate / _ESTIMATES_PER_S)
        self._stream.set_time("time", duration=np.timedelta64(round(self._position / self._rate * 1e9), "ns"))
        self._stream.log("reading", rr.TextDocument(tone_page(estimate), media_type="text/markdown"))

    def _redraw(self, extremes: Extremes) -> None:
        """Draw the rig with the exaggeration for the largest motions `extremes`."""
        self._view = RigView(self._scene, extremes, gaps_known=True)
        for path, part in self._view.static_parts():
            self._stream.log(path, part, static=True)

    def _adapt_exaggeration(self, rig_motion: RigMotion) -> None:
        """Redraw the rig if its exaggeration is too large, or much too small, for the motion."""
        current = Extremes().extended_by(rig_motion, [shaker.body for _, shaker in self._scene.tables])
        first_position = self._position - round(_SMALL_MOTION_S * self._rate)
        self._recent_extremes = [entry for entry in self._recent_extremes if entry[0] >= first_position]
        self._recent_extremes.append((self._position, current))
        recent = (vars(extremes).values() for _, extremes in self._recent_extremes)
        largest = Extremes(*(max(values) for values in zip(*recent, strict=True)))
        factor = exaggeration(largest)
        # Whether the stored extremes cover `_SMALL_MOTION_S`.
        is_covered = self._position - self._recent_extremes[0][0] >= 0.9 * _SMALL_MOTION_S * self._rate
        if factor < self._view.exaggeration or (is_covered and factor > _MIN_INCREASE * self._view.exaggeration):
            self._redraw(largest)


def tone_page(estimate: ToneEstimate) -> str:
    """Return the values of a tone as a page in Markdown."""
    # Held: steady state; silent: no excitation; settling: transient.
    state = "held" if estimate.is_settled else "silent" if estimate.level == 0.0 else "settling"
    lines = [
        f"## {format_decimals(estimate.frequency, 2)} Hz, {estimate.level:g} N: {state}",
        f"force {format_decimals(abs(estimate.force), 3)} N, drive amplitude {estimate.drive:.4g}",
        "",
        "| channel | displacement | over force | phase |",
        "|---|---|---|---|",
    ]
    for name, displacement in estimate.displacement.items():
        ratio = estimate.receptance(name)
        ratio_cells = f"{abs(ratio) * 1e3:.4g} mm/N | {math.degrees(cmath.phase(ratio)):.1f}°"
        if not estimate.is_settled:
            ratio_cells = "- | -"
        lines.append(f"| {escape_markdown(name)} | {abs(displacement) * 1e3:.4g} mm | {ratio_cells} |")
    return "\n".join(lines) + "\n"


def tone_line(estimate: ToneEstimate) -> str:
    """Return the values of a settled tone as a line of text."""
    responses = ", ".join(
        f"{name} {abs(displacement) * 1e3:.3g} mm ({math.degrees(cmath.phase(estimate.receptance(name))):.0f}°)"
        for name, displacement in estimate.displacement.items()
    )
    return f"{estimate.frequency:g} Hz: {abs(estimate.force):.3g} N held; {responses}"
