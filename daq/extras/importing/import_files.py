"""Recording made from time histories that were measured with other programs."""

import math
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from daq.core.excitation import procedure_of
from daq.core.measurement.run import missing_force_reference
from daq.core.recording.committed_file import locked
from daq.core.recording.layout import MAX_VOLTS, require_ordered_times
from daq.core.recording.markers import BETWEEN_FILES
from daq.core.recording.recorder import Recorder
from daq.core.signal_chain.driving_power import MOTION_INTEGRATIONS, DrivingPower
from daq.extras.importing.assignment import AssignedSignal, ChosenSignal, assign, choose_signals, contradicted_units
from daq.extras.importing.channel_table import Column, columns_of
from daq.extras.importing.dwell_detection import DwellDetector
from daq.extras.importing.files import signals_of
from daq.extras.importing.force_pulses import ForcePulses
from daq.extras.importing.overloads import ClippingDetector
from daq.extras.importing.signal import GAP, Signal, are_repetitions, join
from rig.core.base.arrays import Array
from rig.core.base.errors import RecordingError, RunWarning, SceneError
from rig.core.base.input_files import as_path, duplicate_files
from rig.core.base.output_files import atomic_write, resolve_output
from rig.core.base.progress import FractionProgress
from rig.core.numerics.runs import merge_spans, runs_of
from rig.core.scene.loading import SceneLike, load
from rig.core.scene.scene import Scene
from rig.core.system.structural_model import structural_model

# Number of samples of each channel in memory at a time: half a megabyte, which the cache holds.
_BLOCK_SAMPLES = 1 << 16
# Two sample rates are equal if they differ by less than this fraction, because files round sample rates.
_RATE_TOLERANCE = 2e-5
# Probable unit of times that were read as seconds, by the ratio of the true sample rate to the rate from these times.
_TIME_UNITS = {1e3: "ms", 1e6: "us"}
# Frequency band of a test if its scene specifies none, as ratios to the sample rate.
_LOWEST_RATIO = 1e-4
_HIGHEST_RATIO = 0.4
# Largest plausible readings of a vibration test, SI units.
_MAX_PLAUSIBLE = {"acceleration": 1e6, "velocity": 1e4, "displacement": 1e2, "force": 1e7, "voltage": 1e4}
# Largest plausible sample rate [Hz] of a vibration test; a larger rate indicates a wrong unit of time.
_MAX_PLAUSIBLE_RATE = 1e6
# Number of lost segments of a channel above which segments less than `_LOST_PAUSE_S` apart are merged; each segment is
# a marker, and a viewer shows no more.
_MAX_LOST_SEGMENTS = 1000
# Two lost segments are merged up to this pause between them [s].
_LOST_PAUSE_S = 0.1
# Two overloads are merged up to this pause between them [s].
_OVERLOAD_PAUSE_S = 0.01
# In a free decay, the largest motion occurs within this fraction of the duration from the start; otherwise something
# excites the structure later.
_MAX_PEAK_SHARE = 0.05


