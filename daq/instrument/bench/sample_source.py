"""What stands behind the chassis: a source of samples that takes drives, and a scene's bench as one."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from fractions import Fraction
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from daq.excitation import Excitation as PlayedSignal
from daq.excitation import Station, excitation
from daq.instrument.bench.background_test import BackgroundTest
from daq.instrument.bench.input_stream import InputStream, at_rate
from daq.instrument.devices.modules import DIVIDED
from daq.instrument.devices.teds import with_sensitivity
from daq.instrument.errors import Code, DaqError
from daq.instrument.sample_clock import samples_per_tick
from daq.instrument.values import Coupling, Excitation
from daq.signal_chain.bench import AcquiredBlock, Bench
from daq.signal_chain.channel import ChannelInfo
from daq.signal_chain.converter import SampleClock
from daq.signal_chain.outputs import Outputs
from daq.signal_chain.oversampling import oversampling
from rig.scene.modules import module
from rig.scene.presets import filled_in, input_settings, needs_supply
from rig.scene.shaker import DRIVE_PER_VOLT
from rig.scene.teds import electronic_data_sheet
from rig.simulation.motion import Motion
from rig.simulation.plant import Plant

if TYPE_CHECKING:
    from daq.instrument.settings.channels import Channel
    from rig.scene.measurement_chain import Channel as WiredChannel
    from rig.scene.scene import Scene

# A rate that somebody asks for while the rig moves begins with filters that have seen this much of the motion, s.
_SETTLING = 2.0
# No more than so many ticks of it are kept: a stiff scene has a million a second.
_MOST_TICKS = 1 << 18


class SampleSource(Protocol):
    """What the chassis samples.

    Attributes
    ----------
    scene : Scene
        What a recording of it says it is of.
    rate : float
        Ticks per second: how finely outputs act, whatever the rates of those who sample.
    sample_rate : float
        Samples per second that it takes by itself.
    dtype : type
        Kind of its samples: volts, or counts of a converter.
    drive_per_volt : ndarray, shape (outputs,)
        What a volt at each output becomes.
    """

    scene: Scene
    rate: float
    sample_rate: float
    dtype: type[np.generic]
    drive_per_volt: NDArray[np.float64]

    @property
    def channels(self) -> Sequence[ChannelInfo]:
        """What is connected, at `sample_rate`."""

    def lost(self, rate: float) -> Sequence[tuple[int, int]]:
        """Give first and last sample of every stretch that is lost of the samples at a rate."""

    def horizon(self, ticks: int) -> int:
        """Cut a number of ticks at the end of what is known of the drive by itself."""

    def acquire(
        self, volts: NDArray[np.float64] | None, ticks: int, rates: Collection[float]
    ) -> Mapping[float, AcquiredBlock]:
        """Let ticks pass with volts at the outputs, shape (outputs, ticks); None: nobody drives them.

        Gives the samples at each of some rates, and at `sample_rate`. Sample n is taken n / rate seconds after
        power-on.
        """

    def leave_outputs(self) -> None:
        """Hear that somebody has taken an output."""

    @property
    def quiet(self) -> bool:
        """Whether nothing moves the bench but the outputs."""

    def wire(self, channels: Sequence[Channel], in_use: Collection[int]) -> None:
        """Set couplings and supplies as channels want them; with -50103 for those in use that have others."""

    def supply(self, row: int) -> float | None:
        """Give the current that feeds the sensor at a channel now, A; None where it needs none, or is fed somehow."""

    def data_sheet(self, row: int) -> bytes | None:
        """Give the electronic data sheet of the sensor at a channel; None if there is none to be read."""

    def filter_properties(self, row: int, rate: float | None) -> dict[str, Any]:
        """Give delay [s] of a channel's filter at a rate, and whether it is taken out."""


