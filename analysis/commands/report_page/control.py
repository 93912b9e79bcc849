"""Charts of tests that control the motion of channels: profiles, pulses and shock response spectra."""

import numpy as np

from analysis.commands.report_page.charts import (
    Chart,
    Curve,
    EvenlySpaced,
    Mark,
    Panel,
    Strip,
    limits_with_margin,
    side_limits,
)
from analysis.commands.report_page.measurements import Measurement
from analysis.core.decays.sensor_correction import correct_motion
from analysis.core.signals.profile_check import ProfileCheck
from analysis.core.signals.shock_spectrum import OCTAVE_STEPS, prescribed_spectrum, scatter_text
from analysis.core.tracking.backbone import Backbone
from analysis.core.tracking.body_motion import CurvePart, common_error_text
from analysis.core.tracking.continuation import AmplitudeCurve
from daq.core.recording.recorded_test import shocks_of
from rig.core.base.arrays import Array
from rig.core.base.palette import BASELINE, CurveStyle, location_style
from rig.core.numerics.decibels import from_decibels
from rig.core.numerics.runs import ranges_of
from rig.core.results import format_percent
from rig.core.scene.excitation import FORCE_TOLERANCE

# The duration of a pulse is the time in which it exceeds this fraction of its peak.
_VISIBLE_PART = 0.2
# Lower limit of the vertical axis of a profile, as a fraction of the lowest value of the profile.
_SHOWN_BELOW = 1e-2
# The chart first shows this multiple of the duration of the pulse.
_PULSE_VIEW = 3.0


def _profile_chart(check: ProfileCheck) -> Chart:
    """Return a chart of control and limited channels with their bounds."""
    control, *limited = check.styles()
    frequency = check.frequency
    curves = [
        Curve("profile", frequency, check.profile, *check.band, CurveStyle(BASELINE, (6, 3))),
        Curve("control", frequency, check.control, style=control._replace(dashes=())),
    ]
    for level, style in zip(check.limited, limited, strict=True):
        curves.append(Curve(level.channel, frequency, level.values, level.low, level.high, style._replace(dashes=())))
        curves.append(Curve(f"limit of {level.channel}", frequency, level.limit, style=style._replace(dashes=(2, 2))))
    highest = max(float(np.nanmax(np.asarray(curve.y))) for curve in curves)
    return Chart(
        f"Control channel with profile and tolerance of {check.tolerance:g} dB; limited channels with limits (dotted)"
        + " and 95 % intervals" * check.is_density,
        "Control and limited channels against the profile.",
        [
            Panel(
                "acceleration PSD" if check.is_density else "acceleration",
                check.unit,
                curves,
                height=280,
                logarithmic=True,
                strips=[
                    Strip(ends, color) for marked, color in check.strips() for ends in ranges_of(frequency, marked)
                ],
                limits=(_SHOWN_BELOW * float(np.nanmin(check.profile)), 2.0 * highest),
            )
        ],
        logarithmic=True,
        notes=[
            "Colored strips: a limit keeps the control below the tolerance." * bool(check.is_reduced.any()),
            "Black strips: outside the tolerance, where no limit acts." * bool(check.is_outside.any()),
        ],
    )


def _tracking_chart(result: AmplitudeCurve | Backbone, frequency_name: str) -> Chart:
    """Return a chart of the amplitude against frequency of followed curves or resonances."""
    curves, parts = list[Curve](), result.parts()
    amplitude, expanded = 1e3 * result.amplitude, 1e3 * result.amplitude_own
    for part in parts:
        if not any(part.style == curve.style for curve in curves):
            path = np.any([other.selected for other in parts if other.style == part.style], axis=0)
            curves.append(Curve(part.name, result.frequency[path], amplitude[path], style=part.style, draw="path"))
        curves.append(_bars(part, result.frequency, amplitude, expanded))
    difference = float(np.nanmax(abs(result.force / result.level - 1.0))) if result.unit == "N" else 0.0
    notes = [
        common_error_text(result.amplitude, result.amplitude_own, result.amplitude_expanded),
        "Hollow circles: motions that are unstable at constant force." * any(not part.is_stable for part in parts),
        f"The measured force differs from its level by up to {format_percent(difference)}."
        * (difference > FORCE_TOLERANCE),
    ]
    frequency = np.concatenate([np.asarray(curve.x) for curve in curves])
    # A label is joined to the end of an interval.
    ends = dict(zip(result.frequency.tolist(), (amplitude + expanded).tolist(), strict=True))
    marks = [Mark(at, ends.get(at, 1e3 * height), text) for at, height, text in sorted(result.marks())]
    return Chart(
        "Points in the order of the test, with 95 % intervals",
        f"Amplitude against {frequency_name}.",
        [Panel(f"amplitude of {result.body}", "mm", curves, 300, limits=limits_with_margin(curves), marks=marks)],
        x_name=frequency_name,
        x_limits=side_limits(frequency),
        notes=notes,
    )


