"""Work-precision study of a scene's motion: error and CPU time of every method, measured on this machine.

The methods are the engine, general solvers, time stepping and penalty springs. The reference is a motion in decimal
arithmetic.
"""

import importlib.util
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from decimal import Decimal
from functools import partial
from typing import TypeVar

import numpy as np

from rig.core.base.errors import RunError, SceneError, ShotrigError
from rig.core.engine.propagator import tone_propagator
from rig.core.scene.scene import Scene
from rig.core.settings.quantities import count
from rig.core.simulation.simulate import Run, simulate
from rig.core.system.assembly import assemble
from rig.core.system.hybrid_system import HybridSystem
from rig.core.system.open_loop_drive import ToneDrive, accelerations_per_level, level_of, tone_drive
from rig.studies.cost.adaptive_solvers import GUARD_PAUSE_S, cvode_solver, integrate, penalty, scipy_solver
from rig.studies.cost.first_order_form import SAMPLES_PER_PERIOD, ComputedMotion, FirstOrderForm
from rig.studies.cost.high_precision import DIGITS, ExactMotion, events_of, exact_motion

#: Number of periods of the drive that every method computes.
PERIODS = 20
#: CPU time after which a method is stopped [s].
MAX_CPU_S = 10.0
#: Fast methods are repeated until their total CPU time exceeds this [s]; the fastest run counts.
MIN_MEASURED_CPU_S = 0.05
#: Stiffness of the penalty springs, as the ratio of drive period to contact duration.
CONTACTS_PER_PERIOD = (30, 300, 3000)
#: Numbers of steps per period of time stepping; multiples of the samples per period.
STEPS_PER_PERIOD = (320, 1600, 8000, 40_000)
#: Numbers of samples per period of the engine's sampled drives.
DRIVE_SAMPLES_PER_PERIOD = (64, 256, 1024, 4096)
#: Maximum step of a general solver that misses no events, in periods of the drive.
SHORT_STEP_RATIO = 1 / 40
#: Label of the setting with this maximum step, which also suspends event detection at a wall after a separation (guard
#: pause).
SHORT_STEP_SETTING = "rtol 1e-12, step T/40, guard pause"
#: The reference must be this many times as accurate as the best method.
MIN_REFERENCE_MARGIN = 1e3

T = TypeVar("T")


@dataclass(frozen=True)
class Point:
    """Cost and error of one method, or one model of beds, at one setting."""

    method: str
    setting: str
    cpu: float  # CPU time [s]: per period of the drive for the motion, total for the steady state
    error: float
    """Largest error of any displacement relative to the largest displacement; NaN if the method failed."""
    event_error: float = np.nan  # largest error of an event's time [s]; NaN if there are no events to compare
    is_correct: bool = True
    """Whether the result is valid: events in the correct order for each element; for the steady state, convergence."""
    note: str = ""  # remarks, or the reason for a failure


def failure_reason(failure: ShotrigError) -> str:
    """Describe why a method has no result: the scene is not supported, or the method failed."""
    return f"{'not applicable' if isinstance(failure, SceneError) else 'failed'}: {failure}"


@dataclass(frozen=True)
class MotionStudy:
    """Result of `motion_study`."""

    scene: Scene
    frequency: float  # Hz
    periods: int  # length of the motion, in periods of the drive
    events: int  # number of events in the motion
    points: tuple[Point, ...]
    reference: str  # origin and accuracy of the reference
    margin: float  # ratio of the smallest error of all methods to the error of the reference


def default_frequency(scene: Scene, system: HybridSystem) -> float:
    """Return the frequency of largest linear acceleration among the tones of the test, or in its band [Hz].

    Raises `SceneError` if the scene has no shaker, or its test no frequency.
    """
    level_of(scene)
    test = scene.test
    if test is None or test.band is None:
        raise SceneError("test: has no frequency. Give `frequency`.")
    grid = sorted(set(test.dwells)) or np.linspace(*test.band, 400)
    accelerations = [accelerations_per_level(scene, system, 2.0 * np.pi * f).max() for f in grid]
    return float(grid[int(np.argmax(accelerations))])


