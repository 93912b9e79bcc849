"""Output of a steady response as a text table or CSV, and the frequencies at which it is computed."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.core.base.errors import SceneError
from rig.core.base.output_files import atomic_write, csv_text
from rig.core.results.ratio_names import REFERENCE_UNITS, frf_display, ratio_name
from rig.core.results.text import format_decimals, format_frequencies, format_interval, table_lines
from rig.core.scene.excitation import spaced_frequencies
from rig.core.scene.scene import Scene
from rig.core.settings.quantities import count
from rig.core.steady_response.frequency_response import SteadyResponse
from rig.core.steady_response.motion_type import describe_motion, element_labels

# The uncertainty of an interpolated peak is printed if it exceeds this fraction of the peak; a smaller uncertainty does
# not change the printed digits.
_NEGLIGIBLE_ERROR = 1e-4
# Two sweeps have the same motion if their responses differ by less than this fraction, which differences of settling
# can reach.
_SAME_MOTION = 1e-2
# Maximum number of listed peaks with few frequencies; a longer list would hide the other lines.
_MAX_LISTED = 8
# Number of frequencies in a band without a number of tones.
_POINTS = 101
_GIVE_BAND = "Give `first` and `last`."


def sweep_frequencies(
    scene: Scene, first: float | None, last: float | None, points: int | None, direction: str | None
) -> tuple[tuple[float, ...], str]:
    """Return ascending frequencies in Hz and the direction ("up", "down" or "both").

    An argument that is None has the value of the scene's test: its tones, or 101 frequencies in its band. Without a
    value, `points` is 101 and `direction` is "up". Raises `SceneError` if neither the arguments nor the test specify
    the frequencies.
    """
    test = scene.test
    tones = () if test is None else test.tones(_POINTS)
    if any(value is not None for value in (first, last, points)):
        test_first, test_last = (None, None) if test is None or test.band is None else test.band
        first, last = test_first if first is None else first, test_last if last is None else last
        default = len(tones) if len(tones) > 1 else _POINTS
        points = count(default if points is None else points, 2, "points")
        if first is None or last is None:
            missing = "`first`" if first is None else "`last`"
            raise SceneError(f"frequencies: {missing} is missing. {_GIVE_BAND}")
        if not 0.0 < first < last:
            raise SceneError(
                f"frequencies: got {first:g} Hz as `first` and {last:g} Hz as `last`; expected values "
                "above 0, first the lower value"
            )
        return spaced_frequencies(first, last, points, "linear"), direction or "up"
    if test is not None and tones:
        return tones, direction or test.sweep_direction
    raise SceneError(f"scene {scene.name!r}: the test has no frequencies. {_GIVE_BAND}")


def csv_rows(response: SteadyResponse) -> tuple[list[str], list[list[str]]]:
    """Return column names and rows of a response, with all digits."""
    bodies, dampers = len(response.frf), len(response.impacts) - response.joints
    name, unit = ratio_name("displacement", response.reference)
    frf_name = f"{name}_{unit.replace('/', '_per_').lower()}"
    header = ["frequency_hz"]
    for body in range(1, bodies + 1):
        header += [f"body{body}_{frf_name}", f"body{body}_phase_deg", f"body{body}_peak_m"]
    header += [f"{response.reference}_{REFERENCE_UNITS[response.reference].lower()}", "motion_type"]
    elements = [*(f"damper{k}" for k in range(1, dampers + 1)), *(f"joint{k}" for k in range(1, response.joints + 1))]
    header += [f"{element}_impacts_per_period" for element in elements]
    header += ["repetition_periods", "converged", "residual", "direction"]
    header += [f"{element}_motion" for element in elements]
    table, sweep_directions = [], directions(response.frequency)
    for k, frequency in enumerate(response.frequency):
        row = [repr(float(frequency))]
        for body in range(bodies):
            value = response.frf[body, k]
            body_values = (abs(value), np.degrees(np.angle(value)), response.peak[body, k])
            row += [repr(float(number)) for number in body_values]
        row += [repr(float(response.reference_amplitude[k])), str(response.motion_type[k])]
        row += [repr(float(impacts)) for impacts in response.impacts[:, k]]
        row += [str(response.repetition[k]), str(bool(response.converged[k])).lower()]
        row += [repr(float(response.residual[k])), sweep_directions[k], *response.damper_motion[:, k].tolist()]
        table.append(row)
    return header, table


def directions(frequency: NDArray[np.float64]) -> list[str]:
    """Return the sweep direction, "up" or "down", at each frequency in the order of computation.

    >>> directions(np.array([10.0, 11.0, 12.0, 12.0, 11.0]))
    ['up', 'up', 'up', 'down', 'down']
    """
    steps = ["up" if step > 0.0 else "down" for step in np.diff(frequency)]
    return [*(steps[:1] or ["up"]), *steps]


def write_csv(response: SteadyResponse, path: Path) -> None:
    """Write a response as CSV.

    Raises `SceneError` if the file cannot be written.
    """
    header, table = csv_rows(response)
    with atomic_write(path) as temporary:
        temporary.write_text(csv_text([header, *table]), encoding="utf-8", newline="")


def format_response(response: SteadyResponse, every_frequency: bool = False) -> str:
    """Return a response as text: range, motion of the dampers, peaks of each body; on request every frequency."""
    lines = [response.summary()]
    elements = len(response.damper_motion)
    labels = [f"{label}," for label in element_labels(elements, response.joints)] if elements > 1 else ["motion"]
    for label, motion in zip(labels, response.damper_motion, strict=False):
        kinds = list(dict.fromkeys(motion.tolist()))
        for kind in kinds if len(kinds) > 1 else []:
            ranges = format_frequencies(response.frequency.tolist(), (motion == kind).tolist())
            lines.append(f"  {label} {kind}: {ranges}")
    if not response.converged.all():
        ranges = format_frequencies(response.frequency.tolist(), (~response.converged).tolist())
        lines.append(
            f"  no steady state: {ranges}. Irregular motion never settles; for other types of motion, pass a larger "
            "`longest` to rig.frequency_response (Python)."
        )
    motion_labels = _motion_labels(response)
    lines += ["", *_peak_table(response, motion_labels)]
    if every_frequency:
        lines += ["", *_frequency_table(response, motion_labels)]
    return "\n".join(lines)


def _motion_labels(response: SteadyResponse) -> list[str]:
    """Return the motion at each frequency, with the direction of the sweep if it goes both up and down."""
    sweep_directions = directions(response.frequency)
    is_up_and_down = len(set(sweep_directions)) > 1
    return [
        describe_motion(response.damper_motion[:, [k]], response.joints) + (f", {direction}" if is_up_and_down else "")
        for k, direction in enumerate(sweep_directions)
    ]


def _peak_table(response: SteadyResponse, motion: list[str]) -> list[str]:
    """Return a table of the peaks of each body's response, refined between the frequencies, with notes on spacing."""
    from rig.core.results.resonances import MIN_LINES, find_resonances

    unit, factor = frf_display(response.reference)[1:]
    rows, coarse = [("body", "frequency / Hz", f"peak / ({unit})", "motion")], []
    jumps: list[_Jump] = []
    sweep_directions = np.array(directions(response.frequency))
    for curve in response.response.curves():
        for direction in dict.fromkeys(sweep_directions):
            points = np.flatnonzero(sweep_directions == direction)
            sweep = curve.at(points)
            for peak in find_resonances(sweep):
                k = points[peak.line]
                # Dampers that are at rest at two neighboring frequencies may move between them.
                if response.motion_type[k] == "linear" and peak.is_interpolated:
                    error = peak.expanded if peak.expanded > _NEGLIGIBLE_ERROR * peak.value else 0.0
                    row = format_decimals(peak.frequency, 4), format_interval(factor * peak.value, factor * error)
                else:
                    height = f"{factor * abs(curve.value[k]):.4g}"
                    is_coarse = peak.lines < MIN_LINES or not peak.is_interpolated
                    row = format_decimals(curve.frequency[k], 4), f"at least {height}" if is_coarse else height
                    jump = _jump_at(response, curve.value, *points[peak.line - 1 : peak.line + 2])
                    if is_coarse and jump is not None:
                        jumps.append(jump)
                    elif is_coarse:
                        coarse.append(peak)
                rows.append((curve.response, *row, motion[k]))
        if rows[-1][0] != curve.response:
            k = int(np.argmax(abs(curve.value)))
            rows.append(
                (
                    curve.response,
                    format_decimals(curve.frequency[k], 4),
                    f"{factor * abs(curve.value[k]):.4g}",
                    motion[k],
                )
            )
    lines = table_lines(rows, "<>><")
    if coarse:
        frequencies = sorted({round(peak.frequency, 2) for peak in coarse})
        needed = min(peak.needed_spacing for peak in coarse)
        advice = f"Compute every {needed:.1g} Hz there" if np.isfinite(needed) else "Compute more frequencies there"
        lines.append(
            f"fewer than {MIN_LINES} frequencies in the half-power width of the peaks near "
            f"{', '.join(f'{frequency:.4g}' for frequency in frequencies[:_MAX_LISTED])} Hz: the true "
            f"peaks may be higher. {advice} (`points`)."
        )
    return [*lines, *_jump_notes(jumps)]


