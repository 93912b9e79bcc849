"""Hits of a hammer: when, how hard, and what its force sensor read that was not the hit."""

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
from rig.errors import RecordingError

if TYPE_CHECKING:
    from daq.recording.recording import Recording

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# What is looked at before a hit, s, to see whether the rig was at rest, and read as the channel's zero.
REST = 0.2
# At rest what changes within that time is less than this part of the response that follows.
_STILL = 2e-3
# Noise is taken for motion where it is so many times as much as by its chance.
_SURE = 4.0
# The largest force belongs to the hit; where its marker holds less than this part of it, it missed the hit.
_MISSED = 0.5
# A hammer that bounces hits again with at least this part of its first force, and so many times the noise.
_REBOUND, _NOISY = 0.05, 8.0
# The spectrum of a force ends where its power is below this part of its highest.
_FAINT = 1e-2

# Counts that a coarser converter takes for one, and how much larger the mean square then is of what it changes than
# that of rounding to counts, a twelfth.
_COARSER = ((2.0, 6.0), (3.0, 8.0))
# Of fewer counts a coarser converter leaves next to nothing, unless noise, of half a count and more, lets no more than
# this share of rounding be the same each time.
_FEWEST_COUNTS, _SAME = 6.0, 0.007


@dataclass(frozen=True)
class Hits:
    """The hits of a recording."""

    channel: str
    """The force channel."""
    arrivals: tuple[tuple[int, int], ...]
    """First and last sample in which the force channel holds each hit."""
    missed: tuple[Flaw, ...]
    """Hits whose force is not where their marker is."""
    interval: int
    """Samples from one hit to the next, at least; after the last, to the end."""

    @classmethod
    def of(cls, rec: Recording) -> Hits:
        """Find the hits that the test marked."""
        channel = next((name for name, info in rec.channels.items() if info.quantity == "force"), None)
        if channel is None:
            raise RecordingError(
                "no force channel: an impact test gives a frequency response only with the hammer recorded; "
                "add {name: hammer, at: hammer} to the scene's channels, or use `analysis decay`"
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
                f"blocks of {interval / rec.rate:.3g} s between hits are too short: test: interval"
            )
        missed, windows = [], []
        for (begin, end), stop in zip(arrivals, [*starts[1:], rec.samples], strict=True):
            force = rec.read(channel, begin, stop)
            noise = np.sqrt(np.nanmedian(np.diff(force) ** 2))
            force = abs(force - np.nanmedian(force))
            there, raw = (float(np.nanmax(part, initial=0.0)) for part in (force[: end - begin + 1], force))
            if there < _MISSED * raw:
                reason = (
                    f"reads {there:.3g} N at most where the hit is marked, at {begin / rec.rate:.4g} s, and "
                    f"{raw:.3g} N elsewhere: the marker or the channel's delay is wrong"
                )
                missed.append(Flaw(begin, stop, channel, reason))
            # A hammer that bounces hits again: what it then does belongs to the hit.
            last = int(np.flatnonzero(force > max(_REBOUND * there, _NOISY * noise))[-1:].sum())
            spread = 2 * int(np.ceil(info.filter.get("delay", 0.0))) + 2
            windows.append((begin, min(max(end, begin + last + spread), stop - 1)))
        arrivals = windows
        return cls(channel, tuple(arrivals), tuple(missed), interval)

    def inside(self, start: int, stop: int) -> list[tuple[int, int]]:
        """Hits that a stretch holds whole."""
        return [(begin, end) for begin, end in self.arrivals if begin >= start and end < stop]

    def lead(self) -> int:
        """Count the samples of rest to put in front of a stretch that begins at rest.

        So the hit comes long after the beginning, as does the end of the record, and what rings on at the end can
        be separated from the response to the hit.
        """
        return self.interval

    def moving(self, rec: Recording, names: Sequence[str], start: int, stop: int) -> float:
        """Size of what moved or drifted before the first hit of a stretch, as a part of the response that follows.

        The largest of all channels; infinite if too little was recorded before the hit to say.
        """
        begin = self.inside(start, stop)[0][0]
        first = max(start, begin - int(REST * rec.rate))
        if begin - first < 4 or any(other < begin for other, _ in self.arrivals):
            return np.inf
        # A short look sees little of a slow motion.
        largest, seen = 0.0, min(1.0, (begin - first) / (REST * rec.rate))
        for name in names:
            reading = rec.read(name, first, min(begin + self.interval, stop))
            before, after = reading[: begin - first], reading[begin - first :]
            size = float(abs(after - before.mean()).max())
            largest = max(largest, _amplitude(before) / (seen * size) if size else 0.0)
        return largest

    def at_rest(self, moving: float, start: int, stop: int, samples: int) -> bool:
        """Whether a stretch, among zeros up to so many samples, is taken as the response to its hits alone.

        It is where hardly anything moved before them; and where one hit comes so soon that what moved before cannot be
        separated from the response to it by how they change from line to line.
        """
        if moving < _STILL:
            return True
        inside = self.inside(start, stop)
        return bool(np.isfinite(moving) and len(inside) == 1 and 2 * SIDE * (inside[0][0] - start) < samples)

    def alone(self, rec: Recording, names: Sequence[str], block: Array, start: int, rest: bool) -> Array:
        """Take the zero off all channels, and off the force all that is not a hit, high-passes included."""
        inside = self.inside(start, start + block.shape[1])
        quiet = slice(max(inside[0][0] - start - int(REST * rec.rate), 0), max(inside[0][0] - start, 1))
        out = block - (block[:, quiet] if rest else block).mean(axis=1, keepdims=True)
        row = names.index(self.channel)
        force = np.zeros(block.shape[1])
        for begin, end in inside:
            first = begin - start
            before = block[row, max(first - int(REST * rec.rate), 0) : first]
            # What was there before is the tail of earlier hits, which hardly changes while this one lasts.
            piece = block[row, first:] - (before.mean() if before.size else 0.0)
            force[first:] += pulse_alone(rec.channels[self.channel], piece, 0, end - begin)
        out[row] = force
        if rest:
            out = _faded_in(out[:, quiet.start :], quiet.stop - quiet.start)
        return out

    def force_noise(self, rec: Recording, stretches: Sequence[tuple[int, int]], frequency: Array) -> Array:
        """Variance of either quadrature component of the force, relative, for the noise in it while hits last.

        It is the same for all lines that a hit drives, so that no scatter from line to line shows it.
        """
        power, noise = np.zeros(frequency.size), []
        info = rec.channels[self.channel]
        # Rounding leaves a twelfth of a count squared, whether or not it shows before the hit.
        least = 0.0 if info.volts_per_count is None else info.unit_per_count**2 / 12.0
        for start, stop in stretches:
            for begin, end in self.inside(start, stop):
                before = rec.read(self.channel, max(start, begin - int(REST * rec.rate)), begin)
                pulse = rec.read(self.channel, begin, end + 1)
                turn = np.exp(-2j * np.pi / rec.rate * frequency[:, None] * np.arange(pulse.size))
                power += abs(turn @ (pulse - before.mean() if before.size else pulse)) ** 2
                if before.size > 2:
                    # Differences from sample to sample know nothing of the tail of an earlier hit.
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
        """How far rounding to counts can change each channel's gain, relative, shape (channels, lines).

        What follows a hit is read as the same counts after each equal hit, so that no averaging helps, and what is off
        soon after it passes for response: of what has decayed to half a count nothing is read, and a tone of few counts
        has harmonics. Coarser converters show how much: what readings differ by when they are rounded once more, to
        every second and every third count. Noise of s counts lets ``exp(-2 pi^2 s^2)`` of this through (Widrow and
        Kollár, as in `noise_gain`). Readings of too few counts to be rounded once more determine nothing: infinite.

        Parameters
        ----------
        blocks, spectra : sequences of ndarray
            Of the stretches, shape (channels, samples), and with zeros before, shape (channels, bins).
        lines : ndarray of int
            Bins at which the response is estimated.
        side : int
            Lines to either side that a fit takes in.
        """
        count = counts_of(rec, names)[:, None]
        step = np.where(count > 0.0, count, 1.0)
        size = 2 * (spectra[0].shape[1] - 1)
        # What is nearer to a hit than this, low polynomials cannot separate from the response to it.
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
        # From tooth to tooth of the comb that several hits leave, and no farther: peaks say nothing of valleys.
        teeth = 2 * -(-side // SIDE) + 1
        around = scipy.ndimage.uniform_filter1d(power, teeth, axis=1, mode="nearest")
        off = scipy.ndimage.uniform_filter1d(off, side, axis=2, mode="nearest").max(axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            # Of a normal error with two components the square is in 95 % of cases below three times its mean.
            gain = (step * np.sqrt(3.0 * off / around))[:, lines]
        gain = np.where((most < _FEWEST_COUNTS) & (through > _SAME), np.inf, gain)
        return np.asarray(
            np.where(count > 0.0, through * np.nan_to_num(gain, nan=np.inf, posinf=np.inf), 0.0)
        )

    def lowest_frequency(self, rec: Recording) -> float:
        """Frequency in Hz below which the time between hits resolves nothing."""
        return 4.0 * rec.rate / self.interval

    def highest_frequency(self, rec: Recording) -> float:
        """Frequency in Hz beyond which the hits no longer drive anything."""
        size = fft.next_fast_len(int(0.2 * rec.rate) + 64, real=True)
        power = np.zeros(size // 2 + 1)
        for begin, end in self.arrivals:
            piece = rec.read(self.channel, begin, min(begin + size, rec.samples))
            piece = np.nan_to_num(piece - np.nanmedian(piece))
            power += abs(fft.rfft(piece[: end - begin + 1], size)) ** 2
        highest = int(np.argmax(power))
        reach = np.flatnonzero(power[highest:] < _FAINT * power[highest])
        return float(min(highest + int(reach[0]) if reach.size else power.size, 0.4 * size) * rec.rate / size)


def _faded_in(readings: Array, quiet: int) -> Array:
    """Let readings begin softly: they rise in the first half of so many quiet samples in front of a hit.

    Drift of an integrator that sets in at once is a step, whose spectrum falls more slowly than any displacement's: far
    above the resonances it would be more than the response, and as even as that. In the half next to the hit a filter
    may already show it.
    """
    rise = quiet // 2
    slope = 0.5 - 0.5 * np.cos(np.pi * (np.arange(rise) + 0.5) / max(rise, 1))
    return np.concatenate([readings[:, :rise] * slope, readings[:, rise:]], axis=1)


def _amplitude(reading: Array) -> float:
    """Amplitude of what moves or drifts in a reading; noise differs from sample to sample, motion hardly does."""
    noise = 0.5 * np.mean(np.diff(reading) ** 2)
    middle, few = reading.size // 2, _SURE / np.sqrt(reading.size)
    drift = abs(reading[:middle].mean() - reading[middle:].mean()) - 2.0 * few * np.sqrt(noise)
    return float(max(drift, np.sqrt(2.0 * max(reading.var() - (1.0 + few * np.sqrt(2.0)) * noise, 0.0)), 0.0))
