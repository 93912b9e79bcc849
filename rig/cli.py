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

from rig.arguments import (
    MOST,
    Changes,
    Cluster,
    First,
    Last,
    Overwrite,
    Points,
    SceneName,
    completions,
    loaded,
)
from rig.command_line import application, run
from rig.console import counting, goes_on, progress, saying
from rig.errors import SceneError

if TYPE_CHECKING:
    from rig.scene.quantities import Kind

app = application("The physics of the virtual vibration rig.")


@app.command()
def scenes(
    show: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Print this scene's file.", autocompletion=completions),
    ] = None,
    copy: Annotated[
        tuple[str, Path] | None,
        typer.Option(metavar="NAME FILE", help="Copy this scene's file, to begin one of your own with."),
    ] = None,
) -> None:
    """List the bundled scenes, or print or copy the file of one."""
    from rig.output_files import replacing
    from rig.scene.scene_files import bundled, summary, text_of

    if show is not None:
        print(text_of(show), end="")
    if copy is not None:
        text = text_of(copy[0])
        with replacing(copy[1], overwrite=False) as part:
            part.write_text(text, encoding="utf-8")
        print(f"{copy[1]}: change it, then: daq record {quote(str(copy[1]))}")
    if show is None and copy is None:
        _list([(name, summary(name)) for name in bundled()])


@app.command()
def presets(
    name: Annotated[str | None, typer.Argument(metavar="[NAME]", help="A part, for all its figures.")] = None,
) -> None:
    """List the parts whose data sheets a scene can name as preset, or the figures of one and where they are from."""
    from rig.scene.data_sheets import data_sheets, described

    if name is not None:
        print("\n".join(described(name)))
    else:
        _list([(sheet.name, f"{sheet.summary} {sheet.doubts}".strip()) for sheet in data_sheets().values()])


def _list(rows: Sequence[tuple[str, str]]) -> None:
    """Print names and what they are; a pipe gets a tab between, whatever the width of the terminal it may end in."""
    wide = max(len(name) for name, _ in rows) if sys.stdout.isatty() else 0
    for name, what in rows:
        print(f"{name:{wide}}  {what}" if wide else f"{name}\t{what}")


@app.command()
def schema(
    explain: Annotated[bool, typer.Option("--explain", help="Every key in words, as Markdown.")] = False,
) -> None:
    """Print the JSON Schema of scene files, for editors; or the reference of all keys."""
    from rig.scene.json_schema import schema_text
    from rig.scene.reference import page

    print(page() if explain else schema_text(), end="")


@app.command("help")
def help_(
    key: Annotated[
        str | None, typer.Argument(metavar="[KEY]", help="Such as test.force, or only force.")
    ] = None,
) -> None:
    """Explain a key of scene files: what it means, what it takes, and what holds without it."""
    from rig.scene.reference import help_on

    print(help_on(key))


@app.command()
def explain(
    scene: SceneName,
    changes: Changes = None,
    measure: Annotated[
        bool, typer.Option("--measure", help="Add the effects one at a time and measure what each costs.")
    ] = False,
) -> None:
    """Say which effects a scene turns on, how many states each adds, and what its test will do."""
    import rig
    from rig.effects.foresight import foresights

    setting = loaded(scene, changes)
    print(rig.explain(setting))
    for foreseen in foresights(setting):
        print(f"\n{foreseen}")
    if measure:
        from rig.effects.effect_cost import effect_costs, text

        with saying() as say:
            costs = effect_costs(setting, say)
        print("\n" + text(costs))