class _Jump(NamedTuple):
    """A jump of the response between two frequencies [Hz]; confirmed if the sweeps up and down differ at the peak."""

    low: float
    high: float
    is_confirmed: bool


def _jump_at(response: SteadyResponse, value: NDArray[np.complex128], before: int, k: int, after: int) -> _Jump | None:
    """Return a possible jump next to a peak of `value`: between `k` and the lower of its neighbors `before`, `after`.

    There the response falls below half power and the motion changes. None if the sweeps up and down agree at the peak.
    """
    frequency, below = response.frequency, min(before, after, key=lambda j: float(abs(value[j])))
    other_sweep = value[(frequency == frequency[k]) & (np.arange(frequency.size) != k)]
    is_confirmed = bool((abs(other_sweep - value[k]) > _SAME_MOTION * abs(value[k])).any())
    has_changed = bool((response.impacts[:, below] != response.impacts[:, k]).any())
    if abs(value[below]) > abs(value[k]) / np.sqrt(2.0) or not has_changed or (other_sweep.size and not is_confirmed):
        return None
    low, high = sorted((float(frequency[k]), float(frequency[below])))
    return _Jump(low, high, is_confirmed)


def _jump_notes(jumps: list[_Jump]) -> list[str]:
    """Return a sentence on the confirmed jumps, and a sentence on the others."""
    notes = (
        (True, "the response jumps", "the sweeps up and down differ there. `rig.follow_orbits` computes the branches."),
        (
            False,
            "the response falls and the motion changes",
            "it may jump there. Compare the sweeps up and down (`direction`): if they agree, compute more frequencies "
            "there (`points`).",
        ),
    )
    lines = []
    for is_confirmed, event, advice in notes:
        intervals = dict.fromkeys(
            f"{low:.5g} and {high:.5g} Hz" for low, high, of in sorted(jumps) if of is is_confirmed
        )
        if intervals:
            lines.append(f"{event} between {' and between '.join([*intervals][:_MAX_LISTED])}: {advice}")
    return lines


def _frequency_table(response: SteadyResponse, motion: list[str]) -> list[str]:
    """Return a table of responses, impacts per period and type of motion at each frequency."""
    unit, factor = frf_display(response.reference)[1:]
    headers = [f"{label} / ({unit})" for label in response.labels]
    lines = [f"{'frequency / Hz':>14}" + "".join(f"{header:>18}" for header in headers) + "  impacts  motion"]
    for k, frequency in enumerate(response.frequency):
        columns = "".join(f"{factor * abs(value):18.4g}" for value in response.frf[:, k])
        remark = "" if response.converged[k] else f"  not steady (residual {response.residual[k]:.1g})"
        impacts = float(response.impacts[:, k].sum())
        lines.append(f"{format_decimals(frequency, 4):>14}{columns}  {impacts:7.3g}  {motion[k]}{remark}")
    return lines
