"""Turn time histories of a real bench into a recording."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np

from daq.importing.assignment import Assigned, Choice, assign, choose, contradicted_units
from daq.importing.channel_table import Column, read_table
from daq.importing.driving_power import MOTIONS, DrivingPower
from daq.importing.files import signals_of
from daq.importing.force_pulses import ForcePulses
from daq.importing.overloads import Overloads, joined
from daq.importing.signal import Array, Signal
from daq.importing.steps import StepFinder, mark_steps
from daq.recording.recorder import Recorder
from daq.recording.recording import open as open_recording
from daq.recording.timebase import refuse_reversed
from daq.signal_chain.channel import ChannelInfo
from rig.errors import RecordingError, RunWarning, SceneError, ShotrigError
from rig.input_files import path_of, repeated
from rig.numerics.runs import runs_of
from rig.output_files import destination, replacing
from rig.scene.excitation import Free, Impulse, Multisine, Random, Sine, SteppedSine, SweptSine
from rig.scene.loading import SceneLike, load
from rig.scene.scene import Scene

Progress = Callable[[float, str], None]

# Samples of each channel in memory at a time.
_PIECE = 1 << 16
# Rates that differ by less are one rate, rounded in one of the files.
_SAME_RATE = 2e-5
# Of what a real test excites, what is looked at where its scene does not say: parts of the sample rate.
_LOWEST, _HIGHEST = 1e-4, 0.4
# Readings beyond these, in the unit of their quantity, are no vibration.
_ABSURD = {"acceleration": 1e6, "velocity": 1e4, "displacement": 1e2, "force": 1e7, "voltage": 1e4}
_LOST_LISTED = 1000
# Part of a free test after which its largest motion comes late.
_LATE = 0.05


def import_files(
    files: Sequence[str | Path] | str | Path,
    scene: SceneLike,
    path: str | Path,
    *,
    table: Mapping[str, Column] | str | Path | None = None,
    from_s: float | None = None,
    to_s: float | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Path:
    r"""Make a recording of time histories that other programs have measured.

    Signals become the channels of the scene, by name or as a table says, in SI. Where samples are missing the recording
    says `lost`, where they were clipped `overload`. The excitation is that of the scene's test: hits
    are found in the force channel, and the steps of a sine or stepped sine where a tone is held; any other excitation
    is taken as one measurement from end to end.

    Parameters
    ----------
    files : path or sequence of paths
        TDMS (.tdms), Universal File (.uff, .unv), WAV, text (.csv, .txt, .tsv, .lvm), numpy (.npz, .npy), MATLAB (.mat)
        or another program's MCAP.
    scene : Scene, str, Path or mapping
        What was on the bench: structure, dampers, shaker, test, channels with their sensors.
    path : str or Path
        Recording to write (MCAP), in an existing folder.
    table : mapping of str to Column, or str or Path, optional
        Which column is which channel, or the file that says so; see `daq.importing.channel_table`.
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
        If a file cannot be read, or contradicts itself or another one; no recording is left behind.
    RunError
        If a package is missing, or the disk is full.

    Warns
    -----
    RunWarning
        For everything that is missing, left out or doubtful.

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
    what = load(scene)
    named: Sequence[str | Path] = (
        [files] if isinstance(files, str | Path) or not isinstance(files, Sequence) else files
    )
    paths = [path_of(file, "files") for file in named]
    said = table if isinstance(table, Mapping) else {} if table is None else read_table(Path(table))
    for first, again in repeated(paths):
        raise RecordingError(f"{again}: the same content as {first}. Give each file once.")
    with ExitStack() as stack:
        signals = [signal for file in paths for signal in signals_of(file, stack)]
        # Only now: that a file is missing or no such scene is what the user should hear of first.
        destination(path_of(path), overwrite or _is_import_of(path_of(path), paths), RecordingError)
        chosen, notes = choose(what, signals, said)
        notes += contradicted_units(chosen)
        rate = _common_rate(chosen, what)
        made = _cut(_started_together(assign(what, chosen, rate)), rate, from_s, to_s)
        notes += _lengths(made)
        with warnings.catch_warnings(record=True) as heard:
            warnings.simplefilter("always", RunWarning)
            notes += _Import(_as_it_was(what, made, rate), made, rate).run(Path(path), overwrite, progress)
    for note in dict.fromkeys([*notes, *(str(each.message) for each in heard)]):
        warnings.warn(note, RunWarning, stacklevel=2)
    return Path(path)


