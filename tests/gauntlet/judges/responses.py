"""Frequency responses: every line within its stated 95 % bound of the exact curve, or marked, or refused.

Judged twice: the whole bound against the structure as it is, and the bound without the sensors' tolerances against
the structure as its sensors, each a little off its data sheet, must show it. The second keeps wide tolerances from
hiding what else is wrong.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy import special

import analysis
import rig
from analysis.responses.frf import CLOCK, MOTIONS, SENSITIVITY, Frf
from analysis.responses.multisine import LIFTED, NONLINEAR, ONE_REALISATION
from daq.signal_chain.sensors import accelerometer, force_sensor
from rig.scene.measurement_chain import Accelerometer, Hammer
from rig.scene.presets import filled_in
from rig.scene.shaker import ForceShaker
from rig.system.structural_model import receptance
from tests.gauntlet.cavities import STEPS, TONE
from tests.gauntlet.verdict import Case, Outcome, Verdict

# Of the lines of a scene, so many must lie within the bound, unless it has so few that chance brings that about: errors
# whose 95 % bounds are right are as large, together, in no more than so many scenes. (Of two lines one lies outside in
# every tenth scene, whatever the bounds; one far outside in none.)
FEWEST_INSIDE, CHANCE = 0.7, 1e-4
# A line as far off as this, as a multiple of its bound and relative to the truth, misleads by itself; so many may.
FAR_BOUNDS, FAR, MOST_FAR = 3.0, 0.05, 0.02
# A scene of which more lines than this have no value or no finite bound, or are marked as unsteady, told little.
MOST_UNTOLD = 0.3
# Warnings that say of the whole curve that it is no response to steady tones, and why. No other warning excuses a
# wrong line: what is printed on every run warns of nothing.
_NOT_TONES = (
    LIFTED,
    NONLINEAR,
    ONE_REALISATION,
    "before the motion had become periodic",
    "before the motion is steady",
)
# Rounding of what has no noise at all, relative.
_ROUNDING = 1e-9
# How much more force tells how a response depends on it, relative.
_MORE_FORCE = 2e-3
# Largest relative change of a response with that of its force that is one of the same motion.
_STEEPEST = 20.0
# A force no farther off than this, relative, tells a response to some 1e-5 by that.
_NEAR = 2e-3


@dataclass
class _Tally:
    """Lines within their bounds, those far off, and those that claim nothing."""

    name: str
    inside: int = 0
    points: int = 0
    by_chance: float = 1.0
    """Chance of errors as large together, of the curve least likely."""
    far: int = 0
    refused: int = 0
    marked: int = 0
    widths: list[float] = field(default_factory=list)
    off: list[str] = field(default_factory=list)

    def add(self, frf: Frf, exact: NDArray[np.complex128]) -> None:
        bound, known = frf.bound(0.95), np.isfinite(exact)
        size, wrong = np.maximum(abs(exact), 1e-300), abs(frf.value - exact)
        bound = bound + _ROUNDING * size
        told = np.isfinite(frf.value) & np.isfinite(bound)
        steady = np.ones(told.size, dtype=bool) if frf.unsteady is None else ~frf.unsteady
        judged, good = known & told & steady, wrong <= bound
        self.inside += int(np.sum(good & judged))
        self.points += int(judged.sum())
        self.refused += int(np.sum(known & ~told))
        self.marked += int(np.sum(known & told & ~steady))
        self.far += int(np.sum(judged & (wrong > FAR_BOUNDS * bound) & (wrong > FAR * size)))
        if judged.any():
            # A normal error is k times its 95 % bound or more with a chance of 0.05 to the power of k squared.
            exponent = -np.log(0.05) * np.sum((wrong / bound)[judged] ** 2)
            self.by_chance = min(self.by_chance, float(special.gammaincc(judged.sum(), exponent)))
            self.widths += (bound / size)[judged].tolist()
            worst = int(np.argmax(np.where(judged, wrong / bound, 0.0)))
            self.off.append(
                f"{frf.response} {good[judged].mean():.0%} (worst off by {wrong[worst] / size[worst]:.2%}, bound "
                f"{bound[worst] / size[worst]:.2%}, at {frf.frequency[worst]:.4g} Hz; median "
                f"{np.median((wrong / size)[judged]):.2%}, bound {np.median((bound / size)[judged]):.2%})"
            )

    def verdict(self, kind: str, said: list[str]) -> Verdict:
        lines = self.points + self.refused + self.marked
        enough = self.inside >= FEWEST_INSIDE * self.points or self.by_chance > CHANCE
        holds = enough and self.far <= MOST_FAR * self.points
        outcome: Outcome
        if self.refused > MOST_UNTOLD * lines:
            outcome = "refused"
        elif self.marked > MOST_UNTOLD * lines or any(cause in text for text in said for cause in _NOT_TONES):
            outcome = "warned"
        else:
            outcome = "right" if holds else "wrong"
        note = "; ".join(self.off) + "".join(f" [{text}]" for text in dict.fromkeys(said))
        # What was warned of or refused as a whole claims no bounds that could be counted.
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
    said: list[str] = []
    known = _truth(case.scene)
    truth, close = _at_forces(case, known, np.inf), _at_forces(case, known, _NEAR)
    for group in analysis.frequency_responses(case.recording):
        for frf in group:
            said += frf.warnings
            body = int(case.recording.channels[frf.response].at.split()[1]) - 1
            whole.add(frf, truth(frf.frequency)[body])
            others = {name: part for name, part in frf.systematic.items() if name not in (SENSITIVITY, CLOCK)}
            random.add(replace(frf, systematic=others), _as_built(case, frf, close))
    return [tally.verdict(kind, said) for tally in (whole, random)]


def _truth(scene: rig.Scene) -> Callable[[NDArray[np.float64]], NDArray[np.complex128]]:
    """Receptances of all bodies at some frequencies, NaN where the motion is irregular; each asked for once."""
    known: dict[bytes, NDArray[np.complex128]] = {}

    def exact(frequency: NDArray[np.float64]) -> NDArray[np.complex128]:
        key = frequency.tobytes()
        if key not in known:
            if scene.test.kind == "multisine":
                # Where dampers fly it says that it is no response to tones; else it is that of what rides.
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


def _settled(scene: rig.Scene, frequency: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Receptances behind a spring, through which the dampers' harmonics act back on the force."""
    down = getattr(scene.test, "direction", "up") == "down"
    response = rig.frequency_response(scene, frequency, direction="down" if down else "up", longest=3000)
    order = np.argsort(response.frequency)
    known = np.where(response.converged, response.compliance, np.nan)[:, order]
    return known[:, np.searchsorted(response.frequency[order], frequency)]


