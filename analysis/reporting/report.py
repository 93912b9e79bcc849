"""Write the report page: summary, results, settings, warnings and the commands that reproduce it."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from string import Template

from analysis.presentation.outputs import CommandOutput, output_stem, with_ending
from analysis.reporting.answer import answer
from analysis.reporting.charts import ChartWriter
from analysis.reporting.drawing import mode_drawing, rig_drawing
from analysis.reporting.histories import spectrograms, time_histories
from analysis.reporting.measured import Measured, Measurements
from analysis.reporting.responses import damper_chart, decay_charts, response_charts
from analysis.reporting.tables import budget, changes_table, decays, resonances, settings, test_text
from rig.escaping import escape_html
from rig.output_files import atomic_write, create_folder
from rig.progress import CountProgress
from rig.provenance import output_source, reject_foreign_files, relative_paths


def write_report(
    paths: Sequence[Path], output: Path | None = None, progress: CountProgress | None = None
) -> CommandOutput:
    """Write one self-contained HTML report about recordings.

    `paths`: recordings; the first is the reference of the comparisons; `output`: folder for the page, or its file
    name if it ends in .html; default: the folder of the first recording. Returns the page, the sentences of its
    summary, and the warnings. Raises `RecordingError` if a file is not a recording. Raises `SceneError` if the page
    exists and was not made from these recordings.
    """
    with _page(paths, output):
        pass  # Raise the error of an existing page before the long analysis.
    with Measurements(paths, progress) as measurements:
        sentences, body = _body(measurements, paths)
    title = f"Vibration test: {', '.join(path.stem for path in paths)}"
    browser = files("analysis.reporting") / "browser"

    def text(name: str) -> str:
        return (browser / name).read_text(encoding="utf-8")

    page = Template(text("page.html")).substitute(
        title=escape_html(title),
        body=body,
        uplot_css=text("uPlot.min.css"),
        page_css=text("page.css"),
        uplot=text("uPlot.iife.min.js"),
        charts=text("charts.js"),
    )
    with _page(paths, output) as target:
        create_folder(target.parent)
        with atomic_write(target) as part:
            part.write_text(page, encoding="utf-8")
    return CommandOutput((target,), tuple(sentences), tuple(measurements.warnings))


@contextmanager
def _page(paths: Sequence[Path], output: Path | None) -> Iterator[Path]:
    """Yield the path of the page; writing inside the `with` block follows the overwriting rule of `rig.provenance`."""
    if output is not None and output.suffix.lower() in {".html", ".htm"} and not output.is_dir():
        with output_source("report", *relative_paths(paths, output.parent)):
            reject_foreign_files(output)
            yield output
        return
    with output_stem(paths, output, "report", "html") as stem:
        yield with_ending(stem, "html")


def _body(measurements: Measurements, paths: Sequence[Path]) -> tuple[list[str], str]:
    """Return the summary, and the sections of the page as HTML."""
    results, charts = measurements.results, ChartWriter()
    compared = measurements.changes()
    sentences = answer(results, compared)
    parts = ['<section class="answer">', *(f"<p>{escape_html(text)}</p>" for text in sentences)]
    parts += [f'<p class="test">{escape_html(text)}</p>' for text in dict.fromkeys(map(_test_description, results))]
    parts.append("</section>")
    parts += [changes_table(compared), resonances(results), decays(results)]
    if measurements.warnings:
        items = "".join(f"<li>{escape_html(note)}</li>" for note in measurements.warnings)
        parts.append(f'<h2>Warnings</h2><ul class="warnings">{items}</ul>')
    responses = [charts.write(chart) for chart in response_charts(results)]
    if responses:
        parts += ["<h2>Frequency responses</h2>", *responses]
    parts += _modes(results)
    dampers = [charts.write(damper_chart(measured, result)) for measured in results for result in measured.dampers]
    if dampers:
        parts += ["<h2>Dampers</h2>", *dampers]
    free = [charts.write(chart) for chart in decay_charts(results)]
    if free:
        parts += ["<h2>Free decays</h2>", *free]
    parts += _budgets(results)
    for measured in results:
        parts += [
            f"<h2>Recording {escape_html(measured.path.name)}</h2>",
            f"<figure>{rig_drawing(measured.rec.scene)}</figure>",
        ]
        parts += [settings(measured), charts.write(time_histories(measured.rec))]
        parts += [charts.write(chart) for chart in spectrograms(measured.rec)]
    parts += _commands(paths, results)
    return sentences, "\n".join(parts)


def _test_description(measured: Measured) -> str:
    """Describe the test of a recording: excitation, channels, duration."""
    rec = measured.rec
    return (
        f"Test “{measured.label}”: {test_text(rec.scene)}; {len(rec.channels)} channels at {rec.rate:g} Hz, "
        f"{rec.duration:.4g} s."
    )


def _modes(results: Sequence[Measured]) -> list[str]:
    """Draw the mode shapes of the first sweep of each recording."""
    parts = []
    for measured in results:
        for modes in [sweep.modes for sweep in measured.passes[:1] if sweep.modes is not None]:
            bodies = modes.of_bodies()
            if len(bodies.names) < 2 or not modes.frequency.size:
                continue
            drawings = [
                mode_drawing(bodies, k, f"{frequency:.4g} Hz, damping ratio {modes.damping_text(k)}")
                for k, frequency in enumerate(modes.frequency)
            ]
            parts += [f"<h3>{escape_html(measured.label)}</h3>", f'<div class="shapes">{"".join(drawings)}</div>']
    return ["<h2>Mode shapes</h2>", *parts] if parts else []


def _budgets(results: Sequence[Measured]) -> list[str]:
    """Write the uncertainty budget at the highest peak of each recording."""
    first = [(measured, measured.passes[0].highest) for measured in results if measured.passes]
    tables = [budget(measured, *highest) for measured, highest in first if highest is not None]
    return ["<h2>Uncertainty</h2>", *tables] if tables else []


def _commands(paths: Sequence[Path], results: Sequence[Measured]) -> list[str]:
    """List the commands that reproduce the recordings and the results, and the version of shotrig."""
    all_paths = " ".join(shlex.quote(str(path)) for path in paths)
    named = [
        ("frf", [measured for measured in results if measured.passes]),
        ("modes", [measured for measured in results if any(sweep.modes is not None for sweep in measured.passes)]),
        ("dampers", [measured for measured in results if measured.dampers]),
        ("decay", [measured for measured in results if measured.decay is not None]),
    ]
    recorded = [measured for measured in results if not measured.rec.source and measured.rec.scene.test is not None]
    lines = [
        f"daq record {shlex.quote(measured.path.stem + '.yaml')} -o {shlex.quote(str(measured.path))}"
        for measured in recorded
    ]
    lines += [
        f"analysis {command} {' '.join(shlex.quote(str(measured.path)) for measured in which)}"
        for command, which in named
        if which
    ]
    lines.append(f"analysis report {all_paths}")
    origin = f"Made with shotrig {version('shotrig')}."
    if recorded:
        names = ", ".join(f"{measured.path.stem}.yaml" for measured in recorded)
        origin += f" Save the scene file of each recording (above) as {names}. The same seed gives the same samples."
    return [
        "<h2>How to repeat this</h2>",
        f"<pre>{escape_html(chr(10).join(lines))}</pre>",
        f"<p>{escape_html(origin)}</p>",
    ]
