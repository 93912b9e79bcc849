"""Charts of tests that control the motion of channels: profiles, pulses and shock response spectra."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from analysis.commands.report_page.charts import Chart, Curve, EvenlySpaced, Panel
from analysis.commands.report_page.measurements import Measurement
from analysis.core.decays.sensor_correction import correct_motion
from analysis.core.responses.measurands import response_channels
from analysis.core.signals.profile_check import ProfileCheck
from analysis.core.signals.shock_spectrum import srs
from analysis.core.tracking.backbone import Backbone, backbone
from analysis.core.tracking.continuation import AmplitudeCurve, continuation
from daq.core.recording.recorded_test import FOLLOWED_CURVE, HELD_PHASE, shocks_of
from rig.core.base.palette import REFERENCE, CurveStyle, place_style, place_styles
from rig.core.scene.excitation.profile import from_decibels

if TYPE_CHECKING:
    from daq.core.recording.recording import Recording

# The duration of a pulse is the time above this fraction of its peak.
_VISIBLE_PART = 0.01
# The chart first shows this multiple of the duration of the pulse.
_PULSE_VIEW = 3.0


def _profile_chart(check: ProfileCheck) -> Chart:
    """Return a chart of control and limited channels with their bounds."""
    control, *limited = place_styles([level.place for level in (check.channels[0], *check.limited)])
    frequency = check.frequency
    curves = [
        Curve("profile", frequency, check.profile, *check.band, CurveStyle(REFERENCE)),
        Curve("control", frequency, check.control, style=control._replace(dashes=())),
    ]
    for level, style in zip(check.limited, limited, strict=True):
        curves.append(Curve(level.channel, frequency, level.values, level.low, level.high, style._replace(dashes=())))
        curves.append(Curve(f"limit of {level.channel}", frequency, level.bound, style=style._replace(dashes=(6, 3))))
    return Chart(
        f"{check.summary().removesuffix('.')}. Band of the profile: tolerance.",
        "Control and limited channels against the profile.",
        [
            Panel(
                "acceleration PSD" if check.is_density else "acceleration",
                check.unit,
                curves,
                height=280,
                logarithmic=True,
            )
        ],
        logarithmic=True,
    )


def _tracking_chart(rec: Recording) -> Chart:
    """Return a chart of the amplitude over the frequency of followed curves or resonances."""
    result: AmplitudeCurve | Backbone
    if FOLLOWED_CURVE.measured(rec.markers):
        result = continuation(rec)
        parts = {
            f"{level:g} {result.unit}{', unstable' if not stable else ''}": (result.level == level)
            & (result.stable == stable)
            & result.settled
            for level in dict.fromkeys(result.level.tolist())
            for stable in (True, False)
        }
    else:
        result = backbone(rec)
        parts = {"phase resonance": result.settled}
    curves = []
    for (label, part), style in zip(parts.items(), place_styles([""] * len(parts)), strict=True):
        order = np.flatnonzero(part)[np.argsort(result.frequency[part])]
        frequency, amplitude, bound = (
            values[order] for values in (result.frequency, result.amplitude, result.amplitude_bound)
        )
        if order.size:
            curves.append(Curve(label, frequency, amplitude, amplitude - bound, amplitude + bound, style, "points"))
    panel = Panel(f"amplitude of {result.body}", "m", curves, height=300)
    return Chart(f"{result.summary()}.", "Amplitude over the frequency of the controlled tone.", [panel])


def control_charts(measurement: Measurement) -> list[Chart]:
    """Return the charts of the controlled motion in a recording; empty for tests without controlled motion."""
    rec = measurement.rec
    if FOLLOWED_CURVE.measured(rec.markers) or HELD_PHASE.measured(rec.markers):
        return [_tracking_chart(rec)]
    if measurement.profile is not None:
        return [_profile_chart(measurement.profile)]
    shocks = shocks_of(rec.markers)
    if not shocks or rec.scene.test is None:
        return []
    test, mark = rec.scene.test, shocks[0]
    control = next(name for _, name in test.named_channels)
    samples = rec.read(control, mark.first_sample, mark.end + 1)
    wave = correct_motion(rec.channels[control], samples, "acceleration", 2.0 / test.shortest, 0.4 * rec.rate)
    center = int(mark.fields["center"]) - mark.first_sample
    time = EvenlySpaced(-center / rec.rate, 1.0 / rec.rate, wave.size)
    curves = [Curve(control, time, wave, style=place_style(rec.channels[control].at))]
    elapsed = (np.arange(wave.size) - center) / rec.rate
    pulse, view = test.pulse(elapsed), None
    if pulse is not None:
        target, tolerance = pulse
        # The measured pulse is drawn over the prescribed pulse.
        band = target - tolerance, target + tolerance
        curves.insert(0, Curve("prescribed", time, target, *band, CurveStyle(REFERENCE)))
        moving = elapsed[abs(target) > _VISIBLE_PART * abs(target).max()]
        view = _PULSE_VIEW * float(moving.min()), _PULSE_VIEW * float(moving.max())
    waveform = Chart(
        "First shock at the control channel; band: tolerance.",
        f"Acceleration of {control} in the first shock.",
        [Panel("acceleration", "m/s²", curves, height=220)],
        x_name="time",
        x_unit="s",
        x_view=view,
    )
    spectra = [srs(rec, name) for name in dict.fromkeys((control, *response_channels(rec)))]
    curves = [
        Curve(each.channel, each.frequency, each.maximax, style=place_style(rec.channels[each.channel].at))
        for each in spectra
    ]
    prescribed = test.shock_spectrum()
    if prescribed is not None:
        frequency, values, tolerance = prescribed
        ratio = from_decibels(tolerance)
        curves.append(Curve("prescribed", frequency, values, values / ratio, values * ratio, CurveStyle(REFERENCE)))
    response = Chart(
        "Shock response spectra (maximax) of the first shock, Q = 10.",
        "Shock response spectra of the control channel and the bodies.",
        [Panel("shock response", "m/s²", curves, height=260, logarithmic=True)],
        x_name="natural frequency",
        logarithmic=True,
    )
    return [waveform, response]
