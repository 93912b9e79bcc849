"""Responses of fixed sensors to impacts at several points, as responses of these points to forces at the sensors.

By the reciprocity theorem of Maxwell and Betti, output and input of a curve may be exchanged. Modes are then identified
from all curves at once, and their shapes have a component for each point of impact.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import reduce

import numpy as np

from rig.core.base.errors import RecordingError, SceneError
from rig.core.results.points import Point, body_number
from rig.core.results.response import Response, stack

# Minimum number of common lines, with two real values each: a single mode has four unknowns.
_MIN_LINES = 8


def exchange_points(curves: Sequence[Response]) -> Response:
    """Exchange output and input of curves; outputs of the result are the points of impact, and inputs are the sensors.

    Curves without a place of the force are named after their files.
    Raises `SceneError` if there is one point only, or if a point lacks a sensor or has impacts in several tests. Raises
    `RecordingError` if the curves have too few lines in common.
    """
    by_points = {(curve.input_at or curve.label, curve.output_at or curve.response): curve for curve in curves}
    points, sensors = (list(dict.fromkeys(names)) for names in zip(*by_points, strict=True))
    if len(points) < 2 or not len(by_points) == len(curves) == len(points) * len(sensors):
        raise SceneError(
            f"roving hammer: {len(curves)} curves of impacts at {', '.join(points)[:200]} with sensors at "
            f"{', '.join(sensors)[:200]}; expected every sensor at each of several points. "
            "Record one file for each point, with the same sensors."
        )
    lines = reduce(np.intersect1d, [curve.frequency for curve in curves])
    if lines.size < _MIN_LINES:
        raise RecordingError(
            f"roving hammer: the curves have {lines.size} frequencies in common, too few for modes. Record all impacts "
            "with the same sample rate, and for the same time after each impact (test.interval)."
        )
    exchanged = [
        replace(
            curve.at(np.isin(curve.frequency, lines)),
            outputs=(replace(curve.outputs[0], name=point, place=point, body=body_number(point)),),
            inputs=(Point(f"force at {sensor}", "force", sensor),),
        )
        for point in points
        for sensor in sensors
        for curve in [by_points[point, sensor]]
    ]
    label = f"{curves[0].label} and {len(points) - 1} other points"
    return replace(stack(exchanged, len(sensors)), label=label)
