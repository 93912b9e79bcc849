"""Pseudo-arclength continuation: a curve of solutions is computed through its folds.

The curve is defined by n equations in n + 1 unknowns. The last unknown is the parameter (a frequency, a force, a
clearance). Steps are measured along the curve, so that a fold, where the curve reverses its direction in the parameter,
is a regular point. A curve may end at a *border*, beyond which its solutions have no meaning. The *margin* is the
distance from a border, negative beyond it. The result always states why the curve ended.

References
----------
Seydel, R., "Practical Bifurcation and Stability Analysis", Springer 2010, chapter 4.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

Vector = NDArray[np.float64]
# x (n + 1,) -> residual (n,), jacobian (n, n + 1)
Equations = Callable[[Vector], tuple[Vector, Vector]]
# x (n + 1,), unit tangent (n + 1,) -> quantity whose zero is to be located
TestFunction = Callable[[Vector, Vector], float]
# x (n + 1,) -> margin to each border (negative outside), and the borders' names
Margins = Callable[[Vector], tuple[Vector, Sequence[str]]]
# A point (n + 1,) and the curve's unit tangent there (n + 1,)
PointWithTangent = tuple[Vector, Vector]

# Tolerance of the distance of the last point from a border, relative to the chord across the border.
BORDER_TOLERANCE = 1e-9
# Reason for the end of a curve with `Steps.max_points`.
POINT_LIMIT = "the largest number of points is reached"


@dataclass(frozen=True)
class Steps:
    """Step control of a continuation; arclengths are in units of the scaled unknowns."""

    first_step: float = 1e-2
    min_step: float = 1e-8
    max_step: float = 0.2
    max_angle_rad: float = 0.15
    """Largest angle between the tangents of neighboring points."""
    tolerance: float = 1e-11
    """Newton's iteration ends when its largest correction (scaled unknowns) is below this."""
    max_iterations: int = 8
    """Maximum number of corrections of a point; after these the step is reduced."""
    max_points: int = 4000
    """Maximum number of points on one side of the start."""


@dataclass
class Curve:
    """Points on a curve of solutions, in order."""

    points: Vector
    """The unknowns and, last, the parameter; shape (points, n + 1)."""
    tangents: Vector
    """Unit tangents in scaled unknowns, in the order of the points; shape (points, n + 1)."""
    ends: tuple[str, str] = ("", "")
    """Reasons for the ends before the first and after the last point: ``"range"`` (end of the parameter's range),
    ``"closed"`` (back at the start), `POINT_LIMIT`, ``"no convergence: ..."``, or the name of a border."""
    scale: Vector = field(default_factory=lambda: np.ones(0))
    """Magnitude of each unknown; unknowns divided by it are the scaled unknowns; shape (n + 1,)."""

    @property
    def folds(self) -> NDArray[np.int64]:
        """Indices i for which the curve has a fold between points i and i + 1."""
        return np.flatnonzero(self.tangents[:-1, -1] * self.tangents[1:, -1] < 0)


class NoConvergence(Exception):
    """Newton's iteration did not converge; the message gives the reason."""


