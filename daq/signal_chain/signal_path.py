"""One channel's way from the input to the converter."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from daq.dsp.block_buffers import BlockBuffers
from daq.dsp.circuit import INTEGRATION, Circuit
from daq.dsp.discretisation import discretise
from daq.dsp.disturbances import Disturbance, Disturbances, Offset, SettlingOffset, Zero
from daq.dsp.interpolation import CubicInput
from daq.dsp.noise import Noise, generator
from daq.dsp.propagation import propagate, scratch_for
from daq.dsp.skew import Delay
from daq.signal_chain.converter import SampleClock
from daq.signal_chain.decimation_filter import DELAY, Decimation
from daq.signal_chain.sampling import AverageSampler, FilteredSampler, Jitter, PointSampler, Sampler
from daq.signal_chain.stage import Stage, is_averaged
from rig.scene.measurement_chain import Converter

Array = NDArray[np.float64]


class SignalPath:
    """Sensor, amplifier, coupling and sampling of one channel.

    Limits act at the samples: where the signal's average over an interval exceeds what a sensor can follow,
    what it lacks is taken away from everything behind the sensor over that interval; a voltage in an
    amplifier is cut back at the sample that finds it beyond its rails.

    Parameters
    ----------
    stages : sequence of Stage
        Sensor first.
    oversampling : int
        Intervals of the input per sample.
    delay : float
        Delay of what is sampled, s.
    buffers : BlockBuffers
        That it shares with the other channels.
    """

    def __init__(
        self,
        name: str,
        stages: Sequence[Stage],
        converter: Converter,
        clock: SampleClock,
        oversampling: int,
        delay: float,
        seed: int,
        buffers: BlockBuffers,
    ) -> None:
        circuit = Circuit.series([section for stage in stages for section in stage.sections])
        sensor, rate = stages[0], clock.true_rate * oversampling
        gain = sensor.nominal * (1.0 + sensor.deviation)
        # Whole intervals of a delay are the filter's business.
        late = int(delay * rate)
        self._reading = _reading(stages, circuit, gain, converter, clock, oversampling, late, buffers)
        entries, sources = _disturbances(stages, name, clock.true_rate, seed)
        watched, filtered, direct = None, [False] * len(entries), circuit.d[entries]
        if sensor.limit is not None:
            # What a limit takes away, the first of these, is averaged and filtered like the signal itself.
            watched, filtered[0], direct[0] = Circuit.series(sensor.sections), True, 0.0
        self._tables = discretise(circuit, gain, rate, self._reading.integrals, watched, entries, filtered)
        self._state, self._scratch = np.zeros(circuit.c.size), scratch_for(self._tables)
        self._rails, self._overload = _rails(stages), _overload(sensor, rate)
        self._shift = np.zeros(min(1, self._overload.size))
        self._rows, self._rows_input = self._reading.rows, self._reading.rows_input

        share = delay * rate - late
        self._delay = Delay(share) if share else None
        wait = DELAY if converter.filter is not None else 0
        self._disturbances = Disturbances(sources, direct, oversampling, wait)
        self._jitter = None
        if converter.jitter:
            self._jitter = Jitter(circuit, gain, converter.jitter * clock.true_rate, wait)
            self._rows = np.concatenate([self._rows, self._jitter.row[None]])
            self._rows_input = np.append(self._rows_input, self._jitter.row_input)
        self._noise = None
        if converter.noise is not None:
            random = generator(seed, name, "converter noise")
            self._noise = Noise(converter.noise, None, clock.true_rate, random)

    def measure(self, pieces: CubicInput, late: Array | None) -> Array:
        """Give the volts at the samples that end the intervals of a block.

        Parameters
        ----------
        late : ndarray, shape (samples,), or None
            How late each sample is taken, in standard deviations of the jitter.

        Returns
        -------
        ndarray, shape (samples,)
            V.
        """
        if self._delay is not None:
            pieces = self._delay.shift(pieces)
        intervals = pieces.smooth.shape[1]
        held = self._disturbances.hold(intervals)
        points = np.empty((self._rows_input.size, intervals))
        propagate(
            pieces, self._tables, self._state, held, self._rails, self._overload, self._shift,
            self._rows, self._rows_input, points, self._reading.place(intervals), self._scratch,
        )  # fmt: skip
        ends = self._disturbances.ends
        volts = self._reading.read(points, ends)
        volts += self._disturbances.reach_output(held[:, ends])
        if self._jitter is not None and late is not None:
            volts += self._jitter.error(points[-1, ends], late)
        if self._noise is not None:
            noise = np.empty(volts.size)
            self._noise.fill(noise)
            volts += noise
        return volts


def _reading(
    stages: Sequence[Stage],
    circuit: Circuit,
    gain: float,
    converter: Converter,
    clock: SampleClock,
    oversampling: int,
    late: int,
    buffers: BlockBuffers,
) -> Sampler:
    if converter.filter is not None:
        return FilteredSampler(circuit, Decimation.standard(clock.rate), oversampling, late, buffers)
    if is_averaged(stages, converter):
        return AverageSampler(circuit, oversampling, late, buffers)
    return PointSampler(circuit, gain, late)


def _overload(sensor: Stage, rate: float) -> Array:
    """Describe a sensor's limit: see `propagate`."""
    if sensor.limit is None:
        return np.zeros(0)
    if not sensor.recovery:
        return np.array([sensor.limit, 0.0, 0.0])
    left = float(np.exp(-1.0 / (sensor.recovery * rate)))
    return np.array([sensor.limit, left, 1.0 - left])


def _rails(stages: Sequence[Stage]) -> Array:
    """Give the voltage that each state cannot exceed."""
    rails: list[float] = []
    for stage in stages:
        for section in stage.sections:
            limited = stage.rails is not None and section.name == INTEGRATION
            rails += [stage.rails if limited and stage.rails is not None else np.inf] * section.states
    return np.array(rails)


def _disturbances(
    stages: Sequence[Stage], channel: str, rate: float, seed: int
) -> tuple[list[int], list[Disturbance]]:
    """List the disturbances, each with the section in front of which it enters.

    What a limit takes away comes first.
    """
    entries: list[int] = []
    sources: list[Disturbance] = []
    behind = 0
    for stage in stages:
        behind += len(stage.sections)
        found: list[Disturbance] = []
        if stage.limit is not None:
            found.append(Zero())
        if stage.noise is not None:
            found.append(
                Noise(stage.noise, stage.noise_corner, rate, generator(seed, channel, stage.name + " noise"))
            )
        if stage.offset is not None and stage.settling is not None:
            found.append(SettlingOffset(stage.offset, stage.settling, rate))
        elif stage.offset is not None:
            found.append(Offset(stage.offset))
        entries += [behind] * len(found)
        sources += found
    return entries, sources
