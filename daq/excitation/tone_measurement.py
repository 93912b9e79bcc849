"""Spring force and displacements as complex amplitudes, read from the channels at the drive's frequency."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from daq.excitation.lock_in import lock_in
from daq.excitation.station import Station

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


class Gauge:
    """Reads what a sine test watches.

    Parameters
    ----------
    force : bool
        Whether the spring force is wanted; it is then the first quantity, and missing channels are a
        SceneError. The displacements at all motion channels follow.
    """

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
        """Amplitudes in a window of a steady tone; shape (quantities,)."""
        return self._of(frequency) @ lock_in(samples, frequency, self._station.rate, phase)

    def _of(self, frequency: float) -> ComplexArray:
        if frequency != self._at:
            self._at = frequency
            rows = [self._station.force_weights(frequency)] if self._force else []
            for row in self._rows:
                rows.append(np.zeros(len(self._station.channels), dtype=complex))
                rows[-1][row] = self._station.displacement(row, frequency)
            self._weights = np.array(rows).reshape(len(rows), len(self._station.channels))
        return self._weights