def _is_import_of(path: Path, files: Sequence[Path]) -> bool:
    """Whether a file is a recording of other programs' files with these names."""
    try:
        with open_recording(path) as recording:
            return bool(recording.source) and recording.source in ", ".join(file.name for file in files)
    except ShotrigError:
        return False


def _common_rate(chosen: Sequence[Choice], scene: Scene) -> float:
    """Find the one rate of all signals: the table's, the files', or else the scene's."""
    given = {one.column.rate for one in chosen if one.column.rate is not None}
    if len(given) > 1:
        raise SceneError(f"the table gives several rates, {_several(given)}; a recording has one")
    if given:
        return given.pop()
    converter = scene.converter
    stated = "rate" in converter.model_fields_set or converter.preset is not None
    rates = sorted({one.signal.rate for one in chosen if one.signal.rate is not None})
    if not rates:
        if not stated:
            raise SceneError(
                "nothing says how fast the samples came: the files have no times, and no rate; give rate: in the "
                "table, or converter: {rate: 5120 Hz} in the scene"
            )
        return converter.sample_rate
    if rates[-1] > rates[0] * (1.0 + _SAME_RATE):
        raise RecordingError(
            f"the signals have several sample rates, {_several(rates)}; a recording has one: import them one by one, "
            "or choose those of one rate in a table"
        )
    rate = rates[0]
    if stated and abs(converter.sample_rate - rate) > _SAME_RATE * rate:
        raise SceneError(
            f"the files say {rate:.10g} Hz, the scene's converter {converter.sample_rate:.10g} Hz; correct the one "
            f"that is wrong: --set converter.rate={rate:.10g}Hz, or rate: in the table"
        )
    return rate


def _several(rates: Sequence[float] | set[float]) -> str:
    return ", ".join(f"{rate:.10g} Hz" for rate in sorted(rates))


def _started_together(made: Sequence[Assigned]) -> list[Assigned]:
    """Take small differences of the start for delays; refuse signals that began at different times."""
    stated = [one for one in made if one.column.delay is None]
    if not stated:
        return list(made)
    origin = stated[0].signal
    out = []
    for one in made:
        late = _start(one.signal, origin)
        if one.column.delay is not None or late == 0.0:
            out.append(one)
            continue
        rate = one.info.rate
        if abs(late) * rate > 0.5:
            raise RecordingError(
                f"{one.signal.name!r} of {one.signal.file} begins {late:.6g} s after {origin.name!r} of {origin.file}: "
                "they do not belong together sample by sample; import them one by one or, where the files are wrong, "
                "say delay: 0 s for both in the table"
            )
        out.append(replace(one, info=replace(one.info, delay=one.info.delay - late)))
    return out


def _start(signal: Signal, origin: Signal) -> float:
    """Time of a signal's first sample after another's, s; dates count where both have one."""
    dated = signal.start_ns and origin.start_ns
    return signal.start_s - origin.start_s + ((signal.start_ns - origin.start_ns) * 1e-9 if dated else 0.0)


def _cut(
    made: Sequence[Assigned], rate: float, from_s: float | None, to_s: float | None
) -> Sequence[Assigned]:
    """Take the samples between two times."""
    if from_s is None and to_s is None:
        return made
    refuse_reversed(from_s, to_s)
    longest = max(one.signal.samples for one in made)
    start = 0 if from_s is None else max(0, math.ceil(from_s * rate))
    stop = longest if to_s is None else min(longest, math.ceil(to_s * rate))
    if stop - start < 2:
        raise SceneError(
            f"nothing is left between --from and --to: the files hold 0 s to {longest / rate:.6g} s"
        )

    def within(signal: Signal) -> Signal:
        return replace(
            signal,
            samples=max(min(stop, signal.samples) - start, 0),
            read=lambda first, last: signal.read(start + first, start + last),
            start_s=signal.start_s + start / rate,
        )

    return [replace(one, signal=within(one.signal)) for one in made]


