"""Turn time histories of a real bench into a recording."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from daq.importing.assignment import Assigned, Choice, assign, choose, contradicted_units
from daq.importing.channel_table import Column, read_table
from daq.importing.driving_power import MOTIONS, DrivingPower
from daq.importing.files import signals_of
from daq.importing.force_pulses import ForcePulses
from daq.importing.overloads import Overloads, joined
from daq.importing.signal import Signal
from daq.importing.steps import StepFinder
from daq.recording.layout import refuse_reversed
from daq.recording.recorder import Recorder
from daq.recording.recording import open as open_recording
from rig.arrays import Array
from rig.errors import RecordingError, RunWarning, SceneError, ShotrigError
from rig.input_files import as_path, duplicate_files
from rig.numerics.runs import runs_of
from rig.output_files import atomic_write, resolve_output
from rig.progress import FractionProgress
from rig.scene.excitation import Free, Impulse, Multisine, Random, Sine, SteppedSine, SweptSine
from rig.scene.loading import SceneLike, load
from rig.scene.scene import Scene

# Samples of each channel in memory at a time.
_PIECE_SAMPLES = 1 << 16
# Relative difference below which two rates are equal: files round them.
_RATE_TOLERANCE = 2e-5
# Band of a test whose scene states none, as ratios to the sample rate.
_LOWEST_RATIO = 1e-4
_HIGHEST_RATIO = 0.4
# Larger readings, in SI, are not a vibration.
_IMPLAUSIBLE = {"acceleration": 1e6, "velocity": 1e4, "displacement": 1e2, "force": 1e7, "voltage": 1e4}
# Largest number of lost segments of a channel; beyond it, segments with short pauses between them are joined.
_MAX_LOST_SEGMENTS = 1000
# Longest pause between two lost segments that are joined.
_LOST_PAUSE_S = 0.1
# Longest pause between two overloads that are joined.
_OVERLOAD_PAUSE_S = 0.01
# Share of a free test after which its largest motion is too late for a decay.
_LATE_SHARE = 0.05


def import_files(
    files: Sequence[str | Path] | str | Path,
    scene: SceneLike,
    path: str | Path,
    *,
    table: Mapping[str, Column] | str | Path | None = None,
    from_s: float | None = None,
    to_s: float | None = None,
    overwrite: bool = False,
    progress: FractionProgress | None = None,
) -> Path:
    r"""Make a recording of time histories that other programs have measured.

    Signals become the channels of the scene, by name or as a table states, in SI. Missing samples are marked `lost`,
    clipped samples `overload`. The excitation is that of the scene's test: hits are detected in the force channel, and
    the steps of a sine or stepped sine where a tone is held; any other excitation is one measurement from end to end.

    Parameters
    ----------
    files : path or sequence of paths
        TDMS (.tdms), Universal File (.uff, .unv), WAV, text (.csv, .txt, .tsv, .lvm), numpy (.npz, .npy), MATLAB (.mat)
        or another program's MCAP.
    scene : Scene, str, Path or mapping
        The bench: structure, dampers, shaker, test, channels with their sensors.
    path : str or Path
        Recording to write (MCAP), in an existing folder.
    table : mapping of str to Column, or str or Path, optional
        The column of each channel, or a file with it; see `daq.importing.channel_table`.
    from_s, to_s : float, optional
        Times in s after the first sample between which samples are taken.
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
        If a file cannot be read, or contradicts itself or another file; no recording is left behind.
    RunError
        If a package is missing, or the disk is full.

    Warns
    -----
    RunWarning
        For everything that is missing, left out or uncertain.

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
    bench = load(scene)
    named = [files] if isinstance(files, str | Path) or not isinstance(files, Sequence) else files
    paths = [as_path(file, "files") for file in named]
    target = as_path(path)
    columns = table if isinstance(table, Mapping) else {} if table is None else read_table(Path(table))
    for first, duplicate in duplicate_files(paths):
        raise RecordingError(f"{duplicate}: the same content as {first}. Give each file once.")
    with ExitStack() as stack:
        signals = [signal for file in paths for signal in signals_of(file, stack)]
        # Not before: a missing file or scene is the more helpful message.
        replaces = overwrite
        with suppress(ShotrigError), open_recording(target) as recording:
            # A recording of the same files may be replaced.
            names = ", ".join(file.name for file in paths)
            replaces |= bool(recording.source) and recording.source in names
        resolve_output(target, replaces, RecordingError)
        chosen, notes = choose(bench, signals, columns)
        notes += contradicted_units(chosen)
        rate = _common_rate(chosen, bench)
        assigned = _cut(_with_start_delays(assign(bench, chosen, rate)), rate, from_s, to_s)
        longest = max(each.signal.samples for each in assigned)
        short = [f"{each.channel.name} ({each.signal.samples})" for each in assigned if each.signal.samples < longest]
        if short:
            notes.append(f"{', '.join(short)} have fewer than {longest} samples; the rest is marked as lost")
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", RunWarning)
            notes += _Import(_as_measured(bench, assigned, rate), assigned, rate).run(target, overwrite, progress)
    for note in dict.fromkeys([*notes, *(str(each.message) for each in caught)]):
        warnings.warn(note, RunWarning, stacklevel=2)
    return target


