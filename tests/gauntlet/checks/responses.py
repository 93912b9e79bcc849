"""Check of frequency responses: the exact curve lies within the 95 % interval of each line, or the line is marked.

"responses" compares full intervals with the exact response of the structure. "responses, as built" compares intervals
without sensor tolerances with the exact response as the drawn sensors read it. These sensors deviate from their data
sheets. The second comparison reveals errors that wide tolerances would hide. "magnitudes" compares expanded
uncertainties of magnitudes, at lines and between them, where the response is interpolated or refused.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy import special

import analysis
import rig
from analysis.core.responses.multisine import LIFTED, NONLINEAR, ONE_REALIZATION
from daq.core.recording.markers import Marker
from daq.core.recording.recording import Recording
from daq.core.signal_chain.devices import accelerometer, force_sensor
from rig.core.base.errors import SceneError
from rig.core.results.response import MOTIONS, Response
from rig.core.results.uncertainty import CLOCK, SENSITIVITY
from rig.core.scene.measurement_chain import Accelerometer, Hammer
from rig.core.scene.presets import complete_from_preset
from rig.core.scene.shaker import ForceShaker
from rig.core.system.structural_model import receptance
from tests.gauntlet.controlled_tones import BACKBONE, CURVE, FOLDS, HELD
from tests.gauntlet.instant_contact import STEPS, TONE
from tests.gauntlet.result import Case, CheckResult, Outcome
from tests.gauntlet.two_shakers import exact_receptance

# Function from frequencies [Hz] to the receptances of all bodies (bodies, frequencies), m/N.
ReceptanceFunction = Callable[[NDArray[np.float64]], NDArray[np.complex128]]

# At least this fraction of the lines of a scene must lie within their intervals.
MIN_COVERAGE = 0.7
# With few lines, chance alone can violate `MIN_COVERAGE`. A scene is also correct if the joint probability of its
# errors under correct intervals exceeds this.
MIN_PROBABILITY = 1e-4
# A line is misleading if its error exceeds both this multiple of its bound and `MISLEADING_ERROR`.
MISLEADING_BOUNDS = 3.0
# A misleading line has at least this error, relative to the true value.
MISLEADING_ERROR = 0.05
# At most this fraction of the lines may be misleading.
MAX_MISLEADING_FRACTION = 0.02
# At most this fraction of the lines may have no value, no finite bound, or the mark of an unsteady point.
MAX_UNRESOLVED_FRACTION = 0.3
# Warnings that the complete curve is not a response to steady tones. No other warning excuses a wrong line.
_NOT_TONES = (LIFTED, NONLINEAR, ONE_REALIZATION, "was measured before steady state", "too fast to reach steady state")
# Relative error of the truth of a nonlinear structure, relative to that of the images of the drive,
# (frequency / rate)²: the drive is interpolated between its samples, while the exact orbits have a sinusoidal force. A
# rate four times as high reduces this error by a factor of 16.
_IMAGE_SENSITIVITY = 5.0
# Relative rounding error of curves without noise.
_ROUNDING = 1e-9
# The derivative of a response with respect to the force is computed with this relative change of the force.
_FORCE_STEP = 2e-3
# A larger relative derivative than this indicates a change to another type of motion.
_MAX_RELATIVE_SLOPE = 20.0
# The true motion is regular if the amplitudes in parts of a measurement have at most this relative standard deviation.
_MAX_AMPLITUDE_DEVIATION = 0.02
# In steady state, the true amplitude changes from the first to the second half of a measurement by at most this
# fraction. A transient as large as `_MIN_DIFFERENCE_OF_MOTIONS` decays by more.
_MAX_STEADY_DRIFT = 1e-3
# A steady-state motion is not the computed periodic orbit, but a coexisting stable motion, if the amplitudes differ by
# more than this fraction.
_MIN_DIFFERENCE_OF_MOTIONS = 0.01
# An orbit and a simulation to steady state of the same motion differ by at most this fraction.
_MAX_DIFFERENCE_OF_METHODS = 1e-3
# Number of parts of a measurement, each of whole periods, whose amplitudes are compared.
_COMPARED_PARTS = 10
# Number of steps between lines at which a curve is interpolated.
_BETWEEN_LINES = 20
# The first-order correction is accurate to about 1e-5 up to this relative deviation of the force.
_MAX_FORCE_DEVIATION = 2e-3


@dataclass
class _Tally:
    """Numbers of lines of all curves of a recording, by the outcome of their comparison with the exact curve."""

    name: str
    inside: int = 0
    """Lines within their bounds."""
    points: int = 0
    """Compared lines: those with a finite bound that are not marked as unsteady."""
    probability: float = 1.0
    """Joint probability of errors that are at least as large, for the least likely curve."""
    misleading: int = 0
    unresolved: int = 0
    """Lines without a value or without a finite bound."""
    unsteady: int = 0
    """Lines marked as unsteady."""
    relative_bounds: list[float] = field(default_factory=list)
    """Bound relative to the true value, for each compared line."""
    notes: list[str] = field(default_factory=list)

    def add(self, frf: Response, exact: NDArray[np.complex128], truth_error: NDArray[np.float64] | float = 0.0) -> None:
        """Add the lines of a curve; lines where the exact curve is NaN do not count.

        `truth_error`: largest relative error of `exact`.
        """
        bound, is_known = frf.bound(0.95), np.isfinite(exact)
        magnitude, error = np.maximum(abs(exact), 1e-300), abs(frf.value - exact)
        bound = bound + (_ROUNDING + truth_error) * magnitude
        resolved = np.isfinite(frf.value) & np.isfinite(bound)
        steady = np.ones(resolved.size, dtype=bool) if frf.unsteady is None else ~frf.unsteady
        compared, is_inside = is_known & resolved & steady, error <= bound
        self.inside += int(np.sum(is_inside & compared))
        self.points += int(compared.sum())
        self.unresolved += int(np.sum(is_known & ~resolved))
        self.unsteady += int(np.sum(is_known & resolved & ~steady))
        self.misleading += int(
            np.sum(compared & (error > MISLEADING_BOUNDS * bound) & (error > MISLEADING_ERROR * magnitude))
        )
        if compared.any():
            # A complex Gaussian error exceeds k times its 95 % bound with a probability of 0.05^(k^2). Therefore the
            # sum of these exponents has a gamma distribution.
            exponent = -np.log(0.05) * np.sum((error / bound)[compared] ** 2)
            self.probability = min(self.probability, float(special.gammaincc(compared.sum(), exponent)))
            self.relative_bounds += (bound / magnitude)[compared].tolist()
            worst = int(np.argmax(np.where(compared, error / bound, 0.0)))
            self.notes.append(
                f"{frf.response} {is_inside[compared].mean():.0%} "
                f"(largest error {error[worst] / magnitude[worst]:.2%}, bound {bound[worst] / magnitude[worst]:.2%}, "
                f"at {frf.frequency[worst]:.4g} Hz; median "
                f"{np.median((error / magnitude)[compared]):.2%}, bound {np.median((bound / magnitude)[compared]):.2%})"
            )

    def result(self, kind: str, warnings: list[str]) -> CheckResult:
        """Return the result on all added curves, given the warnings of the analysis."""
        lines = self.points + self.unresolved + self.unsteady
        covered = self.inside >= MIN_COVERAGE * self.points or self.probability > MIN_PROBABILITY
        is_correct = covered and self.misleading <= MAX_MISLEADING_FRACTION * self.points
        outcome: Outcome
        if self.unresolved > MAX_UNRESOLVED_FRACTION * lines:
            outcome = "refused"
        elif self.unsteady > MAX_UNRESOLVED_FRACTION * lines or any(
            cause in text for text in warnings for cause in _NOT_TONES
        ):
            outcome = "warned"
        else:
            outcome = "correct" if is_correct else "wrong"
        note = "; ".join(self.notes) + "".join(f" [{text}]" for text in dict.fromkeys(warnings))
        # The lines of refused curves, and of curves with a warning, do not count.
        counted = outcome in ("correct", "wrong")
        return CheckResult(
            self.name,
            kind,
            outcome,
            self.inside if counted else 0,
            self.points if counted else 0,
            float(np.median(self.relative_bounds)) if self.relative_bounds else np.nan,
            note,
        )


def check(case: Case, kind: str) -> list[CheckResult]:
    """Compare all curves of a recording with closed form or exact orbits."""
    if not case.recording.test.drives or kind in (TONE, STEPS, HELD, BACKBONE, CURVE, FOLDS):
        return []
    if len(case.scene.shakers) > 1:
        return _check_several_shakers(case, kind)
    full_bound, without_tolerances = _Tally("responses"), _Tally("responses, as built")
    warnings: list[str] = []
    # The truth where the motion is regular, corrected to the actual forces. For intervals without tolerances the
    # correction is accurate enough only near the nominal force.
    regular_truth = _exclude_irregular(case, _truth(case.scene))
    truth = _truth_at_actual_forces(case, regular_truth, np.inf)
    truth_near_nominal_force = _truth_at_actual_forces(case, regular_truth, _MAX_FORCE_DEVIATION)
    sensitivity = 0.0 if case.scene.is_linear else _IMAGE_SENSITIVITY
    magnitudes: dict[str, list[tuple[Response, NDArray[np.complex128]]]] = {
        "magnitudes": [],
        "magnitudes, as built": [],
    }
    for group in analysis.frequency_responses(case.recording):
        for frf in group:
            warnings += frf.warnings
            body = case.recording.channels[frf.response].body - 1
            if case.scene.is_linear:
                for selected in (frf, *_between_lines(frf)):
                    magnitudes["magnitudes"].append((selected, truth(selected.frequency)[body]))
                    exact = _curve_of_actual_sensors(case, selected, truth_near_nominal_force)
                    magnitudes["magnitudes, as built"].append((selected.without(SENSITIVITY, CLOCK), exact))
            truth_error = sensitivity * (frf.frequency / case.recording.rate) ** 2
            full_bound.add(frf, truth(frf.frequency)[body], truth_error)
            frf_without_tolerances = replace(frf, uncertainty=frf.uncertainty.without(SENSITIVITY, CLOCK))
            curve = _curve_of_actual_sensors(case, frf, truth_near_nominal_force)
            without_tolerances.add(frf_without_tolerances, curve, truth_error)
    results = [tally.result(kind, warnings) for tally in (full_bound, without_tolerances)]
    if results[1].outcome == "correct":
        results += [_magnitude_result(name, kind, compared) for name, compared in magnitudes.items() if compared]
    return results


def _between_lines(frf: Response) -> list[Response]:
    """Return values between lines, at frequencies that the analysis does not refuse."""
    ordered, values = frf.sorted(), []
    steps = np.linspace(0, frf.frequency.size - 2, _BETWEEN_LINES).astype(int)
    for step in np.unique(steps[steps >= 0]):
        try:
            values.append(frf.interpolated(ordered.frequency[step : step + 2].mean()))
        except SceneError:
            continue
    return values


def _magnitude_result(name: str, kind: str, compared: list[tuple[Response, NDArray[np.complex128]]]) -> CheckResult:
    """Return the numbers of magnitudes within their expanded uncertainty."""
    inside, relative = [], []
    for frf, exact in compared:
        expanded, truth = frf.expanded(), np.maximum(abs(exact), 1e-300)
        is_known = np.isfinite(exact) & np.isfinite(frf.value) & np.isfinite(expanded)
        if frf.unsteady is not None:
            is_known &= ~frf.unsteady
        inside.append((abs(abs(frf.value) - truth) <= expanded + _ROUNDING * truth)[is_known])
        relative.append((expanded / truth)[is_known])
    all_inside = np.concatenate(inside)
    median = float(np.median(np.concatenate(relative))) if all_inside.size else np.nan
    return CheckResult(name, kind, "correct", int(all_inside.sum()), all_inside.size, median)


def _check_several_shakers(case: Case, kind: str) -> list[CheckResult]:
    """Compare the responses to each of several simultaneous forces with closed form."""
    full_bound, without_tolerances = _Tally("responses"), _Tally("responses, as built")
    warnings: list[str] = []
    shaker_numbers = {
        f"force at body {shaker.bodies[0]}": number for number, shaker in enumerate(case.scene.shakers, 1)
    }
    clock = 1.0 + (case.scene.converter.clock_error or 0.0)
    for matrix in analysis.frequency_responses(case.recording):
        for frf in matrix:
            warnings += frf.warnings
            body = case.recording.channels[frf.response].body - 1
            shaker = shaker_numbers[frf.input]
            full_bound.add(frf, exact_receptance(case.scene, frf.frequency, shaker)[body])
            frf_without_tolerances = replace(frf, uncertainty=frf.uncertainty.without(SENSITIVITY, CLOCK))
            gain = _gain(case, frf.response, frf.frequency) / _gain(case, f"f{shaker}", frf.frequency)
            without_tolerances.add(
                frf_without_tolerances, exact_receptance(case.scene, clock * frf.frequency, shaker)[body] * gain
            )
    return [tally.result(kind, warnings) for tally in (full_bound, without_tolerances)]


def _truth(scene: rig.Scene) -> ReceptanceFunction:
    """Return a function for the true receptances of all bodies, with a cache.

    NaN where the motion is irregular, or where two stable motions exist, between which the course of the test decides.
    """
    cache: dict[bytes, NDArray[np.complex128]] = {}

    def exact(frequency: NDArray[np.float64]) -> NDArray[np.complex128]:
        key = frequency.tobytes()
        if key not in cache:
            if scene.test.kind == "multisine":
                # If dampers fly, the analysis warns and the curve is not compared. Otherwise the dampers are at rest.
                dampers = [damper.replace(locked=True) for damper in scene.dampers]
                cache[key] = receptance(scene.replace(dampers=dampers), frequency)
            elif not scene.is_linear and isinstance(scene.driven_shaker, ForceShaker):
                response = rig.orbit_response(scene, frequency)
                settled = _steady_receptance(scene, frequency)
                differs = np.any(abs(settled / response.compliance - 1.0) > _MAX_DIFFERENCE_OF_METHODS, axis=0)
                cache[key] = np.where(response.simulated | differs, np.nan, response.compliance)
            elif not scene.is_linear:
                # Through the coil spring, the harmonics of dampers and joints affect the force.
                cache[key] = _steady_receptance(scene, frequency)
            else:
                cache[key] = receptance(scene, frequency)
        return cache[key]

    return exact


def _exclude_irregular(case: Case, exact: ReceptanceFunction) -> ReceptanceFunction:
    """Return ``exact``, with NaN where the recorded true motion is irregular or another steady-state motion."""
    recording, excluded = case.recording, []
    if case.scene.is_linear or recording.truth_points == ():
        return exact
    for marker in recording.markers:
        if marker.kind == "measure" and "frequency" in marker.fields and marker.last_sample is not None:
            frequency = marker.fields["frequency"]
            amplitudes = _amplitudes_of_parts(recording, marker)
            mean, middle = amplitudes.mean(axis=0), len(amplitudes) // 2
            drift = np.max(abs(amplitudes[:middle].mean(axis=0) - amplitudes[middle:].mean(axis=0)) / mean)
            is_irregular = np.any(amplitudes.std(axis=0) > _MAX_AMPLITUDE_DEVIATION * mean)
            is_other_motion = False
            if drift < _MAX_STEADY_DRIFT and isinstance(case.scene.driven_shaker, ForceShaker):
                # The drive of an ideal force shaker is the force, N.
                expected = marker.fields["drive"] * abs(exact(np.array([frequency]))[: len(mean), 0])
                is_other_motion = np.any(abs(mean / expected - 1.0) > _MIN_DIFFERENCE_OF_MOTIONS)
            if is_irregular or is_other_motion:
                excluded.append(frequency)

    def regular(frequency: NDArray[np.float64]) -> NDArray[np.complex128]:
        is_excluded = np.isclose(frequency[:, None], np.array(excluded), rtol=1e-3, atol=0.0).any(axis=1)
        return np.where(is_excluded, np.nan, exact(frequency))

    return regular


def _amplitudes_of_parts(recording: Recording, marker: Marker) -> NDArray[np.float64]:
    """Return true displacement amplitudes at the frequency of a measurement in parts of it (parts, bodies), m."""
    period = recording.rate / marker.fields["frequency"]
    n_periods = int((marker.stop - marker.first_sample) / period)
    part_periods = max(n_periods // _COMPARED_PARTS, 1)
    edges = np.arange(n_periods // part_periods + 1) * part_periods * period
    edges = marker.first_sample + np.round(edges).astype(int)
    motion = recording.truth("displacement", edges[0], edges[-1])
    demodulated = motion * np.exp(-2j * np.pi * np.arange(motion.shape[1]) / period)
    parts = np.split(demodulated, edges[1:-1] - edges[0], axis=1)
    return 2.0 * abs(np.array([part.mean(axis=1) for part in parts]))


def _steady_receptance(scene: rig.Scene, frequency: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Return receptances from a simulation to steady state; NaN where it is not reached."""
    down = getattr(scene.test, "direction", "up") == "down"
    response = rig.frequency_response(scene, frequency, direction="down" if down else "up", longest=3000)
    order = np.argsort(response.frequency)
    values = np.where(response.converged, response.compliance, np.nan)[:, order]
    return values[:, np.searchsorted(response.frequency[order], frequency)]