def _lengths(made: Sequence[Assigned]) -> list[str]:
    longest = max(one.signal.samples for one in made)
    short = [f"{one.channel.name} ({one.signal.samples})" for one in made if one.signal.samples < longest]
    return [f"of {longest} samples, {', '.join(short)} are all there are; the rest is lost"] if short else []


def _as_it_was(scene: Scene, made: Sequence[Assigned], rate: float) -> Scene:
    """Give the scene as the files have it: its channels as far as they are there, and their rate."""
    converter = scene.converter.replace(rate=rate, remove_delay=True, dropped_blocks=(), skew=None)
    if abs(converter.sample_rate - rate) > _SAME_RATE * rate:
        raise SceneError(
            f"the files say {rate:.10g} Hz, at which a {converter.preset} does not sample; give the scene the "
            "converter that was used, or none"
        )
    return scene.replace(
        channels=[one.channel for one in made],
        converter=converter,
        recording=scene.recording.replace(
            truth=False, samples="float32" if scene.recording.samples == "float32" else "float64"
        ),
    )


def _driving_power(scene: Scene, infos: Sequence[ChannelInfo]) -> tuple[DrivingPower, list[int]] | None:
    """Watch the force, where there is one channel of it, and the motion where it acts; with the rows of both."""
    forces = [row for row, info in enumerate(infos) if info.quantity == "force"]
    places = [f"body {number}" for number in scene.force_on]
    motions = [row for row, info in enumerate(infos) if info.quantity in MOTIONS and [info.at] == places]
    if len(forces) != 1 or not motions:
        return None
    rows = [forces[0], motions[0]]
    return DrivingPower(infos[rows[0]], infos[rows[1]]), rows