#: The call by the name of the command; `import` itself is a keyword.
import_ = import_files


def _common_rate(chosen: Sequence[Choice], scene: Scene) -> float:
    """Return the rate of all signals: the table's, the files', or else the scene's."""

    def listed(rates: Iterable[float]) -> str:
        return ", ".join(f"{rate:.10g} Hz" for rate in sorted(rates))

    table_rates = {each.column.rate for each in chosen if each.column.rate is not None}
    if len(table_rates) > 1:
        raise SceneError(f"the table gives several rates, {listed(table_rates)}. Give one rate: a recording has one.")
    if table_rates:
        return table_rates.pop()
    converter = scene.converter
    in_scene = "rate" in converter.model_fields_set or converter.preset is not None
    rates = sorted({each.signal.rate for each in chosen if each.signal.rate is not None})
    if not rates:
        if not in_scene:
            raise SceneError(
                "the sample rate is not stated: the files have no times, and no rate. Give rate: in the table, or "
                "converter: {rate: 5120 Hz} in the scene."
            )
        return converter.sample_rate
    if rates[-1] > rates[0] * (1.0 + _RATE_TOLERANCE):
        raise RecordingError(
            f"the signals have several sample rates, {listed(rates)}; a recording has one. Import them one by one, or "
            "choose those of one rate in a table."
        )
    rate = rates[0]
    if in_scene and abs(converter.sample_rate - rate) > _RATE_TOLERANCE * rate:
        raise SceneError(
            f"the files state {rate:.10g} Hz, the scene's converter {converter.sample_rate:.10g} Hz. Correct the wrong "
            f"value: --set converter.rate={rate:.10g}Hz, or rate: in the table."
        )
    return rate


def _with_start_delays(assigned: Sequence[Assigned]) -> list[Assigned]:
    """Turn small differences of the start into delays; reject signals that began at different times."""
    stated = [each.signal for each in assigned if each.column.delay is None]
    delayed = []
    for each in assigned:
        delay_s = 0.0
        if each.column.delay is None:
            signal, origin = each.signal, stated[0]
            delay_s = signal.start_s - origin.start_s
            # Dates count where both have one.
            if signal.start_ns and origin.start_ns:
                delay_s += (signal.start_ns - origin.start_ns) * 1e-9
        if abs(delay_s) * each.info.rate > 0.5:
            raise RecordingError(
                f"{each.signal.name!r} of {each.signal.file} begins {delay_s:.6g} s after {stated[0].name!r} of "
                f"{stated[0].file}: their samples were not taken together. Import them one by one or, where the files "
                "are wrong, give delay: 0 s for both in the table."
            )
        delayed.append(replace(each, info=replace(each.info, delay=each.info.delay - delay_s)) if delay_s else each)
    return delayed


