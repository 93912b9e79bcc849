"""Steady-state motion over a parameter such as frequency or force, computed as exact stable orbits (periodic motions).

At each value of the parameter the orbit is predicted from the previous orbits and corrected by Newton's iteration.
Every orbit is checked for admissibility and stability. If a check fails, the motion is simulated as in a slow sweep
until it settles to another orbit. An irregular motion is averaged.

A *setting* is an operating point: the values of all parameters. A *plan* is the sequence of contact events in a cycle.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rig.core.base.arrays import Array
from rig.core.base.errors import RunError, SceneError
from rig.core.base.progress import CountProgress
from rig.core.engine.propagator import Propagator
from rig.core.numerics.jit import cached_njit
from rig.core.orbits.newton import IterationLimits, distance
from rig.core.orbits.orbit import Orbit, OrbitFamily
from rig.core.orbits.periodic_orbit import period_steps, search_orbit, set_to_orbit, start_propagator
from rig.core.orbits.problem import (
    Axis,
    OperatingPoint,
    OrbitProblem,
    Parameter,
    base_frequency,
    vary,
)
from rig.core.results import Result
from rig.core.results.ratio_names import frf_display, per_force
from rig.core.scene.loading import SceneLike, scene_of
from rig.core.steady_response.frequency_response import as_response, draw_frf, frf_columns
from rig.core.steady_response.motion_type import combined_type, describe_motion
from rig.core.steady_response.steady_state import INSTANTS_PER_PERIOD, sample_periods

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from rig.core.results.response import Response

# Maximum number of continuation steps, including rejected steps, from one value to the next.
MAX_STEPS = 6
# Maximum number of Newton corrections after a prediction.
MAX_CORRECTIONS = 6
# Newton's iteration is stopped if the first correction after a prediction exceeds this fraction of the predicted change
# from the previous point, or if a correction exceeds this fraction of the previous correction. In designs of dampers
# for the bundled scenes, these limits stop 97 % of the iterations that would not converge in six corrections, and 0.4 %
# of those that would.
MAX_CORRECTION_RATIO = 0.5
# A prediction is rejected if its error exceeds this fraction of the change from the previous point.
MAX_PREDICTION_ERROR = 0.3
# A prediction changes an unknown by at most this multiple of the scale of the unknown. Without this limit, closely
# spaced points could predict event instants millions of periods ahead, and the propagation would not finish.
MAX_PREDICTION_RATIO = 10.0
# Number of points used for extrapolation.
EXTRAPOLATION_POINTS = 4
# A motion without repetition after this number of periods of the drive is irregular.
MAX_PERIODS = 1500
# Number of periods over which an irregular motion is averaged.
AVERAGED_PERIODS = 64


@dataclass(frozen=True, repr=False)
class OrbitResponse(Result):
    """Steady-state motion over a parameter, in the order in which its values were computed.

    Attributes
    ----------
    parameter : str
        Varied parameter: frequency, force, clearance or mass_ratio.
    value : ndarray, shape (values,)
        Values of the parameter (Hz, N, m, or factor on the mass ratios).
    frf : complex ndarray, shape (bodies, values)
        First harmonic of each displacement, divided by that of the reference [m/N, or m/m].
    peak : ndarray, shape (bodies, values)
        Half the peak-to-peak value of each displacement [m].
    orbits : tuple of Orbit or None, length values
        None for irregular motion, which is simulated and averaged.
    reasons : tuple of str, length values
        Reason for a missing orbit; "" if the orbit exists.
    labels : tuple of str, length bodies
        Display names of the bodies: their names, or body 1, body 2, ...
    elements : int
        Number of dampers that move, plus number of joints.
    joints : int
        Number of joints, the last rows of `damper_motion`.
    reference : {"force", "table"}
        Force on the structure, or displacement of the table.
    """

    axis: Axis = field(repr=False)
    value: Array
    frf: NDArray[np.complex128]
    peak: Array
    orbits: tuple[Orbit | None, ...]
    reasons: tuple[str, ...]
    labels: tuple[str, ...]
    elements: int
    joints: int = 0
    reference: str = "force"

    @property
    def parameter(self) -> str:
        """Name of the parameter."""
        return self.axis.name

    @property
    def compliance(self) -> NDArray[np.complex128]:
        """`frf` with the force as reference [m/N]; raises `SceneError` with another reference."""
        return per_force(self.frf, self.reference)

    # A search for peaks needs only the response, so further quantities are computed when first used.
    @cached_property
    def damper_motion(self) -> NDArray[np.str_]:
        """Type of motion of each damper that moves, then of each joint, shape (dampers and joints, values)."""
        irregular = ("irregular",) * self.elements
        types = [irregular if orbit is None else orbit.damper_motion for orbit in self.orbits]
        return np.array(types, dtype=np.str_).reshape(len(types), -1).T

    @cached_property
    def motion_type(self) -> NDArray[np.str_]:
        """Type of motion at each value of the parameter, named as in `rig.frequency_response`; shape (values,)."""
        return np.array([combined_type(types) for types in self.damper_motion.T.tolist()])

    @cached_property
    def repetition(self) -> NDArray[np.int64]:
        """Periods of the drive after which the motion repeats, shape (values,); 0 for irregular motion."""
        return np.array([0 if orbit is None else orbit.repetition for orbit in self.orbits])

    @cached_property
    def multiplier(self) -> Array:
        """Modulus of the largest Floquet multiplier, shape (values,); NaN for irregular motion."""
        return np.array([np.nan if orbit is None else np.abs(orbit.multipliers).max() for orbit in self.orbits])

    @property
    def simulated(self) -> NDArray[np.bool_]:
        """Whether the motion is irregular, and was simulated and averaged; shape (values,)."""
        return np.array([orbit is None for orbit in self.orbits], dtype=bool)

    @property
    def response(self) -> Response:
        """Return the responses of all bodies over frequency as a `rig.Response`, for plots with measured responses.

        Raises
        ------
        SceneError
            If another parameter was varied.
        """
        if self.parameter != "frequency":
            raise SceneError(
                f"response: requires a sweep over frequency, but this sweep varied the {self.parameter}. Vary the "
                "frequency."
            )
        return as_response(self.value, self.labels, self.frf, self.reference, unsteady=self.simulated, label="orbits")

    def summary(self) -> str:
        """Return the range of the parameter, the highest computed value and the types of motion in words."""
        body, k = np.unravel_index(int(np.argmax(abs(self.frf))), self.frf.shape)
        unit = self.axis.unit
        frf_unit, factor = frf_display(self.reference)[1:]
        return (
            f"{self.value.size} steady-state motions, "
            f"{self.parameter} {self.value.min():.4g} to {self.value.max():.4g} {unit}, "
            f"highest computed value {factor * abs(self.frf[body, k]):.4g} {frf_unit} at {self.value[k]:.4g} {unit} "
            f"({self.labels[body]}), motion {describe_motion(self.damper_motion, self.joints)}"
        )

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return parameter, response of each body, type of motion, and largest Floquet multiplier."""
        return {
            self.axis.column: self.value,
            **frf_columns(self.labels, self.frf, self.reference),
            "motion_type": self.motion_type,
            "multiplier": self.multiplier,
        }

    def draw(self, ax: Axes, **style: Any) -> None:
        """Draw the response of each body."""
        abscissa = self.axis.factor * self.value
        draw_frf(ax, abscissa, self.labels, self.frf, self.reference, self.simulated, "irregular, averaged", **style)
        ax.set(xlabel=self.axis.label)


