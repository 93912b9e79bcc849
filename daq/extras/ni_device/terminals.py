"""Connection of the bench of a scene to the instrument: output voltages, input conditioning, and the scene's test.

Conditioning is the coupling (AC or DC) of an input and the supply current of its sensor.
"""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.core.excitation import Excitation as TestExcitation
from daq.core.excitation import Station, excitation
from daq.core.signal_chain.oversampling import choose_oversampling
from daq.core.virtual_bench.bench import Bench, Block
from daq.extras.ni_device.background_test import BackgroundTest
from daq.extras.ni_device.devices.modules import DEFAULT_RATES
from daq.extras.ni_device.devices.sensor_teds import electronic_data_sheet
from daq.extras.ni_device.devices.teds import with_sensitivity
from daq.extras.ni_device.errors import Code, DaqError
from daq.extras.ni_device.settings.channels import Channel
from daq.extras.ni_device.values import Coupling, Excitation
from rig.core.base.progress import FractionProgress
from rig.core.data_sheets.modules import module
from rig.core.scene.measurement_chain import Channel as SceneChannel
from rig.core.scene.presets import complete_from_preset, input_settings, needs_supply
from rig.core.scene.scene import Scene
from rig.core.scene.shaker import DRIVE_PER_VOLT

# Frequency of the sync output of the bench, which is connected to all PFI terminals [Hz].
_SYNC_HZ = 1.0
# Maximum number of ticks in a step of the bench: the overhead of a step is negligible, and responses are quick.
_MAX_BLOCK_TICKS = 4096


