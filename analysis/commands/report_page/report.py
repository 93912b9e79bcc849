"""The report page: summary, results, settings, warnings and the commands that reproduce it."""

import re
import shlex
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from string import Template

from analysis.commands.presentation.outputs import CommandOutput, check_outputs, output_stem, with_ending
from analysis.commands.report_page.charts import ChartWriter
from analysis.commands.report_page.control import control_charts
from analysis.commands.report_page.dampers import damper_charts
from analysis.commands.report_page.decays import decay_charts
from analysis.commands.report_page.drawing import rig_drawing
from analysis.commands.report_page.histories import spectrograms, time_histories
from analysis.commands.report_page.levels import level_table
from analysis.commands.report_page.measurements import Measurement, Measurements
from analysis.commands.report_page.mode_drawing import mode_drawing
from analysis.commands.report_page.responses import force_charts, response_charts
from analysis.commands.report_page.stabilization import stabilization_charts
from analysis.commands.report_page.summary import limitations, summarize
from analysis.commands.report_page.sweep_changes import same_mode, sweep_changes
from analysis.commands.report_page.tables import (
    budget,
    changes_table,
    controlled,
    decays,
    mac_table,
    motions,
    resonances,
    settings,
    test_sentence,
)
from analysis.core.modal.modes import Modes
from analysis.core.recordings.descriptions import line_spacing
from daq.core.recording.recorded_test import own_analyses
from rig.core.base.errors import SceneError
from rig.core.base.escaping import escape_html
from rig.core.base.output_files import atomic_write
from rig.core.base.progress import CountProgress
from rig.core.results.table import typeset

# The change of a peak is emphasized in a result.
_CHANGE = re.compile(r"(?:reduction|increase)[^(;,]* dB")


def write_report(
    paths: Sequence[Path], output: Path | None = None, progress: CountProgress | None = None, note: str = ""
) -> CommandOutput:
    """Write one self-contained HTML report about recordings.

    `paths`: recordings; the first without moving dampers, otherwise the first, is the baseline of the comparisons.
    `output`: folder for the page, or its file name if it ends in .html; default: the folder of the first recording.
    `note`: text below the summary. Returns the page, its summary, and the warnings. Raises
    `RecordingError` if a file is not a recording. Raises `SceneError` if the page exists and may not be replaced.
    """
    if not paths:
        raise SceneError("report: no recordings. Give at least one.")
    target = _page(paths, output)
    check_outputs(paths, target)
    with Measurements(paths, progress) as measurements:
        summary, body = _body(measurements, paths, note)
    title = page_title(measurements)
    templates = files("analysis.commands.report_page") / "browser"

    def template(name: str) -> str:
        return (templates / name).read_text(encoding="utf-8")

    texts = {
        "title": typeset(title),
        "uplot_css": template("uPlot.min.css"),
        "page_css": template("page.css").replace("$footer", _footer(paths)),
        "uplot": template("uPlot.iife.min.js"),
        "charts": template("charts.js"),
    }
    before, after = (Template(part).substitute(texts) for part in template("page.html").split("$body"))
    # The charts of many recordings take tens of megabytes: joining them would take several times as much.
    with atomic_write(target) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write(before)
        for part in body:
            file.write(part)
            file.write("\n")
        file.write(after)
    return CommandOutput((target,), tuple(summary), tuple(measurements.warnings))


def page_title(measurements: Measurements) -> str:
    """Return the title, which states whether the recordings are those of the virtual rig."""
    simulated = [not each.rec.source for each in measurements.results]
    test = "Vibration test" if not any(simulated) else "Simulated vibration test"
    partly = " (partly measured)" * (any(simulated) and not all(simulated))
    labels = " · ".join(dict.fromkeys(each.label for each in measurements.results))
    return f"{test}{partly}: {', '.join(filter(None, [measurements.subject, labels]))}"


def _footer(paths: Sequence[Path]) -> str:
    """Return the files and the date of the report as a string of CSS for the foot of a printed page."""
    first, *others = (path.name for path in paths)
    files_text = f"{first} and {len(others)} more" if len(others) > 1 else ", ".join([first, *others])
    text = f"{files_text} · report of {datetime.now(UTC):%Y-%m-%d} · shotrig {version('shotrig')}"
    # CSS names any character by its code.
    return "".join(letter if letter.isalnum() else f"\\{ord(letter):x} " for letter in text)


def _page(paths: Sequence[Path], output: Path | None) -> Path:
    if output is not None and output.suffix.lower() in {".html", ".htm"} and not output.is_dir():
        return output
    return with_ending(output_stem(paths, output, "report"), "html")


