"""Fit of a scene to recordings of the real structure, with 95 % intervals of all values."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from analysis.fitting.diagnosis import cause, list_omitted_points, mass_scale_error
from analysis.fitting.estimate import COVERAGE_FACTOR, Estimate, estimate
from analysis.fitting.identifiability import LevelDamping, coupled_values, damping_by_level
from analysis.fitting.measured import Curves, measured
from analysis.fitting.parameters import Parameter, free_parameters, with_ratio_per_mode
from analysis.fitting.problem import Group, Problem
from analysis.recordings.names import opened
from rig.arrays import Array, ComplexArray
from rig.errors import RecordingError, SceneError, suggestion
from rig.input_files import duplicate_files
from rig.results import Result, complete_style, format_number
from rig.scene.loading import SceneLike, scene_of
from rig.scene.scene import Scene
from rig.system.structural_model import structural_model

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from daq.recording.recording import Recording

Progress = Callable[[str], None]

# Largest relative half width of the 95 % interval of a value that is determined roughly.
_MAX_HALF_WIDTH = 0.5
# Clearance of a ceiling that is not reached, as a multiple of the largest gap.
_UNREACHED_RATIO = 1.2
# Largest mean square of the normalized residuals that the errors of the curves explain.
_MAX_NOISE_VARIANCE = 4.0
# Relative residual above which the scene is not a model of the measured structure.
_MAX_RESIDUAL_RATIO = 0.02
# Largest plausible deviation of a sensor, in tolerances of its data sheet.
_MAX_SENSOR_DEVIATION = 2.0
# Largest share of the points with a steady motion in the model that a fit may omit.
_MAX_OMITTED_SHARE = 0.25
# Largest share of points without a steady motion in the model. Dampers without a ceiling move irregularly over wide
# ranges, in the model as on the rig.
_MAX_IRREGULAR_SHARE = 0.5


@dataclass(frozen=True)
class Fitted:
    """Fitted value of the scene.

    `key`, `unit`: key as in `--set`, and unit; `start`, `value`: before and after the fit, in SI.

    `status`: 'determined' within a few per cent, 'roughly' within 50 %, or 'undetermined'. No value is 'determined' if
    the residuals exceed the errors of the curves.
    """

    key: str
    unit: str
    start: float
    value: float
    low: float  # 95 % interval
    high: float  # 95 % interval
    status: str

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
    used: NDArray[np.bool_]  # fitted points, shape (n,)
    normalized_residuals: Array  # residuals in standard deviations, shape (responses, n)
    relative: float


@dataclass(frozen=True, repr=False)
class Fit(Result):
    """A scene with the values that recordings determine.

    Attributes
    ----------
    scene : Scene
        Scene with the fitted values; undetermined values stay near their start.
    parameters : tuple of Fitted
        Fitted values with their 95 % intervals.
    correlation : ndarray, shape (parameters, parameters)
        Correlation of the errors of their logarithms.
    sensitivities : mapping of str to (float, float)
        Relative deviation of the sensitivity of each sensor with a tolerance, and its 95 % bound.
    modes : tuple of Mode
        Modes of the fitted structure.
    damping : tuple of LevelDamping
        Damping of the structure from each sweep alone, without the damping by the dampers.
    compared : tuple of Compared
        Measured and predicted curves of each sweep or test.
    variance : float
        Mean square of the residuals in standard deviations: at most about 1 where the stated errors explain them.
    misfit : str
        Reason why the scene does not fit the recordings, so that no value is determined; "" if it fits.
    together : tuple of str
        Combinations of values that the recordings cannot separate.
    warnings : tuple of str
        Consequences for the results, in full sentences.
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
        by_key = {value.key: value for value in self.parameters}
        if key not in by_key:
            hint = suggestion(key, by_key, f"Give one of {', '.join(by_key)}.")
            raise SceneError(f"no value {key!r} in the fit. {hint}")
        return by_key[key]

    def summary(self) -> str:
        """Return whether the scene fits, and how many values are determined."""
        statuses = [parameter.status for parameter in self.parameters]
        texts = {"roughly": "roughly determined"}
        counts = ", ".join(f"{statuses.count(kind)} {texts.get(kind, kind)}" for kind in dict.fromkeys(statuses))
        return f"{self.scene.name}: {'does not fit; ' if self.misfit else ''}{counts}"

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return each value with its initial value and 95 % interval."""
        names = ("key", "unit", "start", "value", "low", "high", "status")
        return {name: np.array([getattr(parameter, name) for parameter in self.parameters]) for name in names}

    def draw(self, ax: Axes, **style: Any) -> None:
        """Draw the largest residual over frequency, in standard deviations."""
        for compared in self.compared:
            order = np.argsort(compared.curves.frequency, kind="stable")
            worst = np.where(compared.used, compared.normalized_residuals.max(axis=0), np.nan)[order]
            ax.semilogy(
                compared.curves.frequency[order], worst, ".-", **complete_style(style, label=compared.curves.label)
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
    motions. Initial values come from the identified modes. Each free value has a prior: its value in the scene, within
    a factor of e. The prior has an effect only on values that the recordings do not determine; these are reported.

    Parameters
    ----------
    recordings : sequence of daq.Recording, str or Path
        Recordings of one structure: stepped, swept, random, multisine or impulse tests; with moving dampers only
        tones. The scene of each recording states which dampers were in place.
    scene : Scene, str, Path or mapping
        The model: structure and dampers with guessed values. Shaker, test and channels come from the recordings.
    free : sequence of str, optional
        Keys of the free values, such as ``structure.masses`` or ``dampers[1].clearance``; if omitted, masses,
        springs, damping, and all values of the dampers.
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
    >>> result = analysis.fit("recordings/demo-sweep-no-damper.mcap", guess)
    >>> result.misfit, result["structure.masses[1]"].status
    ('', 'determined')
    """
    report = progress or (lambda _: None)
    scene = scene_of(scene)
    if scene.structure.damping is None and scene.structure.matrices is None:
        raise SceneError(
            f"scene {scene.name!r}: no structure.damping. Give its form and a guess, such as damping: {{modal: 1 %}}."
        )
    model = with_ratio_per_mode(scene)
    parameters = free_parameters(model, free)
    report("reading")
    sources: Sequence[Any] = recordings if isinstance(recordings, list | tuple) else [recordings]
    for recording in sources:
        if not isinstance(recording, str | Path) and not hasattr(recording, "channels"):
            raise RecordingError(f"fit: {recording!r:.60} is not a recording. Give paths, or recordings from daq.open.")
    paths = [Path(source) if isinstance(source, str | Path) else source.path for source in sources]
    for first, again in duplicate_files(paths):
        raise SceneError(f"{again}: the same content as {first}, which would count twice. Give each recording once.")
    curves = [sweep_curves for recording in sources for sweep_curves in _curves(recording)]
    if not curves:
        raise RecordingError("fit: no recordings. Give at least one.")
    problem = Problem(model, parameters, curves)
    estimated = estimate(problem, report)
    return _result(problem, estimated, report)


