"""Follow a curve of solutions through its folds: pseudo-arclength continuation.

The curve is given by n equations in n + 1 unknowns, the last of which is the parameter that is followed (a
frequency, a force, a clearance). Steps are measured along the curve, so that a fold, where the curve turns
back in the parameter, is a point like any other. A trace always says why it ended, and a failure says where,
with the last good point; a branch never just stops.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

Vector = NDArray[np.float64]
# x (n + 1,) -> residual (n,), jacobian (n, n + 1)
Equations = Callable[[Vector], tuple[Vector, Vector]]
# x (n + 1,), unit tangent (n + 1,) -> a number whose sign change is looked for
Monitor = Callable[[Vector, Vector], float]
# x (n + 1,) -> margin to each border (negative beyond it), and the borders' names
Margins = Callable[[Vector], tuple[Vector, Sequence[str]]]


# How near to a border the last point before it lies, relative to the step there.
NEAR_BORDER = 1e-9


@dataclass(frozen=True)
class Steps:
    """How a curve is stepped along; lengths are in units of the scaled unknowns."""

    first: float = 1e-2
    shortest: float = 1e-8
    longest: float = 0.2
    """Arclength of the first step, and the bounds of all others."""
    turn: float = 0.15
    """Largest angle, in radians, between the tangents of neighbouring points."""
    tolerance: float = 1e-11
    """Newton's iteration ends when its last correction is below this (scaled unknowns)."""
    iterations: int = 8
    """Corrections allowed a point before the step is halved."""
    points: int = 4000
    """Most points on one side of the start."""


@dataclass
class Curve:
    """Points on a curve of solutions, in order."""

    points: Vector
    """The unknowns and, last, the parameter; shape (points, n + 1)."""
    tangents: Vector
    """Unit tangents in scaled unknowns, all in the direction of travel; shape (points, n + 1)."""
    ends: tuple[str, str] = ("", "")
    """Why the curve stops before its first and after its last point: ``"range"`` (the parameter left its
    range), ``"closed"`` (back at the start), ``"points"`` (the allowance is used up), ``"no convergence:
    ..."`` or the border's own name."""
    scale: Vector = field(default_factory=lambda: np.ones(0))

    @property
    def folds(self) -> NDArray[np.int64]:
        """Indices i such that the curve turns back in its parameter between points i and i + 1."""
        return np.flatnonzero(self.tangents[:-1, -1] * self.tangents[1:, -1] < 0)


class NoConvergence(Exception):
    """Newton's iteration did not settle; the message says how it went."""


def newton(
    equations: Equations, x: Vector, scale: Vector, steps: Steps, border: Vector
) -> tuple[Vector, Vector, int]:
    """Solve the equations on the plane through `x` at right angles to `border` (scaled unknowns).

    Returns `x`, shape (n + 1,), the solution; `tangent`, shape (n + 1,), unit tangent of the curve there (scaled
    unknowns), on the side of `border`; from the last correction, which was too small to change it; `iterations`,
    corrections it took. Raises `NoConvergence` with the size of the last correction.
    """
    start, last = x, np.inf
    system, right = np.empty((x.size, x.size)), np.zeros((x.size, 2))
    system[-1], right[-1, 1] = border, 1.0
    for iteration in range(1, steps.iterations + 1):
        # An iteration that runs away may overflow; it is stopped below, by what is not finite.
        with np.errstate(all="ignore"):
            residual, jacobian = equations(x)
        system[:-1] = jacobian * scale
        right[:-1, 0], right[-1, 0] = -residual, -border @ ((x - start) / scale)
        if not (np.isfinite(system).all() and np.isfinite(right).all()):
            raise NoConvergence("the equations are not finite here")
        try:
            move, along = np.linalg.solve(system, right).T
        except np.linalg.LinAlgError:
            raise NoConvergence("the equations are singular here") from None
        size = float(np.abs(move).max())
        x = x + move * scale
        # Convergence has ended when the correction is at rounding level or has stopped shrinking there, or when
        # it is quadratic and the next one would be at rounding level.
        stalled = size < 1e-9 and size > 0.3 * last
        squared = last < 1.0 and size**3 < steps.tolerance * last**2
        if size < steps.tolerance or stalled or squared:
            return x, along / np.linalg.norm(along), iteration
        if size > 1e3 * max(last, 1e-3):
            raise NoConvergence(f"corrections grow (last one {size:.1e})")
        last = size
    raise NoConvergence(f"corrections still {last:.1e} after {steps.iterations} of them")


def tangent(equations: Equations, x: Vector, scale: Vector) -> Vector:
    """Return the unit tangent of the curve at `x` (scaled unknowns), on the side of rising parameters."""
    _, jacobian = equations(x)
    null = np.linalg.svd(jacobian * scale)[2][-1]
    return null if null[-1] >= 0 else -null