def newton(equations: Equations, x: Vector, scale: Vector, steps: Steps, normal: Vector) -> tuple[Vector, Vector, int]:
    """Solve the equations on the plane that contains `x` and is perpendicular to `normal` (scaled unknowns).

    Returns `x`, shape (n + 1,), the solution; `tangent`, shape (n + 1,), unit tangent of the curve (scaled unknowns)
    from the last iteration, in the direction of `normal`; `iterations`, number of corrections. Raises `NoConvergence`
    with the size of the last correction.
    """
    start, last_correction = x, np.inf
    system, rhs = np.empty((x.size, x.size)), np.zeros((x.size, 2))
    system[-1], rhs[-1, 1] = normal, 1.0
    for iteration in range(1, steps.max_iterations + 1):
        # A diverging iteration may overflow; the test for finite numbers below ends it.
        with np.errstate(all="ignore"):
            residual, jacobian = equations(x)
        system[:-1] = jacobian * scale
        rhs[:-1, 0], rhs[-1, 0] = -residual, -normal @ ((x - start) / scale)
        if not (np.isfinite(system).all() and np.isfinite(rhs).all()):
            raise NoConvergence("the equations have values that are not finite")
        try:
            correction, direction = np.linalg.solve(system, rhs).T
        except np.linalg.LinAlgError:
            raise NoConvergence("the Jacobian matrix is singular") from None
        largest_correction = float(np.abs(correction).max())
        x = x + correction * scale
        # The iteration has converged if the correction is within the tolerance, if it no longer decreases, or if the
        # next correction would be within the tolerance because convergence is quadratic.
        stalled = largest_correction < 1e-9 and largest_correction > 0.3 * last_correction
        quadratic = last_correction < 1.0 and largest_correction**3 < steps.tolerance * last_correction**2
        if largest_correction < steps.tolerance or stalled or quadratic:
            return x, direction / np.linalg.norm(direction), iteration
        if largest_correction > 1e3 * max(last_correction, 1e-3):
            raise NoConvergence(f"Newton's method diverges (last correction {largest_correction:.1e})")
        last_correction = largest_correction
    raise NoConvergence(f"Newton's correction is still {last_correction:.1e} after {steps.max_iterations} iterations")


def tangent(equations: Equations, x: Vector, scale: Vector) -> Vector:
    """Return the unit tangent of the curve at `x` (scaled unknowns), in the direction of increasing parameter."""
    _, jacobian = equations(x)
    null = np.linalg.svd(jacobian * scale)[2][-1]
    return null if null[-1] >= 0 else -null


def solve_with_tangent(
    equations: Equations, x: Vector, parameter: float, scale: Vector, steps: Steps | None = None
) -> tuple[Vector, Vector]:
    """Solve the equations for a given value of the parameter, starting from `x`.

    Returns `x`, shape (n + 1,); `tangent`, shape (n + 1,), its unit tangent, in the direction of increasing parameter.
    Raises `NoConvergence` if Newton's iteration does not converge.
    """
    normal = np.zeros(x.size)
    normal[-1] = 1.0
    x = x.copy()
    x[-1] = parameter
    solution, direction, _ = newton(equations, x, scale, steps or Steps(), normal)
    solution[-1] = parameter
    return solution, direction


def solve_at(equations: Equations, x: Vector, parameter: float, scale: Vector, steps: Steps | None = None) -> Vector:
    """Solve the equations for a given value of the parameter by `solve_with_tangent`; return only the solution."""
    return solve_with_tangent(equations, x, parameter, scale, steps)[0]


def trace(
    equations: Equations,
    start: Vector,
    bounds: tuple[float, float],
    scale: Vector,
    steps: Steps | None = None,
    margins: Margins = lambda x: (np.ones(1), ("",)),
) -> Curve:
    """Compute the curve through a solution in both directions.

    `equations`: x -> residual (n,), jacobian (n, n + 1); the parameter is the last element of x.
    `start`, shape (n + 1,): a solution. `bounds`: range of the parameter; the curve ends there exactly.
    `scale`, shape (n + 1,): magnitude of each unknown, in which arclength is measured.
    `margins`: x -> margin to each border, negative outside the curve, and the borders' names. A margin changes smoothly
    across its border, so that the last point of the curve is on the border.

    Returns the curve in the direction of increasing parameter at the start.
    """
    steps = steps or Steps()
    start_tangent = tangent(equations, start, scale)
    forward, end = _trace_one_way(equations, start, start_tangent, bounds, scale, steps, margins)
    if end == "closed":
        return Curve(*_columns(forward), (end, end), scale)
    backward, begin = _trace_one_way(equations, start, -start_tangent, bounds, scale, steps, margins)
    reverse = [(x, -t) for x, t in reversed(backward[1:])]
    return Curve(*_columns(reverse + forward), (begin, end), scale)