def _curves(recording: Any) -> list[Curves]:
    if isinstance(recording, str | Path):
        with opened(Path(recording)) as rec:
            return measured(rec, Path(recording).name)
    return measured(recording, recording.path.name)


def _result(problem: Problem, estimated: Estimate, report: Progress) -> Fit:
    limits = _clearance_limits(problem, estimated)
    # A ceiling without impacts keeps its height, or moves just above the largest gap.
    x = estimated.x.copy()
    for k, limit in limits.items():
        clearance = problem.parameters[k]
        x[k] = clearance.unknown(max(clearance.start, _UNREACHED_RATIO * limit))
    scene = problem.scene(x)
    compared = tuple(_compare(problem, x, scene, group) for group in problem.groups)
    warnings = [f"{comparison.curves.label}: {note}" for comparison in compared for note in comparison.curves.warnings]
    misfit = _misfit(estimated, compared) or _implausible_sensors(problem, x)
    if misfit:
        report("searching the cause of the misfit")
        explains, text = cause(problem)
        misfit = text if explains else f"{misfit} {text}"
    else:
        misfit = mass_scale_error(problem, x)
    if not misfit and estimated.variance > _MAX_NOISE_VARIANCE:
        worst = max(comparison.relative for comparison in compared)
        warnings.append(
            f"The residuals reach {worst:.2%} of the curves, more than their errors explain (variance "
            f"{estimated.variance:.3g}). "
            "The intervals are widened accordingly."
        )
    for comparison, group in zip(compared, problem.groups, strict=True):
        uncovered = {} if group.tones is None else group.tones.uncovered
        warnings += list_omitted_points(comparison.curves, comparison.used, uncovered)
    count, deviation = len(problem.parameters), estimated.deviation
    unexplained = bool(misfit) or estimated.variance > _MAX_NOISE_VARIANCE
    fitted = tuple(
        _fitted(parameter, x[k], deviation[k], unexplained) for k, parameter in enumerate(problem.parameters)
    )
    if not misfit and all(value.status == "undetermined" for value in fitted):
        misfit = "The recordings determine none of the free values. `analysis frf` shows the uncertainty of the curves."
    clearances = [
        f"{problem.parameters[k].key} is at least {1e3 * limit:.3g} mm: no ceiling impact is in the motions that fit."
        for k, limit in limits.items()
        if not misfit
    ]
    return Fit(
        scene=scene,
        parameters=fitted,
        correlation=estimated.correlation[:count, :count],
        sensitivities={
            sensor.name: (problem.deviation(x, sensor), COVERAGE_FACTOR * float(deviation[count + k]))
            for k, sensor in enumerate(problem.sensors)
        },
        modes=_modes(problem, estimated),
        damping=() if misfit else damping_by_level(problem, estimated),
        compared=compared,
        variance=estimated.variance,
        misfit=misfit,
        together=(*clearances, *coupled_values(problem, estimated, [value.status for value in fitted])),
        warnings=tuple(warnings),
    )