def hold(
    equations: Equations, x: Vector, parameter: float, scale: Vector, steps: Steps | None = None
) -> tuple[Vector, Vector]:
    """Solve the equations with the parameter held at a given value, starting from `x`.

    Returns `x`, shape (n + 1,); `tangent`, shape (n + 1,), unit tangent there, on the side of rising parameters.
    Raises `NoConvergence` if Newton's iteration does not settle.
    """
    border = np.zeros(x.size)
    border[-1] = 1.0
    x = x.copy()
    x[-1] = parameter
    solution, along, _ = newton(equations, x, scale, steps or Steps(), border)
    solution[-1] = parameter
    return solution, along


def solve_at(
    equations: Equations, x: Vector, parameter: float, scale: Vector, steps: Steps | None = None
) -> Vector:
    """Solve the equations with the parameter held at a given value, as `hold` does; the solution alone."""
    return hold(equations, x, parameter, scale, steps)[0]


def trace(
    equations: Equations,
    start: Vector,
    bounds: tuple[float, float],
    scale: Vector,
    steps: Steps | None = None,
    margins: Margins = lambda x: (np.ones(1), ("",)),
) -> Curve:
    """Follow the curve through a solution in both directions.

    `equations`: x -> residual (n,), jacobian (n, n + 1); the parameter is x's last element; `start`, shape (n + 1,):
    a solution; `bounds`: range of the parameter; the curve ends on it exactly; `scale`, shape (n + 1,): natural size
    of each unknown; arclength is measured in these; `margins`: x -> margin to each border, negative for what is not
    part of the curve any more, and the borders' names. A margin changes smoothly across its border, so that the last
    point kept lies there. Returns from the end reached against the parameter's direction at the start to the other
    end.
    """
    steps = steps or Steps()
    first = tangent(equations, start, scale)
    forward, end = _walk(equations, start, first, bounds, scale, steps, margins)
    if end == "closed":
        return Curve(*_columns(forward), (end, end), scale)
    backward, begin = _walk(equations, start, -first, bounds, scale, steps, margins)
    before = [(x, -t) for x, t in reversed(backward[1:])]
    return Curve(*_columns(before + forward), (begin, end), scale)


def _columns(pairs: list[tuple[Vector, Vector]]) -> tuple[Vector, Vector]:
    return np.array([x for x, _ in pairs]), np.array([t for _, t in pairs])


def _walk(
    equations: Equations,
    start: Vector,
    direction: Vector,
    bounds: tuple[float, float],
    scale: Vector,
    steps: Steps,
    margins: Margins,
) -> tuple[list[tuple[Vector, Vector]], str]:
    """Walk one way from the start; the points passed (start included) and why the walk ended."""
    path = [(start, direction)]
    step, travelled = steps.first, 0.0
    space, names = margins(start)
    while len(path) < steps.points:
        x, way = path[-1]
        if space.min() < 0:
            return path, names[int(space.argmin())]
        try:
            reached, new_way, iterations = newton(equations, _ahead(path, step, scale), scale, steps, way)
            # A correction as long as the step itself has left this curve for another one.
            strayed = float(np.linalg.norm((reached - x) / scale - step * way)) > 0.5 * step
            if strayed and step > steps.shortest:
                raise NoConvergence("the correction leads away from the curve")
        except NoConvergence as failure:
            if step <= steps.shortest:
                return path, f"no convergence: {failure} at parameter {x[-1]:.9g}"
            step /= 3
            continue
        angle = float(np.arccos(np.clip(new_way @ way, -1.0, 1.0)))
        if angle > steps.turn:
            if step <= steps.shortest:
                return path, f"no convergence: the curve turns by {angle:.2g} rad at parameter {x[-1]:.9g}"
            step = max(step * max(0.2, 0.7 * steps.turn / angle), steps.shortest)
            continue
        ends = ""
        if not bounds[0] <= reached[-1] <= bounds[1]:
            bound = bounds[0] if reached[-1] < bounds[0] else bounds[1]
            try:
                reached, new_way = hold(
                    equations, _at(path[-1], (reached, new_way), bound), bound, scale, steps
                )
            except NoConvergence as failure:
                return path, f"no convergence: {failure} at parameter {bound:.9g}, the end of its range"
            new_way, ends = new_way if new_way @ way > 0 else -new_way, "range"
        left, _ = margins(reached)
        if left.min() < 0:
            try:
                last, index = _on_border(equations, (x, space), (reached, left), scale, steps, margins)
            except NoConvergence as failure:
                if step <= steps.shortest:
                    return path, f"no convergence: {failure} at parameter {x[-1]:.9g}"
                step /= 4
                continue
            path.append(last)
            return path, names[index]
        back = (start - reached) / scale
        if travelled > 4 * step and np.linalg.norm(back) < 0.6 * step and way @ direction > 0.5:
            return path, "closed"
        path.append((reached, new_way))
        if ends:
            return path, ends
        space = left
        travelled += step
        if iterations <= 3 and angle < 0.5 * steps.turn:
            step = min(2.0 * step, steps.longest)
        elif iterations >= 6:
            step = max(0.5 * step, steps.shortest)
    return path, "points"