def _columns(pairs: list[PointWithTangent]) -> tuple[Vector, Vector]:
    """Return the points and the tangents of a list as two arrays."""
    return np.array([x for x, _ in pairs]), np.array([t for _, t in pairs])


def _trace_one_way(
    equations: Equations,
    start: Vector,
    direction: Vector,
    bounds: tuple[float, float],
    scale: Vector,
    steps: Steps,
    margins: Margins,
) -> tuple[list[PointWithTangent], str]:
    """Compute the curve in one direction; return its points with tangents, and the reason of its end."""
    path = [(start, direction)]
    step, arclength = steps.first_step, 0.0
    margin, border_names = margins(start)
    while len(path) < steps.max_points:
        x, x_tangent = path[-1]
        if margin.min() < 0:
            return path, border_names[int(margin.argmin())]
        try:
            new_x, new_tangent, iterations = newton(equations, _predict(path, step, scale), scale, steps, x_tangent)
            # If the point is more than half a step from the tangent's end, it may be on another curve.
            is_far = float(np.linalg.norm((new_x - x) / scale - step * x_tangent)) > 0.5 * step
            if is_far and step > steps.min_step:
                raise NoConvergence("Newton's correction leads away from the curve")
        except NoConvergence as failure:
            if step <= steps.min_step:
                return path, f"no convergence: {failure} at parameter {x[-1]:.9g}"
            step /= 3
            continue
        angle = float(np.arccos(np.clip(new_tangent @ x_tangent, -1.0, 1.0)))
        if angle > steps.max_angle_rad:
            if step <= steps.min_step:
                return path, f"no convergence: the curve turns by {angle:.2g} rad at parameter {x[-1]:.9g}"
            step = max(step * max(0.2, 0.7 * steps.max_angle_rad / angle), steps.min_step)
            continue
        end = ""
        if not bounds[0] <= new_x[-1] <= bounds[1]:
            bound = bounds[0] if new_x[-1] < bounds[0] else bounds[1]
            try:
                new_x, new_tangent = solve_with_tangent(
                    equations, _interpolate(path[-1], (new_x, new_tangent), bound), bound, scale, steps
                )
            except NoConvergence as failure:
                return path, f"no convergence: {failure} at parameter {bound:.9g}, the end of its range"
            new_tangent, end = new_tangent if new_tangent @ x_tangent > 0 else -new_tangent, "range"
        new_margin, _ = margins(new_x)
        if new_margin.min() < 0:
            try:
                border_point, index = _locate_border(equations, (x, margin), (new_x, new_margin), scale, steps, margins)
            except NoConvergence as failure:
                if step <= steps.min_step:
                    return path, f"no convergence: {failure} at parameter {x[-1]:.9g}"
                step /= 4
                continue
            path.append(border_point)
            return path, border_names[index]
        # The curve is closed if the next step would pass the start in the same direction.
        to_start = (start - new_x) / scale
        if arclength > 4 * step and np.linalg.norm(to_start) < 0.6 * step and x_tangent @ direction > 0.5:
            return path, "closed"
        path.append((new_x, new_tangent))
        if end:
            return path, end
        margin = new_margin
        arclength += step
        # Few corrections and a small angle permit a longer step; many corrections require a shorter one.
        if iterations <= 3 and angle < 0.5 * steps.max_angle_rad:
            step = min(2.0 * step, steps.max_step)
        elif iterations >= 6:
            step = max(0.5 * step, steps.min_step)
    return path, POINT_LIMIT


def _predict(path: list[PointWithTangent], step: float, scale: Vector) -> Vector:
    """Predict the point after a step, by extrapolation of the cubic through the last two points with their tangents."""
    x, x_tangent = path[-1]
    prediction = x + step * x_tangent * scale
    if len(path) > 1:
        previous, previous_tangent = path[-2]
        chord = (previous - x) / scale
        length = float(np.linalg.norm(chord))
        # The cubic's parameter t is 0 at the last point and -1 at the previous point.
        deviation, bend = chord + length * x_tangent, length * (previous_tangent - x_tangent)
        t = step / length
        prediction += t * t * (3 * deviation + bend + t * (bend + 2 * deviation)) * scale
    return prediction


