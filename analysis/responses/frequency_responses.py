"""Frequency responses of any recording: the processing that belongs to the test it holds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from analysis.recordings.names import takes_path
from analysis.responses.estimators import ESTIMATORS, Averages
from analysis.responses.measurands import chosen, concerned, input_place, place
from analysis.responses.passivity import reversed_force
from daq.recording.recorded_test import TestKind
from rig.errors import RecordingError, SceneError
from rig.results.response import MOTIONS, stack
from rig.results.response import Response as Response
from rig.scene.quantities import FORCE, number

if TYPE_CHECKING:
    from analysis.responses.multisine import BestLinearApproximation
    from analysis.responses.spectral_lines import Lines
    from analysis.responses.swept_sine import SweptTone
    from analysis.responses.whole_stretches import WholeStretches
    from daq.recording.recording import Recording

Progress = Callable[[int, int], None]


# Which options of blocks can act on what a recording holds, and how it is taken where they cannot.
BLOCK_OPTIONS = {
    "random": ("estimator", "block", "overlap", "window"),
    "hits": ("estimator", "block", "window"),
}
TAKEN = {
    "multisine": "whole periods of a multisine are averaged",
    "sweep": "a sweep is taken whole, by the local rational method",
    "hits": "a block belongs to one hit",
    "tones": "held tones are averaged over whole periods",
}


@dataclass(frozen=True)
class Blocks:
    """How spectra of blocks are to be averaged, where that is asked for."""

    estimator: str | None = None
    block: float | None = None
    overlap: float | None = None
    window: str | None = None

    def __post_init__(self) -> None:
        if self.estimator is not None and self.estimator not in ESTIMATORS:
            raise SceneError(f"unknown estimator {self.estimator!r}: expected {', '.join(ESTIMATORS)}")

    @property
    def wanted(self) -> bool:
        """Whether it is asked for."""
        return self != Blocks()

    def acting_on(self, kind: str) -> Blocks:
        """Leave out what cannot act on a kind of test."""
        return Blocks(**{name: getattr(self, name) for name in BLOCK_OPTIONS.get(kind, ())})


@takes_path
def frequency_responses(
    rec: Recording,
    channels: Sequence[str] | None = None,
    reference: str = "force",
    motion: str = "displacement",
    estimator: str | None = None,
    block: float | None = None,
    progress: Progress | None = None,
    overlap: float | None = None,
    window: str | None = None,
) -> list[Response]:
    """All frequency responses that a recording holds.

    Parameters
    ----------
    rec : daq.Recording, str or Path
        The recording, or its path, of a sine, stepped sine, swept sine, random, multisine or impulse test.
    channels : sequence of str, optional
        Responses; omitted, every channel on a body.
    reference : {'force', 'table'}
        Divide by the force on the structure, or by the displacement of the table.
    motion : {'displacement', 'velocity', 'acceleration'}
        Receptance, mobility or accelerance.
    estimator : {'H1', 'H2', 'Hv'}, optional
        For random and hits: average the spectra of blocks. Omitted, random, hits and sweeps are taken whole, by the
        local rational method, which leaks nothing. Tones average amplitudes.
    block : float, optional
        Length of the blocks in s, for random and hits, each of which begins one: averages their spectra, as H1 unless
        chosen otherwise.
    progress : callable, optional
        Called with (done, in all).
    overlap : float, optional
        Part of a block that it shares with the next, for random; omitted, 0.5.
    window : str, optional
        Over each block, as `scipy.signal.get_window` names it; omitted, ``hann`` for random, none for hits.

    Returns
    -------
    list of Response
        One for each sweep (level and direction), with all outputs.

    Raises
    ------
    SceneError
        If something asked for is unknown, or cannot act on what the recording holds.
    """
    blocks = Blocks(estimator, block, overlap, window)
    if motion not in MOTIONS:
        raise SceneError(f"unknown motion {motion!r}: expected {', '.join(MOTIONS)}")
    names = chosen(rec, channels)
    if not names:
        raise RecordingError("no channel on a body: there is no response to divide")
    kind = rec.test.kind
    if blocks.acting_on(kind) != blocks:
        raise SceneError(
            f"blocks, H1, H2 and Hv are for random and hits; {rec.path}: {TAKEN.get(kind, rec.test.name)}"
        )
    out: list[list[Response]] = []
    channels = concerned(rec, names, reference)
    for source in _sources(rec, kind, channels, reference, blocks, progress):
        if isinstance(source, Averages):
            out.append([source.frf(rec, name, reference, motion, estimator or "H1") for name in names])
        else:
            curves = []
            for done, name in enumerate(names, 1):
                curves.append(source.frf(rec, name, reference, motion))
                if progress is not None:
                    progress(done, len(names))
            out.append(curves)
    said = _unfiltered(rec, channels)
    return [stack(checked(rec, [curve.warn(*said) for curve in each])) for each in out]


def checked(rec: Recording, curves: Sequence[Response]) -> list[Response]:
    """Locate curves of one sweep, and add a warning to all where the force has the wrong sign."""
    located = [_located(rec, curve) for curve in curves]
    warning = reversed_force(located)
    return [curve.warn(warning) for curve in located] if warning else located


def _located(rec: Recording, curve: Response) -> Response:
    """Say where a curve's response is and where its reference acts."""
    return curve.placed(place(rec, curve.response), input_place(rec, curve.reference))


