"""Signal path of one channel, from the input to the converter."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from daq.dsp.block_buffers import BlockBuffers
from daq.dsp.circuit import INTEGRATION, Circuit
from daq.dsp.discretisation import Entry, Tables, discretise
from daq.dsp.disturbances import Disturbance, Disturbances, Offset, SettlingOffset
from daq.dsp.interpolation import CubicInput
from daq.dsp.limiting import limits_of
from daq.dsp.noise import FastNoise, Noise, generator
from daq.dsp.propagation import propagate, scratch_for
from daq.dsp.skew import Delay
from daq.signal_chain.converter import SampleClock
from daq.signal_chain.decimation_filter import DELAY, Decimation
from daq.signal_chain.overloads import Overloads
from daq.signal_chain.sampling import AverageSampler, FilteredSampler, Jitter, PointSampler, Sampler
from daq.signal_chain.stage import Stage, is_averaged
from rig.scene.measurement_chain import Converter

Array = NDArray[np.float64]

# Polynomials per sample that noise behind a filter is made of: see `FastNoise`.
NOISE_TERMS = 3


class SignalPath:
    """Sensor, amplifier, coupling and sampling of one channel, sampled late by `delay` in s.

    The limits of sensor and amplifier act on the signal itself, in front of filter and samples.
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
        sections = [section for stage in stages for section in stage.sections]
        circuit = Circuit.series(sections)
        sensor, rate = stages[0], clock.true_rate * oversampling
        gain = sensor.nominal * (1.0 + sensor.deviation)
        # The filter delays by whole intervals.
        late = int(delay * rate)
        filtered, self._oversampling, self._interval = converter.filter is not None, oversampling, 0
        self._reading = _reading(stages, circuit, gain, converter, clock, oversampling, late, buffers)
        entries, sources = _disturbances(stages, name, clock.true_rate, seed, filtered)
        self.noise_states = sum(source.states for source in sources if isinstance(source, Noise))
        direct = np.array([0.0 if filtered else circuit.d[entry.section] for entry in entries])
        self._disturbances = Disturbances(sources, direct, [entry.degree for entry in entries], oversampling)
        self._tables = _tables(circuit, gain, rate, self._reading.integrals, entries)
        limited = len(sensor.sections)
        self._limits = limits_of(
            sections, limited, sensor.limit, _rails(stages), gain, rate, entries, self._tables
        )
        self._state, self._scratch = np.zeros(circuit.c.size), scratch_for(self._tables)
        self._overloads = Overloads(stages, rate, self._reading.intervals)
        self._rows, self._rows_input = self._reading.rows, self._reading.rows_input

        share = delay * rate - late
        self._delay = Delay(share) if share else None
        self._jitter = None
        if converter.jitter:
            wait = DELAY if filtered else 0
            self._jitter = Jitter(circuit, gain, converter.jitter * clock.true_rate, wait)
            self._rows = np.concatenate([self._rows, self._jitter.row[None]])
            self._rows_input = np.append(self._rows_input, self._jitter.row_input)
        self._rows_excess = np.full(len(self._rows), -circuit.d[limited])
        self._noise = None
        if converter.noise is not None:
            random = generator(seed, name, "converter noise")
            self._noise = Noise(converter.noise, None, clock.true_rate, random)

    def measure(self, pieces: CubicInput, late: Array | None) -> tuple[Array, NDArray[np.bool_]]:
        """Return the volts at the samples that end intervals of a block, and where a limit has affected them.

        `late` is the lateness of each sample, in standard deviations of the jitter.
        """
        if self._delay is not None:
            pieces = self._delay.shift(pieces)
        intervals = pieces.smooth.shape[1]
        ends = slice(-self._interval % self._oversampling, intervals, self._oversampling)
        self._interval += intervals
        held = self._disturbances.hold(intervals)
        points = np.empty((self._rows_input.size, intervals))
        propagate(
            pieces, self._tables, self._limits, self._state, held, self._rows, self._rows_input,
            self._rows_excess, points, self._reading.place(intervals), self._overloads.place(intervals),
            self._scratch,
        )  # fmt: skip
        volts = self._reading.read(points, ends)
        self._disturbances.add_direct(held[:, ends], volts)
        if self._jitter is not None and late is not None:
            volts += self._jitter.error(points[-1, ends], late)
        if self._noise is not None:
            noise = np.empty(volts.size)
            self._noise.fill(noise)
            volts += noise
        return volts, self._overloads.flags(ends)


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
    return PointSampler(circuit, gain, oversampling, late)


def _rails(stages: Sequence[Stage]) -> Array:
    """Return the largest voltage of each state."""
    rails: list[float] = []
    for stage in stages:
        limit = np.inf if stage.rails is None else stage.rails
        for section in stage.sections:
            rails += [limit if section.name == INTEGRATION else np.inf] * section.states
    return np.array(rails)


# Tables by the circuit's content: channels with equal data sheets, and further benches of a scene, share them.
_CACHE: dict[tuple[object, ...], Tables] = {}
_MOST_TABLES = 64


def _tables(circuit: Circuit, gain: float, rate: float, integrals: int, entries: Sequence[Entry]) -> Tables:
    """Discretise a circuit, or take the tables of an equal one."""
    matrices = (np.asarray(each).tobytes() for each in (circuit.a, circuit.b, circuit.c, circuit.d))
    key = (*matrices, np.asarray(circuit.sections).tobytes(), gain, rate, integrals, tuple(entries))
    if key not in _CACHE:
        if len(_CACHE) >= _MOST_TABLES:
            _CACHE.clear()
        _CACHE[key] = discretise(circuit, gain, rate, integrals, entries)
    return _CACHE[key]


def _disturbances(
    stages: Sequence[Stage], channel: str, rate: float, seed: int, filtered: bool
) -> tuple[list[Entry], list[Disturbance]]:
    """List the disturbances and where each enters."""
    entries: list[Entry] = []
    sources: list[Disturbance] = []
    behind = 0
    for stage in stages:
        behind += len(stage.sections)
        if stage.noise is not None:
            noise, corner, name = stage.noise, stage.noise_corner, stage.name + " noise"
            sources.append(Noise(noise, corner, rate, generator(seed, channel, name)))
            terms = NOISE_TERMS if filtered else 1
            for degree in range(1, terms):
                random = generator(seed, channel, f"{name} {degree}")
                sources.append(FastNoise(noise, corner, rate, random, degree))
            entries += [Entry(behind, degree, filtered) for degree in range(terms)]
        if stage.offset is not None:
            settling = stage.settling
            sources.append(
                Offset(stage.offset) if settling is None else SettlingOffset(stage.offset, settling, rate)
            )
            entries.append(Entry(behind, 0, filtered))
    return entries, sources