class SceneSource:
    """A scene's bench: one plant, and channels that are sampled at as many rates as there are.

    The plant ticks as finely as the fastest module needs. So neither its motion nor a sample depends on what else
    runs.

    Parameters
    ----------
    scene : Scene
        What is on the bench.

    Attributes
    ----------
    drive : ndarray, shape (inputs, samples)
        Drive of the latest ticks, at `sample_rate`.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        clock = SampleClock.of(scene.converter)
        self.sample_rate, ticks = clock.rate, _ticks_per_sample(scene)
        self.rate = clock.rate * ticks
        self._plant = Plant(scene, clock.true_rate * ticks)
        own = InputStream(scene, clock.rate, Fraction(1, ticks), self._plant)
        self._streams = {clock.rate: own}
        # The latest motion and forces, for rates that somebody asks for next.
        self._past: deque[tuple[Motion, NDArray[np.float64]]] = deque()
        self._line = Outputs(scene, self._plant.inputs, self._plant.drive_units)
        counts = bool(self.channels) and self.channels[0].volts_per_count is not None
        self.dtype: type[np.generic] = np.int32 if counts else np.float64
        inputs, units = self._plant.inputs, self._plant.drive_units
        self._outputs = [row for row, name in enumerate(inputs) if name != "hammer"]
        self.drive_per_volt = np.array([DRIVE_PER_VOLT[units[row]] for row in self._outputs])
        self._converter = filled_in(scene.converter)
        self._ticks = ticks
        self.drive = np.zeros((len(inputs), 0))
        self._test = BackgroundTest(
            Station(scene, own.channels, inputs, clock.rate, mark=lambda *given, **fields: None),
            ticks,
            own.physical,
        )

    @property
    def channels(self) -> Sequence[ChannelInfo]:
        """See `SampleSource.channels`."""
        return self._streams[self.sample_rate].channels

    @property
    def wiring(self) -> tuple[WiredChannel, ...]:
        """The channels of the scene as they are set now."""
        return self._streams[self.sample_rate].wiring

    def physical(self, samples: NDArray[Any]) -> NDArray[np.float64]:
        """Read samples in each channel's unit; see `InputStream.physical`."""
        return self._streams[self.sample_rate].physical(samples)

    def warm_up(self) -> None:
        """Have compiled what has to be, before time begins to run: reads would wait for it in vain."""
        Bench(self.scene).acquire(np.zeros((len(self._plant.inputs), 64)))

    def lost(self, rate: float) -> Sequence[tuple[int, int]]:
        """See `SampleSource.lost`."""
        return self._streams[rate].lost

    def horizon(self, ticks: int) -> int:
        """See `SampleSource.horizon`."""
        return self._test.horizon(ticks)

    def acquire(
        self, volts: NDArray[np.float64] | None, ticks: int, rates: Collection[float]
    ) -> Mapping[float, AcquiredBlock]:
        """See `SampleSource.acquire`."""
        wanted = {self.sample_rate, *rates}
        kept = {rate: self._streams.get(rate) for rate in wanted}
        self._streams = {rate: kept[rate] or self._stream(rate) for rate in sorted(wanted)}
        drive = self._test.drive(ticks).copy()
        if volts is not None and self._outputs:
            drive[self._outputs] = volts * self.drive_per_volt[:, None]
        drive = self._line.put_out(drive)
        motion = self._plant.advance(drive)
        self._past.append((motion, drive))
        self.drive = drive[:, -motion.first % self._ticks :: self._ticks]
        while motion.first - self._past[0][0].first > min(_SETTLING * self.rate, _MOST_TICKS):
            self._past.popleft()
        blocks = {rate: stream.take(motion, drive) for rate, stream in self._streams.items()}
        self._test.hear(blocks[self.sample_rate].samples, ticks)
        return blocks

    def _stream(self, rate: float) -> InputStream:
        """Begin to sample at a rate."""
        return InputStream(
            self.scene, rate, samples_per_tick(rate, self.rate), self._plant, self._past, self.wiring
        )

    def play(
        self,
        scene: Scene,
        position: int,
        mark: Callable[..., Any],
        report: Callable[[float, str], None],
        ended: Callable[[str], None],
        excite: Callable[[Station], PlayedSignal] = excitation,
    ) -> BackgroundTest:
        """Play the test of a scene once, from the first sample after `position` ticks; see `BackgroundTest`."""
        first = -(-position // self._ticks)
        own = self._streams[self.sample_rate]
        station = Station(scene, own.channels, self._plant.inputs, self.sample_rate, mark, report, now=first)
        self._test = BackgroundTest(
            station, self._ticks, own.physical, first * self._ticks - position, excite, ended
        )
        return self._test

    def leave_outputs(self) -> None:
        """See `SampleSource.leave_outputs`."""
        self._test.leave_shaker()

    @property
    def quiet(self) -> bool:
        """See `SampleSource.quiet`."""
        return self._test.quiet

    def wire(self, channels: Sequence[Channel], in_use: Collection[int]) -> None:
        """See `SampleSource.wire`."""
        wiring, taken = list(self.wiring), set(in_use)
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
        if wiring != list(self.wiring):
            for stream in self._streams.values():
                stream.rewire(wiring)

    def _supply(self, channel: Channel) -> float | None:
        """Give the current for a sensor, A; None where the scene leaves open what feeds it."""
        if self._converter.excitation is None:
            return None
        if channel.settings["ai_excit_src"] == Excitation.NONE:
            return 0.0
        return self._converter.excitation or channel.module.currents[0]

    def supply(self, row: int) -> float | None:
        """See `SampleSource.supply`."""
        channel = self.wiring[row]
        return input_settings(self.scene.converter, channel).excitation if needs_supply(channel) else None

    def data_sheet(self, row: int) -> bytes | None:
        """See `SampleSource.data_sheet`."""
        channel = self.wiring[row]
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


def _ticks_per_sample(scene: Scene) -> int:
    """Choose the ticks of the plant for each sample of the scene's own converter.

    As many as the fastest of its modules needs, and what it looks at in between (`oversampling`). Where modules divide
    one clock, all their samples then fall on ticks.
    """
    own, named = scene.converter.sample_rate, scene.converter.preset
    sheets = [None if shaker.output is None else shaker.output.preset for shaker in scene.shakers]
    inputs = None if named is None else module(named).inputs
    outputs = [None if name is None else module(name).outputs for name in sheets]
    fastest, *others = (
        DIVIDED.fastest if each is None else each.rates.fastest for each in (inputs, *outputs)
    )
    needed = [own * oversampling(scene, SampleClock.of(scene.converter)), *others]
    if fastest > own:
        fast = at_rate(scene, fastest)
        needed.append(fastest * oversampling(fast, SampleClock.of(fast.converter)))
    return math.ceil(max(needed) / own - 1e-6)
