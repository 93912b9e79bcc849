"""Curves of exact orbits (periodic motions) over frequency, force, clearance or mass ratio, stable and unstable.

A *branch* is a curve of orbits with one sequence of events (*plan*). Continuation follows it through folds to the end
of the range or to a *border*, where the sequence becomes impossible: a grazing impact, a release, a contact of zero
duration, or two events that change order. Beyond the border another sequence is valid. This sequence is identified by
simulation from the border, and is then continued in the same way. A *setting* is an operating point: the values of all
parameters.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from rig.core.base.arrays import Array
from rig.core.base.errors import RunError, SceneError
from rig.core.numerics import continuation
from rig.core.orbits.orbit import Orbit, OrbitFamily
from rig.core.orbits.orbit_curve import OrbitBranch, OrbitCurve
from rig.core.orbits.periodic_orbit import refine_orbit, search_orbit, set_to_orbit, start_propagator
from rig.core.orbits.problem import Axis, OperatingPoint, OrbitProblem, Parameter, base_frequency, vary
from rig.core.scene.loading import SceneLike, scene_of

# Step control of the continuation; lengths are in scaled unknowns (`OrbitFamily.scale`).
STEPS = continuation.Steps(first_step=5e-3, max_step=0.25, max_angle_rad=0.12, min_step=1e-7, max_points=1500)
# Step past a border, relative to the parameter, at which Newton's iteration for the next orbit starts.
BORDER_STEP = 2e-6
# Steps past a border, relative to the parameter, at which the motion is simulated until it is steady.
SIMULATED_BORDER_STEPS = (2e-5, 3e-4, 3e-3)
# Maximum number of branches: near irregular motion there are infinitely many.
MAX_BRANCHES = 60
# Orbits whose responses differ by less than this fraction are identical: on a branch of several points, and on a branch
# of one point.
SAME_RESPONSE, SAME_POINT_RESPONSE = 0.01, 0.02
# An orbit beyond a border is the neighbor of the orbit at the border if their responses differ by at most this
# fraction.
NEIGHBOR_RESPONSE = 0.05
# An orbit is compared with the end of a branch at this distance from the end, relative to the parameter.
END_DISTANCE = 1e-3


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
    parameter : {'frequency', 'force', 'drive', 'clearance', 'mass_ratio'}
        Varied parameter: Hz, level of the scene's test (a force, N, or a drive in the unit of the shaker's drive),
        clearance of all dampers [m], factor on their masses.
    bounds : tuple of float or str
        Range of the parameter, in SI or as strings with units.
    frequency : float or str, optional
        Hz, or text with a unit; needed unless it is the parameter.
    searches : int
        Number of values at which motions are searched from rest and from the steady state of the linear structure.
    progress : callable, optional
        Called with the number of orbits computed so far.

    Returns
    -------
    OrbitCurve
        All branches that were found, with their stability and folds.

    Raises
    ------
    SceneError
        If the parameter or its range is invalid.
    """
    problem = OrbitProblem(scene_of(scene))
    axis = problem.axis(parameter)
    limits = axis.values(bounds)
    if limits.size != 2 or not limits[0] < limits[1]:
        raise SceneError(
            f"bounds: got {', '.join(f'{limit:g}' for limit in limits)}; expected two ascending values above 0"
        )
    low, high = limits.tolist()
    base = problem.setting(base_frequency(axis, frequency, low))
    explorer = _Explorer(problem, base, axis, (low, high), progress)
    for value in np.linspace(low, high, searches + 2)[1:-1]:
        explorer.search(float(value))
    return OrbitCurve(tuple(explorer.branches), tuple(dict.fromkeys(explorer.failures)))