def _cut(assigned: Sequence[Assigned], rate: float, from_s: float | None, to_s: float | None) -> Sequence[Assigned]:
    """Select the samples between two times."""
    if from_s is None and to_s is None:
        return assigned
    refuse_reversed(from_s, to_s)
    longest = max(each.signal.samples for each in assigned)
    start = 0 if from_s is None else max(0, math.ceil(from_s * rate))
    stop = longest if to_s is None else min(longest, math.ceil(to_s * rate))
    if stop - start < 2:
        raise SceneError(f"no samples between --from and --to. Give times from 0 s to {longest / rate:.6g} s.")

    def within(signal: Signal) -> Signal:
        return replace(
            signal,
            samples=max(min(stop, signal.samples) - start, 0),
            read=lambda first, last: signal.read(start + first, start + last),
            start_s=signal.start_s + start / rate,
        )

    return [replace(each, signal=within(each.signal)) for each in assigned]


def _as_measured(scene: Scene, assigned: Sequence[Assigned], rate: float) -> Scene:
    """Return the scene with the channels of the files, and their rate."""
    converter = scene.converter.replace(rate=rate, remove_delay=True, dropped_blocks=(), skew=None)
    if abs(converter.sample_rate - rate) > _RATE_TOLERANCE * rate:
        raise SceneError(
            f"the files state {rate:.10g} Hz, a rate that {converter.preset} does not have. Give the "
            "scene the converter that was used, or none."
        )
    samples = "float32" if scene.recording.samples == "float32" else "float64"
    return scene.replace(
        channels=[each.channel for each in assigned],
        converter=converter,
        recording=scene.recording.replace(truth=False, samples=samples),
    )


