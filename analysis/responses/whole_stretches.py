"""Frequency responses of tests without tones: local fits to the spectra of complete clean stretches.

The local rational method treats random excitation, bursts and hits in the same manner, because the force was measured
and the transients at the beginning and end of a stretch are part of the fit. The response need not decay, no window
adds damping, and double hits are acceptable. Samples with overloads or losses are excluded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy import fft

from analysis.responses.clean_stretches import clean_stretches, cure, describe_flaws, flaws
from analysis.responses.force_pulse import high_passes
from analysis.responses.local_models.jitter import jitter_factor
from analysis.responses.local_models.local_spectra import SIDE, LocalSpectra
from analysis.responses.local_models.low_spectra import low_spectra
from analysis.responses.measurands import motion_of, reference_of, responses
from analysis.responses.systematic import in_counts, noise_gain
from rig.errors import RecordingError
from rig.results.response import Response

if TYPE_CHECKING:
    from analysis.responses.clean_stretches import Flaw
    from analysis.responses.hits import Hits
    from daq.recording.recording import Recording


# Stretches shorter than this part of the longest are omitted, because their transients need too many parameters.
_WORTH = 0.25
# Stretches with less than this part of a burst are omitted, too.
_BURST = 0.5
_MOST_LINES = 1000
# Limit of the samples of all channels in stretches with hits; with their spectra they use just under a gigabyte.
_MOST_VALUES = 14_000_000
#: The systematic part due to motion before a hit, and the threshold of its warning.
MOTION_BEFORE = "motion before the hit"
_MUCH = 0.01


@dataclass(frozen=True)
class WholeStretches:
    """Samples and band of a recording for local fits."""

    # a flaw of one excludes the samples of all, so that the curves have equal lines
    channels: tuple[str, ...]
    first: int  # samples between which the test ran
    stop: int
    low: float  # band in Hz in which responses are estimated
    high: float
    missed: Sequence[Flaw] = ()  # flaws of channels in addition to overloads and losses
    hits: Hits | None = None  # hits of a hammer, with the noise of the force before and after each hit
    # period of bursts and duration of each burst in samples; None for tests without bursts
    bursts: tuple[int, int] | None = None
    label: str = ""  # for legends
    warnings: tuple[str, ...] = ()  # in full sentences
    # stored spectra by channels, and the motion before the hits of each stretch
    made: dict[tuple[str, ...], tuple[LocalSpectra, list[float]]] = field(default_factory=dict)

    def frf(
        self, rec: Recording, response: str, reference: str = "force", motion: str = "displacement"
    ) -> Response:
        """Estimate the frequency response with coherence, random and systematic errors."""
        above, below = motion_of(rec, response, motion), reference_of(rec, reference)
        names, noise = self.channels, None
        if self.hits is not None:
            # The channels of each response determine whether the rig was at rest before its hits.
            names = tuple(dict.fromkeys([*above.channels, *below.channels]))
        spectra, moving, stretches, notes = self.prepared(rec, names, below.channels)
        if self.hits is not None:
            noise = self.hits.force_noise(rec, stretches, spectra.frequency[spectra.lines])
        frf = spectra.frf(rec, above, below, reference, motion, self.label, (*self.warnings, *notes), noise)
        return _with_motion_before(frf, moving)

    def prepared(
        self, rec: Recording, names: tuple[str, ...], references: Sequence[str]
    ) -> tuple[LocalSpectra, list[float], list[tuple[int, int]], list[str]]:
        """Return spectra, motion before the hits of each stretch, the stretches, and notes on them."""
        found = flaws(rec, self.channels, self.first, self.stop)
        found = sorted([*found, *self.missed], key=lambda flaw: flaw.first)
        stretches, notes = self._worth_fitting(rec, clean_stretches(found, self.first, self.stop))
        stretches, few = self._in_memory(stretches, rec.rate)
        notes += few
        if found:
            kept = sum(stop - start for start, stop in stretches) / (self.stop - self.first)
            notes.insert(0, f"{1 - kept:.0%} of the test left out: {describe_flaws(rec, found)}.")
        if not stretches:
            spoilt = {flaw.channel for flaw in found}
            others = [name for name in responses(rec) if name in self.channels and name not in spoilt]
            advice = f"the test is flawed. {cure(rec, found)}, and record again"
            if not found:
                advice = "the test is too short to average. Record longer"
            elif others and not spoilt & set(references):
                advice += f", or use only the other channels: --response {' --response '.join(others)}"
            raise RecordingError(
                f"{rec.path}: {' '.join([*notes, f'No response can be estimated: {advice}.'])}"
            )
        if names not in self.made:
            before = [] if self.hits is None else [self.hits.moving(rec, names, *each) for each in stretches]
            self.made[names] = self._spectra(rec, names, stretches, before), before
        return *self.made[names], stretches, notes

    def _worth_fitting(
        self, rec: Recording, clean: Sequence[tuple[int, int]]
    ) -> tuple[list[tuple[int, int]], list[str]]:
        """Select stretches of sufficient length; for a hammer, only stretches with a hit."""
        if self.hits is not None:
            clean = [stretch for stretch in clean if self.hits.inside(*stretch)]
        if self.bursts is not None:
            # Samples at rest between bursts carry no information: undriven, a spring's force follows its response.
            # After the end of a burst, most of the vibration was excited before the stretch began.
            size, on = self.bursts
            clean = [
                (start, stop)
                for start, stop in clean
                if np.sum((np.arange(start, stop) - self.first) % size < on) > max(4 * SIDE, _BURST * on)
            ]
        # The range of a fit must be smaller than the band.
        least = 2 * SIDE / (self.high - self.low) if self.hits is None else 0.2
        longest = max((stop - start for start, stop in clean), default=0)
        worth = [
            (start, stop)
            for start, stop in clean
            if stop - start >= max(_WORTH * longest, least * rec.rate, 4 * SIDE)
        ]
        if clean and not worth:
            return [], [f"No stretch longer than {longest / rec.rate:.3g} s is clean."]
        return worth, []

    def _in_memory(
        self, stretches: list[tuple[int, int]], rate: float
    ) -> tuple[list[tuple[int, int]], list[str]]:
        """Limit hits to the first that fit into memory; random tests are read in pieces."""
        if self.hits is None:
            return stretches, []
        left, kept = _MOST_VALUES // len(self.channels), []
        for whole in stretches:
            start, stop = whole
            if stop - start > left:
                start = max(start, self.hits.inside(*whole)[0][0] - left // 4)
                begins = [begin for begin, _ in self.hits.inside(start, stop)[1:] if begin - start <= left]
                # The response to a single hit is truncated at the memory limit.
                stop = begins[-1] if begins else min(stop, start + left)
            if not self.hits.inside(start, stop):
                break
            kept.append((start, stop))
            left -= stop - start
            if kept[-1] != whole:
                break
        if kept == stretches or not kept:
            return stretches, []
        taken, there = (sum(len(self.hits.inside(*each)) for each in some) for some in (kept, stretches))
        return kept, [
            f"Only {taken} of {there} hits are used, those before {kept[-1][1] / rate:.4g} s, because all of them need "
            "more than a gigabyte of memory. Record at a lower rate or with a shorter interval between hits."
        ]

    def _spectra(
        self,
        rec: Recording,
        names: Sequence[str],
        stretches: Sequence[tuple[int, int]],
        moving: Sequence[float],
    ) -> LocalSpectra:
        """Compute the spectra of all stretches, zero-padded at the beginning to the length of the longest."""
        # Rest before each stretch separates the residual vibration at its end from the response to its hit.
        lead = 0 if self.hits is None else self.hits.interval
        # The length does not depend on motion before the hits, so that all responses have the same lines.
        size = fft.next_fast_len(max(stop - start for start, stop in stretches) + lead, real=True)
        # The spectrum of periodic hits is a comb of lines, without excitation between its teeth.
        teeth = 1.0 if self.hits is None else max(1.0, size / lead)
        lines, side = self._lines(rec, size), int(np.ceil(SIDE * teeth))
        # Range of bins of the fits.
        first = max(int(lines[0]) - side, 0)
        reach = slice(first, min(max(int(lines[-1]) + side, first + 2 * side), size // 2) + 1)
        bins = np.arange(reach.stop)
        lengths, rests = [stop - start for start, stop in stretches], [False] * len(stretches)
        jitter = np.zeros((0, len(names)))
        if self.hits is None:
            found = [low_spectra(rec, names, *each, size, reach.stop) for each in stretches]
            samples = [spectra for spectra, _ in found]
            power = np.average([square for _, square in found], axis=0, weights=lengths)
            gain = np.repeat(noise_gain(in_counts(rec, names, power))[:, None], lines.size, axis=1)
        else:
            rests = [
                self.hits.at_rest(moved, *each, size) for each, moved in zip(stretches, moving, strict=True)
            ]
            blocks = []
            for (start, stop), rest in zip(stretches, rests, strict=True):
                block = np.stack([rec.read(name, start, stop) for name in names])
                blocks.append(self.hits.alone(rec, names, block, start, rest))
            lengths = [block.shape[1] for block in blocks]
            padded = [np.pad(block, ((0, 0), (size - block.shape[1], 0))) for block in blocks]
            samples = [fft.rfft(block, axis=1) for block in padded]
            # Their response includes the whole tail, which the recording may truncate.
            info = rec.channels[self.hits.channel]
            turn = high_passes(info, fft.rfftfreq(size, 1.0 / rec.rate))
            for each in samples:
                each[names.index(self.hits.channel)] *= turn
            inside = [hit for each in stretches for hit in self.hits.inside(*each)]
            jitter = jitter_factor(rec, names, inside, size, side)
            gain = self.hits.rounding(rec, names, stretches, blocks, samples, lines, side)
        begins = np.exp(np.outer((size - np.array(lengths)) / size, -2j * np.pi * bins))
        ends = np.where(np.array(rests)[:, None], 0.0, begins)
        frequency = bins * (rec.rate / size)
        # The displacement at zero frequency is undefined; this line is not used.
        frequency[0] = frequency[1]
        return LocalSpectra(
            tuple(names),
            np.stack(samples)[:, :, reach],
            ends[:, reach],
            frequency[reach],
            lines - first,
            side,
            sum(lengths) / (size * len(lengths)),
            gain,
            np.zeros(gain.shape),
            jitter,
        )

    def _lines(self, rec: Recording, size: int) -> NDArray[np.int64]:
        low, high = (edge * size / rec.rate for edge in (self.low, self.high))
        first, last = max(int(np.ceil(low - 1e-9)), 1), min(int(high + 1e-9), int(0.45 * size))
        if last <= first:
            raise RecordingError(
                f"{rec.path}: the resolution of {rec.rate / size:.3g} Hz leaves no lines between {self.low:.4g} and "
                f"{self.high:.4g} Hz. Record longer."
            )
        return np.arange(first, last + 1, -(-(last - first) // _MOST_LINES))


def _with_motion_before(frf: Response, moving: Sequence[float]) -> Response:
    """Add the effect of motion before the hits to a curve's bound, and warn if it is large."""
    most = max((part for part in moving if np.isfinite(part)), default=None)
    if most is None:
        return frf
    warning = (
        f"{frf.response}: motion or drift of {most:.1%} of the response before a hit, which affects the curve. Begin "
        "at rest and earlier, or record several hits in a row."
    )
    # The spectrum of a free decay decreases with the distance from its resonance in proportion to the response to the
    # hit. Every line is therefore treated as a resonance with the magnitude and width of the curve at this line.
    rate = (2.0 * np.pi * frf.frequency) ** {"displacement": 2, "velocity": 1, "acceleration": 0}[frf.motion]
    reach = 1.0 / (np.pi * (np.abs(np.arange(1 - frf.value.size, frf.value.size)) + 1.0))
    part = most * scipy.signal.fftconvolve(reach, abs(frf.value) * rate, mode="valid") / rate
    found = frf.with_limits({MOTION_BEFORE: part})
    return found.warn(warning) if most > _MUCH else found


def dampers_move(rec: Recording) -> tuple[str, ...]:
    """Warn of dampers that may move; the response is then valid only for this excitation."""
    if not any(damper.moves for damper in rec.scene.dampers):
        return ()
    return (
        "Moving dampers make the structure nonlinear: this curve is valid only for this level and kind of excitation, "
        "and its error bars assume linearity. Use stepped sine for the response to steady tones.",
    )
