"""The `rig` command line."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated

import typer

from rig.commands.arguments import (
    MAX_COUNT,
    Changes,
    Cluster,
    First,
    Last,
    Overwrite,
    Points,
    SceneName,
    completions,
    load_scene,
)
from rig.commands.command_line import create_application, run_command
from rig.core.base.console import count_progress, progress, report_written, resumable, show_activity
from rig.core.base.errors import SceneError

if TYPE_CHECKING:
    from rig.core.settings.quantities import Kind

app = create_application("Compute the motion of the virtual vibration rig, without sensors and recordings.")


@app.command(example="rig scenes --copy fig9 mine.yaml")
def scenes(
    show: Annotated[
        str | None, typer.Option(metavar="NAME", help="Print the file of the scene NAME.", autocompletion=completions)
    ] = None,
    copy: Annotated[
        tuple[str, Path] | None,
        typer.Option(metavar="NAME FILE", help="Copy the file of the scene NAME to FILE, to change it there."),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """List the bundled scenes; print or copy a scene file."""
    from rig.core.base.output_files import atomic_write
    from rig.core.scene.scene_files import bundled_scenes, scene_text, summary

    if show is not None:
        print(scene_text(show), end="")
    if copy is not None:
        text = scene_text(copy[0])
        with atomic_write(copy[1], overwrite=overwrite) as temporary:
            temporary.write_text(text, encoding="utf-8")
        print(f"wrote {copy[1]}. Change it, then run: daq record {quote(str(copy[1]))}")
    if show is None and copy is None:
        _print_descriptions([(name, summary(name)) for name in bundled_scenes()])


@app.command(example="rig presets")
def presets(
    name: Annotated[
        str | None,
        typer.Argument(metavar="[NAME]", help="Preset whose values to print, in quotes, such as 'NI 9234'."),
    ] = None,
) -> None:
    """List the presets from data sheets, or print one of them."""
    from rig.core.data_sheets.data_sheets import data_sheets, describe_preset

    if name is not None:
        print("\n".join(describe_preset(name)))
    else:
        _print_descriptions(
            [(sheet.name, f"{sheet.summary} {sheet.unsourced_note}".strip()) for sheet in data_sheets().values()]
        )


def _print_descriptions(rows: Sequence[tuple[str, str]]) -> None:
    """Print names with descriptions, separated by a tab if the output is a pipe."""
    width = max(len(name) for name, _ in rows) if sys.stdout.isatty() else 0
    for name, description in rows:
        print(f"{name:{width}}  {description}" if width else f"{name}\t{description}")


@app.command(example="rig schema --explain")
def schema(
    explain: Annotated[
        bool, typer.Option("--explain", help="Print the reference of all keys, in Markdown, instead of the schema.")
    ] = False,
) -> None:
    """Print the JSON Schema of scene files, or a list of all keys."""
    from rig.core.scene.json_schema import schema_text
    from rig.core.scene.reference import reference_page

    print(reference_page() if explain else schema_text(), end="")


@app.command("help", example="rig help test.stepped_sine")
def help_(
    key: Annotated[
        str | None,
        typer.Argument(
            metavar="[KEY]",
            help="Key to explain, such as test.force, force or test.stepped_sine. Default: list all top-level keys.",
        ),
    ] = None,
) -> None:
    """Explain a key of scene files: meaning, values and default."""
    from rig.core.scene.reference import help_on

    print(help_on(key))


@app.command(example="rig explain fig9")
def explain(
    scene: SceneName,
    changes: Changes = None,
    no_prediction: Annotated[
        bool, typer.Option("--no-prediction", help="List the effects without a prediction of the test.")
    ] = False,
) -> None:
    """List the modeled effects, and predict the signals of the test.

    Each effect is listed with the number of state variables that it adds to the model.
    """
    import rig
    from rig.core.base.extensions import test_predictions

    loaded_scene = load_scene(scene, changes)
    print(rig.explain(loaded_scene), flush=True)
    for prediction in [] if no_prediction else test_predictions(loaded_scene):
        print(f"\n{prediction}")


@app.command(example="rig simulate fig9 --duration 2s -o run.npz")
def simulate(
    scene: SceneName,
    changes: Changes = None,
    duration: Annotated[
        str | None,
        typer.Option(metavar="TIME", help="Duration of the motion, such as '2 s'. Default: as in the scene's test."),
    ] = None,
    rate: Annotated[
        str, typer.Option(metavar="RATE", help="Sample rate of the motion, such as '5120 Hz'.")
    ] = "5120 Hz",
    frequency: Annotated[
        str | None,
        typer.Option(
            metavar="F",
            help="Drive with a sine of this frequency, such as '49 Hz', instead of the test's signal. Its amplitude is "
            "the test's force or drive.",
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            metavar="FILE",
            help="File for the motion, .npz or .csv. With it, the same command continues an interrupted run with "
            "grains.",
        ),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Simulate the motion of a scene; print peaks, events and energy.

    The drive acts in open loop: sensors and controller are not simulated.
    """
    from rig.core.base.output_files import allow_overwriting
    from rig.core.settings.quantities import FREQUENCY, SAMPLE_RATE, TIME
    from rig.core.simulation.run_output import simulate_to_file, summary

    loaded_scene = load_scene(scene, changes)
    duration_s, tone_hz = (_quantity(duration, TIME, "--duration"), _quantity(frequency, FREQUENCY, "--frequency"))
    sample_rate = _quantity(rate, SAMPLE_RATE, "--rate") or 0.0
    with (
        allow_overwriting(overwrite),
        count_progress("computing the motion") as progress,
    ):
        run = simulate_to_file(output, loaded_scene, duration_s, sample_rate, tone_hz, progress)
    print(loaded_scene.structure.relabel(summary(run)))
    if output is not None:
        report_written(output)