def import_files(
    files: Sequence[str | Path] | str | Path,
    scene: SceneLike,
    path: str | Path,
    *,
    table: Mapping[str, Column | Mapping[str, Any] | str | int] | str | Path | None = None,
    from_s: float | None = None,
    to_s: float | None = None,
    overwrite: bool = False,
    progress: FractionProgress | None = None,
) -> Path:
    r"""Make a recording of time histories that other programs have measured.

    Signals become the channels of the scene, by name or as a table specifies, in SI. Missing samples are marked `lost`,
    clipped samples `overload`. The scene's test specifies the excitation. Impacts are detected in the force channel; a
    dwell of a sine or stepped sine is detected where the frequency is constant. Any other excitation is one measurement
    over the whole duration. Files of an impact test that contain the same signals are joined, as impacts of one test,
    unless the table states files.

    Parameters
    ----------
    files : path or sequence of paths
        TDMS (.tdms), Universal File (.uff, .unv), WAV, text (.lvm, .csv, .txt or any other suffix), numpy (.npz, .npy),
        MATLAB (.mat), HDF5 (.h5) or another program's MCAP.
    scene : Scene, str, Path or mapping
        The bench: structure, dampers, shaker, test, and channels with their sensors.
    path : str or Path
        Recording to write (MCAP), in an existing folder.
    table : mapping, or str or Path, optional
        The column of each channel, such as ``{"body1": {"column": "ai0", "unit": "g"}}``, or a file with this table;
        see `daq.extras.importing.channel_table`.
    from_s : float, optional
        Start of the part to use, in seconds from the first sample.
    to_s : float, optional
        End of the part to use, in seconds from the first sample.
    overwrite : bool
        Whether an existing recording may be replaced.
    progress : callable, optional
        ``progress(fraction, message)``.

    Returns
    -------
    Path
        The recording.

    Raises
    ------
    SceneError
        If the scene or the table does not fit the files.
    RecordingError
        If a file cannot be read, or contradicts itself or another file; no incomplete recording is left.
    RunError
        If a package is missing, or the disk is full.

    Warns
    -----
    RunWarning
        For data that is missing, omitted or uncertain.

    Examples
    --------
    >>> import tempfile, daq, rig
    >>> scene = rig.load("fig4-structure", {"test": None, "channels": None, "converter": None})
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder) / "run.csv"
    ...     rows = (f"{k / 1000},{np.sin(0.3 * k)}" for k in range(1000))
    ...     _ = file.write_text("time [s],body1 [g]\n" + "\n".join(rows))
    ...     with warnings.catch_warnings(action="ignore"):
    ...         path = daq.import_files(file, scene, file.with_suffix(".mcap"))
    ...     with daq.open(path) as recording:
    ...         recording.rate, round(float(recording.read("body1").max()), 4)
    (1000.0, 9.8066)
    """
    bench_scene = load(scene)
    file_arguments = [files] if isinstance(files, str | Path) or not isinstance(files, Sequence) else files
    paths = [as_path(file, "files") for file in file_arguments]
    target = as_path(path)
    columns = columns_of(table)
    for first, duplicate in duplicate_files(paths):
        raise RecordingError(f"{duplicate}: the same content as {first}. Give each file once.")
    with ExitStack() as stack:
        files_of_signals = [signals_of(file, stack) for file in paths]
        # If the table states files, force and response of one impact are in separate files, which are not repetitions.
        is_joined = (
            _detection(bench_scene) == "hits"
            and are_repetitions(files_of_signals)
            and not any(column.file for column in columns.values())
        )
        if is_joined:
            # Lost samples separate the impacts, because the time between them is unknown.
            gaps = [GAP] * (len(paths) - 1)
            signals = [join(repetitions, gaps) for repetitions in zip(*files_of_signals, strict=True)]
        else:
            signals = list(chain.from_iterable(files_of_signals))
        # This is checked after the files and the scene, because their errors are more helpful.
        resolve_output(target, overwrite, RecordingError)
        requires_force = bench_scene.test is not None and _detection(bench_scene) == "hits"
        chosen, notes = choose_signals(bench_scene, signals, columns, requires_force)
        notes += contradicted_units(chosen)
        if is_joined:
            notes.append(
                f"{len(paths)} files with the same signals are joined as impacts of one test, separated by {GAP} lost "
                "samples"
            )
        rate = _common_rate(chosen, bench_scene)
        assigned = _cut_to_times(_with_start_delays(assign(bench_scene, chosen, rate)), rate, from_s, to_s)
        if warning := missing_force_reference(bench_scene, [assignment.info for assignment in assigned]):
            notes.append(warning)
        longest = max(assignment.signal.samples for assignment in assigned)
        notes += _implausible_times(bench_scene, rate, longest)
        shorter = [
            f"{assignment.channel.name} ({assignment.signal.samples})"
            for assignment in assigned
            if assignment.signal.samples < longest
        ]
        if shorter:
            notes.append(
                f"channels with fewer than {longest} samples: {', '.join(shorter)}. The missing samples are marked as "
                "lost."
            )
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", RunWarning)
            writer = _RecordingWriter(_scene_as_measured(bench_scene, assigned, rate), assigned, rate)
            notes += writer.run(target, overwrite, progress)
    for note in dict.fromkeys([*notes, *(str(warning.message) for warning in caught)]):
        warnings.warn(note, RunWarning, stacklevel=2)
    return target