def _interpolate(left: PointWithTangent, right: PointWithTangent, parameter: float) -> Vector:
    """Interpolate between two points of a curve at a value of the parameter."""
    fraction = (parameter - left[0][-1]) / (right[0][-1] - left[0][-1])
    return np.asarray(left[0] + fraction * (right[0] - left[0]))


def _locate_border(
    equations: Equations,
    inside: tuple[Vector, Vector],
    outside: tuple[Vector, Vector],
    scale: Vector,
    steps: Steps,
    margins: Margins,
) -> tuple[PointWithTangent, int]:
    """Return the last point of a curve before a border, and the index of this border.

    `inside` and `outside` are points on both sides, with their margins. Points of the chord between them are corrected
    to the curve, until the margin of the border that is crossed first vanishes.
    """
    chord = (outside[0] - inside[0]) / scale
    length = float(np.linalg.norm(chord))
    normal = chord / length

    def correct(distance: float) -> PointWithTangent:
        return newton(equations, inside[0] + distance * normal * scale, scale, steps, normal)[:2]

    def margin_at(distance: float, index: int) -> float:
        return float(margins(correct(distance)[0])[0][index])

    end, end_margin = length, outside[1]
    while True:
        crossed = np.flatnonzero(end_margin < 0)
        fractions = inside[1][crossed] / (inside[1][crossed] - end_margin[crossed])
        index = int(crossed[fractions.argmin()])
        try:
            distance = brentq(margin_at, 0.0, end, args=(index,), xtol=BORDER_TOLERANCE * end)
        except ValueError as failure:
            # From the chord, the correction leads to another point beyond the border than from the tangent.
            raise NoConvergence("the curve does not cross the border on its chord") from failure
        # The point must be on the inner side of the border.
        distance = max(0.0, distance - 2 * BORDER_TOLERANCE * end)
        border_point = correct(distance)
        border_margin = margins(border_point[0])[0]
        if border_margin.min() >= 0 or distance == 0.0:
            return border_point, index
        end, end_margin = distance, border_margin


def locate(
    equations: Equations, curve: Curve, index: int, test_function: TestFunction, steps: Steps | None = None
) -> tuple[Vector, Vector]:
    """Locate the zero of a test function between two neighboring points of a curve.

    Points of the chord between them are corrected to the curve, and the zero is found by Brent's method.

    Returns `x, tangent`, shape (n + 1,), the point and its unit tangent. Raises `NoConvergence` if a point of the chord
    cannot be corrected to the curve, or the test function has the same sign at both points.
    """
    steps = steps or Steps()
    first, scale = curve.points[index], curve.scale
    chord = (curve.points[index + 1] - first) / scale
    length = float(np.linalg.norm(chord))
    normal = chord / length

    def correct(distance: float) -> PointWithTangent:
        return newton(equations, first + distance * normal * scale, scale, steps, normal)[:2]

    values = [test_function(curve.points[i], curve.tangents[i]) for i in (index, index + 1)]
    if not values[0] * values[1] < 0:
        raise NoConvergence("the test function does not change sign between the two points")
    try:
        distance = brentq(lambda d: test_function(*correct(d)), 0.0, length, xtol=1e-11 * length, rtol=1e-11)
    except ValueError:
        raise NoConvergence("the test function is zero at one of the points, or discontinuous") from None
    return correct(distance)


def locate_folds(equations: Equations, curve: Curve, steps: Steps | None = None) -> Vector:
    """Locate the folds of a curve, shape (folds, n + 1)."""
    folds = [locate(equations, curve, int(i), lambda x, tangent: float(tangent[-1]), steps)[0] for i in curve.folds]
    return np.array(folds).reshape(-1, curve.points.shape[1])