@app.command(example="rig response fig9 --from 30Hz --to 40Hz --points 21 -o response.csv")
def response(
    scene: SceneName,
    changes: Changes = None,
    first: First = None,
    last: Last = None,
    points: Points = None,
    direction: Annotated[
        str | None,
        typer.Option(
            metavar="up|down|both",
            help="Order of the frequencies; both: first up, then down. Default: as in the scene's test.",
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", metavar="FILE.csv", help="CSV file for the response at all frequencies, with all digits."
        ),
    ] = None,
    overwrite: Overwrite = False,
    verbose: Annotated[bool, typer.Option("--verbose", help="Also print the response at every frequency.")] = False,
) -> None:
    """Compute the steady-state response to a sine at each frequency.

    The amplitude of the sine is the force or drive of the scene's test.
    """
    import rig
    from rig.core.base.output_files import allow_overwriting, prepare_outputs
    from rig.core.settings.quantities import FREQUENCY
    from rig.core.steady_response.response_output import format_response, write_csv

    loaded_scene = load_scene(scene, changes)
    band = (_quantity(first, FREQUENCY, "--from"), _quantity(last, FREQUENCY, "--to"))
    with allow_overwriting(overwrite):
        if output is not None:
            prepare_outputs(output)
        with count_progress("computing the motion") as progress:
            result = rig.response(loaded_scene, *band, points, direction, progress)
        print(format_response(result, verbose))
        if output is not None:
            write_csv(result, output)
            report_written(output)


@app.command(example="rig grains fig9 --set 'dampers[1].grains={diameter: 2 mm}' --points 5 -o grains.csv")
def grains(
    scene: SceneName,
    changes: Changes = None,
    first: First = None,
    last: Last = None,
    points: Points = None,
    periods: Annotated[
        int,
        typer.Option(
            min=1,
            max=MAX_COUNT,
            metavar="N",
            help="Number of drive periods in an average. The motion is steady when two successive averages agree "
            "within 1 %.",
        ),
    ] = 20,
    cluster: Cluster = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            metavar="FILE.csv",
            help="CSV file for the results. Frequencies that are already in this file are not computed again.",
        ),
    ] = None,
) -> None:
    """Compare responses with beds as grains and as one mass each.

    At each frequency, both models of the beds are simulated until the motion is steady.
    """
    import rig
    from rig.core.settings.quantities import FREQUENCY
    from rig.extras.bed_response.bed_response import format_table

    loaded_scene = load_scene(scene, changes)
    band = (_quantity(first, FREQUENCY, "--from"), _quantity(last, FREQUENCY, "--to"))
    with resumable(output is not None), count_progress("simulating the grains") as progress:
        result = rig.grains(loaded_scene, *band, points, periods, output, cluster, progress)
    print(format_table(result))
    if output is not None:
        report_written(output)


