"""Frequency responses of tests without steady tones: local fits to the spectra of whole segments.

A *segment* is a part of the test without overloaded or lost samples. The local rational method (see `local_models`)
treats random excitation, bursts and impacts in the same manner: it uses the measured force, and the transients at the
beginning and end of a segment are part of the fit. The response need not decay, no window adds damping, and double
impacts are acceptable.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy import fft

from analysis.core.responses.checks.clean_segments import Flaw, clean_segments, describe_flaws, find_flaws, remedy
from analysis.core.responses.errors.systematic import noise_gain_error, power_in_counts
from analysis.core.responses.force_pulse import high_pass_response
from analysis.core.responses.hammer_impacts import PRE_IMPACT_S, HammerImpacts
from analysis.core.responses.impact_errors import force_noise, jitter_factor, rounding_gain_error
from analysis.core.responses.local_models.local_spectra import FIT_HALF_WIDTH, LocalSpectra
from analysis.core.responses.local_models.low_spectra import low_spectra
from analysis.core.responses.measurands import Measurand, response_channels
from daq.core.recording.recording import Recording
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import RecordingError
from rig.core.results import format_percent
from rig.core.results.response import Response
from rig.core.results.uncertainty import UncertaintyBudget

# Smallest length of a used segment, relative to the longest; shorter segments need too many transients.
_MIN_LENGTH_RATIO = 0.25
# Smallest fraction of a burst in a used segment; otherwise most of its vibration was excited before.
_MIN_BURST_RATIO = 0.5
# Maximum number of lines of an estimated response.
_MAX_LINES = 1000
# Maximum number of impacts of one local fit. More impacts are fitted in groups, whose responses are averaged.
_MAX_HITS = 24
# Maximum of impacts of a group times responses, whose residuals remain in memory (1.2 MB each).
_MAX_RESIDUALS = 192
# Maximum number of samples of a group of impacts; the spectra of a response and of the force need 0.5 GB.
_MAX_SAMPLES = 3 << 20
#: Name of the systematic error due to motion before an impact.
MOTION_BEFORE = "motion before the impact"
# Largest motion before an impact without a warning, relative to the response: an error of this order.
_MAX_MOTION_RATIO = 0.01


@dataclass(frozen=True)
class SegmentFits:
    """Interval, channels and frequency band of a test that is evaluated by local fits."""

    # channels; a flaw of one channel excludes the samples of all channels, so all responses have the same lines
    channels: tuple[str, ...]
    first: int  # first sample of the test
    stop: int  # one past the last sample of the test
    low: float  # lower edge of the band in which responses are estimated [Hz]
    high: float  # upper edge of the band [Hz]
    other_flaws: Sequence[Flaw] = ()  # flaws other than overloads and lost samples
    impacts: HammerImpacts | None = None  # impacts of a hammer; None for other tests
    # period of bursts and duration of each burst in samples; None for tests without bursts
    bursts: tuple[int, int] | None = None
    warnings: tuple[str, ...] = ()  # in full sentences
    # spectra of a random test, because all responses use the same spectra
    stored: list[LocalSpectra] = field(default_factory=list)

    def frf(
        self, rec: Recording, numerator: Measurand, denominator: Measurand, others: Sequence[Measurand] = ()
    ) -> Response:
        """Estimate the frequency response with coherence, random and systematic errors; `others`: other inputs."""
        segments, notes = self.usable_segments(rec, [name for each in (denominator, *others) for name in each.channels])
        warnings = (*self.warnings, *notes)
        if self.impacts is None:
            if not self.stored:
                longest = max(stop - start for start, stop in segments)
                self.stored.append(self._spectra(rec, self.channels, segments, [], longest))
            return self.stored[0].frf(rec, numerator, denominator, others, warnings=warnings)
        # Whether the rig was at rest before the impacts is determined from the channels of each response.
        names = tuple(dict.fromkeys([*numerator.channels, *denominator.channels]))
        longest = max(stop - start for start, stop in segments)
        curves: list[Response] = []
        for group in self._groups(segments):
            prior_motion = [self.impacts.prior_motion(rec, names, *bounds) for bounds in group]
            spectra = self._spectra(rec, names, group, prior_motion, longest)
            noise = force_noise(self.impacts, rec, group, spectra.frequency[spectra.lines])
            frf = spectra.frf(rec, numerator, denominator, reference_noise=noise, warnings=warnings)
            frf = _with_motion_before(frf, prior_motion)
            # The arrays of the errors are large: those of the first group are stored, and represent all groups.
            curves.append(replace(frf, uncertainty=replace(frf.uncertainty, errors=None)) if curves else frf)
        return _average(curves)

    def usable_segments(self, rec: Recording, references: Sequence[str]) -> tuple[list[tuple[int, int]], list[str]]:
        """Return the segments in which all `references` are usable, and notes on omitted segments."""
        all_flaws = find_flaws(rec, self.channels, self.first, self.stop)
        all_flaws = sorted([*all_flaws, *self.other_flaws], key=lambda flaw: flaw.first)
        segments, notes = self._sufficient_segments(rec, clean_segments(all_flaws, self.first, self.stop))
        if self.impacts is not None:
            segments, split_notes = self._split_at_impacts(segments, rec.rate)
            notes += split_notes
        if all_flaws:
            used_ratio = sum(stop - start for start, stop in segments) / (self.stop - self.first)
            notes.insert(
                0, f"{format_percent(1.0 - used_ratio)} of the test omitted: {describe_flaws(rec, all_flaws)}."
            )
        if not segments:
            flawed = {flaw.channel for flaw in all_flaws}
            others = [name for name in response_channels(rec) if name in self.channels and name not in flawed]
            advice = f"no usable segment remains. {remedy(rec, all_flaws)}, and record again"
            if not all_flaws:
                advice = "the test is too short to average. Record longer"
            elif others and not flawed & set(references):
                advice += f", or use only the other channels (`response`: {', '.join(others)})"
            raise RecordingError(f"{rec.path}: {' '.join([*notes, f'No response can be estimated: {advice}.'])}")
        return segments, notes

    def _sufficient_segments(
        self, rec: Recording, clean: Sequence[tuple[int, int]]
    ) -> tuple[list[tuple[int, int]], list[str]]:
        """Select segments of sufficient length; for a hammer, only segments with an impact."""
        if self.impacts is not None:
            clean = [segment for segment in clean if self.impacts.inside(*segment)]
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
        # The frequency range of a fit must be smaller than the band. Impacts are at least 0.2 s apart.
        min_length_s = 2 * FIT_HALF_WIDTH / (self.high - self.low) if self.impacts is None else 0.2
        longest = max((stop - start for start, stop in clean), default=0)
        selected = [
            (start, stop)
            for start, stop in clean
            if stop - start >= max(_MIN_LENGTH_RATIO * longest, min_length_s * rec.rate, 4 * FIT_HALF_WIDTH)
        ]
        if clean and not selected:
            return [], [f"The longest usable segment lasts only {longest / rec.rate:.3g} s."]
        return selected, []

    @property
    def _max_impacts(self) -> int:
        """Return the maximum number of impacts that are fitted together; the last channel is the force."""
        return min(max(_MAX_RESIDUALS // max(len(self.channels) - 1, 1), 1), _MAX_HITS)

    def _split_at_impacts(
        self, segments: list[tuple[int, int]], rate: float
    ) -> tuple[list[tuple[int, int]], list[str]]:
        """Split segments before impacts so that no segment has more impacts or samples than one fit can include."""
        # The vibration that remains from earlier impacts is a transient of the fit.
        assert self.impacts is not None
        impacts = self.impacts
        count = sum(len(impacts.inside(*segment)) for segment in segments)
        if count <= self._max_impacts and sum(stop - start for start, stop in segments) <= _MAX_SAMPLES:
            return segments, []
        # The groups have nearly equal numbers of impacts, because their responses have equal weight.
        max_impacts = -(-count // -(-count // self._max_impacts))  # both rounded up
        n_before = min(int(PRE_IMPACT_S * rate), impacts.interval // 2)
        parts, is_cut = [], False
        for start, stop in segments:
            begins = [begin for begin, _ in impacts.inside(start, stop)]
            edges, n_impacts = [start], 0
            for begin, end in pairwise([*(begin - n_before for begin in begins), stop]):
                if n_impacts and (n_impacts == max_impacts or end - edges[-1] > _MAX_SAMPLES):
                    edges.append(begin)
                    n_impacts = 0
                n_impacts += 1
            for first, last in pairwise([*edges, stop]):
                # Only a segment with a single impact can be longer than the limit.
                if last - first > _MAX_SAMPLES:
                    is_cut, first = True, max(first, impacts.inside(first, last)[0][0] - _MAX_SAMPLES // 4)
                parts.append((first, min(last, first + _MAX_SAMPLES)))
        note = (
            f"Of the response to an impact, at most {_MAX_SAMPLES / rate:.4g} s are used, because more needs a "
            "gigabyte of memory. Record at a lower rate to use more."
        )
        return parts, [note] if is_cut else []

    def _groups(self, segments: Sequence[tuple[int, int]]) -> list[list[tuple[int, int]]]:
        """Combine the segments that contain impacts into groups; all segments of a group are fitted together."""
        assert self.impacts is not None
        groups: list[list[tuple[int, int]]] = []
        n_impacts = n_samples = 0
        for start, stop in segments:
            count = len(self.impacts.inside(start, stop))
            n_impacts, n_samples = n_impacts + count, n_samples + stop - start
            if not groups or n_impacts > self._max_impacts or n_samples > _MAX_SAMPLES:
                groups.append([])
                n_impacts, n_samples = count, stop - start
            groups[-1].append((start, stop))
        return groups

    def _spectra(
        self,
        rec: Recording,
        names: Sequence[str],
        segments: Sequence[tuple[int, int]],
        prior_motion: Sequence[float],
        longest: int,
    ) -> LocalSpectra:
        """Compute the spectra of segments, each padded with zeros to the length of the longest of the test."""
        # The transform is periodic: zeros separate the end of a segment from the response to its impact.
        leading_zeros = 0 if self.impacts is None else min(self.impacts.interval, longest)
        # The length does not depend on motion before the impacts, so all responses have the same lines.
        size = fft.next_fast_len(longest + leading_zeros, real=True)
        # The spectrum of periodic impacts is a comb: it has no excitation between its lines.
        lines_per_comb_line = 1.0 if self.impacts is None else max(1.0, size / leading_zeros)
        lines, half_width = self._lines(rec, size), int(np.ceil(FIT_HALF_WIDTH * lines_per_comb_line))
        # Bins that the fits use.
        first = max(int(lines[0]) - half_width, 0)
        fitted_bins = slice(first, min(max(int(lines[-1]) + half_width, first + 2 * half_width), size // 2) + 1)
        bins = np.arange(fitted_bins.stop)
        lengths = [stop - start for start, stop in segments]
        # Whether each segment is the response to its impacts alone, without motion before them.
        at_rest = [False] * len(segments)
        jitter = np.zeros((0, len(names)))
        if self.impacts is None:
            pairs = [low_spectra(rec, names, *bounds, size, fitted_bins.stop) for bounds in segments]
            channel_spectra = [spectra for spectra, _ in pairs]
            power = np.average([square for _, square in pairs], axis=0, weights=lengths)
            gain_error = np.repeat(noise_gain_error(power_in_counts(rec, names, power))[:, None], lines.size, axis=1)
        else:
            at_rest = [
                self.impacts.is_response_to_impacts_alone(motion, *bounds, size)
                for bounds, motion in zip(segments, prior_motion, strict=True)
            ]
            blocks = []
            for (start, stop), is_at_rest in zip(segments, at_rest, strict=True):
                block = np.stack([rec.read(name, start, stop) for name in names])
                blocks.append(self.impacts.isolate(rec, names, block, start, is_at_rest))
            lengths = [block.shape[1] for block in blocks]
            padded = [np.pad(block, ((0, 0), (size - block.shape[1], 0))) for block in blocks]
            channel_spectra = [fft.rfft(block, axis=1) for block in padded]
            # The force includes the whole tail of its high-pass filters, which the recording may truncate.
            info = rec.channels[self.impacts.channel]
            high_pass = high_pass_response(info, fft.rfftfreq(size, 1.0 / rec.rate))
            for spectra in channel_spectra:
                spectra[names.index(self.impacts.channel)] *= high_pass
            inside = [impact for bounds in segments for impact in self.impacts.inside(*bounds)]
            jitter = jitter_factor(rec, names, inside, size, half_width)
            gain_error = rounding_gain_error(
                self.impacts, rec, names, segments, zip(blocks, channel_spectra, strict=True), lines, half_width
            )
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


def _average(curves: Sequence[Response]) -> Response:
    """Average the responses of groups of impacts, whose random errors are independent."""
    first, count = curves[0], len(curves)
    if count == 1:
        return first
    budgets = [curve.uncertainty for curve in curves]
    error = np.linalg.norm([curve.error for curve in curves], axis=0) / count
    degrees_of_freedom = np.sum([curve.degrees_of_freedom for curve in curves], axis=0)
    limits: dict[str, Array] = {}
    sources: dict[str, dict[str, ComplexArray]] = {}
    for cause in (cause for budget in budgets for cause in budget.contributions if cause.evaluation == "B"):
        limits[cause.name] = limits.get(cause.name, 0.0) + cause.deviation / count
        for changes in cause.sources:
            total = sources.setdefault(cause.name, {})
            for source, change in changes.items():
                total[source] = total.get(source, 0.0) + change / count
    budget = first.uncertainty
    errors = None if budget.errors is None else budget.errors.scaled(np.full(error.size, count**-0.5, dtype=complex))
    return replace(
        first,
        value=np.mean([curve.value for curve in curves], axis=0),
        uncertainty=UncertaintyBudget.of(
            error,
            degrees_of_freedom,
            limits,
            sources,
            errors=errors,
            shared=budget.shared,
            clock=budget.clock,
            scale=budget.scale,
        ),
        coherence=np.mean([curve.coherence for curve in curves], axis=0),
        warnings=tuple(dict.fromkeys(text for curve in curves for text in curve.warnings)),
    )


def _with_motion_before(frf: Response, prior_motion: Sequence[float]) -> Response:
    """Add the error due to motion before the impacts to a response's uncertainty, and warn if it is large."""
    if np.isnan(prior_motion).any():
        frf = frf.warn(
            f"{frf.response}: the samples begin with an impact, so motion before it is unknown and the structure "
            "is assumed to be at rest. Start recording at least 0.2 s before each impact."
        )
    largest = max((ratio for ratio in prior_motion if np.isfinite(ratio)), default=None)
    if largest is None:
        return frf
    warning = (
        f"{frf.response}: motion or drift before an impact, of {format_percent(largest)} of the response, affects the "
        "curve. Hit the structure at rest, start recording earlier, or record several impacts in a row."
    )
    # The spectrum of a free decay has the shape of a resonance. Every line is therefore treated as a resonance with the
    # magnitude of the response at this line, whose sides decrease with the distance from the line.
    to_acceleration = (2.0 * np.pi * frf.frequency) ** {"displacement": 2, "velocity": 1, "acceleration": 0}[frf.motion]
    skirt = 1.0 / (np.pi * (np.abs(np.arange(1 - frf.value.size, frf.value.size)) + 1.0))
    accelerance = abs(frf.value) * to_acceleration
    error = largest * scipy.signal.fftconvolve(skirt, accelerance, mode="valid") / to_acceleration
    with_error = frf.with_limits({MOTION_BEFORE: error})
    return with_error.warn(warning) if largest > _MAX_MOTION_RATIO else with_error


def warn_of_dampers(rec: Recording) -> tuple[str, ...]:
    """Return a warning if dampers or joints may act; the response is then valid only for this excitation."""
    if rec.scene.is_linear:
        return ()
    subject = "Moving dampers" if any(damper.impacts for damper in rec.scene.dampers) else "Joints"
    return (
        f"{subject} make the structure nonlinear: this curve is valid only for this level and kind of excitation, "
        "and its uncertainty assumes linearity. Use stepped sine for the response to steady tones.",
    )
