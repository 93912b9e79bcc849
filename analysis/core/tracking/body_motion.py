"""Amplitude of one body along a measured response, for results against amplitude."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.core.base.arrays import Array
from rig.core.base.palette import CurveStyle
from rig.core.results.response import Response


class BodyMotion(NamedTuple):
    """Motion of a body at the lines of a response, each of shape (lines,)."""

    output: int  # index of the body's channel in the response
    force: Array  # amplitude, N; NaN if it is not known
    amplitude: Array  # displacement, m
    relative: Array  # half of the 95 % interval of the response, relative to the response
    settled: NDArray[np.bool_]


class CurvePart(NamedTuple):
    """Points of a curve with a common symbol. The curve consists of the parts with equal styles."""

    name: str
    style: CurveStyle
    selected: NDArray[np.bool_]  # shape (points,)
    is_stable: bool


def body_motion(response: Response, location: str) -> BodyMotion:
    """Return the motion at a location such as "body 2"; the force is the measured force of the test."""
    k = [output.at for output in response.outputs].index(location)
    size, magnitude = response.frequency.size, abs(response.value[:, k, 0])
    force = np.full(size, np.nan) if response.amplitude is None else response.amplitude
    settled = np.ones(size, dtype=bool) if response.unsteady is None else ~response.unsteady
    return BodyMotion(k, force, magnitude * force, response.expanded()[:, k, 0] / magnitude, settled)