@app.command(example="rig cost fig9")
def cost(
    scene: SceneName,
    changes: Changes = None,
    frequency: Annotated[
        str | None,
        typer.Option(
            metavar="F",
            help="Excitation frequency, such as '49 Hz'. Default: in the range of the test, the frequency of the "
            "largest acceleration with the dampers at rest on their floors.",
        ),
    ] = None,
    periods: Annotated[
        int, typer.Option(min=2, max=MAX_COUNT, metavar="N", help="Number of drive periods to simulate.")
    ] = 20,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for the figure and the table.")
    ] = Path(),
    overwrite: Overwrite = False,
) -> None:
    """Compare errors and computing times of simulation methods.

    For a scene with a bed of grains, simpler models of the bed are compared instead: one mass, one mass with
    finite-duration contact, and softer grains.
    """
    import rig
    from rig.core.base.output_files import allow_overwriting, file_stem, prepare_outputs
    from rig.core.settings.quantities import FREQUENCY

    loaded_scene = load_scene(scene, changes)
    with allow_overwriting(overwrite), show_activity() as report:
        prepare_outputs(*_figure_and_table(output / file_stem("cost", loaded_scene.name)))
        tone_hz = _quantity(frequency, FREQUENCY, "--frequency")
        result = rig.cost(loaded_scene, tone_hz, periods, report)
        files = result.write(output)
    print(result)
    report_written(*files)


@app.command("map", example="rig map fig9 --rows 12 --points 24")
def map_(
    scene: SceneName,
    changes: Changes = None,
    over: Annotated[
        str | None,
        typer.Option(
            metavar="force|drive|clearance",
            help="Quantity that is varied in addition to the frequency. Default: the force or drive of the test.",
        ),
    ] = None,
    lowest: Annotated[
        str | None,
        typer.Option(
            "--least",
            metavar="VALUE",
            help="Lowest value of the quantity that --over varies, such as '0.5 N'. Default: below that of the scene, "
            "and below the lowest at which a damper lifts off.",
        ),
    ] = None,
    highest: Annotated[
        str | None,
        typer.Option(
            "--most",
            metavar="VALUE",
            help="Highest value of the quantity that --over varies, such as '20 N'. Default: above that of the scene.",
        ),
    ] = None,
    rows: Annotated[
        int, typer.Option(min=2, max=1000, metavar="N", help="Number of values of the quantity --over.")
    ] = 36,
    first: First = None,
    last: Last = None,
    points: Annotated[int, typer.Option(min=2, max=1000, metavar="N", help="Number of frequencies.")] = 48,
    cluster: Cluster = None,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for the figure and the table.")
    ] = Path(),
    overwrite: Overwrite = False,
) -> None:
    """Map motion types and settling time over level and frequency.

    To continue an interrupted run, give the same command again.
    """
    import rig
    from rig.core.base.output_files import allow_overwriting, prepare_outputs
    from rig.core.base.study import unfinished_file
    from rig.core.settings.quantities import FREQUENCY
    from rig.studies.motion_map.grid import vertical_axis
    from rig.studies.motion_map.motion_map import STUDY, output_stem, summarize_map, write_map

    loaded_scene = load_scene(scene, changes)
    over, kind = vertical_axis(loaded_scene, over)
    band = _quantity(first, FREQUENCY, "--from"), _quantity(last, FREQUENCY, "--to")
    limits = _quantity(lowest, kind, "--least"), _quantity(highest, kind, "--most")
    stem = output_stem(loaded_scene, over, output)
    table = stem.with_suffix(".csv")
    with resumable(), allow_overwriting(overwrite), STUDY.reserve(table):
        prepare_outputs(*_figure_and_table(stem))
        with count_progress("computing the motion") as progress:
            result = rig.map(
                loaded_scene, over, *limits, rows, *band, points, cluster, unfinished_file(table), progress
            )
        files = write_map(result, output)
    print(summarize_map(result))
    report_written(*files)