def motion_study(
    scene: Scene, frequency: float | None = None, periods: int = PERIODS, progress: Callable[[str], None] | None = None
) -> MotionStudy:
    """Measure all methods for the first periods of a scene's motion under a sinusoidal drive.

    `frequency`: excitation frequency [Hz]; None: `default_frequency`. Raises `SceneError` if nothing drives the
    scene, or its impacts are coupled by a full mass matrix.
    """
    system, periods = assemble(scene), count(periods, 1, "periods")
    frequency = frequency if frequency is not None else default_frequency(scene, system)
    tone = tone_drive(scene, system, frequency)
    assert tone is not None
    report = progress if progress is not None else lambda computation: None
    duration, rate = periods / frequency, SAMPLES_PER_PERIOD * frequency
    report("reference")
    run = simulate(scene, duration, rate, frequency=frequency)
    exact = exact_motion(system, tone, run, SAMPLES_PER_PERIOD)
    comparison = _Comparison(exact, run, system)
    points = []
    for method, setting, compute in _methods(scene, system, tone, periods):
        report(f"{method}, {setting}")
        points.append(comparison.measure(method, setting, compute, periods))
    best = min((p.error for p in points if p.error > 0.0), default=np.inf)
    margin = best / max(exact.agreement, 10.0 ** (-DIGITS))
    if margin < MIN_REFERENCE_MARGIN:
        raise RunError(
            f"the error of the reference motion is only {margin:.0f} times smaller than that of the best method; "
            f"expected at least {MIN_REFERENCE_MARGIN:.0f} times. Please report this as a bug, and attach the scene."
        )
    reference = (
        f"decimal arithmetic of {DIGITS} digits, with every event located again. With fewer digits, the motion changes "
        f"by {exact.agreement:.0e} (relative). The error of the most accurate method is {margin:.0e} times this change."
    )
    return MotionStudy(scene, frequency, periods, len(run.events), tuple(points), reference, margin)


Methods = Iterator[tuple[str, str, Callable[[], ComputedMotion]]]


def _methods(scene: Scene, system: HybridSystem, tone: ToneDrive, periods: int) -> Methods:
    """Yield each method with a setting and a function that computes the motion."""
    frequency = tone.frequency
    duration, rate = periods / frequency, SAMPLES_PER_PERIOD * frequency

    # "as called" includes the setup of a run; "warm" is the propagation with precomputed tables alone.
    yield "engine, tone", "as called", lambda: _motion_of(simulate(scene, duration, rate, frequency=frequency), system)
    yield "engine, tone", "warm", _with_prepared_tables(system, tone, periods)
    if np.array_equal(tone.state, system.initial):
        # First run without measurement, so compilation is not included in the time.
        _with_sampled_drive(scene, system, tone, DRIVE_SAMPLES_PER_PERIOD[0], 1)()
        for samples in DRIVE_SAMPLES_PER_PERIOD:
            compute = _with_sampled_drive(scene, system, tone, samples, periods)
            yield "engine, sampled drive", f"{samples * frequency:.4g} Hz", compute
    problem = FirstOrderForm(system, tone, periods)
    # Beds with instantaneous contact: no other mass falls freely.
    if system.detached.all():
        yield from _without_events(problem)
        yield from _compiled(problem, 1.0 / frequency)
    yield from _adaptive(problem, 1.0 / frequency)


def _without_events(problem: FirstOrderForm) -> Methods:
    """Yield the methods without event location."""
    from rig.studies.cost.moreau_jean import moreau_jean

    for contacts in CONTACTS_PER_PERIOD:
        yield "penalty, LSODA", f"contact of T/{contacts}", partial(penalty, problem, contacts)
    moreau_jean(FirstOrderForm(problem.system, problem.tone, 1), STEPS_PER_PERIOD[0])
    for steps in STEPS_PER_PERIOD:
        yield "Moreau-Jean", f"{steps} steps", partial(moreau_jean, problem, steps)


def _compiled(problem: FirstOrderForm, period: float) -> Methods:
    """Yield the compiled Runge-Kutta solver, after a run without measurement for its compilation."""
    from rig.studies.cost.compiled_runge_kutta import MAX_DAMPERS, DormandPrince

    if problem.system.dampers > MAX_DAMPERS:
        return
    solver = DormandPrince(problem)
    # A failure is reported in the measured run.
    with suppress(RunError):
        solver.integrate(1e-6, GUARD_PAUSE_S, period)
    for rtol in (1e-6, 1e-9, 1e-12):
        yield "compiled DP5", f"rtol {rtol:.0e}", partial(solver.integrate, rtol, GUARD_PAUSE_S, np.inf)
    yield "compiled DP5", SHORT_STEP_SETTING, partial(solver.integrate, 1e-12, GUARD_PAUSE_S, SHORT_STEP_RATIO * period)