def orbit_response(
    scene: SceneLike,
    values: ArrayLike,
    parameter: Parameter = "frequency",
    *,
    frequency: float | str | None = None,
    progress: CountProgress | None = None,
) -> OrbitResponse:
    """Compute the steady-state motion of a scene at each value of a parameter, as exact stable orbits.

    The result is the same as that of `rig.frequency_response`, without simulation of transients. If the test
    controls the spring force of a table, this force is a pure tone here, as in `rig.periodic_orbit`.
    `rig.frequency_response` includes the harmonics that the dampers cause through the coil spring, so the results
    may differ by 1 %.

    Parameters
    ----------
    scene : Scene, str, Path or mapping
        As for `rig.periodic_orbit`.
    values : array_like, shape (values,)
        Values of the parameter, in SI or as strings with units, in the order of computation: each starts from the
        motion at the previous value.
    parameter : {'frequency', 'force', 'drive', 'clearance', 'mass_ratio'}
        Varied parameter: Hz, level of the scene's test (a force, N, or a drive in the unit of the shaker's drive),
        clearance of all dampers [m], factor on their masses.
    frequency : float or str, optional
        Hz, or text with a unit; needed unless it is the parameter.
    progress : callable, optional
        Called with the number of completed values and the total number.

    Returns
    -------
    OrbitResponse
        Motion at each value of the parameter.

    Raises
    ------
    SceneError
        If the parameter or a value is invalid.

    Examples
    --------
    >>> import rig
    >>> response = rig.orbit_response(rig.load("fig9"), [49.2, 49.5, 49.8])
    >>> response.motion_type.tolist(), bool(response.simulated.any())
    (['III', 'II', 'II'], False)
    """
    problem = OrbitProblem(scene_of(scene))
    axis = problem.axis(parameter)
    si_values = axis.values(values)
    base = problem.setting(base_frequency(axis, frequency, float(si_values[0])))
    return sweep(problem, base, axis, si_values, progress)