@app.command(example="rig design fig9 --budget '50 g' --bodies 3 --levels 3N -o design")
def design(
    scene: SceneName,
    changes: Changes = None,
    budget: Annotated[
        str | None,
        typer.Option(
            metavar="MASS|SHARE",
            help="Largest total mass of the dampers, such as '50 g', or '5 %' of the structure's mass. Default: '5 %'.",
        ),
    ] = None,
    bodies: Annotated[
        str | None,
        typer.Option(
            metavar="BODY,...",
            help="Bodies that may contain a damper, such as 1,3; list a body twice for two dampers in it. Default: "
            "all.",
        ),
    ] = None,
    dampers: Annotated[
        int,
        typer.Option(min=1, metavar="N", help="Largest number of dampers; fewer are chosen if they are as effective."),
    ] = 1,
    clearance: Annotated[
        str | None,
        typer.Option(
            metavar="LOW,HIGH",
            help="Range of clearances to search, such as '0.2 mm, 3 mm'. Default: derived from the motion without "
            "dampers; designs without a ceiling are then included.",
        ),
    ] = None,
    levels: Annotated[
        str | None,
        typer.Option(
            metavar="F,F,...",
            help="Force amplitudes for which dampers are designed, such as 1N,3N. Default: 0.5, 1 and 2 times the "
            "force of the test.",
        ),
    ] = None,
    band: Annotated[
        str | None,
        typer.Option(
            metavar="LOW,HIGH",
            help="Frequency band in which the peaks are reduced, such as '30 Hz, 60 Hz'. Default: as in the scene's "
            "test.",
        ),
    ] = None,
    response_bodies: Annotated[
        str | None,
        typer.Option(
            "--watched", metavar="BODY,...", help="Bodies whose peaks are reduced, such as 1,3. Default: all."
        ),
    ] = None,
    damping_uncertainty: Annotated[
        str,
        typer.Option(
            "--damping-off",
            metavar="SHARE",
            help="Relative uncertainty of the structure's damping, such as '30 %'. The dampers are chosen for its "
            "worst case.",
        ),
    ] = "0 %",
    stiffness_uncertainty: Annotated[
        str,
        typer.Option(
            "--stiffness-off",
            metavar="SHARE",
            help="Relative uncertainty of the structure's stiffness, such as '5 %'. The dampers are chosen for its "
            "worst case.",
        ),
    ] = "0 %",
    cluster: Cluster = None,
    output: Annotated[
        Path,
        typer.Option(
            "-o",
            "--output",
            metavar="DIR",
            help="Folder for the scene, the figure and the table, design-NAME; NAME is the name in the scene.",
        ),
    ] = Path(),
    overwrite: Overwrite = False,
) -> None:
    """Choose mass, clearance and location of dampers.

    The chosen dampers minimize the largest peak of the compliance over all levels. To continue an interrupted run, give
    the same command again.

    New dampers have the restitution and contact of the scene's first damper.
    """
    from rig.core.base.extensions import test_predictions
    from rig.core.base.output_files import allow_overwriting, file_stem, prepare_outputs
    from rig.studies.design.design import design as choose_dampers
    from rig.studies.design.evaluator import STUDY
    from rig.studies.design.figure import describe_check, summary, write

    loaded_scene = load_scene(scene, changes)
    stem = output / file_stem("design", loaded_scene.name)
    table = stem.with_suffix(".csv")
    with (
        resumable(),
        allow_overwriting(overwrite),
        STUDY.reserve(table),
        progress("evaluating designs") as report_progress,
    ):
        prepare_outputs(*(stem.with_suffix(suffix) for suffix in (".yaml", ".png", ".svg")))
        result = choose_dampers(
            loaded_scene,
            budget=budget,
            bodies=_split_list(bodies),
            dampers=dampers,
            clearance=_split_list(clearance),
            levels=_split_list(levels),
            band=_split_list(band),
            watched=_split_list(response_bodies),
            uncertain=(damping_uncertainty, stiffness_uncertainty),
            cluster=cluster,
            table=table,
            progress=lambda n_completed, total: report_progress(n_completed / total, f"{n_completed} of {total}"),
            say=partial(report_progress, 1.0),
        )
        report_progress(1.0, "writing")
        files = write(result, output)
    print(loaded_scene.structure.relabel(summary(result)))
    report_written(*files, table)
    print(loaded_scene.structure.relabel(describe_check(result, files[0])))
    for prediction in test_predictions(result.scene):
        print(f"\n{prediction}")


def _figure_and_table(stem: Path) -> list[Path]:
    return [stem.with_name(f"{stem.name}.{suffix}") for suffix in ("png", "svg", "csv")]


def _split_list(text: str | None) -> list[str] | None:
    """Split the comma-separated values of an option."""
    return None if text is None else [word.strip() for word in text.split(",")]


def _quantity(value: str | None, kind: Kind, name: str) -> float | None:
    """Parse the value of the option `name`; a number without a unit is in SI units."""
    from rig.core.settings.quantities import number

    quantity = number(value, kind, name)
    if value is not None and quantity is not None and (math.isinf(quantity) or not kind.supports(quantity)):
        raise SceneError(f"{name}: got {value[:60]}; expected {kind.noun} {kind.range}")
    return quantity


def main() -> None:
    """Run the `rig` command."""
    run_command("rig.commands.cli")