class Terminals:
    """The interface between a bench and its instrument.

    The tick is short enough for the fastest module. The motion and the samples therefore do not depend on which tasks
    run.
    """

    def __init__(self, scene: Scene) -> None:
        # The tick rate is the smallest multiple of the converter's rate that is at least the fastest rate of each
        # module and the rate for oversampling. Samples of modules that divide one clock then coincide with ticks.
        sample_rate, input_preset = scene.converter.sample_rate, scene.converter.preset
        output_presets = [None if shaker.output is None else shaker.output.preset for shaker in scene.shakers]
        inputs = None if input_preset is None else module(input_preset).inputs
        outputs = [None if preset is None else module(preset).outputs for preset in output_presets]
        fastest_input, *fastest_outputs = (
            DEFAULT_RATES.fastest if ports is None else ports.rates.fastest for ports in (inputs, *outputs)
        )
        min_tick_rates = [sample_rate * choose_oversampling(scene), *fastest_outputs]
        if fastest_input > sample_rate:
            min_tick_rates.append(
                fastest_input * choose_oversampling(scene, scene.converter.replace(rate=fastest_input))
            )
        self.bench = bench = Bench(scene, math.ceil(max(min_tick_rates) / sample_rate - 1e-6))
        has_counts = bool(bench.channels) and bench.channels[0].volts_per_count is not None
        self.dtype: type[np.generic] = np.int32 if has_counts else np.float64  # type of the samples: counts or volts
        # Indices of the outputs among the inputs of the rig, to which the hammer also belongs.
        self._outputs = [index for index, name in enumerate(bench.inputs) if name != "hammer"]
        # Factor from output voltage to drive [N, m or V], shape (outputs,).
        self.drive_per_volt = np.array([DRIVE_PER_VOLT[bench.drive_units[index]] for index in self._outputs])
        self._converter = complete_from_preset(scene.converter)
        station = Station(scene, bench.channels, bench.inputs, bench.rate, mark=lambda *arguments, **fields: None)
        self._test = BackgroundTest(station, bench.ticks_per_sample, bench.to_units)

    def warm_up(self) -> None:
        """Compile the kernels before the clock starts so that no read waits for them."""
        Bench(self.bench.scene).acquire(np.zeros((len(self.bench.inputs), 64)))

    # Time

    def limit_ticks(self, ticks: int) -> int:
        """Limit a number of ticks to the ticks for which the drive of the test is already known, and to a block."""
        return self._test.limit_ticks(min(ticks, _MAX_BLOCK_TICKS))

    def advance(self, volts: NDArray[np.float64] | None, ticks: int, rates: Collection[float]) -> Mapping[float, Block]:
        """Advance the bench and return its samples by rate; see `Bench.advance`.

        `volts` are the voltages of the outputs, shape (outputs, ticks); if None, the test drives the outputs.
        """
        drive = self._test.drive(ticks).copy()
        if volts is not None and self._outputs:
            drive[self._outputs] = volts * self.drive_per_volt[:, None]
        blocks = self.bench.advance(drive, rates)
        self._test.add_readings(blocks[self.bench.rate].samples, ticks)
        return blocks

    # The test

    def run_test(
        self,
        scene: Scene,
        position: int,
        mark: Callable[..., Any],
        report: FractionProgress,
        on_end: Callable[[str], None],
        make_excitation: Callable[[Station], TestExcitation] = excitation,
    ) -> BackgroundTest:
        """Run the test of a scene from `position` ticks on, with markers and progress; see `BackgroundTest`."""
        bench = self.bench
        first_sample = -(-position // bench.ticks_per_sample)  # rounded up
        station = Station(scene, bench.channels, bench.inputs, bench.rate, mark, report, now=first_sample)
        lead_ticks = first_sample * bench.ticks_per_sample - position
        self._test = BackgroundTest(
            station, bench.ticks_per_sample, bench.to_units, lead_ticks, make_excitation, on_end
        )
        return self._test

    def release_outputs(self) -> None:
        """End the test because a task uses an output; see `BackgroundTest.release_outputs`."""
        self._test.release_outputs()

    @property
    def is_idle(self) -> bool:
        """Whether no test is running."""
        return self._test.is_idle

    # Inputs

    def set_conditioning(self, channels: Sequence[Channel], in_use: Collection[int]) -> None:
        """Set the couplings and sensor supplies of a task's channels.

        `in_use` are the indices of the inputs that other tasks are reading. Raises `DaqError` -50103 if one of these
        inputs has a different coupling or supply.
        """
        scene_channels, fixed = list(self.bench.channel_settings), set(in_use)
        for channel in channels:
            supply = self._converter.excitation  # current, A; None if the scene does not model the supply
            if supply is not None and channel.settings["ai_excit_src"] == Excitation.NONE:
                supply = 0.0
            elif supply is not None:
                supply = supply or channel.module.currents[0]
            present = scene_channels[channel.bench_index]
            coupling = Coupling(channel.settings["ai_coupling"]).name
            requested = present.replace(coupling=coupling, excitation=supply)
            if self._conditioning(requested) == self._conditioning(present):
                continue
            if channel.bench_index in fixed:
                raise DaqError(
                    f"{channel.port.name} is in use with a different coupling or sensor supply. Stop the task that "
                    "uses it, or choose the same settings.",
                    Code.PAL_RESOURCE_RESERVED,
                )
            scene_channels[channel.bench_index] = requested
            fixed.add(channel.bench_index)
        self.bench.set_conditioning(scene_channels)

    def _conditioning(self, scene_channel: SceneChannel) -> tuple[str, float | None]:
        """Return coupling and supply current (A) of a channel, by default those of the converter."""
        settings = input_settings(self.bench.scene.converter, scene_channel)
        return settings.coupling or "DC", settings.excitation

    def supply(self, bench_index: int) -> float | None:
        """Return the present supply current of a channel's sensor [A]; None if not needed or not modeled."""
        channel = self.bench.channel_settings[bench_index]
        return self._conditioning(channel)[1] if needs_supply(channel) else None

    def teds(self, bench_index: int) -> bytes | None:
        """Return the TEDS (electronic data sheet) of a channel's sensor; None if the input cannot read TEDS."""
        channel = self.bench.channel_settings[bench_index]
        sheet = None if channel.integrator else electronic_data_sheet(channel, self.bench.scene.seed)
        if sheet is None:
            return None
        return with_sensitivity(sheet.bits, sheet.template, self.bench.channels[bench_index].sensitivity)

    def pulse_frequency(self, owner: str, terminal: str) -> float:
        """Return the frequency of the pulses at a terminal such as pfi0 of a chassis or device [Hz]; 0 without."""
        return _SYNC_HZ

    def filter_properties(self, bench_index: int, rate: float | None) -> dict[str, Any]:
        """Return NI's filter properties of a channel at a rate in S/s: the delay in s, and whether it is removed."""
        info = self.bench.channels[bench_index]
        delay = info.delay * (info.rate / rate if rate and info.filter else 1.0)
        return {
            "ai_filter_delay": delay + (0.5 / (rate or info.rate) if info.average else 0.0),
            "ai_remove_filter_delay": self._converter.remove_delay,
        }
