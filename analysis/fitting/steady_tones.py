"""Steady response of a scene with dampers to tones: exact periodic motions (orbits), point by point.

Dampers at rest on their floors are "riding"; a bed is the mass in a cavity.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from analysis.fitting.measured import Curves
from analysis.fitting.predicted import riding
from rig.arrays import Array, ComplexArray
from rig.errors import RunError, SceneError, UncoveredMotionError
from rig.orbits.admissibility import evaluate_motion
from rig.orbits.event_sequence import Plan
from rig.orbits.orbit import Orbit, OrbitFamily
from rig.orbits.periodic_orbit import search_orbit, set_to_orbit, start_propagator
from rig.orbits.problem import OperatingPoint, OrbitProblem
from rig.scene.matrices import Matrices
from rig.scene.scene import Scene
from rig.scene.shaker import ForceShaker
from rig.scene.structure import Structure
from rig.system.open_loop_drive import riding_response
from rig.system.structural_model import driven_bodies, structural_model

_MAX_NEWTON_STEPS = 8
# Maximum number of simulated periods in the search for a motion.
_MAX_PERIODS = 1500
# Number of frequency steps in the continuation from a neighbouring point, and of level corrections in each.
_CONTINUATION_STEPS = 8
_LEVEL_CORRECTIONS = 2
# Secant method for the drive that causes a level: maximum number of steps, minimum relative step, and relative
# deviation from the level at which it ends; the response is interpolated over this deviation.
_MAX_SECANT_STEPS = 8
_MIN_RELATIVE_STEP = 1e-6
_LEVEL_TOLERANCE = 1e-5
# Maximum number of drives at which a motion is searched, each closer to the level.
_MAX_SEARCHES = 5


@dataclass(frozen=True)
class Known:
    """A periodic motion: its events, the unknowns of its equations, and the level of the drive that causes it.

    `slope`: derivative of displacement / reference with respect to the level of the reference, where the reference
    is not the driven quantity, shape (bodies,).
    """

    plan: Plan
    unknowns: Array
    drive: float
    slope: ComplexArray | None = None


Solution = tuple[Known, ComplexArray]


class SteadyTones:
    """Steady motion with dampers at each point of a sweep, continued from the motion stored there.

    `known`: stored motion at each point; None if all dampers are riding or the motion is not periodic.
    `before`: last motion at each point. It restores the motion after a trial that lost it.
    `given_up`: points without a motion, which are not searched again until this set is emptied.
    `uncovered`: reasons why orbits cannot be computed at points, from the last search.
    """

    def __init__(self, curves: Curves) -> None:
        if isinstance(curves.scene.shaker, tuple):
            raise SceneError(
                f"{curves.label}: several shakers drive a scene with dampers. Fit recordings of a single shaker."
            )
        self.curves = curves
        self.known: list[Known | None] = [None] * curves.frequency.size
        self.before = list(self.known)
        self.given_up: set[int] = set()
        self.uncovered: dict[int, str] = {}

    def at(self, bench: Scene, level: Array, frequency: Array, settle: bool = True) -> ComplexArray:
        """Return displacement of the bodies / reference; NaN where the motion is irregular.

        `bench`: from `on_the_bench`; `level`, shape (n,): true amplitude of the reference; `frequency`, shape (n,):
        Hz; `settle`: whether motions may be searched; otherwise only stored motions are continued, for derivatives.
        """
        found, beds = riding(bench, self.curves, frequency)
        acceleration = (2.0 * np.pi * frequency) ** 2 * level * abs(beds).max(axis=0, initial=0.0)
        flying = np.array([known is not None for known in self.known])
        solver = _OrbitSolver(bench)
        for k in np.flatnonzero(acceleration > bench.gravity if settle else flying).tolist():
            here = self.known[k]
            if not settle:
                assert here is not None
                answer = solver.follow(here, frequency[k], level[k])
            else:
                answer = None if here is None else solver.refine(here, frequency[k], level[k])
                answer = answer or self._recover(solver, frequency, level, k)
                self.before[k] = here or self.before[k]
                self.known[k] = None if answer is None else answer[0]
            found[:, k] = np.nan if answer is None else answer[1]
        if settle:
            for k in np.flatnonzero(acceleration <= bench.gravity).tolist():
                self.known[k] = None
        return found

    def others(self, bench: Scene, level: Array, frequency: Array, k: int) -> Iterator[Solution]:
        """Yield the stable motions at a point that are reached from its neighbours, from riding, and from rest."""
        solver = _OrbitSolver(bench)
        for near in (k - 1, k + 1):
            if 0 <= near < frequency.size and (known := self.known[near]) is not None:
                answer = solver.continue_to(known, frequency[[near, k]], level[[near, k]])
                if answer is not None:
                    yield answer
        for moving in (True, False):
            answer = self._search(solver, frequency, level, k, moving)
            if answer is not None:
                yield answer

    def largest_gap(self, bench: Scene, level: Array, frequency: Array, damper: int) -> float:
        """Largest gap below a damper (from 0) in all motions, m; infinite with ceiling impacts."""
        solver, largest = _OrbitSolver(bench), 0.0
        for k, known in enumerate(self.known):
            if known is not None:
                largest = max(largest, solver.largest_gap(known, frequency[k], level[k], damper))
        return largest

    def _recover(self, solver: _OrbitSolver, frequency: Array, level: Array, k: int) -> Solution | None:
        """Motion with its earlier events, or with those of a neighbour, or the motion reached from riding."""
        neighbours = [self.known[near] for near in (k - 1, k + 1) if 0 <= near < len(self.known)]
        for known in (self.before[k], *neighbours):
            if known is not None:
                answer = solver.refine(known, frequency[k], level[k])
                if answer is not None:
                    return answer
        if k in self.given_up:
            return None
        answer = self._search(solver, frequency, level, k, moving=True)
        if answer is None:
            self.given_up.add(k)
        return answer

    def _search(
        self, solver: _OrbitSolver, frequency: Array, level: Array, k: int, moving: bool
    ) -> Solution | None:
        """Motion reached from riding or from rest at a point; records the reason if it has no orbit."""
        self.uncovered.pop(k, None)
        try:
            return solver.search_motion(frequency[k], level[k], moving)
        except UncoveredMotionError as error:
            self.uncovered[k] = error.args[0]
            return None


class _OrbitSolver:
    """Orbits of a scene for levels of the reference.

    A table with prescribed motion is replaced by a spring to ground and a force of stiffness times displacement.
    The table of an electrodynamic shaker reacts to the dampers; the drive that causes its level is computed by the
    secant method.
    """

    def __init__(self, bench: Scene) -> None:
        shaker = bench.driven_shaker
        assert shaker is not None
        self.driven = shaker.bodies[0] - 1
        self.spring = shaker.spring or 0.0
        self.table: int | None = None
        level = "force"
        if shaker.kind == "electrodynamic":
            level = "drive"
        elif self.spring:
            held = structural_model(bench).with_ground_springs(driven_bodies(bench), self.spring)
            matrices = Matrices(mass=held.mass, damping=held.damping, stiffness=held.stiffness)
            bench = bench.replace(
                structure=Structure(matrices=matrices), shaker=ForceShaker(body=shaker.body)
            )
        self.bodies = bench.structure.bodies
        self.problem = OrbitProblem(bench.replace(test={"kind": "sine", "frequency": 1.0, level: 1.0}))
        if shaker.kind == "electrodynamic":
            self.table = self.problem.system.points.index("table")

    def search_motion(self, frequency: float, level: float, moving: bool) -> Solution | None:
        """Motion reached from the steady motion with riding dampers or, unless `moving`, from rest.

        Raises `UncoveredMotionError` if it settles to a motion for which orbits are not computed.
        """
        drive = self._drive(level)
        if self.table is not None:
            per_volt = riding_response(self.problem.system, "shaker", 2.0 * np.pi * frequency)[self.table]
            drive = level / abs(per_volt)
        orbit: Orbit | None = None
        for _ in range(_MAX_SEARCHES if self.table is not None else 1):
            setting = OperatingPoint(float(frequency), float(drive))
            propagator = start_propagator(self.problem, setting, moving)[0]
            if orbit is not None:
                set_to_orbit(propagator, orbit)
            try:
                orbit = search_orbit(self.problem, setting, propagator, _MAX_PERIODS)
            except UncoveredMotionError:
                raise
            except (RunError, np.linalg.LinAlgError):
                return None
            known = Known(orbit.plan, orbit.unknowns, drive)
            answer = self.refine(known, frequency, level)
            if answer is not None or self.table is None:
                return answer
            solution = self._solve_at_drive(known, frequency, drive)
            if solution is None:
                return None
            drive *= float(np.clip(level / solution[2], 0.5, 2.0))
        return None

    def follow(self, near: Known, frequency: float, level: float) -> Solution | None:
        """Continue a motion by a finite-difference step, without checks; None without convergence."""
        drive = near.drive if self.table is not None else self._drive(level)
        solution = self._solve_at_drive(near, frequency, drive)
        if solution is None:
            return None
        known, ratio, amplitude = solution
        return known, ratio if near.slope is None else ratio + near.slope * (level - amplitude)

    def refine(self, near: Known, frequency: float, level: float, checked: bool = True) -> Solution | None:
        """Refine a motion at a frequency and level; None without convergence or if it fails the check.

        `checked`: an inadmissible or unstable motion is rejected.
        """
        if self.table is None:
            solution = self._solve_at_drive(near, frequency, self._drive(level), checked)
            return None if solution is None else solution[:2]
        drive, before = near.drive, None
        for _ in range(_MAX_SECANT_STEPS):
            solution = self._solve_at_drive(near, frequency, drive)
            if solution is None:
                return None
            near, ratio, amplitude = solution
            gain = amplitude / drive
            if before is not None:
                gain = (amplitude - before[1]) / (drive - before[0])
                slope = (ratio - before[2]) / (amplitude - before[1])
                if abs(amplitude / level - 1.0) < _LEVEL_TOLERANCE:
                    if checked and self._solve_at_drive(near, frequency, drive, checked) is None:
                        return None
                    return replace(near, slope=slope), ratio + slope * (level - amplitude)
            if not gain > 0.0:
                return None
            before = drive, amplitude, ratio
            step = (level - amplitude) / gain / drive
            drive *= 1.0 + float(np.copysign(np.clip(abs(step), _MIN_RELATIVE_STEP, 0.5), step))
        return None

    def largest_gap(self, known: Known, frequency: float, level: float, damper: int) -> float:
        """Largest gap below a damper in a motion, m; infinite with ceiling impacts."""
        drive = known.drive if self.table is not None else self._drive(level)
        setting = OperatingPoint(float(frequency), float(drive))
        solution = self._solve(known, setting)
        if solution is None:
            return 0.0
        curve, *solved = solution
        orbit = curve.make_orbit(setting, *solved)
        hits = (orbit.events["damper"] == damper + 1) & (orbit.events["kind"] == "ceiling")
        return np.inf if hits.any() else float(orbit.columns()[f"gap {damper + 1}_m"].max())

    def continue_to(self, known: Known, frequency: Array, level: Array) -> Solution | None:
        """Continue a motion from the first point to the second at a constant force in the coil spring."""
        answer = self.refine(known, frequency[0], level[0], checked=False)
        if answer is None:
            return None
        force, amplitude = level[0] * self._spring_force(answer[1]), level[0]
        for between in np.linspace(frequency[0], frequency[1], _CONTINUATION_STEPS + 1)[1:].tolist():
            for _ in range(_LEVEL_CORRECTIONS if self.spring else 1):
                answer = self.refine(known, between, amplitude, checked=False)
                if answer is None:
                    return None
                amplitude = force / self._spring_force(answer[1])
            known = answer[0]
        return self.refine(known, frequency[1], level[1], checked=True)

    def _spring_force(self, ratio: ComplexArray) -> float:
        """Force per unit of the reference, up to a constant factor."""
        return float(abs(1.0 - ratio[self.driven])) if self.spring else 1.0

    def _drive(self, level: float) -> float:
        """Force equivalent to a level of the reference."""
        return float(level * (self.spring or 1.0))

    def _solve_at_drive(
        self, near: Known, frequency: float, drive: float, checked: bool = False
    ) -> tuple[Known, ComplexArray, float] | None:
        """Motion at a drive, displacement over the reference, and the reference's level."""
        setting = OperatingPoint(float(frequency), float(drive))
        solution = self._solve(near, setting)
        if solution is None:
            return None
        curve, x, equations, shot = solution
        sequence = near.plan.sequence
        if checked:
            orbit = curve.make_orbit(setting, x, equations, shot)
            if orbit.flaw or not orbit.stable:
                return None
        instants = x[len(x) - len(sequence.kind) :]
        harmonic = 2.0 / equations.period * evaluate_motion(equations, sequence, shot, instants)[1]
        driven = -1j * setting.force / (self.spring or 1.0)
        reference = complex(driven if self.table is None else harmonic[self.table])
        known = replace(near, unknowns=x, drive=float(drive))
        return known, harmonic[: self.bodies] / reference, abs(reference)

    def _solve(self, near: Known, setting: OperatingPoint) -> tuple[OrbitFamily, Array, Any, Any] | None:
        """Newton's method from a motion: the curve, unknowns, equations and shot; None without convergence."""
        curve = OrbitFamily(self.problem, near.plan, setting, "frequency", near.unknowns)
        try:
            equations, x, _, shot, _, count = curve.correct(
                setting.frequency, near.unknowns, _MAX_NEWTON_STEPS
            )
        except np.linalg.LinAlgError:
            return None
        return None if count < 0 else (curve, x, equations, shot)