def _clearance_limits(problem: Problem, estimated: Estimate) -> dict[int, float]:
    """Return lower limits of undetermined clearances of dampers in flight, by the number of the parameter."""
    deviation = estimated.deviation
    limits = {
        k: problem.clearance_limit(estimated.x, parameter)
        for k, parameter in enumerate(problem.parameters)
        if parameter.quantity == "clearance" and COVERAGE_FACTOR * deviation[k] > _MAX_HALF_WIDTH
    }
    return {k: limit for k, limit in limits.items() if limit > 0.0}


def _fitted(parameter: Parameter, x: float, deviation: float, unexplained: bool) -> Fitted:
    low, value, high = (parameter.value(x + step * COVERAGE_FACTOR * deviation) for step in (-1.0, 0.0, 1.0))
    half_width = COVERAGE_FACTOR * deviation * parameter.slope(value)
    status = "determined" if half_width <= parameter.limit and not unexplained else "roughly"
    if half_width > _MAX_HALF_WIDTH:
        status = "undetermined"
    return Fitted(parameter.key, parameter.unit, parameter.start, value, low, high, status)


def _compare(problem: Problem, x: Array, scene: Scene, group: Group) -> Compared:
    curves = group.curves
    predicted = problem.predicted(x, group, scene)
    residual = predicted - curves.value
    normalized = abs(np.einsum("nij,jn->in", curves.whiten, residual))
    used = group.used & np.isfinite(normalized).all(axis=0)
    # Weighted by their errors, so that lines with much noise have little influence.
    weight = abs(np.einsum("nii->in", curves.whiten))[:, used]
    square = np.sum(abs(weight * residual[:, used]) ** 2, axis=1)
    square /= np.sum(abs(weight * curves.value[:, used]) ** 2, axis=1)
    relative = float(np.sqrt(square.max())) if used.any() else np.inf
    return Compared(curves, predicted, used, normalized, relative)


def _misfit(estimated: Estimate, compared: Sequence[Compared]) -> str:
    """Describe the recording that the scene does not fit, with the residual; "" if it fits all."""
    for comparison in compared:
        regular = np.isfinite(comparison.predicted).all(axis=0)
        omitted = int((regular & ~comparison.used).sum())
        if omitted > _MAX_OMITTED_SHARE * regular.sum() or regular.mean() < 1.0 - _MAX_IRREGULAR_SHARE:
            return (
                f"{comparison.curves.label}: the scene does not reproduce the measured motion at "
                f"{int((~comparison.used).sum())} of {comparison.used.size} points."
            )
    worst = max(compared, key=lambda comparison: comparison.relative)
    if estimated.variance > _MAX_NOISE_VARIANCE and worst.relative > _MAX_RESIDUAL_RATIO:
        return (
            f"{worst.curves.label}: the best fit leaves a residual of {worst.relative:.1%} of the curves (rms), "
            f"{format_number(np.sqrt(estimated.variance))} times their stated errors."
        )
    return ""


def _implausible_sensors(problem: Problem, x: Array) -> str:
    """Name the sensors whose fitted errors far exceed the tolerances of their data sheets."""
    sensors = [
        f"{sensor.name} would need an error of {100.0 * error:.3g} %, but its data sheet allows "
        f"{100.0 * sensor.tolerance:.3g} %"
        for sensor in problem.sensors
        if abs(error := problem.deviation(x, sensor)) > _MAX_SENSOR_DEVIATION * sensor.tolerance
    ]
    return f"The curves fit only with sensors outside their tolerance: {', and '.join(sensors)}." if sensors else ""


def _modes(problem: Problem, estimated: Estimate) -> tuple[Mode, ...]:
    """Return the modes of the structure alone; bounds by first-order propagation of a square root of the covariance."""

    def modal_values(x: Array) -> Array:
        modes = structural_model(problem.scene(x)).modes
        return np.concatenate([modes.frequency, modes.damping_ratio])

    values, step = modal_values(estimated.x), 1e-6
    columns = [(modal_values(estimated.x + step * row) - values) / step for row in np.eye(problem.size)]
    jacobian = np.stack(columns, axis=1)
    bound = COVERAGE_FACTOR * np.linalg.norm(jacobian @ estimated.factor, axis=1)
    count = values.size // 2
    rows = np.transpose([values[:count], bound[:count], values[count:], bound[count:]])
    return tuple(Mode(*row) for row in rows.tolist())