def sweep(
    problem: OrbitProblem,
    base: OperatingPoint,
    axis: Axis,
    values: Array,
    progress: CountProgress | None = None,
) -> OrbitResponse:
    """Compute `orbit_response` for an existing problem."""
    continuation = _Continuation(problem, base, axis.field)
    points = []
    for completed, value in enumerate(values.tolist(), 1):
        points.append(continuation.point(value))
        if progress is not None:
            progress(completed, len(values))
    return OrbitResponse(
        axis=axis,
        value=values,
        frf=np.array([p.frf for p in points]).T,
        peak=np.array([p.peak for p in points]).T,
        orbits=tuple(p.orbit for p in points),
        reasons=tuple(p.reason for p in points),
        labels=problem.scene.structure.labels,
        elements=len(problem.system.elements),
        joints=len(problem.system.elements) - problem.system.dampers,
        reference=problem.reference.name,
    )


@dataclass(frozen=True)
class _Point:
    """Steady-state motion at one value of the parameter; fields as in `OrbitResponse`."""

    frf: NDArray[np.complex128]
    peak: Array
    orbit: Orbit | None
    reason: str


@dataclass(frozen=True)
class _BranchPoint:
    """A point of the current branch: unknowns and their derivative (slope) with respect to the parameter."""

    value: float
    unknowns: Array
    slope: Array
    orbit: Orbit


@cached_njit
def _hermite(nodes: Array, values: Array, slopes: Array, x: float) -> Array:
    """Return the Hermite polynomial at x, shape (unknowns,).

    `values`, `slopes`, shape (points, unknowns): values and derivatives of the polynomial at the `nodes`.
    """
    result = np.zeros(values.shape[1])
    for i in range(nodes.size):
        basis, basis_slope = 1.0, 0.0
        for k in range(nodes.size):
            if k != i:
                basis *= ((x - nodes[k]) / (nodes[i] - nodes[k])) ** 2
                basis_slope += 2 / (nodes[i] - nodes[k])
        step = x - nodes[i]
        result += basis * ((1 - basis_slope * step) * values[i] + step * slopes[i])
    return result


