"""Curves of exact orbits over frequency, force, clearance or mass ratio: stable and unstable, across borders.

Continuation follows a sequence of events through folds to the end of the range or to a border, where the sequence
becomes impossible: a grazing impact, a release, a contact of zero duration, or two events that change order. Beyond
the border another sequence is valid. Simulation of the exact motion from the border locates it, and continuation
follows it in turn.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from rig.arrays import Array
from rig.errors import RunError, SceneError
from rig.numerics import continuation
from rig.orbits.orbit import Following, Orbit
from rig.orbits.orbit_curve import OrbitBranch, OrbitCurve
from rig.orbits.periodic_orbit import enter, refine, search, start_march
from rig.orbits.problem import OperatingPoint, OrbitProblem, Parameter, base_frequency, parameter_values, vary
from rig.scene.loading import SceneLike, scene_of

STEPS = continuation.Steps(first=5e-3, longest=0.25, turn=0.12, shortest=1e-7, points=1500)
# Distance past a border, relative to the parameter, at which Newton's iteration for the next orbit starts.
BEYOND = 2e-6
# Distances past a border at which the motion is simulated until it is steady.
FARTHER = (2e-5, 3e-4, 3e-3)
# Limit of the number of branches: near irregular motion there are infinitely many.
MOST = 60


def follow_orbits(
    scene: SceneLike,
    parameter: Parameter,
    bounds: tuple[float | str, float | str],
    *,
    frequency: float | str | None = None,
    searches: int = 5,
    progress: Callable[[int], None] | None = None,
) -> OrbitCurve:
    """Follow all orbits reached by simulation from rest and by continuation across borders.

    Parameters
    ----------
    scene : Scene, str, Path or mapping
        As for `rig.periodic_orbit`.
    parameter : {'frequency', 'force', 'clearance', 'mass_ratio'}
        Varied parameter: Hz, level of the drive (N), clearance of all dampers (m), factor on their masses.
    bounds : tuple of float or str
        Range of the parameter, in SI or as texts with units.
    frequency : float or str, optional
        Hz, or text with a unit; needed unless it is the parameter.
    searches : int
        Number of values at which motions are searched from rest and from the steady state of the linear structure.
    progress : callable, optional
        Called with the number of orbits computed so far.

    Raises
    ------
    SceneError
        If the parameter or its range is invalid.
    """
    ends = parameter_values(parameter, bounds)
    if ends.size != 2 or not ends[0] < ends[1]:
        raise SceneError(
            f"bounds: got {', '.join(f'{end:g}' for end in ends)}; expected two rising values above 0"
        )
    low, high = ends.tolist()
    problem = OrbitProblem(scene_of(scene))
    base = problem.setting(base_frequency(parameter, frequency, low))
    explorer = _Explorer(problem, base, parameter, (low, high), progress)
    for value in np.linspace(low, high, searches + 2)[1:-1]:
        explorer.search(float(value))
    return OrbitCurve(tuple(explorer.branches), tuple(dict.fromkeys(explorer.failures)))


class _Explorer:
    """Search for branches from starting motions and from the borders of known branches."""

    def __init__(
        self,
        problem: OrbitProblem,
        base: OperatingPoint,
        parameter: Parameter,
        bounds: tuple[float, float],
        progress: Callable[[int], None] | None,
    ) -> None:
        self.problem, self.parameter, self.bounds = problem, parameter, bounds
        self.base, self.at = base, vary(base, parameter)
        self.progress = progress
        self.branches: list[OrbitBranch] = []
        self.failures: list[str] = []

    def search(self, value: float) -> None:
        """Add the branches reached from rest and from the linear steady state, and all adjacent branches."""
        for moving in (False, True):
            try:
                propagator, _ = start_march(self.problem, self.at(value), moving)
                self._add(search(self.problem, self.at(value), propagator))
            except RunError as failure:
                self.failures.append(f"at {self.parameter} {value:.6g}: {failure}")

    def _add(self, orbit: Orbit) -> None:
        """Follow an orbit unless it lies on a known branch; then continue beyond the borders of the new branch."""
        waiting = [orbit]
        while waiting:
            start = waiting.pop(0)
            if len(self.branches) == MOST:
                self.failures.append(
                    f"{MOST} branches followed, but not the one through {self.parameter} "
                    f"{getattr(start.setting, self.parameter):.8g} [{start.plan.label}] and what lies beyond"
                )
                return
            if any(self._holds(branch, start) for branch in self.branches):
                continue
            branch = self._follow(start)
            self.branches.append(branch)
            if self.progress is not None:
                self.progress(sum(len(b.orbits) for b in self.branches))
            for index in self._losses(branch):
                waiting += self._shaken(branch.orbits[index])
            for side in (0, 1):
                beyond = self._beyond(branch, side)
                if beyond is not None:
                    waiting.append(beyond)

    def _follow(self, start: Orbit) -> OrbitBranch:
        following = Following(self.problem, start.plan, start.setting, self.parameter, start.unknowns)
        x = np.append(start.unknowns, getattr(start.setting, self.parameter))
        curve = continuation.trace(following, x, self.bounds, following.scale, STEPS, following.margins)
        orbits = tuple(following.orbit(x) for x in curve.points)
        return OrbitBranch(
            parameter=self.parameter,
            value=curve.points[:, -1],
            orbits=orbits,
            ends=curve.ends,
            folds=_located(following, curve, curve.folds, lambda x, way: float(way[-1])),
            doublings=_crossings(following, curve, orbits, _minus_one),
            toruses=_crossings(following, curve, orbits, _pair),
            plan=start.plan,
            curve=curve,
        )

    def _losses(self, branch: OrbitBranch) -> list[int]:
        """Return the points just after a loss of stability that is not at a fold."""
        found = []
        for value in (*branch.doublings, *branch.toruses):
            for i in np.flatnonzero((branch.value[:-1] - value) * (branch.value[1:] - value) <= 0).tolist():
                stable = branch.orbits[i].stable, branch.orbits[i + 1].stable
                if stable[0] != stable[1]:
                    found.append(i + 1 if stable[0] else i)
        return found

    def _shaken(self, orbit: Orbit) -> list[Orbit]:
        """Simulate from a perturbed unstable orbit and return the orbit to which it settles, if any."""
        propagator, _ = start_march(self.problem, orbit.setting)
        enter(propagator, orbit)
        n = propagator.system.states
        propagator.state.z[:n] *= 1 + 1e-5 * np.cos(np.arange(n))
        try:
            return [search(self.problem, orbit.setting, propagator)]
        except RunError as failure:
            value = getattr(orbit.setting, self.parameter)
            self.failures.append(
                f"where Type {orbit.motion_type} is unstable, {self.parameter} {value:.8g}: {failure}"
            )
            return []

    def _holds(self, branch: OrbitBranch, orbit: Orbit) -> bool:
        """Whether an orbit lies on a branch: same events, and same response after interpolation."""
        if not branch.plan.same_cycle(orbit.plan):
            return False
        offset = branch.value - getattr(orbit.setting, self.parameter)
        near = np.flatnonzero(offset[:-1] * offset[1:] <= 0).tolist()
        # The search from an adjacent branch's border starts just beyond an end of this branch.
        if abs(offset[0]) < 1e-3 * abs(branch.value[0]):
            near.append(0)
        if abs(offset[-1]) < 1e-3 * abs(branch.value[-1]):
            near.append(len(offset) - 2)
        responses = branch.compliance
        size = np.abs(orbit.compliance).max()
        for i in near:
            if i < 0 or len(offset) < 2:
                return bool(np.abs(responses[:, 0] - orbit.compliance).max() < 0.02 * size)
            share = offset[i] / (offset[i] - offset[i + 1]) if offset[i] != offset[i + 1] else 0.0
            there = responses[:, i] + share * (responses[:, i + 1] - responses[:, i])
            if np.abs(there - orbit.compliance).max() < 0.01 * size:
                return True
        return False

    def _beyond(self, branch: OrbitBranch, side: int) -> Orbit | None:
        """Return the orbit on the other side of a branch's end, if the end is a border."""
        end = branch.ends[side]
        last = branch.orbits[0 if side == 0 else -1]
        value = float(branch.value[0 if side == 0 else -1])
        if end in ("range", "closed"):
            return None
        where = f"at {self.parameter} {value:.8g} (Type {last.motion_type}, events [{last.plan.label}])"
        if end.startswith("no convergence") or end == "points":
            self.failures.append(f"{where}: {end}")
        tangent = branch.curve.tangents[0 if side == 0 else -1]
        way = np.sign(tangent[-1]) * (1 if side == 1 else -1)
        try:
            return self._run_on(last, value, float(way))
        except RunError as failure:
            self.failures.append(f"beyond {where}, where {end}: {failure}")
            return None

    def _run_on(self, orbit: Orbit, value: float, way: float) -> Orbit:
        """Return the orbit beyond a border: the nearest orbit, otherwise the orbit to which the motion settles."""
        # At a border the curve may turn back in the parameter, so that the nearest orbit may lie on either side.
        for past in (BEYOND, -BEYOND, 10 * BEYOND, -10 * BEYOND):
            target = value * (1 + way * past)
            if not self.bounds[0] <= target <= self.bounds[1]:
                continue
            setting = self.at(target)
            propagator, steps = start_march(self.problem, setting)
            enter(propagator, orbit)
            for _ in range(3):
                try:
                    found = refine(self.problem, setting, propagator, steps, orbit.repetition)
                except RunError:
                    continue
                close = (
                    np.abs(found.compliance - orbit.compliance).max() < 0.05 * np.abs(orbit.compliance).max()
                )
                if close and not found.flaw and not found.plan.same_cycle(orbit.plan):
                    return found
        # Close to the border, the new event may be too small to detect in a motion settled to 1e-7.
        for past in FARTHER[:-1]:
            try:
                return self._settled_past(orbit, value, way * past)
            except RunError:
                continue
        return self._settled_past(orbit, value, way * FARTHER[-1])

    def _settled_past(self, orbit: Orbit, value: float, past: float) -> Orbit:
        setting = self.at(float(np.clip(value * (1 + past), *self.bounds)))
        propagator, _ = start_march(self.problem, setting)
        enter(propagator, orbit)
        return search(self.problem, setting, propagator)