def _at_forces(
    case: Case, truth: Callable[[NDArray[np.float64]], NDArray[np.complex128]], most: float
) -> Callable[[NDArray[np.float64]], NDArray[np.complex128]]:
    """Receptances at the forces that were there, to first order; NaN where these are off by more than that is good for.

    A controller holds what its sensors read, each a little off, and stops at its tolerance; the response of a structure
    that is not linear is that to the force that was there, whatever was asked for.
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
            off = forces[near] / abs(_force_reads(case, frequency, known)) / scene.test.force - 1.0
            slope = (more(frequency) - known) / _MORE_FORCE
            # Steeper than this it is another motion that a little more force leads to: no first order, and no truth.
            smooth = abs(slope) < _STEEPEST * abs(known)
            return np.asarray(np.where((abs(off) <= most) & smooth, known + slope * off, np.nan))

    return exact


def _gain(case: Case, name: str, frequency: NDArray[np.float64]) -> NDArray[np.complex128]:
    """What is told by a channel of what is there, at nominal frequencies: by its sensor and the clock as drawn."""
    channel = next(channel for channel in case.scene.channels or () if channel.name == name)
    clock, info = 1.0 + (case.scene.converter.clock_error or 0.0), case.recording.channels[name]
    # Told by the data sheet's response at the nominal frequency, read with that at the true one.
    off = info.response(frequency * clock) / info.response(frequency)
    if channel.measures_force:
        deviation = force_sensor(filled_in(channel.hammer or Hammer()), case.scene.seed, name).deviation
        return np.asarray((1.0 + deviation) * off)
    sensor = accelerometer(filled_in(channel.accelerometer or Accelerometer()), case.scene.seed, name)
    return np.asarray((1.0 + sensor.deviation) * off * clock ** MOTIONS.index(info.quantity))


def _force_reads(
    case: Case, frequency: NDArray[np.float64], exact: NDArray[np.complex128]
) -> NDArray[np.complex128]:
    """What the channels tell of the force for each newton that is there, by the receptances of all bodies."""
    channels = case.scene.channels or ()
    force = next((channel.name for channel in channels if channel.measures_force), None)
    if force is not None:
        return _gain(case, force, frequency)
    table = next(channel.name for channel in channels if channel.at == "table")
    number = case.scene.shaker.bodies[0]
    driven = next(channel.name for channel in channels if channel.at == f"body {number}")
    # The spring's force as the difference of what is read at its ends, per newton that is there.
    spring = case.scene.shaker.spring * exact[number - 1]
    # Not a number where the truth is none; such lines are judged nowhere.
    with np.errstate(invalid="ignore"):
        reads = _gain(case, table, frequency) * (1.0 + spring) - _gain(case, driven, frequency) * spring
    return np.asarray(reads)


def _as_built(
    case: Case, frf: Frf, truth: Callable[[NDArray[np.float64]], NDArray[np.complex128]]
) -> NDArray[np.complex128]:
    """Curve that sensors read which are off their data sheets by what the seed drew for them."""
    # Everything runs at the true rate of a clock that is off, and is told by its nominal one.
    exact = truth(frf.frequency * (1.0 + (case.scene.converter.clock_error or 0.0)))
    body = int(case.recording.channels[frf.response].at.split()[1])
    with np.errstate(invalid="ignore"):
        told = exact[body - 1] * _gain(case, frf.response, frf.frequency)
        return np.asarray(told / _force_reads(case, frf.frequency, exact))