def _modal_chart(result: Backbone) -> Chart:
    """Return a chart of natural frequency and damping ratio against amplitude."""
    [part], amplitude = result.parts(), 1e3 * result.amplitude
    panels = []
    for name, unit, values, expanded in (
        ("natural frequency", "Hz", result.natural_frequency, result.natural_frequency_expanded),
        ("damping ratio", "%", 100.0 * result.damping, 100.0 * result.damping_expanded),
    ):
        path = Curve(part.name, amplitude[part.selected], values[part.selected], style=part.style, draw="path")
        curves = [path, _bars(part, amplitude, values, expanded)]
        panels.append(Panel(name, unit, curves, 170, limits=limits_with_margin(curves)))
    return Chart(
        "Natural frequency and damping ratio at each level against amplitude, with 95 % intervals",
        "Natural frequency and damping ratio against amplitude.",
        panels,
        x_name=f"amplitude of {result.body}",
        x_unit="mm",
        x_limits=side_limits(amplitude),
    )


def _bars(part: CurvePart, x: Array, y: Array, expanded: Array) -> Curve:
    """Return the points of a part of the curve with their intervals; unstable points are hollow."""
    x, y, expanded = x[part.selected], y[part.selected], expanded[part.selected]
    return Curve(part.name, x, y, y - expanded, y + expanded, part.style, "dots" if part.is_stable else "circles")


def control_charts(measurement: Measurement) -> list[Chart]:
    """Return the charts of the controlled motion in a recording; empty for tests without controlled motion."""
    rec = measurement.rec
    if measurement.tracked is not None:
        tracked = measurement.tracked
        if not isinstance(tracked, Backbone):
            return [_tracking_chart(tracked, "excitation frequency")]
        drawn = tracked.at_natural_frequencies
        return [_tracking_chart(drawn, drawn.frequency_name), _modal_chart(tracked)]
    if measurement.profile is not None:
        return [_profile_chart(measurement.profile)]
    if not measurement.spectra or rec.scene.test is None:
        return []
    test, mark = rec.scene.test, shocks_of(rec.markers)[0]
    control = next(name for _, name in test.named_channels)
    samples = rec.read(control, mark.first_sample, mark.end + 1)
    wave = correct_motion(rec.channels[control], samples, "acceleration", 2.0 / test.shortest, 0.4 * rec.rate)
    center = int(mark.fields["center"]) - mark.first_sample
    time = EvenlySpaced(-1e3 * center / rec.rate, 1e3 / rec.rate, wave.size)
    curves = [Curve(control, time, wave, style=location_style(rec.channels[control].at))]
    elapsed = (np.arange(wave.size) - center) / rec.rate
    pulse, view = test.pulse(elapsed), None
    if pulse is not None:
        target, tolerance = pulse
        # The measured pulse is drawn over the prescribed pulse.
        band = target - tolerance, target + tolerance
        curves.insert(0, Curve("prescribed", time, target, *band, CurveStyle(BASELINE)))
        moving = 1e3 * elapsed[abs(target) > _VISIBLE_PART * abs(target).max()]
        view = _PULSE_VIEW * float(moving.min()), _PULSE_VIEW * float(moving.max())
    waveform = Chart(
        "First shock at the control channel; band: tolerance",
        f"Acceleration of {control} in the first shock.",
        [Panel("acceleration", "m/s²", curves, height=220)],
        x_name="time",
        x_unit="ms",
        x_view=view,
    )
    curves = []
    for first, *_ in measurement.spectra:
        style = location_style(rec.channels[first.channel].at)
        curves.append(Curve(first.channel, first.frequency, first.maximax, style=style))
    prescribed, of_pulse = test.shock_spectrum(), prescribed_spectrum(rec, first.q, first.frequency)
    if of_pulse is not None:
        curves.insert(0, Curve("prescribed pulse", *of_pulse, style=CurveStyle(BASELINE)))
    if prescribed is not None:
        frequency, values, tolerance = prescribed
        ratio = from_decibels(tolerance)
        curves.append(Curve("prescribed", frequency, values, values / ratio, values * ratio, CurveStyle(BASELINE)))
    response = Chart(
        f"Shock response spectra (maximax, {OCTAVE_STEPS} per octave) of the first shock, Q = {first.q:g}"
        + f"; {scatter_text(measurement.spectra)}",
        "Shock response spectra of the control channel and the bodies.",
        [Panel("shock response", "m/s²", curves, height=260, logarithmic=True)],
        x_name="natural frequency",
        logarithmic=True,
    )
    return [waveform, response]
