"""Sine test: a tone of constant frequency and amplitude."""

import numpy as np

from daq.core.excitation.controlled import controlled
from daq.core.excitation.lock_in import whole_periods
from daq.core.excitation.procedure import Form, Procedure
from daq.core.excitation.station import Excitation, Station
from daq.core.excitation.tones.settling import Settling
from daq.core.excitation.tones.steady_tone import WINDOW_S, SteadyTone
from rig.core.base.arrays import Array
from rig.core.results.text import format_decimals
from rig.core.scene.excitation import Settle, Sine

# Largest transient in steady state, relative to the amplitude: below the uncertainty of sensors.
_TOLERANCE = 1e-3
# Longest wait for the steady state [s]; irregular motion of dampers never reaches it.
_MAX_WAIT_S = 60.0


class SineProcedure(Procedure["Sine"]):
    """A tone of constant frequency."""

    detection = "dwells"
    form = Form("sine", ("level", "frequency"), adjustable=True)

    def excite(self, station: Station, test: Sine) -> Excitation:
        """Run a tone of constant frequency; mark the measurement.

        With a controlled spring force, the duration of the test begins when the force is steady at its level. In open
        loop it begins with the first sample, at full amplitude.
        """
        tone, level = SteadyTone(station, test.frequency, controlled(station)), station.level
        if station.is_controlled:
            settle = Settle(tolerance=_TOLERANCE, longest=_MAX_WAIT_S)
            yield from tone.run([[test.frequency]], [level], settle, [test.duration])
            return
        # In open loop, the level is the amplitude of the drive.
        tone.amplitude = level
        detector = Settling(_TOLERANCE)
        window = whole_periods(test.frequency, station.rate, WINDOW_S)
        status = f"{format_decimals(test.frequency, 2)} Hz, level {station.level_text(level)}"
        first, total, steady_from = station.now, station.samples(test.duration), None
        while (remaining := first + total - station.now) > 0:
            station.report((total - remaining) / total, status)
            n_samples, phase = min(window, remaining), tone.phase
            readings = yield station.drive(tone.hold(n_samples))
            if n_samples == window and steady_from is None:
                detector.add(tone.amplitudes(readings, [phase])[0])
                steady_from = station.now if detector.settled else None
        settled = steady_from is not None and station.now - steady_from >= window
        # Without a steady state, the second half of the test is measured.
        begin = steady_from if settled else first + total // 2
        station.mark("measure", begin, station.now, frequency=test.frequency, level=level, drive=level, settled=settled)

    def snr_gain(self, test: Sine, frequency: Array) -> Array:
        """Return the signal-to-noise ratio over the duration [sqrt(s)], for unit level and unit noise density."""
        return np.full(frequency.size, np.sqrt(test.duration / 2.0))


PROCEDURE = SineProcedure()
