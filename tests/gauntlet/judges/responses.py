"""Frequency responses: every line within its stated 95 % bound of the exact curve, or a warning, or a refusal.

Judged twice: the whole bound against the structure as it is, and the bound without the sensors' tolerances against
the structure as its sensors, each a little off its data sheet, must show it. The second keeps wide tolerances from
hiding what else is wrong.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

import analysis
import rig
from analysis.responses.frf import MOTIONS, Frf
from analysis.responses.systematic import CLOCK, SENSITIVITY
from daq.signal_chain.sensors import accelerometer, force_sensor
from rig.scene.measurement_chain import Accelerometer, Hammer
from rig.scene.presets import filled_in
from rig.system.receptance import receptance
from tests.gauntlet.cavities import STEPS, TONE
from tests.gauntlet.verdict import Case, Outcome, Verdict

# Of the lines of a scene, so many must lie within the bound unless it warns.
FEWEST_INSIDE = 0.7
# A line as far off as this, as a multiple of its bound and relative to the truth, misleads by itself; so many may.
FAR_BOUNDS, FAR, MOST_FAR = 3.0, 0.05, 0.02
# Rounding of what has no noise at all, relative.
_ROUNDING = 1e-9


@dataclass
class _Tally:
    """Lines within their bounds, and those far off."""

    name: str
    inside: int = 0
    points: int = 0
    far: int = 0
    off: list[str] = field(default_factory=list)

    def add(self, frf: Frf, exact: NDArray[np.complex128], bound: NDArray[np.float64]) -> None:
        judged = np.isfinite(exact) & np.isfinite(frf.value)
        size, wrong = np.maximum(abs(exact), 1e-300), abs(frf.value - exact)
        # A line without an error bar claims nothing, and is not drawn like a measurement.
        bound = np.where(np.isnan(bound), np.inf, bound) + _ROUNDING * size
        good = wrong <= bound
        self.inside += int(np.sum(good & judged))
        self.points += int(judged.sum())
        self.far += int(np.sum(judged & (wrong > FAR_BOUNDS * bound) & (wrong > FAR * size)))
        if judged.any():
            worst = int(np.argmax(np.where(judged, wrong / bound, 0.0)))
            self.off.append(
                f"{frf.response} {good[judged].mean():.0%} (worst off by {wrong[worst] / size[worst]:.2%}, bound "
                f"{bound[worst] / size[worst]:.2%}, at {frf.frequency[worst]:.4g} Hz; median "
                f"{np.median((wrong / size)[judged]):.2%}, bound {np.median((bound / size)[judged]):.2%})"
            )

    def verdict(self, kind: str, said: list[str]) -> Verdict:
        holds = self.inside >= FEWEST_INSIDE * self.points and self.far <= MOST_FAR * self.points
        outcome: Outcome = "right" if holds else "warned" if said else "wrong"
        note = "; ".join(self.off) + "".join(f" [{text}]" for text in dict.fromkeys(said))
        return Verdict(self.name, kind, outcome, self.inside, self.points, note)


def judge(case: Case, kind: str) -> list[Verdict]:
    """Compare all curves of a recording with closed form or exact orbits."""
    if case.scene.test.kind == "free" or kind in (TONE, STEPS):
        return []
    whole, random = _Tally("responses"), _Tally("responses, as built")
    said = []
    truth = _truth(case.scene)
    for group in analysis.frequency_responses(case.recording):
        for frf in group:
            said += frf.warnings
            body = int(case.recording.channels[frf.response].at.split()[1]) - 1
            exact = truth(frf.frequency)
            whole.add(frf, exact[body], frf.bound(0.95))
            known = sum(frf.systematic.get(name, 0.0) for name in (SENSITIVITY, CLOCK))
            if np.isfinite(known).all():
                built = _as_built(case, frf, truth)
                random.add(frf, built, frf.bound(0.95) - known)
    return [tally.verdict(kind, said) for tally in (whole, random) if tally.points]


def _truth(scene: rig.Scene) -> Callable[[NDArray[np.float64]], NDArray[np.complex128]]:
    """Receptances of all bodies at some frequencies, NaN where the motion is irregular; each asked for once."""
    known: dict[bytes, NDArray[np.complex128]] = {}

    def exact(frequency: NDArray[np.float64]) -> NDArray[np.complex128]:
        key = frequency.tobytes()
        if key not in known:
            if scene.dampers:
                response = rig.orbit_response(scene, frequency)
                known[key] = np.where(response.simulated, np.nan, response.compliance)
            else:
                known[key] = receptance(scene, frequency)
        return known[key]

    return exact


def _as_built(
    case: Case, frf: Frf, truth: Callable[[NDArray[np.float64]], NDArray[np.complex128]]
) -> NDArray[np.complex128]:
    """Curve that sensors read which are off their data sheets by what the seed drew for them."""
    scene, channels = case.scene, {channel.name: channel for channel in case.scene.channels or ()}

    # Everything runs at the true rate of a clock that is off, and is told by its nominal one.
    clock = 1.0 + (scene.converter.clock_error or 0.0)

    def gain(name: str) -> float:
        channel, info = channels[name], case.recording.channels[name]
        if channel.measures_force:
            return 1.0 + force_sensor(filled_in(channel.hammer or Hammer()), scene.seed, name).deviation
        sensor = accelerometer(filled_in(channel.accelerometer or Accelerometer()), scene.seed, name)
        return float((1.0 + sensor.deviation) * clock ** MOTIONS.index(info.quantity))

    exact = truth(frf.frequency * clock)
    response = exact[int(case.recording.channels[frf.response].at.split()[1]) - 1] * gain(frf.response)
    force = next((channel.name for channel in channels.values() if channel.measures_force), None)
    if force is not None:
        return response / gain(force)
    table = next(channel.name for channel in channels.values() if channel.at == "table")
    number = scene.shaker.bodies[0]
    driven = next(channel.name for channel in channels.values() if channel.at == f"body {number}")
    # The spring's force as the difference of what is read at its ends, per newton that is there.
    spring = scene.shaker.spring * exact[number - 1]
    # Not a number where the truth is none; such lines are judged nowhere.
    with np.errstate(invalid="ignore"):
        return response / (gain(table) * (1.0 + spring) - gain(driven) * spring)
