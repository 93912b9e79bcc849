"""The force [N] or displacement [m] that a controller keeps at its level, computed from channels.

Few benches measure the force of a coil spring. It is computed as k0 (x0 - x1) from the displacements x0 of the table
and x1 of the structure. In general, a controlled quantity is therefore a weighted sum of channels.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from daq.core.excitation.station import Station
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import SceneError

# Each quantity as named in messages, and the setting to use instead if its channels are missing.
_FORCE = "the spring force k0 (x0 - x1)", "test.drive instead of test.force (open loop)"
_MOTION = "the motion", "a test of kind stepped_sine"


@dataclass(frozen=True)
class Controlled:
    """A force [N] or displacement [m] as the weighted sum of channels."""

    station: Station
    rows: tuple[int, ...]  # rows of the readings
    factors: tuple[float, ...]  # for each row: N/m if displacements are summed to a force, otherwise 1

    def weights(self, frequency: Array | Sequence[float] | float) -> ComplexArray:
        """Return the weights of the channels' amplitudes, shape (channels, ...), at frequencies in Hz.

        The weights remove the responses of sensor, integrator and converter.
        """
        frequency = np.asarray(frequency, dtype=float)
        weights = np.zeros((len(self.station.channels), *frequency.shape), dtype=complex)
        for row, factor in zip(self.rows, self.factors, strict=True):
            weights[row] = factor * self.station.displacement_factor(row, frequency)
        return weights

    def amplitudes(self, readings: Array, frequencies: Sequence[float], phases: Sequence[float]) -> ComplexArray:
        """Return the complex amplitudes of the quantity at simultaneous tones, (tones,), as `Station.amplitudes`."""
        amplitudes = self.station.amplitudes(readings, frequencies, phases)
        return np.array([each @ tone for each, tone in zip(self.weights(frequencies).T, amplitudes.T, strict=True)])


def controlled(station: Station) -> Controlled | None:
    """Return the quantity that the test of a station controls; None in open loop.

    Raises `SceneError` if no channel measures one of the displacements in its sum.
    """
    terms = station.scene.controlled_terms
    is_motion = station.scene.test is not None and station.scene.test.held_motion is not None
    return _sum_of_displacements(station, terms, _MOTION if is_motion else _FORCE) if terms else None


def displacement(station: Station, at: str) -> Controlled:
    """Return the displacement at a location; raise `SceneError` if no channel measures it."""
    return _sum_of_displacements(station, {at: 1.0}, _MOTION)


def measured_force(station: Station) -> Controlled | None:
    """Return the force of the driven shaker, from its channel or its coil spring; None if no channel measures it."""
    location = station.scene.at_driven("shaker")
    for row, info in enumerate(station.channels):
        if info.at == location and info.quantity == "force":
            return Controlled(station, (row,), (1.0,))
    return None if station.force_is_drive else spring_force(station)


def spring_force(station: Station) -> Controlled:
    """Return the force of the driven shaker's coil spring, F1 = k0 (x0 - x1).

    Raises `SceneError` if no channel measures one of the displacements.
    """
    shaker = station.scene.driven_shaker
    assert shaker is not None
    terms = shaker.force_terms("", station.scene.at_driven("table"))
    return _sum_of_displacements(station, terms, _FORCE)


def _sum_of_displacements(station: Station, terms: Mapping[str, float], names: tuple[str, str]) -> Controlled:
    """Return a weighted sum of displacements; `terms`: factor of each location; `names`: quantity and remedy."""
    # The first channel at each location counts.
    rows = {info.at: row for row, info in reversed([*enumerate(station.channels)]) if info.quantity != "voltage"}
    for place in terms:
        if place not in rows:
            listed = ", ".join(f"{info.name} ({info.quantity} at {info.at})" for info in station.channels) or "none"
            raise SceneError(
                f"channels: controlling {names[0]} requires a motion channel at the {place}; the channels are "
                f"{listed}. Add {{name: {place.replace(' ', '')}, at: {place}}}, or set {names[1]}."
            )
    return Controlled(station, tuple(rows[place] for place in terms), tuple(terms.values()))
