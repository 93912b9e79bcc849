"""Response-controlled stepped sine: at each frequency, hold the amplitude of a motion and measure.

Far from modes, the amplitude of the drive is controlled, as in a stepped sine with constant force. Near a mode, the
complex envelope of the drive is controlled (`envelope_control`). (T. Karaagacli, H. N. Ozguven, Mech. Syst. Signal
Process. 146 (2021) 107023.)
"""

from collections.abc import Generator, Mapping
from typing import Any

import numpy as np

from daq.core.excitation import stepped_sine
from daq.core.excitation.controlled import controlled
from daq.core.excitation.procedure import Form, FormValues
from daq.core.excitation.station import AbortedTest, Excitation, Station
from daq.core.excitation.stepped_sine import SteadyTonesProcedure
from daq.core.excitation.tones.envelope_control import MAX_POLE_TIMES_DEAD_TIME, EnvelopeTone
from rig.core.base.arrays import Array
from rig.core.results import format_percent
from rig.core.scene.excitation import ConstantResponse
from rig.core.scene.excitation.kind import KindOfTest
from rig.core.scene.scene import Scene
from rig.core.system.structural_model import structural_model

# First drive, relative to the force that moves the structure's mass by the level: a resonance needs little.
_FIRST_FORCE_RATIO = 0.05
# The amplitude is controlled for at most this time [s]. After it, the envelope is controlled if the mode is known.
_AMPLITUDE_WAIT_S = 15.0
# No further attempt begins if the remaining time is shorter than this value [s].
_MIN_WAIT_S = 1.0
# A drive above this fraction of the amplifier's limit counts as limited: the control needs some reserve.
AT_LIMIT_RATIO = 0.99
# Number of points of a test on the bench page: a form has no list of frequencies.
_FORM_POINTS = 40


class HeldMotion(EnvelopeTone):
    """A tone whose drive brings a motion to the level."""

    def __init__(self, station: Station, test: ConstantResponse) -> None:
        quantity = controlled(station)
        assert quantity is not None
        super().__init__(station, test.order[0], quantity, test.settle)
        self._order, self._level, self.target = test.held_motion[1], 0.0, 0.0
        # Frequencies [Hz] with the amplifier at its limit, and the amplitude there relative to the level.
        self.limited: dict[float, float] = {}
        # Open-loop growth rate [1/s] and dead time [s] of each orbit that the control failed to stabilize.
        self.lost: list[tuple[float, float]] = []

    def start(self, level: float) -> float:
        """Start the control of a level; return the first drive amplitude."""
        self._level = level
        self.forget_mode()
        mass = float(np.trace(structural_model(self.station.scene).mass))
        force = _FIRST_FORCE_RATIO * mass * (2.0 * np.pi * self.frequency) ** 2 * self._displacement(self.frequency)
        return min(super().start(1.0) * force, self.station.drive_limit)

    def _displacement(self, frequency: float) -> float:
        """Return the displacement amplitude that corresponds to the level [m]."""
        return float(self._level / (2.0 * np.pi * frequency) ** self._order)

    def settle(
        self, drives: Mapping[float, float], tolerance: float, max_wait_s: float
    ) -> Generator[Array, Array, bool]:
        """Change to a frequency in Hz and bring the motion to the level; return whether the level was reached."""
        [(frequency, drive)] = drives.items()
        self.target = self._displacement(frequency)
        settled, end = False, self.station.now + max_wait_s * self.rate
        while not settled and (remaining_s := (end - self.station.now) / self.rate) > _MIN_WAIT_S:
            if self.is_controllable(frequency):
                settled = yield from self.settle_envelope(frequency, drive, self.target, remaining_s)
            else:
                super().start(self.target)
                settled = yield from super().settle({frequency: drive}, tolerance, min(_AMPLITUDE_WAIT_S, remaining_s))
                yield from self.observe(self.window)
            drive = self.amplitude
        if not settled and self.amplitude >= AT_LIMIT_RATIO * self.station.drive_limit:
            self.limited[frequency] = abs(self.motion) / self.target
        return settled

    def measure(self, samples: int, settled: bool, fields: Mapping[str, Any]) -> Generator[Array, Array, None]:
        """Measure for at least a number of samples, and mark the interval.

        If the motion leaves the level although the drive is constant, its orbit is unstable: feedback holds it.
        """
        held = yield from self.hold_until_decayed(samples, self.target, feedback=False)
        growth = held.growth
        if settled and growth:
            settled = yield from self.settle_envelope(self.frequency, self.amplitude, self.target, self._settle.longest)
            held = yield from self.hold_envelope(samples, self.target, feedback=True)
            settled = settled and not held.growth
            if not settled and growth * self.dead_time > MAX_POLE_TIMES_DEAD_TIME:
                self.lost.append((growth, self.dead_time))
        self.mark_measured(held, settled, **fields)


class ConstantResponseProcedure(SteadyTonesProcedure["ConstantResponse"]):
    """Tones at which a motion has a constant amplitude."""

    form = Form("constant response", ("low", "high"))
    waits_for_sensors = True
    duration_ratio = 1.5

    def excite(self, station: Station, test: ConstantResponse) -> Excitation:
        """Run the test; raise `AbortedTest` if no dwell reached its level."""
        tone = HeldMotion(station, test)
        yield from tone.measure_noise()
        settled = yield from stepped_sine.excite(station, test, tone)
        messages = []
        if tone.limited:
            frequencies, ratios = sorted(tone.limited), sorted(tone.limited.values())
            parts = " to ".join(dict.fromkeys(format_percent(ratio) for ratio in (ratios[0], ratios[-1])))
            where = " to ".join(dict.fromkeys(f"{frequency:.4g}" for frequency in (frequencies[0], frequencies[-1])))
            messages.append(
                f"{test.at} reaches only {parts} of the level at {where} Hz: the amplifier is at its limit. Choose a "
                "lower level, or exclude these frequencies."
            )
        if tone.lost:
            growth, dead_time = max(tone.lost)
            limit = MAX_POLE_TIMES_DEAD_TIME / growth
            messages.append(
                f"open-loop growth of {growth:.2g} 1/s requires a dead time below {limit:.2g} s; it is "
                f"{dead_time:.2g} s. Use a converter filter with a shorter delay."
            )
        if not settled:
            raise AbortedTest(" ".join([f"the motion of {test.at} reached the level at no frequency.", *messages]))
        for message in messages:
            station.warn(message)
        tone.warn_of_repetitions()

    def part(self, test: ConstantResponse, seconds: float, scene: Scene) -> ConstantResponse:
        """Return the highest level at evenly spaced frequencies of the test."""
        step_s = self.waits(test, scene) / (len(test.levels) * len(test.order)) + test.measure.periods / test.order[0]
        ascending = sorted(set(test.order))
        count = int(np.clip(seconds / step_s, 2, len(ascending)))
        chosen = [ascending[k] for k in np.unique(np.linspace(0, len(ascending) - 1, count).round().astype(int))]
        steps: dict[str, Any] = {"from_": None, "to": None, "points": None, "frequencies": chosen, "direction": "up"}
        return test.at_level(max(test.levels)).replace(**steps)

    def from_form(self, values: FormValues, test: KindOfTest | None) -> dict[str, Any]:
        """Return a stepped sine over the band at the level of the scene's test, or 1 mm of body 1."""
        level: dict[str, Any] = {"displacement": 1e-3}
        if test is not None and test.held_motion is not None:
            level = {test.level_key: test.levels}
        return {**super().from_form(values, test), "points": _FORM_POINTS, **level}


PROCEDURE = ConstantResponseProcedure()
