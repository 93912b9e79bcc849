"""The least-squares problem of a fit: unknowns, their prior knowledge, weighted residuals and their derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.fitting.measured import Curves, Sensor
from analysis.fitting.parameters import Parameter, with_values
from analysis.fitting.predicted import linear_response, linear_slopes, scene_of_test
from rig.arrays import Array, ComplexArray
from rig.scene.scene import Scene

if TYPE_CHECKING:
    from analysis.fitting.steady_tones import SteadyTones, StoredOrbit

# Prior standard deviation of a value's logarithm: so wide that it matters only where the data determine nothing.
PRIOR_SD = 1.0
# Largest change of a value's logarithm from its initial value.
_MAX_CHANGE = 6.0
# Step for derivatives of orbits, whose values are accurate to about 1e-13.
_STEP = 1e-6
# Relative step for derivatives of the matrices, in which all values but modal damping are linear.
_MATRIX_STEP = 1e-3
# Residual assigned to a point where the model has no periodic solution, standard deviations.
_FAILED_RESIDUAL = 30.0
# A point with a larger residual is an outlier; in standard deviations, and in medians of the residuals.
_OUTLIER_LIMIT = 6.0
# Ratio of frequencies up to which points are neighbors.
_NEIGHBORHOOD = 1.15


# State of a group: the fitted points, the orbit at each point, and the previous orbits.
Motions = tuple[NDArray[np.bool_], "list[StoredOrbit | None]", "list[StoredOrbit | None]"]


def _steady_tones(measured: Curves) -> SteadyTones:
    # Loaded where dampers move: the equations of orbits take a tenth of the time of a fit without dampers.
    from analysis.fitting.steady_tones import SteadyTones

    return SteadyTones(measured)


@dataclass
class Group:
    """Curves with the motion at each of their points."""

    curves: Curves
    tones: SteadyTones | None
    """Orbits where dampers move; None if the rig is linear."""
    used: NDArray[np.bool_]
    """Points that are fitted, shape (n,)."""
    local_peak: Array
    """Largest whitened value near each point, shape (n, responses)."""
    cached: tuple[tuple[float, ...], bool, ComplexArray] | None = field(default=None, repr=False)

    def motions(self) -> Motions:
        """Return the state of the motions, for `restore`."""
        assert self.tones is not None
        return self.used.copy(), list(self.tones.orbits), list(self.tones.previous)

    def restore(self, motions: Motions) -> None:
        """Restore a state of the motions."""
        assert self.tones is not None
        used, orbits, previous = motions
        self.used, self.cached = used.copy(), None
        self.tones.orbits, self.tones.previous = list(orbits), list(previous)
        self.tones.failed.clear()

    def choose_motions(self, problem: Problem, x: Array, scene: Scene) -> bool:
        """Replace the orbit at outliers by one that fits better, and exclude points that remain outliers.

        Returns whether anything changed.
        """
        assert self.tones is not None
        self.tones.failed.clear()
        curves, used_before = self.curves, self.used.copy()
        predicted = problem.predicted(x, self, scene)
        bench = scene_of_test(scene, curves)
        level, frequency = problem.operating_points(x, curves)
        channel_gains, gain = problem.gains(x, curves)

        def residual(k: int, value: ComplexArray) -> float:
            whitened = abs(curves.whiten[k] @ (value - curves.value[:, k]))
            return float(np.nan_to_num(whitened, nan=np.inf).max())

        residuals = np.array([residual(k, predicted[:, k]) for k in range(frequency.size)])
        limit = _OUTLIER_LIMIT * max(1.0, float(np.median(residuals)))
        changed = False
        for k in np.flatnonzero(residuals > limit).tolist():
            for orbit, bodies in self.tones.alternatives(bench, level, frequency, k):
                smaller = residual(k, channel_gains / gain * bodies[list(curves.bodies)])
                if smaller < 0.5 * residuals[k]:
                    self.tones.orbits[k], residuals[k], changed = orbit, smaller, True
                if residuals[k] <= limit:
                    break
        self.used, self.cached = residuals <= limit, None
        return changed or bool(np.any(self.used != used_before))


class Problem:
    """Unknowns of a scene, and its residuals against the measured curves.

    `model`: with one damping value for each mode; `parameters`: its free values; `curves`: measured responses;
    `sensors`: sensors with a tolerance of sensitivity; their deviations are unknowns after the parameters; `clocks`:
    largest deviation of the sample clock; if it is not zero, its deviation is the last unknown; `start`, `prior_sd`,
    shape (unknowns,): prior mean and standard deviation. Values are represented by their logarithm.
    """

    def __init__(self, model: Scene, parameters: Sequence[Parameter], curves: Sequence[Curves]) -> None:
        self.model, self.parameters = model, list(parameters)
        self.groups = [
            Group(
                measured,
                _steady_tones(measured) if measured.moving else None,
                np.ones(measured.frequency.size, bool),
                _local_peaks(measured),
            )
            for measured in curves
        ]
        sensors = [sensor for measured in curves for sensor in (*measured.sensors, measured.reference_sensor)]
        self.sensors = [sensor for sensor in dict.fromkeys(sensors) if sensor.tolerance > 0.0]
        self.clock = max(measured.clock for measured in curves)
        values = [parameter.unknown(parameter.start) for parameter in self.parameters]
        # A uniform distribution within the tolerance has a standard deviation of tolerance / sqrt(3).
        limits = [sensor.tolerance for sensor in self.sensors] + [self.clock] * (self.clock > 0.0)
        self.start = np.array(values + [0.0] * len(limits))
        self.prior_sd = np.array([PRIOR_SD] * len(values) + [limit / np.sqrt(3.0) for limit in limits])

    @property
    def size(self) -> int:
        """Return the number of unknowns."""
        return self.start.size

    def values(self, x: Array) -> Array:
        """Return the values of the parameters, in SI units."""
        limited = np.clip(x - self.start, -_MAX_CHANGE, _MAX_CHANGE) + self.start
        return np.array([parameter.value(value) for parameter, value in zip(self.parameters, limited, strict=False)])

    def scene(self, x: Array) -> Scene:
        """Return the model with the values of the unknowns."""
        places = [parameter.place for parameter in self.parameters]
        return with_values(self.model, dict(zip(places, self.values(x).tolist(), strict=True)))

    def deviation(self, x: Array, sensor: Sensor) -> float:
        """Return the relative deviation of a sensor's sensitivity."""
        first = len(self.parameters)
        return float(x[first + self.sensors.index(sensor)]) if sensor in self.sensors else 0.0

    def gains(self, x: Array, curves: Curves) -> tuple[Array, float]:
        """Return the relative gains of the response sensors, shape (responses,), and of the reference sensor."""
        channel_gains = np.array([1.0 + self.deviation(x, sensor) for sensor in curves.sensors])
        return channel_gains, 1.0 + self.deviation(x, curves.reference_sensor)

    def operating_points(self, x: Array, curves: Curves) -> tuple[Array, Array]:
        """Return the true level of the reference (NaN without tones) and the true frequency in Hz, shape (n,)."""
        clock = 1.0 + (float(x[-1]) if self.clock > 0.0 else 0.0)
        level = np.nan if curves.level is None else curves.level
        return np.asarray(level / self.gains(x, curves)[1]), curves.frequency * clock

    def clearance_limit(self, x: Array, parameter: Parameter) -> float:
        """Return the largest gap of a damper, m, a lower limit of its clearance; 0 with ceiling impacts."""
        scene, limit = self.scene(x), 0.0
        assert parameter.damper is not None
        body = self.model.dampers[parameter.damper].body
        for group in self.groups:
            if group.tones is None:
                continue
            bench = scene_of_test(scene, group.curves)
            for number, damper in enumerate(bench.dampers):
                if damper.body == body and damper.moves:
                    points = self.operating_points(x, group.curves)
                    limit = max(limit, group.tones.largest_gap(bench, *points, number))
        return limit if np.isfinite(limit) else 0.0

    def predicted(self, x: Array, group: Group, scene: Scene, search: bool = True) -> ComplexArray:
        """Return the predicted readings, shape (responses, n); NaN where there is no steady motion."""
        channel_gains, gain = self.gains(x, group.curves)
        return (
            channel_gains[:, None] / gain * self._displacement_ratio(x, group, scene, search)[list(group.curves.bodies)]
        )

    def _displacement_ratio(self, x: Array, group: Group, scene: Scene, search: bool = True) -> ComplexArray:
        """Return displacement of the bodies / reference, shape (bodies, n)."""
        curves = group.curves
        level, frequency = self.operating_points(x, curves)
        gain = 0.0 if group.tones is None else self.gains(x, curves)[1]
        key = (*x[: len(self.parameters)].tolist(), float(x[-1]) if self.clock > 0.0 else 0.0, gain)
        if group.cached is None or group.cached[0] != key or (search and not group.cached[1]):
            bench = scene_of_test(scene, curves)
            if group.tones is None:
                bodies = linear_response(bench, curves, frequency)[0]
            else:
                bodies = group.tones.response(bench, level, frequency, search)
            group.cached = (key, search, bodies)
        return group.cached[2]

    def normalized_residuals(
        self, x: Array, group: Group, scene: Scene, model_error: float = 0.0, search: bool = True
    ) -> ComplexArray:
        """Return the residuals of a group's used points in standard deviations; shape (used, responses)."""
        curves, used = group.curves, group.used
        residual = self.predicted(x, group, scene, search)[:, used] - curves.value[:, used]
        whitened = np.einsum("nij,jn->ni", curves.whiten[used], residual)
        whitened = whitened / np.sqrt(1.0 + (model_error * group.local_peak[used]) ** 2)
        return np.where(np.isfinite(whitened), whitened, _FAILED_RESIDUAL * (1 + 1j))

    def residual(self, x: Array, groups: Sequence[Group], model_error: float = 0.0, search: bool = True) -> Array:
        """Return residuals of groups (real and imaginary parts), then deviations of the unknowns from their priors."""
        scene = self.scene(x)
        parts = [self.normalized_residuals(x, group, scene, model_error, search) for group in groups]
        flat = np.concatenate([part.ravel() for part in parts]) if parts else np.zeros(0, dtype=complex)
        return np.concatenate([flat.real, flat.imag, (x - self.start) / self.prior_sd])

    def jacobian(
        self, x: Array, groups: Sequence[Group], model_error: float = 0.0, active: Sequence[int] | None = None
    ) -> Array:
        """Differentiate `residual` with respect to active unknowns, shape (residuals, active).

        It is exact where the rig is linear. Orbits are refined from those at x, with the same events.
        """
        indices = list(range(self.size)) if active is None else list(active)
        scene = self.scene(x)
        moving = [group for group in groups if group.tones is not None]
        following = iter(self._differences(x, moving, scene, model_error, indices))
        parts = [
            self._linear_slopes(x, group, scene, model_error, indices) if group.tones is None else next(following)
            for group in groups
        ]
        flat = np.concatenate([np.zeros((0, len(indices))), *(part.reshape(-1, len(indices)) for part in parts)])
        prior = np.zeros((self.size, len(indices)))
        prior[indices, range(len(indices))] = 1.0 / self.prior_sd[indices]
        return np.concatenate([flat.real, flat.imag, prior])

    def _differences(
        self, x: Array, groups: Sequence[Group], scene: Scene, model_error: float, indices: Sequence[int]
    ) -> list[ComplexArray]:
        """Differentiate the residuals of each group by finite differences; shape (used, responses, chosen)."""
        if not groups:
            return []
        base = [self.normalized_residuals(x, group, scene, model_error, search=False) for group in groups]
        columns: list[list[ComplexArray]] = [[] for _ in groups]
        for k in indices:
            shifted = x.copy()
            # A poorly determined unknown may lie where its value is already clipped.
            shifted[k] += _STEP * max(1.0, abs(x[k]))
            changed = self.scene(shifted)
            for group, unchanged, column in zip(groups, base, columns, strict=True):
                difference = self.normalized_residuals(shifted, group, changed, model_error, search=False) - unchanged
                column.append(difference / (shifted[k] - x[k]))
        return [np.stack(column, axis=-1) for column in columns]

    def _linear_slopes(
        self, x: Array, group: Group, scene: Scene, model_error: float, indices: Sequence[int]
    ) -> ComplexArray:
        """Differentiate the residuals of a group in which no damper moves; shape (used, responses, chosen)."""
        curves, used, count = group.curves, group.used, len(self.parameters)
        # Of dampers at rest on their floors, only the masses have an effect.
        effective = [
            k
            for k in indices
            if k < count
            and (self.parameters[k].damper is None or self.parameters[k].quantity in ("mass", "mass_ratio"))
        ]
        benches = [self._neighbors(x, k, scene, curves) for k in effective]
        frequency = self.operating_points(x, curves)[1]
        by_value, by_frequency = linear_slopes(scene_of_test(scene, curves), curves, frequency, benches)
        values, (channel_gains, gain) = self.values(x), self.gains(x, curves)
        bodies, rows = self._displacement_ratio(x, group, scene), list(curves.bodies)
        slopes = np.zeros((len(indices), *curves.value.shape), dtype=complex)
        for column, k in enumerate(indices):
            if k in effective:
                by_unknown = values[k] * self.parameters[k].slope(float(values[k]))
                slopes[column] = channel_gains[:, None] / gain * by_value[effective.index(k)][rows] * by_unknown
            elif count <= k < count + len(self.sensors):
                sensor = self.sensors[k - count]
                by_response_gain = np.array([float(channel_sensor == sensor) for channel_sensor in curves.sensors])[
                    :, None
                ]
                by_gain = float(curves.reference_sensor == sensor)
                slopes[column] = (by_response_gain - by_gain * channel_gains[:, None] / gain) / gain * bodies[rows]
            elif k >= count:
                slopes[column] = channel_gains[:, None] / gain * by_frequency[rows] * curves.frequency
        whitened = np.einsum("nij,cjn->nic", curves.whiten[used], slopes[:, :, used])
        return whitened / np.sqrt(1.0 + (model_error * group.local_peak[used]) ** 2)[..., None]

    def _neighbors(self, x: Array, k: int, scene: Scene, curves: Curves) -> tuple[Scene, Scene, float]:
        """Return benches with a slightly larger and a slightly smaller value, and the difference of the values.

        `scene` has the values of the unknowns x.
        """
        value, place = float(self.values(x)[k]), self.parameters[k].place
        larger, smaller = (
            scene_of_test(with_values(scene, {place: value * factor}), curves)
            for factor in (1.0 + _MATRIX_STEP, 1.0 - _MATRIX_STEP)
        )
        return larger, smaller, 2.0 * _MATRIX_STEP * value


def _local_peaks(curves: Curves) -> Array:
    """Return the largest value near each point in standard deviations, shape (n, responses)."""
    order = np.argsort(curves.frequency, kind="stable")
    f, size = curves.frequency[order], abs(curves.value[:, order])
    low, high = np.searchsorted(f, f / _NEIGHBORHOOD), np.searchsorted(f, f * _NEIGHBORHOOD, side="right")
    largest = np.empty(size.T.shape)
    largest[order] = np.stack([size[:, a:b].max(axis=1) for a, b in zip(low, high, strict=True)])
    return largest * abs(np.einsum("nii->ni", curves.whiten))
