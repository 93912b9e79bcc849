"""Frequency responses: every line lies within its stated 95 % bound of the exact curve, or is marked, or is refused.

Judged twice: the whole bound against the structure, and the bound without sensor tolerances against the structure
as its actual sensors show it. The second comparison prevents wide tolerances from hiding other errors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy import special

import analysis
import rig
from analysis.responses.multisine import LIFTED, NONLINEAR, ONE_REALISATION
from daq.signal_chain.devices import accelerometer, force_sensor
from rig.results.response import MOTIONS, Response
from rig.results.uncertainty import CLOCK, SENSITIVITY
from rig.scene.measurement_chain import Accelerometer, Hammer
from rig.scene.presets import complete_from_preset
from rig.scene.shaker import ForceShaker
from rig.system.structural_model import receptance
from tests.gauntlet.cavities import STEPS, TONE
from tests.gauntlet.verdict import Case, Outcome, Verdict

# Smallest share of the lines of a scene within their bounds. With few lines chance alone can violate it; then the
# joint probability of errors as large under correct bounds decides, which must exceed CHANCE.
FEWEST_INSIDE, CHANCE = 0.7, 1e-4
# A line is misleading beyond FAR_BOUNDS bounds and beyond FAR of the true value; MOST_FAR is the largest share of
# such lines.
FAR_BOUNDS, FAR, MOST_FAR = 3.0, 0.05, 0.02
# Largest share of lines without a value, without a finite bound, or marked as unsteady.
MOST_UNRESOLVED = 0.3
# Warnings that the whole curve is not a response to steady tones, with the reason. No other warning excuses a wrong
# line.
_NOT_TONES = (
    LIFTED,
    NONLINEAR,
    ONE_REALISATION,
    "was measured before steady state",
    "too fast to reach steady state",
)
# Relative rounding error of curves without noise.
_ROUNDING = 1e-9
# Relative change of the force for the derivative of a response with respect to it.
_MORE_FORCE = 2e-3
# Larger relative derivatives belong to a change to another kind of motion.
_STEEPEST = 20.0
# Relative standard deviation of the true amplitudes of single periods above which the motion of a window is irregular,
# and the number of periods compared.
_IRREGULAR, _PERIODS = 0.02, 10
# Largest relative deviation of the force for which the first-order correction is accurate to about 1e-5.
_NEAR = 2e-3


@dataclass
class _Tally:
    """Counts of lines within their bounds, of misleading lines, and of lines without a claim."""

    name: str
    inside: int = 0
    points: int = 0
    by_chance: float = 1.0
    """Joint probability of errors as large, for the least likely curve."""
    far: int = 0
    refused: int = 0
    marked: int = 0
    widths: list[float] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def add(self, frf: Response, exact: NDArray[np.complex128]) -> None:
        bound, known = frf.bound(0.95), np.isfinite(exact)
        size, wrong = np.maximum(abs(exact), 1e-300), abs(frf.value - exact)
        bound = bound + _ROUNDING * size
        resolved = np.isfinite(frf.value) & np.isfinite(bound)
        steady = np.ones(resolved.size, dtype=bool) if frf.unsteady is None else ~frf.unsteady
        judged, good = known & resolved & steady, wrong <= bound
        self.inside += int(np.sum(good & judged))
        self.points += int(judged.sum())
        self.refused += int(np.sum(known & ~resolved))
        self.marked += int(np.sum(known & resolved & ~steady))
        self.far += int(np.sum(judged & (wrong > FAR_BOUNDS * bound) & (wrong > FAR * size)))
        if judged.any():
            # An error exceeds k times its 95 % bound with a probability of 0.05 to the power of k squared.
            exponent = -np.log(0.05) * np.sum((wrong / bound)[judged] ** 2)
            self.by_chance = min(self.by_chance, float(special.gammaincc(judged.sum(), exponent)))
            self.widths += (bound / size)[judged].tolist()
            worst = int(np.argmax(np.where(judged, wrong / bound, 0.0)))
            self.notes.append(
                f"{frf.response} {good[judged].mean():.0%} (largest error {wrong[worst] / size[worst]:.2%}, bound "
                f"{bound[worst] / size[worst]:.2%}, at {frf.frequency[worst]:.4g} Hz; median "
                f"{np.median((wrong / size)[judged]):.2%}, bound {np.median((bound / size)[judged]):.2%})"
            )

    def verdict(self, kind: str, warnings: list[str]) -> Verdict:
        lines = self.points + self.refused + self.marked
        enough = self.inside >= FEWEST_INSIDE * self.points or self.by_chance > CHANCE
        holds = enough and self.far <= MOST_FAR * self.points
        outcome: Outcome
        if self.refused > MOST_UNRESOLVED * lines:
            outcome = "refused"
        elif self.marked > MOST_UNRESOLVED * lines or any(
            cause in text for text in warnings for cause in _NOT_TONES
        ):
            outcome = "warned"
        else:
            outcome = "right" if holds else "wrong"
        note = "; ".join(self.notes) + "".join(f" [{text}]" for text in dict.fromkeys(warnings))
        # Curves that are refused or warned of as a whole have no bounds to count.
        counted = outcome in ("right", "wrong")
        return Verdict(
            self.name,
            kind,
            outcome,
            self.inside if counted else 0,
            self.points if counted else 0,
            float(np.median(self.widths)) if self.widths else np.nan,
            note,
        )


def judge(case: Case, kind: str) -> list[Verdict]:
    """Compare all curves of a recording with closed form or exact orbits."""
    if case.scene.test.kind == "free" or kind in (TONE, STEPS):
        return []
    whole, random = _Tally("responses"), _Tally("responses, as built")
    warnings: list[str] = []
    known = _where_regular(case, _truth(case.scene))
    truth, close = _at_forces(case, known, np.inf), _at_forces(case, known, _NEAR)
    for group in analysis.frequency_responses(case.recording):
        for frf in group:
            warnings += frf.warnings
            body = int(case.recording.channels[frf.response].at.split()[1]) - 1
            whole.add(frf, truth(frf.frequency)[body])
            within_tolerance = replace(frf, uncertainty=frf.uncertainty.without(SENSITIVITY, CLOCK))
            random.add(within_tolerance, _as_built(case, frf, close))
    return [tally.verdict(kind, warnings) for tally in (whole, random)]


def _truth(scene: rig.Scene) -> Callable[[NDArray[np.float64]], NDArray[np.complex128]]:
    """Return a function for the receptances of all bodies, NaN where the motion is irregular; results are stored."""
    known: dict[bytes, NDArray[np.complex128]] = {}

    def exact(frequency: NDArray[np.float64]) -> NDArray[np.complex128]:
        key = frequency.tobytes()
        if key not in known:
            if scene.test.kind == "multisine":
                # With dampers in flight the estimate warns that it is no response to tones; otherwise the dampers
                # are at rest.
                dampers = [damper.replace(locked=True) for damper in scene.dampers]
                known[key] = receptance(scene.replace(dampers=dampers), frequency)
            elif scene.dampers and isinstance(scene.driven_shaker, ForceShaker):
                response = rig.orbit_response(scene, frequency)
                known[key] = np.where(response.simulated, np.nan, response.compliance)
            elif scene.dampers:
                known[key] = _settled(scene, frequency)
            else:
                known[key] = receptance(scene, frequency)
        return known[key]

    return exact


def _where_regular(
    case: Case, exact: Callable[[NDArray[np.float64]], NDArray[np.complex128]]
) -> Callable[[NDArray[np.float64]], NDArray[np.complex128]]:
    """Return ``exact`` with NaN where the recorded true motion was irregular, and so not on the stable orbit."""
    rec, irregular = case.recording, []
    if not case.scene.dampers or rec.truth_points == ():
        return exact
    for marker in rec.markers:
        if marker.kind == "measure" and "frequency" in marker.fields and marker.last_sample is not None:
            period = rec.rate / marker.fields["frequency"]
            first, whole = marker.first_sample, int((marker.stop - marker.first_sample) / period)
            edges = np.round(first + period * np.linspace(0, whole, min(whole, _PERIODS) + 1)).astype(int)
            motion = rec.truth("displacement", edges[0], edges[-1])
            tone = motion * np.exp(-2j * np.pi * np.arange(motion.shape[1]) / period)
            parts = np.array([part.mean(axis=1) for part in np.split(tone, edges[1:-1] - first, axis=1)])
            if np.any(parts.std(axis=0) > _IRREGULAR * abs(parts.mean(axis=0))):
                irregular.append(marker.fields["frequency"])

    def known(frequency: NDArray[np.float64]) -> NDArray[np.complex128]:
        others = np.isclose(frequency[:, None], np.array(irregular), rtol=1e-3, atol=0.0).any(axis=1)
        return np.where(others, np.nan, exact(frequency))

    return known


def _settled(scene: rig.Scene, frequency: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Receptances with a coil spring, through which the dampers' harmonics act back on the force."""
    down = getattr(scene.test, "direction", "up") == "down"
    response = rig.frequency_response(scene, frequency, direction="down" if down else "up", longest=3000)
    order = np.argsort(response.frequency)
    known = np.where(response.converged, response.compliance, np.nan)[:, order]
    return known[:, np.searchsorted(response.frequency[order], frequency)]