@app.command()
def simulate(
    scene: SceneName,
    changes: Changes = None,
    duration: Annotated[
        str | None,
        typer.Option(metavar="TIME", help="How long, such as '2 s' (default: the test's duration)."),
    ] = None,
    rate: Annotated[
        str, typer.Option(metavar="RATE", help="Samples of the motion, such as '5120 Hz'.")
    ] = "5120 Hz",
    frequency: Annotated[
        str | None, typer.Option(metavar="F", help="A tone of this frequency at the test's level.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            metavar="FILE",
            help="Write the run: .npz or .csv; with grains it goes on where it stopped.",
        ),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Simulate a scene without sensors and controller; print peaks, events and energy."""
    from rig.provenance import made_from, overwriting
    from rig.scene.quantities import FREQUENCY, TIME
    from rig.simulation.run_output import simulate_into, summary

    setting = loaded(scene, changes)
    seconds, tone = _quantity(duration, TIME, "--duration"), _quantity(frequency, FREQUENCY, "--frequency")
    samples = _quantity(rate, FREQUENCY, "--rate") or 0.0
    with (
        overwriting(overwrite),
        made_from("simulate", setting.to_yaml()),
        counting("following the motion") as progress,
    ):
        run = simulate_into(output, setting, seconds, samples, tone, progress)
    print(setting.structure.relabel(summary(run)))
    if output is not None:
        print(f"\nwritten: {output}")


@app.command()
def response(
    scene: SceneName,
    changes: Changes = None,
    first: First = None,
    last: Last = None,
    points: Points = None,
    direction: Annotated[
        str | None, typer.Option(metavar="up|down|both", help="Order of the frequencies.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="FILE.csv", help="Write the table with all digits."),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Steady response over frequency at the test's level; at the test's frequencies unless others are given."""
    import rig
    from rig.provenance import made_from, overwriting, refuse_others
    from rig.response.response_output import frequencies_of, text, write
    from rig.scene.quantities import FREQUENCY

    setting = loaded(scene, changes)
    ends = (_quantity(first, FREQUENCY, "--from"), _quantity(last, FREQUENCY, "--to"))
    frequencies, order = frequencies_of(setting, *ends, points, direction)
    with overwriting(overwrite), made_from("response", setting.to_yaml()):
        if output is not None:
            refuse_others(output)
        with counting("following the motion") as progress:
            result = rig.frequency_response(setting, frequencies, direction=order, progress=progress)
        print(text(result))
        if output is not None:
            write(result, output)
            print(f"\nwritten: {output}")


@app.command()
def grains(
    scene: SceneName,
    changes: Changes = None,
    first: First = None,
    last: Last = None,
    points: Points = None,
    periods: Annotated[
        int, typer.Option(min=1, max=MOST, metavar="N", help="Of the drive in a block that is averaged.")
    ] = 20,
    cluster: Cluster = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", metavar="FILE.csv", help="Table to keep; what it has is not done again."
        ),
    ] = None,
) -> None:
    """Follow beds of grains at each frequency until they are steady, beside the same beds as one mass."""
    from rig.bed_response.bed_response import bed_response, text
    from rig.response.response_output import frequencies_of
    from rig.scene.quantities import FREQUENCY

    setting = loaded(scene, changes)
    ends = (_quantity(first, FREQUENCY, "--from"), _quantity(last, FREQUENCY, "--to"))
    frequencies, _ = frequencies_of(setting, *ends, points, None)
    with goes_on(output is not None), counting("following the grains") as progress:
        result = bed_response(setting, frequencies, periods, output, cluster, progress)
    print(text(result))
    if output is not None:
        print(f"\nwritten: {output}")


@app.command()
def cost(
    scene: SceneName,
    changes: Changes = None,
    frequency: Annotated[
        str | None,
        typer.Option(
            metavar="F", help="Of the drive (default: where the linear structure accelerates most)."
        ),
    ] = None,
    periods: Annotated[int, typer.Option(min=2, max=MOST, metavar="N", help="Length of the motion.")] = 20,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Where to write the figure and the table.")
    ] = Path(),
    overwrite: Overwrite = False,
) -> None:
    """Measure what accuracy costs: every way to compute this scene, its error against its time, here and now.

    Of a scene with a bed of grains: what one mass, one mass on contacts that last, and coarser grains are worth.
    """
    from rig.output_files import make_ready, stem
    from rig.provenance import made_from, overwriting, refuse_others
    from rig.scene.quantities import FREQUENCY
    from rig.work_precision.cost import cost as cost_of

    setting = loaded(scene, changes)
    make_ready(output)
    with overwriting(overwrite), made_from("cost", setting.to_yaml()), saying() as say:
        refuse_others(*_figure_and_table(output / stem("cost", setting.name)))
        tone = _quantity(frequency, FREQUENCY, "--frequency")
        text, files = cost_of(setting, tone, periods, output, say)
    print(text)
    print("\nwritten:", *files)


@app.command("map")
def map_(
    scene: SceneName,
    changes: Changes = None,
    over: Annotated[
        str | None,
        typer.Option(
            metavar="force|drive|clearance", help="What changes beside frequency (default: the level)."
        ),
    ] = None,
    least: Annotated[
        str | None, typer.Option(metavar="VALUE", help="Smallest level or clearance, such as '0.5 N'.")
    ] = None,
    most: Annotated[str | None, typer.Option(metavar="VALUE", help="Largest level or clearance.")] = None,
    rows: Annotated[
        int, typer.Option(min=2, max=1000, metavar="N", help="How many levels or clearances.")
    ] = 36,
    first: First = None,
    last: Last = None,
    points: Annotated[int, typer.Option(min=2, max=1000, metavar="N", help="How many frequencies.")] = 48,
    cluster: Cluster = None,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Where to write the figure and the table.")
    ] = Path(),
    overwrite: Overwrite = False,
) -> None:
    """Map where it gets hard: type of motion and time to settle over level (or clearance) and frequency.

    Started again after an interruption, it goes on where it stopped.
    """
    import rig
    from rig.motion_map.figure import place, summary, write
    from rig.motion_map.grid import KIND_OF_UNIT, columns, rows_of, vertical_axis
    from rig.output_files import make_ready
    from rig.provenance import made_from, overwriting, refuse_others
    from rig.scene.quantities import FREQUENCY

    setting = loaded(scene, changes)
    over, unit = vertical_axis(setting, over)
    ends = _quantity(first, FREQUENCY, "--from"), _quantity(last, FREQUENCY, "--to")
    frequencies = columns(setting, *ends, points)
    kind = KIND_OF_UNIT[unit]
    ends = _quantity(least, kind, "--least"), _quantity(most, kind, "--most")
    values = rows_of(setting, over, frequencies, *ends, rows)
    make_ready(output)
    name = place(setting, over, output)
    kept = name.with_suffix(".csv.kept")
    with goes_on(), overwriting(overwrite), made_from("map", setting.to_yaml()):
        refuse_others(*_figure_and_table(name))
        with counting("following the motion") as progress:
            found = rig.map_motion(setting, over, values, frequencies, progress, cluster, kept)
        files = write(found, output)
    kept.unlink()
    print(summary(found))
    print("\nwritten:", *files)