def _body(measurements: Measurements, paths: Sequence[Path], note: str) -> tuple[list[str], list[str]]:
    """Return the summary, and the parts of all sections of the page as HTML."""
    results, charts = measurements.results, ChartWriter()
    changes, baseline = sweep_changes(measurements), measurements.baseline
    summary = summarize(results, changes)
    warnings = [f"<li>{typeset(warning)}</li>" for warning in measurements.warnings]
    counts = {"Warnings": f" ({len(warnings)})"}
    # The drawing shows the dampers whose effect is compared; a recording has its own only with another structure.
    drawn = next((each for each in results if each is not baseline), baseline)
    rig = drawn.rec.scene.structure, drawn.rec.scene.shakers
    # Title and content of each section; a section without content is omitted. The warnings stand between the curves and
    # the results computed from them, because they limit both.
    sections = {
        "Levels": [level_table(results)],
        "Controlled motion": [
            part for each in results for part in (*map(charts.write, control_charts(each)), controlled(each))
        ],
        "Frequency responses": [
            charts.write(chart)
            for chart in (*response_charts(results, baseline.label), *force_charts(results, baseline.label))
        ],
        "Warnings": [f'<ul class="warnings">{"".join(warnings)}</ul>'] if warnings else [],
        "Results": [changes_table(changes), resonances(results, baseline), decays(results)],
        "Mode shapes": [*_modes(results, baseline), *_macs(results, baseline)],
        "Stabilization diagrams": [charts.write(chart) for chart in stabilization_charts(results)],
        "Dampers": [part for each in results for part in (*map(charts.write, damper_charts(each)), motions(each))],
        "Free decays": [charts.write(chart) for chart in decay_charts(results, baseline.label)],
        "Uncertainty": _budgets(results),
        **{
            f"Recording {each.path.name}": _recording(
                each, charts, (each.rec.scene.structure, each.rec.scene.shakers) != rig
            )
            for each in results
        },
        "How to reproduce this report": _commands(paths, results),
    }
    filled = {title: list(filter(None, parts)) for title, parts in sections.items() if any(parts)}
    anchors = {title: f"section-{number}" for number, title in enumerate(filled, 1)}
    links = "".join(
        f'<li><a href="#{anchors[title]}">{escape_html(title)}{counts.get(title, "")}</a></li>' for title in filled
    )
    descriptions: dict[str, list[str]] = {}
    for each in results:
        descriptions.setdefault(_test_description(each), []).append(f"“{each.label}”")
    # The title names a single recording.
    name = f"“{baseline.label}”: " if len(results) == 1 else "\n"
    named = [f"{', '.join(labels)}: {text}" for text, labels in descriptions.items()]
    tests = "".join(f'<p class="test">{typeset(_without_name(text, name))}</p>' for text in named)
    caption = f"<figcaption>Rig of “{escape_html(drawn.label)}”</figcaption>" if len(results) > 1 else ""
    body = [
        tests,
        '<div class="first"><div>',
        '<section class="answer">',
        *(_summary_html(_without_name(text, name)) for text in summary),
        "</section>",
        f'<p class="test">{escape_html(note)}</p>' if note else "",
        f'</div><figure class="rig">{rig_drawing(drawn.rec.scene)}{caption}</figure></div>',
        # In the full width they have few lines, so that the first chart is on the first screen.
        *(f'<p class="limitation">{typeset(_without_name(text, name))}</p>' for text in limitations(results)),
        f"<nav><ul>{links}</ul></nav>",
    ]
    for title, parts in filled.items():
        body += [f'<h2 id="{anchors[title]}">{escape_html(title)}</h2>', *parts]
    return summary, body


def _without_name(text: str, name: str) -> str:
    """Remove the name of a recording at the start of a sentence."""
    rest = text.removeprefix(name)
    return rest[:1].upper() + rest[1:]


def _summary_html(text: str) -> str:
    """Write a text of the summary as HTML: later lines, `name: result`, become rows."""
    first, *lines = text.split("\n")
    rows = ""
    for name, separator, result in (line.partition(": ") for line in lines):
        change = _CHANGE.match(result)
        result_html = typeset(result)
        if change is not None:
            result_html = f"<strong>{typeset(change[0])}</strong>{typeset(result[change.end() :])}"
        rows += f"<dt>{typeset(name)}</dt><dd>{result_html}</dd>" if separator else f"<dd>{typeset(name)}</dd>"
    return f"<p>{typeset(first)}</p>" + (f"<dl>{rows}</dl>" if rows else "")


def _recording(measurement: Measurement, charts: ChartWriter, is_drawn: bool) -> list[str]:
    """Write the settings, time histories and spectrograms of a recording; `is_drawn`: also its rig."""
    pictures = "".join(charts.write(chart) for chart in spectrograms(measurement.rec, measurement.drawn))
    return [
        f"<figure>{rig_drawing(measurement.rec.scene)}</figure>" if is_drawn else "",
        charts.write(time_histories(measurement.rec, measurement.drawn)),
        settings(measurement),
        f'<details class="spectrograms"><summary>Spectrograms</summary>{pictures}</details>' if pictures else "",
    ]