def _at_forces(
    case: Case, truth: Callable[[NDArray[np.float64]], NDArray[np.complex128]], most: float
) -> Callable[[NDArray[np.float64]], NDArray[np.complex128]]:
    """Return a function for the receptances at the actual forces, to first order; NaN beyond its range of validity.

    The controller holds the reading of sensors with deviations, within its tolerance. The response of a nonlinear
    structure is that to the actual force, not to the specified one.
    """
    scene = case.scene
    read = {
        marker.fields["frequency"]: marker.fields["force"]
        for marker in case.recording.markers
        if marker.kind == "measure" and "frequency" in marker.fields and "force" in marker.fields
    }
    if not scene.dampers or not read or scene.test.force is None:
        return truth
    more = _truth(scene.replace(test=scene.test.replace(force=scene.test.force * (1.0 + _MORE_FORCE))))
    frequencies, forces = np.array(list(read)), np.array(list(read.values()))

    def exact(frequency: NDArray[np.float64]) -> NDArray[np.complex128]:
        known = truth(frequency)
        near = np.argmin(abs(frequency[:, None] - frequencies), axis=1)
        with np.errstate(invalid="ignore"):
            deviation = forces[near] / abs(_force_reads(case, frequency, known)) / scene.test.force - 1.0
            slope = (more(frequency) - known) / _MORE_FORCE
            # A steeper slope means that more force leads to another kind of motion: the first order is invalid.
            smooth = abs(slope) < _STEEPEST * abs(known)
            return np.asarray(np.where((abs(deviation) <= most) & smooth, known + slope * deviation, np.nan))

    return exact


