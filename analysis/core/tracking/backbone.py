"""Backbone of a resonance: natural frequency and damping ratio against amplitude, from a phase-resonance test.

At phase resonance the force supplies the dissipated power P, so the damping ratio is D = P / (w0 w^2 a^2) with the
modal amplitude a of mass-normalized modes. P is the power of the tone; the power of the harmonics is zero for a force
shaker, and neglected for a coil spring. (M. Scheel, S. Peter, R. I. Leine, M. Krack, J. Sound Vib. 435 (2018) 56.)

At phase resonance, other modes still contribute to the phase of each body. They respond nearly in phase with the force,
so that the quadrature parts of all bodies' motions form the shape of the resonant mode. The projection of the motion on
this shape, weighted with the mass matrix, is the modal coordinate q. Its phase gives the natural frequency: w0^2 = w^2
+ 2 D w0 w Re q / -Im q. Other modes dissipate a part of the power, in proportion to the square of their motion.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from analysis.core.recordings.opening import takes_path
from analysis.core.responses.frequency_responses import frequency_responses
from analysis.core.responses.measurands import reference_of
from analysis.core.tracking.body_motion import CurvePart, LevelPoint, body_motion, quantity_ranges, table_of_levels
from daq.core.recording.recorded_test import HELD_PHASE
from daq.core.recording.recording import Recording
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import RecordingError
from rig.core.base.figure_types import Axes
from rig.core.base.palette import location_styles
from rig.core.base.renamed import renamed
from rig.core.results import Result, complete_style, format_limited, format_number
from rig.core.results.table import Table
from rig.core.results.uncertainty import SENSITIVITY
from rig.core.system.structural_model import structural_model

# Ratio of the frequency deviation that a phase deviation causes to that of a single mode. Contributions of other modes
# to the phase make it larger than 1. The largest ratio with the scene `backbone` was 1.8.
_FREQUENCY_DEVIATION_RATIO = 2.0
# Largest quadrature part of other modes, in their in-phase part times the resonant mode's damping ratio.
_MAX_QUADRATURE_PER_DAMPING = 10.0
# Largest power that other modes dissipate, relative to that of the resonant mode with the same motion. Apart from
# their quadrature part, it is at most 1 for damping proportional to mass or stiffness, and 2 allows for other damping.
_MAX_DISSIPATION_RATIO = 2.0
# Quantities of the mode at a level without a mode near phase resonance.
_NO_MODE = dict.fromkeys(("natural_frequency", "natural_frequency_expanded", "damping", "damping_expanded"), np.nan)


@dataclass(frozen=True, repr=False)
class Backbone(Result):
    """Natural frequency and damping ratio at each level of a test, in the order of the test.

    Attributes
    ----------
    label : str
        Name of the scene.
    body : str
        Body whose amplitude is given.
    unit : str
        Unit of the level.
    level, force : ndarray, shape (n,)
        Level, and amplitude of the measured force in N.
    frequency, frequency_expanded : ndarray, shape (n,)
        Frequency of phase resonance and half of its 95 % interval [Hz]. The interval includes the effect of the
        remaining phase deviation.
    phase_deviation, phase_deviation_expanded : ndarray, shape (n,)
        Phase of the body relative to that of phase resonance, and half of its 95 % interval [rad].
    natural_frequency, natural_frequency_expanded : ndarray, shape (n,)
        Natural frequency of the mode without the contributions of other modes to the phase of the body, and half of its
        95 % interval [Hz].
    amplitude, amplitude_expanded : ndarray, shape (n,)
        Displacement of the body and half of its 95 % interval [m].
    amplitude_own : ndarray, shape (n,)
        As `amplitude_expanded`, without the tolerances of the sensors, which all points share [m].
    damping, damping_expanded : ndarray, shape (n,)
        Damping ratio and half of its 95 % interval.
    settled : ndarray of bool, shape (n,)
        Whether phase and amplitude settled.
    """

    label: str
    body: str
    unit: str
    level: Array
    force: Array
    frequency: Array
    frequency_expanded: Array
    phase_deviation: Array
    phase_deviation_expanded: Array
    natural_frequency: Array
    natural_frequency_expanded: Array
    amplitude: Array
    amplitude_expanded: Array
    amplitude_own: Array
    damping: Array
    damping_expanded: Array
    settled: NDArray[np.bool_]

    frequency_bound = renamed("frequency_bound", "frequency_expanded")
    phase_deviation_bound = renamed("phase_deviation_bound", "phase_deviation_expanded")
    natural_frequency_bound = renamed("natural_frequency_bound", "natural_frequency_expanded")
    amplitude_bound = renamed("amplitude_bound", "amplitude_expanded")
    damping_bound = renamed("damping_bound", "damping_expanded")

    def summary(self) -> str:
        """Return the number of levels, and the frequency at the first and last level and at its extreme values."""
        ranges = quantity_ranges(self.level_points())
        name = "natural frequency" if "natural frequency" in ranges else "excitation frequency"
        return f"{self.label}: {self.level.size} levels, {name} {ranges[name]}"

    @property
    def at_natural_frequencies(self) -> Self:
        """Results drawn against natural frequency; unchanged if only the excitation frequency is known."""
        if not np.isfinite(self.natural_frequency).all():
            return self
        return replace(self, frequency=self.natural_frequency, frequency_expanded=self.natural_frequency_expanded)

    @property
    def frequency_name(self) -> str:
        """Name of the quantity in `frequency`."""
        is_natural = np.array_equal(self.frequency, self.natural_frequency)
        return "natural frequency" if is_natural else "excitation frequency"

    def omissions(self) -> list[str]:
        """Return no sentence: each level has one point, and the test ends where it does not reach a level."""
        return []

    def level_points(self) -> list[LevelPoint]:
        """Return natural frequency, damping ratio, excitation frequency and amplitude of each point."""
        columns = {
            "natural frequency / Hz": (self.natural_frequency, self.natural_frequency_expanded),
            "damping ratio / %": (100.0 * self.damping, 100.0 * self.damping_expanded),
            "excitation frequency / Hz": (self.frequency, self.frequency_expanded),
            "phase deviation / °": (np.degrees(abs(self.phase_deviation)), np.degrees(self.phase_deviation_expanded)),
            f"amplitude of {self.body} / mm": (1e3 * self.amplitude, 1e3 * self.amplitude_expanded),
        }
        points = []
        for k, level in enumerate(self.level.tolist()):
            quantities = {
                name: (float(value[k]), format_limited(float(value[k]), float(expanded[k])))
                for name, (value, expanded) in columns.items()
            }
            note = "" if self.settled[k] else "steady state not reached"
            points.append(LevelPoint(f"{format_number(level)} {self.unit}", float(self.frequency[k]), quantities, note))
        return points

    def parts(self) -> list[CurvePart]:
        """Return the settled points."""
        return [CurvePart("phase resonance", location_styles([self.body])[0], self.settled, True)]

    def marks(self) -> list[tuple[float, float, str]]:
        """Return frequency, amplitude and level of each point."""
        texts = [f"{format_number(level)} {self.unit}" for level in self.level]
        return [*zip(self.frequency.tolist(), self.amplitude.tolist(), texts, strict=True)]

    def table(self) -> Table:
        """Return the quantities of each level with their 95 % intervals."""
        points = self.level_points()
        return table_of_levels(points, points[0].quantities)

    def columns(self) -> Mapping[str, NDArray[Any]]:
        """Return level, frequency, amplitude and damping ratio with their intervals."""
        return {
            "level": self.level,
            "force_N": self.force,
            "frequency_Hz": self.frequency,
            "frequency_bound_Hz": self.frequency_expanded,
            "phase_deviation_rad": self.phase_deviation,
            "phase_deviation_bound_rad": self.phase_deviation_expanded,
            "natural_frequency_Hz": self.natural_frequency,
            "natural_frequency_bound_Hz": self.natural_frequency_expanded,
            "amplitude_m": self.amplitude,
            "amplitude_bound_m": self.amplitude_expanded,
            "damping_ratio": self.damping,
            "damping_ratio_bound": self.damping_expanded,
            "settled": self.settled,
        }

    def draw(self, ax: Axes, **style: Any) -> None:
        """Draw the amplitude against frequency: the measured points with their levels, joined in their order."""
        color = location_styles([self.body])[0].color
        # Dotted: nothing is measured between the points.
        line = {"color": color, "ls": ":", "lw": 1.0, "marker": "o", "markersize": 4.5}
        bars = complete_style(style, label=self.label, capsize=2, elinewidth=1.0, **line)
        ax.errorbar(
            self.frequency, 1e3 * self.amplitude, 1e3 * self.amplitude_own,
            self.frequency_expanded, **bars,
        )  # fmt: skip
        marks = self.marks()
        for k, (frequency, amplitude, level) in enumerate(marks):
            # The label is on the side away from the next point, and from the previous point at the end.
            is_left = marks[k + 1 if k + 1 < len(marks) else k - 1][0] > frequency
            ax.annotate(
                level, (frequency, 1e3 * amplitude), (-7 if is_left else 7, 5), textcoords="offset points",
                fontsize=8, ha="right" if is_left else "left",
            )  # fmt: skip
        ax.set(xlabel=f"{self.frequency_name} / Hz", ylabel=f"amplitude of {self.body} / mm")


@takes_path
def backbone(rec: Recording) -> Backbone:
    """Estimate natural frequency and damping ratio against amplitude from a phase-resonance test.

    Natural frequency and damping ratio need a motion channel at each body, and use the mass matrix of the scene.

    Parameters
    ----------
    rec : daq.Recording, str or Path
        The recording, or its path.

    Returns
    -------
    Backbone
        Frequencies [Hz], amplitudes [m] and damping ratios (1: critical damping) of all levels.

    Raises
    ------
    RecordingError
        If the recording contains no phase-resonance test.
    """
    markers = HELD_PHASE.measured(rec.markers)
    test = rec.scene.test
    held = None if test is None else test.held_phase
    if test is None or held is None or not markers:
        raise RecordingError(f"{rec.path} contains no phase-resonance test. Record a test of kind phase_resonance.")
    body, prescribed_phase = held
    mass = structural_model(rec.scene).mass
    driven = [number - 1 for number in rec.scene.force_on]
    # The sensitivity of a force sensor does not change the phase; those of the sensors of a spring force do.
    rotates = len(reference_of(rec, "force").channels) > 1
    points: list[dict[str, Any]] = []
    for marker in markers:
        [response] = frequency_responses(rec, level=float(marker.fields["level"]))
        line = int(np.argmin(abs(response.frequency - float(marker.fields["frequency"]))))
        omega = 2.0 * np.pi * float(response.frequency[line])
        output_at = {output.at: index for index, output in enumerate(response.outputs)}
        at_body = body_motion(response, body)
        held_output, values = at_body.output, response.value[line, :, 0]
        force, amplitude, relative, own = (
            float(column[line]) for column in (at_body.force, at_body.amplitude, at_body.relative, at_body.own)
        )
        turn = 2.0 * np.pi
        phase_error = float(np.remainder(np.angle(values[held_output]) - prescribed_phase + np.pi, turn) - np.pi)
        uncertain = response if rotates else response.without(SENSITIVITY)
        rotation = float(uncertain.expanded()[line, held_output, 0]) / abs(values[held_output])
        angle = _FREQUENCY_DEVIATION_RATIO * (abs(phase_error) + rotation)
        tangent = float(np.tan(angle)) if angle < np.pi / 2.0 else np.inf
        places = [f"body {number}" for number in range(1, len(mass) + 1)]
        mode, outputs = _NO_MODE, [output_at[place] for place in places if place in output_at]
        if len(outputs) == len(mass):
            motion = np.asarray(force * values[outputs], dtype=np.complex128)
            mode = _mode(motion, mass, driven, force, omega, relative, rotation)
        points.append({
            "level": float(marker.fields["level"]),
            "force": force,
            "frequency": response.frequency[line],
            "frequency_expanded": abs(mode["damping"]) * omega / turn * tangent,
            "phase_deviation": phase_error,
            "phase_deviation_expanded": rotation,
            **mode,
            "amplitude": amplitude,
            "amplitude_expanded": relative * amplitude,
            "amplitude_own": own * amplitude,
            "settled": marker.fields.get("settled") is not False,
        })  # fmt: skip
    return Backbone(
        label=rec.scene.name,
        body=rec.scene.structure.label(body),
        unit=test.level_unit(rec.scene.driven_shaker),
        **{name: np.array([point[name] for point in points]) for name in points[0]},
    )


def _mode(
    motion: ComplexArray, mass: Array, driven: list[int], force: float, omega: float, relative: float, rotation: float
) -> dict[str, float]:
    """Return the mode of a motion [m] per force [N]; `relative`, `rotation`: uncertainties of motion and phase."""
    shape = -motion.imag / np.sqrt(motion.imag @ mass @ motion.imag)
    coordinate = complex(shape @ mass @ motion)
    others = motion.real - shape * coordinate.real
    tangent = coordinate.real / -coordinate.imag
    # The equation of the mode: (w0^2 - w^2 + 2i D w0 w) q = force
    quadrature = float(np.sum(shape[driven])) * force * -coordinate.imag / (abs(coordinate) ** 2 * omega**2)
    squared = 1.0 + quadrature * tangent
    if squared <= 0.0:
        # Far from resonance, other modes dominate.
        return _NO_MODE
    natural = omega * float(np.sqrt(squared))
    damping = quadrature * omega / (2.0 * natural)
    share = float(np.sqrt(others @ mass @ others)) / -coordinate.imag
    drive_share = max(share, abs(float(np.sum(others[driven])) / float(np.sum(motion.imag[driven]))))
    damping_error = 2.0 * relative + _MAX_DISSIPATION_RATIO * share**2
    damping_error += min(_MAX_QUADRATURE_PER_DAMPING * abs(damping), 1.0) * drive_share
    # Without motion of other modes, an unbounded error of their motion has no effect (0 times infinity would be NaN).
    angle_error = rotation + (share * (share + relative) if share else 0.0)
    error = abs(damping) * ((1.0 + tangent**2) * angle_error + abs(tangent) * damping_error)
    values = natural / (2.0 * np.pi), natural * error / (2.0 * np.pi), damping, abs(damping) * damping_error
    return dict(zip(_NO_MODE, values, strict=True))