def _adaptive(problem: FirstOrderForm, period: float) -> Methods:
    for method, tolerances in (("DOP853", (1e-4, 1e-6, 1e-9, 1e-12)), ("LSODA", (1e-6, 1e-9))):
        for rtol in tolerances:
            solve_segment = scipy_solver(method, rtol, np.inf)
            yield f"scipy {method}", f"rtol {rtol:.0e}", partial(integrate, problem, solve_segment, 0.0, MAX_CPU_S)
    if importlib.util.find_spec("sksundae") is None:
        return
    for rtol in (1e-4, 1e-6, 1e-9, 1e-12):
        solve_segment = cvode_solver(rtol, 0.0)
        yield "CVODE", f"rtol {rtol:.0e}", partial(integrate, problem, solve_segment, 0.0, MAX_CPU_S)
    short_steps = cvode_solver(1e-12, SHORT_STEP_RATIO * period)
    yield "CVODE", SHORT_STEP_SETTING, partial(integrate, problem, short_steps, GUARD_PAUSE_S, MAX_CPU_S)


def _motion_of(run: Run, system: HybridSystem, sample_stride: int = 1) -> ComputedMotion:
    return ComputedMotion(run.displacement[:, ::sample_stride], events_of(run.events, system))


def _with_prepared_tables(system: HybridSystem, tone: ToneDrive, periods: int) -> Callable[[], ComputedMotion]:
    """Return a run of the engine with precomputed tables, to time the propagation alone, as in a long run."""
    propagator, steps = tone_propagator(system, tone.amplitudes, tone.omega)
    propagator.set_state(tone.state, np.array([1.0, 0.0]))
    initial_state = propagator.snapshot()
    # Store the state at the end of the last period only.
    lengths, rows = np.full(periods, steps), np.full(periods, -1)
    rows[-1] = 0

    def compute() -> ComputedMotion:
        propagator.resume(initial_state)
        trajectory = propagator.propagate_tone(lengths, rows, np.ones(periods, dtype=bool))
        return ComputedMotion(trajectory.state[:, : len(system.points)].T, [])

    compute()
    return compute


def _with_sampled_drive(
    scene: Scene, system: HybridSystem, tone: ToneDrive, samples_per_period: int, periods: int
) -> Callable[[], ComputedMotion]:
    """Return a run of the engine driven by samples of the sinusoid."""
    rate = samples_per_period * tone.frequency
    angle = 2.0 * np.pi * np.arange(periods * samples_per_period + 1) / samples_per_period
    drive = np.real(tone.amplitudes[:, None] * np.exp(1j * angle))
    return lambda: _motion_of(
        simulate(scene, periods / tone.frequency, rate, drive=drive), system, samples_per_period // SAMPLES_PER_PERIOD
    )


class _Comparison:
    """Comparison of computed motions with the reference."""

    def __init__(self, exact: ExactMotion, run: Run, system: HybridSystem) -> None:
        self.exact = exact
        self.scale = float(np.abs(exact.displacement).max())
        times = zip(exact.event_time.astype(np.float64), events_of(run.events, system), strict=True)
        self.events = _by_element([(float(t), j, kind) for t, (_, j, kind) in times], len(system.elements))

    def measure(self, method: str, setting: str, compute: Callable[[], ComputedMotion], periods: int) -> Point:
        """Run a method and evaluate its error."""
        try:
            cpu, motion = timed(compute)
        except ShotrigError as failure:
            return Point(method, setting, np.nan, np.nan, is_correct=False, note=failure_reason(failure))
        # Subtract in decimal arithmetic so that the reference is not rounded.
        values = np.vectorize(Decimal, otypes=[object])(motion.displacement)
        has_only_last_sample = values.shape[1] == 1
        exact = self.exact.displacement[:, -1:] if has_only_last_sample else self.exact.displacement
        error = float(np.abs(values - exact).max()) / self.scale
        if has_only_last_sample:
            return Point(method, setting, cpu / periods, error, note="propagation and events only")
        computed_events = _by_element(motion.events, len(self.events))
        correct_events = _kinds(computed_events) == _kinds(self.events)
        event_error = np.nan
        if correct_events and any(computed_events):
            event_error = max(
                abs(t - reference)
                for events, references in zip(computed_events, self.events, strict=True)
                for (t, _), (reference, _) in zip(events, references, strict=True)
            )
        return Point(method, setting, cpu / periods, error, event_error, correct_events)


def _kinds(events: list[list[tuple[float, str]]]) -> list[list[str]]:
    return [[kind for _, kind in element_events] for element_events in events]


def _by_element(events: list[tuple[float, int, str]], elements: int) -> list[list[tuple[float, str]]]:
    return [[(t, kind) for t, j, kind in events if j == element] for element in range(elements)]


def timed(compute: Callable[[], T]) -> tuple[float, T]:
    """Return the CPU time of the fastest of several calls [s] and the result."""
    shortest, total = np.inf, 0.0
    while True:
        start = time.process_time()
        result = compute()
        cpu = time.process_time() - start
        shortest, total = min(shortest, cpu), total + cpu
        if total > MIN_MEASURED_CPU_S:
            return float(shortest), result
