"""Complex amplitudes of spring force and displacements, measured from the channels at the drive frequency."""

from __future__ import annotations

from collections.abc import Generator

import numpy as np
from numpy.typing import NDArray

from daq.excitation.lock_in import lock_in, whole_periods
from daq.excitation.station import Station
from daq.excitation.tone import Tone

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


# A longer window is driven and measured in pieces of at least this number of samples.
_PIECE = 1 << 16


class Gauge:
    """Measures the spring force if required, then the displacements at all motion channels."""

    def __init__(self, station: Station, force: bool) -> None:
        self._station = station
        self._force = force
        self._rows = [
            row for row, info in enumerate(station.channels) if info.quantity not in ("force", "voltage")
        ]
        self._at = -1.0
        self._weights = np.zeros((0, len(station.channels)), dtype=complex)
        if force:
            station.force_weights(1.0)

    def steady(self, samples: Array, frequency: float, phase: float) -> ComplexArray:
        """Return the amplitudes in a window of a steady tone, for its phase at the start; shape (quantities,)."""
        turned = 2.0 * np.pi * frequency * self._station.latency / self._station.rate
        return self._of(frequency) @ lock_in(samples, frequency, self._station.rate, phase - turned)

    def _of(self, frequency: float) -> ComplexArray:
        if frequency != self._at:
            self._at = frequency
            rows = [self._station.force_weights(frequency)] if self._force else []
            for row in self._rows:
                rows.append(np.zeros(len(self._station.channels), dtype=complex))
                rows[-1][row] = self._station.displacement(row, frequency)
            self._weights = np.array(rows).reshape(len(rows), len(self._station.channels))
        return self._weights


def held(station: Station, tone: Tone, gauge: Gauge, samples: int) -> Generator[Array, Array, ComplexArray]:
    """Hold a tone for a number of samples, and return the amplitudes of the gauge, shape (quantities,).

    A long window is read in pieces of whole periods, so that not all readings are in memory.
    """
    frequency, left = tone.frequency, samples
    piece = whole_periods(frequency, station.rate, _PIECE / station.rate)
    total: ComplexArray = np.zeros(0, dtype=complex)
    while left:
        size, phase = (piece if left >= 2 * piece else left), tone.phase
        readings = yield station.drive(tone.hold(size))
        read = size / samples * gauge.steady(readings, frequency, phase)
        total, left = (total + read if total.size else read), left - size
    return total
