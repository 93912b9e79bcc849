"""What stands behind the chassis: a source of samples that takes drives, and a scene's bench as one."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from daq.instrument.bench.background_test import BackgroundTest
from daq.instrument.devices.teds import with_sensitivity
from daq.instrument.errors import Code, DaqError
from daq.instrument.values import Coupling, Excitation
from daq.signal_chain.bench import AcquiredBlock, Bench
from daq.signal_chain.channel import ChannelInfo
from daq.signal_chain.decimation_filter import DELAY
from rig.errors import SceneError
from rig.scene.presets import filled_in, input_settings
from rig.scene.shaker import DRIVE_PER_VOLT
from rig.scene.teds import electronic_data_sheet

if TYPE_CHECKING:
    from daq.instrument.settings.channels import Channel
    from rig.scene.scene import Scene


class SampleSource(Protocol):
    """What the chassis samples.

    Attributes
    ----------
    scene : Scene
        What a recording of it says it is of.
    rate : float
        Ticks per second.
    dtype : type
        Kind of its samples: volts, or counts of a converter.
    drive_per_volt : ndarray, shape (outputs,)
        What a volt at each output becomes.
    sampling, delay
        How its converter takes samples, and by how many samples its filter lags, see `RateDivider`.
    """

    scene: Scene
    rate: float
    dtype: type[np.generic]
    drive_per_volt: NDArray[np.float64]
    sampling: Literal["point", "average", "filter"]
    delay: float

    @property
    def channels(self) -> Sequence[ChannelInfo]:
        """What is connected."""

    @property
    def lost(self) -> Sequence[tuple[int, int]]:
        """First and last sample of every stretch that is lost."""

    def horizon(self, samples: int) -> int:
        """Cut a number of ticks at the end of what is known of the drive by itself."""

    def acquire(self, volts: NDArray[np.float64] | None, samples: int) -> AcquiredBlock:
        """Let ticks pass with volts at the outputs, shape (outputs, samples); None: nobody drives them."""

    def leave_outputs(self) -> None:
        """Hear that somebody has taken an output."""

    def wire(self, channels: Sequence[Channel], in_use: Collection[int]) -> None:
        """Set couplings and supplies as channels want them; with -50103 for those in use that have others."""

    def data_sheet(self, row: int) -> bytes | None:
        """Give the electronic data sheet of the sensor at a channel; None if there is none to be read."""

    def filter_properties(self, row: int, rate: float | None) -> dict[str, Any]:
        """Give delay [s] of a channel's filter at a rate, and whether it is taken out."""


class SceneSource:
    """A scene's bench.

    Parameters
    ----------
    scene : Scene
        What is on the bench.
    rate : float or None
        Ticks per second, if not what the scene's converter makes.
    """

    def __init__(self, scene: Scene, rate: float | None) -> None:
        if rate is not None and rate != scene.converter.sample_rate:
            scene = _at_rate(scene, rate)
        self.scene = scene
        self.bench = Bench(scene)
        self.rate = self.bench.rate
        self.lost: Sequence[tuple[int, int]] = self.bench.lost
        counts = bool(self.channels) and self.channels[0].volts_per_count is not None
        self.dtype: type[np.generic] = np.int32 if counts else np.float64
        self._outputs = [row for row, name in enumerate(self.bench.inputs) if name != "hammer"]
        self.drive_per_volt = np.array([DRIVE_PER_VOLT[self.bench.drive_units[row]] for row in self._outputs])
        self._converter = filled_in(scene.converter)
        filtered = self._converter.filter is not None
        self.sampling: Literal["point", "average", "filter"] = (
            self.channels[0].sampling if self.channels else "filter" if filtered else "point"
        )
        self.delay = float(DELAY) if filtered and not self._converter.remove_delay else 0.0
        self._test = BackgroundTest(self.bench)

    @property
    def channels(self) -> Sequence[ChannelInfo]:
        """See `SampleSource.channels`."""
        return self.bench.channels

    def warm_up(self) -> None:
        """Have compiled what has to be, before time begins to run: reads would wait for it in vain."""
        Bench(self.scene).acquire(np.zeros((len(self.bench.inputs), 64)))

    def horizon(self, samples: int) -> int:
        """See `SampleSource.horizon`."""
        return self._test.horizon(samples)

    def acquire(self, volts: NDArray[np.float64] | None, samples: int) -> AcquiredBlock:
        """See `SampleSource.acquire`."""
        drive = self._test.drive(samples).copy()
        if volts is not None and self._outputs:
            drive[self._outputs] = volts * self.drive_per_volt[:, None]
        block = self.bench.acquire(drive)
        self._test.hear(block.samples, samples)
        return block

    def leave_outputs(self) -> None:
        """See `SampleSource.leave_outputs`."""
        self._test.leave_shaker()

    def wire(self, channels: Sequence[Channel], in_use: Collection[int]) -> None:
        """See `SampleSource.wire`."""
        wiring, taken = list(self.bench.wiring), set(in_use)
        for each in channels:
            before = wiring[each.row]
            wanted = before.replace(
                coupling=Coupling(each.settings["ai_coupling"]).name, excitation=self._supply(each)
            )
            here, there = (input_settings(self.scene.converter, one) for one in (before, wanted))
            if (here.coupling or "DC", here.excitation) == (there.coupling or "DC", there.excitation):
                continue
            if each.row in taken:
                raise DaqError(
                    f"the resource is reserved: {each.port.name} is in use with another coupling or sensor supply; "
                    "stop that task, or give both the same",
                    Code.PAL_RESOURCE_RESERVED,
                )
            wiring[each.row] = wanted
            taken.add(each.row)
        self.bench.rewire(wiring)

    def _supply(self, channel: Channel) -> float | None:
        """Give the current for a sensor, A; None where the scene leaves open what feeds it."""
        if self._converter.excitation is None:
            return None
        if channel.settings["ai_excit_src"] == Excitation.NONE:
            return 0.0
        return self._converter.excitation or channel.module.currents[0]

    def data_sheet(self, row: int) -> bytes | None:
        """See `SampleSource.data_sheet`."""
        channel = self.bench.wiring[row]
        sheet = None if channel.integrator else electronic_data_sheet(channel, self.scene.seed)
        if sheet is None:
            return None
        return with_sensitivity(sheet.bits, sheet.template, self.channels[row].sensitivity)

    def filter_properties(self, row: int, rate: float | None) -> dict[str, Any]:
        """See `SampleSource.filter_properties`."""
        info = self.channels[row]
        delay = info.delay * (info.rate / rate if rate and info.filter else 1.0)
        return {
            "ai_filter_delay": delay + (0.5 / (rate or info.rate) if info.average else 0.0),
            "ai_remove_filter_delay": self._converter.remove_delay,
        }


def _at_rate(scene: Scene, rate: float) -> Scene:
    """Change a scene's sample rate; its test stays away where samples at that rate cannot tell its tones."""
    converter = scene.converter.replace(rate=rate)
    try:
        return scene.replace(converter=converter)
    except SceneError as error:
        quiet = scene.replace(converter=converter, test=None)
        warnings.warn(
            f"the test of scene {scene.name!r} cannot be played, the bench stays quiet until a script drives it: "
            f"{error}",
            RuntimeWarning,
            stacklevel=2,
        )
        return quiet
