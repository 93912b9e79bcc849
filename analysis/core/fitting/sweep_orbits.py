"""Steady response of a scene with moving dampers to sinusoidal excitation, from exact periodic orbits.

A *periodic orbit* is a motion with impacts that repeats after one or several periods of the excitation. The *reference*
of the response is the force or the displacement of the shaker's table; its *level* is its amplitude, in N or m. A fit
needs the orbit for a given level. The level that an electrodynamic shaker reaches at a *drive* voltage depends on the
motion of the dampers, so the drive for a level is computed by the secant method.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from analysis.core.fitting.measured import Curves
from analysis.core.fitting.predicted import linear_response
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import RunError, SceneError, UncoveredMotionError
from rig.core.orbits.event_sequence import Plan
from rig.core.orbits.newton import IterationLimits, newton_solve
from rig.core.orbits.orbit import Orbit, OrbitFamily
from rig.core.orbits.periodic_orbit import search_orbit, set_to_orbit, start_propagator
from rig.core.orbits.problem import OperatingPoint, OrbitProblem
from rig.core.orbits.track import first_harmonic
from rig.core.scene.matrices import Matrices
from rig.core.scene.scene import Scene
from rig.core.scene.shaker import ForceShaker
from rig.core.scene.structure import Structure
from rig.core.system.open_loop_drive import riding_response
from rig.core.system.structural_model import driven_bodies, structural_model

# Maximum number of Newton steps to an orbit at a nearby frequency and drive, which needs fewer.
_MAX_CORRECTIONS = 8
# The motion must become periodic within this number of simulated periods.
_MAX_PERIODS = 1500
# Number of steps of the continuation from a neighboring point.
_CONTINUATION_STEPS = 8
# Corrections of the level in each step of the continuation from a neighboring point.
_LEVEL_CORRECTIONS = 2
# Maximum number of secant steps to the drive that gives the level.
_MAX_SECANT_STEPS = 8
# Smallest relative secant step.
_MIN_RELATIVE_STEP = 1e-6
# Largest relative error of the level after the secant steps; the remaining error is corrected linearly.
_LEVEL_TOLERANCE = 1e-5
# Maximum number of drives at which an orbit is searched. Each gives a level closer to the required one.
_MAX_SEARCHES = 5


@dataclass(frozen=True)
class StoredOrbit:
    """An orbit, as initial values for the orbit at a nearby frequency and drive."""

    plan: Plan  # sequence of impacts and separations of the orbit
    unknowns: Array  # solution of the equations of the orbit
    drive: float  # amplitude of the force in N or, for an electrodynamic shaker, of the voltage in V
    # derivative of displacement / reference with respect to the level, shape (bodies,); None if the force is prescribed
    slope: ComplexArray | None = None


# An orbit, and its displacement / reference, shape (bodies,).
OrbitResponse = tuple[StoredOrbit, ComplexArray]


class SweepOrbits:
    """Orbits at the points of a stepped-sine sweep; each is refined from the orbit stored at its point.

    Where all dampers are at rest on their floors, the rig is linear and no orbit is needed.
    """

    def __init__(self, curves: Curves) -> None:
        if isinstance(curves.scene.shaker, tuple):
            raise SceneError(
                f"{curves.label}: recorded with several shakers and moving dampers, which a fit cannot compute. Fit "
                "recordings with a single shaker."
            )
        self.curves = curves
        # orbit at each point; None if all dampers are at rest, or if the motion is irregular
        self.current: list[StoredOrbit | None] = [None] * curves.frequency.size
        self.earlier = list(self.current)  # previous orbits, from which a later trial may start again
        self.failed: set[int] = set()  # points without an orbit, which are not searched again until this is cleared
        self.uncovered: dict[int, str] = {}  # reasons why the last search could not compute an orbit

    def response(self, test_scene: Scene, level: Array, frequency: Array, search: bool = True) -> ComplexArray:
        """Return displacement of the bodies / reference, shape (bodies, n); NaN where the motion is irregular.

        `test_scene`: from `scene_of_test`; `level`, shape (n,): true amplitude of the reference; `frequency`, shape
        (n,): Hz. If `search`, orbits are checked and, where they fail, searched. Otherwise, for derivatives, the stored
        orbits are refined without checks.
        """
        response, beds = linear_response(test_scene, self.curves, frequency)
        # A damper lifts off where the acceleration amplitude of its bed exceeds gravity.
        acceleration = (2.0 * np.pi * frequency) ** 2 * level * abs(beds).max(axis=0, initial=0.0)
        stored = np.array([orbit is not None for orbit in self.current])
        solver = _OrbitSolver(test_scene)
        for k in np.flatnonzero(acceleration > test_scene.gravity if search else stored).tolist():
            orbit = self.current[k]
            if not search:
                assert orbit is not None
                refined = solver.refine_unchecked(orbit, frequency[k], level[k])
            else:
                refined = None if orbit is None else solver.refine(orbit, frequency[k], level[k])
                refined = refined or self._recover(solver, frequency, level, k)
                self.earlier[k] = orbit or self.earlier[k]
                self.current[k] = None if refined is None else refined[0]
            response[:, k] = np.nan if refined is None else refined[1]
        if search:
            for k in np.flatnonzero(acceleration <= test_scene.gravity).tolist():
                self.current[k] = None
        return response

    def alternatives(self, test_scene: Scene, level: Array, frequency: Array, k: int) -> Iterator[OrbitResponse]:
        """Yield the stable orbits at point k, reached from adjacent points, resting dampers, and standstill."""
        solver = _OrbitSolver(test_scene)
        for neighbor in (k - 1, k + 1):
            if 0 <= neighbor < frequency.size and (orbit := self.current[neighbor]) is not None:
                reached = solver.continue_orbit(orbit, frequency[[neighbor, k]], level[[neighbor, k]])
                if reached is not None:
                    yield reached
        for from_riding in (True, False):
            reached = self._search(solver, frequency, level, k, from_riding)
            if reached is not None:
                yield reached

    def largest_gap(self, test_scene: Scene, level: Array, frequency: Array, damper: int) -> float:
        """Return the largest gap below a damper (counted from 0) over all orbits [m]; infinite with ceiling impacts."""
        solver = _OrbitSolver(test_scene)
        gaps = [
            solver.largest_gap(orbit, frequency[k], level[k], damper)
            for k, orbit in enumerate(self.current)
            if orbit is not None
        ]
        return max(gaps, default=0.0)

    def _recover(self, solver: "_OrbitSolver", frequency: Array, level: Array, k: int) -> OrbitResponse | None:
        """Refine the earlier orbit of point k or the orbit of a neighbor; if all fail, search from resting dampers."""
        neighbors = [self.current[j] for j in (k - 1, k + 1) if 0 <= j < len(self.current)]
        for orbit in (self.earlier[k], *neighbors):
            if orbit is not None and (refined := solver.refine(orbit, frequency[k], level[k])) is not None:
                return refined
        if k in self.failed:
            return None
        reached = self._search(solver, frequency, level, k, from_riding=True)
        if reached is None:
            self.failed.add(k)
        return reached

    def _search(
        self, solver: "_OrbitSolver", frequency: Array, level: Array, k: int, from_riding: bool
    ) -> OrbitResponse | None:
        """Search the orbit of point k by `_OrbitSolver.search`; store the reason if the orbit cannot be computed."""
        self.uncovered.pop(k, None)
        try:
            return solver.search(frequency[k], level[k], from_riding)
        except UncoveredMotionError as error:
            self.uncovered[k] = error.args[0]
            return None


class _OrbitSolver:
    """Solver of a scene's orbits for given levels of the reference.

    A table with prescribed motion is replaced with a spring to ground and a force of stiffness times displacement.
    """

    def __init__(self, test_scene: Scene) -> None:
        shaker = test_scene.driven_shaker
        assert shaker is not None
        self.driven = shaker.first_body - 1
        self.spring = shaker.coil_spring or 0.0
        self.table: int | None = None
        # The table is a coordinate of the orbits if its motion depends on the structure or if it carries it.
        has_table = shaker.carries_structure or (self.spring > 0.0 and not shaker.prescribed)
        if self.spring and shaker.prescribed:
            grounded = structural_model(test_scene).with_ground_springs(driven_bodies(test_scene), self.spring)
            matrices = Matrices(mass=grounded.mass, damping=grounded.damping, stiffness=grounded.stiffness)
            test_scene = test_scene.replace(
                structure=Structure(matrices=matrices), shaker=ForceShaker(body=shaker.bodies[0])
            )
        self.bodies, level = test_scene.structure.bodies, "drive" if has_table else "force"
        self.problem = OrbitProblem(test_scene.replace(test={"kind": "sine", "frequency": 1.0, level: 1.0}))
        if has_table:
            self.table = self.problem.system.points.index("table")

    def search(self, frequency: float, level: float, from_riding: bool) -> OrbitResponse | None:
        """Search the orbit to which the motion settles.

        The motion starts from the steady state with resting dampers if `from_riding` is set, otherwise from rest.

        Returns None if no stable orbit is reached. Raises `UncoveredMotionError` if the motion settles to a kind for
        which orbits are not computed.
        """
        drive = self._force(level)
        if self.table is not None:
            displacement_per_volt = riding_response(self.problem.system, "shaker", 2.0 * np.pi * frequency)[self.table]
            drive = level / abs(displacement_per_volt)
        orbit: Orbit | None = None
        for _ in range(_MAX_SEARCHES if self.table is not None else 1):
            point = OperatingPoint(float(frequency), float(drive))
            propagator = start_propagator(self.problem, point, from_riding)[0]
            if orbit is not None:
                set_to_orbit(propagator, orbit)
            try:
                orbit = search_orbit(self.problem, point, propagator, _MAX_PERIODS)
            except UncoveredMotionError:
                raise
            except (RunError, np.linalg.LinAlgError):
                return None
            stored = StoredOrbit(orbit.plan, orbit.unknowns, drive)
            refined = self.refine(stored, frequency, level)
            if refined is not None or self.table is None:
                return refined
            solution = self._refine_at_drive(stored, frequency, drive)
            if solution is None:
                return None
            reached_level = solution[2]
            drive *= float(np.clip(level / reached_level, 0.5, 2.0))
        return None

    def refine_unchecked(self, start: StoredOrbit, frequency: float, level: float) -> OrbitResponse | None:
        """Correct an orbit once for a slightly different scene, frequency and level; None if it is singular.

        Finite differences require the same orbit even if it becomes inadmissible. The error of a single correction is
        of second order in the shift, and cancels in a central difference.
        """
        drive = self._initial_drive(start, level)
        solution = self._refine_at_drive(start, frequency, drive, max_corrections=1)
        if solution is None:
            return None
        stored, ratio, reached_level = solution
        return stored, ratio if start.slope is None else ratio + start.slope * (level - reached_level)

    def refine(self, start: StoredOrbit, frequency: float, level: float, check: bool = True) -> OrbitResponse | None:
        """Refine an orbit at a frequency and level by Newton's method and, for the drive, the secant method.

        Returns None without convergence or, if `check`, if the orbit is inadmissible or unstable.
        """
        if self.table is None:
            solution = self._refine_at_drive(start, frequency, self._force(level), check)
            return None if solution is None else solution[:2]
        drive, previous = start.drive, None
        for _ in range(_MAX_SECANT_STEPS):
            solution = self._refine_at_drive(start, frequency, drive)
            if solution is None:
                return None
            start, ratio, reached_level = solution
            level_per_drive = reached_level / drive
            if previous is not None:
                previous_drive, previous_level, previous_ratio = previous
                level_per_drive = (reached_level - previous_level) / (drive - previous_drive)
                slope = (ratio - previous_ratio) / (reached_level - previous_level)
                if abs(reached_level / level - 1.0) < _LEVEL_TOLERANCE:
                    if check and self._refine_at_drive(start, frequency, drive, check) is None:
                        return None
                    return replace(start, slope=slope), ratio + slope * (level - reached_level)
            if not level_per_drive > 0.0:
                return None
            previous = drive, reached_level, ratio
            step = (level - reached_level) / level_per_drive / drive
            drive *= 1.0 + float(np.copysign(np.clip(abs(step), _MIN_RELATIVE_STEP, 0.5), step))
        return None

    def largest_gap(self, stored: StoredOrbit, frequency: float, level: float, damper: int) -> float:
        """Return the largest gap below a damper on an orbit [m]; infinite with ceiling impacts."""
        point = OperatingPoint(float(frequency), float(self._initial_drive(stored, level)))
        solution = self._newton(stored, point)
        if solution is None:
            return 0.0
        family, *solved = solution
        orbit = family.make_orbit(point, *solved)
        ceiling_impacts = (orbit.events["damper"] == damper + 1) & (orbit.events["kind"] == "ceiling")
        return np.inf if ceiling_impacts.any() else float(orbit.columns()[f"gap {damper + 1}_m"].max())

    def continue_orbit(self, orbit: StoredOrbit, frequency: Array, level: Array) -> OrbitResponse | None:
        """Continue an orbit from the first frequency and level to the second, at constant force in the coil spring."""
        refined = self.refine(orbit, frequency[0], level[0], check=False)
        if refined is None:
            return None
        force, amplitude = level[0] * self._force_ratio(refined[1]), level[0]
        for intermediate_frequency in np.linspace(frequency[0], frequency[1], _CONTINUATION_STEPS + 1)[1:].tolist():
            for _ in range(_LEVEL_CORRECTIONS if self.spring else 1):
                refined = self.refine(orbit, intermediate_frequency, amplitude, check=False)
                if refined is None:
                    return None
                amplitude = force / self._force_ratio(refined[1])
            orbit = refined[0]
        return self.refine(orbit, frequency[1], level[1], check=True)

    def _force_ratio(self, ratio: ComplexArray) -> float:
        """Return the spring force per unit of the reference, up to a constant factor."""
        return float(abs(1.0 - ratio[self.driven])) if self.spring else 1.0

    def _force(self, level: float) -> float:
        """Return the force that is equivalent to a level of the reference."""
        return float(level * (self.spring or 1.0))

    def _initial_drive(self, stored: StoredOrbit, level: float) -> float:
        """Return the drive stored with an orbit or, if the reference is prescribed, the force for the level."""
        return stored.drive if self.table is not None else self._force(level)

    def _refine_at_drive(
        self,
        start: StoredOrbit,
        frequency: float,
        drive: float,
        check: bool = False,
        max_corrections: int = _MAX_CORRECTIONS,
    ) -> tuple[StoredOrbit, ComplexArray, float] | None:
        """Return the orbit at a drive, its displacement / reference, and its level; None as in `refine`."""
        point = OperatingPoint(float(frequency), float(drive))
        solution = self._newton(start, point, max_corrections)
        if solution is None:
            return None
        family, x, equations, shooting = solution
        sequence = start.plan.sequence
        if check:
            orbit = family.make_orbit(point, x, equations, shooting)
            if orbit.flaw or not orbit.stable:
                return None
        event_times = x[len(x) - len(sequence.kind) :]
        integral = first_harmonic(equations, sequence, event_times, shooting.states)
        harmonic = 2.0 / equations.period * integral
        prescribed = -1j * point.level / (self.spring or 1.0)
        reference = complex(prescribed if self.table is None else harmonic[self.table])
        stored = replace(start, unknowns=x, drive=float(drive))
        return stored, harmonic[: self.bodies] / reference, abs(reference)

    def _newton(
        self, start: StoredOrbit, point: OperatingPoint, max_corrections: int = _MAX_CORRECTIONS
    ) -> tuple[OrbitFamily, Array, Any, Any] | None:
        """Return family, unknowns, equations and shooting result of the refined orbit; None without convergence."""
        # With one correction at most, the convergence is not checked.
        plan, problem = start.plan, self.problem
        family = OrbitFamily(problem, plan, point, "frequency", start.unknowns)
        equations, derivatives = problem.equations(point, plan, parameter=None)
        scale, residual_scale = family.scale[:-1], family.residual_scale
        try:
            x, _, shooting, _, count = newton_solve(
                equations, derivatives, plan.sequence, start.unknowns, scale, residual_scale,
                IterationLimits(max_corrections),
            )  # fmt: skip
        except np.linalg.LinAlgError:
            return None
        return None if count < 0 and max_corrections > 1 else (family, x, equations, shooting)
