"""Measured data of a fit: responses to one reference, the covariance of their errors, and their sensors.

Each response is divided by the *reference*: the force or, with a coil spring, the displacement of the table.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from analysis.core.recordings.names import sweep_name
from analysis.core.responses.errors.systematic import IRREGULAR, REFERENCE_NOISE, tolerance
from analysis.core.responses.frequency_responses import frequency_responses
from analysis.core.responses.measurands import (
    default_reference,
    driven_forces,
    reference_of,
    response_channels,
)
from daq.core.recording.recording import Recording
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import RecordingError
from rig.core.results.response import Response, stack
from rig.core.results.uncertainty import CLOCK, SENSITIVITY, Covariance, standard_of_limit
from rig.core.scene.scene import Scene

# Lower limit of the standard uncertainty of a point, relative to its value: a few quiet points must not decide the fit.
_MIN_RELATIVE_UNCERTAINTY = 2e-5
# Smallest standard uncertainty of a point, relative to its curve's peak: zeros of the response must not decide.
_MIN_UNCERTAINTY_RELATIVE_TO_PEAK = 1e-7
# The noise power of the reference has this relative uncertainty if it is estimated from several responses.
_REFERENCE_NOISE_UNCERTAINTY = 0.5
# Systematic errors that are unknowns of the fit.
_FITTED_ERRORS = (SENSITIVITY, CLOCK)
# Systematic errors that `Curves.correlated_limit` does not include.
_EXCLUDED_FROM_CORRELATED = (*_FITTED_ERRORS, REFERENCE_NOISE, *IRREGULAR)
# Minimum number of points of a fit, with two real values each: a single mode has four unknowns.
_MIN_POINTS = 8


@dataclass(frozen=True)
class Sensor:
    """A physical sensor; equal sensors in several recordings have the same sensitivity error."""

    name: str  # name of the channel
    at: str  # location in the scene, such as 'body 2'
    seed: int  # seed of the recorded scene, which identifies the individual sensor
    tolerance: float  # relative tolerance of the sensitivity, from the data sheet


@dataclass(frozen=True)
class Curves:
    """Responses of one sweep or test over one reference, at n frequencies.

    Limits of systematic errors: `line_limit` is the limit of errors that vary irregularly from line to line.
    `correlated_limit` is the limit of all other errors, except reference noise (see `reference_noise_limit`) and the
    tolerances of sensors and clock, which are unknowns of the fit. If the reference noise is not estimated
    (`errors.reference` is None), `correlated_limit` includes the reference noise and the errors of `line_limit`.
    """

    label: str  # recording, and its level or part if there are several
    scene: Scene  # scene of the recording: the fit uses its shaker, test and dampers, and estimates its structure
    frequency: Array  # Hz, in the order of measurement, shape (n,)
    value: ComplexArray  # displacement / reference, as read by the sensors, shape (responses, n)
    # matrices that convert errors to uncorrelated real and imaginary parts of variance 1, (n, responses, responses)
    whitening: ComplexArray
    errors: Covariance  # covariance of the random errors
    line_limit: Array  # shape (responses, n)
    correlated_limit: Array  # shape (responses, n)
    reference_noise_limit: Array  # limit of the relative error of all responses due to reference noise, shape (n,)
    sensors: tuple[Sensor, ...]  # sensor of each response
    reference_sensor: Sensor
    bodies: tuple[int, ...]  # body of each response, counted from 0
    reference: str  # 'force' or 'table'
    level: Array | None  # amplitude of the reference for steady tones, N or m, shape (n,)
    clock_tolerance: float  # largest relative deviation of the sample clock
    frfs: tuple[Response, ...]  # responses as measured
    correction: ComplexArray  # factors that correct a supposed mistake, (responses, n)
    warnings: tuple[str, ...]  # warnings of the estimation

    @property
    def is_linear(self) -> bool:
        """Whether the structure is linear: no dampers that can move in their cavities, and no joints."""
        return self.scene.is_linear


def measured_curves(rec: Recording, name: str) -> list[Curves]:
    """Estimate the curves of a fit: one set for each sweep or test of a recording.

    With a coil spring the reference is the displacement of the table: the responses describe the structure with the
    spring to ground. The spring force is not used, because it is a small difference of two readings. If a table carries
    the structure, the displacement of the table is also the reference.

    Raises `RecordingError` if the recording contains no responses, or moving dampers without steady tones.
    """
    scene = rec.scene
    if not rec.test.drives:
        raise RecordingError(
            f"{name}: a free decay has no response to a force. Record a stepped_sine, swept_sine, multisine, random "
            "or impulse test."
        )
    if len(driven_forces(rec)) > 1:
        raise RecordingError(
            f"{name}: several shakers were driven at once, but a fit needs responses to one force. Record one "
            "shaker at a time, and fit the recordings together."
        )
    names = response_channels(rec)
    if not names:
        raise RecordingError(f"{name}: no channel on a body, so there is no response to fit. Mount a sensor on a body.")
    spring = None if scene.driven_shaker is None else scene.driven_shaker.coil_spring
    has_table = spring is not None or default_reference(rec) == "table"
    reference = "table" if has_table and not rec.test.kind.hammered else "force"
    has_tones = rec.test.kind.steady
    if not scene.is_linear and not has_tones:
        parts = "joints" if scene.joints else "dampers that move"
        raise RecordingError(
            f"{name}: {rec.test.name} with {parts} cannot be fitted, because their response depends on the "
            "level. Record test: {kind: stepped_sine, ...} at one or several levels."
        )
    groups = frequency_responses(rec, names, reference)
    return [
        _curves(rec, group, reference, f"{name}, {sweep_name(group.label, rec.scene.name)}".removesuffix(", "))
        for group in groups
    ]


def _curves(rec: Recording, frfs: Sequence[Response], reference: str, label: str) -> Curves:
    """Return the curves of one sweep or test, without failed channels and without points that cannot be fitted."""
    zero_responses = [frf.response for frf in frfs if not np.any(frf.value != 0.0)]
    if len(zero_responses) == len(frfs):
        raise RecordingError(
            f"{label}: all responses are zero throughout ({', '.join(zero_responses)}): their sensors may be "
            "disconnected or have failed. Check the sensors and cables."
        )
    notes = [f"{name} is omitted: it reads zero throughout (disconnected or failed)." for name in zero_responses]
    frfs = [frf for frf in frfs if frf.response not in zero_responses]
    value = np.stack([frf.value for frf in frfs])
    limits = np.vstack([_limits(frfs, without=_EXCLUDED_FROM_CORRELATED), _limits(frfs, IRREGULAR)])
    is_limited = np.isfinite(limits).all(axis=0)
    is_unsteady = np.any(
        [frf.unsteady for frf in frfs if frf.unsteady is not None] or [np.zeros(is_limited.size, bool)], axis=0
    )
    is_valid = np.isfinite(value).all(axis=0) & is_limited & ~is_unsteady & (frfs[0].frequency > 0.0)
    if is_valid.sum() < _MIN_POINTS:
        raise RecordingError(
            f"{label}: only {int(is_valid.sum())} points have a value and a finite uncertainty; expected {_MIN_POINTS} "
            "or more. " + (" ".join(frfs[0].warnings) or "Record again at more frequencies.")
        )
    sensors = tuple(_sensor(rec, frf.response) for frf in frfs)
    errors = stack(frfs).covariance().at(is_valid)
    frfs = [frf.at(is_valid) for frf in frfs]
    relative_bias, reference_noise_limit = _reference_noise(frfs, errors)
    return Curves(
        label=label,
        scene=rec.scene,
        frequency=frfs[0].frequency,
        value=value[:, is_valid] * (1.0 + relative_bias),
        whitening=_whitening(frfs, errors),
        errors=errors,
        line_limit=_limits(frfs, IRREGULAR),
        correlated_limit=_limits(
            frfs, without=_FITTED_ERRORS if errors.reference is None else _EXCLUDED_FROM_CORRELATED
        ),
        reference_noise_limit=reference_noise_limit,
        sensors=sensors,
        reference_sensor=_sensor(rec, reference_of(rec, reference).channels[0]),
        bodies=tuple(rec.channels[sensor.name].body - 1 for sensor in sensors),
        reference=reference,
        level=frfs[0].amplitude,
        clock_tolerance=abs(rec.scene.converter.clock_error or 0.0),
        frfs=tuple(frfs),
        correction=np.ones((len(frfs), frfs[0].frequency.size), dtype=complex),
        warnings=(*notes, *frfs[0].warnings),
    )


def _limits(frfs: Sequence[Response], names: Collection[str] | None = None, without: Collection[str] = ()) -> Array:
    """Return the root sum of squares of the limits `names` (all if omitted) except `without`; shape (responses, n)."""
    totals = []
    for frf in frfs:
        selected = names or frf.limits
        included = [limit for name, limit in frf.limits.items() if name in selected and name not in without]
        totals.append(np.linalg.norm([np.zeros(frf.value.size), *included], axis=0))
    return np.stack(totals)


def _reference_noise(frfs: Sequence[Response], errors: Covariance) -> tuple[Array, Array]:
    """Return the relative bias due to reference noise and the bound of its error, each of shape (lines,)."""
    magnitude = np.stack([np.maximum(abs(frf.value), 1e-300) for frf in frfs])
    # The coherence of a response is lowered by noise of the response, too, and gives only an upper bound of the
    # reference noise. The smallest bound is therefore the best estimate.
    bias_limit: Array = np.asarray((_limits(frfs, [REFERENCE_NOISE]) / magnitude).min(axis=0))
    if errors.reference is None or len(frfs) < 2:
        return np.zeros(bias_limit.size), bias_limit
    noise_ratio = np.minimum(errors.reference, 0.5)
    return noise_ratio / (1.0 - noise_ratio), _REFERENCE_NOISE_UNCERTAINTY * noise_ratio


def _whitening(frfs: Sequence[Response], errors: Covariance) -> ComplexArray:
    """Return the inverse square root of the covariance of the real or the imaginary part, as in `Curves.whitening`."""
    quadrature_covariance = errors.lines / 2.0
    variance = np.einsum("nii->ni", quadrature_covariance).real.copy()
    magnitude = np.stack([abs(frf.value) for frf in frfs], axis=1)
    # A single average determines no variance; a standard deviation of 1 % of the median magnitude is assumed.
    quadrature_covariance[~np.isfinite(quadrature_covariance).all(axis=(1, 2))] = 0.0
    variance = np.where(np.isfinite(variance), variance, (0.01 * np.median(magnitude, axis=0)) ** 2)
    variance_floor = (_MIN_RELATIVE_UNCERTAINTY * magnitude) ** 2 + (
        _MIN_UNCERTAINTY_RELATIVE_TO_PEAK * magnitude.max(axis=0)
    ) ** 2
    # A variance from few degrees of freedom is multiplied by the variance of Student's t distribution, at most by 2.
    inflation, systematic = np.ones(variance.shape), _limits(frfs, IRREGULAR)
    if errors.reference is None:
        systematic = _limits(frfs, without=_FITTED_ERRORS)
        freedom = np.stack([frf.degrees_of_freedom for frf in frfs], axis=1)
        inflation = np.where(freedom > 4.0, freedom / np.maximum(freedom - 2.0, 1.0), 2.0)
    index = np.arange(len(frfs))
    quadrature_covariance *= inflation[:, :1, None]
    quadrature_covariance[:, index, index] = (
        inflation * variance + standard_of_limit(systematic.T) ** 2 + variance_floor
    )
    return inverse_root(quadrature_covariance)


def inverse_root(covariance: ComplexArray) -> ComplexArray:
    """Return the inverse Cholesky factors of covariances, shape (n, responses, responses)."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))


def _sensor(rec: Recording, name: str) -> Sensor:
    info = rec.channels[name]
    return Sensor(name, info.at, rec.scene.seed, tolerance(rec, name))
