"""Tables of a report: resonances, changes of peaks, decays, the uncertainty budget, settings and channels."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from math import isfinite
from typing import TYPE_CHECKING

import numpy as np

from analysis.commands.figures.peak_marks import MODE_SHIFT
from analysis.commands.presentation.comparison import change_table
from analysis.commands.presentation.mode_findings import MIN_SAME_SHAPE_MAC
from analysis.commands.presentation.shock_findings import pulse_table
from analysis.commands.report_page.measurements import Measurement
from analysis.commands.report_page.sweep_changes import SweepChange, common_mac, same_mode
from analysis.core.damper_motion.comparison import Peak, PeakChange
from analysis.core.modal.modes import Modes
from analysis.core.responses.errors.systematic import tolerance_text
from rig.core.base.escaping import escape_html
from rig.core.results import format_number
from rig.core.results.response import Response
from rig.core.results.table import Table, join_tables, typeset

if TYPE_CHECKING:
    from daq.core.recording.recording import Recording
    from rig.core.scene.damper import Damper
    from rig.core.scene.scene import Scene

# Maximum number of overloads or gaps that are listed individually; a longer list would hide the other rows.
_MAX_LISTED = 5


def resonances(measurements: Sequence[Measurement], baseline: Measurement) -> str:
    """Return a table of natural frequencies and damping ratios, each with the highest peak near it, as HTML.

    Tests at several levels have a table of their own. `baseline`: its modes are listed for every
    recording, also where they were not identified.
    """
    rows: list[tuple[str, ...]] = []
    known = [each.modes for each in baseline.sweeps[:1] if each.modes is not None]
    single = (measurement.sweeps[0] for measurement in measurements if len(measurement.sweeps) == 1)
    inputs = {frf.input for measurement in measurements for sweep in measurement.sweeps for frf in sweep.frfs}
    for sweep in single:
        modes, peaks = sweep.modes, sweep.peaks
        if modes is None:
            continue
        rows.append((modes.label,))
        for k, highest in enumerate(peaks):
            location = height = ""
            if highest is not None:
                frf, peak = highest
                location = frf.ratio if len(inputs) > 1 else frf.response
                height = peak.height_text(frf.shown_in[1])
            frequency, damping = modes.cells(k)
            rows.append((location, frequency, damping + sweep.damping_note(k), height))
        rows += [(f"uncertain: {each.reason}", *each.cells(), "") for each in modes.uncertain]
        rows += [
            (f"mode of {before.frequency_label(k)}", "not determined", "", "")
            for before in known
            for k, frequency in enumerate(before.frequency)
            if not (abs(modes.frequency / frequency - 1.0) < MODE_SHIFT).any()
        ]
    found = (peak for measurement in measurements for sweep in measurement.sweeps for peak in sweep.peaks)
    units = " or ".join(dict.fromkeys(peak[0].shown_in[0] for peak in found if peak is not None)) or "µm/N"
    heading = ("response", "natural frequency / Hz", "damping ratio / %", f"peak / ({units})")
    relative = f"; responses to the {', '.join(inputs)}" * (len(inputs) == 1)
    # The top of the page states which errors the intervals do not include.
    return Table(heading, "<>>>", rows).html(
        f"Resonances, with 95 % intervals{relative}, of which the one with the highest peak is named"
    )


def changes_table(changes: Sequence[SweepChange]) -> str:
    """Return the table that `analysis compare` prints, with the changes of each pair of sweeps, as HTML."""
    joined = join_tables(
        (" → ".join(labels), change_table([each.change for each in group], changes[0].shown_in))
        for labels, group in groupby(changes, lambda change: (change.baseline, change.compared))
    )
    return joined.html(
        "Changes of the resonance peaks. Equivalent ζ: damping ratio of a linear mode with the changed peak, to within "
        "the interval of the change"
    )


def change_text(change: PeakChange) -> str:
    """Write the change of a peak as a reduction or an increase with its interval [dB]; a one-sided limit in words."""
    best, low, high = change.decibel
    decimals = change.decibel_decimals
    if not isfinite(low) and not isfinite(high):
        return "not determined"
    if isfinite(low) and isfinite(high):
        # A reduction is written as a positive number.
        sign, direction = (-1.0, "reduction") if best < 0.0 else (1.0, "increase")
        ends = " to ".join(f"{limit:.{decimals}f}" for limit in sorted((sign * low, sign * high)))
        is_determined = change.baseline.is_determined and change.damped.is_determined
        return f"{direction} {abs(best):.{decimals}f} dB ({ends})" if is_determined else f"{direction} of {ends} dB"
    # A lower limit of the change is an upper limit of a reduction.
    limit, is_lower = (low, True) if isfinite(low) else (high, False)
    direction = "reduction" if limit < 0.0 else "increase"
    at_most = is_lower == (limit < 0.0)
    unknown = "lower" if at_most else "upper"
    return f"{direction} at {'most' if at_most else 'least'} {abs(limit):.{decimals}f} dB; {unknown} limit unknown"


def mac_table(before: Modes, after: Modes) -> str:
    """Return the modal assurance criterion between the shapes of two sweeps, or within one sweep, as HTML."""
    mac_matrix = common_mac(before, after)
    if mac_matrix is None or (before is after and before.frequency.size < 2):
        return ""
    rows = [(before.frequency_label(k), *(f"{value:.3f}" for value in row)) for k, row in enumerate(mac_matrix)]
    if before is not after:
        # Shapes of one mode in two sweeps.
        for (name, *cells), frequency, k in zip(rows, before.frequency, range(len(rows)), strict=True):
            column = same_mode(after, frequency)
            if column is not None and mac_matrix[k, column] < MIN_SAME_SHAPE_MAC:
                cells[column] += ", differ"
                rows[k] = (name, *cells)
    heading = ["", *(after.frequency_label(k) for k in range(after.frequency.size))]
    pair = before.label if before is after else f"{before.label} (rows) and {after.label} (columns)"
    caption = f"Modal assurance criterion (MAC; equal shapes above about {MIN_SAME_SHAPE_MAC:g}): {pair}"
    return Table(heading, "<" + ">" * len(after.frequency), rows).html(caption)


def decays(measurements: Sequence[Measurement]) -> str:
    """Return the tables of free decays that `analysis decay` prints as one table, as HTML."""
    tables = [
        (f"{each.label}, {each.decay.channel}", each.decay.table()) for each in measurements if each.decay is not None
    ]
    caption = (
        "Free decay of each mode, with 95 % intervals. The frequency is that at the best determined amplitude. "
        "Resting dampers add mass and lower the frequency; dampers in flight do not. The frequency therefore depends "
        "on amplitude and differs from the resonance frequency of the response"
    )
    return join_tables(tables).html(caption)


def motions(measurement: Measurement) -> str:
    """Return the table of damper motion that `analysis dampers` prints, with all sweeps, as HTML."""
    return join_tables((each.label, each.table()) for each in measurement.dampers).html("Motion of the dampers")


def controlled(measurement: Measurement) -> str:
    """Return the channels of a profile, or the pulses of a shock test, as HTML."""
    if measurement.profile is not None:
        return measurement.profile.table().html("Channels at the full level")
    return pulse_table(measurement.rec).html("Pulses at the control channel")


def budget(curve: Response, highest: Peak) -> str:
    """Return the uncertainty budget of a response at its highest peak, as HTML."""
    point = int(np.argmin(abs(curve.frequency - highest.frequency)))
    if curve.expanded()[point] > abs(curve.value[point]):
        point = curve.peak_line()
    result = curve.budget(curve.response, float(curve.frequency[point]))
    unit, factor = curve.shown_in
    peak = highest.height_text(factor, unit)
    stated = f". The budget is that of a measured point; the stated peak is {peak}" * highest.is_extrapolated
    return result.table().html(f"Uncertainty budget of {curve.label}, {result.heading}{stated}")


def test_sentence(scene: Scene) -> str:
    """Describe the test of a scene in words.

    >>> import rig
    >>> test_sentence(rig.load("fig8-no-damper"))
    'stepped sine, 8 to 60 Hz, 2.6 N, 150 points upward'
    """
    return "none" if scene.test is None else scene.test.sentence(scene.driven_shaker)


def settings(measurement: Measurement) -> str:
    """Return the tables of the test settings and of the channels, and the scene file, as HTML."""
    rec, scene = measurement.rec, measurement.rec.scene
    dampers = "; ".join(_damper_text(damper, scene.structure.label(damper.body)) for damper in scene.dampers)
    facts = [
        ("recording", measurement.path.name),
        ("scene", scene.name),
        ("test", test_sentence(scene)),
        ("shaker", ", ".join(shaker.kind for shaker in scene.shakers) or "none"),
        ("dampers", dampers or "none"),
        *([("joints", "; ".join(joint.text(scene.structure.label) for joint in scene.joints))] if scene.joints else []),
        ("duration", f"{rec.duration:.2f} s, {rec.samples} samples at {rec.rate:g} Hz"),
        ("overloads", _times_text(rec, [(m.first_sample, m.fields.get("channel", "?")) for m in rec.overloads])),
        ("lost samples", _times_text(rec, [(gap.first_sample, ", ".join(gap.channels)) for gap in rec.gaps])),
        ("recorded by", f"shotrig {rec.metadata.get('run', {}).get('shotrig', '(unknown version)')}"),
        ("seed", str(scene.seed)),
    ]
    facts_html = "".join(f"<tr><th>{escape_html(key)}</th><td>{typeset(value)}</td></tr>" for key, value in facts)
    middle = _middle_frequency(measurement)
    channels = [
        (
            info.name,
            scene.structure.label(info.at),
            info.quantity,
            f"{info.sensitivity:.5g} V per {unit}",
            f"± {limit}" if (limit := tolerance_text(rec, info.name)) else "not stated",
            "unlimited" if info.range is None else f"± {info.range / info.sensitivity:.4g} {unit}",
            f"{abs(complex(info.response(middle))):.4f}",
        )
        for info in rec.channels.values()
        for unit in [info.unit.replace("^2", "²")]
    ]
    heading = ["channel", "at", "quantity", "sensitivity", "tolerance", "range", f"gain at {middle:.3g} Hz"]
    return (
        f'<details><summary>Settings and channels</summary><div class="settings"><table>{facts_html}</table>'
        f"{Table(heading, '<' * len(heading), channels).html('Channels')}</div></details>"
        f"<details><summary>Scene file</summary><pre>{escape_html(scene.to_yaml())}</pre></details>"
    )


def _middle_frequency(measurement: Measurement) -> float:
    """Return the frequency at which channel gains are listed [Hz]: geometric mean of the test band or of the modes."""
    if measurement.sweeps:
        band = measurement.sweeps[0].frfs[0].frequency
        return float(np.sqrt(band[band > 0].min() * band.max()))
    if measurement.decay is not None and measurement.decay.modes:
        return float(np.exp(np.mean([np.log(mode.center) for mode in measurement.decay.modes])))
    return measurement.rec.rate / 100.0


def _damper_text(damper: Damper, body: str) -> str:
    mass = f"{damper.mass:.4g} kg" if damper.mass is not None else f"mass ratio {damper.mass_ratio:.3g}"
    clearance = f"clearance {format_number(1e3 * damper.clearance)} mm" if isfinite(damper.clearance) else "no ceiling"
    if damper.spring is not None:
        clearance = f"spring {damper.spring:.4g} N/m, dashpot {damper.dashpot:.4g} N s/m, {damper.walls_text}"
    if damper.friction is not None:
        clearance += f", friction {damper.friction:.3g}"
    return f"{body}: {mass}, {clearance}{', locked' if damper.locked else ''}"


def _times_text(rec: Recording, places: Sequence[tuple[int, object]]) -> str:
    """List the times and channels of overloads or gaps; `places`: first sample, and channels."""
    if not places:
        return "none"
    first = "; ".join(f"{sample / rec.rate:.3f} s ({name})" for sample, name in places[:_MAX_LISTED])
    return f"{len(places)}: {first}{' ...' if len(places) > _MAX_LISTED else ''}"
