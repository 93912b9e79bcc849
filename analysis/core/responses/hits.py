"""Hammer impacts: their times and forces, the motion before them, and the noise and rounding of the readings."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy import fft

from analysis.core.recordings.channel_delay import arrival
from analysis.core.recordings.slices import hits
from analysis.core.responses.checks.clean_segments import Flaw
from analysis.core.responses.checks.dead_channels import dead_channels
from analysis.core.responses.errors.systematic import quantization_steps, reproducible_rounding
from analysis.core.responses.force_pulse import isolate_pulse, samples_after_hit
from analysis.core.responses.local_models.local_rational import ORDER
from analysis.core.responses.local_models.local_spectra import FIT_HALF_WIDTH
from daq.core.recording.recording import Recording
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import RecordingError

# Interval before an impact, s, in which residual motion is detected and the zero offset of each channel is measured.
PRE_HIT_S = 0.2
# Motion before an impact is estimated from at least this number of samples.
_MIN_PRE_HIT_SAMPLES = 4
# Number of parts of the force window with independent noise.
_NOISE_PARTS = 16
# The rig is at rest in this interval if its motion is at most this fraction of the response to the impact.
_MAX_REST_RATIO = 2e-3
# Motion is detected if the estimate exceeds its noise by this number of standard deviations.
_DETECTION_SIGMAS = 4.0
# Smallest accepted ratio of the largest force within an impact's marker to the largest force until the next impact.
_MIN_MARKED_RATIO = 0.5
# A rebound of the hammer is detected if its force is at least this fraction of the force within the marker.
_MIN_REBOUND_RATIO = 0.05
# The force of a rebound must also be at least this multiple of the noise, the median change between samples.
_REBOUND_SIGMAS = 8.0
# Maximum number of samples after an impact in which rebounds and unmarked impacts are detected.
_MAX_SCAN_SAMPLES = 1 << 20
# The usable force spectrum ends where its power falls to this fraction of its maximum (-20 dB).
_MIN_POWER_RATIO = 1e-2
# The readings are rounded again as by coarser converters: quantization step of these in counts, and mean square of the
# resulting changes, relative to the mean square of the original rounding error (1/12).
_COARSER_CONVERTERS = ((2.0, 6.0), (3.0, 8.0))
# Signals below this number of counts are rounded again only if they contain noise, which acts as dither.
_MIN_COUNTS = 6.0
# If noise dithers the signal, at most this fraction of the rounding error repeats from impact to impact (the value for
# noise of half a count).
_MAX_REPRODUCIBLE = 0.007


@dataclass(frozen=True)
class Hits:
    """The impacts of a recording."""

    channel: str  # the force channel
    arrivals: tuple[tuple[int, int], ...]  # first and last sample of each impact in the force channel
    unmarked: tuple[Flaw, ...]  # impacts whose largest force is outside their marker
    interval: int  # smallest number of samples from an impact to the next impact, or from the last impact to the end

    @classmethod
    def of(cls, rec: Recording) -> Hits:
        """Locate the impacts that are marked in a recording."""
        channel = next((name for name, info in rec.channels.items() if info.quantity == "force"), None)
        if channel is None:
            raise RecordingError(
                f"{rec.path}: no force channel for the responses of an impact test. "
                "Add {name: hammer, at: hammer} to the scene's channels, or use `analysis decay`."
            )
        info = rec.channels[channel]
        arrivals = []
        for first, last in hits(rec):
            begin, end = arrival(info, first, last)
            arrivals.append((max(begin, 0), min(end, rec.samples - 1)))
        starts = [begin for begin, _ in arrivals]
        interval = int(min(np.diff([*starts, rec.samples])))
        if interval < 0.2 * rec.rate:
            raise RecordingError(
                f"{rec.path}: only {interval / rec.rate:.3g} s from an impact to the next impact (or to the end of the "
                "recording); expected 0.2 s or more. Increase test.interval, and record again."
            )
        unmarked, complete_hits, dead = [], [], dead_channels(rec).get(channel, rec.samples)
        for (begin, end), stop in zip(arrivals, [*starts[1:], rec.samples], strict=True):
            force = rec.read(channel, begin, min(stop, begin + _MAX_SCAN_SAMPLES))
            noise = np.sqrt(np.nanmedian(np.diff(force) ** 2))
            force = abs(force - np.nanmedian(force))
            marked = float(np.nanmax(force[: end - begin + 1], initial=0.0))
            largest = float(np.nanmax(force, initial=0.0))
            if marked < _MIN_MARKED_RATIO * largest and begin < dead:
                reason = (
                    f"reads at most {marked:.3g} N at the marker of the impact, {begin / rec.rate:.4g} s, and "
                    f"{largest:.3g} N elsewhere: the marker or the channel's delay is wrong"
                )
                unmarked.append(Flaw(begin, stop, channel, reason))
            # Rebounds of the hammer are part of the impact.
            min_rebound = max(_MIN_REBOUND_RATIO * marked, _REBOUND_SIGMAS * noise)
            last = int(np.flatnonzero(force > min_rebound)[-1:].sum())
            filter_length = 2 * int(np.ceil(info.filter.get("delay", 0.0))) + 2
            complete_hits.append((begin, min(max(end, begin + last + filter_length), stop - 1)))
        return cls(channel, tuple(complete_hits), tuple(unmarked), interval)

    def inside(self, start: int, stop: int) -> list[tuple[int, int]]:
        """List the impacts that lie completely within a segment."""
        first, last = (bisect_left(self.arrivals, (sample,)) for sample in (start, stop))
        return [(begin, end) for begin, end in self.arrivals[first:last] if end < stop]

    def prior_motion(self, rec: Recording, names: Sequence[str], start: int, stop: int) -> float:
        """Estimate the largest motion or drift before the first impact of a segment, relative to the response.

        The result, over the channels `names`, is NaN if the segment begins with the impact, and infinite if this is
        not the first impact of the recording.
        """
        begin = self.inside(start, stop)[0][0]
        first = max(start, begin - int(PRE_HIT_S * rec.rate))
        if begin - first < _MIN_PRE_HIT_SAMPLES:
            return np.nan
        if self.arrivals[0][0] < begin:
            return np.inf
        # In an interval shorter than `PRE_HIT_S` only a part of a slow motion is visible.
        largest, visible_ratio = 0.0, min(1.0, (begin - first) / (PRE_HIT_S * rec.rate))
        for name in names:
            reading = rec.read(name, first, min(begin + self.interval, stop))
            before, after = reading[: begin - first], reading[begin - first :]
            response = float(abs(after - before.mean()).max())
            largest = max(largest, _amplitude(before) / (visible_ratio * response) if response else 0.0)
        return largest

    def is_response_to_hits_alone(self, motion: float, start: int, stop: int, samples: int) -> bool:
        """Return whether a segment, zero-padded to `samples`, is treated as the response to its impacts alone.

        The result is true if `motion`, the result of `prior_motion`, is small. It is also true for a single impact
        close to the beginning, because the spectra of earlier motion and of the response are then too similar for
        separate terms.
        """
        if motion < _MAX_REST_RATIO:
            return True
        inside = self.inside(start, stop)
        return not np.isinf(motion) and len(inside) == 1 and 2 * FIT_HALF_WIDTH * (inside[0][0] - start) < samples

    def isolate(self, rec: Recording, names: Sequence[str], block: Array, start: int, at_rest: bool) -> Array:
        """Subtract the zero of all channels; restrict the force to the impacts and invert its high-pass filters.

        `block`: readings of the channels `names` from sample `start` on, shape (channels, samples). If `at_rest`, the
        result begins `PRE_HIT_S` before the first impact and is faded in.
        """
        inside = self.inside(start, start + block.shape[1])
        pre_hit = slice(max(inside[0][0] - start - int(PRE_HIT_S * rec.rate), 0), max(inside[0][0] - start, 1))
        isolated = block - (block[:, pre_hit] if at_rest else block).mean(axis=1, keepdims=True)
        row = names.index(self.channel)
        force = np.zeros(block.shape[1])
        for begin, end in inside:
            first = begin - start
            before = block[row, max(first - int(PRE_HIT_S * rec.rate), 0) : first]
            # The mean before the impact is the tail of earlier impacts, which is nearly constant during this impact.
            force_after = block[row, first:] - (before.mean() if before.size else 0.0)
            force[first:] += isolate_pulse(rec.channels[self.channel], force_after, 0, end - begin)
        isolated[row] = force
        if at_rest:
            # A sudden onset of integrator drift is a step, whose smooth spectrum decreases more slowly than the
            # spectrum of a displacement. The readings are therefore faded in over the first half of the samples before
            # the impact. In the second half a filter may already show the impact.
            isolated, n_fade = isolated[:, pre_hit.start :], (pre_hit.stop - pre_hit.start) // 2
            fade_in = 0.5 - 0.5 * np.cos(np.pi * (np.arange(n_fade) + 0.5) / max(n_fade, 1))
            isolated = np.concatenate([isolated[:, :n_fade] * fade_in, isolated[:, n_fade:]], axis=1)
        return isolated

    def force_noise(self, rec: Recording, segments: Sequence[tuple[int, int]], frequency: Array) -> ComplexArray:
        """Compute the relative change of the force due to noise during the impacts, shape (lines, sections).

        The force window is divided into successive sections. The noise of each section is multiplied by an independent
        normal coefficient of variance 1. The noise of a short window changes slowly from line to line, so the scatter
        between lines does not show it. Over a peak it changes nevertheless, and therefore shifts a pole.
        """
        info = rec.channels[self.channel]
        n_after, n_taper = samples_after_hit(info)
        # The taper counts as half of its length, because it reduces the noise power to about a half.
        n_window = n_after + n_taper // 2 + 1
        longest = max((end + n_window - begin for span in segments for begin, end in self.inside(*span)), default=0)
        power, noise, total = np.zeros(frequency.size), [], np.zeros(frequency.size, dtype=complex)
        phases = np.exp(-2j * np.pi / rec.rate * frequency[:, None] * np.arange(longest))
        # Rounding adds 1/12 count² even if it is not visible before the impact.
        rounding_variance = 0.0 if info.volts_per_count is None else info.unit_per_count**2 / 12.0
        for start, stop in segments:
            for begin, end in self.inside(start, stop):
                before = rec.read(self.channel, max(start, begin - int(PRE_HIT_S * rec.rate)), begin)
                pulse = rec.read(self.channel, begin, end + 1)
                spectrum = phases[:, : pulse.size] @ (pulse - before.mean() if before.size else pulse)
                power, total = power + abs(spectrum) ** 2, total + spectrum
                if before.size > 2:
                    # Differences between samples are insensitive to the tail of an earlier impact.
                    variance = max(float(np.mean(np.diff(before) ** 2)) / 2.0, rounding_variance)
                    noise.append((end + n_window - begin) * variance)
        n_parts = min(longest, _NOISE_PARTS)
        if not noise or not n_parts:
            return np.zeros((frequency.size, 1), dtype=complex)
        size = np.sqrt(float(np.mean(noise)) / n_parts / np.maximum(power, 1e-300))
        centers = (np.arange(n_parts) + 0.5) * longest / n_parts - 0.5
        shifts = np.exp(-2j * np.pi / rec.rate * frequency[:, None] * centers)
        return np.asarray((size * np.exp(-1j * np.angle(total)))[:, None] * shifts)

    def rounding_gain_error(
        self,
        rec: Recording,
        names: Sequence[str],
        segments: Sequence[tuple[int, int]],
        readings: Iterable[tuple[Array, ComplexArray]],
        lines: NDArray[np.int64],
        half_width: int,
    ) -> Array:
        """Compute the maximum relative change of each channel's gain due to rounding, shape (channels, lines).

        Equal impacts give equal counts, so averaging does not reduce the rounding error. Rounding errors shortly after
        an impact resemble a response, and are not visible in the scatter. The error is estimated from the change of the
        readings when they are rounded again, to every second and every third count (coarser converters). Noise of s
        counts reduces the error by ``exp(-2 pi^2 s^2)`` (as in `noise_gain_error`). The result is infinite for readings
        of too few counts to be rounded again.

        `readings`: readings and their spectra for each of `segments`; `lines`: bins of the result;
        `half_width`: bins on either side of a line that a local fit uses.
        """
        steps = quantization_steps(rec, names)[:, None]
        step = np.where(steps > 0.0, steps, 1.0)
        # Power spectra of the errors, summed over impacts. Each error ends `n_after_hit` samples after its impact, so
        # that a short transform determines the autocorrelation.
        errors, noise, max_counts = [np.zeros((1, 1)) for _ in _COARSER_CONVERTERS], [], np.zeros(steps.shape)
        power = np.zeros((1, 1))
        for (block, spectra), (start, stop) in zip(readings, segments, strict=True):
            power = power + abs(spectra) ** 2
            n_samples = 2 * (spectra.shape[1] - 1)
            # The polynomials of a local fit represent errors within this number of samples after an impact as a
            # response.
            n_after_hit = int(n_samples * (ORDER + 1) / half_width)
            n_transform = fft.next_fast_len(2 * n_after_hit, real=True)
            for begin, _ in self.inside(start, stop):
                first = begin - (stop - block.shape[1])
                counts = np.rint(block[:, first : first + n_after_hit] / step)
                max_counts = np.maximum(max_counts, abs(counts).max(axis=1, keepdims=True))
                for k, (coarse_step, ratio) in enumerate(_COARSER_CONVERTERS):
                    added_rounding = coarse_step * np.rint(counts / coarse_step) - counts
                    errors[k] = errors[k] + abs(fft.rfft(added_rounding, n_transform, axis=1)) ** 2 / ratio
                before = [rec.read(name, max(start, begin - int(PRE_HIT_S * rec.rate)), begin) for name in names]
                if before[0].size > 2:
                    noise.append(np.mean(np.diff(before, axis=1) ** 2, axis=1, keepdims=True) / 2.0)
        reproducible = reproducible_rounding(np.mean(noise, axis=0) / step**2 if noise else np.zeros(steps.shape))
        # The spectrum of several impacts is a comb. The power is averaged over one spacing of the comb's teeth. A wider
        # average would mix the power in peaks and in valleys of the response.
        n_bins = 2 * -(-half_width // FIT_HALF_WIDTH) + 1  # rounded up
        mean_power = scipy.ndimage.uniform_filter1d(power, n_bins, axis=1, mode="nearest")
        mean_errors = np.max(
            [
                scipy.ndimage.uniform_filter1d(
                    _longer_transform(error, n_transform, n_samples), half_width, axis=1, mode="nearest"
                )
                for error in errors
            ],
            axis=0,
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            # The squared magnitude of a complex normal error is below three times its mean with a probability of 95 %.
            gain_error = (step * np.sqrt(3.0 * mean_errors / mean_power))[:, lines]
        gain_error = np.where((max_counts < _MIN_COUNTS) & (reproducible > _MAX_REPRODUCIBLE), np.inf, gain_error)
        gain_error = np.nan_to_num(gain_error, nan=np.inf, posinf=np.inf)
        return np.asarray(np.where(steps > 0.0, reproducible * gain_error, 0.0))

    def highest_frequency(self, rec: Recording) -> float:
        """Compute the highest frequency that the impacts excite, Hz, but at most 40 % of the sample rate."""
        size = fft.next_fast_len(int(0.2 * rec.rate) + 64, real=True)
        power = np.zeros(size // 2 + 1)
        for begin, end in self.arrivals:
            force = rec.read(self.channel, begin, min(begin + size, rec.samples))
            force = np.nan_to_num(force - np.nanmedian(force))
            power += abs(fft.rfft(force[: end - begin + 1], size)) ** 2
        peak = int(np.argmax(power))
        weak = np.flatnonzero(power[peak:] < _MIN_POWER_RATIO * power[peak])
        last = peak + int(weak[0]) if weak.size else power.size
        return float(min(last, 0.4 * size) * rec.rate / size)


def _longer_transform(power: Array, size: int, new_size: int) -> Array:
    """Compute the power spectrum at the bins of a transform of `new_size` samples, of signals of at most `size` / 2."""
    correlation = fft.irfft(power, size, axis=1)
    n_lags = (size + 1) // 2
    padded = np.zeros((len(power), new_size))
    padded[:, :n_lags] = correlation[:, :n_lags]
    padded[:, new_size - n_lags + 1 :] = correlation[:, size - n_lags + 1 :]
    return np.maximum(fft.rfft(padded, axis=1).real, 0.0)


def _amplitude(reading: Array) -> float:
    """Estimate the amplitude of motion or drift in a reading; noise is estimated from the changes between samples."""
    noise = 0.5 * np.mean(np.diff(reading) ** 2)
    middle, sigmas = reading.size // 2, _DETECTION_SIGMAS / np.sqrt(reading.size)
    drift = abs(reading[:middle].mean() - reading[middle:].mean()) - 2.0 * sigmas * np.sqrt(noise)
    return float(max(drift, np.sqrt(2.0 * max(reading.var() - (1.0 + sigmas * np.sqrt(2.0)) * noise, 0.0)), 0.0))
