"""Two tones at once: the procedure of a kind of test that exists only in the test suite."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from daq.core.excitation.procedure import Form, FormValues, Procedure
from daq.core.excitation.station import Excitation, Station
from rig.core.base.arrays import Array

if TYPE_CHECKING:
    from rig.core.scene.excitation import TwoTones
    from rig.core.scene.excitation.kind import KindOfTest


class TwoTonesProcedure(Procedure["TwoTones"]):
    """Output both tones; the second half is measured, once for each tone."""

    form = Form("two tones", ("level", "low", "high", "duration"))

    def excite(self, station: Station, test: TwoTones) -> Excitation:
        """Run the test."""
        total = station.samples(test.duration)
        first, wave = station.now, test.wave(total, station.rate).values
        yield station.drive(wave[: total // 2])
        middle = station.now
        station.report(0.5, "measuring")
        yield station.drive(wave[total // 2 :])
        for frequency in test.frequencies:
            station.mark("settle", first, middle, frequency=frequency, level=test.drive, settled=True)
            station.mark("measure", middle, station.now, frequency=frequency, level=test.drive, settled=True)

    def noise_gain(self, test: TwoTones, frequency: Array) -> Array:
        """Return the gain of a measurement over half the duration."""
        return np.full(frequency.size, np.sqrt(test.duration / 4.0))

    def from_form(self, values: FormValues, test: KindOfTest | None) -> dict[str, Any]:
        """Return tones at the ends of the band."""
        band = [values.low, values.high]
        return {"kind": "two_tones", "frequencies": band, "drive": values.level, "duration": values.duration}


PROCEDURE = TwoTonesProcedure()
