"""Harmonic force surface: the force against frequency and amplitude, from tests that hold the amplitude of a motion.

At one frequency the force is a single-valued function of the amplitude, even if several amplitudes belong to one force.
Curves of constant force, with their unstable parts, follow from this function. (T. Karaagacli, H. N. Ozguven, Vibration
3 (2020) 266.) The real and imaginary parts of the dynamic stiffness are interpolated over the amplitude, because they
are smoother than the force.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import floor, log10
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import Akima1DInterpolator

from analysis.core.recordings.opening import takes_path
from analysis.core.responses.frequency_responses import frequency_responses
from analysis.core.tracking.body_motion import body_motion, draw_common_error
from daq.core.recording.recording import Recording
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import RecordingError
from rig.core.base.figure_types import Axes
from rig.core.base.palette import recording_styles
from rig.core.base.renamed import renamed
from rig.core.results import Result, complete_style

# Minimum number of amplitudes at one frequency for interpolation by a curve instead of a straight line.
_MIN_AMPLITUDES = 3
# Successive amplitudes belong to the same held level if they differ by less than this fraction.
_LEVEL_STEP = 0.02
# Number of amplitudes to which the points of a frequency are interpolated: finer than the contours of a figure.
_GRID = 1000
# A larger ratio of forces has a logarithmic axis.
_MAX_LINEAR_RATIO = 10.0


@dataclass(frozen=True, repr=False)
class ForceSurface(Result):
    """Force amplitudes in steady state at several frequencies and displacement amplitudes of a body.

    Attributes
    ----------
    label : str
        Name of the scene.
    body : str
        Body whose amplitude was held.
    frequency, amplitude : ndarray, shape (n,)
        Frequency in Hz and displacement amplitude in m.
    stiffness : ndarray, shape (n,), complex
        Dynamic stiffness, force per displacement [N/m].
    force, force_expanded : ndarray, shape (n,)
        Force amplitude and half of its 95 % interval at the stated displacement amplitude [N]. The interval includes
        the uncertainty of the displacement, which changes the force by the slope between the measured amplitudes.
    force_own : ndarray, shape (n,)
        As `force_expanded`, without the tolerances of the sensors, which all points share [N].
    """

    label: str
    body: str
    frequency: Array
    amplitude: Array
    stiffness: ComplexArray
    force: Array
    force_expanded: Array
    force_own: Array

    force_bound = renamed("force_bound", "force_expanded")

    def _curves(self) -> Iterable[tuple[float, Array, Array, Array]]:
        """Yield each frequency in Hz with amplitudes in m, and force with half of its 95 % interval in N.

        The error of the interpolation is at most s (1 - s) times the change of the dynamic stiffness from one amplitude
        to the next, with the share s of the distance. This assumption is true for the scene `held-response`.
        """
        for frequency in np.unique(self.frequency).tolist():
            chosen = np.flatnonzero(self.frequency == frequency)
            chosen = chosen[np.argsort(self.amplitude[chosen])]
            if chosen.size < _MIN_AMPLITUDES:
                continue
            known, stiffness = self.amplitude[chosen], self.stiffness[chosen]
            amplitude = np.geomspace(known[0], known[-1], _GRID)
            real, imaginary = (
                Akima1DInterpolator(known, part, method="makima")(amplitude)
                for part in (stiffness.real, stiffness.imag)
            )
            force = amplitude * np.hypot(real, imaginary)
            lower = np.clip(np.searchsorted(known, amplitude) - 1, 0, known.size - 2)
            share = (amplitude - known[lower]) / np.diff(known)[lower]
            change = abs(np.diff(stiffness))[lower] * amplitude
            expanded = np.interp(amplitude, known, self.force_expanded[chosen]) + share * (1.0 - share) * change
            yield frequency, amplitude, force, expanded

    def at_force(self, force: float) -> dict[str, NDArray[Any]]:
        """Return the response at constant force by interpolation between the held amplitudes.

        Parameters
        ----------
        force : float
            Force amplitude [N].

        Returns
        -------
        dict of ndarray
            `frequency_Hz`, `amplitude_m`, half of its 95 % interval `amplitude_bound_m`, and `stable`: whether the
            force rises with the amplitude. A frequency appears once for each amplitude, or not at all if the measured
            forces do not include the force.
        """
        rows: list[tuple[float, float, float, bool]] = []
        for frequency, amplitude, values, expanded in self._curves():
            rise = np.diff(values)
            for k in np.flatnonzero((values[1:] >= force) != (values[:-1] >= force)):
                share = (force - values[k]) / rise[k]
                # Next to a fold, the slope of the chord over the interval of the force is used.
                within = np.flatnonzero(abs(values - force) <= expanded[k])
                width = np.ptp(amplitude[within]) / 2.0 if within.size else 0.0
                error = max(expanded[k] * (amplitude[k + 1] - amplitude[k]) / abs(rise[k]), width)
                rows.append((frequency, amplitude[k] + share * (amplitude[k + 1] - amplitude[k]), error, rise[k] > 0.0))
        columns = zip(*rows, strict=True) if rows else ([], [], [], [])
        names = ("frequency_Hz", "amplitude_m", "amplitude_bound_m", "stable")
        return {name: np.array(column) for name, column in zip(names, columns, strict=True)}

    def folds(self, force: float) -> list[tuple[float, float]]:
        """Return frequency [Hz] and amplitude [m] of the folds of the response at constant force.

        At a fold the force has a maximum or minimum with respect to the amplitude. Maxima and minima are interpolated
        linearly from one measured frequency to the next.
        """
        folds: list[tuple[float, float]] = []
        previous: dict[bool, tuple[float, float, float]] = {}
        for frequency, amplitude, values, _ in self._curves():
            rise = np.diff(values)
            extremes: dict[bool, tuple[float, float, float]] = {}
            for k in np.flatnonzero(rise[1:] * rise[:-1] < 0.0) + 1:
                extremes.setdefault(bool(rise[k] < 0.0), (frequency, amplitude[k], values[k]))
            for kind, (f1, a1, force1) in extremes.items():
                if kind in previous:
                    f0, a0, force0 = previous[kind]
                    share = (force - force0) / (force1 - force0) if force1 != force0 else np.inf
                    if 0.0 <= share < 1.0:
                        folds.append((f0 + share * (f1 - f0), a0 + share * (a1 - a0)))
            previous = extremes
        return folds

    def summary(self) -> str:
        """Return the ranges of frequency, amplitude and force."""
        return (
            f"{self.label}: {self.frequency.size} points, {self.frequency.min():.4g} to {self.frequency.max():.4g} Hz, "
            f"{self.body} from {1e3 * self.amplitude.min():.3g} to {1e3 * self.amplitude.max():.3g} mm, force from "
            f"{self.force.min():.3g} to {self.force.max():.3g} N"
        )

    def columns(self) -> Mapping[str, NDArray[Any]]:
        """Return frequency, amplitude and force with its interval."""
        return {
            "frequency_Hz": self.frequency,
            "amplitude_m": self.amplitude,
            "force_N": self.force,
            "force_bound_N": self.force_expanded,
        }

    def draw(self, ax: Axes, **style: Any) -> None:
        """Draw the force against frequency; points near one amplitude are one curve."""
        levels = _levels(self.amplitude)
        medians = [1e3 * float(np.median(self.amplitude[chosen])) for chosen in levels]
        # Levels have two digits, unless they differ by less.
        digits = 2 if len({f"{each:.2g}" for each in medians}) == len(levels) else 4
        styles = recording_styles([False] * len(levels))
        for chosen, median, (color, _, marker) in zip(levels, medians, styles, strict=True):
            along = chosen[np.argsort(self.frequency[chosen])]
            label = f"{median:.{max(digits - 1 - floor(log10(median)), 0)}f} mm"
            # Dotted: the lowest force may be between the points.
            line = {"color": color, "ls": ":", "lw": 1.0, "elinewidth": 1.0, "marker": marker, "ms": 3}
            bars = complete_style(style, label=label, capsize=2, **line)
            ax.errorbar(self.frequency[along], self.force[along], self.force_own[along], **bars)
            columns = self.frequency, self.force, self.force_own, self.force_expanded
            draw_common_error(ax, *(column[along] for column in columns))
        ax.set(xlabel="frequency / Hz", ylabel="force / N")
        if self.force.max() > _MAX_LINEAR_RATIO * self.force.min() > 0.0:
            # Imported at the first figure, because matplotlib takes long.
            from rig.core.base.figure_style import log_axis

            log_axis(ax, [self.force])


@takes_path
def force_surface(rec: Recording) -> ForceSurface:
    """Return the harmonic force surface of a test that holds the amplitude of a motion.

    Parameters
    ----------
    rec : daq.Recording, str or Path
        The recording, or its path.

    Returns
    -------
    ForceSurface
        Force [N] at each frequency [Hz] and amplitude [m]. Points that did not reach steady state are omitted.

    Raises
    ------
    RecordingError
        If the test held no motion.
    """
    test = rec.scene.test
    if test is None or test.held_motion is None:
        raise RecordingError(
            f"{rec.path}: the test held no amplitude of a motion constant. Record a test of kind constant_response."
        )
    location = test.held_motion[0]
    parts = []
    for response in frequency_responses(rec):
        motion = body_motion(response, location)
        value = response.value[:, motion.output, 0]
        columns = (response.frequency, motion.amplitude, 1.0 / value, motion.force, motion.relative, motion.own)
        parts.append([column[motion.settled] for column in columns])
    frequency, amplitude, stiffness, force, relative, own = map(np.concatenate, zip(*parts, strict=True))
    if not frequency.size:
        raise RecordingError(
            f"{rec.path}: no point reached steady state. Increase test.settle.longest, and record again."
        )
    slope = largest_slopes(frequency, amplitude, force)
    shaker = rec.scene.driven_shaker
    if shaker is None or not shaker.drive_is_force:
        # An error of the response may be caused by an error of the force.
        slope = np.maximum(slope, 1.0)
    body = rec.scene.structure.label(location)
    expanded, own = (slope * part * force for part in (relative, own))
    return ForceSurface(rec.scene.name, body, frequency, amplitude, stiffness, force, expanded, own)


def largest_slopes(frequency: Array, amplitude: Array, force: Array) -> Array:
    """Return the largest magnitude of the slope d ln(force) / d ln(amplitude) that each point can have.

    The slope is the larger slope of the chords to the next lower and higher amplitude at the same frequency. Below the
    lowest amplitude the structure is assumed to be linear, with the slope 1. Above the highest amplitude, the slope is
    assumed to change as much as between the last two chords.
    """
    largest = np.ones(frequency.size)
    for value in np.unique(frequency):
        chosen = np.flatnonzero(frequency == value)
        levels = [chosen[part] for part in _levels(amplitude[chosen])]
        heights, forces = (np.log([np.mean(values[part]) for part in levels]) for values in (amplitude, force))
        chords = np.append(1.0, np.diff(forces) / np.diff(heights))
        above = np.append(chords[1:], 2.0 * chords[-1] - chords[-2:][0])
        for part, slope in zip(levels, np.maximum(abs(chords), abs(above)), strict=True):
            largest[part] = slope
    return largest


def _levels(amplitude: Array) -> list[NDArray[np.intp]]:
    """Return the indices of the points of each held level, from the lowest to the highest."""
    order = np.argsort(amplitude)
    return np.split(order, np.flatnonzero(np.diff(np.log(amplitude[order])) > _LEVEL_STEP) + 1)
