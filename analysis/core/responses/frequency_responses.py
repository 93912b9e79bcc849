"""Frequency responses of any recording, by the estimator for its kind of test."""

from collections.abc import Sequence
from dataclasses import replace

from analysis.core.recordings.opening import takes_path
from analysis.core.responses.checks.channel_changes import change_warnings, without_mean_delay
from analysis.core.responses.checks.failed_channels import failed_channel_warnings
from analysis.core.responses.checks.tone_steps import sweep_warnings
from analysis.core.responses.errors.systematic import ASSUMED_TOLERANCE, has_assumed_tolerance
from analysis.core.responses.estimator import Blocks, Request, estimator_of
from analysis.core.responses.measurands import (
    default_reference,
    relative_forces,
    required_channels,
    select_channels,
    strong_forces,
    weak_force_warnings,
)
from daq.core.recording.markers import describe_faulty_impacts
from daq.core.recording.recorded_test import TestKind
from daq.core.recording.recording import Recording
from rig.core.base.errors import RecordingError, SceneError
from rig.core.base.progress import CountProgress
from rig.core.numerics.blas_threads import with_one_blas_thread
from rig.core.results import format_percent
from rig.core.results.response import MOTIONS
from rig.core.results.response import Response as Response
from rig.core.settings.quantities import FORCE, number

#: Beginning of the warning about a recording without a filter, by which other modules recognize it.
EXCLUDED_ALIASING = "The uncertainty excludes aliasing"


@takes_path
@with_one_blas_thread
def frequency_responses(
    rec: Recording,
    channels: Sequence[str] | None = None,
    reference: str | None = None,
    motion: str = "displacement",
    estimator: str | None = None,
    block: float | None = None,
    progress: CountProgress | None = None,
    overlap: float | None = None,
    window: str | None = None,
    level: float | str | None = None,
    direction: str | None = None,
) -> list[Response]:
    """Estimate the frequency responses of one recording; `analysis.frf` is this function for any number of recordings.

    Parameters
    ----------
    rec : daq.Recording, str or Path
        The recording, or its path, of a sine, stepped sine, swept sine, random, multisine or impact test.
    channels : sequence of str, optional
        As `response` in `analysis.frf`.
    reference, motion, estimator, block, progress, overlap, window, level, direction : as in `analysis.frf`
        Input, quantity and estimator of the responses, and the selected sweeps; by default, all sweeps.

    Returns
    -------
    list of Response
        A matrix of all outputs over all inputs [m/N] for each sweep (level and direction); one input is one column.

    Raises
    ------
    SceneError
        If an option is unknown or does not apply to the kind of test.
    """
    blocks = Blocks(estimator, block, overlap, window)
    if motion not in MOTIONS:
        raise SceneError(f"motion: got {motion!r}; expected {', '.join(MOTIONS)}")
    names, kind = select_channels(rec, channels), rec.test.kind
    if not names:
        raise RecordingError(f"{rec.path}: no channel measures a body's motion. Add one to the scene's channels.")
    own_estimator = estimator_of(kind)
    unused = [name for name, value in vars(blocks).items() if value is not None and name not in own_estimator.options]
    if unused:
        has_responses = kind.drives and kind is not TestKind.NONE
        method = own_estimator.method if has_responses else rec.test.name
        verb, pronoun = ("has", "it") if len(unused) == 1 else ("have", "them")
        raise SceneError(f"{rec.path}: {', '.join(unused)} {verb} no effect ({method}). Omit {pronoun}.")
    measured = [marker for marker in rec.markers if marker.kind == "measure"]
    if kind.marked and not measured:
        raise RecordingError(f"{rec.path}: the test ended before its first measurement. Record it again.")
    if (level is not None or direction is not None) and not kind.steady and kind is not TestKind.NONE:
        raise SceneError(f"{rec.path}: no sweeps of steady tones to choose from. Omit level and direction.")
    reference = reference or default_reference(rec)
    relative = relative_forces(rec) if reference == "force" else []
    forces = strong_forces(relative)
    inputs = forces if len(forces) > 1 else ()
    used = [*names, *(point.name for point in inputs)] if inputs else required_channels(rec, names, reference)
    amplitude = number(level, FORCE, "level")
    request = Request(rec, names, reference, motion, blocks, progress, used, measured, inputs, amplitude, direction)
    computed = own_estimator.compute(request)
    warnings = weak_force_warnings(relative)
    warnings += failed_channel_warnings(rec, used, names)
    if faulty := describe_faulty_impacts(rec.markers, used):
        warnings.append(faulty)
    warnings += [text for parts in own_estimator.parts(request) for text in change_warnings(rec, parts, used)]
    warnings += [
        f"The test ended early ({marker.fields['reason']}): points or averages are missing. Record it again to its end."
        for marker in rec.markers
        if marker.kind == "abort"
    ]
    unfiltered = [name for name in used if not rec.channels[name].filter]
    if rec.source and unfiltered:
        warnings.append(
            f"{', '.join(unfiltered)}: imported, and the scene names no filter of the converter. "
            f"{EXCLUDED_ALIASING} from above half the sample rate. Name the filter in the scene (converter.preset or "
            "converter.filter), and import again."
        )
    if assumed := [name for name in used if has_assumed_tolerance(rec, name)]:
        warnings.append(
            f"{', '.join(assumed)}: imported, and the scene states no sensitivity_tolerance. The uncertainty assumes "
            f"sensors calibrated within {format_percent(ASSUMED_TOLERANCE)}. State the tolerance in the scene, and "
            "import again."
        )
    if own_estimator.jumps:
        texts_of_sweeps = sweep_warnings(rec, own_estimator.tones(request), used, computed)
        computed = [response.warn(*texts) for response, texts in zip(computed, texts_of_sweeps, strict=True)]
    return [
        replace(response, test=kind.value, warnings=without_mean_delay((*response.warnings, *warnings)))
        for response in computed
    ]


