"""The commands of `analysis` as Python calls: same names and arguments; each returns a result that plots itself.

The commands print, draw and tabulate the results of these calls.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from rig.core.base.figure_types import Axes
from rig.core.base.progress import CountProgress
from rig.core.results.result import Result, join_columns
from rig.core.results.table import Table, join_tables

if TYPE_CHECKING:
    from analysis.commands.presentation.comparison import Comparison
    from analysis.core.damper_motion.dampers import Dampers
    from analysis.core.modal.modes import Modes
    from analysis.studies.cost.study import ChainStudy
    from daq.core.recording.recording import Recording
    from rig.core.results.response import Response
    from rig.core.scene.loading import SceneLike

R = TypeVar("R", bound=Result)
OneRecording: TypeAlias = "Recording | str | Path"
Recordings: TypeAlias = "OneRecording | Sequence[OneRecording]"


class Results(Result, Sequence[R], Generic[R]):
    """Sequence of results in the order of the recordings, one for each sweep (level and direction).

    It plots all results in one figure and joins their tables.
    """

    def __init__(self, results: Iterable[R]) -> None:
        self._results = tuple(results)

    def __getitem__(self, index: Any) -> Any:
        """Return one result, or a selection of them."""
        return Results(self._results[index]) if isinstance(index, slice) else self._results[index]

    def __len__(self) -> int:
        return len(self._results)

    def columns(self) -> dict[str, NDArray[Any]]:
        """Join the columns that all results have; the column `label` names the recording and sweep."""
        all_columns = [dict(result.columns()) for result in self._results]
        names = [
            name for name in (all_columns[0] if all_columns else {}) if all(name in columns for columns in all_columns)
        ]
        tables = []
        for result, columns in zip(self._results, all_columns, strict=True):
            count = len(next(iter(columns.values()), ()))
            label = np.full(count, str(getattr(result, "label", "")))
            tables.append({name: columns[name] for name in names} | {"label": label})
        return join_columns(tables)

    def table(self) -> Table:
        """Join the tables of all results; the label of each result is a subheading."""
        return join_tables((str(getattr(result, "label", "")), result.table()) for result in self._results)

    def summary(self) -> str:
        """Return the summaries of all results, one per line."""
        return "\n".join(result.summary() for result in self._results)

    def draw(self, ax: Axes, **style: Any) -> None:
        """Draw all results into the same axes."""
        for result in self._results:
            result.draw(ax, **style)

    def _repr_html_(self) -> str:
        return "".join(result._repr_html_() for result in self._results)


def frf(
    recordings: Recordings,
    response: Sequence[str] | None = None,
    reference: str | None = None,
    motion: str = "displacement",
    estimator: str | None = None,
    block: float | None = None,
    overlap: float | None = None,
    window: str | None = None,
    unit: str | None = None,
    progress: CountProgress | None = None,
    level: float | str | None = None,
    direction: str | None = None,
) -> Results[Response]:
    """Estimate frequency responses with 95 % intervals and coherence, as `analysis frf`.

    This call evaluates any test with any number of shakers: each response is a matrix of outputs over inputs.

    Parameters
    ----------
    recordings : daq.Recording, str, Path or a sequence of these
        Recordings, or .uff and .csv files with responses that other programs have estimated.
    response : sequence of str, optional
        Response channels. Default: all channels on bodies.
    reference : {'force', 'table'}, optional
        Input of the responses: force on the structure, or displacement of the table. Default: the table if it carries
        the structure, otherwise the force.
    motion : {'displacement', 'velocity', 'acceleration'}
        Motion of the response: displacement (compliance), velocity (mobility) or acceleration (accelerance).
    estimator : {'H1', 'H2', 'Hv'}, optional
        Average spectra of blocks, in random and impact tests. H1 assumes noise in the response, H2 in the force, Hv in
        both. Default: a fit to the whole record, without leakage.
    block : float, optional
        Average the spectra of blocks of this length in seconds, in random and impact tests.
    overlap : float, optional
        Overlap of blocks, as a fraction of their length. Default: 0.5.
    window : str, optional
        Window of the blocks, such as ``hann`` or ``flattop`` (names of scipy). Default: ``hann`` in random tests, none
        in impact tests.
    unit : str, optional
        Unit of responses in a file (.uff, .csv) without a unit, such as ``g/N``.
    progress : callable, optional
        Called with (completed, total).
    level, direction : float or str, and str, optional
        Sweep to select if the test has several sweeps: its level, such as ``"2.6 N"``, and ``"up"`` or ``"down"``.

    Returns
    -------
    Results of Response
        For each sweep a matrix [m/N] with a row for each output and a column for each input.

    Examples
    --------
    >>> import analysis
    >>> responses = analysis.frf("recordings/demo-sweep-no-damper.mcap")
    >>> responses[0].keys()
    ('body1', 'body2', 'body3')
    """
    from analysis.commands.presentation.inputs import read_curves
    from analysis.core.responses.frequency_responses import frequency_responses
    from rig.core.results.response import stack

    responses = []
    for source, label in _sources(recordings):
        if isinstance(source, Path):
            curves = read_curves(source, reference, response, unit)
            responses.append(_labeled(stack([curve.to(motion) for curve in curves]), label))
            continue
        with source as rec:
            for sweep in frequency_responses(
                rec, response, reference, motion, estimator, block, progress, overlap, window, level, direction
            ):
                responses.append(_labeled(sweep, label, rec.scene.name))
    return Results(responses)


def modes(
    recordings: Recordings,
    reference: str | None = None,
    modes: int | None = None,
    block: float | None = None,
    unit: str | None = None,
    progress: CountProgress | None = None,
    response: Sequence[str] | None = None,
) -> Results[Modes]:
    """Estimate natural frequencies, damping ratios and mode shapes, as `analysis modes`.

    Parameters
    ----------
    recordings, reference : as in `frf`
        Recordings or files with responses, and the input.
    modes : int, optional
        Largest number of modes. Default: all significant modes.
    block, unit, progress : as in `frf`
        Length of blocks, unit of files, and a callable for the progress.
    response : as in `frf`
        Response channels.

    Returns
    -------
    Results of Modes
        Natural frequencies [Hz], damping ratios and shapes of each sweep. `analysis.mac` compares shapes of two sweeps.
    """
    from analysis.core.modal.identification import identify

    responses = frf(recordings, response, reference, block=block, unit=unit, progress=progress)
    return Results(_labeled(identify(response, modes), response.label) for response in responses)


def dampers(recordings: Recordings, progress: CountProgress | None = None) -> Results[Dampers]:
    """Estimate impacts and dissipated energy of dampers in stepped sines, as `analysis dampers`.

    Parameters
    ----------
    recordings : daq.Recording, str, Path or a sequence of these
        Recordings.
    progress : callable, optional
        Called with (completed, total).

    Returns
    -------
    Results of Dampers
        Impacts per period and dissipated energy [J] at each frequency [Hz] of each sweep.
    """
    from analysis.commands.presentation.inputs import check_recording
    from analysis.core.damper_motion.dampers import dampers_in
    from rig.core.base.errors import RecordingError

    results: list[Dampers] = []
    for source, label in _sources(recordings):
        if isinstance(source, Path):
            raise RecordingError(f"{source}: this file contains frequency responses. Give a recording (.mcap).")
        with source as rec:
            check_recording(rec, rec.path, "dampers")
            results += dampers_in(rec, label, progress)
    return Results(results)


def compare(recordings: Sequence[OneRecording], progress: CountProgress | None = None) -> Comparison:
    """Compare height and frequency of resonance peaks with the first recording, like `analysis compare`.

    Parameters
    ----------
    recordings : sequence of daq.Recording, str or Path
        Two or more recordings.
    progress : callable, optional
        Called with (completed, total).

    Returns
    -------
    Comparison
        Change of height [dB] and frequency [Hz] of each peak with its 95 % interval.
    """
    from analysis.commands.presentation.comparison import compare_peaks

    return compare_peaks(_paths(recordings), progress)


def report(
    recordings: Recordings,
    output: str | Path | None = None,
    overwrite: bool = False,
    progress: CountProgress | None = None,
    note: str = "",
) -> Path:
    """Write an interactive HTML page about recordings, as `analysis report`.

    Parameters
    ----------
    recordings : daq.Recording, str, Path or a sequence of these
        Recordings; the first one without moving dampers is the reference.
    output : str or Path, optional
        Folder, or .html file; if omitted, the folder of the first recording.
    overwrite : bool
        Whether an existing page may be replaced.
    progress : callable, optional
        Called with (completed, total).
    note : str
        Text below the summary: date, operator, remarks.

    Returns
    -------
    Path
        The page.
    """
    from analysis.commands.report_page.report import write_report
    from rig.core.base.output_files import allow_overwriting

    with allow_overwriting(overwrite):
        return write_report(_paths(recordings), None if output is None else Path(output), progress, note).files[0]


def export(
    recording: OneRecording,
    output: str | Path,
    channel: Sequence[str] | None = None,
    from_s: float | None = None,
    to_s: float | None = None,
    speed: float = 1.0,
    overwrite: bool = False,
    what: str = "samples",
    progress: CountProgress | None = None,
) -> Path:
    """Export a recording as UFF, MATLAB, CSV, NPZ or WAV file, as `analysis export`.

    Parameters
    ----------
    recording : daq.Recording, str or Path
        The recording.
    output : str or Path
        File to write: .uff, .mat, .csv, .npz or .wav.
    channel : sequence of str, optional
        Channels to export. Default: all.
    from_s : float, optional
        Start of the exported part, in seconds from the beginning of the recording.
    to_s : float, optional
        End of the exported part, in seconds from the beginning of the recording.
    speed : float
        Playback speed of a .wav file. At 10, a tone of 30 Hz sounds at 300 Hz.
    overwrite : bool
        Whether an existing file may be replaced.
    what : {'samples', 'frfs', 'modes'}
        Write the samples, or the frequency responses (frfs) or modes estimated from them. The latter two require a
        .uff or .mat file.
    progress : callable, optional
        Called with (completed, total).

    Returns
    -------
    Path
        The file.
    """
    from analysis.core.recordings.opening import open_existing
    from analysis.core.recordings.slices import Slice
    from analysis.extras.formats.export import export as export_segment
    from analysis.extras.formats.results import export_results

    path, target = _path(recording), Path(output)
    if what != "samples":
        export_results(path, target, what, overwrite, progress)
        return target
    with open_existing(path) as rec:
        export_segment(Slice.of(rec, channel, from_s, to_s), target, speed, overwrite, progress)
    return target


def cost(
    scene: SceneLike, frequency: Sequence[float] | None = None, progress: CountProgress | None = None
) -> ChainStudy:
    """Measure error and computing time of the measurement chain, changing one part at a time, as `analysis cost`.

    Parameters
    ----------
    scene : Scene, str, Path or mapping
        A scene, or an argument of `rig.load`.
    frequency : sequence of float, optional
        Frequencies to measure [Hz]. Default: both ends of the test, and the frequency of largest acceleration.
    progress : callable, optional
        Called with (completed, total).

    Returns
    -------
    ChainStudy
        Error (1: the value itself) and time [s] of each variant.
    """
    from analysis.studies.cost.study import chain_study
    from rig.core.scene.loading import scene_of

    return chain_study(scene_of(scene), frequency, progress)


def paper(
    output: str | Path,
    fresh: Sequence[str] = (),
    cluster: str | None = None,
    overwrite: bool = False,
    progress: Callable[[str], None] | None = None,
) -> list[Path]:
    """Reproduce the figures of the paper and assess its claims, as `analysis paper`.

    Parameters
    ----------
    output : str or Path
        Folder for data, figures and the page. A repeated call continues an incomplete one.
    fresh : sequence of str
        Names of the parts to compute again, such as ``"rec-fig9"``.
    cluster : str, optional
        Address of a Dask scheduler, as in `rig.design`.
    overwrite : bool
        Whether existing figures and pages may be replaced.
    progress : callable, optional
        Called with lines of text.

    Returns
    -------
    list of Path
        Figures and pages.
    """
    from analysis.studies.paper.reproduce import reproduce
    from rig.core.base.output_files import allow_overwriting

    with allow_overwriting(overwrite):
        return reproduce(Path(output), progress or (lambda _: None), fresh, cluster)


def _as_list(recordings: Recordings) -> list[OneRecording]:
    from analysis.core.recordings.opening import require_recording

    is_single = isinstance(recordings, str | Path) or hasattr(recordings, "channels")
    sources: Any = [recordings] if is_single or not isinstance(recordings, Iterable) else list(recordings)
    for source in sources:
        require_recording(source, "recordings")
    return list(sources)


def _paths(recordings: Recordings) -> list[Path]:
    return [
        Path(recording) if isinstance(recording, str | Path) else recording.path for recording in _as_list(recordings)
    ]


def _path(recording: OneRecording) -> Path:
    from rig.core.base.errors import RecordingError

    paths = _paths(recording)
    if len(paths) != 1:
        raise RecordingError(f"recording: got {len(paths)} recordings; expected one")
    return paths[0]


def _sources(recordings: Recordings) -> Iterator[tuple[Any, str]]:
    """Yield each recording as a context manager, or the path of a file with responses, with its label."""
    from analysis.commands.presentation.inputs import labels
    from analysis.core.recordings.opening import OpenRecordings, as_context
    from analysis.extras.formats.frf_files import is_frf_file

    sources, paths = _as_list(recordings), _paths(recordings)
    with OpenRecordings() as opened:
        for source, path, label in zip(sources, paths, labels(opened, paths), strict=True):
            if is_frf_file(path):
                yield path, label
            else:
                yield as_context(opened.of(path) if isinstance(source, str | Path) else source), label


def _labeled(result: Any, label: str, scene: str | None = None) -> Any:
    """Return a result with the label of its recording instead of the name of its scene."""
    from dataclasses import replace

    from analysis.core.recordings.names import relabel

    return relabel(result, scene, label) if scene is not None else replace(result, label=label)
