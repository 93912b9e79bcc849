"""Stream of curves of channels and dampers, and of the motion of the rig, to a viewer, block by block."""

from collections.abc import Mapping, Sequence

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from daq.core.drawing.palette import body_color, channel_color
from daq.core.drawing.rig_view import RigMotion, RigView
from daq.core.signal_chain.channel import ChannelInfo
from daq.extras.viewer.blueprint import ENVELOPE_ENTITY, TIMELINE
from rig.core.scene.damper import Damper
from rig.core.scene.scene import STANDARD_GRAVITY

CONTACTS = ("flight", "floor", "ceiling", "lost")
# Colors of different lightness, so they remain distinct in a gray print; a damper in flight has its own color.
CONTACT_COLORS = (0xE69F00FF, 0x6B4423FF, 0xC4453BFF, 0x404040FF)
# Quantities in the order of their plots: factor from SI to the displayed unit, and this unit.
DISPLAY_UNITS = {
    "displacement": (1e3, "mm"),
    "acceleration": (1.0 / STANDARD_GRAVITY, "g"),
    "velocity": (1.0, "m/s"),
    "force": (1.0, "N"),
    "voltage": (1.0, "V"),
}


def plots(channels: Mapping[str, ChannelInfo]) -> list[tuple[str, str]]:
    """Return entity and title of the plot of each quantity that the channels measure."""
    present = {info.quantity for info in channels.values()}
    return [
        (f"channels/{quantity}", f"{quantity} / ({unit})" if "/" in unit else f"{quantity} / {unit}")
        for quantity, (_, unit) in DISPLAY_UNITS.items()
        if quantity in present
    ]


class CurveSender:
    """Sends curves of channels, gaps and contacts of the given dampers, and motion to a stream, on one timeline."""

    def __init__(
        self, stream: rr.RecordingStream, rate: float, channels: Mapping[str, ChannelInfo], dampers: Sequence[Damper]
    ) -> None:
        self._stream, self._rate, self._channels = stream, rate, channels
        self._last_contact: list[int] = [-1] * len(dampers)

        def curve_style(color: tuple[int, int, int], name: str) -> rr.SeriesLines:
            # By default, the viewer averages the samples in a pixel, so a tone of high frequency would vanish.
            return rr.SeriesLines(colors=[color], names=[name], widths=[1.2], aggregation_policy="MinMax")

        for name, info in channels.items():
            stream.log(channel_entity(info.quantity, name), curve_style(channel_color(info.at), name), static=True)
            envelope_style = rr.SeriesLines(colors=[channel_color(info.at)] * 2, names=[name] * 2, widths=[1.2] * 2)
            stream.log(rr.new_entity_path([ENVELOPE_ENTITY, name]), envelope_style, static=True)
        contact_style = rr.SeriesLines(widths=[12.0], aggregation_policy="Off", interpolation_mode="StepAfter")
        for number, damper in enumerate(dampers, start=1):
            style = curve_style(body_color(damper.body), f"damper {number} (body {damper.body})")
            stream.log(f"dampers/gap_mm/damper_{number}", style, static=True)
            stream.log(f"dampers/contact/damper_{number}", contact_style, static=True)

    def time_column(self, samples: NDArray[np.int64]) -> rr.TimeColumn:
        """Return the times of sample indices, counted from the start of the recording."""
        # Durations are far below 2^53 ns, up to which a double represents every nanosecond.
        nanoseconds = np.round(samples * (1e9 / self._rate)).astype("timedelta64[ns]")
        return rr.TimeColumn(TIMELINE, duration=nanoseconds)

    def send_channel(self, name: str, first: int, samples: NDArray[np.float64]) -> None:
        """Send the next samples of a channel, in its unit; the curve is interrupted at NaN."""
        quantity = self._channels[name].quantity
        times = self.time_column(np.arange(first, first + samples.size))
        columns = rr.Scalars.columns(scalars=samples * DISPLAY_UNITS[quantity][0])
        self._stream.send_columns(channel_entity(quantity, name), [times], columns)

    def send_envelope(self, name: str, first: int, samples: NDArray[np.float64], column: int) -> None:
        """Send minimum and maximum of each `column` samples of a channel with the quantity of the first plot."""
        info = self._channels[name]
        if not plots(self._channels)[0][0].endswith(f"/{info.quantity}"):
            return
        starts = np.arange(0, samples.size, column)
        ends = np.stack([extreme.reduceat(samples, starts) for extreme in (np.fmin, np.fmax)], axis=1)
        columns = rr.Scalars.columns(scalars=ends * DISPLAY_UNITS[info.quantity][0])
        self._stream.send_columns(
            rr.new_entity_path([ENVELOPE_ENTITY, name]), [self.time_column(first + starts)], columns
        )

    def send_dampers(self, first: int, gap: NDArray[np.float64], contact: NDArray[np.float64 | np.int8]) -> None:
        """Send the next samples of gaps [m] and contacts, both (dampers, samples); NaN where lost."""
        samples = np.arange(first, first + gap.shape[1])
        states = np.where(np.isnan(contact), CONTACTS.index("lost"), contact).astype(np.int8)
        for number in range(gap.shape[0]):
            columns = rr.Scalars.columns(scalars=1e3 * gap[number])
            self._stream.send_columns(f"dampers/gap_mm/damper_{number + 1}", [self.time_column(samples)], columns)
            previous = np.concatenate([self._last_contact[number : number + 1], states[number, :-1]])
            # The last sample ends the line. The viewer draws the line before a point in the color of the point.
            change_indices = np.union1d(np.nonzero(states[number] != previous)[0], states.shape[1] - 1)
            times = [self.time_column(samples[change_indices])]
            colors = np.array(CONTACT_COLORS, dtype=np.uint32)[previous[change_indices]]
            lane = np.full(change_indices.size, number + 1.0)
            lanes = [*rr.Scalars.columns(scalars=lane), *rr.SeriesLines.columns(colors=colors)]
            self._stream.send_columns(f"dampers/contact/damper_{number + 1}", times, lanes)
            self._last_contact[number] = int(states[number, -1])

    def send_motion(self, view: RigView, samples: NDArray[np.int64], motion: RigMotion) -> None:
        """Send the motion of the rig at the given sample indices."""
        if not samples.size:
            return
        times = [self.time_column(samples)]
        for path, translation, scale in view.moving_parts(motion):
            columns = rr.Transform3D.columns(translation=translation, scale=scale)
            self._stream.send_columns(path, times, columns)


def channel_entity(quantity: str, name: str) -> str:
    """Return the entity of a channel, escaped: its name may contain spaces and slashes."""
    return rr.new_entity_path(["channels", quantity, name])