class _Explorer:
    """Search for branches from starting motions and from the borders of known branches."""

    def __init__(
        self,
        problem: OrbitProblem,
        base: OperatingPoint,
        axis: Axis,
        bounds: tuple[float, float],
        progress: Callable[[int], None] | None,
    ) -> None:
        self.problem, self.axis, self.bounds = problem, axis, bounds
        self.base, self.setting_at = base, vary(base, axis.field)
        self.progress = progress
        self.branches: list[OrbitBranch] = []
        self.failures: list[str] = []

    def search(self, value: float) -> None:
        """Add the branches reached from rest and from the linear steady state, and all adjacent branches."""
        for from_linear_response in (False, True):
            try:
                propagator, _ = start_propagator(self.problem, self.setting_at(value), from_linear_response)
                self._add(search_orbit(self.problem, self.setting_at(value), propagator))
            except RunError as failure:
                self.failures.append(f"at {self.axis.name} {value:.6g}: {failure}")

    def _add(self, orbit: Orbit) -> None:
        """Follow an orbit unless it lies on a known branch; then continue beyond the borders of the new branch."""
        queue = [orbit]
        while queue:
            start = queue.pop(0)
            if len(self.branches) == MAX_BRANCHES:
                self.failures.append(
                    f"stopped after {MAX_BRANCHES} branches: the branch through {self.axis.name} "
                    f"{getattr(start.operating_point, self.axis.field):.8g} (events [{start.plan.label}]) and adjacent "
                    "branches are missing. Choose narrower bounds."
                )
                return
            if any(self._contains(branch, start) for branch in self.branches):
                continue
            branch = self._continue(start)
            self.branches.append(branch)
            if self.progress is not None:
                self.progress(sum(len(b.orbits) for b in self.branches))
            for index in self._stability_losses(branch):
                queue += self._simulate_perturbed(branch.orbits[index])
            for at_end in (False, True):
                neighbor = self._cross_border(branch, at_end)
                if neighbor is not None:
                    queue.append(neighbor)

    def _continue(self, start: Orbit) -> OrbitBranch:
        """Follow the branch through an orbit in both directions."""
        family = OrbitFamily(self.problem, start.plan, start.operating_point, self.axis.field, start.unknowns)
        x = np.append(start.unknowns, getattr(start.operating_point, self.axis.field))
        curve = continuation.trace(family, x, self.bounds, family.scale, STEPS, family.margins)
        orbits = tuple(family.orbit(x) for x in curve.points)
        return OrbitBranch(
            axis=self.axis,
            value=curve.points[:, -1],
            orbits=orbits,
            ends=curve.ends,
            folds=_locate(family, curve, curve.folds, lambda x, direction: float(direction[-1])),
            doublings=_locate_bifurcations(family, curve, orbits, _period_doubling_test),
            toruses=_locate_bifurcations(family, curve, orbits, _torus_test),
            plan=start.plan,
            curve=curve,
        )

    def _stability_losses(self, branch: OrbitBranch) -> list[int]:
        """Return the indices of unstable orbits that are next to a loss of stability, except at folds."""
        unstable_indices = []
        for value in (*branch.doublings, *branch.toruses):
            for i in np.flatnonzero((branch.value[:-1] - value) * (branch.value[1:] - value) <= 0).tolist():
                stable = branch.orbits[i].stable, branch.orbits[i + 1].stable
                if stable[0] != stable[1]:
                    unstable_indices.append(i + 1 if stable[0] else i)
        return unstable_indices

    def _simulate_perturbed(self, orbit: Orbit) -> list[Orbit]:
        """Simulate from a perturbed unstable orbit; return the orbit to which the motion settles, or an empty list."""
        propagator, _ = start_propagator(self.problem, orbit.operating_point)
        set_to_orbit(propagator, orbit)
        n = propagator.system.states
        # Relative changes up to 1e-5, different for each state.
        propagator.state.z[:n] *= 1 + 1e-5 * np.cos(np.arange(n))
        try:
            return [search_orbit(self.problem, orbit.operating_point, propagator)]
        except RunError as failure:
            value = getattr(orbit.operating_point, self.axis.field)
            self.failures.append(f"where Type {orbit.motion_type} is unstable, {self.axis.name} {value:.8g}: {failure}")
            return []

    def _contains(self, branch: OrbitBranch, orbit: Orbit) -> bool:
        """Return whether an orbit lies on a branch: same events, and same response after interpolation."""
        if not branch.plan.has_same_cycle(orbit.plan):
            return False
        offset = branch.value - getattr(orbit.operating_point, self.axis.field)
        segments = np.flatnonzero(offset[:-1] * offset[1:] <= 0).tolist()
        # An orbit computed beyond the border of the adjacent branch can lie slightly outside the range of this branch.
        if abs(offset[0]) < END_DISTANCE * abs(branch.value[0]):
            segments.append(0)
        if abs(offset[-1]) < END_DISTANCE * abs(branch.value[-1]):
            segments.append(len(offset) - 2)
        responses = branch.frf
        magnitude = np.abs(orbit.frf).max()
        for i in segments:
            if i < 0 or len(offset) < 2:
                return bool(np.abs(responses[:, 0] - orbit.frf).max() < SAME_POINT_RESPONSE * magnitude)
            ratio = offset[i] / (offset[i] - offset[i + 1]) if offset[i] != offset[i + 1] else 0.0
            interpolated = responses[:, i] + ratio * (responses[:, i + 1] - responses[:, i])
            if np.abs(interpolated - orbit.frf).max() < SAME_RESPONSE * magnitude:
                return True
        return False

    def _cross_border(self, branch: OrbitBranch, at_end: bool) -> Orbit | None:
        """Return the orbit beyond the first point (or `at_end` the last) of a branch, if this is on a border."""
        index = -1 if at_end else 0
        reason, orbit, value = branch.ends[index], branch.orbits[index], float(branch.value[index])
        if reason in ("range", "closed"):
            return None
        location = f"at {self.axis.name} {value:.8g} (Type {orbit.motion_type}, events [{orbit.plan.label}])"
        if reason.startswith("no convergence") or reason == continuation.POINT_LIMIT:
            self.failures.append(f"{location}: {reason}")
        direction = np.sign(branch.curve.tangents[index, -1]) * (1 if at_end else -1)
        try:
            return self._orbit_past_border(orbit, value, float(direction))
        except RunError as failure:
            self.failures.append(f"not continued beyond the end of a branch {location} ({reason}): {failure}")
            return None

    def _orbit_past_border(self, orbit: Orbit, value: float, direction: float) -> Orbit:
        """Return the orbit beyond a border: the nearest orbit, otherwise the orbit to which the motion settles.

        `direction`: sign of the change of the parameter across the border.
        """
        # At a border the curve may turn back in the parameter, so the nearest orbit may lie on either side.
        for step in (BORDER_STEP, -BORDER_STEP, 10 * BORDER_STEP, -10 * BORDER_STEP):
            target = value * (1 + direction * step)
            if not self.bounds[0] <= target <= self.bounds[1]:
                continue
            setting = self.setting_at(target)
            propagator, steps = start_propagator(self.problem, setting)
            set_to_orbit(propagator, orbit)
            # Every attempt simulates one more cycle.
            for _ in range(3):
                try:
                    candidate = refine_orbit(self.problem, setting, propagator, steps, orbit.repetition)
                except RunError:
                    continue
                is_close = np.abs(candidate.frf - orbit.frf).max() < NEIGHBOR_RESPONSE * np.abs(orbit.frf).max()
                if is_close and not candidate.flaw and not candidate.plan.has_same_cycle(orbit.plan):
                    return candidate
        # Close to the border, the new event may be too weak to be detected in a motion that is steady to 1e-7.
        for step in SIMULATED_BORDER_STEPS[:-1]:
            try:
                return self._simulate_past_border(orbit, value, direction * step)
            except RunError:
                continue
        return self._simulate_past_border(orbit, value, direction * SIMULATED_BORDER_STEPS[-1])

    def _simulate_past_border(self, orbit: Orbit, value: float, step: float) -> Orbit:
        """Simulate from an orbit until the motion settles to another; `step`: relative change of the parameter."""
        setting = self.setting_at(float(np.clip(value * (1 + step), *self.bounds)))
        propagator, _ = start_propagator(self.problem, setting)
        set_to_orbit(propagator, orbit)
        return search_orbit(self.problem, setting, propagator)


