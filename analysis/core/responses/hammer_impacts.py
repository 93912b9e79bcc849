"""Hammer impacts: their times and forces, and the motion before them."""

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy import fft

from analysis.core.recordings.channel_delay import arrival
from analysis.core.recordings.slices import impact_ranges
from analysis.core.responses.checks.clean_segments import Flaw
from analysis.core.responses.checks.failed_channels import failed_channels
from analysis.core.responses.force_pulse import isolate_pulse
from analysis.core.responses.local_models.local_spectra import FIT_HALF_WIDTH
from daq.core.recording.recording import Recording
from rig.core.base.arrays import Array
from rig.core.base.errors import RecordingError

# Interval before an impact [s], in which residual motion is detected and the zero offset of each channel is measured.
PRE_IMPACT_S = 0.2
# Motion before an impact is estimated from at least this number of samples; fewer do not separate it from noise.
_MIN_PRE_IMPACT_SAMPLES = 4
# Largest motion of a rig at rest before an impact, relative to the response: without visible effect.
_MAX_REST_RATIO = 2e-3
# Smallest detected motion, in standard deviations of its noise, which chance does not reach.
_DETECTION_SIGMAS = 4.0
# Smallest accepted ratio of the largest force within an impact's marker to the largest force until the next impact.
_MIN_MARKED_RATIO = 0.5
# Smallest detected rebound, relative to the force within the marker; smaller rebounds are negligible in the spectrum.
_MIN_REBOUND_RATIO = 0.05
# The force of a rebound must also be at least this multiple of the noise, the median change between samples.
_REBOUND_SIGMAS = 8.0
# Number of samples after an impact in which rebounds and unmarked impacts are detected, to limit the memory to 8 MB a
# channel.
_MAX_SCAN_SAMPLES = 1 << 20
# The usable force spectrum ends where its power falls to this fraction of its maximum (-20 dB).
_MIN_POWER_RATIO = 1e-2


