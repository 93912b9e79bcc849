"""Swept sine: frequency responses by the local rational method.

A *line* is a frequency of the result. For each line, the method is applied to the *segment* of the sweep in which the
frequency of the tone is near the line. A *bin* is a frequency of the discrete Fourier transform of the segment.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from analysis.core.recordings.slices import read_slices
from analysis.core.responses.checks.clean_segments import describe_flaws, find_flaws, remedy
from analysis.core.responses.checks.tone_steps import ToneInterval
from analysis.core.responses.errors.systematic import (
    UNSETTLED,
    power_in_counts,
    relative_to_reading,
    reproducible_rounding,
    tolerance,
    tone_gain_error,
)
from analysis.core.responses.estimator import Estimator, Request
from analysis.core.responses.local_models.local_rational import ORDER
from analysis.core.responses.local_models.local_spectra import FIT_HALF_WIDTH, LocalSpectra
from analysis.core.responses.measurands import Measurand
from analysis.core.responses.segment_fits import warn_of_dampers
from daq.core.recording.markers import Marker
from daq.core.recording.recording import Recording
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import RecordingError
from rig.core.base.progress import CountProgress
from rig.core.results import format_number
from rig.core.results.response import MOTIONS, Response

# Smallest frequency ratio of a segment: short segments exclude harmonics of a nonlinear structure.
_MIN_FREQUENCY_RATIO = 1.35
# Factor by which the ratio is increased until enough bins of the segment are excited on either side of its frequency.
_RATIO_INCREASE = 1.1
# Number of frequencies at which the response is estimated: several in each half-power width.
_POINTS = 400
# Ratio of the number of bins of a fit to its number of parameters.
_BINS_PER_VALUE = (2 * FIT_HALF_WIDTH + 1) / (3 * ORDER + 2)
# Positions of the bins of a fit, relative to the line.
_BIN_OFFSETS = np.arange(-FIT_HALF_WIDTH, FIT_HALF_WIDTH + 1)
# Dampers are assumed to stay on their floors up to this acceleration of their body [g]. They lift off at 1 g.
_MAX_FLOOR_ACCELERATION = 0.7
# With dampers in flight, a sweep is slow enough if the relative error due to its sweep rate is at most this value.
_MAX_SWEEP_ERROR_RATIO = 0.3
# A warning is issued if the sweep is too fast at more than this share of the lines with dampers in flight.
_MAX_FAST_SHARE = 0.05
# A warning recommends a sweep that is longer by this factor.
_RECOMMENDED_SLOWDOWN = 10
# Minimum number of periods over which the amplitude of a reading is evaluated.
_MIN_PERIODS = 3.0


@dataclass(frozen=True)
class SweptTone:
    """Spectra of a sweep: for each line, the spectra of the segment in which the tone is near the line."""

    spectra: LocalSpectra
    sweep_rate: Array  # Hz/s; shape (lines,)
    warnings: tuple[str, ...]
    # lines at which all dampers stay on their floors and the structure is linear; shape (lines,)
    on_floor: NDArray[np.bool_]
    omitted: Array  # frequencies without a line [Hz]

    def frf(
        self, rec: Recording, numerator: Measurand, denominator: Measurand, others: Sequence[Measurand] = ()
    ) -> Response:
        """Estimate the frequency response with coherence, random and systematic errors; `others`: other inputs."""
        frf = self.spectra.frf(rec, numerator, denominator, others, warnings=self.warnings)
        frf = replace(frf, omitted=self.omitted)
        if not warn_of_dampers(rec):
            return frf
        error = np.where(self.on_floor, 0.0, self._sweep_error(frf))
        frf = frf.with_limits({UNSETTLED: error})
        too_fast = error / abs(frf.value) > _MAX_SWEEP_ERROR_RATIO
        if not np.sum(too_fast) > _MAX_FAST_SHARE * np.sum(error > 0.0):
            return frf
        # Frequencies have two digits, so responses with nearly the same band have the same warning.
        low, high = (format_number(float(f"{end:.2g}")) for end in frf.frequency[np.flatnonzero(too_fast)[[0, -1]]])
        parts = "joints that act" if rec.scene.joints else "dampers in flight"
        return frf.warn(
            f"Between {low} and {high} Hz this sweep is too fast to reach steady state with {parts}, so the curve is a "
            f"transient response there. Sweep {_RECOMMENDED_SLOWDOWN} times slower, or use stepped sine."
        )

    def _sweep_error(self, frf: Response) -> Array:
        """Estimate the error of a nonlinear response due to the sweep rate.

        The response to a sweep differs from the steady-state response by half the sweep rate (in rad/s²) times the
        curvature of the response (J. R. Carson, T. C. Fry, Variable frequency electric circuit theory, Bell System
        Technical Journal 16 (1937) 513-540). The fit corrects this difference for a linear structure. For a nonlinear
        structure it is a possible error.
        """
        if frf.frequency.size < 3:
            return np.full(frf.frequency.size, np.inf)
        slope = np.gradient(frf.value, frf.frequency)
        return np.asarray(self.sweep_rate / (4.0 * np.pi) * abs(np.gradient(slope, frf.frequency)), dtype=float)


def sweep_spectra(
    rec: Recording, marker: Marker, channels: Sequence[str], progress: CountProgress | None = None
) -> SweptTone:
    """Compute the spectra of a sweep around each line, over the segment in which the tone is near the line.

    The transients at the beginning and end of a segment are part of the fit. Neither the sweep rate nor the length of
    the segment therefore limits the resolution. `marker`: the ``measure`` marker of the sweep.
    """
    first = marker.first_sample
    stop = rec.samples if marker.last_sample is None else min(rec.samples, marker.stop)
    names = tuple(channels)
    low, high = sorted(float(marker.fields[key]) for key in ("from", "to"))
    frequency = np.geomspace(low, high, _POINTS)
    bounds = [_segment(marker, f, rec.rate, first, stop) for f in frequency]
    all_flaws = find_flaws(rec, names, first, stop)
    is_clean = [
        not any(flaw.first < end and flaw.stop > begin for flaw in all_flaws) and end - begin > 4 * FIT_HALF_WIDTH
        for begin, end in bounds
    ]
    notes = []
    if not all(is_clean):
        reasons = describe_flaws(rec, all_flaws) or "the sweep is too short"
        notes.append(f"{is_clean.count(False)} of {_POINTS} frequencies omitted: {reasons}.")
    if not any(is_clean):
        raise RecordingError(
            f"{rec.path}: no part of the sweep can be used ({reasons}). {remedy(rec, all_flaws)}, or sweep for longer."
        )
    if marker.fields.get("settled") is False:
        notes.append(
            "The sweep began before steady state at its first frequency, so the curve may be wrong near it. Begin "
            "farther from a resonance (test.from)."
        )
    order = sorted(np.flatnonzero(is_clean).tolist(), key=lambda index: bounds[index])
    direction = 1 if marker.fields["to"] > marker.fields["from"] else -1
    lines, variances = dict[int, _Line](), np.empty((len(names), _POINTS))
    blocks = read_slices(rec, names, [bounds[index] for index in order])
    for n_completed, (index, block) in enumerate(zip(order, blocks, strict=True), 1):
        if progress is not None:
            progress(n_completed, len(order))
        lines[index] = _line(block, frequency[index], rec.rate, direction)
        begin, width = bounds[index][0], FIT_HALF_WIDTH * rec.rate / block.shape[1]
        # The time at which a logarithmic sweep passes a frequency exists only for positive frequencies.
        edges = [max(frequency[index] + offset, 1e-6 * frequency[index]) for offset in (-width, width)]
        # Samples at which the sweep passes the first and the last bin of the fit.
        passage = [first + _sample_at(marker, edge, rec.rate) - begin for edge in edges]
        variances[:, index] = _samples_between(block, passage, rec.rate / frequency[index]).var(axis=1)
    clean_points, lengths = np.array(sorted(order)), np.array([end - begin for begin, end in bounds])
    noise_levels = [line.noise for line in lines.values() if line.noise]
    noise = _interpolate_noise(noise_levels, frequency[clean_points], len(names))
    # Noise reduces the reproducible rounding error; its smallest value over all frequencies is used.
    noise_counts = power_in_counts(rec, names, noise.min(axis=1))
    rounding_gain_error = reproducible_rounding(noise_counts)[:, None] * tone_gain_error(
        power_in_counts(rec, names, variances[:, clean_points])
    )
    spectra = LocalSpectra(
        names,
        np.concatenate([lines[index].spectra for index in sorted(lines)], axis=1)[None],
        np.ones((1, clean_points.size * _BIN_OFFSETS.size), dtype=complex),
        np.concatenate([lines[index].frequency for index in sorted(lines)]),
        np.arange(clean_points.size) * _BIN_OFFSETS.size + FIT_HALF_WIDTH,
        FIT_HALF_WIDTH,
        1.0,
        rounding_gain_error,
        noise * lengths[clean_points],
        np.zeros((len(names), len(names))),
        max(float(np.median(_BINS_PER_VALUE * rec.rate / lengths / np.gradient(frequency))), 1.0),
    )
    sweep_rate = abs(np.gradient(frequency, [_sample_at(marker, f, rec.rate) / rec.rate for f in frequency]))
    on_floor = _dampers_on_floor(rec, names, frequency[clean_points], variances[:, clean_points])
    omitted = frequency[~np.array(is_clean)]
    return SweptTone(spectra, sweep_rate[clean_points], tuple(notes), on_floor, omitted)


class _Line(NamedTuple):
    """Spectra of the bins around a line, from its segment."""

    spectra: ComplexArray  # shape (channels, bins)
    frequency: Array  # of the bins [Hz]
    noise: tuple[float, ...]  # frequency [Hz] at which the noise is estimated, and its power in each channel; or empty


def _line(block: Array, frequency: float, rate: float, direction: int) -> _Line:
    """Compute the spectra around a line; `block`: (channels, samples), `direction`: 1 if the sweep rises."""
    n_samples = block.shape[1]
    center = max(int(frequency * n_samples / rate), FIT_HALF_WIDTH + 1)
    bins = center + _BIN_OFFSETS
    # The noise is estimated from bins that contain neither the tone nor its leakage.
    half_range = max((_MIN_FREQUENCY_RATIO**0.5 - 1.0) * center, FIT_HALF_WIDTH)
    noise_bin = center + direction * (int(_RATIO_INCREASE * half_range) + 2 * FIT_HALF_WIDTH)
    has_noise = FIT_HALF_WIDTH < noise_bin < n_samples // 2 - FIT_HALF_WIDTH
    if has_noise:
        bins = np.concatenate([bins, np.arange(noise_bin - FIT_HALF_WIDTH - 1, noise_bin + FIT_HALF_WIDTH + 2)])
    # This shift of the spectrum moves the frequency exactly onto a bin.
    spectrum = spectrum_at_bins(block - block.mean(axis=1, keepdims=True), bins, frequency * n_samples / rate - center)
    spectra, noise_spectra = np.split(spectrum, [_BIN_OFFSETS.size], axis=1)
    noise_frequency = frequency + (noise_bin - center) * rate / n_samples
    noise = (noise_frequency, *(_noise(noise_spectra) / n_samples)) if has_noise else ()
    return _Line(spectra, frequency + _BIN_OFFSETS * rate / n_samples, noise)


def _dampers_on_floor(rec: Recording, names: Sequence[str], frequency: Array, variances: Array) -> NDArray[np.bool_]:
    """Return, for each frequency, whether all dampers stay on their floors, from the variances of motion channels."""
    on_floor = np.full(frequency.size, not rec.scene.joints)  # a stop may act at any acceleration
    for damper in rec.scene.dampers:
        largest = np.full(frequency.size, np.inf)
        for name, variance in zip(names, variances, strict=True):
            info = rec.channels[name]
            if info.at != f"body {damper.body}" or info.quantity not in MOTIONS:
                continue
            order = 2 - MOTIONS.index(info.quantity)
            acceleration = (2.0 * variance) ** 0.5 / abs(info.response(frequency)) * (2 * np.pi * frequency) ** order
            largest = np.minimum(largest, acceleration * (1.0 + relative_to_reading(np.array(tolerance(rec, name)))))
        rests = damper.spring is None  # a mass on a spring may hit its walls at any acceleration
        limit = rec.scene.gravity * (1.0 if damper.friction is None else damper.friction)
        on_floor &= (not damper.impacts) | (rests & (largest < _MAX_FLOOR_ACCELERATION * limit))
    return on_floor


def _segment(marker: Marker, frequency: float, rate: float, first: int, stop: int) -> tuple[int, int]:
    """Return the first and one-past-last sample of the segment around a frequency."""
    frequency_ratio = _MIN_FREQUENCY_RATIO
    while True:
        edges = frequency / frequency_ratio**0.5, frequency * frequency_ratio**0.5
        ends = sorted(first + _sample_at(marker, edge, rate) for edge in edges)
        begin, end = max(first, int(ends[0])), min(stop, int(ends[1]))
        excited_bins = (frequency_ratio**0.5 - 1.0) * frequency * (end - begin) / rate
        if excited_bins >= FIT_HALF_WIDTH or (begin == first and end == stop):
            return begin, end
        frequency_ratio *= _RATIO_INCREASE


def spectrum_at_bins(block: Array, bins: NDArray[np.int64], shift: float) -> ComplexArray:
    """Compute a few bins of the spectrum of a long segment after a frequency shift.

    The segment is folded into rows and multiplied by a small matrix of phase factors, much faster than a complete
    transform. `block` has the shape (channels, samples). `shift`: frequency above each bin, in bins.

    >>> block = np.random.default_rng(1).standard_normal((1, 1000))
    >>> shifted = np.fft.fft(block * np.exp(-2j * np.pi * 0.3 / 1000 * np.arange(1000)))
    >>> np.allclose(spectrum_at_bins(block, np.array([3, 80]), 0.3), shifted[:, [3, 80]], rtol=1e-12)
    True
    """
    size = block.shape[1]
    columns = max(1, int(size**0.5))
    rows = size // columns

    def phase_factors(samples: NDArray[np.int64]) -> ComplexArray:
        # With integer arithmetic, phases of late samples are as exact as those of early samples.
        return np.exp(-2j * np.pi * (np.outer(bins, samples) % size + shift * samples) / size)

    by_row, by_column = phase_factors(columns * np.arange(rows)), phase_factors(np.arange(columns))
    factors = np.concatenate([by_row.real, by_row.imag])
    folded = []
    for row in block:
        real, imaginary = np.split(factors @ row[: rows * columns].reshape(rows, columns), 2)
        folded.append(np.sum((real + 1j * imaginary) * by_column, axis=1))
    last = np.arange(rows * columns, size)
    return np.array(folded) + block[:, last] @ phase_factors(last).T


def _noise(spectra: ComplexArray) -> Array:
    """Estimate the noise power of each channel from bins without excitation or leakage, shape (channels,)."""
    windowed = 0.5 * spectra[:, 1:-1] - 0.25 * (spectra[:, :-2] + spectra[:, 2:])
    # A Hann window reduces the power to 3/8. The median of the power is ln 2 times its mean and excludes hum.
    return np.asarray(np.median(abs(windowed) ** 2, axis=1) / (0.375 * np.log(2.0)))


def _interpolate_noise(levels: Sequence[tuple[float, ...]], frequency: Array, channels: int) -> Array:
    """Interpolate the noise of each channel between the frequencies of estimates; constant outside their range."""
    if not levels:
        return np.zeros((channels, frequency.size))
    noise_frequency, *power = np.array(sorted(levels)).T
    smooth = [scipy.ndimage.uniform_filter1d(row, 2 * FIT_HALF_WIDTH + 1, mode="nearest") for row in power]
    return np.array([np.interp(frequency, noise_frequency, row) for row in smooth])


def _samples_between(block: Array, ends: Sequence[float], period: float) -> Array:
    """Return the samples between two positions of a segment, but at least `_MIN_PERIODS` around their middle."""
    # The readings in other parts of the segment may be far larger.
    middle, half = sum(ends) / 2.0, max(abs(ends[1] - ends[0]) / 2.0, _MIN_PERIODS / 2.0 * period)
    return block[:, max(int(middle - half), 0) : max(int(middle + half), int(period)) + 1]


def _sample_at(marker: Marker, frequency: float, rate: float) -> float:
    """Return the sample index, from the beginning of the sweep, at which the sweep reaches a frequency."""
    low, high, duration = (float(marker.fields[key]) for key in ("from", "to", "duration"))
    if marker.fields.get("spacing") == "linear":
        return (frequency - low) / (high - low) * duration * rate
    return float(np.log(frequency / low) / np.log(high / low) * duration * rate)


def _compute(request: Request) -> list[Response]:
    return request.compute(
        sweep_spectra(request.rec, marker, request.channels, request.progress) for marker in request.measured
    )


def _tones(request: Request) -> list[ToneInterval]:
    """Return the intervals of the sweeps, with the change of the frequency in each."""
    rec, intervals = request.rec, []
    for marker in request.measured:
        first, last, duration = (float(marker.fields[key]) for key in ("from", "to", "duration"))
        law = {"growth": math.log(last / first) / (duration * rec.rate)}
        if marker.fields.get("spacing") == "linear":
            law = {"slope": (last - first) / duration / rec.rate**2}
        stop = rec.samples if marker.last_sample is None else min(marker.stop, rec.samples)
        intervals.append(ToneInterval(marker.first_sample, stop, first / rec.rate, **law))
    return intervals


ESTIMATOR = Estimator(
    _compute,
    "a sweep is processed as a whole, by the local rational method",
    "local rational method",
    jumps=True,
    tones=_tones,
)