def _period_doubling_test(multipliers: NDArray[np.complex128]) -> float:
    """Return a test value that changes sign where a multiplier passes -1 (period doubling)."""
    return float(np.prod(1 + multipliers).real)


def _torus_test(multipliers: NDArray[np.complex128]) -> float:
    """Return a value that is positive if a complex pair is outside the unit circle (torus bifurcation)."""
    pairs = multipliers[np.abs(multipliers.imag) > 1e-9]
    return float(np.abs(pairs).max(initial=0.5) - 1)


def _locate_bifurcations(
    family: OrbitFamily,
    curve: continuation.Curve,
    orbits: tuple[Orbit, ...],
    test: Callable[[NDArray[np.complex128]], float],
) -> Array:
    """Return the parameter values at which a test function of the Floquet multipliers changes sign."""
    values = np.array([test(orbit.multipliers) for orbit in orbits])
    segments = np.flatnonzero(values[:-1] * values[1:] < 0)
    return _locate(family, curve, segments, lambda x, tangent: test(family.multipliers(x)))


def _locate(
    family: OrbitFamily, curve: continuation.Curve, segments: NDArray[np.int64], test: continuation.TestFunction
) -> Array:
    """Return parameter values at which a test function changes sign; the middle of the step if it cannot be located."""
    values = []
    for i in segments:
        try:
            values.append(continuation.locate(family, curve, int(i), test)[0][-1])
        except continuation.NoConvergence:
            values.append(curve.points[i : i + 2, -1].mean())
    return np.array(values)
