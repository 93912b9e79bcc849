"""Frequency responses of tests without steady tones: local fits to the spectra of whole segments.

A *segment* is a part of the test without overloaded or lost samples. The local rational method (see `local_models`)
treats random excitation, bursts and hits in the same manner: it uses the measured force, and the transients at the
beginning and end of a segment are part of the fit. The response need not decay, no window adds damping, and double hits
are acceptable.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy import fft

from analysis.core.responses.clean_segments import clean_segments, describe_flaws, find_flaws, remedy
from analysis.core.responses.force_pulse import high_pass_response
from analysis.core.responses.local_models.jitter import jitter_factor
from analysis.core.responses.local_models.local_spectra import FIT_HALF_WIDTH, LocalSpectra
from analysis.core.responses.local_models.low_spectra import low_spectra
from analysis.core.responses.measurands import motion_of, reference_of, response_channels
from analysis.core.responses.systematic import noise_gain_error, power_in_counts
from rig.core.base.errors import RecordingError
from rig.core.results import format_percent
from rig.core.results.response import Response

if TYPE_CHECKING:
    from analysis.core.responses.clean_segments import Flaw
    from analysis.core.responses.hits import Hits
    from daq.core.recording.recording import Recording


# A segment is used if it has at least this fraction of the length of the longest; the transients of shorter segments
# need too many parameters.
_MIN_LENGTH_RATIO = 0.25
# A segment is used if it contains at least this fraction of a burst; with less, most of the vibration was excited
# before the segment.
_MIN_BURST_RATIO = 0.5
# Maximum number of lines of an estimated response.
_MAX_LINES = 1000
# Maximum number of samples of all channels in segments with hits; with their spectra they need just under a gigabyte.
_MAX_VALUES = 14_000_000
#: Name of the systematic error due to motion before a hit.
MOTION_BEFORE = "motion before the hit"
# This motion causes a warning if its amplitude exceeds this fraction of the response to the hit.
_MAX_MOTION_RATIO = 0.01


@dataclass(frozen=True)
class SegmentFits:
    """Interval, channels and frequency band of a test that is evaluated by local fits."""

    # a flaw of one of these channels excludes the samples of all, so that all responses have the same lines
    channels: tuple[str, ...]
    first: int  # first sample of the test
    stop: int  # one past its last sample
    low: float  # lower edge of the band in which responses are estimated, Hz
    high: float  # its upper edge, Hz
    other_flaws: Sequence[Flaw] = ()  # flaws other than overloads and lost samples
    hits: Hits | None = None  # hits of a hammer; None for other tests
    # period of bursts and duration of each burst in samples; None for tests without bursts
    bursts: tuple[int, int] | None = None
    label: str = ""  # for legends
    warnings: tuple[str, ...] = ()  # in full sentences
    # stored spectra, and motion before the hits of each segment, by channels
    stored: dict[tuple[str, ...], tuple[LocalSpectra, list[float]]] = field(default_factory=dict)

    def frf(self, rec: Recording, response: str, reference: str = "force", motion: str = "displacement") -> Response:
        """Estimate the frequency response with coherence, random and systematic errors."""
        numerator, denominator = motion_of(rec, response, motion), reference_of(rec, reference)
        names, noise = self.channels, None
        if self.hits is not None:
            # The channels of each response determine whether the rig was at rest before its hits.
            names = tuple(dict.fromkeys([*numerator.channels, *denominator.channels]))
        spectra, prior_motion, segments, notes = self.prepare(rec, names, denominator.channels)
        if self.hits is not None:
            noise = self.hits.force_noise(rec, segments, spectra.frequency[spectra.lines])
        frf = spectra.frf(rec, numerator, denominator, reference, motion, self.label, (*self.warnings, *notes), noise)
        return _with_motion_before(frf, prior_motion)

    def prepare(
        self, rec: Recording, names: tuple[str, ...], references: Sequence[str]
    ) -> tuple[LocalSpectra, list[float], list[tuple[int, int]], list[str]]:
        """Return spectra of the channels `names`, motion before the hits of each segment, the segments, and notes.

        `references`: channels of the reference, without which no response can be estimated.
        """
        all_flaws = find_flaws(rec, self.channels, self.first, self.stop)
        all_flaws = sorted([*all_flaws, *self.other_flaws], key=lambda flaw: flaw.first)
        segments, notes = self._sufficient_segments(rec, clean_segments(all_flaws, self.first, self.stop))
        segments, memory_notes = self._limit_memory(segments, rec.rate)
        notes += memory_notes
        if all_flaws:
            used_ratio = sum(stop - start for start, stop in segments) / (self.stop - self.first)
            notes.insert(
                0, f"{format_percent(1.0 - used_ratio)} of the test left out: {describe_flaws(rec, all_flaws)}."
            )
        if not segments:
            flawed = {flaw.channel for flaw in all_flaws}
            others = [name for name in response_channels(rec) if name in self.channels and name not in flawed]
            advice = f"no usable segment remains. {remedy(rec, all_flaws)}, and record again"
            if not all_flaws:
                advice = "the test is too short to average. Record longer"
            elif others and not flawed & set(references):
                advice += f", or use only the other channels: --response {' --response '.join(others)}"
            raise RecordingError(f"{rec.path}: {' '.join([*notes, f'No response can be estimated: {advice}.'])}")
        if names not in self.stored:
            prior_motion = []
            if self.hits is not None:
                prior_motion = [self.hits.prior_motion(rec, names, *bounds) for bounds in segments]
            self.stored[names] = self._spectra(rec, names, segments, prior_motion), prior_motion
        return *self.stored[names], segments, notes

    def _sufficient_segments(
        self, rec: Recording, clean: Sequence[tuple[int, int]]
    ) -> tuple[list[tuple[int, int]], list[str]]:
        """Select segments of sufficient length; for a hammer, only segments with a hit."""
        if self.hits is not None:
            clean = [segment for segment in clean if self.hits.inside(*segment)]
        if self.bursts is not None:
            # The samples between bursts contain no information, because the force of an undriven coil spring follows
            # from the response. A segment that begins late in a burst contains mainly the response to earlier force.
            period, on_samples = self.bursts
            clean = [
                (start, stop)
                for start, stop in clean
                if np.sum((np.arange(start, stop) - self.first) % period < on_samples)
                > max(4 * FIT_HALF_WIDTH, _MIN_BURST_RATIO * on_samples)
            ]
        # The frequency range of a fit must be smaller than the band. Hits are at least 0.2 s apart.
        min_length_s = 2 * FIT_HALF_WIDTH / (self.high - self.low) if self.hits is None else 0.2
        longest = max((stop - start for start, stop in clean), default=0)
        selected = [
            (start, stop)
            for start, stop in clean
            if stop - start >= max(_MIN_LENGTH_RATIO * longest, min_length_s * rec.rate, 4 * FIT_HALF_WIDTH)
        ]
        if clean and not selected:
            return [], [f"The longest usable segment lasts only {longest / rec.rate:.3g} s."]
        return selected, []

    def _limit_memory(self, segments: list[tuple[int, int]], rate: float) -> tuple[list[tuple[int, int]], list[str]]:
        """Select the first hits that fit into memory; random tests are read in pieces."""
        if self.hits is None:
            return segments, []
        free_samples, selected = _MAX_VALUES // len(self.channels), []
        for segment in segments:
            start, stop = segment
            if stop - start > free_samples:
                start = max(start, self.hits.inside(*segment)[0][0] - free_samples // 4)
                begins = [begin for begin, _ in self.hits.inside(start, stop)[1:] if begin - start <= free_samples]
                # The segment ends before a hit, or within the response to its only hit.
                stop = begins[-1] if begins else min(stop, start + free_samples)
            if not self.hits.inside(start, stop):
                break
            selected.append((start, stop))
            free_samples -= stop - start
            if selected[-1] != segment:
                break
        if selected == segments or not selected:
            return segments, []
        used, total = (sum(len(self.hits.inside(*bounds)) for bounds in chosen) for chosen in (selected, segments))
        return selected, [
            f"Only {used} of {total} hits are used, those before {selected[-1][1] / rate:.4g} s, because all hits need "
            "more than a gigabyte of memory. Record at a lower rate or with a shorter interval between hits."
        ]

    def _spectra(
        self, rec: Recording, names: Sequence[str], segments: Sequence[tuple[int, int]], prior_motion: Sequence[float]
    ) -> LocalSpectra:
        """Compute the spectra of all segments, each segment padded with zeros to the length of the longest."""
        # The transform is periodic: zeros separate the vibration at the end of a segment from the response to its hit.
        leading_zeros = 0 if self.hits is None else self.hits.interval
        # The length does not depend on motion before the hits, so that all responses have the same lines.
        size = fft.next_fast_len(max(stop - start for start, stop in segments) + leading_zeros, real=True)
        # The spectrum of periodic hits is a comb: it has no excitation between its lines.
        lines_per_comb_line = 1.0 if self.hits is None else max(1.0, size / leading_zeros)
        lines, half_width = self._lines(rec, size), int(np.ceil(FIT_HALF_WIDTH * lines_per_comb_line))
        # Bins that the fits use.
        first = max(int(lines[0]) - half_width, 0)
        fitted_bins = slice(first, min(max(int(lines[-1]) + half_width, first + 2 * half_width), size // 2) + 1)
        bins = np.arange(fitted_bins.stop)
        lengths = [stop - start for start, stop in segments]
        # Whether each segment is the response to its hits alone, without motion before them.
        at_rest = [False] * len(segments)
        jitter = np.zeros((0, len(names)))
        if self.hits is None:
            pairs = [low_spectra(rec, names, *bounds, size, fitted_bins.stop) for bounds in segments]
            channel_spectra = [spectra for spectra, _ in pairs]
            power = np.average([square for _, square in pairs], axis=0, weights=lengths)
            gain_error = np.repeat(noise_gain_error(power_in_counts(rec, names, power))[:, None], lines.size, axis=1)
        else:
            at_rest = [
                self.hits.is_response_to_hits_alone(motion, *bounds, size)
                for bounds, motion in zip(segments, prior_motion, strict=True)
            ]
            blocks = []
            for (start, stop), is_at_rest in zip(segments, at_rest, strict=True):
                block = np.stack([rec.read(name, start, stop) for name in names])
                blocks.append(self.hits.isolate(rec, names, block, start, is_at_rest))
            lengths = [block.shape[1] for block in blocks]
            padded = [np.pad(block, ((0, 0), (size - block.shape[1], 0))) for block in blocks]
            channel_spectra = [fft.rfft(block, axis=1) for block in padded]
            # The force includes the whole tail of its high-pass filters, which the recording may truncate.
            info = rec.channels[self.hits.channel]
            high_pass = high_pass_response(info, fft.rfftfreq(size, 1.0 / rec.rate))
            for spectra in channel_spectra:
                spectra[names.index(self.hits.channel)] *= high_pass
            inside = [hit for bounds in segments for hit in self.hits.inside(*bounds)]
            jitter = jitter_factor(rec, names, inside, size, half_width)
            gain_error = self.hits.rounding_gain_error(rec, names, segments, blocks, channel_spectra, lines, half_width)
        start_phases = np.exp(np.outer((size - np.array(lengths)) / size, -2j * np.pi * bins))
        end_phases = np.where(np.array(at_rest)[:, None], 0.0, start_phases)
        frequency = bins * (rec.rate / size)
        # The displacement at zero frequency is undefined; no line is there.
        frequency[0] = frequency[1]
        return LocalSpectra(
            tuple(names),
            np.stack(channel_spectra)[:, :, fitted_bins],
            end_phases[:, fitted_bins],
            frequency[fitted_bins],
            lines - first,
            half_width,
            sum(lengths) / (size * len(lengths)),
            gain_error,
            np.zeros(gain_error.shape),
            jitter,
        )

    def _lines(self, rec: Recording, size: int) -> NDArray[np.int64]:
        """Return the bins of a transform of `size` samples at which the response is estimated."""
        low, high = (edge * size / rec.rate for edge in (self.low, self.high))
        first, last = max(int(np.ceil(low - 1e-9)), 1), min(int(high + 1e-9), int(0.45 * size))
        if last <= first:
            raise RecordingError(
                f"{rec.path}: the resolution of {rec.rate / size:.3g} Hz leaves no spectral lines between "
                f"{self.low:.4g} and {self.high:.4g} Hz. Record longer."
            )
        return np.arange(first, last + 1, -(-(last - first) // _MAX_LINES))  # rounded up


def _with_motion_before(frf: Response, prior_motion: Sequence[float]) -> Response:
    """Add the error due to motion before the hits to a response's uncertainty, and warn if it is large."""
    largest = max((ratio for ratio in prior_motion if np.isfinite(ratio)), default=None)
    if largest is None:
        return frf
    warning = (
        f"{frf.response}: motion or drift before a hit, of {format_percent(largest)} of the response, affects the "
        "curve. Hit the structure at rest, start recording earlier, or record several hits in a row."
    )
    # The spectrum of a free decay has the shape of a resonance of the response. Every line is therefore treated as a
    # resonance with the magnitude of the response at this line; its skirts decrease with the distance from it.
    to_acceleration = (2.0 * np.pi * frf.frequency) ** {"displacement": 2, "velocity": 1, "acceleration": 0}[frf.motion]
    skirt = 1.0 / (np.pi * (np.abs(np.arange(1 - frf.value.size, frf.value.size)) + 1.0))
    accelerance = abs(frf.value) * to_acceleration
    error = largest * scipy.signal.fftconvolve(skirt, accelerance, mode="valid") / to_acceleration
    with_error = frf.with_limits({MOTION_BEFORE: error})
    return with_error.warn(warning) if largest > _MAX_MOTION_RATIO else with_error


def warn_of_dampers(rec: Recording) -> tuple[str, ...]:
    """Return a warning if dampers may move; the response is then valid only for this excitation."""
    if not any(damper.moves for damper in rec.scene.dampers):
        return ()
    return (
        "Moving dampers make the structure nonlinear: this curve is valid only for this level and kind of excitation, "
        "and its error bars assume linearity. Use stepped sine for the response to steady tones.",
    )
