"""The least-squares problem of a fit: unknowns, their prior knowledge, weighted residuals and their derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from analysis.fitting.measured import Curves, Sensor
from analysis.fitting.parameters import Parameter, with_values
from analysis.fitting.predicted import linear, linear_slopes, on_the_bench
from analysis.fitting.steady_tones import Known, SteadyTones
from rig.arrays import Array, ComplexArray
from rig.scene.scene import Scene

# Prior standard deviation of a value's logarithm: so wide that it matters only where the data determine nothing.
VAGUE = 1.0
# Largest change of a value's logarithm from its start.
_FARTHEST = 6.0
# Step for derivatives of motions with dampers, which are exact to about 1e-13; relative step of the matrices, in
# which all values but modal damping are linear.
_STEP, _BESIDE = 1e-6, 1e-3
# Residual of a point at which the model has no steady motion, and limit of all residuals, standard deviations.
_LOST = 30.0
# Largest residual, in standard deviations and in medians, of a point with the right kind of motion.
_OUTLYING = 6.0
# Ratio of frequencies that belong to a neighbourhood.
_AROUND = 1.15


@dataclass(frozen=True)
class Motions:
    """State of a group: the motion at each point, the motion before it, and the points that count."""

    used: NDArray[np.bool_]
    known: tuple[Known | None, ...]
    before: tuple[Known | None, ...]


@dataclass
class Group:
    """Curves with the motion at each of their points."""

    curves: Curves
    tones: SteadyTones | None
    """Where dampers move; None where the rig is linear."""
    used: NDArray[np.bool_]
    """Points that count, shape (n,)."""
    around: Array
    """Largest whitened value around each point, shape (n, responses)."""
    last: tuple[tuple[float, ...], bool, ComplexArray] | None = field(default=None, repr=False)

    def motions(self) -> Motions:
        """Return the state of the motions, for `restore`."""
        assert self.tones is not None
        return Motions(self.used.copy(), *self.tones.state())

    def restore(self, motions: Motions) -> None:
        """Restore a state of the motions."""
        assert self.tones is not None
        self.used, self.last = motions.used.copy(), None
        self.tones.restore(motions.known, motions.before)

    def choose_motions(self, problem: Problem, x: Array, scene: Scene) -> bool:
        """Replace the motion at outlying points by one that fits better, and leave out points that stay outlying.

        Returns whether anything changed.
        """
        assert self.tones is not None
        self.tones.given_up.clear()
        curves, before = self.curves, self.used.copy()
        level = np.asarray(self.curves.level)
        predicted = problem.predicted(x, self, scene)
        bench = on_the_bench(scene, curves)
        gain = 1.0 + problem.deviation(x, curves.reference_sensor)
        frequency = curves.frequency * (1.0 + problem.clock_deviation(x))
        own = np.array([1.0 + problem.deviation(x, sensor) for sensor in curves.sensors]) / gain

        def miss(k: int, value: ComplexArray) -> float:
            return float(
                np.nan_to_num(abs(curves.whiten[k] @ (value - curves.value[:, k])), nan=np.inf).max()
            )

        off = np.array([miss(k, predicted[:, k]) for k in range(frequency.size)])
        outlying = _OUTLYING * max(1.0, float(np.median(off)))
        changed = False
        for k in np.flatnonzero(off > outlying).tolist():
            for known, bodies in self.tones.others(bench, level / gain, frequency, k):
                better = miss(k, own * bodies[list(curves.bodies)])
                if better < 0.5 * off[k]:
                    self.tones.known[k], off[k], changed = known, better, True
                if off[k] <= outlying:
                    break
        self.used = off <= outlying
        self.last = None
        return changed or bool(np.any(self.used != before))


class Problem:
    """Unknowns of a scene, and its residuals against the measured curves.

    `model`: with one damping value for each mode; `parameters`: its free values; `curves`: measured responses;
    `sensors`: sensors with a tolerance of sensitivity; their deviations are unknowns after the parameters; `clocks`:
    largest deviation of the sample clock; if it is not zero, its deviation is the last unknown; `start`, `spread`,
    shape (unknowns,): prior mean and standard deviation. Values are represented by their logarithm.
    """

    def __init__(self, model: Scene, parameters: Sequence[Parameter], curves: Sequence[Curves]) -> None:
        self.model, self.parameters = model, list(parameters)
        self.groups = [
            Group(
                one,
                SteadyTones(one) if one.moving else None,
                np.ones(one.frequency.size, dtype=bool),
                _around(one),
            )
            for one in curves
        ]
        everywhere = [sensor for one in curves for sensor in (*one.sensors, one.reference_sensor)]
        self.sensors = [sensor for sensor in dict.fromkeys(everywhere) if sensor.tolerance > 0.0]
        self.clock = max(one.clock for one in curves)
        values = [one.unknown(one.start) for one in self.parameters]
        # A uniform distribution within the tolerance has a standard deviation of tolerance / sqrt(3).
        others = [sensor.tolerance for sensor in self.sensors] + [self.clock] * (self.clock > 0.0)
        self.start = np.array(values + [0.0] * len(others))
        self.spread = np.array([VAGUE] * len(values) + [one / np.sqrt(3.0) for one in others])

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.start.size

    def values(self, x: Array) -> Array:
        """Values of the parameters, in SI."""
        inside = np.clip(x - self.start, -_FARTHEST, _FARTHEST) + self.start
        return np.array([one.value(value) for one, value in zip(self.parameters, inside, strict=False)])

    def scene(self, x: Array) -> Scene:
        """Give the model with the values of the unknowns."""
        return with_values(
            self.model,
            {one.place: v for one, v in zip(self.parameters, self.values(x).tolist(), strict=True)},
        )

    def deviation(self, x: Array, sensor: Sensor) -> float:
        """Relative deviation of a sensor's sensitivity."""
        at = len(self.parameters)
        return float(x[at + self.sensors.index(sensor)]) if sensor in self.sensors else 0.0

    def clock_deviation(self, x: Array) -> float:
        """Relative deviation of the sample clock."""
        return float(x[-1]) if self.clock > 0.0 else 0.0

    def clearance_limit(self, x: Array, parameter: Parameter) -> float:
        """Largest gap of a damper in all motions, m, a lower limit of its clearance; 0 with ceiling impacts."""
        scene, limit = self.scene(x), 0.0
        assert parameter.damper is not None
        body = self.model.dampers[parameter.damper].body
        for group in self.groups:
            if group.tones is None:
                continue
            bench = on_the_bench(scene, group.curves)
            gain = 1.0 + self.deviation(x, group.curves.reference_sensor)
            frequency = group.curves.frequency * (1.0 + self.clock_deviation(x))
            for number, damper in enumerate(bench.dampers):
                if damper.body == body and damper.moves:
                    assert group.curves.level is not None
                    limit = max(limit, group.tones.rise(bench, group.curves.level / gain, frequency, number))
        return limit if np.isfinite(limit) else 0.0

    def predicted(self, x: Array, group: Group, scene: Scene, settle: bool = True) -> ComplexArray:
        """Return the predicted readings, shape (responses, n); NaN where there is no steady motion."""
        curves = group.curves
        gain = 1.0 + self.deviation(x, curves.reference_sensor)
        own = np.array([1.0 + self.deviation(x, sensor) for sensor in curves.sensors])
        return own[:, None] / gain * self._answer(x, group, scene, settle)[list(curves.bodies)]

    def _answer(self, x: Array, group: Group, scene: Scene, settle: bool = True) -> ComplexArray:
        """Displacement of the bodies over the reference, shape (bodies, n)."""
        curves = group.curves
        gain = 1.0 + self.deviation(x, curves.reference_sensor)
        clock = 1.0 + self.clock_deviation(x)
        level = None if group.tones is None else gain
        key = (*x[: len(self.parameters)].tolist(), clock, 0.0 if level is None else level)
        if group.last is None or group.last[0] != key or (settle and not group.last[1]):
            frequency = curves.frequency * clock
            bench = on_the_bench(scene, curves)
            if group.tones is None:
                bodies = linear(bench, curves, frequency)
            else:
                assert curves.level is not None
                bodies = group.tones.at(bench, curves.level / gain, frequency, settle)
            group.last = (key, settle, bodies)
        return group.last[2]

    def misses(
        self, x: Array, group: Group, scene: Scene, distrust: float = 0.0, settle: bool = True
    ) -> ComplexArray:
        """Return the residuals of a group's used points in standard deviations; shape (used, responses)."""
        curves, used = group.curves, group.used
        off = self.predicted(x, group, scene, settle)[:, used] - curves.value[:, used]
        white = np.einsum("nij,jn->ni", curves.whiten[used], off)
        white = white / np.sqrt(1.0 + (distrust * group.around[used]) ** 2)
        return np.where(np.isfinite(white), white, _LOST * (1 + 1j))

    def residual(
        self, x: Array, groups: Sequence[Group], distrust: float = 0.0, settle: bool = True
    ) -> Array:
        """All misses of some groups, real and imaginary parts, then how far the unknowns are from what was known."""
        scene = self.scene(x)
        parts = [self.misses(x, group, scene, distrust, settle) for group in groups]
        flat = np.concatenate([part.ravel() for part in parts]) if parts else np.zeros(0, dtype=complex)
        return np.concatenate([flat.real, flat.imag, (x - self.start) / self.spread])

    def jacobian(
        self, x: Array, groups: Sequence[Group], distrust: float = 0.0, active: Sequence[int] | None = None
    ) -> Array:
        """Differentiate `residual` with respect to active unknowns, shape (residuals, active).

        Exact where the rig is linear. Motions of dampers keep their events as they are followed from the ones known
        at x.
        """
        chosen = list(range(self.size)) if active is None else list(active)
        scene = self.scene(x)
        moving = [group for group in groups if group.tones is not None]
        following = iter(self._differences(x, moving, scene, distrust, chosen))
        parts = [
            self._linear_slopes(x, group, scene, distrust, chosen) if group.tones is None else next(following)
            for group in groups
        ]
        flat = (
            np.concatenate([part.reshape(-1, len(chosen)) for part in parts])
            if parts
            else np.zeros((0, len(chosen)))
        )
        prior = np.zeros((self.size, len(chosen)))
        prior[chosen, range(len(chosen))] = 1.0 / self.spread[chosen]
        return np.concatenate([flat.real, flat.imag, prior])

    def _differences(
        self, x: Array, groups: Sequence[Group], scene: Scene, distrust: float, chosen: Sequence[int]
    ) -> list[ComplexArray]:
        """Slopes of the misses of each group by differences; shape (used, responses, chosen)."""
        if not groups:
            return []
        base = [self.misses(x, group, scene, distrust, settle=False) for group in groups]
        columns: list[list[ComplexArray]] = [[] for _ in groups]
        for k in chosen:
            moved = x.copy()
            # An undetermined unknown may have moved far beyond where its value still changes.
            moved[k] += _STEP * max(1.0, abs(x[k]))
            there = self.scene(moved)
            for group, here, column in zip(groups, base, columns, strict=True):
                off = self.misses(moved, group, there, distrust, settle=False) - here
                column.append(off / (moved[k] - x[k]))
        return [np.stack(column, axis=-1) for column in columns]

    def _linear_slopes(
        self, x: Array, group: Group, scene: Scene, distrust: float, chosen: Sequence[int]
    ) -> ComplexArray:
        """Slopes of the misses of a group in which no damper moves; shape (used, responses, chosen)."""
        curves, used, count = group.curves, group.used, len(self.parameters)
        seen = [k for k in chosen if k < count and self.parameters[k].seen_riding]
        by_value, by_frequency = linear_slopes(
            on_the_bench(scene, curves),
            curves,
            curves.frequency * (1.0 + self.clock_deviation(x)),
            [self._beside(x, k, curves) for k in seen],
        )
        values = self.values(x)
        gain = 1.0 + self.deviation(x, curves.reference_sensor)
        own = np.array([1.0 + self.deviation(x, sensor) for sensor in curves.sensors])
        bodies, rows = self._answer(x, group, scene), list(curves.bodies)
        slopes = np.zeros((len(chosen), *curves.value.shape), dtype=complex)
        for column, k in enumerate(chosen):
            if k in seen:
                one = self.parameters[k]
                by_unknown = values[k] * slope(one, float(values[k]))
                slopes[column] = own[:, None] / gain * by_value[seen.index(k)][rows] * by_unknown
            elif count <= k < count + len(self.sensors):
                sensor = self.sensors[k - count]
                of = np.array([float(one == sensor) for one in curves.sensors])[:, None]
                by_gain = float(curves.reference_sensor == sensor)
                slopes[column] = (of - by_gain * own[:, None] / gain) / gain * bodies[rows]
            elif k >= count:
                slopes[column] = own[:, None] / gain * by_frequency[rows] * curves.frequency
        white = np.einsum("nij,cjn->nic", curves.whiten[used], slopes[:, :, used])
        return white / np.sqrt(1.0 + (distrust * group.around[used]) ** 2)[..., None]

    def _beside(self, x: Array, k: int, curves: Curves) -> tuple[Scene, Scene, float]:
        """Benches with a little more and a little less of a value, and the distance of the two."""
        values = self.values(x).tolist()
        benches = []
        for sign in (1.0, -1.0):
            changed = {one.place: value for one, value in zip(self.parameters, values, strict=True)}
            changed[self.parameters[k].place] *= 1.0 + sign * _BESIDE
            benches.append(on_the_bench(with_values(self.model, changed), curves))
        return benches[0], benches[1], 2.0 * _BESIDE * values[k]


def _around(curves: Curves) -> Array:
    """Largest value around each point in standard deviations: how much a model that is not right may be off."""
    order = np.argsort(curves.frequency, kind="stable")
    f, size = curves.frequency[order], abs(curves.value[:, order])
    low, high = np.searchsorted(f, f / _AROUND), np.searchsorted(f, f * _AROUND, side="right")
    largest = np.empty(size.T.shape)
    largest[order] = np.stack([size[:, a:b].max(axis=1) for a, b in zip(low, high, strict=True)])
    return largest * abs(np.einsum("nii->ni", curves.whiten))


def slope(one: Parameter, value: float) -> float:
    """Relative change of a parameter's value for one unit of its unknown."""
    return 1.0 - value if one.below_one else 1.0