class _Import:
    """One import: signals are read in pieces, examined, and written."""

    def __init__(self, scene: Scene, assigned: Sequence[Assigned], rate: float) -> None:
        self._scene, self._assigned, self._rate = scene, assigned, rate
        self._infos = [each.info for each in assigned]
        self._samples = max(each.signal.samples for each in assigned)
        self._missing: list[list[tuple[int, int]]] = [[] for _ in assigned]
        # Largest voltage that a signal can read: full scale of its file, or the converter's range.
        limits = [each.info.range if each.calibrated else None for each in assigned]
        for row, each in enumerate(assigned):
            if each.signal.full_scale is not None:
                limits[row] = abs(each.signal.full_scale * each.factor)
        self._overloads = [Overloads(limit) for limit in limits]
        forces = [row for row, info in enumerate(self._infos) if info.quantity == "force"]
        self._forces = {row: ForcePulses() for row in forces if isinstance(scene.test, Impulse | None)}
        # The power of the only channel of force and the motion where it acts.
        places = [f"body {number}" for number in scene.force_on]
        motions = [row for row, info in enumerate(self._infos) if info.quantity in MOTIONS and [info.at] == places]
        self._powered = [forces[0], motions[0]] if len(forces) == 1 and motions else []
        self._power = DrivingPower(*(self._infos[row] for row in self._powered)) if self._powered else None
        is_tone_test = isinstance(scene.test, Sine | SteppedSine)
        self._steps = StepFinder(scene, self._infos, rate) if is_tone_test else None

    def run(self, path: Path, overwrite: bool, progress: FractionProgress | None) -> list[str]:
        """Write the recording; return the warnings about it."""
        source = ", ".join(dict.fromkeys(Path(each.signal.file).name for each in self._assigned))
        start_ns = max(each.signal.start_ns for each in self._assigned)
        start_ns += round(self._assigned[0].signal.start_s * 1e9) if start_ns else 0
        with (
            atomic_write(path, overwrite or None) as part,
            Recorder(part, self._scene, self._infos, self._rate, max(start_ns, 0), source=source) as recorder,
        ):
            for first in range(0, self._samples, _PIECE_SAMPLES):
                stop = min(first + _PIECE_SAMPLES, self._samples)
                block = np.stack([self._read_block(row, first, stop) for row in range(len(self._infos))])
                recorder.write(block)
                if self._power is not None:
                    self._power.add(*block[self._powered])
                if self._steps is not None:
                    self._steps.add(block)
                if progress is not None:
                    progress(stop / self._samples, f"{stop / self._rate:.0f} s")
            return [*self._mark_channels(recorder), *self._mark_test(recorder)]

    def _read_block(self, row: int, first: int, stop: int) -> Array:
        """Read a piece of a channel in volts, NaN where the file has no number, and examine it."""
        each = self._assigned[row]
        volts = np.full(stop - first, np.nan)
        end = min(stop, each.signal.samples)
        if end > first:
            volts[: end - first] = each.volts(first, end)
            volts[~np.isfinite(volts)] = np.nan
        self._missing[row] += [(first + a, first + b) for a, b in runs_of(np.isnan(volts))]
        if len(self._missing[row]) > _MAX_LOST_SEGMENTS:
            self._missing[row] = joined(self._missing[row], round(_LOST_PAUSE_S * self._rate))
        self._overloads[row].add(first, volts)
        if row in self._forces:
            self._forces[row].add(first, volts / each.info.sensitivity)
        return volts

    def _mark_channels(self, recorder: Recorder) -> Iterator[str]:
        """Mark lost and clipped samples; yield warnings."""
        for each, missing, overloads in zip(self._assigned, self._missing, self._overloads, strict=True):
            name, signal = each.channel.name, each.signal
            where = f"{name} ({signal.name!r} of {signal.file})"
            lost = joined(missing)
            for first, stop in lost:
                recorder.mark("lost", first, stop - 1, channels=[name], reason=f"not in {signal.file}")
            count = sum(stop - first for first, stop in lost if first < signal.samples)
            if count:
                yield f"{where}: {count} of {signal.samples} samples are not numbers; marked as lost"
            yield from _implausible(where, each, overloads)
            clipped = joined(overloads.spans(), round(_OVERLOAD_PAUSE_S * self._rate))
            for first, stop in clipped:
                recorder.mark("overload", first, stop - 1, channel=name)
            if clipped:
                yield f"{where} is clipped in {len(clipped)} segments; marked as overload"
        if self._power is not None and (warning := self._power.warning()):
            yield warning

    def _mark_test(self, recorder: Recorder) -> Iterator[str]:
        """Mark the hits or steps, or all of it as measured, as the scene's test requires; yield warnings."""
        test = self._scene.test
        if isinstance(test, Free):
            moving = [
                (overloads.peak_at, each.channel.name)
                for each, overloads in zip(self._assigned, self._overloads, strict=True)
                if each.channel.body is not None and overloads.peak_at is not None
            ]
            latest, name = max(moving, default=(0, ""))
            if latest >= _LATE_SHARE * self._samples:
                yield (
                    f"a free test: its decay begins with the first sample, but {name} moves most at "
                    f"{latest / self._rate:.4g} s. Remove the time before it with --from."
                )
            return
        if self._steps is not None:
            yield from self._steps.mark(recorder, self._assigned[self._steps.row])
            return
        hits = [hit for force in self._forces.values() for hit in force.hits(self._rate)]
        for number, hit in enumerate(hits, 1):
            recorder.mark("hit", hit.first, hit.stop - 1, number=number, peak=hit.peak)
        if hits:
            return
        if isinstance(test, Impulse):
            yield (
                "no hit was detected: the scene's test is an impulse, but no channel holds a force pulse. "
                "Check for swapped columns or another test."
            )
        elif not any(info.quantity == "force" for info in self._infos) and not self._scene.shakers:
            yield "no channel measures a force and the scene has no shaker, so responses have no reference"
        else:
            low, high = _LOWEST_RATIO * self._rate, _HIGHEST_RATIO * self._rate
            if isinstance(test, SweptSine | Random | Multisine):
                low, high = sorted((test.from_, test.to))
            recorder.mark("measure", 0, self._samples - 1, **{"from": low, "to": high})


def _implausible(where: str, each: Assigned, overloads: Overloads) -> Iterator[str]:
    """Yield warnings of implausible readings."""
    peak, unit = overloads.peak / abs(each.info.sensitivity), each.info.unit
    if not np.isfinite(peak):
        yield f"{where} contains no numbers"
        return
    if overloads.span == 0.0:
        yield f"{where} reads {peak:.6g} {unit} throughout: the sensor is dead, or not connected"
    if peak > _IMPLAUSIBLE[each.info.quantity]:
        yield f"{where} reads up to {peak:.3g} {unit}. Check for a wrong unit or sensitivity."
    if overloads.beyond_limit:
        yield (
            f"{where} reads up to {overloads.peak:.4g} V, above the converter's range of {overloads.limit:.4g} V. "
            "Correct unit, sensitivity or range."
        )
