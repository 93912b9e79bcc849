"""Response at constant force from a continuation test: its stable and unstable parts, and its folds.

A fold is a point at which the curve turns back in frequency: the frequency has a maximum or minimum along the curve.
The extreme value is computed from a cubic polynomial, fitted to the frequencies of the nearest points over the length
of the curve. At a corner, the fold lies between the last stable point and the frequency at which the motion has jumped.
The motion between two folds is unstable at constant force.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from analysis.core.recordings.opening import takes_path
from analysis.core.responses.frequency_responses import frequency_responses
from analysis.core.tracking.body_motion import CurvePart, LevelPoint, body_motion
from daq.core.recording.recorded_test import FOLLOWED_CURVE
from daq.core.recording.recording import Recording
from rig.core.base.arrays import Array
from rig.core.base.errors import RecordingError
from rig.core.base.figure_types import Axes
from rig.core.base.palette import level_styles
from rig.core.base.renamed import renamed
from rig.core.results import Result, complete_style, format_interval, format_limited, format_number
from rig.core.results.table import Table
from rig.core.results.text import format_quantity
from rig.core.results.uncertainty import SENSITIVITY
from rig.core.scene.excitation import FORCE_TOLERANCE

# Number of points on each side of a fold to which polynomials are fitted: as many as a parabola has coefficients.
_FITTED = 3
# A curve reaches an end of the band up to this ratio of frequencies.
_BAND_END = 1.001


class Fold(NamedTuple):
    """A point at which a curve turns back."""

    level: float  # level, in the unit of the test
    frequency: float  # Hz
    expanded: float  # expanded uncertainty of the frequency [Hz]
    amplitude: float  # m
    position: float  # position along the curve, in numbers of points


@dataclass(frozen=True, repr=False)
class AmplitudeCurve(Result):
    """Points of the response curve at each level, in the order of the test.

    Attributes
    ----------
    label : str
        Name of the scene.
    body : str
        Body whose amplitude is given.
    unit : str
        Unit of the level.
    band : tuple of float
        Lowest and highest frequency of the test [Hz].
    level, force : ndarray, shape (n,)
        Level in the unit of the test, and amplitude of the measured force in N.
    frequency, frequency_expanded : ndarray, shape (n,)
        Frequency and half of the 95 % interval of the frequency that has this amplitude at the level [Hz].
    amplitude, amplitude_expanded : ndarray, shape (n,)
        Displacement of the body and half of its 95 % interval [m].
    amplitude_own : ndarray, shape (n,)
        As `amplitude_expanded`, without the tolerances of the sensors, which all points share [m].
    stable, settled : ndarray of bool, shape (n,)
        Whether the motion is stable at constant force, and whether steady state was reached.
    folds : tuple of Fold
        Level, frequency in Hz, half of its 95 % interval, and amplitude in m of each fold.
    """

    label: str
    body: str
    unit: str
    band: tuple[float, float]
    level: Array
    force: Array
    frequency: Array
    frequency_expanded: Array
    amplitude: Array
    amplitude_expanded: Array
    amplitude_own: Array
    stable: NDArray[np.bool_]
    settled: NDArray[np.bool_]
    folds: tuple[Fold, ...]

    frequency_bound = renamed("frequency_bound", "frequency_expanded")
    amplitude_bound = renamed("amplitude_bound", "amplitude_expanded")

    def summary(self) -> str:
        """Return the numbers of points and folds, and the largest amplitude."""
        folds = len(self.folds)
        return (
            f"{self.label}: {np.unique(self.level).size} levels, {self.level.size} points ({(~self.stable).sum()} "
            f"unstable), {folds} fold{'s' * (folds != 1)}, {self.body} up to {1e3 * self.amplitude.max():.3g} mm"
        )

    def omissions(self) -> list[str]:
        """Return a sentence on each level whose curve ends inside the band of the test."""
        (low, high), omissions = self.band, []
        for level in dict.fromkeys(self.level.tolist()):
            frequency = self.frequency[(self.level == level) & self.settled]
            ends = [f"below {frequency.min():.2f} Hz"] if frequency.size and frequency.min() > low * _BAND_END else []
            ends += [f"above {frequency.max():.2f} Hz"] if frequency.size and high > frequency.max() * _BAND_END else []
            if ends:
                name = f"{format_number(level)} {self.unit}"
                omissions.append(f"{name}: not followed {' and '.join(ends)}, where amplitudes may be larger")
        return omissions

    def resolution(self, level: float) -> float:
        """Return the smallest distance of two folds that can be told apart [Hz].

        This is the largest step or interval between points with more than half of the largest amplitude.

        It is infinite if no point of the level is in steady state.
        """
        chosen = (self.level == level) & self.settled
        if not chosen.any():
            return float("inf")
        is_high = self.amplitude[chosen] > 0.5 * self.amplitude[chosen].max()
        steps, noise = abs(np.diff(self.frequency[chosen])), 2.0 * self.frequency_expanded[chosen]
        return float(np.maximum(steps, noise[1:])[is_high[1:]].max(initial=0.0))

    def level_points(self) -> list[LevelPoint]:
        """Return excitation frequency and amplitude of the highest point at each level, with the folds of the level."""
        points = []
        for level in dict.fromkeys(self.level.tolist()):
            chosen = np.flatnonzero(self.level == level)
            highest = chosen[np.argmax(self.amplitude[chosen])]
            frequency, *peak = (
                float(values[highest])
                for values in (self.frequency, 1e3 * self.amplitude, 1e3 * self.amplitude_expanded)
            )
            folds = [format_quantity(fold.frequency, fold.expanded, "Hz") for fold in self.folds if fold.level == level]
            if folds:
                note = f"fold{'s' * (len(folds) > 1)} at {', '.join(folds)}"
            elif self.settled[chosen].any():
                note = f"no fold detected; a fold narrower than {self.resolution(level):.2g} Hz can be missed"
            else:
                note = "no steady state"
            largest = format_limited(*peak)
            if highest in chosen[[0, -1]]:
                # The curve continues beyond its first and last point.
                largest = f"≥ {peak[0] - peak[1]:.3g}"
            quantities = {
                "excitation frequency / Hz": (frequency, f"{frequency:.4g}"),
                f"largest amplitude of {self.body} / mm": (peak[0], largest),
            }
            points.append(LevelPoint(f"{format_number(level)} {self.unit}", frequency, quantities, note))
        return points

    def parts(self) -> list[CurvePart]:
        """Return the settled points of each level, stable and unstable."""
        return [
            CurvePart(f"{format_number(level)} {self.unit}{'' if is_stable else ', unstable'}", style, part, is_stable)
            for level, style in level_styles(self.level).items()
            for is_stable in (True, False)
            if (part := (self.level == level) & self.settled & (self.stable == is_stable)).any()
        ]

    def marks(self) -> list[tuple[float, float, str]]:
        """Return frequency, amplitude and name of each fold."""
        return [(fold.frequency, fold.amplitude, f"fold {fold.frequency:.4g} Hz") for fold in self.folds]

    def table(self, exact: Sequence[str] = ()) -> Table:
        """Return the folds; `exact`: frequencies of the folds of the exact orbits [Hz]."""
        rows = [
            (
                f"{format_number(fold.level)} {self.unit}", format_interval(fold.frequency, fold.expanded),
                f"{1e3 * fold.amplitude:.3g}", exact_fold,
            )
            for fold, exact_fold in zip(self.folds, exact or [""] * len(self.folds), strict=True)
        ]  # fmt: skip
        return Table(("level", "fold / Hz", f"amplitude of {self.body} / mm", "exact / Hz"), ">>>>", rows)

    def columns(self) -> Mapping[str, NDArray[Any]]:
        """Return level, frequency and amplitude with their intervals and stability."""
        return {
            "level": self.level,
            "force_N": self.force,
            "frequency_Hz": self.frequency,
            "frequency_bound_Hz": self.frequency_expanded,
            "amplitude_m": self.amplitude,
            "amplitude_bound_m": self.amplitude_expanded,
            "stable": self.stable,
            "settled": self.settled,
        }

    def draw(self, ax: Axes, **style: Any) -> None:
        """Draw the settled points, joined in their order; unstable points are hollow, and folds are crosses."""
        for level, level_style in level_styles(self.level).items():
            chosen = (self.level == level) & self.settled
            ax.plot(self.frequency[chosen], 1e3 * self.amplitude[chosen], color=level_style.color, lw=0.5, zorder=0)
        self.draw_points(ax, **style)

    def draw_points(self, ax: Axes, **style: Any) -> None:
        """Draw the settled points without lines; unstable points are hollow, and folds are crosses."""
        for name, (color, _, marker), part, is_stable in self.parts():
            face = color if is_stable else "white"
            points = complete_style(style, color=color, marker=marker, ms=4, ls="", elinewidth=0.7, zorder=3)
            columns = self.frequency, 1e3 * self.amplitude, 1e3 * self.amplitude_own
            x, y, expanded = (column[part] for column in columns)
            ax.errorbar(x, y, expanded, markerfacecolor=face, label=name, **points)
        if self.folds:
            folds = [(fold.frequency, 1e3 * fold.amplitude, fold.expanded) for fold in self.folds]
            x, y, expanded = np.transpose(folds)
            ax.errorbar(x, y, xerr=expanded, fmt="x", color="black", zorder=4, label="fold", ms=8, capsize=2)
        ax.set(xlabel="excitation frequency / Hz", ylabel=f"amplitude of {self.body} / mm")


@takes_path
def continuation(rec: Recording) -> AmplitudeCurve:
    """Return the response curves of a continuation test, with unstable parts and folds.

    Parameters
    ----------
    rec : daq.Recording, str or Path
        The recording, or its path.

    Returns
    -------
    AmplitudeCurve
        Frequencies [Hz] and amplitudes [m] of the points and folds of all levels.

    Raises
    ------
    RecordingError
        If the recording contains no continuation test.
    """
    markers = FOLLOWED_CURVE.measured(rec.markers)
    test = rec.scene.test
    if not markers or test is None or test.band is None:
        raise RecordingError(f"{rec.path} contains no continuation test. Record a test of kind continuation.")
    [location] = rec.scene.controlled_terms
    columns: list[dict[str, NDArray[Any]]] = []
    folds: list[Fold] = []
    for level in dict.fromkeys(float(marker.fields["level"]) for marker in markers):
        [response] = frequency_responses(rec, level=level)
        motion, frequency = body_motion(response, location), response.frequency
        compliance, settled = response.value[:, motion.output, 0], motion.settled
        fields_at = {
            float(marker.fields["frequency"]): marker.fields for marker in markers if marker.fields["level"] == level
        }
        points = [fields_at[each] for each in frequency.tolist()]
        # The drive of a force shaker is the level, independent of the sensitivities of the sensors.
        drive_is_force = rec.scene.driven_shaker is not None and rec.scene.driven_shaker.drive_is_force
        uncertain = response.without(SENSITIVITY) if drive_is_force else response
        force_error = uncertain.expanded()[:, motion.output, 0] / abs(compliance) + FORCE_TOLERANCE
        # Change of the frequency per relative change of the force at constant amplitude, as on the side of a resonance.
        decay_rate = np.array([float(fields[FOLLOWED_CURVE.field]) for fields in points]) / (2.0 * np.pi)
        per_force = decay_rate * abs(compliance) / np.maximum(abs(compliance.real), 1e-3 * abs(compliance))
        expanded = force_error * per_force
        jump = np.array([fields.get("jump") or np.nan for fields in points])
        of_level = _folds(level, frequency[settled], motion.amplitude[settled], expanded[settled], jump[settled])
        folds += of_level
        # The motion is unstable behind an odd number of folds.
        n_passed = np.searchsorted([fold.position for fold in of_level], np.arange(frequency.size))
        columns.append({
            "level": np.full(frequency.size, level),
            "force": motion.force,
            "frequency": frequency,
            "frequency_expanded": expanded,
            "amplitude": motion.amplitude,
            "amplitude_expanded": motion.relative * motion.amplitude,
            "amplitude_own": motion.own * motion.amplitude,
            "stable": n_passed % 2 == 0,
            "settled": settled,
        })  # fmt: skip
    return AmplitudeCurve(
        label=rec.scene.name,
        body=rec.scene.structure.label(location),
        unit=test.level_unit(rec.scene.driven_shaker),
        band=test.band,
        folds=tuple(folds),
        **{name: np.concatenate([each[name] for each in columns]) for name in columns[0]},
    )


def _folds(level: float, frequency: Array, amplitude: Array, expanded: Array, jump: Array) -> list[Fold]:
    """Locate the points at which the frequency turns back; `expanded`: uncertainty at constant amplitude [Hz].

    `jump`: frequency at which the motion of a point behind a corner has jumped [Hz]; NaN for other points.
    """
    folds: list[Fold] = []
    steps = np.diff(frequency)
    vertex: int
    for vertex in (np.flatnonzero(steps[1:] * steps[:-1] < 0.0) + 1).tolist():
        if not np.isnan(jump[vertex : vertex + 2]).all():
            continue
        first = max(vertex - _FITTED + 1, 0)
        window = slice(first, vertex + _FITTED)
        near, heights = frequency[window], amplitude[window]
        # Frequency and logarithm of the amplitude are scaled to the same range within the window.
        logarithm = np.log(heights)
        chords = np.hypot(np.diff(near) / max(np.ptp(near), 1e-12), np.diff(logarithm) / max(np.ptp(logarithm), 1e-12))
        # Length along the curve, from the vertex.
        length = np.concatenate([[0.0], np.cumsum(chords)])
        length -= length[vertex - first]
        extremes: list[tuple[float, float]] = []
        for degree in (2, 3):
            polynomial = np.polynomial.Polynomial.fit(length, near, min(degree, length.size - 1))
            roots = polynomial.deriv().roots()
            nearest = float(np.real(roots[np.argmin(abs(roots))])) if roots.size else 0.0
            nearest = float(np.clip(nearest, length[0], length[-1]))
            extremes.append((nearest, float(polynomial(nearest))))
        (_, quadratic), (at, cubic) = extremes
        position = first + float(np.interp(at, length, np.arange(length.size)))
        error = float(np.hypot(expanded[vertex], cubic - quadratic))
        folds.append(Fold(level, cubic, error, float(np.interp(at, length, heights)), position))
    for point in np.flatnonzero(np.isfinite(jump)).tolist():
        middle, half = (jump[point] + frequency[point]) / 2.0, abs(jump[point] - frequency[point]) / 2.0
        folds.append(Fold(level, float(middle), float(half + expanded[point]), float(amplitude[point]), point - 0.5))
    return sorted(folds, key=lambda fold: fold.position)
