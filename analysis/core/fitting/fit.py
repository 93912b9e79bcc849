"""Fit of a scene to recordings of the real structure, with a 95 % interval of each fitted value."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.core.fitting.diagnosis import find_cause, list_omitted_points, mass_scale_error
from analysis.core.fitting.estimate import Estimate, Report, estimate
from analysis.core.fitting.identifiability import LevelDamping, damping_by_level, describe_coupled_values
from analysis.core.fitting.measured import Curves, measured_curves
from analysis.core.fitting.parameters import Parameter, free_parameters, with_ratio_per_mode
from analysis.core.fitting.problem import Group, Problem
from analysis.core.recordings.opening import as_context, require_recording
from daq.core.recording.recording import Recording
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import RecordingError, SceneError, suggestion
from rig.core.base.figure_types import Axes
from rig.core.base.input_files import duplicate_files
from rig.core.base.renamed import renamed
from rig.core.numerics.blas_threads import with_one_blas_thread
from rig.core.results import Result, complete_style, format_interval, format_number, format_percent
from rig.core.results.table import Table
from rig.core.scene.loading import SceneLike, scene_of
from rig.core.scene.scene import Scene
from rig.core.system.structural_model import structural_model

# Printed descriptions of statuses (`Fitted.status`); other statuses are printed as they are.
STATUS_TEXTS = {"roughly": "roughly determined"}
# Usual relative tolerance of the quartz of a sample clock.
_USUAL_CLOCK_TOLERANCE = 20e-6
# A value is roughly determined if its relative expanded uncertainty is below this value.
_MAX_RELATIVE_EXPANDED = 0.5
# Smallest clearance of a damper that does not reach its ceiling, relative to its largest gap to the floor.
_UNREACHED_RATIO = 1.2
# Largest mean square of normalized residuals that is consistent with the uncertainties of the curves.
_MAX_NOISE_VARIANCE = 4.0
# The scene does not describe the measured structure if the relative residual exceeds this value.
_MAX_RESIDUAL_RATIO = 0.02
# A fit may omit at most this fraction of the points at which the model has a steady-state motion.
_MAX_OMITTED_SHARE = 0.25
# At most this fraction of the points may have no steady-state motion in the model. Dampers without a ceiling move
# irregularly over wide ranges of frequency, in the model as on the rig.
_MAX_IRREGULAR_SHARE = 0.5


@dataclass(frozen=True)
class Fitted:
    """Fitted value of the scene.

    `status`: 'determined' within a few per cent, 'roughly' within 50 %, or 'undetermined'. No value is 'determined' if
    the residuals exceed the uncertainties of the curves.
    """

    key: str  # as in `--set`
    unit: str  # SI; "" for a ratio
    start: float  # before the fit
    value: float  # after the fit
    low: float  # lower end of the 95 % interval
    high: float  # upper end of the 95 % interval
    status: str

    @property
    def half_width(self) -> float:
        """Half the 95 % interval, relative to the value."""
        return 0.5 * (self.high - self.low) / self.value


@dataclass(frozen=True)
class Mode:
    """A natural mode of the fitted structure without dampers and coil spring, with expanded uncertainties."""

    frequency: float  # undamped natural frequency [Hz]
    frequency_expanded: float  # Hz
    damping: float  # ratio
    damping_expanded: float

    frequency_bound = renamed("frequency_bound", "frequency_expanded")
    damping_bound = renamed("damping_bound", "damping_expanded")


@dataclass(frozen=True)
class Comparison:
    """Measured curves of one sweep or test, compared with the prediction of the fitted scene."""

    curves: Curves  # measured
    # Predicted readings of the response, shape (responses, n); NaN where the model has no steady-state motion.
    predicted: ComplexArray
    is_fitted: NDArray[np.bool_]  # fitted points, shape (n,)
    normalized_residuals: Array  # residuals over their standard deviations, shape (responses, n)
    # rms residual / rms of the curve, both weighted by the inverse standard uncertainty; the largest over the responses
    relative: float


@dataclass(frozen=True, repr=False)
class Fit(Result):
    """A scene with the values that recordings determine.

    Attributes
    ----------
    scene : Scene
        Scene with the fitted values; undetermined values stay near their initial values.
    parameters : tuple of Fitted
        Fitted values with their 95 % intervals.
    correlation : ndarray, shape (parameters, parameters)
        Correlation matrix of the fitted unknowns: logarithms of the values, log odds of ratios below 1.
    sensitivities : mapping of str to (float, float)
        Relative deviation of the sensitivity of each sensor with a tolerance, and its expanded uncertainty.
    modes : tuple of Mode
        Modes of the fitted structure.
    damping : tuple of LevelDamping
        Damping of the structure from each sweep alone, without the dissipation of the dampers.
    compared : tuple of Comparison
        Measured and predicted curves of each sweep or test.
    variance : float
        Mean square of the normalized residuals: at most about 1 if they are consistent with the stated uncertainties.
    misfit : str
        Reason why the scene does not fit the recordings and no value is determined; "" if it fits.
    together : tuple of str
        Sentences on clearances that are not reached, and on values that the recordings determine only in combination.
    warnings : tuple of str
        Sentences on limits of the results.
    """

    scene: Scene
    parameters: tuple[Fitted, ...]
    correlation: Array
    sensitivities: dict[str, tuple[float, float]]
    modes: tuple[Mode, ...]
    damping: tuple[LevelDamping, ...]
    compared: tuple[Comparison, ...]
    variance: float
    misfit: str
    together: tuple[str, ...]
    warnings: tuple[str, ...]

    def __getitem__(self, key: str) -> Fitted:
        """Return a value by its key, such as ``structure.masses.board`` or ``structure.masses[1]``."""
        by_key = {value.key: value for value in self.parameters}
        # The mass of a named body is also found by the number of the body.
        names = enumerate(self.scene.structure.names or (), 1)
        numbered = {f"structure.masses[{number}]": f"structure.masses.{name}" for number, name in names}
        by_key |= {number: by_key[name] for number, name in numbered.items() if name in by_key}
        if key not in by_key:
            items = [known for known in by_key if "[" in key and known.startswith(key.partition("[")[0] + "[")]
            listed = f"Give one of {', '.join(items or by_key)}."
            raise SceneError(f"no value {key!r} in the fit. {listed if items else suggestion(key, by_key, listed)}")
        return by_key[key]

    def summary(self) -> str:
        """Return one line: whether the scene fits, and how many values are determined."""
        statuses = [parameter.status for parameter in self.parameters]
        counts = ", ".join(
            f"{statuses.count(status)} {STATUS_TEXTS.get(status, status)}" for status in dict.fromkeys(statuses)
        )
        return f"{self.scene.name}: {'does not fit; ' if self.misfit else ''}{counts}"

    def table(self) -> Table:
        """Return the fitted values with their 95 % intervals."""
        rows = []
        for each in self.parameters:
            value = f"{each.value:.6g}"
            if each.status != "undetermined":
                value = format_interval(each.value, each.half_width * abs(each.value))
            status = STATUS_TEXTS.get(each.status, each.status)
            rows.append((each.key, value, each.unit, format_number(each.start), status))
        return Table(("value", "fitted", "unit", "initial", "status"), "<><><", rows)

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return each value with its initial value and 95 % interval."""
        names = ("key", "unit", "start", "value", "low", "high", "status")
        return {name: np.array([getattr(parameter, name) for parameter in self.parameters]) for name in names}

    def draw(self, ax: Axes, **style: Any) -> None:
        """Draw the largest normalized residual against frequency."""
        for compared in self.compared:
            order = np.argsort(compared.curves.frequency, kind="stable")
            largest = np.where(compared.is_fitted, compared.normalized_residuals.max(axis=0), np.nan)[order]
            line_style = complete_style(style, label=compared.curves.label)
            ax.semilogy(compared.curves.frequency[order], largest, ".-", **line_style)
        ax.set(xlabel="frequency / Hz", ylabel="largest residual / standard uncertainty")