class _Continuation:
    """Continuation of the steady-state motion from one value of the parameter to the next."""

    def __init__(self, problem: OrbitProblem, base: OperatingPoint, parameter: str) -> None:
        self.problem, self.parameter = problem, parameter
        self.setting_at = vary(base, parameter)
        # The last points of the current branch, in order; empty after an irregular motion.
        self.recent_points: list[_BranchPoint] = []
        self.family: OrbitFamily | None = None  # equations of the current branch
        # `Propagator.snapshot` of the last irregular motion, from which the next simulation starts.
        self.snapshot: tuple[Array, ...] | None = None

    def point(self, value: float) -> _Point:
        """Compute the steady-state motion at a value of the parameter, from the motion at the previous value."""
        orbit = self._continue_orbit(value) if self.recent_points else None
        if orbit is not None:
            return _orbit_point(orbit)
        return self._settle(value)

    def _continue_orbit(self, value: float) -> Orbit | None:
        """Continue the orbit to a value of the parameter; return None if it ends or loses its stability before."""
        if value == self.recent_points[-1].value:
            return self.recent_points[-1].orbit
        target = value
        for _ in range(MAX_STEPS):
            point = self._step(target)
            if point is None:
                target = 0.5 * (self.recent_points[-1].value + target)
                continue
            if point.orbit.flaw or not point.orbit.stable:
                return None
            # The nodes of the extrapolation must differ, even if a sweep repeats a value.
            other_points = [recent for recent in self.recent_points if recent.value != target]
            self.recent_points = [*other_points[1 - EXTRAPOLATION_POINTS :], point]
            if target == value:
                return point.orbit
            target = value
        return None

    def _step(self, value: float) -> _BranchPoint | None:
        """Predict the orbit at a value of the parameter, and correct the prediction.

        Returns None if Newton's iteration diverges or reaches another orbit.
        """
        family, last_point = self.family, self.recent_points[-1]
        assert family is not None
        prediction, scale = self._predict(value), family.scale[:-1]
        change = distance(prediction, last_point.unknowns, scale)
        if not change < MAX_PREDICTION_RATIO:
            return None
        max_first_size = MAX_CORRECTION_RATIO * max(change, 0.01)
        limits = IterationLimits(MAX_CORRECTIONS, max_first_size, MAX_CORRECTION_RATIO)
        try:
            equations, x, slope, shooting, _, corrections = family.correct(value, prediction, limits)
        except np.linalg.LinAlgError:
            return None
        max_error = MAX_PREDICTION_ERROR * max(distance(x, last_point.unknowns, scale), 0.01)
        if corrections < 0 or distance(x, prediction, scale) > max_error:
            return None
        orbit = family.make_orbit(self.setting_at(value), x, equations, shooting)
        return _BranchPoint(value, x, slope, orbit)

    def _predict(self, value: float) -> Array:
        """Predict the unknowns at a value of the parameter with the Hermite polynomial through the last points."""
        nodes = np.array([point.value for point in self.recent_points])
        unknowns = np.array([point.unknowns for point in self.recent_points])
        return _hermite(nodes, unknowns, np.array([point.slope for point in self.recent_points]), value)

    def _settle(self, value: float) -> _Point:
        """Simulate from the previous motion until it settles to an orbit; if it does not, average the motion."""
        setting = self.setting_at(value)
        propagator, _ = start_propagator(self.problem, setting)
        if self.recent_points:
            set_to_orbit(propagator, self.recent_points[-1].orbit)
        elif self.snapshot is not None:
            propagator.resume(self.snapshot)
        try:
            orbit = search_orbit(self.problem, setting, propagator, MAX_PERIODS)
            reason = orbit.flaw or ("" if orbit.stable else "the computed orbit is not stable")
        except RunError as failure:
            reason = str(failure)
        if reason:
            self.recent_points, self.snapshot = [], propagator.snapshot()
            return _average(self.problem, setting, propagator, reason)
        self.family = family = OrbitFamily(self.problem, orbit.plan, setting, self.parameter, orbit.unknowns)
        _, x, slope, *_ = family.correct(value, orbit.unknowns, IterationLimits(1))
        self.recent_points = [_BranchPoint(value, x, slope, orbit)]
        return _orbit_point(orbit)


def _orbit_point(orbit: Orbit) -> _Point:
    """Return the point of an admissible stable orbit."""
    return _Point(orbit.frf, orbit.peak, orbit, "")


@cached_njit
def _mean_period(initial: Array, states: Array, bodies: int) -> tuple[Array, Array]:
    """Return the mean of the states at each instant of a period, and half the range of each body's displacement.

    `states`: states at the ends of the intervals between the instants, shape (periods * instants, states); `initial`:
    state at the first instant.
    """
    periods, size = states.shape[0] // INSTANTS_PER_PERIOD, states.shape[1]
    mean, lowest, highest = np.zeros((INSTANTS_PER_PERIOD, size)), states[0, :bodies].copy(), states[0, :bodies].copy()
    mean[0] = initial
    for row in range(states.shape[0]):
        for body in range(bodies):
            lowest[body] = min(lowest[body], states[row, body])
            highest[body] = max(highest[body], states[row, body])
        if row + 1 < states.shape[0]:
            instant = (row + 1) % INSTANTS_PER_PERIOD
            for column in range(size):
                mean[instant, column] += states[row, column]
    return mean / periods, 0.5 * (highest - lowest)


def _average(problem: OrbitProblem, setting: OperatingPoint, propagator: Propagator, reason: str) -> _Point:
    """Compute the response of an irregular motion, averaged over `AVERAGED_PERIODS`."""
    bodies = problem.scene.structure.bodies
    steps = period_steps(propagator, setting)
    initial = propagator.state.z.copy()
    trajectory = sample_periods(propagator, steps, 1.0, AVERAGED_PERIODS)
    # Mean over evenly spaced instants: velocity jumps at impacts cause a relative error of about 1e-5.
    mean_period, half_ranges = _mean_period(initial, trajectory.state, bodies)
    phase = 2 * np.pi * np.arange(INSTANTS_PER_PERIOD) / INSTANTS_PER_PERIOD
    phase_factors: NDArray[np.complex128] = np.exp(-1j * phase)
    harmonic = 2 / INSTANTS_PER_PERIOD * (phase_factors @ mean_period)
    amplitude = problem.reference.amplitude(setting.level, harmonic[: problem.system.states])
    return _Point(frf=harmonic[:bodies] / amplitude, peak=half_ranges, orbit=None, reason=reason)
