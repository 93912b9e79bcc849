"""Frequency response as a text table or CSV, and the frequencies of a scene's test."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import TextIO

import numpy as np
from numpy.typing import NDArray

from rig.errors import SceneError
from rig.output_files import replacing
from rig.scene.excitation import Sine, SteppedSine, spaced
from rig.scene.scene import Scene
from rig.steady_response.frequency_response import SteadyResponse


def frequencies_of(
    scene: Scene, first: float | None, last: float | None, points: int | None, direction: str | None
) -> tuple[tuple[float, ...], str]:
    """Return rising frequencies in Hz and the direction, as given or from the scene's test.

    Raises
    ------
    SceneError
        If neither specifies the frequencies.
    """
    test = scene.test
    given = (first, last, points)
    if any(part is not None for part in given):
        stepped = test if isinstance(test, SteppedSine) else None
        first = first if first is not None else getattr(stepped, "from_", None)
        last = last if last is not None else getattr(stepped, "to", None)
        points = points if points is not None else getattr(stepped, "points", None) or 101
        if first is None or last is None or not 0.0 < first < last or points < 2:
            raise SceneError(
                "frequencies: expected --from below --to, both above zero, and at least 2 --points"
            )
        return spaced(first, last, points, "linear"), direction or "up"
    if isinstance(test, SteppedSine):
        return tuple(sorted(set(test.order))), direction or test.direction
    if isinstance(test, Sine):
        return (test.frequency,), direction or "up"
    raise SceneError(f"scene {scene.name!r} names no frequencies; expected --from and --to")


def rows(response: SteadyResponse) -> tuple[list[str], list[list[str]]]:
    """Return column names and rows of a response, with all digits."""
    bodies, dampers = len(response.compliance), len(response.impacts)
    header = ["frequency_hz"]
    for body in range(1, bodies + 1):
        header += [f"body{body}_compliance_m_per_n", f"body{body}_phase_deg", f"body{body}_peak_m"]
    header += ["force_n", "motion_type", *(f"damper{k}_impacts_per_period" for k in range(1, dampers + 1))]
    header += ["repetition_periods", "converged", "residual", "direction"]
    table, ways = [], directions(response.frequency)
    for k, frequency in enumerate(response.frequency):
        row = [repr(float(frequency))]
        for body in range(bodies):
            value = response.compliance[body, k]
            numbers = (abs(value), np.degrees(np.angle(value)), response.peak[body, k])
            row += [repr(float(number)) for number in numbers]
        row += [repr(float(response.force[k])), str(response.motion_type[k])]
        row += [repr(float(count)) for count in response.impacts[:, k]]
        row += [str(response.repetition[k]), str(bool(response.converged[k])).lower()]
        row += [repr(float(response.residual[k])), ways[k]]
        table.append(row)
    return header, table


def directions(frequency: NDArray[np.float64]) -> list[str]:
    """Return the sweep direction, "up" or "down", at each frequency in the order visited.

    Examples
    --------
    >>> directions(np.array([10.0, 11.0, 12.0, 12.0, 11.0]))
    ['up', 'up', 'up', 'down', 'down']
    """
    steps = ["up" if step > 0.0 else "down" for step in np.diff(frequency)]
    return [*(steps[:1] or ["up"]), *steps]


def write(response: SteadyResponse, path: Path) -> None:
    """Write a response as CSV.

    Raises
    ------
    SceneError
        If the file cannot be written.
    """
    with replacing(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        write_to(response, file)


def write_to(response: SteadyResponse, file: TextIO) -> None:
    """Write a response as CSV into an open file."""
    header, table = rows(response)
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(table)


def text(response: SteadyResponse) -> str:
    """Format a readable table: compliance of every body, motion type, impacts per period."""
    ratios = [f"X{b}/F1 m/N" for b in range(1, len(response.compliance) + 1)]
    if response.bodies:
        ratios = [f"{name}/F1 m/N" for name in response.bodies]
    widths = [max(12, len(ratio) + 2) for ratio in ratios]
    heads = "".join(f"{ratio:>{width}}" for ratio, width in zip(ratios, widths, strict=True))
    lines = [f"{'Hz':>9} {heads}   impacts  motion"]
    ways = directions(response.frequency)
    several = len(set(ways)) > 1
    for k, frequency in enumerate(response.frequency):
        values = zip(response.compliance[:, k], widths, strict=True)
        sizes = "".join(f"{abs(value):{width}.4g}" for value, width in values)
        impacts = float(response.impacts[:, k].sum())
        note = "" if response.converged[k] else f"  not steady (residual {response.residual[k]:.1g})"
        way = f", {ways[k]}" if several else ""
        lines.append(f"{frequency:9.4f} {sizes}   {impacts:7.3g}  {response.motion_type[k]}{way}{note}")
    return "\n".join(lines)