def _unfiltered(rec: Recording, channels: Sequence[str]) -> tuple[str, ...]:
    """Warn of channels of another instrument behind no filter that the scene names."""
    bare = [name for name in channels if not rec.channels[name].filter]
    if not rec.source or not bare:
        return ()
    return (
        f"{', '.join(bare)}: imported, and the scene names no filter of the converter (converter: preset, or filter): "
        "what folds back from beyond half the sample rate is in no bound.",
    )


def _sources(
    rec: Recording,
    kind: TestKind,
    channels: Sequence[str],
    reference: str,
    blocks: Blocks,
    progress: Progress | None,
) -> Sequence[Lines | Averages | BestLinearApproximation | WholeStretches | SweptTone]:
    """Take what was measured: tones, periods, blocks of noise, a sweep, or hits."""
    measured = [marker for marker in rec.markers if marker.kind == "measure"]
    if kind in (TestKind.MULTISINE, TestKind.SWEEP, TestKind.RANDOM) and not measured:
        raise RecordingError(
            f"{rec.path}: {rec.test.name} that ended before anything was measured. Record it again."
        )
    if kind is TestKind.MULTISINE:
        from analysis.responses.multisine import best_linear_approximation

        return [best_linear_approximation(rec, measured, channels, reference, progress)]
    if kind is TestKind.SWEEP:
        from analysis.responses.swept_sine import tracked

        return [tracked(rec, marker, channels, progress) for marker in measured]
    if kind is TestKind.RANDOM:
        from analysis.responses import random

        if not blocks.wanted:
            return [random.whole(rec, marker, channels) for marker in measured]
        overlap = 0.5 if blocks.overlap is None else blocks.overlap
        window = blocks.window or "hann"
        return [
            random.averages(rec, marker, channels, blocks.block, overlap, None, progress, window)
            for marker in measured
        ]
    if kind is TestKind.HITS:
        from analysis.responses import impact

        if blocks.wanted:
            return [impact.averages(rec, channels, blocks.block, blocks.window or "none")]
        return [impact.whole(rec, channels)]
    from analysis.responses.stepped_sine import sweeps

    return [sweep.lines for sweep in sweeps(rec, channels, progress)]


@takes_path
def frfs(
    rec: Recording,
    channels: Sequence[str] | None = None,
    reference: str = "force",
    motion: str = "displacement",
    level: float | str | None = None,
    direction: str | None = None,
) -> Response:
    """Estimate the frequency responses of a test: one for each response.

    Every channel is corrected for its sensor, amplifier and converter. The force is that in the coil spring,
    F1 = k0 (x0 - x1), from the channels on the table and on the driven body, or a force channel where there is one.

    Parameters
    ----------
    rec : daq.Recording, str or Path
        As for `frequency_responses`, which gives all sweeps of a recording and has more options.
    channels, reference, motion
        As in `frequency_responses`; a response may also be named by the body it sits on.
    level : float or str, optional
        Which level, where the test ran several, such as ``"2.6 N"``.
    direction : {'up', 'down'}, optional
        Which direction, where the test ran both.

    Raises
    ------
    SceneError
        If not exactly one sweep fits; the message lists those there are. If there are none to choose among.

    Examples
    --------
    >>> import analysis
    >>> found = analysis.frfs("recordings/demo-sweep-no-damper.mcap")
    >>> found["body3"].name, analysis.identify(found).frequency.round(2).tolist()
    ('compliance', [13.04, 34.78, 49.66])
    """
    from analysis.responses.stepped_sine import sweeps

    if motion not in MOTIONS:
        raise SceneError(f"unknown motion {motion!r}: expected {', '.join(MOTIONS)}")
    names = chosen(rec, channels)
    if rec.test.kind not in (TestKind.TONES, TestKind.NONE):
        if level is not None or direction is not None:
            raise SceneError(f"level and direction choose among sweeps of held tones; {rec.path} holds none")
        (group,) = frequency_responses(rec, names, reference, motion)
        return group
    wanted = number(level, FORCE, "level")
    found = sweeps(rec, concerned(rec, names, reference))
    fitting = [
        sweep
        for sweep in found
        if (wanted is None or abs(sweep.level - wanted) <= 1e-6 * abs(wanted))
        and (direction is None or sweep.direction == direction)
    ]
    if len(fitting) != 1:
        have = "; ".join(f"level={sweep.level:g}, direction={sweep.direction!r}" for sweep in found)
        what = "several sweeps fit" if fitting else "no sweep fits"
        raise SceneError(f"{what}: choose one of {have}, or take them all with analysis.frequency_responses")
    return stack(checked(rec, [fitting[0].lines.frf(rec, name, reference, motion) for name in names]))


@takes_path
def compliance(
    rec: Recording,
    response: str = "body3",
    reference: str = "force",
    level: float | str | None = None,
    direction: str | None = None,
) -> Response:
    """Compliance of the structure at one channel: displacement per force, X_j / F_1.

    Parameters
    ----------
    rec : daq.Recording, str or Path
        As for `frfs`.
    response : str
        Channel, or the body it sits on.
    reference : {'force', 'table'}
        ``"table"`` gives X_j / X_0 instead.
    level, direction
        As in `frfs`.
    """
    return frfs(rec, [response], reference, level=level, direction=direction)[0]
