"""The stream to a viewer: channels, dampers and motion of the rig, segment by segment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from daq.drawing.palette import body_color, channel_color
from daq.viewing.blueprint import TIMELINE

if TYPE_CHECKING:
    from daq.drawing.rig_view import RigPose, RigView
    from daq.signal_chain.channel import ChannelInfo
    from rig.scene.damper import Damper

CONTACTS = ("flight", "floor", "ceiling", "lost")
CONTACT_COLORS = (0x3B82C4FF, 0x8A5A2BFF, 0xC4453BFF, 0x404040FF)
# Quantities in the order of the plots, with the factor to the shown unit.
DISPLAY_UNITS = {
    "displacement": (1e3, "mm"),
    "acceleration": (1.0, "m/s²"),
    "velocity": (1.0, "m/s"),
    "force": (1.0, "N"),
    "voltage": (1.0, "V"),
}


def plots(channels: Mapping[str, ChannelInfo]) -> list[tuple[str, str]]:
    """Entity and title of the plot of each quantity."""
    present = {info.quantity for info in channels.values()}
    return [(f"channels/{each}", f"{each} [{unit}]") for each, (_, unit) in DISPLAY_UNITS.items() if each in present]


class Traces:
    """Sends curves, motion, and gap and contact of the given dampers to a stream, on one timeline."""

    def __init__(
        self, stream: rr.RecordingStream, rate: float, channels: Mapping[str, ChannelInfo], dampers: Sequence[Damper]
    ) -> None:
        self._stream, self._rate, self._channels = stream, rate, channels
        self._contact: list[int] = [-1] * len(dampers)

        def curve(color: tuple[int, int, int], name: str) -> rr.SeriesLines:
            # By default the viewer averages the samples of a pixel, and a tone would vanish.
            return rr.SeriesLines(colors=[color], names=[name], widths=[1.2], aggregation_policy="MinMax")

        for name, info in channels.items():
            stream.log(entity(info.quantity, name), curve(channel_color(info.at), name), static=True)
        lane = rr.StateConfiguration(
            values=list(CONTACTS), labels=list(CONTACTS), colors=np.array(CONTACT_COLORS, dtype=np.uint32)
        )
        for place, damper in enumerate(dampers, start=1):
            style = curve(body_color(damper.body), f"damper {place} (body {damper.body})")
            stream.log(f"dampers/gap_mm/damper_{place}", style, static=True)
            stream.log(f"dampers/contact/damper_{place}", lane, static=True)

    def times(self, samples: NDArray[np.int64]) -> rr.TimeColumn:
        """Return the times of samples from the start of the recording."""
        # Durations stay far below the 2^53 ns up to which a double holds every nanosecond.
        nanoseconds = np.round(samples * (1e9 / self._rate)).astype("timedelta64[ns]")
        return rr.TimeColumn(TIMELINE, duration=nanoseconds)

    def channel(self, name: str, first: int, samples: NDArray[np.float64]) -> None:
        """Send the next samples of a channel, in its unit; NaN is a gap in the curve."""
        quantity = self._channels[name].quantity
        times = self.times(np.arange(first, first + samples.size))
        columns = rr.Scalars.columns(scalars=samples * DISPLAY_UNITS[quantity][0])
        self._stream.send_columns(entity(quantity, name), [times], columns)

    def dampers(self, first: int, gap: NDArray[np.float64], contact: NDArray[np.float64 | np.int8]) -> None:
        """Send the next samples of gaps [m] and contacts, both (dampers, samples); NaN where lost."""
        samples = np.arange(first, first + gap.shape[1])
        states = np.where(np.isnan(contact), CONTACTS.index("lost"), contact).astype(np.int8)
        for place in range(gap.shape[0]):
            columns = rr.Scalars.columns(scalars=1e3 * gap[place])
            self._stream.send_columns(f"dampers/gap_mm/damper_{place + 1}", [self.times(samples)], columns)
            before = np.concatenate([self._contact[place : place + 1], states[place, :-1]])
            changed = np.nonzero(states[place] != before)[0]
            if changed.size:
                new = rr.StateChange.columns(state=[CONTACTS[state] for state in states[place, changed]])
                at = [self.times(samples[changed])]
                self._stream.send_columns(f"dampers/contact/damper_{place + 1}", at, new)
            self._contact[place] = int(states[place, -1])

    def motion(self, view: RigView, samples: NDArray[np.int64], motion: RigPose) -> None:
        """Send the motion of the rig at some sample numbers."""
        if not samples.size:
            return
        times = [self.times(samples)]
        for path, translation, scale in view.moving_parts(motion):
            columns = rr.Transform3D.columns(translation=translation, scale=scale)
            self._stream.send_columns(path, times, columns)


def entity(quantity: str, name: str) -> str:
    """Return the path of a channel; its name may contain spaces and slashes."""
    return rr.new_entity_path(["channels", quantity, name])