def _minus_one(multipliers: NDArray[np.complex128]) -> float:
    """Return a value that changes sign where a multiplier passes -1 (period doubling)."""
    return float(np.prod(1 + multipliers).real)


def _pair(multipliers: NDArray[np.complex128]) -> float:
    """Return a value that is positive if a complex pair is outside the unit circle (torus bifurcation)."""
    pairs = multipliers[np.abs(multipliers.imag) > 1e-9]
    return float(np.abs(pairs).max(initial=0.5) - 1)


def _crossings(
    following: Following,
    curve: continuation.Curve,
    orbits: tuple[Orbit, ...],
    test: Callable[[NDArray[np.complex128]], float],
) -> Array:
    values = np.array([test(orbit.multipliers) for orbit in orbits])
    where = np.flatnonzero(values[:-1] * values[1:] < 0)
    return _located(following, curve, where, lambda x, way: test(following.multipliers(x)))


def _located(
    following: Following, curve: continuation.Curve, where: NDArray[np.int64], monitor: continuation.Monitor
) -> Array:
    """Return parameter values at which a monitor changes sign; the middle of the step if it cannot be bracketed."""
    found = []
    for i in where:
        try:
            found.append(continuation.locate(following, curve, int(i), monitor)[0][-1])
        except continuation.NoConvergence:
            found.append(curve.points[i : i + 2, -1].mean())
    return np.array(found)