@dataclass(frozen=True)
class HammerImpacts:
    """The impacts of a recording."""

    channel: str  # the force channel
    arrivals: tuple[tuple[int, int], ...]  # first and last sample of each impact in the force channel
    unmarked: tuple[Flaw, ...]  # impacts whose largest force is outside their marker
    interval: int  # smallest number of samples from an impact to the next impact, or from the last impact to the end

    @classmethod
    def of(cls, rec: Recording) -> Self:
        """Locate the impacts that are marked in a recording."""
        channel = next((name for name, info in rec.channels.items() if info.quantity == "force"), None)
        if channel is None:
            raise RecordingError(
                f"{rec.path}: no force channel for the responses of an impact test. "
                "Add {name: hammer, at: hammer} to the scene's channels, or use `analysis decay`."
            )
        info = rec.channels[channel]
        arrivals = []
        for first, last in impact_ranges(rec):
            begin, end = arrival(info, first, last)
            arrivals.append((max(begin, 0), min(end, rec.samples - 1)))
        starts = [begin for begin, _ in arrivals]
        interval = int(min(np.diff([*starts, rec.samples])))
        if interval < 0.2 * rec.rate:
            raise RecordingError(
                f"{rec.path}: only {interval / rec.rate:.3g} s from an impact to the next impact (or to the end of the "
                "recording); expected 0.2 s or more. Increase test.interval, and record again."
            )
        unmarked, complete, failed = [], [], failed_channels(rec).get(channel, rec.samples)
        for (begin, end), stop in zip(arrivals, [*starts[1:], rec.samples], strict=True):
            force = rec.read(channel, begin, min(stop, begin + _MAX_SCAN_SAMPLES))
            noise = np.sqrt(np.nanmedian(np.diff(force) ** 2))
            force = abs(force - np.nanmedian(force))
            marked = float(np.nanmax(force[: end - begin + 1], initial=0.0))
            largest = float(np.nanmax(force, initial=0.0))
            if marked < _MIN_MARKED_RATIO * largest and begin < failed:
                reason = (
                    f"reads at most {marked:.3g} N at the marker of the impact, {begin / rec.rate:.4g} s, and "
                    f"{largest:.3g} N elsewhere: the marker or the channel's delay is wrong"
                )
                unmarked.append(Flaw(begin, stop, channel, reason))
            # Rebounds of the hammer are part of the impact.
            min_rebound = max(_MIN_REBOUND_RATIO * marked, _REBOUND_SIGMAS * noise)
            last = int(np.flatnonzero(force > min_rebound)[-1:].sum())
            filter_length = 2 * int(np.ceil(info.filter.get("delay", 0.0))) + 2
            complete.append((begin, min(max(end, begin + last + filter_length), stop - 1)))
        return cls(channel, tuple(complete), tuple(unmarked), interval)

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
        first = max(start, begin - int(PRE_IMPACT_S * rec.rate))
        if begin - first < _MIN_PRE_IMPACT_SAMPLES:
            return np.nan
        if self.arrivals[0][0] < begin:
            return np.inf
        # In an interval shorter than `PRE_IMPACT_S` only a part of a slow motion is visible.
        largest, visible_ratio = 0.0, min(1.0, (begin - first) / (PRE_IMPACT_S * rec.rate))
        for name in names:
            reading = rec.read(name, first, min(begin + self.interval, stop))
            before, after = reading[: begin - first], reading[begin - first :]
            response = float(abs(after - before.mean()).max())
            largest = max(largest, _amplitude(before) / (visible_ratio * response) if response else 0.0)
        return largest

    def is_response_to_impacts_alone(self, motion: float, start: int, stop: int, samples: int) -> bool:
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
        """Subtract the zero offset of all channels; restrict the force to the impacts and invert its high-pass filters.

        `block`: readings of the channels `names` from sample `start` on, shape (channels, samples). If `at_rest`, the
        result begins `PRE_IMPACT_S` before the first impact and is faded in.
        """
        inside = self.inside(start, start + block.shape[1])
        before_impact = slice(max(inside[0][0] - start - int(PRE_IMPACT_S * rec.rate), 0), max(inside[0][0] - start, 1))
        isolated = block - (block[:, before_impact] if at_rest else block).mean(axis=1, keepdims=True)
        row = names.index(self.channel)
        force = np.zeros(block.shape[1])
        for begin, end in inside:
            first = begin - start
            before = block[row, max(first - int(PRE_IMPACT_S * rec.rate), 0) : first]
            # The mean before the impact is the tail of earlier impacts, which is nearly constant during this impact.
            force_after = block[row, first:] - (before.mean() if before.size else 0.0)
            force[first:] += isolate_pulse(rec.channels[self.channel], force_after, 0, end - begin)
        isolated[row] = force
        if at_rest:
            # A sudden onset of integrator drift is a step, whose smooth spectrum decreases more slowly than the
            # spectrum of a displacement. The readings are therefore faded in over the first half of the samples before
            # the impact. In the second half a filter may already show the impact.
            isolated, n_fade = isolated[:, before_impact.start :], (before_impact.stop - before_impact.start) // 2
            fade_in = 0.5 - 0.5 * np.cos(np.pi * (np.arange(n_fade) + 0.5) / max(n_fade, 1))
            isolated = np.concatenate([isolated[:, :n_fade] * fade_in, isolated[:, n_fade:]], axis=1)
        return isolated

    def highest_frequency(self, rec: Recording) -> float:
        """Compute the highest frequency that the impacts excite [Hz], but at most 40 % of the sample rate."""
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


def _amplitude(reading: Array) -> float:
    """Estimate the amplitude of motion or drift in a reading; noise is estimated from the changes between samples."""
    noise = 0.5 * np.mean(np.diff(reading) ** 2)
    middle, sigmas = reading.size // 2, _DETECTION_SIGMAS / np.sqrt(reading.size)
    drift = abs(reading[:middle].mean() - reading[middle:].mean()) - 2.0 * sigmas * np.sqrt(noise)
    return float(max(drift, np.sqrt(2.0 * max(reading.var() - (1.0 + sigmas * np.sqrt(2.0)) * noise, 0.0)), 0.0))