class _Import:
    """One import: signals go through in pieces, are looked at, and are written."""

    def __init__(self, scene: Scene, made: Sequence[Assigned], rate: float) -> None:
        self._scene, self._made, self._rate = scene, made, rate
        self._infos = [one.info for one in made]
        self._source = ", ".join(dict.fromkeys(Path(one.signal.file).name for one in made))
        self._samples = max(one.signal.samples for one in made)
        self._missing: list[list[tuple[int, int]]] = [[] for _ in made]
        self._overloads = [Overloads(_limit(one)) for one in made]
        self._forces = [
            ForcePulses() if one.info.quantity == "force" and isinstance(scene.test, Impulse | None) else None
            for one in made
        ]
        self._power = _driving_power(scene, self._infos)
        self._steps = (
            StepFinder(scene, self._infos, rate) if isinstance(scene.test, Sine | SteppedSine) else None
        )

    def run(self, path: Path, overwrite: bool, progress: Progress | None) -> list[str]:
        """Write the recording; give what must be said about it."""
        start_ns = max(one.signal.start_ns for one in self._made)
        start_ns += round(self._made[0].signal.start_s * 1e9) if start_ns else 0
        infos = self._infos
        with (
            replacing(path, overwrite or None) as part,
            Recorder(part, self._scene, infos, self._rate, max(start_ns, 0), source=self._source) as recorder,
        ):
            for first in range(0, self._samples, _PIECE):
                stop = min(first + _PIECE, self._samples)
                piece = np.stack([self._piece(row, first, stop) for row in range(len(infos))])
                recorder.write(piece)
                if self._power is not None:
                    power, rows = self._power
                    power.add(*piece[rows])
                if self._steps is not None:
                    self._steps.add(piece)
                if progress is not None:
                    progress(stop / self._samples, f"{stop / self._rate:.0f} s")
            return self._mark(recorder)

    def _piece(self, row: int, first: int, stop: int) -> Array:
        """Read a piece of a channel in volts, NaN where there is nothing, and look at it."""
        one = self._made[row]
        volts = np.full(stop - first, np.nan)
        there = min(stop, one.signal.samples)
        if there > first:
            volts[: there - first] = one.volts(first, there)
            volts[~np.isfinite(volts)] = np.nan
        self._missing[row] += [(first + a, first + b) for a, b in runs_of(np.isnan(volts))]
        if len(self._missing[row]) > _LOST_LISTED:
            self._missing[row] = joined(self._missing[row], round(0.1 * self._rate))
        self._overloads[row].add(first, volts)
        force = self._forces[row]
        if force is not None:
            force.add(first, volts / one.info.sensitivity)
        return volts

    def _mark(self, recorder: Recorder) -> list[str]:
        """Mark what was lost and clipped, and what was measured; say what is doubtful."""
        notes: list[str] = []
        for one, missing, overloads in zip(self._made, self._missing, self._overloads, strict=True):
            name, where = one.channel.name, f"{one.channel.name} ({one.signal.name!r} of {one.signal.file})"
            lost = joined(missing)
            for first, stop in lost:
                recorder.mark("lost", first, stop - 1, channels=[name], reason=f"not in {one.signal.file}")
            count = sum(stop - first for first, stop in lost if first < one.signal.samples)
            if count:
                notes.append(
                    f"{where}: {count} of {one.signal.samples} samples are no numbers; marked as lost"
                )
            notes += _doubts(where, one, overloads, count)
            clipped = joined(overloads.found(), round(0.01 * self._rate))
            for first, stop in clipped:
                recorder.mark("overload", first, stop - 1, channel=name)
            if clipped:
                notes.append(f"{where} is clipped in {len(clipped)} stretches; marked as overload")
        if self._power is not None:
            notes += filter(None, [self._power[0].warning()])
        return notes + self._mark_test(recorder)

    def _mark_test(self, recorder: Recorder) -> list[str]:
        """Mark the hits, or all of it as measured, as the scene's test says."""
        test = self._scene.test
        if isinstance(test, Free):
            return self._released()
        if self._steps is not None:
            return mark_steps(recorder, self._steps, self._made[self._steps.row])
        hits = [hit for force in self._forces if force is not None for hit in force.hits(self._rate)]
        if isinstance(test, Impulse) and not hits:
            return [
                "no hit was found: the scene says impulse, but no channel holds a force that rises from rest and goes "
                "back; are columns swapped, or was it another test?"
            ]
        for number, hit in enumerate(hits, 1):
            recorder.mark("hit", hit.first, hit.stop - 1, number=number, peak=hit.peak)
        if hits:
            return []
        if not any(info.quantity == "force" for info in self._infos) and not self._scene.shakers:
            return ["no channel measures a force and the scene has no shaker, so responses have no reference"]
        low, high = _LOWEST * self._rate, _HIGHEST * self._rate
        if isinstance(test, SweptSine | Random | Multisine):
            low, high = sorted((test.from_, test.to))
        recorder.mark("measure", 0, self._samples - 1, **{"from": low, "to": high})
        return []

    def _released(self) -> list[str]:
        """Say where a free decay begins, if that is not where the file does."""
        moving = [
            (overloads.peak_at, one.channel.name)
            for one, overloads in zip(self._made, self._overloads, strict=True)
            if one.channel.body is not None and overloads.peak_at is not None
        ]
        late = max(moving, default=(0, ""))
        if late[0] < _LATE * self._samples:
            return []
        return [
            f"a free test: its decay is taken from the first sample on, but {late[1]} moves most at "
            f"{late[0] / self._rate:.4g} s; leave out what comes before (--from)"
        ]


def _limit(one: Assigned) -> float | None:
    """Largest voltage that a signal can read: full scale of its file, or the converter's range."""
    if one.signal.full_scale is not None:
        return abs(one.signal.full_scale * one.factor)
    return one.info.range if one.calibrated else None


def _doubts(where: str, one: Assigned, overloads: Overloads, lost: int) -> list[str]:
    """Say what hardly can be right of a channel."""
    peak, unit = overloads.peak / abs(one.info.sensitivity), one.info.unit
    if not np.isfinite(peak):
        return [f"{where} holds no number at all"]
    notes = []
    if overloads.span == 0.0:
        notes.append(f"{where} reads {peak:.6g} {unit} throughout: it is dead, or not connected")
    if peak > _ABSURD[one.info.quantity]:
        notes.append(f"{where} reads up to {peak:.3g} {unit}: a wrong unit or sensitivity?")
    if overloads.beyond_limit:
        notes.append(
            f"{where} reads up to {overloads.peak:.4g} V, beyond the converter's range of {overloads.limit:.4g} V: "
            "unit, sensitivity or range is wrong"
        )
    return notes
