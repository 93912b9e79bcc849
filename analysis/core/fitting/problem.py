"""The least-squares problem of a fit: unknowns, their priors, weighted residuals and the derivatives of residuals.

An *unknown* is the logarithm of a parameter (the log odds of a ratio below 1), the relative deviation of a sensor's
sensitivity, or the relative deviation of the sample clock. A *group* contains the responses of one sweep or test. Where
dampers move, a *periodic orbit* gives the response at each frequency; otherwise the response is linear. A *gap* is the
distance of a damper from the floor of its cavity, the *clearance* its largest possible value.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from analysis.core.fitting.measured import Curves, Sensor
from analysis.core.fitting.parameters import Parameter, with_values
from analysis.core.fitting.predicted import linear_derivatives, linear_response, scene_of_test
from analysis.core.fitting.sweep_orbits import StoredOrbit, SweepOrbits
from analysis.core.modal.modal_fit import neighboring_maxima
from rig.core.base.arrays import Array, ComplexArray
from rig.core.results.uncertainty import standard_of_limit
from rig.core.scene.scene import Scene

# Prior standard deviation of the unknown of a parameter. The prior is so wide that it affects only undetermined values.
PRIOR_SD = 1.0
# Largest change of the unknown of a parameter: a factor of exp(6) = 400 is no longer an error of the scene.
_MAX_CHANGE = 6.0
# Step of an unknown for finite differences of orbits, which are accurate to about 1e-13.
_UNKNOWN_STEP = 1e-6
# Relative step of a parameter for derivatives of the matrices, in which only modal damping is nonlinear.
_PARAMETER_STEP = 1e-6
# Normalized residual of a point where the scene has no periodic solution: far above the limit of outliers.
_FAILED_RESIDUAL = 30.0
# A point is an outlier above this normalized residual, or above this multiple of the median residual if it is larger.
_OUTLIER_LIMIT = 6.0
# Largest plausible deviation of a fitted sensitivity from its data sheet, in tolerances, which may be optimistic.
_MAX_SENSOR_DEVIATION = 2.0


# State of a group: the fitted points, the current orbit at each point, and the earlier orbits.
OrbitState = tuple[NDArray[np.bool_], "list[StoredOrbit | None]", "list[StoredOrbit | None]"]


def _sweep_orbits(curves: Curves) -> SweepOrbits:
    # Imported only where dampers move: this import takes a tenth of the time of a fit without dampers.
    return SweepOrbits(curves)


@dataclass
class Group:
    """Responses of one sweep or test, and the orbits of the scene at their frequencies."""

    curves: Curves
    orbits: SweepOrbits | None
    """Orbits where dampers move; None if the rig is linear."""
    is_fitted: NDArray[np.bool_]
    """Points that are fitted, shape (n,)."""
    local_peak: Array
    """Largest magnitude near each point, in standard deviations of that point, shape (n, responses)."""
    cached: tuple[tuple[float, ...], bool, ComplexArray] | None = field(default=None, repr=False)
    """Last prediction: unknowns, whether orbits were searched, displacement / reference. None before the first."""

    def orbit_state(self) -> OrbitState:
        """Return the orbits and the fitted points, for `restore`."""
        assert self.orbits is not None
        return self.is_fitted.copy(), list(self.orbits.current), list(self.orbits.earlier)

    def restore(self, state: OrbitState) -> None:
        """Restore orbits and fitted points from `orbit_state`."""
        assert self.orbits is not None
        is_fitted, current, earlier = state
        self.is_fitted, self.cached = is_fitted.copy(), None
        self.orbits.current, self.orbits.earlier = list(current), list(earlier)
        self.orbits.failed.clear()

    def replace_outlier_orbits(self, problem: "Problem", x: Array, scene: Scene) -> bool:
        """Replace the orbit at each outlier with a better orbit, and exclude the remaining outliers.

        `x`: unknowns; `scene`: the scene to fit, with the values of the unknowns. Returns whether an orbit or a fitted
        point changed.
        """
        assert self.orbits is not None
        self.orbits.failed.clear()
        curves, previously_fitted = self.curves, self.is_fitted.copy()
        predicted = problem.predicted(x, self, scene)
        test_scene = scene_of_test(scene, curves)
        level, frequency = problem.operating_points(x, curves)
        channel_gains, reference_gain = problem.gains(x, curves)

        def largest_residual(k: int, value: ComplexArray) -> float:
            whitened = abs(curves.whitening[k] @ (value - curves.value[:, k]))
            return float(np.nan_to_num(whitened, nan=np.inf).max())

        residuals = np.array([largest_residual(k, predicted[:, k]) for k in range(frequency.size)])
        outlier_limit = _OUTLIER_LIMIT * max(1.0, float(np.median(residuals)))
        changed = False
        for k in np.flatnonzero(residuals > outlier_limit).tolist():
            for orbit, displacement_ratio in self.orbits.alternatives(test_scene, level, frequency, k):
                residual = largest_residual(k, channel_gains / reference_gain * displacement_ratio[list(curves.bodies)])
                if residual < 0.5 * residuals[k]:
                    self.orbits.current[k], residuals[k], changed = orbit, residual, True
                if residuals[k] <= outlier_limit:
                    break
        self.is_fitted, self.cached = residuals <= outlier_limit, None
        return changed or bool(np.any(self.is_fitted != previously_fitted))


class Problem:
    """Unknowns of a scene, and its residuals relative to the measured curves.

    The unknowns `x`, shape (unknowns,), belong to the parameters, then to the sensors, then to the clock.
    `initial_scene`: the scene to fit, with one damping ratio for each mode; `parameters`: free values of the scene.
    """

    def __init__(self, initial_scene: Scene, parameters: Sequence[Parameter], curves: Sequence[Curves]) -> None:
        self.initial_scene, self.parameters = initial_scene, list(parameters)
        self.groups = [
            Group(
                measured,
                None if measured.is_linear else _sweep_orbits(measured),
                np.ones(measured.frequency.size, bool),
                _local_peaks(measured),
            )
            for measured in curves
        ]
        sensors = [sensor for measured in curves for sensor in (*measured.sensors, measured.reference_sensor)]
        self.sensors = [sensor for sensor in dict.fromkeys(sensors) if sensor.tolerance > 0.0]
        # Largest relative deviation of the sample clock; 0 if it is not an unknown.
        self.clock_tolerance = max(measured.clock_tolerance for measured in curves)
        values = [parameter.unknown(parameter.start) for parameter in self.parameters]
        limits = [sensor.tolerance for sensor in self.sensors] + [self.clock_tolerance] * (self.clock_tolerance > 0.0)
        # Prior mean, which is the initial value, and prior standard deviation of each unknown.
        self.start = np.array(values + [0.0] * len(limits))
        self.prior_sd = np.array([PRIOR_SD] * len(values) + [float(standard_of_limit(limit)) for limit in limits])

    @property
    def size(self) -> int:
        """Return the number of unknowns."""
        return self.start.size

    def values(self, x: Array) -> Array:
        """Return the values of the parameters, in SI units."""
        limited = np.clip(x - self.start, -_MAX_CHANGE, _MAX_CHANGE) + self.start
        return np.array([parameter.value(value) for parameter, value in zip(self.parameters, limited, strict=False)])

    def scene(self, x: Array) -> Scene:
        """Return the scene with the values of the unknowns."""
        key_paths = [parameter.key_path for parameter in self.parameters]
        return with_values(self.initial_scene, dict(zip(key_paths, self.values(x).tolist(), strict=True)))

    def deviation(self, x: Array, sensor: Sensor) -> float:
        """Return the relative deviation of a sensor's sensitivity."""
        first = len(self.parameters)
        return float(x[first + self.sensors.index(sensor)]) if sensor in self.sensors else 0.0

    def implausible_sensors(self, x: Array) -> dict[Sensor, float]:
        """Return the relative errors of the sensors that far exceed the tolerances of their data sheets."""
        errors = {sensor: self.deviation(x, sensor) for sensor in self.sensors}
        return {
            sensor: error for sensor, error in errors.items() if abs(error) > _MAX_SENSOR_DEVIATION * sensor.tolerance
        }

    def gains(self, x: Array, curves: Curves) -> tuple[Array, float]:
        """Return the relative gains of the response sensors, shape (responses,), and of the reference sensor."""
        channel_gains = np.array([1.0 + self.deviation(x, sensor) for sensor in curves.sensors])
        return channel_gains, 1.0 + self.deviation(x, curves.reference_sensor)

    def operating_points(self, x: Array, curves: Curves) -> tuple[Array, Array]:
        """Return true amplitude (N or m; NaN except for steady tones) and frequency [Hz] of the reference; (n,)."""
        clock = 1.0 + (float(x[-1]) if self.clock_tolerance > 0.0 else 0.0)
        level = np.nan if curves.level is None else curves.level
        return np.asarray(level / self.gains(x, curves)[1]), curves.frequency * clock

    def clearance_lower_bound(self, x: Array, parameter: Parameter) -> float:
        """Return the largest gap of a damper in m, a lower bound of its clearance; 0 with ceiling impacts."""
        scene, largest = self.scene(x), 0.0
        assert parameter.damper is not None
        body = self.initial_scene.dampers[parameter.damper].body
        for group in self.groups:
            if group.orbits is None:
                continue
            test_scene = scene_of_test(scene, group.curves)
            for number, damper in enumerate(test_scene.dampers):
                if damper.body == body and damper.impacts:
                    points = self.operating_points(x, group.curves)
                    largest = max(largest, group.orbits.largest_gap(test_scene, *points, number))
        return largest if np.isfinite(largest) else 0.0

    def predicted(self, x: Array, group: Group, scene: Scene, search: bool = True) -> ComplexArray:
        """Return displacement / reference as the sensors read it, (responses, n); NaN without steady-state motion."""
        channel_gains, reference_gain = self.gains(x, group.curves)
        displacement_ratio = self._displacement_ratio(x, group, scene, search)[list(group.curves.bodies)]
        return channel_gains[:, None] / reference_gain * displacement_ratio

    def _displacement_ratio(self, x: Array, group: Group, scene: Scene, search: bool = True) -> ComplexArray:
        """Return displacement of the bodies / reference, shape (bodies, n)."""
        curves = group.curves
        level, frequency = self.operating_points(x, curves)
        # The gain of the reference sensor changes the true level, which affects only orbits.
        reference_gain = 0.0 if group.orbits is None else self.gains(x, curves)[1]
        key = (*x[: len(self.parameters)].tolist(), float(x[-1]) if self.clock_tolerance > 0.0 else 0.0, reference_gain)
        if group.cached is None or group.cached[0] != key or (search and not group.cached[1]):
            test_scene = scene_of_test(scene, curves)
            if group.orbits is None:
                displacement_ratio = linear_response(test_scene, curves, frequency)[0]
            else:
                displacement_ratio = group.orbits.response(test_scene, level, frequency, search)
            group.cached = (key, search, displacement_ratio)
        return group.cached[2]

    def normalized_residuals(
        self, x: Array, group: Group, scene: Scene, model_error: float = 0.0, search: bool = True
    ) -> ComplexArray:
        """Return normalized residuals of fitted points with the `model_error`; (fitted, responses)."""
        curves, is_fitted = group.curves, group.is_fitted
        residual = self.predicted(x, group, scene, search)[:, is_fitted] - curves.value[:, is_fitted]
        whitened = np.einsum("nij,jn->ni", curves.whitening[is_fitted], residual)
        whitened = whitened / np.sqrt(1.0 + (model_error * group.local_peak[is_fitted]) ** 2)
        return np.where(np.isfinite(whitened), whitened, _FAILED_RESIDUAL * (1 + 1j))

    def residual(self, x: Array, groups: Sequence[Group], model_error: float = 0.0, search: bool = True) -> Array:
        """Return normalized residuals: real parts, imaginary parts, deviations of unknowns from priors."""
        scene = self.scene(x)
        residuals = [self.normalized_residuals(x, group, scene, model_error, search).ravel() for group in groups]
        flat = np.concatenate([np.zeros(0, dtype=complex), *residuals])
        return np.concatenate([flat.real, flat.imag, (x - self.start) / self.prior_sd])

    def jacobian(
        self, x: Array, groups: Sequence[Group], model_error: float = 0.0, active: Sequence[int] | None = None
    ) -> Array:
        """Return the Jacobian of `residual`, shape (residuals, active).

        `active`: indices of the unknowns to vary; default: all. Derivatives are in closed form where the rig is linear,
        and finite differences of refined orbits elsewhere.
        """
        indices = list(range(self.size)) if active is None else list(active)
        scene = self.scene(x)
        moving = [group for group in groups if group.orbits is not None]
        differences = iter(self._finite_differences(x, moving, scene, model_error, indices))
        parts = [
            next(differences) if group.orbits else self._linear_derivatives(x, group, scene, model_error, indices)
            for group in groups
        ]
        flat = np.concatenate([np.zeros((0, len(indices))), *(part.reshape(-1, len(indices)) for part in parts)])
        prior = np.zeros((self.size, len(indices)))
        prior[indices, range(len(indices))] = 1.0 / self.prior_sd[indices]
        return np.concatenate([flat.real, flat.imag, prior])

    def _finite_differences(
        self, x: Array, groups: Sequence[Group], scene: Scene, model_error: float, indices: Sequence[int]
    ) -> list[ComplexArray]:
        """Differentiate the residuals of each group by central differences; shape (fitted, responses, indices)."""
        # The error of a forward difference near a resonance would appear as information on undetermined values, such as
        # a common factor of masses, stiffnesses and force.
        if not groups:
            return []
        for group in groups:
            self._displacement_ratio(x, group, scene)  # stores the orbits at x
        stored_ratios = [group.cached for group in groups]
        derivatives = [
            np.zeros((*group.curves.whitening[group.is_fitted].shape[:2], len(indices)), complex) for group in groups
        ]
        for column, k in enumerate(indices):
            for sign in (1.0, -1.0):
                shifted = x.copy()
                shifted[k] += sign * _UNKNOWN_STEP
                shifted_scene = self.scene(shifted)
                for group, derivative in zip(groups, derivatives, strict=True):
                    residual = self.normalized_residuals(shifted, group, shifted_scene, model_error, search=False)
                    derivative[..., column] += sign * residual / (2.0 * _UNKNOWN_STEP)
        for group, displacement_ratio in zip(groups, stored_ratios, strict=True):
            group.cached = displacement_ratio
        return derivatives

    def _linear_derivatives(
        self, x: Array, group: Group, scene: Scene, model_error: float, indices: Sequence[int]
    ) -> ComplexArray:
        """Differentiate the residuals of a group in which no damper moves; shape (fitted, responses, indices)."""
        curves, is_fitted, count = group.curves, group.is_fitted, len(self.parameters)
        # With no damper in flight the response depends only on the mass of a resting damper, and on mass, spring and
        # damping of a tuned mass damper; the derivatives by all other keys of dampers are 0.
        linear_damper_keys = ("mass", "mass_ratio", "spring", "damping")
        effective = [
            k
            for k in indices
            if k < count
            and (
                self.parameters[k].damper is None
                or self.parameters[k].key_path[2:] in [(key,) for key in linear_damper_keys]
            )
        ]
        values, (channel_gains, reference_gain) = self.values(x), self.gains(x, curves)
        changed_scenes = [self._changed_scene(k, float(values[k]), scene, curves) for k in effective]
        frequency = self.operating_points(x, curves)[1]
        by_value, by_frequency = linear_derivatives(scene_of_test(scene, curves), curves, frequency, changed_scenes)
        channel_gains, bodies = channel_gains[:, None], list(curves.bodies)
        displacement_ratio = self._displacement_ratio(x, group, scene)[bodies]
        derivatives = np.zeros((len(indices), *curves.value.shape), dtype=complex)
        for column, k in enumerate(indices):
            if k in effective:
                value_by_unknown = values[k] * self.parameters[k].slope(float(values[k]))
                by_parameter = by_value[effective.index(k)][bodies]
                derivatives[column] = channel_gains / reference_gain * by_parameter * value_by_unknown
            elif count <= k < count + len(self.sensors):
                sensor = self.sensors[k - count]
                measures_response = np.array([[float(other == sensor)] for other in curves.sensors])
                measures_reference = float(curves.reference_sensor == sensor)
                by_sensor = (measures_response - measures_reference * channel_gains / reference_gain) / reference_gain
                derivatives[column] = by_sensor * displacement_ratio
            elif k >= count:
                derivatives[column] = channel_gains / reference_gain * by_frequency[bodies] * curves.frequency
        whitened = np.einsum("nij,cjn->nic", curves.whitening[is_fitted], derivatives[:, :, is_fitted])
        return whitened / np.sqrt(1.0 + (model_error * group.local_peak[is_fitted]) ** 2)[..., None]

    def _changed_scene(self, k: int, value: float, scene: Scene, curves: Curves) -> tuple[Scene, float]:
        """Return the `scene` with a slightly larger value of parameter k, which has this `value`, and the change."""
        changed = value * (1.0 + _PARAMETER_STEP)
        return scene_of_test(with_values(scene, {self.parameters[k].key_path: changed}), curves), changed - value


def _local_peaks(curves: Curves) -> Array:
    """Return the largest magnitude near each point, in standard deviations of that point, shape (n, responses)."""
    order = np.argsort(curves.frequency, kind="stable")
    largest = np.empty(curves.value.T.shape)
    largest[order] = neighboring_maxima(curves.frequency[order], np.abs(curves.value[:, order])).T
    return largest * abs(np.einsum("nii->ni", curves.whitening))
