"""How a converter takes a sample of the voltage at its input."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from daq.circuit import Circuit
from daq.decimation import MOMENTS, Decimation
from daq.decimator import Decimator

Array = NDArray[np.float64]


class Reading(Protocol):
    """A way to take samples.

    Attributes
    ----------
    integrals : int
        Moments of the voltage over each interval that it needs.
    rows, rows_input : ndarray, shapes (outputs, states) and (outputs,)
        Voltages at the end of each interval that it needs, from state and input.
    """

    integrals: int
    rows: Array
    rows_input: Array

    def read(self, points: Array, averages: Array) -> Array:
        """Give the samples.

        Parameters
        ----------
        points : ndarray, shape (outputs, intervals)
            What `rows` gave.
        averages : ndarray, shape (integrals, intervals or more)
            Moments.

        Returns
        -------
        ndarray, shape (samples,)
            V.
        """


class PointReading:
    """Reads the voltage at the instant of the sample: for a signal without impulses.

    Parameters
    ----------
    circuit : Circuit
        The analogue stages.
    """

    integrals = 0

    def __init__(self, circuit: Circuit) -> None:
        self.rows, self.rows_input = circuit.c[None], np.zeros(1)

    def read(self, points: Array, averages: Array) -> Array:
        """Give the samples; see `Reading.read`."""
        return points[0].copy()


class AverageReading:
    """Averages the voltage over the interval that ends at the sample: for a signal that may hold impulses.

    Parameters
    ----------
    circuit : Circuit
        The analogue stages.
    """

    integrals = 1

    def __init__(self, circuit: Circuit) -> None:
        self.rows, self.rows_input = np.zeros((0, circuit.c.size)), np.zeros(0)

    def read(self, points: Array, averages: Array) -> Array:
        """Give the samples; see `Reading.read`."""
        return averages[0, : points.shape[1]].copy()


class FilteredReading:
    """Reads behind the decimation filter of a delta-sigma converter.

    Parameters
    ----------
    circuit : Circuit
        The analogue stages.
    low_pass : Decimation
        The filter.
    oversampling : int
        Intervals per sample.
    """

    integrals = MOMENTS

    def __init__(self, circuit: Circuit, low_pass: Decimation, oversampling: int) -> None:
        self.rows, self.rows_input = np.zeros((0, circuit.c.size)), np.zeros(0)
        self._filter = Decimator(low_pass.taps(oversampling))

    def read(self, points: Array, averages: Array) -> Array:
        """Give the samples; see `Reading.read`."""
        return self._filter.filter(averages, points.shape[1])


class Jitter:
    """Takes samples early or late, through the slope of the voltage.

    The slope is that between samples, so that jitter acts a little less than it should on fast signals (by
    sinc(f / rate)); its second order is left out.

    Parameters
    ----------
    circuit : Circuit
        The analogue stages.
    gain : float
        Volts per unit of the input in front of them.
    deviation : float
        Standard deviation of the sampling instants, in sample intervals.
    wait : int
        Samples by which the reading lags behind the voltage.
    """

    def __init__(self, circuit: Circuit, gain: float, deviation: float, wait: int) -> None:
        self.row, self.row_input = circuit.c, float(circuit.d[0] * gain)
        self._deviation = deviation
        self._last = 0.0
        self._waiting = np.zeros(wait)

    def error(self, voltage: Array, late: Array) -> Array:
        """Give what it adds to the samples.

        Parameters
        ----------
        voltage : ndarray, shape (samples,)
            At the nominal sampling instants, V; what `row` and `row_input` gave.
        late : ndarray, shape (samples,)
            Lateness, in standard deviations.
        """
        if voltage.size == 0:
            return voltage
        held = self._waiting.size
        slope = np.empty(held + voltage.size)
        slope[:held] = self._waiting
        slope[held] = voltage[0] - self._last
        np.subtract(voltage[1:], voltage[:-1], out=slope[held + 1 :])
        self._last = float(voltage[-1])
        self._waiting = slope[voltage.size :].copy()
        return self._deviation * late * slope[: voltage.size]