@with_one_blas_thread
def fit(
    recordings: Sequence[Recording | str | Path] | Recording | str | Path,
    scene: SceneLike,
    free: Sequence[str] | None = None,
    progress: Report | None = None,
) -> Fit:
    """Fit a scene to recordings of the real structure, without and with dampers.

    The responses of each sweep to the force or the table motion are compared, weighted by their stated standard
    uncertainties; the sensitivities of sensors are free within their tolerances. Where dampers move, the model computes
    exact periodic motions. Initial values come from the identified modes. Each free value has a log-normal prior,
    centered on its value in the scene, with a standard deviation of 1 in ln(value). The prior affects only undetermined
    values, which are reported.

    Parameters
    ----------
    recordings : sequence of daq.Recording, str or Path
        Recordings of one structure: stepped, swept, random, multisine or impact tests; with moving dampers only
        stepped-sine tests. The scene of each recording specifies which dampers were in place.
    scene : Scene, str, Path or mapping
        The model: structure and dampers with guessed values. Shaker, test and channels come from the recordings.
    free : sequence of str, optional
        Values to fit, such as ``structure.masses`` or ``dampers[1].clearance``. Default: masses, springs, damping and
        all values of the dampers.
    progress : callable, optional
        Function that is called with the name of each stage.

    Returns
    -------
    Fit
        Values with their intervals, correlations and misfit.

    Raises
    ------
    SceneError
        If the scene has other bodies or dampers than the recordings, or no value is free.
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
    report("reading the recordings")
    sources: Sequence[Any] = recordings if isinstance(recordings, list | tuple) else [recordings]
    for recording in sources:
        require_recording(recording, "fit")
    paths = [Path(source) if isinstance(source, str | Path) else source.path for source in sources]
    for first, duplicate in duplicate_files(paths):
        raise SceneError(f"{duplicate}: the same content as {first}. Give each recording once.")
    curves: list[Curves] = []
    for recording, path in zip(sources, paths, strict=True):
        with as_context(recording) as rec:
            curves += measured_curves(rec, path.name)
    if not curves:
        raise RecordingError("fit: no recordings. Give at least one.")
    problem = Problem(model, parameters, curves)
    estimated = estimate(problem, report)
    return _result(problem, estimated, report)


def _result(problem: Problem, estimated: Estimate, report: Report) -> Fit:
    largest_gaps = _largest_gaps(problem, estimated)
    # Without ceiling impacts, a clearance keeps its initial value unless the largest gap exceeds it.
    x = estimated.x.copy()
    for k, gap in largest_gaps.items():
        clearance = problem.parameters[k]
        x[k] = clearance.unknown(max(clearance.start, _UNREACHED_RATIO * gap))
    scene = problem.scene(x)
    compared = tuple(_compare(problem, x, scene, group) for group in problem.groups)
    warnings = [f"{comparison.curves.label}: {note}" for comparison in compared for note in comparison.curves.warnings]
    misfit = _misfit(estimated, compared) or _implausible_sensors(problem, x)
    if misfit:
        report("searching for the cause of the misfit")
        is_explained, text = find_cause(problem, x)
        misfit = text if is_explained else f"{misfit} {text}"
    else:
        misfit = mass_scale_error(problem, x)
    if not misfit and estimated.variance > _MAX_NOISE_VARIANCE:
        largest = max(comparison.relative for comparison in compared)
        warnings.append(
            f"The residuals reach {format_percent(largest)} of the curves, more than the uncertainties of the curves "
            f"explain (reduced chi-square {estimated.variance:.3g}). The 95 % intervals are widened accordingly."
        )
    for comparison, group in zip(compared, problem.groups, strict=True):
        uncovered = {} if group.orbits is None else group.orbits.uncovered
        warnings += list_omitted_points(comparison.curves, comparison.is_fitted, uncovered)
    count, expanded = len(problem.parameters), estimated.expanded()
    modes = _modes(problem, estimated)
    is_unexplained = bool(misfit) or estimated.variance > _MAX_NOISE_VARIANCE
    fitted = tuple(
        _fitted_value(parameter, x[k], expanded[k], is_unexplained) for k, parameter in enumerate(problem.parameters)
    )
    if not misfit and all(value.status == "undetermined" for value in fitted):
        misfit = (
            "The recordings determine none of the free values. Reduce the uncertainty of the curves, which `analysis "
            "frf` shows with its largest contribution, and record again."
        )
    return Fit(
        scene=scene,
        parameters=fitted,
        correlation=estimated.correlation[:count, :count],
        sensitivities={
            sensor.name: (problem.deviation(x, sensor), float(expanded[count + k]))
            for k, sensor in enumerate(problem.sensors)
        },
        modes=modes,
        damping=() if misfit else damping_by_level(problem, estimated),
        compared=compared,
        variance=estimated.variance,
        misfit=misfit,
        together=describe_coupled_values(
            problem, estimated, [value.status for value in fitted], {} if misfit else largest_gaps
        ),
        warnings=(*warnings, *_missing_clock_tolerance(problem, modes)),
    )


def _missing_clock_tolerance(problem: Problem, modes: Sequence[Mode]) -> list[str]:
    """Return a note if no clock tolerance is stated, and a usual tolerance would widen the frequency intervals."""
    smallest = min((mode.frequency_expanded / mode.frequency for mode in modes), default=np.inf)
    if problem.clock_tolerance or smallest > _USUAL_CLOCK_TOLERANCE:
        return []
    return [
        "The recordings state no tolerance of the sample clock: the intervals of frequencies (the narrowest is "
        f"±{1e6 * smallest:.2g} ppm) do not contain it. State it in the scene (converter.clock_error: 20 ppm)."
    ]


def _largest_gaps(problem: Problem, estimated: Estimate) -> dict[int, float]:
    """Return the largest gaps [m] of flying dampers with undetermined clearance, by the index of the parameter."""
    expanded = estimated.expanded()
    gaps = {
        k: problem.clearance_lower_bound(estimated.x, parameter)
        for k, parameter in enumerate(problem.parameters)
        if parameter.quantity == "clearance" and expanded[k] > _MAX_RELATIVE_EXPANDED
    }
    return {k: gap for k, gap in gaps.items() if gap > 0.0}


def _fitted_value(parameter: Parameter, unknown: float, expanded: float, is_unexplained: bool) -> Fitted:
    low, value, high = (parameter.value(unknown + sign * expanded) for sign in (-1.0, 0.0, 1.0))
    half_width = expanded * parameter.slope(value)
    status = "determined" if half_width <= parameter.max_relative_expanded and not is_unexplained else "roughly"
    if half_width > _MAX_RELATIVE_EXPANDED:
        status = "undetermined"
    return Fitted(parameter.key, parameter.unit, parameter.start, value, low, high, status)


def _compare(problem: Problem, x: Array, scene: Scene, group: Group) -> Comparison:
    curves = group.curves
    predicted = problem.predicted(x, group, scene)
    residual = predicted - curves.value
    normalized = abs(np.einsum("nij,jn->in", curves.whitening, residual))
    is_fitted = group.is_fitted & np.isfinite(normalized).all(axis=0)
    # Weights of 1 / standard deviation, so lines with much noise have little influence.
    weight = abs(np.einsum("nii->in", curves.whitening))[:, is_fitted]
    relative_square = np.sum(abs(weight * residual[:, is_fitted]) ** 2, axis=1)
    relative_square /= np.sum(abs(weight * curves.value[:, is_fitted]) ** 2, axis=1)
    relative = float(np.sqrt(relative_square.max())) if is_fitted.any() else np.inf
    return Comparison(curves, predicted, is_fitted, normalized, relative)


def _misfit(estimated: Estimate, compared: Sequence[Comparison]) -> str:
    """Describe the recording that the scene does not fit, with the residual; "" if the scene fits all recordings."""
    for comparison in compared:
        is_regular = np.isfinite(comparison.predicted).all(axis=0)
        omitted = int((is_regular & ~comparison.is_fitted).sum())
        if omitted > _MAX_OMITTED_SHARE * is_regular.sum() or is_regular.mean() < 1.0 - _MAX_IRREGULAR_SHARE:
            return (
                f"{comparison.curves.label}: the scene does not reproduce the measured motion at "
                f"{int((~comparison.is_fitted).sum())} of {comparison.is_fitted.size} points."
            )
    worst = max(compared, key=lambda comparison: comparison.relative)
    if estimated.variance > _MAX_NOISE_VARIANCE and worst.relative > _MAX_RESIDUAL_RATIO:
        return (
            f"{worst.curves.label}: the best fit leaves a residual of {format_percent(worst.relative)} of the curves "
            f"(rms), {format_number(np.sqrt(estimated.variance))} times their stated uncertainties."
        )
    return ""


def _implausible_sensors(problem: Problem, x: Array) -> str:
    """Name the sensors whose fitted errors far exceed the tolerances of their data sheets."""
    sensors = [
        f"{sensor.name} would need an error of {100.0 * error:.3g} %, but its tolerance is "
        f"{100.0 * sensor.tolerance:.3g} %"
        for sensor, error in problem.implausible_sensors(x).items()
    ]
    return f"The curves fit only with sensors outside their tolerance: {', and '.join(sensors)}." if sensors else ""


def _modes(problem: Problem, estimated: Estimate) -> tuple[Mode, ...]:
    """Return the modes of the structure alone, with uncertainties by first-order propagation of the covariance."""

    def modal_values(x: Array) -> Array:
        modes = structural_model(problem.scene(x)).modes
        return np.concatenate([modes.frequency, modes.damping_ratio])

    values, step = modal_values(estimated.x), 1e-6
    columns = [(modal_values(estimated.x + step * row) - values) / step for row in np.eye(problem.size)]
    jacobian = np.stack(columns, axis=1)
    expanded = estimated.expanded(jacobian)
    count = values.size // 2
    rows = np.transpose([values[:count], expanded[:count], values[count:], expanded[count:]])
    return tuple(Mode(*row) for row in rows.tolist())