#: `daq.import_` has the name of the command; `import` itself is a Python keyword.
import_ = import_files


def _common_rate(chosen: Sequence[ChosenSignal], scene: Scene) -> float:
    """Return the sample rate of all signals [Hz] from the channel table, otherwise the files, otherwise the scene."""

    def rate_list(rates: Iterable[float]) -> str:
        return ", ".join(f"{rate:.10g} Hz" for rate in sorted(rates))

    table_rates = {choice.column.rate for choice in chosen if choice.column.rate is not None}
    if len(table_rates) > 1:
        raise SceneError(
            f"the channel table gives several rates, {rate_list(table_rates)}. Give the same rate for all channels."
        )
    if table_rates:
        return table_rates.pop()
    converter = scene.converter
    rate_in_scene = "rate" in converter.model_fields_set or converter.preset is not None
    rates = sorted({choice.signal.rate for choice in chosen if choice.signal.rate is not None})
    if not rates:
        if not rate_in_scene:
            raise SceneError(
                "the sample rate is not stated: the files have neither times nor a rate. Give rate: in the channel "
                "table, or converter: {rate: 5120 Hz} in the scene."
            )
        return converter.sample_rate
    if rates[-1] > rates[0] * (1.0 + _RATE_TOLERANCE):
        raise RecordingError(
            f"the signals have several sample rates, {rate_list(rates)}; a recording has one. Import the signals of "
            "each rate separately, with one command or channel table per rate."
        )
    rate = rates[0]
    if rate_in_scene and abs(converter.sample_rate - rate) > _RATE_TOLERANCE * rate:
        ratio = converter.sample_rate / rate
        time_units = [unit for factor, unit in _TIME_UNITS.items() if abs(ratio / factor - 1.0) < _RATE_TOLERANCE]
        remedy = (
            f"If the first column is in {time_units[0]}, name it `time [{time_units[0]}]`"
            if time_units
            else f"If the files are right, set converter.rate of the scene to {rate:.10g} Hz"
        )
        raise SceneError(
            f"the files state {rate:.10g} Hz, but the scene's converter has {converter.sample_rate:.10g} Hz. {remedy}; "
            "otherwise, state `rate` in the channel table."
        )
    return rate


def _with_start_delays(assigned: Sequence[AssignedSignal]) -> list[AssignedSignal]:
    """Convert start differences below half a sample to delays; raise `RecordingError` for larger differences."""
    undelayed = [assignment.signal for assignment in assigned if assignment.column.delay is None]
    delayed = []
    for assignment in assigned:
        delay_s = 0.0
        if assignment.column.delay is None:
            signal, reference_signal = assignment.signal, undelayed[0]
            delay_s = signal.start_s - reference_signal.start_s
            # The dates are used if both signals have a date.
            if signal.start_ns and reference_signal.start_ns:
                delay_s += (signal.start_ns - reference_signal.start_ns) * 1e-9
        if abs(delay_s) * assignment.info.rate > 0.5:
            order = "after" if delay_s > 0.0 else "before"
            raise RecordingError(
                f"{assignment.signal.name!r} of {assignment.signal.file} begins {abs(delay_s):.6g} s {order} "
                f"{undelayed[0].name!r} of {undelayed[0].file}: their samples are not simultaneous. Import them one "
                "by one or, if these times are wrong, give delay: 0 s for both in the channel table."
            )
        delayed.append(
            replace(assignment, info=replace(assignment.info, delay=assignment.info.delay - delay_s))
            if delay_s
            else assignment
        )
    return delayed


