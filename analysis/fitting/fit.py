"""Fit of a scene to recordings of the real structure, with 95 % intervals of all values."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from analysis.fitting.diagnosis import cause, omitted_points, report_mass_scale
from analysis.fitting.estimate import COVERAGE_FACTOR, Estimate, estimate
from analysis.fitting.identifiability import LevelDamping, coupled_values, damping_by_level
from analysis.fitting.measured import Curves, measured
from analysis.fitting.parameters import Parameter, free_parameters, spelt_out
from analysis.fitting.problem import Problem
from analysis.recordings.names import opened
from rig.arrays import Array, ComplexArray
from rig.errors import RecordingError, SceneError
from rig.input_files import duplicate_files
from rig.results import Result, complete_style, format_number
from rig.scene.loading import SceneLike, scene_of
from rig.scene.scene import Scene
from rig.system.structural_model import structural_model

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from daq.recording.recording import Recording

Progress = Callable[[str], None]

# Largest relative half width of the 95 % interval of a value that is determined at all.
_MAX_HALF_WIDTH = 0.5
# Clearance of a ceiling that is not reached, as a multiple of the largest gap.
_CLEARANCE_MARGIN = 1.2
# Residuals with a larger variance are not noise.
_MAX_NOISE_VARIANCE = 4.0
# If the residuals also exceed this ratio to the curves, the structure differs from the scene.
_MAX_RELATIVE_RESIDUAL = 0.02
# Largest plausible deviation of a sensor, in tolerances of its data sheet.
_MAX_SENSOR_DEVIATION = 2.0
# Maximum share of omitted points among the points with a steady motion in the model.
_MAX_OMITTED_SHARE = 0.25
# Maximum share of points without a steady motion: dampers without a ceiling move irregularly over wide ranges.
_MAX_IRREGULAR_SHARE = 0.5


@dataclass(frozen=True)
class Fitted:
    """Fitted value of the scene.

    `key`, `unit`: key as in `--set`, and unit; `start`, `value`: before and after the fit, in SI.

    `status`: 'determined' (within a few per cent), 'roughly' (within 50 %) or 'undetermined'. No value is
    'determined' if the residuals exceed the errors of the curves.
    """

    key: str
    unit: str
    start: float
    value: float
    low: float  # 95 % interval
    high: float  # 95 % interval
    status: str

    @property
    def told(self) -> str:
        """Earlier name of `status`."""
        return self.status

    @property
    def half_width(self) -> float:
        """Half the 95 % interval, relative to the value."""
        return 0.5 * (self.high - self.low) / self.value


@dataclass(frozen=True)
class Mode:
    """A natural mode of the fitted structure without dampers and coil spring, with 95 % bounds."""

    frequency: float
    frequency_bound: float
    damping: float
    damping_bound: float


@dataclass(frozen=True)
class Compared:
    """Measured curves, and the prediction of the fitted scene as the sensors read it.

    `relative`: root mean square of the residuals relative to that of the curve, both weighted by their errors; the
    largest over the responses.
    """

    curves: Curves  # measured
    predicted: ComplexArray  # NaN where the model has no steady motion, shape (responses, n)
    used: NDArray[np.bool_]  # points that count, shape (n,)
    misses: Array  # residuals in standard deviations, shape (responses, n)
    relative: float


@dataclass(frozen=True, repr=False)
class Fit(Result):
    """A scene with the values that recordings determine.

    Attributes
    ----------
    scene : Scene
        Scene with the fitted values; undetermined values stay near their start.
    parameters : tuple of Fitted
    correlation : ndarray, shape (parameters, parameters)
        Correlation of the errors of their logarithms.
    sensitivities : mapping of str to (float, float)
        Relative deviation of the sensitivity of each sensor with a tolerance, and its 95 % bound.
    modes : tuple of Mode
    damping : tuple of LevelDamping
        Damping of the structure from each sweep alone, without that of the dampers, which is in their model.
    compared : tuple of Compared
    variance : float
        Mean square of the residuals in standard deviations: at most about 1 where the stated errors explain them.
    misfit : str
        Reason why the scene does not fit the recordings, so that no value is 'determined'; "" if it fits.
    together : tuple of str
        Combinations of values that the recordings cannot separate.
    warnings : tuple of str
    """

    scene: Scene
    parameters: tuple[Fitted, ...]
    correlation: Array
    sensitivities: dict[str, tuple[float, float]]
    modes: tuple[Mode, ...]
    damping: tuple[LevelDamping, ...]
    compared: tuple[Compared, ...]
    variance: float
    misfit: str
    together: tuple[str, ...]
    warnings: tuple[str, ...]

    def __getitem__(self, key: str) -> Fitted:
        """Return a value by its key."""
        found = {value.key: value for value in self.parameters}
        if key not in found:
            near = get_close_matches(key, found, n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"it has {', '.join(found)}"
            raise SceneError(f"no value {key!r} in the fit; {hint}")
        return found[key]

    def summary(self) -> str:
        """Return whether the scene fits, and how many values are determined."""
        statuses = [one.status for one in self.parameters]
        counts = ", ".join(f"{statuses.count(kind)} {kind}" for kind in dict.fromkeys(statuses))
        return f"{self.scene.name}: {'does not fit; ' if self.misfit else ''}{counts}"

    def columns(self) -> dict[str, NDArray[Any]]:
        """Each value with its start and 95 % interval."""
        names = ("key", "unit", "start", "value", "low", "high", "status")
        return {name: np.array([getattr(one, name) for one in self.parameters]) for name in names}

    def draw(self, ax: Axes, **style: Any) -> None:
        """Draw the largest residual over frequency, in standard deviations."""
        for one in self.compared:
            order = np.argsort(one.curves.frequency, kind="stable")
            worst = np.where(one.used, one.misses.max(axis=0), np.nan)[order]
            ax.semilogy(
                one.curves.frequency[order], worst, ".-", **complete_style(style, label=one.curves.label)
            )
        ax.set(xlabel="frequency / Hz", ylabel="largest residual / standard deviation")


def fit(
    recordings: Sequence[Recording | str | Path] | Recording | str | Path,
    scene: SceneLike,
    free: Sequence[str] | None = None,
    progress: Progress | None = None,
) -> Fit:
    """Fit a scene to recordings of the real structure, without and with dampers.

    The responses of each sweep to the force or the table motion are compared, weighted by their stated errors; the
    sensitivities of sensors are free within their tolerances. Where dampers move, the model computes exact periodic
    motions. Initial values come from modes. The prior of a free value is its value in the scene within a factor of
    e; this prior matters only where the recordings do not determine the value, which is then reported.

    Parameters
    ----------
    recordings : sequence of daq.Recording, str or Path
        Recordings of one structure: stepped, swept, random, multisine or impulse tests; with moving dampers only
        tones. The scene of each recording states which dampers were in place.
    scene : Scene, str, Path or mapping
        The model: structure and dampers with guessed values. Shaker, test and channels come from the recordings.
    free : sequence of str, optional
        Keys of the free values, such as ``structure.masses`` or ``dampers[1].clearance``; omitted, masses, springs,
        damping, and all of the dampers.
    progress : callable, optional
        Called with the name of each stage.

    Returns
    -------
    Fit

    Raises
    ------
    SceneError
        If the scene cannot be that of the recordings, or nothing is free.
    RecordingError
        If a recording has no response to fit.

    Examples
    --------
    >>> import analysis, rig
    >>> guess = rig.load("bare-structure", {"structure.masses": ["0.8 kg", "0.7 kg", "0.6 kg"]})
    >>> found = analysis.fit("recordings/demo-sweep-no-damper.mcap", guess)
    >>> found.misfit, found["structure.masses[1]"].status
    ('', 'determined')
    """
    report = progress or (lambda _: None)
    scene = scene_of(scene)
    if scene.structure.damping is None and scene.structure.matrices is None:
        raise SceneError(
            f"scene {scene.name!r}: no structure.damping. Give its form and a guess, such as damping: {{modal: 1 %}}."
        )
    model = spelt_out(scene)
    parameters = free_parameters(model, free)
    report("reading")
    several: Sequence[Any] = recordings if isinstance(recordings, list | tuple) else [recordings]
    for recording in several:
        if not isinstance(recording, str | Path) and not hasattr(recording, "channels"):
            raise RecordingError(
                f"fit: {recording!r:.60} is not a recording. Give paths, or recordings from daq.open."
            )
    paths = [Path(each) if isinstance(each, str | Path) else each.path for each in several]
    for first, again in duplicate_files(paths):
        raise SceneError(
            f"{again}: the same content as {first}, which would count twice. Give each recording once."
        )
    curves = [one for recording in several for one in _curves(recording)]
    if not curves:
        raise RecordingError("fit: no recordings. Give at least one.")
    problem = Problem(model, parameters, curves)
    found = estimate(problem, report)
    return _result(problem, found, report)


def _curves(recording: Any) -> list[Curves]:
    if isinstance(recording, str | Path):
        with opened(Path(recording)) as rec:
            return measured(rec, Path(recording).name)
    return measured(recording, recording.path.name)


def _result(problem: Problem, found: Estimate, report: Progress) -> Fit:
    limits = _clearance_limits(problem, found)
    # A ceiling without impacts keeps its height, or moves just above the largest gap.
    x = found.x.copy()
    for k, limit in limits.items():
        clearance = problem.parameters[k]
        x[k] = clearance.unknown(max(clearance.start, _CLEARANCE_MARGIN * limit))
    scene = problem.scene(x)
    compared = tuple(_compare(problem, x, scene, number) for number in range(len(problem.groups)))
    warnings = [f"{one.curves.label}: {note}" for one in compared for note in one.curves.warnings]
    misfit = _misfit(found, compared) or _intolerable_sensors(problem, x)
    if misfit:
        report("searching the cause of the misfit")
        explains, text = cause(problem)
        misfit = text if explains else f"{misfit} {text}"
    else:
        misfit = report_mass_scale(problem, x)
    if not misfit and found.variance > _MAX_NOISE_VARIANCE:
        worst = max(one.relative for one in compared)
        warnings.append(
            f"The residuals reach {worst:.2%} of the curves, more than their errors explain (variance "
            f"{found.variance:.3g}). "
            "The intervals are widened accordingly."
        )
    for one, group in zip(compared, problem.groups, strict=True):
        warnings += omitted_points(one.curves, one.used, {} if group.tones is None else group.tones.uncovered)
    indices = range(len(problem.parameters))
    deviation = found.deviation
    each = tuple(
        _fitted_value(one, x[k], deviation[k], bool(misfit) or found.variance > _MAX_NOISE_VARIANCE)
        for k, one in enumerate(problem.parameters)
    )
    if not misfit and all(one.status == "undetermined" for one in each):
        misfit = "The recordings determine none of the free values. `analysis frf` shows the uncertainty of the curves."
    clearances = [
        f"{problem.parameters[k].key} is at least {1e3 * limit:.3g} mm: no ceiling impact is in the motions that fit."
        for k, limit in limits.items()
        if not misfit
    ]
    return Fit(
        scene=scene,
        parameters=each,
        correlation=found.correlation[np.ix_(indices, indices)],
        sensitivities={
            sensor.name: (problem.deviation(x, sensor), COVERAGE_FACTOR * float(deviation[len(indices) + k]))
            for k, sensor in enumerate(problem.sensors)
        },
        modes=_modes(problem, found),
        damping=() if misfit else damping_by_level(problem, found),
        compared=compared,
        variance=found.variance,
        misfit=misfit,
        together=(*clearances, *coupled_values(problem, found, [one.status for one in each])),
        warnings=tuple(warnings),
    )


def _clearance_limits(problem: Problem, found: Estimate) -> dict[int, float]:
    """Lower limits of undetermined clearances of flying beds, by the number of the parameter."""
    deviation = found.deviation
    limits = {
        k: problem.clearance_limit(found.x, one)
        for k, one in enumerate(problem.parameters)
        if one.what == "clearance" and COVERAGE_FACTOR * deviation[k] > _MAX_HALF_WIDTH
    }
    return {k: limit for k, limit in limits.items() if limit > 0.0}


def _fitted_value(one: Parameter, x: float, deviation: float, missed: bool) -> Fitted:
    low, value, high = (one.value(x + step * COVERAGE_FACTOR * deviation) for step in (-1.0, 0.0, 1.0))
    half_width = COVERAGE_FACTOR * deviation * one.slope(value)
    status = "determined" if half_width <= one.limit and not missed else "roughly"
    if half_width > _MAX_HALF_WIDTH:
        status = "undetermined"
    return Fitted(one.key, one.unit, one.start, value, low, high, status)


def _compare(problem: Problem, x: Array, scene: Scene, number: int) -> Compared:
    group = problem.groups[number]
    curves = group.curves
    predicted = problem.predicted(x, group, scene)
    off = predicted - curves.value
    misses = abs(np.einsum("nij,jn->in", curves.whiten, off))
    used = group.used & np.isfinite(misses).all(axis=0)
    # By their errors, so that lines that are mostly noise do not count.
    weight = abs(np.einsum("nii->in", curves.whiten))[:, used]
    square = np.sum(abs(weight * off[:, used]) ** 2, axis=1)
    square /= np.sum(abs(weight * curves.value[:, used]) ** 2, axis=1)
    return Compared(curves, predicted, used, misses, float(np.sqrt(square.max())) if used.any() else np.inf)


def _misfit(found: Estimate, compared: Sequence[Compared]) -> str:
    """Say how far a scene is from recordings that it does not fit."""
    for one in compared:
        regular = np.isfinite(one.predicted).all(axis=0)
        omitted = int((regular & ~one.used).sum())
        if omitted > _MAX_OMITTED_SHARE * regular.sum() or regular.mean() < 1.0 - _MAX_IRREGULAR_SHARE:
            return (
                f"{one.curves.label}: the scene does not reproduce the measured motion at {int((~one.used).sum())} "
                f"of {one.used.size} points."
            )
    worst = max(compared, key=lambda one: one.relative)
    if found.variance > _MAX_NOISE_VARIANCE and worst.relative > _MAX_RELATIVE_RESIDUAL:
        return (
            f"{worst.curves.label}: the best fit leaves a residual of {worst.relative:.1%} of the curves (rms), "
            f"{format_number(np.sqrt(found.variance))} times their stated errors."
        )
    return ""


def _intolerable_sensors(problem: Problem, x: Array) -> str:
    """Name the sensors whose fitted errors exceed by far what their data sheets allow."""
    sensors = [
        f"{sensor.name} would need an error of {100.0 * error:.3g} %, but its data sheet allows "
        f"{100.0 * sensor.tolerance:.3g} %"
        for sensor in problem.sensors
        if abs(error := problem.deviation(x, sensor)) > _MAX_SENSOR_DEVIATION * sensor.tolerance
    ]
    return (
        f"The curves fit only with sensors outside their tolerance: {', and '.join(sensors)}."
        if sensors
        else ""
    )


def _modes(problem: Problem, found: Estimate) -> tuple[Mode, ...]:
    """Modes of the structure alone; bounds by first-order propagation of the covariance's factor."""

    def at(x: Array) -> Array:
        modes = structural_model(problem.scene(x)).modes
        return np.concatenate([modes.frequency, modes.damping_ratio])

    here, step = at(found.x), 1e-6
    columns = [(at(found.x + step * row) - here) / step for row in np.eye(problem.size)]
    jacobian = np.stack(columns, axis=1)
    bound = COVERAGE_FACTOR * np.linalg.norm(jacobian @ found.factor, axis=1)
    count = here.size // 2
    rows = np.transpose([here[:count], bound[:count], here[count:], bound[count:]])
    return tuple(Mode(*row) for row in rows.tolist())
