"""Data of a fit: responses to one reference with the covariance of their errors, and the sensors that measured them."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from analysis.responses.frequency_responses import annotate, frequency_responses
from analysis.responses.measurands import reference_of, required_channels, responses
from analysis.responses.stepped_sine import sweeps
from analysis.responses.systematic import REFERENCE_NOISE, ROUGH, tolerance
from daq.recording.recorded_test import TestKind
from rig.arrays import Array, ComplexArray
from rig.errors import RecordingError
from rig.progress import CountProgress
from rig.results import format_number
from rig.results.response import Response, stack
from rig.results.uncertainty import CLOCK, SENSITIVITY, Covariance

if TYPE_CHECKING:
    from daq.recording.recording import Recording
    from rig.scene.scene import Scene


# No point is credited with a smaller error, relative to its value and to the largest of its curve.
_LEAST, _LEAST_OF_TOP = 2e-5, 1e-7
# Error of the separation of reference noise from the noise of several responses, as a share of the noise.
_SPLIT = 0.5
# Systematic errors that are free parameters of the fit, and those that are not smooth errors of single responses.
_FREE = (SENSITIVITY, CLOCK)
_NOT_SMOOTH = (*_FREE, REFERENCE_NOISE, *ROUGH)
# Fewer points than this cannot be judged.
_FEWEST = 8


@dataclass(frozen=True)
class Sensor:
    """A physical sensor: channels of several recordings have one in common if they are called alike."""

    name: str
    at: str
    seed: int
    """Seed of the recorded scene, which identifies the individual sensor."""
    tolerance: float
    """Relative tolerance of the sensitivity, from the data sheet."""


@dataclass(frozen=True)
class Curves:
    """Responses of one sweep or test over one reference.

    `rough`, `smooth`, shape (responses, n): limits of the systematic errors that differ from line to line, and of
    those that do not. Sensor tolerances are not included, because they are parameters of the fit.

    `whiten`: applied to errors, gives components of which each quadrature has variance 1, shape (n, responses,
    responses).
    """

    label: str  # recording, and setting where there are several
    scene: Scene  # scene of the recording: shaker, test and places. Its structure's values are not used
    frequency: Array  # Hz, as measured one after the other, shape (n,)
    value: ComplexArray  # displacement / reference, as read by the sensors, shape (responses, n)
    whiten: ComplexArray
    errors: Covariance  # of the random errors
    rough: Array
    smooth: Array
    common: Array  # limit of the relative error common to all responses, from noise of their reference, shape (n,)
    sensors: tuple[Sensor, ...]  # sensor of each response; `reference_sensor` is that of the reference
    reference_sensor: Sensor
    bodies: tuple[int, ...]  # bodies of the responses, from 0
    reference: str  # 'force' or 'table'
    # amplitude of the reference for tones, on which the motion of dampers depends, shape (n,)
    level: Array | None
    clock: float  # largest relative deviation of the sample clock
    frfs: tuple[Response, ...]
    warnings: tuple[str, ...]  # warnings of the estimation

    @property
    def moving(self) -> bool:
        """Whether there are dampers that can move in their cavities."""
        return any(damper.moves for damper in self.scene.dampers)


def measured(rec: Recording, name: str, progress: CountProgress | None = None) -> list[Curves]:
    """Estimate the curves of a fit: one set for each sweep or test of a recording.

    With a coil spring the reference is the displacement of the table: the responses are those of the structure with
    the spring to ground, and no small difference of two readings enters.

    Raises `RecordingError` if the recording holds no responses, or dampers in a test that is not of tones.
    """
    scene = rec.scene
    if not rec.test.drives:
        raise RecordingError(
            f"{name}: a free decay has no response to a force. Record a stepped_sine, swept_sine, multisine, random "
            "or impulse test."
        )
    names = responses(rec)
    if not names:
        raise RecordingError(
            f"{name}: no channel on a body, so that there is no response to fit. Mount a sensor on one."
        )
    spring = getattr(scene.driven_shaker, "spring", None)
    reference = "force" if spring is None or rec.test.kind is TestKind.HITS else "table"
    tones = rec.test.kind is TestKind.TONES
    if any(d.moves for d in scene.dampers) and not tones:
        raise RecordingError(
            f"{name}: {rec.test.name} with dampers that move cannot be fitted, because their response depends on the "
            "level. Record test: {kind: stepped_sine, ...} at one or several levels."
        )
    if tones:
        force_sweeps = sweeps(rec, required_channels(rec, names, reference), progress)
        several = len(force_sweeps) > 1
        return [
            _curves(
                rec,
                annotate(rec, [sweep.lines.frf(rec, response, reference) for response in names]),
                reference,
                f"{name}, {format_number(sweep.level)} N {sweep.direction}" if several else name,
            )
            for sweep in force_sweeps
        ]
    groups = frequency_responses(rec, names, reference, progress=progress)
    return [
        _curves(rec, group, reference, name if len(groups) == 1 else f"{name}, part {number}")
        for number, group in enumerate(groups, 1)
    ]


def _curves(rec: Recording, frfs: Sequence[Response], reference: str, label: str) -> Curves:
    alive = [k for k, frf in enumerate(frfs) if np.any(frf.value != 0.0)]
    dead = [frf.response for frf in frfs if not np.any(frf.value != 0.0)]
    if not alive:
        raise RecordingError(
            f"{label}: all responses read zero throughout: dead or not connected ({', '.join(dead)}). Check them."
        )
    notes = [f"{name} reads zero throughout: dead or not connected. It is left out." for name in dead]
    frfs = [frfs[k] for k in alive]
    value = np.stack([frf.value for frf in frfs])
    bound = np.linalg.norm(np.vstack([_limits(frfs, without=_NOT_SMOOTH), _limits(frfs, ROUGH)]), axis=0)
    unsteady = np.any(
        [frf.unsteady for frf in frfs if frf.unsteady is not None] or [np.zeros(bound.size, bool)], axis=0
    )
    is_valid = np.isfinite(value).all(axis=0) & np.isfinite(bound) & ~unsteady & (frfs[0].frequency > 0.0)
    if is_valid.sum() < _FEWEST:
        raise RecordingError(
            f"{label}: too few points with a value and a finite bound ({int(is_valid.sum())}). "
            f"Record at least {_FEWEST}. " + " ".join(frfs[0].warnings)
        )
    sensors = tuple(_sensor(rec, frf.response) for frf in frfs)
    errors = stack(frfs).covariance().at(is_valid)
    frfs = [frf.at(is_valid) for frf in frfs]
    too_low, common = _reference_noise(frfs, errors)
    return Curves(
        label=label,
        scene=rec.scene,
        frequency=frfs[0].frequency,
        value=value[:, is_valid] * (1.0 + too_low),
        whiten=_whitening(frfs, errors),
        errors=errors,
        rough=_limits(frfs, ROUGH),
        smooth=_limits(frfs, without=_FREE if errors.reference is None else _NOT_SMOOTH),
        common=common,
        sensors=sensors,
        reference_sensor=_sensor(rec, reference_of(rec, reference).channels[0]),
        bodies=tuple(int(sensor.at.split()[1]) - 1 for sensor in sensors),
        reference=reference,
        level=frfs[0].amplitude,
        clock=abs(rec.scene.converter.clock_error or 0.0),
        frfs=tuple(frfs),
        warnings=(*notes, *frfs[0].warnings),
    )


def _limits(frfs: Sequence[Response], names: Collection[str] | None = None, without: Collection[str] = ()) -> Array:
    """Root of the sum of squares of the systematic errors of some names, or of all but some; shape (responses, n)."""
    return np.stack(
        [
            np.linalg.norm(
                [
                    np.zeros(frf.value.size),
                    *(
                        each
                        for name, each in frf.limits.items()
                        if name in (names or frf.limits) and name not in without
                    ),
                ],
                axis=0,
            )
            for frf in frfs
        ]
    )


def _reference_noise(frfs: Sequence[Response], errors: Covariance) -> tuple[Array, Array]:
    """Relative bias of all responses by noise of the reference, and its limit of error; shape (n,)."""
    size = np.stack([np.maximum(abs(frf.value), 1e-300) for frf in frfs])
    # Noise of a response also lowers its coherence; the smallest share over the responses is that of the reference.
    bias_limit: Array = np.asarray((_limits(frfs, [REFERENCE_NOISE]) / size).min(axis=0))
    if errors.reference is None or len(frfs) < 2:
        return np.zeros(bias_limit.size), bias_limit
    share = np.minimum(errors.reference, 0.5)
    return share / (1.0 - share), _SPLIT * share


def _whitening(frfs: Sequence[Response], errors: Covariance) -> ComplexArray:
    """Inverse square root of the covariance of one quadrature, at each frequency."""
    half = errors.lines / 2.0
    variance = np.einsum("nii->ni", half).real.copy()
    size = np.stack([abs(frf.value) for frf in frfs], axis=1)
    # A single average gives no scatter to estimate the covariance from.
    half[~np.isfinite(half).all(axis=(1, 2))] = 0.0
    variance = np.where(np.isfinite(variance), variance, (0.01 * np.median(size, axis=0)) ** 2)
    variance_floor = (_LEAST * size) ** 2 + (_LEAST_OF_TOP * size.max(axis=0)) ** 2
    # A variance estimated from few degrees of freedom is uncertain: Student's t.
    inflation, rest = np.ones(variance.shape), _limits(frfs, ROUGH)
    if errors.reference is None:
        rest = _limits(frfs, without=_FREE)
        degrees = np.stack([frf.degrees for frf in frfs], axis=1)
        inflation = np.where(degrees > 4.0, degrees / np.maximum(degrees - 2.0, 1.0), 2.0)
    index = np.arange(len(frfs))
    half *= inflation[:, :1, None]
    half[:, index, index] = inflation * variance + rest.T**2 / 3.0 + variance_floor
    return inverse_root(half)


def inverse_root(covariance: ComplexArray) -> ComplexArray:
    """Inverse Cholesky factors of covariances, shape (n, responses, responses)."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))


def _sensor(rec: Recording, name: str) -> Sensor:
    info = rec.channels[name]
    return Sensor(name, info.at, rec.scene.seed, tolerance(info))