def _cut_to_times(
    assigned: Sequence[AssignedSignal], rate: float, from_s: float | None, to_s: float | None
) -> Sequence[AssignedSignal]:
    """Return the signals cut to the samples between two times [s]."""
    if from_s is None and to_s is None:
        return assigned
    require_ordered_times(from_s, to_s)
    longest = max(assignment.signal.samples for assignment in assigned)
    start = 0 if from_s is None else max(0, math.ceil(from_s * rate))
    stop = longest if to_s is None else min(longest, math.ceil(to_s * rate))
    if stop - start < 2:
        raise SceneError(
            f"fewer than 2 samples between `from_s` and `to_s`. Give times from 0 s to {longest / rate:.6g} s."
        )

    def cut_signal(signal: Signal) -> Signal:
        return replace(
            signal.part(start, max(min(stop, signal.samples), start)),
            start_s=signal.start_s + start / rate,
            separators=tuple((max(a - start, 0), max(b - start, 0)) for a, b in signal.separators if a < stop),
        )

    return [replace(assignment, signal=cut_signal(assignment.signal)) for assignment in assigned]


def _scene_as_measured(scene: Scene, assigned: Sequence[AssignedSignal], rate: float) -> Scene:
    """Return the scene with the assigned channels, and the sample rate of the files."""
    converter = scene.converter.replace(rate=rate, remove_delay=True, dropped_blocks=(), skew=None)
    if abs(converter.sample_rate - rate) > _RATE_TOLERANCE * rate:
        raise SceneError(
            f"the files state {rate:.10g} Hz, a rate that {converter.preset} does not have. Set converter.preset to "
            "the converter that was used, or remove the preset."
        )
    samples = "float32" if scene.recording.samples == "float32" else "float64"
    return scene.replace(
        channels=[assignment.channel for assignment in assigned],
        converter=converter,
        recording=scene.recording.replace(truth=False, samples=samples),
    )


def _implausible_times(scene: Scene, rate: float, samples: int) -> Iterator[str]:
    """Yield a warning if the unit of the times is probably wrong; `rate` in Hz."""
    natural_hz = structural_model(scene).modes.frequency
    lowest_hz = min(natural_hz[natural_hz > 0.0], default=np.nan)
    structure = "" if np.isnan(lowest_hz) else f" for a structure with the lowest natural frequency {lowest_hz:.3g} Hz"
    if rate > _MAX_PLAUSIBLE_RATE or rate < 2.0 * lowest_hz or samples / rate * lowest_hz < 1.0:
        yield (
            f"a recording of {samples / rate:.3g} s with {rate:.6g} samples/s is implausible{structure}. Check the "
            "unit of the times, which may be ms although the file states s, or set rate: in the channel table."
        )


def _detection(scene: Scene) -> str:
    """Return the features to detect in the samples; without a test, impacts."""
    return "hits" if scene.test is None else procedure_of(scene.test).detection