def _test_description(measurement: Measurement) -> str:
    """Describe the test of a recording: excitation, lines, channels, duration and date."""
    rec, count = measurement.rec, len(measurement.rec.channels)
    spacing = line_spacing(measurement.sweeps[0].frfs[0]) if measurement.sweeps else ""
    started = int(rec.metadata.get("daq", {}).get("start_ns", 0))
    # The clock of a simulated test begins at zero.
    date = f"; {datetime.fromtimestamp(1e-9 * started, UTC):%Y-%m-%d %H:%M} UTC" if started else ""
    return (
        f"{test_sentence(rec.scene)}; {spacing and f'{spacing}; '}{count} channel{'s' * (count != 1)} at "
        f"{rec.rate:g} Hz, recorded for {rec.duration:.4g} s{date}."
    )


def _modes(results: Sequence[Measurement], baseline: Measurement) -> list[str]:
    """Draw, as HTML, the modes of each recording's first sweep, with the signs of the baseline; for several bodies."""
    sections = []
    reference = next((sweep.modes for sweep in baseline.sweeps[:1] if sweep.modes is not None), None)
    for measurement in results:
        for sweep in measurement.sweeps[:1]:
            modes = sweep.modes
            if modes is None:
                continue
            bodies = modes.of_bodies()
            if len(bodies.names) < 2 or not modes.frequency.size:
                continue
            if reference is not None:
                bodies = bodies.with_signs_of(reference.of_bodies())
            drawings = [
                mode_drawing(bodies, bodies.places, k, f"{modes.frequency_text(k)},\nζ = {sweep.damping_text(k)}")
                for k in range(modes.frequency.size)
            ]
            if reference is not None:
                drawings = _in_columns_of(reference, modes, drawings)
            sections += [f"<h3>{escape_html(modes.label)}</h3>", f'<div class="shapes">{"".join(drawings)}</div>']
    scale = '<p class="test">The largest component of each shape is ±1, with the signs of the baseline.</p>'
    return [scale, *sections] if sections else []


def _in_columns_of(reference: Modes, modes: Modes, drawings: Sequence[str]) -> list[str]:
    """Order drawings of modes as the modes of the reference, with a note for each that is not determined."""
    counterparts = {
        same_mode(reference, float(frequency)): k for k, frequency in reversed([*enumerate(modes.frequency)])
    }
    columns = [
        drawings[counterparts[k]]
        if k in counterparts
        else f'<p class="absent">{reference.frequency_label(k)}: not determined</p>'
        for k in sorted(range(len(reference.frequency)), key=reference.frequency.__getitem__)
    ]
    placed = [k for column, k in counterparts.items() if column is not None]
    return columns + [drawing for k, drawing in enumerate(drawings) if k not in placed]


def _macs(results: Sequence[Measurement], first: Measurement) -> list[str]:
    """Compare the mode shapes of the first sweep of each recording with those of the baseline, as HTML."""
    modes = {each.label: each.sweeps[0].modes for each in (first, *results) if each.sweeps}
    known = [each for each in modes.values() if each is not None and each.frequency.size]
    return ['<div class="pairs">', *(mac_table(known[0], each) for each in known), "</div>"] if known else []


def _budgets(results: Sequence[Measurement]) -> list[str]:
    """Write the uncertainty budget at the highest peak in the first sweep of each recording, as HTML."""
    peaks = [measurement.sweeps[0].highest for measurement in results if measurement.sweeps]
    budgets = [budget(*highest) for highest in peaks if highest is not None]
    return ['<div class="pairs">', *budgets, "</div>"] if budgets else []


def _commands(paths: Sequence[Path], results: Sequence[Measurement]) -> list[str]:
    """List the commands that reproduce the recordings and the results, and the version of shotrig, as HTML."""
    all_paths = " ".join(shlex.quote(path.name) for path in paths)
    analyzed_by = [
        ("frf", [measurement for measurement in results if measurement.sweeps]),
        (
            "modes",
            [measurement for measurement in results if any(sweep.modes is not None for sweep in measurement.sweeps)],
        ),
        ("dampers", [measurement for measurement in results if measurement.dampers]),
        ("decay", [measurement for measurement in results if measurement.decay is not None]),
    ]
    analyzed_by += [(each, [result]) for result in results for each in own_analyses(result.rec.markers)]
    recorded = [
        measurement for measurement in results if not measurement.rec.source and measurement.rec.scene.test is not None
    ]
    lines = [
        f"daq record {shlex.quote(measurement.path.stem + '.yaml')} -o {shlex.quote(measurement.path.name)}"
        for measurement in recorded
    ]
    lines += [
        f"analysis {command} {' '.join(shlex.quote(measurement.path.name) for measurement in recordings)}"
        for command, recordings in analyzed_by
        if recordings
    ]
    lines.append(f"analysis report {all_paths}")
    origin = f"Made with shotrig {version('shotrig')}."
    if recorded:
        names = ", ".join(f"{measurement.path.stem}.yaml" for measurement in recorded)
        origin += f" Save the scene file of each recording (above) as {names}. The same seed gives the same samples."
    return [
        f'<p class="origin">{escape_html(origin)}</p>',
        f'<pre class="commands">{escape_html(chr(10).join(lines))}</pre>',
    ]