def _gain(case: Case, name: str, frequency: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Ratio of reading to true value of a channel at nominal frequencies, with its actual sensor and clock."""
    channel = next(channel for channel in case.scene.channels or () if channel.name == name)
    clock, info = 1.0 + (case.scene.converter.clock_error or 0.0), case.recording.channels[name]
    # The data sheet's response is applied at the nominal frequency, while the sensor acts at the true one.
    shift = info.response(frequency * clock) / info.response(frequency)
    if channel.measures_force:
        deviation = force_sensor(
            complete_from_preset(channel.hammer or Hammer()), case.scene.seed, name
        ).deviation
        return np.asarray((1.0 + deviation) * shift)
    sensor = accelerometer(
        complete_from_preset(channel.accelerometer or Accelerometer()), case.scene.seed, name
    )
    return np.asarray((1.0 + sensor.deviation) * shift * clock ** MOTIONS.index(info.quantity))


def _force_reads(
    case: Case, frequency: NDArray[np.float64], exact: NDArray[np.complex128]
) -> NDArray[np.complex128]:
    """Ratio of the reading to the true force, from the receptances of all bodies."""
    channels = case.scene.channels or ()
    force = next((channel.name for channel in channels if channel.measures_force), None)
    if force is not None:
        return _gain(case, force, frequency)
    table = next(channel.name for channel in channels if channel.at == "table")
    number = case.scene.shaker.bodies[0]
    driven = next(channel.name for channel in channels if channel.at == f"body {number}")
    # The spring force is read as the difference of the displacements at its ends.
    spring = case.scene.shaker.spring * exact[number - 1]
    # NaN where the truth is unknown; such lines are not judged.
    with np.errstate(invalid="ignore"):
        reads = _gain(case, table, frequency) * (1.0 + spring) - _gain(case, driven, frequency) * spring
    return np.asarray(reads)


def _as_built(
    case: Case, frf: Response, truth: Callable[[NDArray[np.float64]], NDArray[np.complex128]]
) -> NDArray[np.complex128]:
    """Exact curve as the actual sensors, with their deviations from the data sheets, show it."""
    # With a clock error the true frequencies differ from the nominal ones.
    exact = truth(frf.frequency * (1.0 + (case.scene.converter.clock_error or 0.0)))
    body = int(case.recording.channels[frf.response].at.split()[1])
    with np.errstate(invalid="ignore"):
        reading = exact[body - 1] * _gain(case, frf.response, frf.frequency)
        return np.asarray(reading / _force_reads(case, frf.frequency, exact))
