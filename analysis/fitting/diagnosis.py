"""Why a scene or some points do not fit: channels that read what they should not, motions that are not computed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from analysis.fitting.estimate import mean_square, solved
from analysis.fitting.measured import Curves, Sensor, inverse_root
from analysis.fitting.problem import Problem
from analysis.fitting.start import start

Array = NDArray[np.float64]

# A cause explains a misfit if it takes away all but this share of it.
_EXPLAINED = 0.02
# Factors by which units are mistaken, with what they are taken for.
_FACTORS = {
    -1.0: "its sign is turned",
    9.80665: "m/s² read as g, or the other way round",
    1.0 / 9.80665: "g read as m/s²",
    1000.0: "a thousandth taken for the unit, as mV for V or mm for m",
    0.001: "the unit taken for a thousandth, as V for mV or m for mm",
    39.3701: "inches for metres",
    0.0254: "metres for inches",
    4.44822: "pounds for newtons",
    1.0 / 4.44822: "newtons for pounds",
}
_NEAR = 0.06
_NO_UNIT = " (no unit is mistaken by that factor: the structure may as well be another one than the scene's)"
# How much looser a suspected sensor is held, and the scale of all masses from which on it is suspect.
_FREED, _SCALE_OFF = 1e4, 2.5
_MOST_PAIRS = 15
# Fewer responses than this fit what contradicts them.
_FEWEST_LEFT = 2


def causes(problem: Problem) -> list[str]:
    """Try what may be wrong with the recordings that have no moving dampers; say what explains the misfit."""
    bare = [group.curves for group in problem.groups if group.tones is None]
    if not bare:
        return [
            "No recording without moving dampers is among them: with one, the structure can be judged alone."
        ]
    before = _variance(problem, bare)[1]
    if before < 4.0:
        return [
            "The recordings without moving dampers fit: it is the dampers that the scene has otherwise, or with values "
            "too far off to start from."
        ]
    found: list[tuple[float, str]] = []
    for text, curves, sensor in _suspects(bare):
        trial, after = _variance(problem, curves)
        if after < max(4.0, _EXPLAINED * before):
            factor = 1.0 if sensor is None else 1.0 + trial[0].deviation(trial[1], sensor)
            meaning = _meaning(factor) or _NO_UNIT
            found.append((after, text if sensor is None else f"{text} {factor:.4g} times what fits{meaning}"))
    if found:
        return [min(found)[1] + ": corrected, the rest fits."]
    alone = [
        sensor.name
        for sensor in _sensors(bare)
        if (rest := _without(bare, sensor)) and _variance(problem, rest)[1] < max(4.0, _EXPLAINED * before)
    ]
    if len(alone) == 1:
        return [
            f"{alone[0]} contradicts the others, by no factor: late, loose, elsewhere than the scene says, "
            "or no measurement at all; left out, the rest fits."
        ]
    return [
        "No single channel and no swap of two explains it: the structure is another one, a chain of other bodies "
        "and springs or one with other damping; the figure of what is left shows where."
    ]


def scale_off(problem: Problem, x: Array) -> str:
    """Say whether all masses are off their guess by so much that a unit must be wrong."""
    masses = [k for k, one in enumerate(problem.parameters) if one.what == "masses"]
    if not masses:
        return ""
    factor = float(np.exp(np.mean((x - problem.start)[masses])))
    if 1.0 / _SCALE_OFF < factor < _SCALE_OFF:
        return ""
    return (
        f"The curves fit with {factor:.4g} times the masses of the scene{_meaning(1.0 / factor)}: force or motion is "
        "in another unit than the recording says, or the masses of the scene are far off; correct either."
    )


def _suspects(bare: list[Curves]) -> Iterator[tuple[str, list[Curves], Sensor | None]]:
    references = dict.fromkeys(curves.reference_sensor for curves in bare)
    for sensor in _sensors(bare):
        yield f"The sign of {sensor.name} is turned", [_turned(curves, sensor) for curves in bare], None
    for sensor in dict.fromkeys((*_sensors(bare), *references)):
        free = replace(sensor, tolerance=_FREED)
        yield f"{sensor.name} reads", [_with_sensor(curves, sensor, free) for curves in bare], free
    names = dict.fromkeys(sensor.name for curves in bare for sensor in curves.sensors)
    for one, other in list(combinations(names, 2))[:_MOST_PAIRS]:
        yield f"{one} and {other} are swapped", [_swapped(curves, one, other) for curves in bare], None


def _sensors(bare: list[Curves]) -> list[Sensor]:
    """All sensors behind responses."""
    return list(dict.fromkeys(sensor for curves in bare for sensor in curves.sensors))


def _turned(curves: Curves, sensor: Sensor) -> Curves:
    """Turn the responses that a sensor reads; of the reference the sign of all others tells the same."""
    sign = np.array([-1.0 if one == sensor else 1.0 for one in curves.sensors])
    return replace(
        curves,
        value=curves.value * sign[:, None],
        whiten=curves.whiten * sign,
        frfs=tuple(replace(frf, value=frf.value * way) for frf, way in zip(curves.frfs, sign, strict=True)),
    )


def _without(bare: list[Curves], sensor: Sensor) -> list[Curves]:
    """Leave out what a sensor reads; nothing if fewer than two responses would be left anywhere."""
    left = []
    for curves in bare:
        kept = [k for k, one in enumerate(curves.sensors) if one != sensor]
        if len(kept) < _FEWEST_LEFT:
            return []
        colour = np.linalg.inv(curves.whiten)
        covariance = (colour @ colour.conj().swapaxes(1, 2))[:, kept][:, :, kept]
        left.append(
            replace(
                curves,
                value=curves.value[kept],
                whiten=inverse_root(covariance),
                systematic=curves.systematic[kept],
                sensors=tuple(curves.sensors[k] for k in kept),
                bodies=tuple(curves.bodies[k] for k in kept),
                frfs=tuple(curves.frfs[k] for k in kept),
            )
        )
    return left


def _with_sensor(curves: Curves, old: Sensor, new: Sensor) -> Curves:
    return replace(
        curves,
        sensors=tuple(new if sensor == old else sensor for sensor in curves.sensors),
        reference_sensor=new if curves.reference_sensor == old else curves.reference_sensor,
    )


def left_out(curves: Curves, used: NDArray[np.bool_], uncovered: Mapping[int, str]) -> list[str]:
    """Say which points were left out of a fit, and why.

    Parameters
    ----------
    curves : Curves
    used : ndarray of bool, shape (n,)
    uncovered : mapping of int to str
        What happens in the motion that the scene has at a point, where no orbit is computed for it.
    """
    why: dict[str, list[str]] = {}
    for k in np.flatnonzero(~used).tolist():
        reason = "the rig was in another motion than any that the scene has there, or in none that repeats"
        if k in uncovered:
            reason = (
                f"{uncovered[k]}, which a fit does not compute; a scene whose dampers have restitution 0, or contacts "
                "that last (contact: {duration: ...}), has none of that"
            )
        why.setdefault(reason, []).append(f"{curves.frequency[k]:.4g}")
    return [f"{curves.label}: left out {', '.join(at)} Hz, where {reason}." for reason, at in why.items()]


def _swapped(curves: Curves, one: str, other: str) -> Curves:
    bodies = {sensor.name: body for sensor, body in zip(curves.sensors, curves.bodies, strict=True)}
    if one in bodies and other in bodies:
        bodies[one], bodies[other] = bodies[other], bodies[one]
    return replace(curves, bodies=tuple(bodies[sensor.name] for sensor in curves.sensors))


def _variance(problem: Problem, curves: list[Curves]) -> tuple[tuple[Problem, Array], float]:
    parameters = [one for one in problem.parameters if one.place[0] != "dampers"]
    trial = Problem(problem.model, parameters, curves)
    x = start(trial, trial.groups)
    for distrust in (0.1, 0.01, 0.0):
        x = solved(trial, x, trial.groups, distrust, most=15)
    # Sensors that are strained far beyond their tolerances explain anything.
    strain = ((x - trial.start) / trial.spread)[len(parameters) :]
    return (trial, x), max(mean_square(trial, x, trial.groups), *(strain**2), 0.0)


def _meaning(factor: float) -> str:
    for known, text in _FACTORS.items():
        if abs(factor / known - 1.0) < _NEAR:
            return f" ({text})"
    return ""