@app.command()
def design(
    scene: SceneName,
    changes: Changes = None,
    budget: Annotated[
        str | None,
        typer.Option(
            metavar="MASS|SHARE", help="The most to add: '50 g', or '5 %' of the structure's mass (default)."
        ),
    ] = None,
    bodies: Annotated[
        str | None,
        typer.Option(
            metavar="BODY,...", help="Bodies that may carry a damper (default: all); for two, name one twice."
        ),
    ] = None,
    dampers: Annotated[
        int, typer.Option(min=1, metavar="N", help="How many; fewer where they do as well.")
    ] = 1,
    clearance: Annotated[
        str | None,
        typer.Option(metavar="LOW,HIGH", help="Clearances to choose from, such as '0.2 mm, 3 mm'."),
    ] = None,
    levels: Annotated[
        str | None,
        typer.Option(
            metavar="F,F,...", help="Forces to do well at (default: half, once and twice the test's)."
        ),
    ] = None,
    band: Annotated[
        str | None, typer.Option(metavar="LOW,HIGH", help="Frequencies that count (default: the test's).")
    ] = None,
    watched: Annotated[
        str | None, typer.Option(metavar="BODY,...", help="Bodies whose peaks count (default: all).")
    ] = None,
    damping_off: Annotated[
        str, typer.Option(metavar="SHARE", help="How far the structure's damping may be off, such as '30 %'.")
    ] = "0 %",
    stiffness_off: Annotated[
        str, typer.Option(metavar="SHARE", help="How far its stiffness may be off.")
    ] = "0 %",
    cluster: Cluster = None,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Where scene, figures and table go.")
    ] = Path(),
    overwrite: Overwrite = False,
) -> None:
    """Choose dampers: mass, clearance and place with the smallest worst peak; what is there of it is not done again.

    New dampers land as the scene's: with their restitution and contact, those of the first where they differ.
    """
    from rig.damper_design.design import design as search
    from rig.damper_design.figure import next_step, summary, write
    from rig.effects.foresight import foresights
    from rig.output_files import make_ready, stem
    from rig.provenance import made_from, overwriting, refuse_others

    setting = loaded(scene, changes)
    make_ready(output)
    name = output / stem("design", setting.name)
    table = name.with_suffix(".csv")
    with (
        goes_on(),
        overwriting(overwrite),
        made_from("design", setting.to_yaml()),
        progress("trying designs") as report_progress,
    ):
        refuse_others(*(name.with_suffix(ending) for ending in (".yaml", ".png", ".svg")))
        found = search(
            setting,
            budget=budget,
            bodies=_listed(bodies),
            dampers=dampers,
            clearance=_listed(clearance),
            levels=_listed(levels),
            band=_listed(band),
            watched=_listed(watched),
            uncertain=(damping_off, stiffness_off),
            cluster=cluster,
            table=table,
            progress=lambda done, total: report_progress(done / total, f"{done} of {total}"),
            say=partial(report_progress, 1.0),
        )
        report_progress(1.0, "writing")
        files = write(found, output)
    print(setting.structure.relabel(summary(found)))
    print("\nwritten:", *files, table)
    print(setting.structure.relabel(next_step(found, files[0])))
    for foreseen in foresights(found.scene):
        print(f"\n{foreseen}")


def _figure_and_table(name: Path) -> list[Path]:
    return [name.with_name(f"{name.name}.{ending}") for ending in ("png", "svg", "csv")]


def _listed(text: str | None) -> list[str] | None:
    """Take an option of several values with commas between apart."""
    return None if text is None else [word.strip() for word in text.split(",")]


def _quantity(value: str | None, kind: Kind, name: str) -> float | None:
    """Read an option that carries a unit; a bare number is SI."""
    from rig.scene.quantities import parse

    if value is None:
        return None
    try:
        number = float(parse(value, kind))
    except ValueError as error:
        raise SceneError(f"{name}: {error}") from None
    if math.isinf(number) or not kind.carries(number):
        raise SceneError(f"{name}: got {value[:60]}; expected {kind.noun} {kind.range}")
    return number


def main() -> None:
    """Run the `rig` command."""
    run("rig.cli")
