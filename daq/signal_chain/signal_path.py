"""Signal path of one channel, from the input to the converter."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from daq.dsp.block_buffers import BlockBuffers
from daq.dsp.circuit import INTEGRATION, RECOVERY, Circuit
from daq.dsp.discretisation import Entry, Tables, discretise
from daq.dsp.disturbances import Disturbance, Disturbances, Offset
from daq.dsp.interpolation import CubicInput
from daq.dsp.limiting import limits_of
from daq.dsp.noise import FastNoise, Noise, generator
from daq.dsp.propagation import propagate, scratch_for
from daq.dsp.skew import Delay
from daq.signal_chain.decimation_filter import DELAY, Decimation
from daq.signal_chain.sampling import AverageSampler, FilteredSampler, Jitter, PointSampler, Sampler
from daq.signal_chain.stage import Stage, is_averaged
from rig.arrays import Array
from rig.scene.measurement_chain import Converter

# Polynomials per sample that noise behind a filter is made of: see `FastNoise`.
NOISE_TERMS = 3
# Share of the limit below which the shift of zero after an overload is negligible: the last digit of a data sheet.
NEGLIGIBLE_ZERO_SHIFT = 1e-3


class SignalPath:
    """Sensor, amplifier, coupling and sampling of one channel, sampled late by `delay` in s.

    The limits of sensor and amplifier act on the signal itself, in front of filter and samples.
    """

    def __init__(
        self,
        name: str,
        stages: Sequence[Stage],
        converter: Converter,
        oversampling: int,
        delay: float,
        seed: int,
        buffers: BlockBuffers,
    ) -> None:
        sections = [section for stage in stages for section in stage.sections]
        circuit = Circuit.series(sections)
        sensor, sample_rate = stages[0], converter.true_rate
        rate, gain = sample_rate * oversampling, sensor.nominal * (1.0 + sensor.deviation)
        # The filter delays by whole intervals.
        late = int(delay * rate)
        filtered, self._oversampling, self._interval = converter.filter is not None, oversampling, 0
        self._reading: Sampler
        if filtered:
            low_pass = Decimation.standard(converter.sample_rate)
            self._reading = FilteredSampler(circuit, low_pass, oversampling, late, buffers)
        elif is_averaged(stages, converter):
            self._reading = AverageSampler(circuit, oversampling, late, buffers)
        else:
            self._reading = PointSampler(circuit, gain, oversampling, late)
        entries, sources = _disturbances(stages, name, sample_rate, seed, filtered)
        self.noise_states = sum(source.states for source in sources if isinstance(source, Noise))
        direct = np.array([0.0 if filtered else circuit.d[entry.section] for entry in entries])
        self._disturbances = Disturbances(sources, direct, [entry.degree for entry in entries], oversampling)
        self._tables = _tables(circuit, gain, rate, self._reading.integrals, entries)
        # The largest voltage of each state.
        rails: list[float] = []
        for stage in stages:
            limit = np.inf if stage.rails is None else stage.rails
            for section in stage.sections:
                rails += [limit if section.name == INTEGRATION else np.inf] * section.states
        limited = len(sensor.sections)
        self._limits = limits_of(
            sections, limited, sensor.limit, np.array(rails), gain, rate, entries, self._tables
        )
        self._state, self._scratch = np.zeros(circuit.c.size), scratch_for(self._tables)
        self._overloads = Overloads(stages, rate, self._reading.intervals)
        self._rows, self._rows_input = self._reading.rows, self._reading.rows_input

        share = delay * rate - late
        self._delay = Delay(share) if share else None
        self._jitter = None
        if converter.jitter:
            wait = DELAY if filtered else 0
            self._jitter = Jitter(circuit, gain, converter.jitter * sample_rate, wait)
            self._rows = np.concatenate([self._rows, self._jitter.row[None]])
            self._rows_input = np.append(self._rows_input, self._jitter.row_input)
        self._rows_excess = np.full(len(self._rows), -circuit.d[limited])
        self._noise = None
        if converter.noise is not None:
            random = generator(seed, name, "converter noise")
            self._noise = Noise(converter.noise, None, sample_rate, random)

    def measure(self, pieces: CubicInput, late: Array | None) -> tuple[Array, NDArray[np.bool_] | bool]:
        """Return the volts at the samples that end intervals of a block, and where a limit has affected them.

        `late` is the lateness of each sample, in standard deviations of the jitter.
        """
        if self._delay is not None:
            pieces = self._delay.shift(pieces)
        intervals = pieces.smooth.shape[1]
        ends = slice(-self._interval % self._oversampling, intervals, self._oversampling)
        self._interval += intervals
        held = self._disturbances.draw(intervals)
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
        return volts, False if self._limits is None else self._overloads.flags(ends)


class Overloads:
    """Flags samples with an interval at a limit, or with a shift of zero that is not negligible yet."""

    def __init__(self, stages: Sequence[Stage], rate: float, intervals: int) -> None:
        fades = [-section.a[0, 0] for section in stages[0].sections if section.name == RECOVERY]
        self._decay_intervals = rate / fades[0] if fades else 0.0
        self._intervals_per_sample = intervals
        self._severity = np.zeros(1)
        self._flagged_ahead = 0

    def place(self, intervals: int) -> Array:
        """Return the place for the severity of each interval; see `daq.dsp.propagation.propagate`."""
        last, self._severity = self._severity[-1], np.empty(1 + intervals)
        self._severity[0] = last
        return self._severity

    def flags(self, ends: slice) -> NDArray[np.bool_]:
        """Return the flag of each sample that ends at one of the intervals `ends`."""
        severity = self._severity[1:]  # 0: within the limit; otherwise 1 + zero shift / limit
        if self._flagged_ahead <= 0 and not severity.any():
            return np.zeros(severity[ends].size, dtype=bool)
        overloaded = np.flatnonzero(severity)
        # The zero shift decays exponentially; count the intervals until it is negligible.
        excess = np.maximum((severity[overloaded] - 1.0) / NEGLIGIBLE_ZERO_SHIFT, 1.0)
        recovery = np.ceil(self._decay_intervals * np.log(excess)).astype(np.int64)
        valid_from = np.zeros(severity.size + 1, dtype=np.int64)
        valid_from[0] = self._flagged_ahead  # carried over from the previous block
        valid_from[overloaded + 1] = overloaded + self._intervals_per_sample + recovery
        valid_from = np.maximum.accumulate(valid_from)
        self._flagged_ahead = int(valid_from[-1]) - severity.size
        return (valid_from[1:] > np.arange(severity.size))[ends]


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
            sources.append(Offset(stage.offset, stage.settling, rate))
            entries.append(Entry(behind, 0, filtered))
    return entries, sources
