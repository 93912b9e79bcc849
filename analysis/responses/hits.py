"""Hammer hits: their times, forces, and the noise and offset of the force channel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy import fft

from analysis.recordings.channel_delay import arrival
from analysis.recordings.slices import hits
from analysis.responses.clean_stretches import Flaw
from analysis.responses.force_pulse import pulse_alone
from analysis.responses.local_models.local_rational import ORDER
from analysis.responses.local_models.local_spectra import SIDE
from analysis.responses.systematic import counts_of, scattered
from rig.arrays import Array, ComplexArray
from rig.errors import RecordingError

if TYPE_CHECKING:
    from daq.recording.recording import Recording


# Interval before a hit, s, for the detection of residual motion and for the channel's zero.
REST = 0.2
# The rig is at rest if the readings change in this interval by less than this part of the following response.
_STILL = 2e-3
# Detection limit of motion, in standard deviations of its estimate from noise.
_SURE = 4.0
# The largest force belongs to the hit. A marker that contains less than this part of it does not mark the hit.
_LEAST_FORCE_SHARE = 0.5
# A rebound of the hammer has at least this part of the first force, and at least this multiple of the noise.
_REBOUND, _NOISY = 0.05, 8.0
# The usable force spectrum ends where the power is below this part of its maximum.
_FAINT = 1e-2

# Step sizes of coarser converters, in counts, and the ratio of the mean square of the changes that they cause to the
# mean square of the original rounding (1/12).
_COARSER = ((2.0, 6.0), (3.0, 8.0))
# A coarser converter loses a signal of fewer counts, unless noise of at least half a count leaves no more than this
# share of the rounding error reproducible.
_FEWEST_COUNTS, _SAME = 6.0, 0.007


@dataclass(frozen=True)
class Hits:
    """The hits of a recording."""

    channel: str  # the force channel
    arrivals: tuple[tuple[int, int], ...]  # first and last sample of each hit in the force channel
    missed: tuple[Flaw, ...]  # hits whose force is outside their marker
    interval: int  # smallest number of samples from a hit to the next hit, or from the last hit to the end

    @classmethod
    def of(cls, rec: Recording) -> Hits:
        """Locate the hits that the test marked."""
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
                f"{rec.path}: {interval / rec.rate:.3g} s between hits are too short. Increase test: interval."
            )
        missed, windows = [], []
        for (begin, end), stop in zip(arrivals, [*starts[1:], rec.samples], strict=True):
            force = rec.read(channel, begin, stop)
            noise = np.sqrt(np.nanmedian(np.diff(force) ** 2))
            force = abs(force - np.nanmedian(force))
            there, raw = (float(np.nanmax(part, initial=0.0)) for part in (force[: end - begin + 1], force))
            if there < _LEAST_FORCE_SHARE * raw:
                reason = (
                    f"reads at most {there:.3g} N at the marker of the hit, {begin / rec.rate:.4g} s, and "
                    f"{raw:.3g} N elsewhere: the marker or the channel's delay is wrong"
                )
                missed.append(Flaw(begin, stop, channel, reason))
            # Rebounds of the hammer are part of the hit.
            last = int(np.flatnonzero(force > max(_REBOUND * there, _NOISY * noise))[-1:].sum())
            spread = 2 * int(np.ceil(info.filter.get("delay", 0.0))) + 2
            windows.append((begin, min(max(end, begin + last + spread), stop - 1)))
        arrivals = windows
        return cls(channel, tuple(arrivals), tuple(missed), interval)

    def inside(self, start: int, stop: int) -> list[tuple[int, int]]:
        """List the hits that lie completely within a stretch."""
        return [(begin, end) for begin, end in self.arrivals if begin >= start and end < stop]

    def moving(self, rec: Recording, names: Sequence[str], start: int, stop: int) -> float:
        """Estimate the largest motion or drift before the first hit of a stretch, relative to the response after it.

        Infinite if the record before the hit is too short.
        """
        begin = self.inside(start, stop)[0][0]
        first = max(start, begin - int(REST * rec.rate))
        if begin - first < 4 or any(other < begin for other, _ in self.arrivals):
            return np.inf
        # A short interval shows only a small part of a slow motion.
        largest, seen = 0.0, min(1.0, (begin - first) / (REST * rec.rate))
        for name in names:
            reading = rec.read(name, first, min(begin + self.interval, stop))
            before, after = reading[: begin - first], reading[begin - first :]
            size = float(abs(after - before.mean()).max())
            largest = max(largest, _amplitude(before) / (seen * size) if size else 0.0)
        return largest

    def at_rest(self, moving: float, start: int, stop: int, samples: int) -> bool:
        """Whether a stretch, zero-padded to `samples`, is treated as the response to its hits alone.

        There was hardly any motion before the hits, or a hit is so close to the beginning that the earlier motion
        cannot be separated from the response by their change from line to line.
        """
        if moving < _STILL:
            return True
        inside = self.inside(start, stop)
        return bool(np.isfinite(moving) and len(inside) == 1 and 2 * SIDE * (inside[0][0] - start) < samples)

    def alone(self, rec: Recording, names: Sequence[str], block: Array, start: int, rest: bool) -> Array:
        """Subtract the zero of all channels; reduce the force to the hits and invert its high-pass filters."""
        inside = self.inside(start, start + block.shape[1])
        quiet = slice(max(inside[0][0] - start - int(REST * rec.rate), 0), max(inside[0][0] - start, 1))
        out = block - (block[:, quiet] if rest else block).mean(axis=1, keepdims=True)
        row = names.index(self.channel)
        force = np.zeros(block.shape[1])
        for begin, end in inside:
            first = begin - start
            before = block[row, max(first - int(REST * rec.rate), 0) : first]
            # The mean before the hit is the tail of earlier hits, which is practically constant during this hit.
            piece = block[row, first:] - (before.mean() if before.size else 0.0)
            force[first:] += pulse_alone(rec.channels[self.channel], piece, 0, end - begin)
        out[row] = force
        if rest:
            # A sudden onset of integrator drift is a step, whose spectrum decreases more slowly than that of a
            # displacement and is as smooth. The readings fade in over the first half of the samples before the hit;
            # the hit may already appear in the second half through a filter.
            out, rise = out[:, quiet.start :], (quiet.stop - quiet.start) // 2
            slope = 0.5 - 0.5 * np.cos(np.pi * (np.arange(rise) + 0.5) / max(rise, 1))
            out = np.concatenate([out[:, :rise] * slope, out[:, rise:]], axis=1)
        return out

    def force_noise(self, rec: Recording, stretches: Sequence[tuple[int, int]], frequency: Array) -> Array:
        """Relative variance of either quadrature component of the force, due to noise during the hits.

        This error is common to all lines that a hit drives, so the scatter between lines does not show it.
        """
        power, noise = np.zeros(frequency.size), []
        info = rec.channels[self.channel]
        # Rounding adds 1/12 count² even if it is not visible before the hit.
        least = 0.0 if info.volts_per_count is None else info.unit_per_count**2 / 12.0
        for start, stop in stretches:
            for begin, end in self.inside(start, stop):
                before = rec.read(self.channel, max(start, begin - int(REST * rec.rate)), begin)
                pulse = rec.read(self.channel, begin, end + 1)
                turn = np.exp(-2j * np.pi / rec.rate * frequency[:, None] * np.arange(pulse.size))
                power += abs(turn @ (pulse - before.mean() if before.size else pulse)) ** 2
                if before.size > 2:
                    # Differences between samples are insensitive to the tail of an earlier hit.
                    noise.append(pulse.size * max(float(np.mean(np.diff(before) ** 2)) / 2.0, least))
        return 0.5 * float(np.mean(noise)) / np.maximum(power, 1e-300) if noise else np.zeros(frequency.size)

    def rounding(
        self,
        rec: Recording,
        names: Sequence[str],
        stretches: Sequence[tuple[int, int]],
        blocks: Sequence[Array],
        spectra: Sequence[ComplexArray],
        lines: NDArray[np.int64],
        side: int,
    ) -> Array:
        """Largest relative change of each channel's gain by rounding to counts, shape (channels, lines).

        Equal hits give equal counts, so averaging does not reduce the rounding error, and the error shortly after a hit
        looks like a response. It is estimated by coarser converters: from the change of the readings when they are
        rounded again, to every second and every third count. Noise of s counts reduces it by ``exp(-2 pi^2 s^2)`` (as
        in `noise_gain`). Infinite for readings of too few counts to be rounded again.
        """
        count = counts_of(rec, names)[:, None]
        step = np.where(count > 0.0, count, 1.0)
        size = 2 * (spectra[0].shape[1] - 1)
        # Low-order polynomials cannot separate errors closer to a hit than this from the response to it.
        near = int(size * (ORDER + 1) / side)
        power = np.sum([abs(each) ** 2 for each in spectra], axis=0)
        off, noise, most = np.zeros((len(_COARSER), *power.shape)), [], np.zeros(count.shape)
        for block, (start, stop) in zip(blocks, stretches, strict=True):
            for begin, _ in self.inside(start, stop):
                first = begin - (stop - block.shape[1])
                read = np.rint(block[:, first : first + near] / step)
                most = np.maximum(most, abs(read).max(axis=1, keepdims=True))
                for each, (times, more) in zip(off, _COARSER, strict=True):
                    each += abs(fft.rfft(times * np.rint(read / times) - read, size, axis=1)) ** 2 / more
                quiet = [rec.read(name, max(start, begin - int(REST * rec.rate)), begin) for name in names]
                if quiet[0].size > 2:
                    noise.append(np.mean(np.diff(quiet, axis=1) ** 2, axis=1, keepdims=True) / 2.0)
        through = scattered(np.mean(noise, axis=0) / step**2 if noise else np.zeros(count.shape))
        # Average over one tooth spacing of the comb spectrum of several hits and no farther: peaks do not represent
        # valleys.
        teeth = 2 * -(-side // SIDE) + 1
        around = scipy.ndimage.uniform_filter1d(power, teeth, axis=1, mode="nearest")
        off = scipy.ndimage.uniform_filter1d(off, side, axis=2, mode="nearest").max(axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            # The square of a normal error with two components is below three times its mean with 95 % probability.
            gain = (step * np.sqrt(3.0 * off / around))[:, lines]
        gain = np.where((most < _FEWEST_COUNTS) & (through > _SAME), np.inf, gain)
        return np.asarray(
            np.where(count > 0.0, through * np.nan_to_num(gain, nan=np.inf, posinf=np.inf), 0.0)
        )

    def highest_frequency(self, rec: Recording) -> float:
        """Highest frequency in Hz that the hits excite."""
        size = fft.next_fast_len(int(0.2 * rec.rate) + 64, real=True)
        power = np.zeros(size // 2 + 1)
        for begin, end in self.arrivals:
            piece = rec.read(self.channel, begin, min(begin + size, rec.samples))
            piece = np.nan_to_num(piece - np.nanmedian(piece))
            power += abs(fft.rfft(piece[: end - begin + 1], size)) ** 2
        highest = int(np.argmax(power))
        reach = np.flatnonzero(power[highest:] < _FAINT * power[highest])
        return float(min(highest + int(reach[0]) if reach.size else power.size, 0.4 * size) * rec.rate / size)


def _amplitude(reading: Array) -> float:
    """Amplitude of motion or drift in a reading; noise is excluded because it differs from sample to sample."""
    noise = 0.5 * np.mean(np.diff(reading) ** 2)
    middle, few = reading.size // 2, _SURE / np.sqrt(reading.size)
    drift = abs(reading[:middle].mean() - reading[middle:].mean()) - 2.0 * few * np.sqrt(noise)
    return float(max(drift, np.sqrt(2.0 * max(reading.var() - (1.0 + few * np.sqrt(2.0)) * noise, 0.0)), 0.0))
