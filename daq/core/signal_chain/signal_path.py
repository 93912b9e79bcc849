"""Computes the samples of one channel [V] from the motion or force at its sensor.

A stage is a device of the channel: sensor, amplifier or coupling. A section is a linear element of its circuit, such as
a high-pass filter. The oversampling divides each sample interval into equal intervals; the circuit is propagated from
interval to interval.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from daq.core.dsp.block_buffers import SharedScratch
from daq.core.dsp.circuit import INTEGRATION, RECOVERY, Circuit
from daq.core.dsp.discretization import DiscreteCircuit, Entry, discretize
from daq.core.dsp.disturbances import Disturbance, Disturbances, Offset, OffsetPolynomial
from daq.core.dsp.interpolation import CubicInput
from daq.core.dsp.limiting import tabulate_limits
from daq.core.dsp.noise import FastNoise, Noise, generator
from daq.core.dsp.propagation import circuit_workspace, propagate
from daq.core.dsp.skew import Delay
from daq.core.signal_chain.decimation_filter import DELAY_SAMPLES, DecimationFilter
from daq.core.signal_chain.sampling import AverageSampler, FilteredSampler, Jitter, PointSampler, Sampler
from daq.core.signal_chain.stage import Stage, is_averaged
from rig.core.base.arrays import Array
from rig.core.numerics.jit import RepeatedCall
from rig.core.scene.measurement_chain import Converter

# Number of Legendre polynomials per interval that represent noise before a filter; see `daq.core.dsp.noise.FastNoise`.
NOISE_TERMS = 3
# The zero shift after an overload is negligible below this fraction of the sensor's limit: data sheets have three
# digits.
NEGLIGIBLE_ZERO_SHIFT_RATIO = 1e-3


class SignalPath:
    """Sensor, amplifier, coupling and sampling of one channel.

    The limits of sensor and amplifier act on the continuous signal, before it is filtered and sampled. `delay` is the
    delay of the channel due to skew, s. Skew is the time difference between the sampling of different channels.
    """

    def __init__(
        self,
        name: str,
        stages: Sequence[Stage],
        converter: Converter,
        oversampling: int,
        delay: float,
        seed: int,
        buffers: SharedScratch,
    ) -> None:
        sections = [section for stage in stages for section in stage.sections]
        circuit = Circuit.series(sections)
        sensor, sample_rate = stages[0], converter.true_rate
        rate, gain = sample_rate * oversampling, sensor.nominal * (1.0 + sensor.deviation)
        # The sampler realizes the whole intervals of the delay, `Delay` the remaining part of an interval.
        delay_intervals = int(delay * rate)
        has_filter, self._oversampling = converter.filter is not None, oversampling
        self._first_interval = 0  # index of the first interval of the next block
        self._sampler: Sampler
        if has_filter:
            low_pass = DecimationFilter.standard(converter.sample_rate)
            self._sampler = FilteredSampler(circuit, low_pass, oversampling, delay_intervals, buffers)
        elif is_averaged(stages, converter):
            self._sampler = AverageSampler(circuit, oversampling, delay_intervals, buffers)
        else:
            self._sampler = PointSampler(circuit, gain, oversampling, delay_intervals)
        entries, sources = _disturbances(stages, name, sample_rate, seed, has_filter)
        self.noise_states = sum(source.states for source in sources if isinstance(source, Noise))
        direct = np.array(
            [
                0.0 if has_filter or isinstance(source, OffsetPolynomial) else circuit.d[entry.section]
                for entry, source in zip(entries, sources, strict=True)
            ]
        )
        # Without a filter, a sample contains the offset at its own instant, not a mean over the interval before it.
        self._direct_offsets = [] if has_filter else _direct_offsets(stages, circuit, sample_rate)
        self._disturbances = Disturbances(sources, direct, [entry.degree for entry in entries], oversampling)
        self._discrete = _discretized(circuit, gain, rate, self._sampler.moments, entries)
        state_limits: list[float] = []  # V
        for stage in stages:
            limit = np.inf if stage.rails is None else stage.rails
            for section in stage.sections:
                state_limits += [limit if section.name == INTEGRATION else np.inf] * section.states
        # The limit of the sensor clips the sensor's output, which is the input of this section.
        limited_section = len(sensor.sections)
        self._limits = tabulate_limits(
            sections, limited_section, sensor.limit, np.array(state_limits), gain, rate, entries, self._discrete
        )
        self._state, self._workspace = np.zeros(circuit.c.size), circuit_workspace(self._discrete)
        self._overloads = Overloads(stages, rate, self._sampler.intervals)
        self._output_matrix, self._feedthrough = self._sampler.output_matrix, self._sampler.feedthrough

        delay_fraction = delay * rate - delay_intervals
        self._delay = Delay(delay_fraction) if delay_fraction else None
        self._jitter = None
        if converter.jitter:
            filter_delay = DELAY_SAMPLES if has_filter else 0
            self._jitter = Jitter(converter.jitter * sample_rate, filter_delay)
            # The voltage is added as the last output, because the error due to jitter requires its slope.
            self._output_matrix = np.concatenate([self._output_matrix, circuit.c[None]])
            self._feedthrough = np.append(self._feedthrough, circuit.d[0] * gain)
        self._propagate = RepeatedCall(propagate)
        self._feedthrough_excess = np.full(len(self._output_matrix), -circuit.d[limited_section])
        self._noise = None
        if converter.noise is not None:
            noise_generator = generator(seed, name, "converter noise")
            self._noise = Noise(converter.noise, None, sample_rate, noise_generator)

    def measure(self, cubics: CubicInput, timing_error: Array | None) -> tuple[Array, NDArray[np.bool_] | None]:
        """Return the samples of a block [V], and for each sample whether a limit of sensor or amplifier affected it.

        The flags are None without a limit. `cubics` are the cubics of the sensor's input in the intervals of the block.
        `timing_error` is the timing error of each sample in standard deviations of the jitter.
        """
        if self._delay is not None:
            cubics = self._delay.shift(cubics)
        intervals = cubics.interval_cubics.shape[1]
        # The intervals of the block that end at a sample.
        sample_ends = slice(-self._first_interval % self._oversampling, intervals, self._oversampling)
        self._first_interval += intervals
        disturbances = self._disturbances.draw(intervals)
        outputs = np.empty((self._feedthrough.size, intervals))
        self._propagate(
            cubics, self._discrete, self._limits, self._state, disturbances, self._output_matrix, self._feedthrough,
            self._feedthrough_excess, outputs, self._sampler.moments_buffer(intervals),
            self._overloads.severity_buffer(intervals), self._workspace,
        )  # fmt: skip
        volts = self._sampler.read(outputs, sample_ends)
        if self._disturbances.has_direct:
            self._disturbances.add_direct(disturbances[:, sample_ends], volts)
        for weight, offset in self._direct_offsets:
            offsets = np.empty(volts.size)
            offset.fill(offsets)
            volts += weight * offsets
        if self._jitter is not None and timing_error is not None:
            volts += self._jitter.error(outputs[-1, sample_ends], timing_error)
        if self._noise is not None:
            noise = np.empty(volts.size)
            self._noise.fill(noise)
            volts += noise
        return volts, None if self._limits is None else self._overloads.flags(sample_ends)


class Overloads:
    """Flags samples that depend on an interval in overload or with a significant zero shift.

    The zero shift is the offset of a sensor after an overload; it decays exponentially. `rate` is in intervals per
    second, `affecting_intervals` the number of intervals on which a sample depends.
    """

    def __init__(self, stages: Sequence[Stage], rate: float, affecting_intervals: int) -> None:
        recovery_rates = [-section.a[0, 0] for section in stages[0].sections if section.name == RECOVERY]
        self._decay_intervals = rate / recovery_rates[0] if recovery_rates else 0.0  # time constant of the zero shift
        self._affecting_intervals = affecting_intervals
        self._severity = np.zeros(1)
        self._affected_ahead = 0  # number of intervals of the next block that earlier overloads affect

    def severity_buffer(self, intervals: int) -> Array:
        """Return the array for the severity of each interval; see `daq.core.dsp.propagation.propagate`."""
        last_severity, self._severity = self._severity[-1], np.empty(1 + intervals)
        self._severity[0] = last_severity
        return self._severity

    def flags(self, sample_ends: slice) -> NDArray[np.bool_]:
        """Return the flag of each sample, given the intervals that end at a sample."""
        severity = self._severity[1:]  # 0 within the limit; 1 + zero shift / limit in overload
        if self._affected_ahead <= 0 and not severity.any():
            return np.zeros(severity[sample_ends].size, dtype=bool)
        overloaded = np.flatnonzero(severity)
        # Number of intervals until the zero shift is negligible.
        decay_ratio = np.maximum((severity[overloaded] - 1.0) / NEGLIGIBLE_ZERO_SHIFT_RATIO, 1.0)
        recovery = np.ceil(self._decay_intervals * np.log(decay_ratio)).astype(np.int64)
        # For each interval, and for the time before the first: interval from which samples are valid again.
        valid_from = np.zeros(severity.size + 1, dtype=np.int64)
        valid_from[0] = self._affected_ahead
        valid_from[overloaded + 1] = overloaded + self._affecting_intervals + recovery
        valid_from = np.maximum.accumulate(valid_from)
        self._affected_ahead = int(valid_from[-1]) - severity.size
        return (valid_from[1:] > np.arange(severity.size))[sample_ends]


# Discretized circuits by their matrices. Channels with equal data sheets share a circuit, also across benches.
_CIRCUIT_CACHE: dict[tuple[object, ...], DiscreteCircuit] = {}
# The cache is emptied when it contains this number of circuits.
_MAX_CIRCUITS = 64


def _discretized(circuit: Circuit, gain: float, rate: float, moments: int, entries: Sequence[Entry]) -> DiscreteCircuit:
    """Discretize a circuit, or return an equal circuit from the cache."""
    matrices = (np.asarray(matrix).tobytes() for matrix in (circuit.a, circuit.b, circuit.c, circuit.d))
    key = (*matrices, np.asarray(circuit.sections).tobytes(), gain, rate, moments, tuple(entries))
    if key not in _CIRCUIT_CACHE:
        if len(_CIRCUIT_CACHE) >= _MAX_CIRCUITS:
            _CIRCUIT_CACHE.clear()
        _CIRCUIT_CACHE[key] = discretize(circuit, gain, rate, moments, entries)
    return _CIRCUIT_CACHE[key]


def _direct_offsets(stages: Sequence[Stage], circuit: Circuit, rate: float) -> list[tuple[float, Offset]]:
    """Return each offset of a stage whose direct feedthrough to the output is not 0, with this feedthrough."""
    offsets, section = [], 0
    for stage in stages:
        section += len(stage.sections)
        if stage.offset is not None and circuit.d[section]:
            offsets.append((float(circuit.d[section]), Offset(stage.offset, stage.settling, rate)))
    return offsets


def _disturbances(
    stages: Sequence[Stage], channel: str, rate: float, seed: int, has_filter: bool
) -> tuple[list[Entry], list[Disturbance]]:
    """Return the noises and offsets of the stages: for each, its point of entry into the circuit, and its source.

    `rate` is the sample rate [Hz].
    """
    entries: list[Entry] = []
    sources: list[Disturbance] = []
    section = 0
    for stage in stages:
        section += len(stage.sections)
        if stage.noise is not None:
            noise, corner, name = stage.noise, stage.noise_corner, stage.name + " noise"
            sources.append(Noise(noise, corner, rate, generator(seed, channel, name)))
            n_terms = NOISE_TERMS if has_filter else 1
            for degree in range(1, n_terms):
                noise_generator = generator(seed, channel, f"{name} {degree}")
                sources.append(FastNoise(noise, corner, rate, noise_generator, degree))
            entries += [Entry(section, degree, has_filter) for degree in range(n_terms)]
        if stage.offset is not None:
            # A constant offset needs only the polynomial of degree 0.
            for degree in range(1 if stage.settling is None else NOISE_TERMS):
                sources.append(OffsetPolynomial(stage.offset, stage.settling, rate, degree))
                entries.append(Entry(section, degree, has_filter))
    return entries, sources