def _ahead(path: list[tuple[Vector, Vector]], step: float, scale: Vector) -> Vector:
    """Guess the point a step ahead: along the tangent, and bent as the curve was between the last two points."""
    x, way = path[-1]
    guess = x + step * way * scale
    if len(path) > 1:
        before, way_before = path[-2]
        chord = (before - x) / scale
        length = float(np.linalg.norm(chord))
        # The cubic through both points with their tangents, in t = 0 here and -1 there.
        misses, bends = chord + length * way, length * (way_before - way)
        t = step / length
        guess += t * t * (3 * misses + bends + t * (bends + 2 * misses)) * scale
    return guess


def _at(left: tuple[Vector, Vector], right: tuple[Vector, Vector], parameter: float) -> Vector:
    """Point of the chord between two points of a curve at a value of the parameter."""
    share = (parameter - left[0][-1]) / (right[0][-1] - left[0][-1])
    return np.asarray(left[0] + share * (right[0] - left[0]))


def _on_border(
    equations: Equations,
    inside: tuple[Vector, Vector],
    outside: tuple[Vector, Vector],
    scale: Vector,
    steps: Steps,
    margins: Margins,
) -> tuple[tuple[Vector, Vector], int]:
    """Find the last point of a curve before a border, and which border that is.

    `inside` and `outside` are points on this side and beyond, with their margins. The chord between them is divided,
    and each trial put back on the curve, until the margin of the border that is crossed first vanishes.
    """
    chord = (outside[0] - inside[0]) / scale
    length = float(np.linalg.norm(chord))
    way = chord / length

    def put_back(distance: float) -> tuple[Vector, Vector]:
        return newton(equations, inside[0] + distance * way * scale, scale, steps, way)[:2]

    def margin_at(distance: float, index: int) -> float:
        return float(margins(put_back(distance)[0])[0][index])

    end, beyond = length, outside[1]
    while True:
        crossed = np.flatnonzero(beyond < 0)
        shares = inside[1][crossed] / (inside[1][crossed] - beyond[crossed])
        index = int(crossed[shares.argmin()])
        distance = brentq(margin_at, 0.0, end, args=(index,), xtol=NEAR_BORDER * end)
        # On this side of the border for certain.
        distance = max(0.0, distance - 2 * NEAR_BORDER * end)
        last = put_back(distance)
        left = margins(last[0])[0]
        if left.min() >= 0 or distance == 0.0:
            return last, index
        end, beyond = distance, left


def locate(
    equations: Equations, curve: Curve, index: int, monitor: Monitor, steps: Steps | None = None
) -> tuple[Vector, Vector]:
    """Find the point between two neighbours of a curve where a monitor changes sign.

    The chord between them is divided, each trial is put back on the curve, and the zero is closed in by Brent's
    method.

    Returns `x, tangent`, shape (n + 1,), the point and the unit tangent there. Raises `NoConvergence` if the curve
    cannot be met between the two points, or the monitor has one sign at both.
    """
    steps = steps or Steps()
    begin, scale = curve.points[index], curve.scale
    chord = (curve.points[index + 1] - begin) / scale
    length = float(np.linalg.norm(chord))
    border = chord / length

    def put_back(distance: float) -> tuple[Vector, Vector]:
        return newton(equations, begin + distance * border * scale, scale, steps, border)[:2]

    ends = [monitor(curve.points[i], curve.tangents[i]) for i in (index, index + 1)]
    if not ends[0] * ends[1] < 0:
        raise NoConvergence("the monitor does not change sign between the two points")
    try:
        distance = brentq(lambda d: monitor(*put_back(d)), 0.0, length, xtol=1e-11 * length, rtol=1e-11)
    except ValueError:
        raise NoConvergence("the monitor vanishes at one of the points, or jumps") from None
    return put_back(distance)


def locate_folds(equations: Equations, curve: Curve, steps: Steps | None = None) -> Vector:
    """Points where the curve turns back in its parameter, shape (folds, n + 1)."""
    found = [locate(equations, curve, int(i), lambda x, way: float(way[-1]), steps)[0] for i in curve.folds]
    return np.array(found).reshape(-1, curve.points.shape[1])
