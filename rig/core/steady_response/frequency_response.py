"""Steady frequency response of a scene with dampers: exact integration until steady, continued over frequency."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import count
from threading import Event
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rig.core.base.arrays import Array
from rig.core.base.errors import SceneError
from rig.core.base.figure_types import Axes
from rig.core.base.progress import CountProgress
from rig.core.engine.propagator import Propagator, tone_propagator
from rig.core.engine.trajectory import Trajectory
from rig.core.laws.events import CONTACT_EVENTS
from rig.core.results import Result, complete_style
from rig.core.results.ratio_names import frf_display, per_force, ratio_name
from rig.core.results.response import Point, Response
from rig.core.scene.loading import SceneLike, scene_of
from rig.core.scene.scene import Scene
from rig.core.settings.quantities import FREQUENCY, positive_values
from rig.core.simulation.energy import fourier_integral
from rig.core.steady_response.motion_type import combined_type, describe_motion, motion_types
from rig.core.steady_response.steady_state import INSTANTS_PER_PERIOD, SteadyState, integrate_cycle, settle
from rig.core.system.assembly import assemble
from rig.core.system.open_loop_drive import level_of, tone_drive
from rig.core.system.reference import reference_of

#: The controlled spring force agrees with its level within this fraction, far below the tolerance of a test.
LEVEL_TOLERANCE = 1e-6
#: Drive levels tried for one point; more are needed only if the response jumps at the level.
MAX_LEVEL_TRIALS = 25
#: Number of periods over which a motion without repetition is averaged.
IRREGULAR_PERIODS = 16
#: Two computed motions are the same if their responses differ by at most this fraction of the largest response.
SAME_MOTION_TOLERANCE = 1e-5


@dataclass(frozen=True, repr=False)
class SteadyResponse(Result):
    """Steady response over frequency, in the order in which the frequencies were computed.

    Attributes
    ----------
    frequency : ndarray, shape (frequencies,)
        Hz.
    frf : complex ndarray, shape (bodies, frequencies)
        First harmonic of each displacement, divided by that of the reference, m/N or m/m; x(t) = Re(X e^{i w t}).
    peak : ndarray, shape (bodies, frequencies)
        Half the peak-to-peak displacement [m].
    reference_amplitude : ndarray, shape (frequencies,)
        Amplitude of the reference's first harmonic, N or m.
    motion_type : ndarray of str, shape (frequencies,)
        "linear" (no damper can hit a wall), "riding" (at rest on its wall), "I", "II", "III" (see
        `motion_types`), "k per n" (k impacts in n periods), "irregular"; types of several dampers and joints are
        sorted and joined by "/"; `damper_motion` has those of each.
    damper_motion : ndarray of str, shape (dampers and joints, frequencies)
        Type of motion of each moving damper, then of each joint.
    impacts : ndarray, shape (dampers and joints, frequencies)
        Impacts per period of the drive.
    closing_speed : ndarray, shape (dampers and joints, frequencies)
        Largest approach speed of each moving damper to a wall, and of each joint [m/s]; 0 without contact.
    converged : ndarray of bool, shape (frequencies,)
    repetition : ndarray of int, shape (frequencies,)
        Periods of the drive after which the motion repeats; 0 if no repetition was detected.
    residual : ndarray, shape (frequencies,)
        Estimated distance from the steady state, relative to the motion; without repetition, the smallest change over
        1 to 8 periods.
    bodies : tuple of str
        Names of the bodies; empty if they have numbers only.
    reference : {"force", "table"}
        Force on the structure, or displacement of the table.
    joints : int
        Number of joints, the last rows of `damper_motion`, `impacts` and `closing_speed`.
    """

    frequency: Array
    frf: NDArray[np.complex128]
    peak: Array
    reference_amplitude: Array
    motion_type: NDArray[np.str_]
    damper_motion: NDArray[np.str_]
    impacts: Array
    closing_speed: Array
    converged: NDArray[np.bool_]
    repetition: NDArray[np.int64]
    residual: Array
    bodies: tuple[str, ...] = ()
    reference: str = "force"
    joints: int = 0

    @property
    def compliance(self) -> NDArray[np.complex128]:
        """`frf` with the force as reference [m/N]; raises `SceneError` with a different reference."""
        return per_force(self.frf, self.reference)

    @property
    def force(self) -> Array:
        """`reference_amplitude` if the reference is a force [N]; raises `SceneError` with a different reference."""
        return per_force(self.reference_amplitude, self.reference)

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of the bodies: their names, or body 1, body 2, ..."""
        return self.bodies or tuple(f"body {number}" for number in range(1, len(self.frf) + 1))

    @property
    def response(self) -> Response:
        """Return the responses of all bodies as a `rig.Response`, for plots with measured responses."""
        return as_response(
            self.frequency, self.labels, self.frf, self.reference, self.reference_amplitude, ~self.converged
        )

    def summary(self) -> str:
        """Summarize frequency range, highest computed value and types of motion."""
        body, k = np.unravel_index(int(np.argmax(abs(self.frf))), self.frf.shape)
        unit, factor = frf_display(self.reference)[1:]
        return (
            f"{self.frequency.size} frequencies, {self.frequency.min():.4g} to {self.frequency.max():.4g} Hz, "
            f"highest computed value {factor * abs(self.frf[body, k]):.4g} {unit} at {self.frequency[k]:.4g} Hz "
            f"({self.labels[body]}), motion {describe_motion(self.damper_motion, self.joints)}"
        )

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return frequency, response of each body, and type of motion."""
        return {
            "frequency_Hz": self.frequency,
            **frf_columns(self.labels, self.frf, self.reference),
            "motion_type": self.motion_type,
        }

    def draw(self, ax: Axes, **style: Any) -> None:
        """Draw the response of each body."""
        draw_frf(ax, self.frequency, self.labels, self.frf, self.reference, ~self.converged, "not steady", **style)
        ax.set(xlabel="frequency / Hz")


def frf_columns(
    labels: Sequence[str], frf: NDArray[np.complex128], reference: str
) -> dict[str, NDArray[np.complex128]]:
    """Return the responses of the bodies as columns of a table."""
    unit = ratio_name("displacement", reference)[1]
    return {f"{label}_{unit}": row for label, row in zip(labels, frf, strict=True)}


def as_response(
    frequency: Array,
    labels: Sequence[str],
    frf: NDArray[np.complex128],
    reference: str,
    amplitude: Array | None = None,
    unsteady: NDArray[np.bool_] | None = None,
    label: str = "computed",
) -> Response:
    """Create a `rig.Response` from the responses of bodies to a reference, (bodies, frequencies)."""
    return Response(
        frequency,
        np.ascontiguousarray(frf.T[:, :, None]),
        tuple(Point(name, "displacement", name, body) for body, name in enumerate(labels, 1)),
        (Point(reference, reference),),
        amplitude=amplitude,
        unsteady=unsteady,
        label=label,
    )


def draw_frf(
    ax: Axes,
    abscissa: Array,
    labels: Sequence[str],
    frf: NDArray[np.complex128],
    reference: str,
    is_marked: NDArray[np.bool_],
    marker_label: str,
    **style: Any,
) -> None:
    """Draw the response of each body, (bodies, points), in the order of the points, with optional markers."""
    name, unit, factor = frf_display(reference)
    for label, row in zip(labels, factor * abs(frf), strict=True):
        (line,) = ax.loglog(abscissa, row, **complete_style(style, label=label))
        ax.plot(abscissa[is_marked], row[is_marked], "o", mfc="white", mec=line.get_color(), ms=4)
    if is_marked.any():
        ax.plot([], [], "o", mfc="white", mec="black", ms=4, label=marker_label)
    ax.set(ylabel=f"|{name}| / ({unit})")


@dataclass(frozen=True)
class SteadyMotion:
    """Steady-state motion at one frequency, over one repetition.

    `end_state`: initial state for the next frequency; `trajectory`, `initial_states`: see `integrate_cycle`;
    `interval`: duration of its segments [s]. For each element: `types`: type of motion; `impacts`: impacts per period
    of the drive; `closing_speed`: as in `SteadyResponse`.
    """

    steady: SteadyState
    end_state: tuple[Array, ...]
    trajectory: Trajectory
    initial_states: Array
    interval: float
    types: list[str]
    impacts: Array
    closing_speed: Array


@dataclass(frozen=True)
class SteadyPoint:
    """Response of a steady-state motion at one frequency; `end_state` is the initial state for the next frequency.

    The attributes are those of `SteadyResponse` at one frequency, the types of motion of all dampers, the result of
    `settle`, and the drive level relative to the level of the linear structure.
    """

    frequency: float
    frf: NDArray[np.complex128]
    peak: Array
    reference_amplitude: float
    types: list[str]
    impacts: Array
    closing_speed: Array
    steady: SteadyState
    end_state: tuple[Array, ...]
    level: complex


def frequency_response(
    scene: SceneLike,
    frequencies: ArrayLike,
    direction: str = "up",
    tolerance: float = 1e-8,
    longest: int = 20_000,
    progress: CountProgress | None = None,
) -> SteadyResponse:
    """Compute the steady response of a scene at a list of frequencies.

    Parameters
    ----------
    scene : Scene, str, Path or mapping
        A scene, or an argument of `rig.load`. Its test gives the level: `force` (the applied force, or the first
        harmonic of the spring force) or `drive`.
    frequencies : array_like or sequence of str, shape (frequencies,)
        Hz, or strings with a unit, such as ``"49 Hz"``.
    direction : {"up", "down", "both"}
        Order of the frequencies; each starts from the motion at the previous frequency. "both" is up, then down.
    tolerance : float
        Largest distance from steady state, relative to the motion, for a point to count as converged.
    longest : int
        Number of periods after which a point is returned as not converged.
    progress : callable, optional
        Called with the number of completed points and the total.

    Returns
    -------
    SteadyResponse
        Response of each body at each frequency, with types of motion.

    Raises
    ------
    SceneError
        If a frequency is not positive, or the scene has no shaker or no level.

    Notes
    -----
    The list is divided into two sections that are computed in parallel on two cores. The second section starts from
    rest. Its points are then recomputed from the last motion of the first section, until a point is the same motion.

    Examples
    --------
    >>> import rig
    >>> scene = rig.load("fig9")
    >>> response = rig.frequency_response(scene.replace(shaker={"kind": "force", "body": 1}, channels=None), [50.0])
    >>> str(response.motion_type[0]), bool(response.converged[0])
    ('II', True)
    """
    scene = scene_of(scene)
    requested = positive_values(frequencies, FREQUENCY, "frequencies")
    if direction not in ("up", "down", "both"):
        raise SceneError(f"direction: got {direction!r}; expected up, down or both")
    level_of(scene)
    ascending = np.sort(requested)
    tasks = {"up": [ascending], "down": [ascending[::-1]], "both": [ascending, ascending[::-1]]}[direction]
    continuation = SteadyContinuation(scene, tolerance, longest)
    completed_points, total = count(1), sum(len(task) for task in tasks)

    def compute_section(order: Array) -> list[SteadyPoint]:
        points = []
        for point in continuation.points(order):
            points.append(point)
            if progress is not None:
                progress(min(next(completed_points), total), total)
        return points

    with ThreadPoolExecutor(2) as pool:
        try:
            if len(tasks) == 2:
                points = [point for section in pool.map(compute_section, tasks) for point in section]
            else:
                points = _compute_in_two_sections(pool, continuation, compute_section, tasks[0])
        except BaseException:
            # The end of the pool's context waits for the other section, so this section is stopped first.
            continuation.stopped.set()
            raise
    return _join_points(points, continuation, scene.structure.names)


def _compute_in_two_sections(
    pool: ThreadPoolExecutor,
    continuation: "SteadyContinuation",
    compute_section: Callable[[Array], list[SteadyPoint]],
    order: Array,
) -> list[SteadyPoint]:
    """Compute two halves of the frequencies in parallel, and let the second continue the motion of the first."""
    # The first point of the second section is always recomputed, so sections of up to two points save no time.
    if len(order) < 4:
        return compute_section(order)
    middle = len(order) // 2
    pending = pool.submit(compute_section, order[middle:])
    first = compute_section(order[:middle])
    second = pending.result()
    # The second section started from rest, so the motion at its first points may differ from a continuation of the
    # first section.
    previous = first[-1]
    for k, estimate in enumerate(second):
        point = continuation.point(estimate.frequency, previous)
        second[k] = point
        if _same_motion(point, estimate):
            break
        previous = point
    return first + second


def _same_motion(first: SteadyPoint, second: SteadyPoint) -> bool:
    magnitude = np.abs(second.frf).max()
    difference = np.abs(first.frf - second.frf).max()
    return first.types == second.types and bool(difference < SAME_MOTION_TOLERANCE * magnitude)


class SteadyContinuation:
    """Continuation of the steady-state motion of a scene in frequency."""

    def __init__(self, scene: Scene, tolerance: float, longest: int) -> None:
        self.scene, self.system = scene, assemble(scene)
        self.tolerance, self.longest = tolerance, longest
        #: Set when no more points are required.
        self.stopped = Event()
        shaker = scene.driven_shaker
        self.reference = reference_of(scene, self.system)
        self.controls_spring_force = scene.level_key == "force" and not (shaker is not None and shaker.drive_is_force)

    def points(self, order: Sequence[float] | Array) -> Iterator[SteadyPoint]:
        """Yield points at the given frequencies, each from the previous point; the first from rest."""
        previous = None
        for frequency in order:
            previous = self.point(float(frequency), previous)
            yield previous

    def point(self, frequency: float, previous: SteadyPoint | None) -> SteadyPoint:
        """Compute the steady-state response at one frequency, from the motion at a different frequency or from rest."""
        propagator, steps = self._propagator(frequency, previous)
        if not self.controls_spring_force:
            return self._measure(propagator, steps, frequency, 1.0, self.tolerance)
        return self._reach_spring_force(propagator, steps, frequency, previous)

    def motions(self, order: Sequence[float] | Array) -> Iterator[SteadyMotion]:
        """Yield the motions of `points` without their response; the force must act directly on a body.

        The Fourier integrals of the response would take a sixth of the time.
        """
        assert not self.controls_spring_force
        previous = None
        for frequency in order:
            propagator, steps = self._propagator(float(frequency), previous)
            previous = self._settle(propagator, steps, 1.0, self.tolerance)
            yield previous

    def _propagator(self, frequency: float, previous: SteadyMotion | SteadyPoint | None) -> tuple[Propagator, float]:
        """Return a propagator, at the end of the motion at another frequency or at rest, and its steps per period."""
        tone = tone_drive(self.scene, self.system, frequency)
        assert tone is not None
        propagator, steps = tone_propagator(self.system, tone.amplitudes, tone.omega)
        if previous is None:
            propagator.set_state(tone.state, np.array([1.0, 0.0]))
        else:
            propagator.resume(previous.end_state)
        return propagator, steps

    def _reach_spring_force(
        self, propagator: Propagator, steps: float, frequency: float, previous: SteadyPoint | None
    ) -> SteadyPoint:
        """Compute the drive level that gives the required spring force, by the secant method in logarithms."""
        target_force = level_of(self.scene)
        level = abs(previous.level) if previous is not None else 1.0
        trials: list[tuple[float, float]] = []
        point = None
        for _ in range(MAX_LEVEL_TRIALS):
            error = abs(trials[-1][1]) if trials else 1.0
            # Far from the required force, a coarse steady state is sufficient and faster.
            tolerance = max(self.tolerance, min(1e-4, 1e-2 * error))
            point = self._measure(propagator, steps, frequency, level, tolerance)
            reached_force = point.reference_amplitude
            log_error = float(np.log(reached_force / target_force)) if reached_force > 0.0 else -1.0
            trials.append((float(np.log(level)), log_error))
            if abs(log_error) < LEVEL_TOLERANCE and tolerance <= self.tolerance * 1.001:
                break
            level = float(np.exp(_next_level(trials)))
        assert point is not None
        converged = abs(trials[-1][1]) < 10.0 * LEVEL_TOLERANCE
        return point if converged else replace(point, steady=replace(point.steady, converged=False))

    def _settle(self, propagator: Propagator, steps: float, level: float, tolerance: float) -> SteadyMotion:
        """Integrate until the motion is steady at a drive level, and over one repetition."""
        system = self.system
        propagator.start_period(level)
        steady = settle(propagator, steps, level, tolerance, self.longest, self.stopped.is_set)
        repetition = steady.repetition or IRREGULAR_PERIODS
        trajectory, initial_states = integrate_cycle(propagator, steps, level, repetition)
        interval = steps / INSTANTS_PER_PERIOD * propagator.tables.step
        is_impact = np.isin(trajectory.event_kind, CONTACT_EVENTS)
        impact_dampers, closing_speed = trajectory.event_damper[is_impact], np.zeros(len(system.elements))
        np.maximum.at(closing_speed, impact_dampers, trajectory.event_speed[is_impact])
        return SteadyMotion(
            steady=steady,
            end_state=propagator.snapshot(),
            trajectory=trajectory,
            initial_states=initial_states,
            interval=interval,
            types=motion_types(trajectory, system, steady.repetition, interval),
            impacts=np.bincount(impact_dampers, minlength=closing_speed.size) / repetition,
            closing_speed=closing_speed,
        )

    def _measure(
        self, propagator: Propagator, steps: float, frequency: float, level: float, tolerance: float
    ) -> SteadyPoint:
        """Integrate until the motion is steady at a drive level, and compute its response over one repetition."""
        system, n, omega = self.system, self.system.coordinates, 2.0 * np.pi * frequency
        motion = self._settle(propagator, steps, level, tolerance)
        trajectory, repetition = motion.trajectory, motion.steady.repetition or IRREGULAR_PERIODS
        durations = np.full(len(motion.initial_states), motion.interval)
        harmonic = fourier_integral(propagator.tables, trajectory, motion.initial_states, durations, omega) / (
            np.pi * repetition / omega
        )
        positions = trajectory.state[:, :n]
        amplitude = self.reference.amplitude(level_of(self.scene) * level, harmonic[: system.states])
        bodies = self.scene.structure.bodies
        return SteadyPoint(
            frequency=frequency,
            frf=harmonic[:bodies] / amplitude if amplitude else np.full(bodies, np.nan + 0j),
            peak=0.5 * np.ptp(positions[:, :bodies], axis=0),
            reference_amplitude=abs(amplitude),
            types=motion.types,
            impacts=motion.impacts,
            closing_speed=motion.closing_speed,
            steady=motion.steady,
            end_state=motion.end_state,
            level=level,
        )


def _next_level(trials: list[tuple[float, float]]) -> float:
    """Return ln(level) after a secant step of at most a factor of two; `trials`: ln(level), ln(force / target)."""
    log_level, log_error = trials[-1]
    slope = 1.0
    if len(trials) > 1:
        previous_level, previous_error = trials[-2]
        change = log_level - previous_level
        secant = (log_error - previous_error) / change if change else 1.0
        # If the force rises little with the level (or falls, near a jump), a full secant step would be too large.
        slope = secant if secant > 0.1 else 1.0
    step = -log_error / slope
    return log_level + float(np.clip(step, -np.log(2.0), np.log(2.0)))


def _join_points(
    points: list[SteadyPoint], continuation: SteadyContinuation, names: Sequence[str] | None
) -> SteadyResponse:
    system, types = continuation.system, [point.types for point in points]
    shape = len(points), len(system.elements)
    return SteadyResponse(
        frequency=np.array([p.frequency for p in points]),
        frf=np.array([p.frf for p in points]).T,
        peak=np.array([p.peak for p in points]).T,
        reference_amplitude=np.array([p.reference_amplitude for p in points]),
        motion_type=np.array([combined_type(t) for t in types]),
        damper_motion=np.array(types, dtype=np.str_).reshape(shape).T,
        impacts=np.array([p.impacts for p in points]).reshape(shape).T,
        closing_speed=np.array([p.closing_speed for p in points]).reshape(shape).T,
        converged=np.array([p.steady.converged for p in points]),
        repetition=np.array([p.steady.repetition for p in points]),
        residual=np.array([p.steady.residual for p in points]),
        bodies=tuple(names or ()),
        reference=continuation.reference.name,
        joints=len(system.elements) - system.dampers,
    )
