"""The estimator of the frequency responses of each kind of recording.

A module of this package that evaluates a kind of recording defines an `Estimator` with the name `ESTIMATOR`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Protocol

import numpy as np

from analysis.core.responses.checks.channel_changes import Parts
from analysis.core.responses.checks.curve_checks import reversed_force
from analysis.core.responses.checks.delays import delayed_channels
from analysis.core.responses.checks.several_inputs import check_matrix
from analysis.core.responses.checks.tone_steps import ToneInterval
from analysis.core.responses.estimators import ESTIMATORS
from analysis.core.responses.measurands import (
    Measurand,
    force_of,
    input_location,
    motion_of,
    output_point,
    reference_of,
)
from daq.core.recording.markers import Marker
from daq.core.recording.recording import Recording
from rig.core.base.errors import RecordingError, SceneError
from rig.core.base.progress import CountProgress
from rig.core.results.response import Point, Response, stack
from rig.core.system.open_loop_drive import linear_limits

#: Module of the estimator of each kind of recording (`TestKind`).
MODULES = {
    "tones": "stepped_sine",
    "none": "stepped_sine",
    "free": "stepped_sine",
    "sweep": "swept_sine",
    "random": "random",
    "multisine": "multisine",
    "hits": "impact",
    "shock": "shock",
}


@dataclass(frozen=True)
class Blocks:
    """User options for block averaging; None selects the default of the kind of test."""

    estimator: str | None = None  # H1, H2 or Hv
    block: float | None = None  # length of a block [s]
    overlap: float | None = None  # share of a block
    window: str | None = None  # name in `scipy.signal.get_window`

    def __post_init__(self) -> None:
        if self.estimator not in (None, *ESTIMATORS):
            raise SceneError(f"estimator: got {self.estimator!r}; expected {', '.join(ESTIMATORS)}")

    def for_kind(self, kind: str) -> Blocks:
        """Return the options without those that have no effect on a kind of recording."""
        return Blocks(**{name: getattr(self, name) for name in estimator_of(kind).options})

    def title(self, kind: str) -> str:
        """Describe how responses are estimated from a kind of recording, in few words.

        >>> Blocks(block=2.0).title("random"), Blocks().title("hits")
        ('H1 of blocks of 2 s, window hann', 'local rational method')
        """
        own, own_estimator = self.for_kind(kind), estimator_of(kind)
        if own == Blocks():
            return own_estimator.title
        length = "" if own.block is None else f" of {own.block:g} s"
        overlap = "" if own.overlap is None else f", overlap {own.overlap:g}"
        return f"{own.estimator or 'H1'} of blocks{length}{overlap}, window {own.window or own_estimator.window}"


class Source(Protocol):
    """Spectra or amplitudes from which responses are estimated: those of a sweep, or of a test without sweeps."""

    def frf(
        self, rec: Recording, numerator: Measurand, denominator: Measurand, others: Sequence[Measurand] = ()
    ) -> Response:
        """Estimate the response of one measurand to another; `others`: the other inputs, if there are several."""


@dataclass(frozen=True)
class Request:
    """Requested responses of a recording."""

    rec: Recording
    names: Sequence[str]  # response channels
    reference: str  # force or table
    motion: str  # quantity of the responses
    blocks: Blocks
    progress: CountProgress | None
    channels: Sequence[str]  # channels of the responses and of their reference
    measured: Sequence[Marker]  # markers of the measured intervals
    inputs: tuple[Point, ...] = ()  # the forces, if several drive the structure
    level: float | None = None  # selected level, if the recording has several; None: every level
    direction: str | None = None  # selected direction, up or down; None: both

    def compute(self, sources: Iterable[Source]) -> list[Response]:
        """Compute the response of each source: the matrix of all outputs over all inputs."""
        references = [force_of(point.name) for point in self.inputs] or [reference_of(self.rec, self.reference)]
        computed = []
        for source in sources:
            columns: list[list[Response]] = [[] for _ in references]
            for n_completed, name in enumerate(self.names, 1):
                output = motion_of(self.rec, name, self.motion)
                for k, (column, reference) in enumerate(zip(columns, references, strict=True)):
                    curve = source.frf(self.rec, output, reference, [*references[:k], *references[k + 1 :]])
                    column.append(replace(curve, inputs=self.inputs[k : k + 1]) if self.inputs else curve)
                if self.progress is not None:
                    self.progress(n_completed, len(self.names))
            columns = [annotate(self.rec, column) for column in columns]
            response = stack([curve for row in zip(*columns, strict=True) for curve in row], len(references))
            computed.append(check_matrix(response) if self.inputs else _with_loading(self.rec, response))
        return computed


@dataclass(frozen=True)
class Estimator:
    """Estimator of the responses of one kind of recording."""

    compute: Callable[[Request], list[Response]]  # returns the response of each sweep, or of the test
    method: str  # description of the estimator, for messages
    title: str  # short description of the estimator, for figures
    options: frozenset[str] = frozenset()  # fields of `Blocks` that have an effect
    window: str = "none"  # default window of blocks
    jumps: bool = False  # whether the motion may change to another branch at one frequency
    # Whether the lines are values of local models of a much finer spectrum; fewer lines then resolve a peak.
    resolves_between_lines: bool = False
    # Returns the parts with equal excitation between which gains and delays of a channel are compared.
    parts: Callable[[Request], list[Parts]] = lambda request: []
    # Returns the intervals of single tones, whose samples are searched for changes of the gain or the delay.
    tones: Callable[[Request], list[ToneInterval]] = lambda request: []
    # Returns the remedy for too few lines to interpolate a peak; argument: required spacing [Hz], infinite if unknown.
    peak_remedy: Callable[[float], str] = lambda needed: "Measure for longer"
    # Remedy for too few lines in a resonance; `step` is the required spacing of the lines [Hz].
    line_remedy: Callable[[float], str] = lambda step: f"Measure every {step:.2g} Hz there."


def estimator_of(kind: str) -> Estimator:
    """Return the estimator of a kind of recording.

    For curves without a recording, `kind` is empty.
    """
    module = MODULES.get(kind or "none")
    if module is None:
        raise RecordingError(f"a recording of kind {kind} has no frequency responses. Use another analysis.")
    estimator: Estimator = import_module(f"analysis.core.responses.{module}").ESTIMATOR
    return estimator


def annotate(rec: Recording, curves: Sequence[Response]) -> list[Response]:
    """Add locations to the curves of one sweep, and warnings of a force with the wrong sign and of a late channel."""
    points = [output_point(rec, curve.response, curve.motion) for curve in curves]
    curves = [
        curve.placed(point.place, curve.input_at or input_location(rec, curve.reference), point.body)
        for curve, point in zip(curves, points, strict=True)
    ]
    warnings = [text for text in (reversed_force(curves), delayed_channels(*_by_channel(rec, curves))) if text]
    return [curve.warn(*warnings) for curve in curves]


def _with_loading(rec: Recording, response: Response) -> Response:
    """Add the loading of the dampers by steady tones, from the body that moves most and the shape of linear motion."""
    outputs = [k for k, point in enumerate(response.outputs) if point.body]
    if response.amplitude is None or not outputs or rec.scene.is_linear or rec.scene.driven_shaker is None:
        return response
    limits = linear_limits(rec.scene, response.frequency)[[response.outputs[k].body - 1 for k in outputs]]
    motion = response.amplitude * abs(response.to("displacement").value[:, outputs, 0]).T
    best = limits.argmax(axis=0), np.arange(response.frequency.size)
    return replace(response, loading=motion[best] / limits[best])


def _by_channel(rec: Recording, curves: Sequence[Response]) -> tuple[list[Response], str]:
    """Return responses to the motion or force of one channel, and its name.

    The force of a coil spring k0 is computed from two channels. With the compliance H of the driven body, the response
    to this force divided by H + 1/k0 is the response to the motion of the table.
    """
    reference, source = curves[0].reference, curves[0].inputs[0].name
    channels = reference_of(rec, reference).channels if source == reference else (source,)
    if len(channels) == 1:
        # A single force has no name of its own.
        return list(curves), f"the {source}" if source == reference else source
    stiffness = reference_of(rec, reference).weights[0]
    driven = [curve.to("displacement") for curve in curves if curve.response == channels[1]]
    return [
        curve.to("displacement").scaled(1.0 / (driven[0].value + 1.0 / stiffness)) for curve in curves if driven
    ], channels[0]