def _truth_at_actual_forces(case: Case, truth: ReceptanceFunction, max_deviation: float) -> ReceptanceFunction:
    """Return a function for the true receptances at the actual forces, to first order in the force deviation.

    NaN where the deviation exceeds `max_deviation`. The actual force differs from the specified force within the
    tolerance of the controller, and because its sensors deviate. A nonlinear response depends on the actual force.
    """
    scene = case.scene
    readings = {
        marker.fields["frequency"]: marker.fields["force"]
        for marker in case.recording.markers
        if marker.kind == "measure" and "frequency" in marker.fields and "force" in marker.fields
    }
    if scene.is_linear or not readings or scene.test.force is None:
        return truth
    truth_at_higher_force = _truth(scene.replace(test=scene.test.replace(force=scene.test.force * (1.0 + _FORCE_STEP))))
    frequencies, forces = np.array(list(readings)), np.array(list(readings.values()))

    def exact(frequency: NDArray[np.float64]) -> NDArray[np.complex128]:
        values = truth(frequency)
        nearest = np.argmin(abs(frequency[:, None] - frequencies), axis=1)
        with np.errstate(invalid="ignore"):
            deviation = forces[nearest] / abs(_force_gain(case, frequency, values)) / scene.test.force - 1.0
            slope = (truth_at_higher_force(frequency) - values) / _FORCE_STEP
            # Where a larger force leads to another type of motion, the first order is invalid.
            smooth = abs(slope) < _MAX_RELATIVE_SLOPE * abs(values)
            return np.asarray(np.where((abs(deviation) <= max_deviation) & smooth, values + slope * deviation, np.nan))

    return exact


