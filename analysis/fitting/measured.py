"""What recordings tell a fit: responses over one reference, weighted by their errors, and the sensors behind them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.responses.frequency_responses import checked, frequency_responses
from analysis.responses.frf import CLOCK, SENSITIVITY, Frf
from analysis.responses.measurands import Measurand, concerned, motion_of, reference_of, responses
from analysis.responses.stepped_sine import sweeps
from analysis.responses.systematic import tolerance
from rig.errors import RecordingError
from rig.results import plainly

if TYPE_CHECKING:
    from analysis.responses.spectral_lines import Lines
    from daq.recording.recording import Recording
    from rig.scene.scene import Scene

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Progress = Callable[[int, int], None]

# No point is credited with a smaller error, relative to its value and to the largest of its curve.
_LEAST, _LEAST_OF_TOP = 2e-5, 1e-7
# Share of each response's own variance that keeps a covariance of few parts from being nearly singular.
_SHRUNK = 0.05
# Fewer points than this tell nothing that could be judged.
_FEWEST = 8


@dataclass(frozen=True)
class Sensor:
    """A physical sensor: channels of several recordings have one in common if they are called alike."""

    name: str
    at: str
    seed: int
    """Of the scene it was recorded with: which of all sensors of its kind it is."""
    tolerance: float
    """Largest relative deviation of its sensitivity that its data sheet leaves open."""


@dataclass(frozen=True)
class Curves:
    """Responses of one sweep or test over one reference.

    Attributes
    ----------
    label : str
        Recording, and setting where there are several.
    scene : Scene
        As recorded: what was on the bench, and where; its values are not those of the structure.
    frequency : ndarray, shape (n,)
        Hz, as measured one after the other.
    value : ndarray of complex, shape (responses, n)
        Displacement over the reference, as read by the sensors.
    whiten : ndarray of complex, shape (n, responses, responses)
        Applied to errors, gives components of which each quadrature has variance 1.
    systematic : ndarray, shape (responses, n)
        How far each value can be off at most, sensors' tolerances apart, however long one averages.
    sensors : tuple of Sensor
        Behind each response; `reference_sensor` behind the reference.
    bodies : tuple of int
        Where the responses are, from 0.
    reference : {'force', 'table'}
    level : ndarray, shape (n,), or None
        Amplitude of the reference, of tones: what dampers answer to.
    clock : float
        Largest relative deviation of the sample clock.
    warnings : tuple of str
        What the estimation had to say.
    """

    label: str
    scene: Scene
    frequency: Array
    value: ComplexArray
    whiten: ComplexArray
    systematic: Array
    sensors: tuple[Sensor, ...]
    reference_sensor: Sensor
    bodies: tuple[int, ...]
    reference: str
    level: Array | None
    clock: float
    frfs: tuple[Frf, ...]
    warnings: tuple[str, ...]

    @property
    def moving(self) -> bool:
        """Whether there are dampers that can move in their cavities."""
        return any(damper.moves for damper in self.scene.dampers)


def measured(rec: Recording, name: str, progress: Progress | None = None) -> list[Curves]:
    """Estimate what a fit compares: one set of curves for each sweep or test of a recording.

    Behind a coil spring responses are taken over the displacement of its table: they are those of the structure with
    the spring to ground, and no small difference of two readings comes in.

    Raises
    ------
    RecordingError
        If the recording holds no responses, or dampers in a test that is not of tones.
    """
    scene = rec.scene
    kind = scene.test.kind if scene.test is not None else ""
    if kind == "free":
        raise RecordingError(
            f"{name} holds a free decay, which no force drives: a fit needs responses to a force; "
            "record a stepped_sine, swept_sine, multisine, random or impulse test"
        )
    names = responses(rec)
    if not names:
        raise RecordingError(f"{name} has no channel on a body: there is no response to fit")
    behind_spring = kind != "impulse" and getattr(scene.driven_shaker, "spring", None) is not None
    reference = "table" if behind_spring else "force"
    tones = any(marker.kind == "measure" and "frequency" in marker.fields for marker in rec.markers)
    if any(d.moves for d in scene.dampers) and not tones:
        raise RecordingError(
            f"{name} holds a test {f'of kind {kind}' if kind else 'without tones'} with dampers that move: their "
            "response is fitted from steady tones; record test: {kind: stepped_sine, ...} at one or several levels"
        )
    if tones:
        found = sweeps(rec, concerned(rec, names, reference), progress)
        several = len(found) > 1
        return [
            _of_lines(
                rec,
                sweep.lines,
                names,
                reference,
                f"{name}, {plainly(sweep.level)} N {sweep.direction}" if several else name,
            )
            for sweep in found
        ]
    groups = frequency_responses(rec, names, reference, progress=progress)
    return [
        _of_frfs(rec, group, reference, name if len(groups) == 1 else f"{name}, part {number}")
        for number, group in enumerate(groups, 1)
    ]


def _of_lines(rec: Recording, lines: Lines, names: Sequence[str], reference: str, label: str) -> Curves:
    frfs = checked(rec, [lines.frf(rec, name, reference) for name in names])
    lower = reference_of(rec, reference)
    weights = lower.row(rec, lines.channels, lines.frequency)
    amplitude = np.sum(weights * lines.mean, axis=0)
    off = np.stack(
        [
            (motion_of(rec, name).row(rec, lines.channels, lines.frequency) - frf.value * weights) / amplitude
            for name, frf in zip(names, frfs, strict=True)
        ]
    )
    rows = np.einsum("ikn,rkn->nir", off, lines.scatter.rows)
    covariance = rows @ rows.conj().swapaxes(1, 2)
    return _curves(rec, frfs, covariance, lower, reference, label, np.abs(amplitude))


def _of_frfs(rec: Recording, frfs: Sequence[Frf], reference: str, label: str) -> Curves:
    covariance = np.zeros((frfs[0].frequency.size, len(frfs), len(frfs)), dtype=complex)
    for k, frf in enumerate(frfs):
        covariance[:, k, k] = 2.0 * frf.error**2
    return _curves(rec, frfs, covariance, reference_of(rec, reference), reference, label, None)


def _curves(
    rec: Recording,
    frfs: Sequence[Frf],
    covariance: ComplexArray,
    lower: Measurand,
    reference: str,
    label: str,
    level: Array | None,
) -> Curves:
    alive = [k for k, frf in enumerate(frfs) if np.any(frf.value != 0.0)]
    dead = [frf.response for frf in frfs if not np.any(frf.value != 0.0)]
    if not alive:
        raise RecordingError(
            f"{label}: {', '.join(dead)} read nothing at all: dead, or not connected; there is no response to fit"
        )
    notes = [f"{one} reads nothing at all: it is dead, or not connected, and left out." for one in dead]
    frfs, covariance = [frfs[k] for k in alive], covariance[:, alive][:, :, alive]
    value = np.stack([frf.value for frf in frfs])
    bound = np.sqrt(sum((_other_systematic(frf) ** 2 for frf in frfs), np.zeros(value.shape[1])))
    unsteady = np.any(
        [frf.unsteady for frf in frfs if frf.unsteady is not None] or [np.zeros(bound.size, bool)], axis=0
    )
    known = np.isfinite(value).all(axis=0) & np.isfinite(bound) & ~unsteady & (frfs[0].frequency > 0.0)
    if known.sum() < _FEWEST:
        raise RecordingError(
            f"{label}: {int(known.sum())} points with a value and a finite bound; expected at least {_FEWEST}. "
            + " ".join(frfs[0].warnings)
        )
    sensors = tuple(_sensor(rec, frf.response) for frf in frfs)
    return Curves(
        label=label,
        scene=rec.scene,
        frequency=frfs[0].frequency[known],
        value=value[:, known],
        whiten=_whitening(frfs, covariance, known),
        systematic=np.stack([_other_systematic(frf)[known] for frf in frfs]),
        sensors=sensors,
        reference_sensor=_sensor(rec, lower.channels[0]),
        bodies=tuple(int(sensor.at.split()[1]) - 1 for sensor in sensors),
        reference=reference,
        level=None if level is None else level[known],
        clock=abs(rec.scene.converter.clock_error or 0.0),
        frfs=tuple(frf.between(0.0, np.inf) for frf in frfs),
        warnings=(*notes, *frfs[0].warnings),
    )


def _other_systematic(frf: Frf) -> Array:
    """All but what is a parameter of the fit."""
    parts = [part for name, part in frf.systematic.items() if name not in (SENSITIVITY, CLOCK)]
    return np.sqrt(np.sum(np.square([np.zeros(frf.value.size), *parts]), axis=0))


def _whitening(frfs: Sequence[Frf], covariance: ComplexArray, known: NDArray[np.bool_]) -> ComplexArray:
    """Inverse square root of the covariance of one quadrature, at each frequency."""
    half = covariance[known] / 2.0
    own = np.einsum("nii->ni", half).real.copy()
    size = np.stack([abs(frf.value) for frf in frfs], axis=1)[known]
    # Where one average alone gives no scatter to tell it from.
    half[~np.isfinite(half).all(axis=(1, 2))] = 0.0
    own = np.where(np.isfinite(own), own, (0.01 * np.median(size, axis=0)) ** 2)
    # Evenly anywhere within its bounds, a part has a third of their squares as its variance.
    rest = np.stack([_other_systematic(frf) ** 2 / 3.0 for frf in frfs], axis=1)[known]
    least = (_LEAST * size) ** 2 + (_LEAST_OF_TOP * size.max(axis=0)) ** 2
    degrees = np.stack([frf.degrees for frf in frfs], axis=1)[known]
    # What is scattered by chance by few parts is known less well than by many.
    grown = np.where(degrees > 4.0, degrees / np.maximum(degrees - 2.0, 1.0), 2.0)
    index = np.arange(len(frfs))
    half *= grown[:, :1, None]
    half[:, index, index] = (1.0 + _SHRUNK) * grown * own + rest + least
    return inverse_root(half)


def inverse_root(covariance: ComplexArray) -> ComplexArray:
    """Give what whitens errors of given covariances, shape (n, responses, responses)."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))


def _sensor(rec: Recording, name: str) -> Sensor:
    info = rec.channels[name]
    return Sensor(name, info.at, rec.scene.seed, tolerance(info))
