"""Results of all analyses of the recordings of a report, computed once for its summary, tables and charts."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType
from typing import ParamSpec, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from analysis.commands.figures.peak_marks import PeakMark, peak_marks
from analysis.commands.figures.tolerance_texts import unstated_tolerances
from analysis.commands.presentation.outputs import with_recording_name, with_sweep_name
from analysis.core.damper_motion.comparison import Peak, peak_bands, resonance_peak, resonance_peaks
from analysis.core.damper_motion.dampers import Dampers, dampers_in
from analysis.core.decays.free_decay import Decay, decay
from analysis.core.modal.identification import identify
from analysis.core.modal.mode_warnings import extrapolates_damping
from analysis.core.modal.modes import Modes
from analysis.core.recordings.names import baseline_label, relabel, scene_labels
from analysis.core.recordings.opening import OpenRecordings
from analysis.core.responses.errors.systematic import clock_deviation, stated_tolerance
from analysis.core.responses.frequency_responses import frequency_responses
from analysis.core.responses.measurands import response_channels
from analysis.core.signals.profile_check import ProfileCheck, profile
from analysis.core.signals.shock_spectrum import ShockSpectrum, spectra_of_shocks
from analysis.core.tracking.backbone import Backbone, backbone
from analysis.core.tracking.continuation import AmplitudeCurve, continuation
from daq.core.recording.recorded_test import FOLLOWED_CURVE, HELD_PHASE, ControlledTones, shocks_of
from daq.core.recording.recording import Recording
from rig.core.base.errors import ShotrigError
from rig.core.base.progress import CountProgress
from rig.core.results.resonances import Resonance
from rig.core.results.response import Response

Parameters = ParamSpec("Parameters")
Returned = TypeVar("Returned")


# Largest number of channels in the charts of a recording: more curves are not readable.
_MAX_DRAWN = 16
# Analyses of tones that a controller chose.
_TRACKED: dict[ControlledTones, Callable[[Recording], AmplitudeCurve | Backbone]] = {
    FOLLOWED_CURVE: continuation,
    HELD_PHASE: backbone,
}


@dataclass(frozen=True)
class SweepResults:
    """Results of one sweep; a test without sweeps counts as one."""

    frfs: list[Response]  # one frequency response for each pair of response and reference
    modes: Modes | None  # None if the identification failed
    # for each mode: the responses with a peak near it, and their peaks
    found: tuple[tuple[tuple[Response, Peak], ...], ...] = ()
    highest: tuple[Response, Peak] | None = None  # the highest peak in the band, also where no mode was identified
    marked: tuple[tuple[Response, list[PeakMark]], ...] = ()  # the marked peaks of each response

    @property
    def peaks(self) -> tuple[tuple[Response, Peak] | None, ...]:
        """For each mode, the response with the highest peak near it; None if no response has a peak."""
        return tuple(max(inside, key=lambda pair: pair[1].value, default=None) for inside in self.found)

    def damping_text(self, mode: int) -> str:
        """Write a damping ratio with its 95 % interval, and its note."""
        assert self.modes is not None
        return self.modes.damping_text(mode) + self.damping_note(mode)

    def damping_note(self, mode: int) -> str:
        """Return ", extrapolated" if no line resolves the peak of a mode, otherwise an empty text."""
        assert self.modes is not None
        return ", extrapolated" * bool(extrapolates_damping(self.modes, self.frfs)[mode])

    @property
    def label(self) -> str:
        """Name of the recording, with level and direction if it has several sweeps."""
        return self.frfs[0].label


@dataclass(frozen=True)
class Measurement:
    """One open recording and its results; a result is empty or None if the test does not determine it."""

    path: Path
    label: str  # name of the recording in legends and sentences
    rec: Recording
    sweeps: tuple[SweepResults, ...] = ()
    dampers: tuple[Dampers, ...] = ()
    decay: Decay | None = None
    profile: ProfileCheck | None = None
    # Curve of a continuation or phase-resonance test. The controller chooses the frequencies, so there is no sweep.
    tracked: AmplitudeCurve | Backbone | None = None
    # Shock response spectra of the control channel and of the bodies, each for all shocks.
    spectra: tuple[list[ShockSpectrum], ...] = ()

    @property
    def drawn(self) -> list[str]:
        """Channels in charts; of many channels some forces, then those with the highest peaks of modes, then others."""
        channels = self.rec.channels
        forces = [name for name, info in channels.items() if info.quantity == "force"]
        highest = [pair[0].response for sweep in self.sweeps for pair in sweep.peaks if pair is not None]
        # Many forces would leave no place for the responses.
        chosen = list(dict.fromkeys([*forces[: _MAX_DRAWN // 2], *highest, *channels]))[:_MAX_DRAWN]
        return [name for name in channels if name in chosen]


@dataclass
class Measurements:
    """The recordings of a report, which stay open inside the `with` block, and the warnings about them."""

    paths: Sequence[Path]
    progress: CountProgress | None = None
    subject: str = ""  # common beginning of the names of all recordings, which their labels omit
    results: list[Measurement] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    _open: ExitStack = field(default_factory=ExitStack)

    def __enter__(self) -> Self:
        with OpenRecordings() as recordings:
            self.subject, labels = _without_common_beginning(scene_labels(recordings, self.paths))
            for path, label in zip(self.paths, labels, strict=True):
                self.results.append(self._measure(path, label, recordings.of(path)))
            self._open = recordings.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open.close()

    @property
    def baseline(self) -> Measurement:
        """Recording with which all others are compared: the first without moving dampers, otherwise the first."""
        label = baseline_label({result.label: not result.rec.scene.is_linear for result in self.results})
        return next((result for result in self.results if result.label == label), self.results[0])

    def _measure(self, path: Path, label: str, rec: Recording) -> Measurement:
        frfs_of_sweeps = tracked = None
        spectra: Sequence[list[ShockSpectrum]] = ()
        tracking = next((analysis for tones, analysis in _TRACKED.items() if tones.measured(rec.markers)), None)
        if tracking is not None:
            tracked = self.attempt(path, "Tracked curve", tracking, rec)
            if tracked is not None:
                tracked = relabel(tracked, rec.scene.name, f"“{label}”")
        elif shocks_of(rec.markers):
            spectra = self.attempt(path, "Shock response spectra", _shock_spectra, rec) or ()
        elif rec.test.drives:
            frfs_of_sweeps = self.attempt(path, "Frequency responses", frequency_responses, rec, progress=self.progress)
        sweeps = tuple(self._evaluate_sweep(path, label, rec, frfs) for frfs in frfs_of_sweeps or ())
        has_damper_results = rec.test.kind.steady and rec.scene.dampers
        dampers = None
        if has_damper_results:
            dampers = self.attempt(path, "Dampers", dampers_in, rec, label, self.progress)
        for sweep_dampers in dampers or ():
            self._warn(path, [*sweep_dampers.missing, *sweep_dampers.warnings])
        free_decay = None
        if rec.test.decays:
            free_decay = self.attempt(path, "Free decay", decay, rec)
            if free_decay is not None:
                free_decay = relabel(free_decay, rec.scene.name, label)
                self._warn(path, free_decay.warnings)
        check = None
        if rec.scene.test is not None and rec.scene.test.profile_control is not None:
            check = self.attempt(path, "Profile", profile, rec)
        if check is not None:
            check = replace(check, label=f"“{label}”")
        return Measurement(path, label, rec, sweeps, tuple(dampers or ()), free_decay, check, tracked, tuple(spectra))

    def _evaluate_sweep(self, path: Path, label: str, rec: Recording, frfs: Sequence[Response]) -> SweepResults:
        frfs = [relabel(frf, rec.scene.name, label) for frf in frfs]
        self._warn(path, frfs[0].warnings)
        (analysis,) = with_sweep_name(frfs[0].label, label, ["Modes"])
        modes = self.attempt(path, analysis, identify, frfs)
        resonances = [(frf, resonance_peaks(frf)) for frf in frfs]
        marked = tuple((frf, peak_marks(frf, found)) for frf, found in resonances)
        if modes is None:
            return SweepResults(frfs, None, marked=marked)
        self._warn(path, with_sweep_name(frfs[0].label, label, modes.warnings, frfs[0].warnings))
        found = _peaks_of_modes(frfs, modes)
        highest = highest_peak(resonances, [peak for inside in found for peak in inside])
        return SweepResults(frfs, modes, found, highest, marked)

    def attempt(
        self,
        path: Path,
        analysis: str,
        compute: Callable[Parameters, Returned],
        *args: Parameters.args,
        **kwargs: Parameters.kwargs,
    ) -> Returned | None:
        """Return the result of an analysis; if it fails, add a warning with the reason and return None."""
        try:
            return compute(*args, **kwargs)
        except ShotrigError as error:
            reason = str(error).removeprefix(f"{path}: ").replace(str(path), path.name)
            reason = reason[:1].upper() + reason[1:]
            self._warn(path, [f"{analysis}: not available. {reason}"])
            return None

    def _warn(self, path: Path, texts: Sequence[str]) -> None:
        self.warnings += [text for text in with_recording_name(path, texts) if text not in self.warnings]


def _without_common_beginning(names: Sequence[str]) -> tuple[str, list[str]]:
    """Split names at their last comma, if the parts before it are equal.

    >>> _without_common_beginning(["Fig 8, no damper", "Fig 8, dampers"])
    ('Fig 8', ['no damper', 'dampers'])
    """
    beginnings = {name.rpartition(", ")[0] for name in names}
    subject = beginnings.pop() if len(beginnings) == 1 and len(names) > 1 else ""
    return subject, [name.removeprefix(f"{subject}, ") if subject else name for name in names]


def _shock_spectra(rec: Recording) -> list[list[ShockSpectrum]]:
    """Return the spectra of the control channels of a shock test and of the responses, each for all shocks."""
    assert rec.scene.test is not None
    controls = [str(name) for _, name in rec.scene.test.named_channels]
    return [spectra_of_shocks(rec, name) for name in dict.fromkeys((*controls, *response_channels(rec)))]


def _peaks_of_modes(frfs: Sequence[Response], modes: Modes) -> tuple[tuple[tuple[Response, Peak], ...], ...]:
    """Return the responses that have a peak near each mode, with their peaks, in the order of `modes`."""
    _, low, high = peak_bands(modes)
    found = []
    # The bands are in ascending order of frequency; the modes may be in a different order.
    for rank in np.argsort(np.argsort(modes.frequency)):
        peaks = [(frf, resonance_peak(frf, low[rank], high[rank])) for frf in frfs]
        found.append(tuple((frf, peak) for frf, peak in peaks if peak is not None and not peak.at_end))
    return tuple(found)


def highest_peak(
    resonances: Sequence[tuple[Response, Sequence[tuple[Resonance, Peak]]]], peaks: Sequence[tuple[Response, Peak]] = ()
) -> tuple[Response, Peak] | None:
    """Return the response with the highest peak, near a mode or at a different frequency.

    `resonances`: responses with their `resonance_peaks`; `peaks`: the peaks near the modes.
    """
    others = [(frf, peak) for frf, found in resonances for _, peak in found if not peak.at_end]
    return max((*peaks, *others), key=lambda pair: pair[1].value, default=None)


def missing_tolerances(measurements: Sequence[Measurement]) -> list[str]:
    """Return the causes of error that intervals omit, because a sensor or the sample clock has no stated tolerance."""
    missing = unstated_tolerances([frf for each in measurements for sweep in each.sweeps for frf in sweep.frfs])
    for rec in (each.rec for each in measurements if not each.sweeps):
        is_stated = all(stated_tolerance(info) for info in rec.channels.values() if info.quantity != "voltage")
        missing += ["calibration"] * (not is_stated) + ["the sample clock"] * (not clock_deviation(rec))
    return sorted(set(missing))


def force_deviation(measurement: Measurement, frf: Response) -> NDArray[np.float64]:
    """Return the relative deviation of the force at each point of a response from the nearest level of its test."""
    force = frf.amplitude
    if force is None or frf.reference != "force":
        return np.zeros(frf.frequency.size)
    scene = measurement.rec.scene
    if scene.test is None or scene.level_key != "force":
        return np.zeros(frf.frequency.size)
    return np.asarray(abs(force[:, None] / np.array(scene.test.levels) - 1.0).min(axis=1))