def _gain(case: Case, name: str, frequency: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Return the ratio of reading to true value of a channel at nominal frequencies [Hz], for its sensor and clock."""
    channel = next(channel for channel in case.scene.channels or () if channel.name == name)
    clock, info = 1.0 + (case.scene.converter.clock_error or 0.0), case.recording.channels[name]
    # The analysis corrects by the sensor's response at the nominal frequency, while the sensor acts at the true one.
    shift = info.response(frequency * clock) / info.response(frequency)
    if channel.measures_force:
        deviation = force_sensor(complete_from_preset(channel.hammer or Hammer()), case.scene.seed, name).deviation
        return np.asarray((1.0 + deviation) * shift)
    sensor = accelerometer(complete_from_preset(channel.accelerometer or Accelerometer()), case.scene.seed, name)
    return np.asarray((1.0 + sensor.deviation) * shift * clock ** MOTIONS.index(info.quantity))


def _force_gain(case: Case, frequency: NDArray[np.float64], exact: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Return the ratio of reading to true force; `exact`: receptances of all bodies."""
    channels = case.scene.channels or ()
    force = next((channel.name for channel in channels if channel.measures_force), None)
    if force is not None:
        return _gain(case, force, frequency)
    table = next(channel.name for channel in channels if channel.at == "table")
    number = case.scene.shaker.bodies[0]
    driven = next(channel.name for channel in channels if channel.at == f"body {number}")
    # The force is the spring's stiffness times the difference of the displacements of table and body. Relative to the
    # force, stiffness times displacement is 1 + r at the table and r at the body.
    r = case.scene.shaker.spring * exact[number - 1]
    # NaN where the truth is unknown; these lines are not compared.
    with np.errstate(invalid="ignore"):
        gain = _gain(case, table, frequency) * (1.0 + r) - _gain(case, driven, frequency) * r
    return np.asarray(gain)


def _curve_of_actual_sensors(case: Case, frf: Response, truth: ReceptanceFunction) -> NDArray[np.complex128]:
    """Return the exact curve as read by the actual sensors, which deviate from their data sheets."""
    # A clock error makes the true frequencies differ from the nominal frequencies.
    exact = truth(frf.frequency * (1.0 + (case.scene.converter.clock_error or 0.0)))
    body = case.recording.channels[frf.response].body
    with np.errstate(invalid="ignore"):
        reading = exact[body - 1] * _gain(case, frf.response, frf.frequency)
        return np.asarray(reading / _force_gain(case, frf.frequency, exact))
