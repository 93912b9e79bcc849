"""Frequency responses of tests that are no tones: clean stretches of the recording taken whole, fitted line by line.

Random, bursts and hits are all one to the local rational method: whatever the force was, it was measured; what a
stretch began with and what still rang when it ended is part of the fit. So nothing has to die away, no window adds
damping, a hammer that bounced is as good as one that did not, and what overloads or lost samples spoil is cut out.
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

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# A stretch shorter than this part of the longest is not worth its transients.
_WORTH = 0.25
# Nor is one that holds less than this part of a burst.
_BURST = 0.5
_MOST_LINES = 1000
# Values, of all channels, that stretches with hits may have: with their spectra they take just under a gigabyte.
_MOST_VALUES = 14_000_000
#: The systematic part that comes of what moved before a hit, and the threshold from which it is stated.
MOTION_BEFORE = "motion before the hit"
_MUCH = 0.01


@dataclass(frozen=True)
class WholeStretches:
    """What of a recording is to be fitted."""

    channels: tuple[str, ...]
    """All channels concerned: where one of them is spoilt, so are all, so that their curves have the
    same lines."""
    first: int
    """Samples between which the test ran."""
    stop: int
    """Samples between which the test ran."""
    low: float
    """Band in Hz in which responses are estimated."""
    high: float
    """Band in Hz in which responses are estimated."""
    missed: Sequence[Flaw] = ()
    """What is wrong with channels besides overloads and losses."""
    hits: Hits | None = None
    """Of a hammer: what is known of the force before and after each."""
    bursts: tuple[int, int] | None = None
    """Samples from one burst to the next, and those in which it is on, where the test comes in bursts."""
    label: str = ""
    """For legends."""
    warnings: tuple[str, ...] = ()
    """In full sentences."""
    made: dict[tuple[str, ...], tuple[LocalSpectra, list[float]]] = field(default_factory=dict)
    """Spectra made so far, by the channels they are of, and what moved before the hits of each stretch."""

    def frf(
        self, rec: Recording, response: str, reference: str = "force", motion: str = "displacement"
    ) -> Response:
        """Frequency response with coherence, random and systematic errors."""
        above, below = motion_of(rec, response, motion), reference_of(rec, reference)
        # Whether hits come upon rest, each response's own channels show.
        names = (
            self.channels if self.hits is None else tuple(dict.fromkeys([*above.channels, *below.channels]))
        )
        spectra, moving, stretches, notes = self.prepared(rec, names, below.channels)
        noise = None
        if self.hits is not None:
            noise = self.hits.force_noise(rec, stretches, spectra.frequency[spectra.lines])
        frf = spectra.frf(rec, above, below, reference, motion, self.label, (*self.warnings, *notes), noise)
        return _with_motion_before(frf, moving)

    def prepared(
        self, rec: Recording, names: tuple[str, ...], references: Sequence[str]
    ) -> tuple[LocalSpectra, list[float], list[tuple[int, int]], list[str]]:
        """Spectra of some channels, the motion before the hits of each stretch, the stretches, and notes on them."""
        found = flaws(rec, self.channels, self.first, self.stop)
        found = sorted([*found, *self.missed], key=lambda flaw: flaw.first)
        stretches, notes = self._worth_fitting(rec, clean_stretches(found, self.first, self.stop))
        stretches, few = self._in_memory(stretches, rec.rate)
        notes += few
        if found:
            kept = sum(stop - start for start, stop in stretches) / (self.stop - self.first)
            notes.insert(0, f"{1 - kept:.0%} of the test left out: {describe_flaws(rec, found)}.")
        if not stretches:
            advice = f"{cure(rec, found)}, and record again"
            spoilt = {flaw.channel for flaw in found}
            others = [name for name in responses(rec) if name in self.channels and name not in spoilt]
            if others and not spoilt & set(references):
                advice += f"; or take the others alone: --response {' --response '.join(others)}"
            if not found:
                advice = "the test is too short to average; record longer"
            raise RecordingError(f"{' '.join(notes)} Nothing is left to estimate a response from: {advice}")
        if names not in self.made:
            before = [] if self.hits is None else [self.hits.moving(rec, names, *each) for each in stretches]
            self.made[names] = self._spectra(rec, names, stretches, before), before
        return *self.made[names], stretches, notes

    def _worth_fitting(
        self, rec: Recording, clean: Sequence[tuple[int, int]]
    ) -> tuple[list[tuple[int, int]], list[str]]:
        """Stretches long enough to resolve something and, of a hammer, with a hit in them."""
        if self.hits is not None:
            clean = [stretch for stretch in clean if self.hits.inside(*stretch)]
        if self.bursts is not None:
            # Samples at rest between bursts carry no information: undriven, a spring's force follows its response.
            # After the end of a burst most of what rings was there before the stretch began.
            least = max(4 * SIDE, _BURST * self.bursts[1])
            clean = [stretch for stretch in clean if self._driven(*stretch) > least]
        # A fit reaches over so many lines, and must not reach over the whole band.
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
        """Keep the first hits, as many as memory takes at once; random tests are read in pieces."""
        if self.hits is None:
            return stretches, []
        left, kept = _MOST_VALUES // len(self.channels), []
        for whole in stretches:
            start, stop = whole
            if stop - start > left:
                start = max(start, self.hits.inside(*whole)[0][0] - left // 4)
                begins = [begin for begin, _ in self.hits.inside(start, stop)[1:] if begin - start <= left]
                # What rings of a single hit is cut where memory ends.
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
            f"Only {taken} of {there} hits are taken, those before {kept[-1][1] / rate:.4g} s: all at once take more "
            "than a gigabyte; a lower rate or a shorter interval between hits needs less."
        ]

    def _driven(self, start: int, stop: int) -> int:
        """Count the samples of a stretch in which bursts were on."""
        size, on = self.bursts or (1, 1)
        return int(np.sum((np.arange(start, stop) - self.first) % size < on))

    def _spectra(
        self,
        rec: Recording,
        names: Sequence[str],
        stretches: Sequence[tuple[int, int]],
        moving: Sequence[float],
    ) -> LocalSpectra:
        """Spectra of all stretches, each at the end of as many samples as the longest has."""
        lead = 0 if self.hits is None else self.hits.lead()
        # As long whether or not hits come upon rest, so that all responses have the same lines.
        size = fft.next_fast_len(max(stop - start for start, stop in stretches) + lead, real=True)
        # Hits alone are a comb of lines: between its teeth nothing is driven.
        teeth = 1.0 if self.hits is None else max(1.0, size / lead)
        lines, side = self._lines(rec, size), int(np.ceil(SIDE * teeth))
        # All that the fits reach.
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
            # Their response is that of the whole tail, which a recording may cut off.
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
        # The line at zero has no displacement: it takes no part.
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
                f"the recording resolves {rec.rate / size:.3g} Hz, and nothing between {self.low:.4g} and "
                f"{self.high:.4g} Hz; record longer"
            )
        return np.arange(first, last + 1, -(-(last - first) // _MOST_LINES))


def _with_motion_before(frf: Response, moving: Sequence[float]) -> Response:
    """Add to a curve's bound what moved before the hits and is in it, and warn where that is much."""
    known = [part for part in moving if np.isfinite(part)]
    if not known:
        return frf
    most = max(known)
    warning = (
        f"{frf.response}: motion or drift of {most:.1%} of the response came before a hit, and is in the curve; begin "
        "at rest and earlier, or record several hits in a row."
    )
    # A free decay's spectrum falls with the distance from its resonance, as that of the response to the hit does: every
    # line is taken for a resonance that holds what it and its width are.
    rate = (2.0 * np.pi * frf.frequency) ** {"displacement": 2, "velocity": 1, "acceleration": 0}[frf.motion]
    reach = 1.0 / (np.pi * (np.abs(np.arange(1 - frf.value.size, frf.value.size)) + 1.0))
    part = most * scipy.signal.fftconvolve(reach, abs(frf.value) * rate, mode="valid") / rate
    found = frf.with_limits({MOTION_BEFORE: part})
    return found.warn(warning) if most > _MUCH else found


def dampers_move(rec: Recording) -> tuple[str, ...]:
    """Warn of dampers that may move: a response without tones is then that of this excitation alone."""
    if not any(damper.moves for damper in rec.scene.dampers):
        return ()
    return (
        "Moving dampers make the structure nonlinear: this curve is valid only for this level and kind of excitation, "
        "and its error bars assume linearity. Use stepped sine for the response to steady tones.",
    )
