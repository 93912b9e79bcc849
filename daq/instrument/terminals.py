"""The terminals of a scene's bench: output voltages, settings of its inputs, and the test of the scene."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from daq.excitation import Excitation as PlayedSignal
from daq.excitation import Station, excitation
from daq.instrument.background_test import BackgroundTest
from daq.instrument.devices.modules import DIVIDED
from daq.instrument.devices.teds import with_sensitivity
from daq.instrument.errors import Code, DaqError
from daq.instrument.values import Coupling, Excitation
from daq.signal_chain.oversampling import oversampling
from daq.virtual_bench.bench import Bench, at_rate
from rig.progress import FractionProgress
from rig.scene.modules import module
from rig.scene.presets import complete_from_preset, input_settings, needs_supply
from rig.scene.shaker import DRIVE_PER_VOLT
from rig.scene.teds import electronic_data_sheet

if TYPE_CHECKING:
    from daq.instrument.settings.channels import Channel
    from daq.virtual_bench.bench import Block
    from rig.scene.scene import Scene


class Terminals:
    """The interface between a bench and its instrument.

    The time step of the plant suits the fastest module, so that neither the motion nor a sample depends on the
    running tasks.

    `drive_per_volt`, shape (outputs,): drive per volt at each output; `dtype`: type of the samples: volts, or counts
    of a converter.
    """

    def __init__(self, scene: Scene) -> None:
        # Ticks per sample of the converter that suit the fastest rate of each module and the intervals that its
        # converter needs: where modules divide one clock, all their samples then coincide with ticks.
        sample_rate, named = scene.converter.sample_rate, scene.converter.preset
        sheets = [None if shaker.output is None else shaker.output.preset for shaker in scene.shakers]
        inputs = None if named is None else module(named).inputs
        outputs = [None if name is None else module(name).outputs for name in sheets]
        fastest, *others = (DIVIDED.fastest if each is None else each.rates.fastest for each in (inputs, *outputs))
        needed = [sample_rate * oversampling(scene), *others]
        if fastest > sample_rate:
            needed.append(fastest * oversampling(at_rate(scene, fastest)))
        self.bench = bench = Bench(scene, math.ceil(max(needed) / sample_rate - 1e-6))
        counts = bool(bench.channels) and bench.channels[0].volts_per_count is not None
        self.dtype: type[np.generic] = np.int32 if counts else np.float64
        self._outputs = [row for row, name in enumerate(bench.inputs) if name != "hammer"]
        self.drive_per_volt = np.array([DRIVE_PER_VOLT[bench.drive_units[row]] for row in self._outputs])
        self._converter = complete_from_preset(scene.converter)
        station = Station(scene, bench.channels, bench.inputs, bench.rate, mark=lambda *arguments, **fields: None)
        self._test = BackgroundTest(station, bench.ticks, bench.physical)

    def warm_up(self) -> None:
        """Compile the kernels before the clock starts, so that no read waits for them."""
        Bench(self.bench.scene).acquire(np.zeros((len(self.bench.inputs), 64)))

    # Time

    def horizon(self, ticks: int) -> int:
        """Limit a number of ticks to the known drive of the test."""
        return self._test.horizon(ticks)

    def advance(self, volts: NDArray[np.float64] | None, ticks: int, rates: Collection[float]) -> Mapping[float, Block]:
        """Advance the bench with output voltages, shape (outputs, ticks), or with the test alone for None.

        The samples are those of `Bench.advance`.
        """
        drive = self._test.drive(ticks).copy()
        if volts is not None and self._outputs:
            drive[self._outputs] = volts * self.drive_per_volt[:, None]
        blocks = self.bench.advance(drive, rates)
        self._test.add_readings(blocks[self.bench.rate].samples, ticks)
        return blocks

    # The test

    def play(
        self,
        scene: Scene,
        position: int,
        mark: Callable[..., Any],
        report: FractionProgress,
        ended: Callable[[str], None],
        excite: Callable[[Station], PlayedSignal] = excitation,
    ) -> BackgroundTest:
        """Play the test of a scene once, from the first sample after `position` ticks; see `BackgroundTest`."""
        bench = self.bench
        first = -(-position // bench.ticks)
        station = Station(scene, bench.channels, bench.inputs, bench.rate, mark, report, now=first)
        lead = first * bench.ticks - position
        self._test = BackgroundTest(station, bench.ticks, bench.physical, lead, excite, ended)
        return self._test

    def release_outputs(self) -> None:
        """End the drive of the test because a task has taken an output."""
        self._test.release_outputs()

    @property
    def quiet(self) -> bool:
        """Whether the test drives no output."""
        return self._test.quiet

    # Inputs

    def wire(self, channels: Sequence[Channel], in_use: Collection[int]) -> None:
        """Set couplings and supplies for a task's channels.

        Raises `DaqError` with -50103 for an input in use that has another coupling or supply.
        """
        wiring, used = list(self.bench.wiring), set(in_use)
        for each in channels:
            before = wiring[each.row]
            # The supply current, A; None if the scene does not model the supply.
            supply = self._converter.excitation
            if supply is not None and each.settings["ai_excit_src"] == Excitation.NONE:
                supply = 0.0
            elif supply is not None:
                supply = supply or each.module.currents[0]
            coupling = Coupling(each.settings["ai_coupling"]).name
            requested = before.replace(coupling=coupling, excitation=supply)
            present, new = (input_settings(self.bench.scene.converter, wired) for wired in (before, requested))
            if (present.coupling or "DC", present.excitation) == (new.coupling or "DC", new.excitation):
                continue
            if each.row in used:
                raise DaqError(
                    f"the resource is reserved: {each.port.name} is in use with another coupling or sensor supply. "
                    "Stop that task, or use the same settings.",
                    Code.PAL_RESOURCE_RESERVED,
                )
            wiring[each.row] = requested
            used.add(each.row)
        self.bench.rewire(wiring)

    def supply(self, row: int) -> float | None:
        """Return the present supply current of a channel's sensor, A; None if not needed or not modeled."""
        channel = self.bench.wiring[row]
        return input_settings(self.bench.scene.converter, channel).excitation if needs_supply(channel) else None

    def data_sheet(self, row: int) -> bytes | None:
        """Return the electronic data sheet of a channel's sensor; None without a readable data sheet."""
        channel = self.bench.wiring[row]
        sheet = None if channel.integrator else electronic_data_sheet(channel, self.bench.scene.seed)
        if sheet is None:
            return None
        return with_sensitivity(sheet.bits, sheet.template, self.bench.channels[row].sensitivity)

    def filter_properties(self, row: int, rate: float | None) -> dict[str, Any]:
        """Return the delay [s] of a channel's filter at a rate, and whether the scene removes it."""
        info = self.bench.channels[row]
        delay = info.delay * (info.rate / rate if rate and info.filter else 1.0)
        return {
            "ai_filter_delay": delay + (0.5 / (rate or info.rate) if info.average else 0.0),
            "ai_remove_filter_delay": self._converter.remove_delay,
        }