class _RecordingWriter:
    """Reads the signals block by block, writes them to a recording, and marks impacts, dwells and faults."""

    def __init__(self, scene: Scene, assigned: Sequence[AssignedSignal], rate: float) -> None:
        self._scene, self._assigned, self._rate = scene, assigned, rate
        self._infos = [assignment.info for assignment in assigned]
        self._n_samples = max(assignment.signal.samples for assignment in assigned)
        self._lost_ranges: list[list[tuple[int, int]]] = [[] for _ in assigned]
        # Full scale of each signal [V]: the full scale of its file, or the range of the converter; None if not known.
        full_scales = [assignment.info.range if assignment.calibrated else None for assignment in assigned]
        for row, assignment in enumerate(assigned):
            if assignment.signal.full_scale is not None:
                full_scales[row] = abs(assignment.signal.full_scale * assignment.factor)
        offsets = [assignment.column.offset * assignment.factor for assignment in assigned]
        self._overloads = list(map(ClippingDetector, full_scales, offsets))
        force_rows = [row for row, info in enumerate(self._infos) if info.quantity == "force"]
        self._detection = _detection(scene)
        self._force_pulses = {row: ForcePulses() for row in force_rows if self._detection == "hits"}
        # The power at the driving point is known if there is a single force channel, and a motion channel where the
        # force acts.
        driven_points = [f"body {number}" for number in scene.force_on]
        motion_rows = [
            row
            for row, info in enumerate(self._infos)
            if info.quantity in MOTION_INTEGRATIONS and [info.at] == driven_points
        ]
        self._power_rows = [force_rows[0], motion_rows[0]] if len(force_rows) == 1 and motion_rows else []
        self._power = DrivingPower(*(self._infos[row] for row in self._power_rows)) if self._power_rows else None
        self._dwells = DwellDetector(scene, self._infos, rate) if self._detection == "dwells" else None

    def run(self, path: Path, overwrite: bool, progress: FractionProgress | None) -> list[str]:
        """Write the recording; return the warnings about it."""
        source = ", ".join(dict.fromkeys(Path(assignment.signal.file).name for assignment in self._assigned))
        start_ns = max(assignment.signal.start_ns for assignment in self._assigned)
        start_ns += round(self._assigned[0].signal.start_s * 1e9) if start_ns else 0
        with (
            locked(path),
            atomic_write(path, overwrite) as temporary_path,
            Recorder(temporary_path, self._scene, self._infos, self._rate, max(start_ns, 0), source=source) as recorder,
        ):
            for first in range(0, self._n_samples, _BLOCK_SAMPLES):
                stop = min(first + _BLOCK_SAMPLES, self._n_samples)
                block = np.stack([self._read_block(row, first, stop) for row in range(len(self._infos))])
                recorder.write(block)
                if self._power is not None:
                    self._power.add(*block[self._power_rows])
                if self._dwells is not None:
                    self._dwells.add(block)
                if progress is not None:
                    progress(stop / self._n_samples, f"{stop / self._rate:.0f} s")
            return [*self._mark_channels(recorder), *self._mark_test(recorder)]

    def _read_block(self, row: int, first: int, stop: int) -> Array:
        """Return a block in volts, NaN where the file has no number; search it for gaps, clipping and impacts."""
        assignment = self._assigned[row]
        volts = assignment.volts(first, stop)
        volts[~(np.abs(volts) < MAX_VOLTS)] = np.nan
        self._lost_ranges[row] += [(first + a, first + b) for a, b in runs_of(np.isnan(volts))]
        if len(self._lost_ranges[row]) > _MAX_LOST_SEGMENTS:
            self._lost_ranges[row] = merge_spans(self._lost_ranges[row], round(_LOST_PAUSE_S * self._rate))
        self._overloads[row].add(first, volts)
        if row in self._force_pulses:
            self._force_pulses[row].add(first, volts / assignment.info.sensitivity)
        return volts

    def _mark_channels(self, recorder: Recorder) -> Iterator[str]:
        """Mark lost and clipped samples; yield warnings."""
        for assignment, lost_ranges, overloads in zip(self._assigned, self._lost_ranges, self._overloads, strict=True):
            name, signal = assignment.channel.name, assignment.signal
            where = f"{name} ({signal.name!r} of {signal.file})"
            lost = merge_spans(lost_ranges)
            for first, stop in lost:
                is_join = any(first <= start < min(end, stop) for start, end in signal.separators)
                reason = BETWEEN_FILES if is_join else f"not in {signal.file}"
                recorder.mark("lost", first, stop - 1, channels=[name], reason=reason)
            separating = sum(min(stop, signal.samples) - first for first, stop in signal.separators)
            count = sum(stop - first for first, stop in lost if first < signal.samples) - separating
            if count:
                yield f"{where}: no number in {count} of {signal.samples - separating} samples; marked as lost"
            yield from _implausible_readings(where, assignment, overloads)
            clipped = merge_spans(overloads.clipped_intervals(), round(_OVERLOAD_PAUSE_S * self._rate))
            for first, stop in clipped:
                recorder.mark("overload", first, stop - 1, channel=name)
            if clipped:
                yield f"{where} is clipped; number of segments marked as overload: {len(clipped)}"
        if self._power is not None and (warning := self._power.warning()):
            yield warning

    def _mark_test(self, recorder: Recorder) -> Iterator[str]:
        """Mark impacts, dwells, or the whole recording as measured, as the scene's test requires; yield warnings."""
        test = self._scene.test
        if self._detection == "start":
            motion_peaks = [
                (overloads.peak_sample, assignment.channel.name)
                for assignment, overloads in zip(self._assigned, self._overloads, strict=True)
                if assignment.channel.body is not None and overloads.peak_sample is not None
            ]
            latest_peak, name = max(motion_peaks, default=(0, ""))
            if latest_peak >= _MAX_PEAK_SHARE * self._n_samples:
                yield (
                    f"the decay of a free test must begin with the first sample, but {name} moves most at "
                    f"{latest_peak / self._rate:.4g} s. Remove the time before it with `from_s`."
                )
            return
        if self._dwells is not None:
            yield from self._dwells.mark(recorder, self._assigned[self._dwells.reference_row])
            return
        impacts = [impact for pulses in self._force_pulses.values() for impact in pulses.impacts(self._rate)]
        for number, impact in enumerate(impacts, 1):
            recorder.mark(
                "hit", impact.first, impact.stop - 1, number=number, peak=impact.peak, double=impact.is_double
            )
        if impacts:
            doubles = [str(number) for number, impact in enumerate(impacts, 1) if impact.is_double]
            if doubles:
                yield f"impact {', '.join(doubles)}: double (a second pulse of the force follows)"
            return
        if test is not None and self._detection == "hits":
            yield (
                "no impact was detected: the scene's test is an impulse, but no channel contains a force pulse. "
                "Check whether columns are swapped, or whether the scene has a different test."
            )
        elif not any(info.quantity == "force" for info in self._infos) and not self._scene.shakers:
            yield (
                "no channel measures a force and the scene has no shaker, so responses have no reference. Assign a "
                "signal to a force channel, or add the shaker to the scene."
            )
        else:
            low, high = _LOWEST_RATIO * self._rate, _HIGHEST_RATIO * self._rate
            if test is not None and test.band is not None:
                low, high = test.band
            fields: dict[str, object] = {"from": low, "to": high}
            if test is not None and test.also_driven:
                fields["shakers"] = [self._scene.driven or 1, *test.also_driven]
            recorder.mark("measure", 0, self._n_samples - 1, **fields)


def _implausible_readings(where: str, assignment: AssignedSignal, overloads: ClippingDetector) -> Iterator[str]:
    """Yield warnings about readings that suggest a failed sensor, or a wrong unit, sensitivity or range."""
    peak, unit = overloads.peak / abs(assignment.info.sensitivity), assignment.info.unit
    if not np.isfinite(peak):
        yield f"{where} contains no numbers. Check the file."
        return
    if overloads.value_range == 0.0:
        yield f"{where} reads {peak:.6g} {unit} throughout. Check that its sensor works and is connected."
    if peak > _MAX_PLAUSIBLE[assignment.info.quantity]:
        yield f"{where} reads up to {peak:.3g} {unit}. Check for a wrong unit or sensitivity."
    if overloads.full_scale_is_wrong:
        yield (
            f"{where} reads up to {overloads.converter_peak:.4g} V, above the converter's range of "
            f"{overloads.full_scale:.4g} V. Correct unit, sensitivity or range."
        )