@takes_path
def frfs(
    rec: Recording,
    channels: Sequence[str] | None = None,
    reference: str | None = None,
    motion: str = "displacement",
    level: float | str | None = None,
    direction: str | None = None,
) -> Response:
    """Short form of `analysis.frf` for one sweep of one recording: return its response, with all outputs.

    Every channel is corrected for its sensor, amplifier and converter. The force is measured by a force channel if
    there is one. Otherwise it is the force in the coil spring, F1 = k0 (x0 - x1), from the channels on the table and on
    the driven body.

    Parameters
    ----------
    rec, channels, reference, motion, level, direction : as in `frequency_responses`
        As in `frequency_responses`; a response may also be named by the body that carries the sensor.

    Returns
    -------
    Response
        All outputs over the force [m/N], or over the motion of the table [1].

    Raises
    ------
    SceneError
        If not exactly one sweep matches; the message lists the available sweeps.

    Examples
    --------
    >>> import analysis
    >>> frfs = analysis.frfs("recordings/demo-sweep-no-damper.mcap")
    >>> frfs["body3"].name, analysis.identify(frfs).frequency.round(2).tolist()
    ('compliance', [13.04, 34.78, 49.66])
    """
    from analysis.core.responses.stepped_sine import describe_sweeps, sweeps

    reference = reference or default_reference(rec)
    responses = frequency_responses(rec, channels, reference, motion, level=level, direction=direction)
    if len(responses) != 1:
        available = describe_sweeps(sweeps(rec, required_channels(rec, select_channels(rec, channels), reference)))
        problem = "several sweeps match" if responses else "no sweep matches"
        raise SceneError(
            f"{rec.path}: {problem}. Choose one of {available}, or use all of them with analysis.frequency_responses."
        )
    return responses[0]


@takes_path
def compliance(
    rec: Recording,
    response: str = "body3",
    reference: str | None = None,
    level: float | str | None = None,
    direction: str | None = None,
) -> Response:
    """Short form of `analysis.frf` for one channel of one sweep: return its compliance or transmissibility.

    Parameters
    ----------
    rec : daq.Recording, str or Path
        The recording, or its path.
    response : str
        Channel, or the body that carries the sensor.
    reference, level, direction : as in `frfs`
        Denominator and sweep.

    Returns
    -------
    Response
        Compliance [m/N], or motion per motion of the table [1], at each frequency [Hz].
    """
    return frfs(rec, [response], reference, level=level, direction=direction)[0]
