"""The `rig` command line."""

import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from shlex import quote
from typing import Annotated, Any

import typer

from rig.commands.arguments import Changes, Cluster, Overwrite, SceneName, completions, load_scene
from rig.commands.command_line import create_application, run_command
from rig.core.base.console import count_progress, progress, report_written, resumable, show_activity

app = create_application("Compute the motion of the virtual vibration rig, without sensors and recordings.")

Folder = Annotated[Path, "DIR: Folder for the figure and the table."]


@app.command(example="rig scenes --copy fig9 mine.yaml")
def scenes(
    name: Annotated[
        str | None, typer.Argument(metavar="NAME", help="Scene whose file to print.", autocompletion=completions)
    ] = None,
    show: Annotated[str | None, typer.Option(metavar="NAME", help="Same as NAME.", hidden=True)] = None,
    copy: Annotated[
        tuple[str, Path] | None,
        typer.Option(metavar="NAME FILE", help="Copy the file of the scene NAME to FILE, to change it there."),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """List the bundled scenes, or print or copy one of them."""
    from rig.core.base.output_files import atomic_write
    from rig.core.scene.scene_files import bundled_scenes, scene_text, summary

    printed = name or show
    if printed is not None:
        print(scene_text(printed), end="")
    if copy is not None:
        text = scene_text(copy[0])
        with atomic_write(copy[1], overwrite=overwrite) as temporary:
            temporary.write_text(text, encoding="utf-8")
        print(f"wrote {copy[1]}. Change it, then run: daq record {quote(str(copy[1]))}")
    if printed is None and copy is None:
        _print_descriptions([(name, summary(name)) for name in bundled_scenes()])


@app.command(example="rig presets")
def presets(
    name: Annotated[str | None, "[NAME]: Preset whose values to print, in quotes, such as 'NI 9234'."] = None,
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
    explain: Annotated[bool, "Print the reference of all keys, in Markdown, instead of the schema."] = False,
) -> None:
    """Print the JSON Schema of scene files, or a list of all keys."""
    from rig.core.scene.json_schema import schema_text
    from rig.core.scene.reference import reference_page

    print(reference_page() if explain else schema_text(), end="")


@app.command("help", example="rig help test.stepped_sine")
def help_(
    key: Annotated[
        str | None,
        "[KEY]: Key to explain, such as test.force, force or test.stepped_sine. Default: list all top-level keys.",
    ] = None,
) -> None:
    """Explain a key of scene files: meaning, values and default."""
    from rig.core.scene.reference import help_on

    print(help_on(key))


@app.command(example="rig explain fig9")
def explain(
    scene: SceneName,
    changes: Changes = None,
    no_prediction: Annotated[bool, "List the effects without a prediction of the test."] = False,
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


@app.command(example="rig simulate fig9 --duration 2s -o run.npz", options="--frequency F")
def simulate(
    scene: SceneName,
    changes: Changes = None,
    duration: Annotated[
        str | None, "TIME: Duration of the motion, such as '2 s'. Default: as in the scene's test."
    ] = None,
    rate: Annotated[str, "RATE: Sample rate of the motion, such as '5120 Hz'."] = "5120 Hz",
    *,
    frequency: str | None,
    output: Annotated[
        Path | None,
        "FILE: File for the motion, .npz or .csv. With it, the same command continues an interrupted run with grains.",
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Simulate a scene; print its largest motion, events and energy.

    The drive acts in open loop: sensors and controller are not simulated.
    """
    from rig.core.base.output_files import allow_overwriting
    from rig.core.simulation.run_output import simulate_to_file, summary

    loaded_scene = load_scene(scene, changes)
    with allow_overwriting(overwrite), count_progress("computing the motion") as progress:
        run = simulate_to_file(output, loaded_scene, duration, rate, frequency, progress)
    print(loaded_scene.structure.relabel(summary(run)))
    if output is not None:
        report_written(output)


@app.command(
    example="rig response fig9 --from 30Hz --to 40Hz --points 21 -o response.csv",
    options="--from F --to F --points N --direction",
)
def response(
    scene: SceneName,
    changes: Changes = None,
    *,
    output: Annotated[Path | None, "FILE.csv: CSV file for the response at all frequencies, with all digits."] = None,
    overwrite: Overwrite = False,
    verbose: Annotated[bool, "Also print the response at every frequency."] = False,
    **options: Any,
) -> None:
    """Compute the steady-state response to a sine at each frequency.

    The amplitude of the sine is the force or drive of the scene's test.
    """
    import rig
    from rig.core.base.output_files import allow_overwriting, prepare_outputs
    from rig.core.steady_response.response_output import format_response, write_csv

    loaded_scene = load_scene(scene, changes)
    with allow_overwriting(overwrite):
        if output is not None:
            prepare_outputs(output)
        with count_progress("computing the motion") as progress:
            result = rig.response(loaded_scene, progress=progress, **options)
        print(format_response(result, verbose))
        if output is not None:
            write_csv(result, output)
            report_written(output)


@app.command(
    example="rig grains fig9 --set 'dampers[1].grains={diameter: 2 mm}' --points 5 -o grains.csv",
    options="--from F --to F --points N --periods N",
)
def grains(
    scene: SceneName,
    changes: Changes = None,
    *,
    cluster: Cluster = None,
    output: Annotated[
        Path | None,
        "FILE.csv: CSV file for the results. Frequencies that are already in this file are not computed again.",
    ] = None,
    **options: Any,
) -> None:
    """Compare responses with beds as grains and as one mass each.

    At each frequency, both models of the beds are simulated until the motion is steady.
    """
    import rig
    from rig.extras.bed_response.bed_response import format_table

    loaded_scene = load_scene(scene, changes)
    with resumable(output is not None), count_progress("simulating the grains") as progress:
        result = rig.grains(loaded_scene, table=output, cluster=cluster, progress=progress, **options)
    print(format_table(result))
    if output is not None:
        report_written(output)


@app.command(example="rig cost fig9", options="--frequency F --periods N")
def cost(
    scene: SceneName,
    changes: Changes = None,
    *,
    frequency: str | None,
    periods: int,
    output: Folder = Path(),
    overwrite: Overwrite = False,
) -> None:
    """Compare errors and computing times of simulation methods.

    For a scene with a bed of grains, simpler models of the bed are compared instead: one mass, one mass with
    finite-duration contact, and softer grains.
    """
    import rig
    from rig.core.base.output_files import allow_overwriting, file_stem, prepare_outputs

    loaded_scene = load_scene(scene, changes)
    with allow_overwriting(overwrite), show_activity() as report:
        prepare_outputs(*_figure_and_table(output / file_stem("cost", loaded_scene.name)))
        result = rig.cost(loaded_scene, frequency, periods, report)
        files = result.write(output)
    print(result)
    report_written(*files)


@app.command(
    "map",
    example="rig map fig9 --rows 12 --points 24",
    options="--over --least VALUE --most VALUE --rows N --from F --to F --points N",
)
def map_(
    scene: SceneName,
    changes: Changes = None,
    *,
    over: str | None,
    cluster: Cluster = None,
    output: Folder = Path(),
    overwrite: Overwrite = False,
    **options: Any,
) -> None:
    """Map types of motion and settling time by level and frequency.

    To continue an interrupted run, give the same command again.
    """
    import rig
    from rig.core.base.output_files import allow_overwriting, prepare_outputs
    from rig.core.base.study import unfinished_file
    from rig.studies.motion_map.grid import vertical_axis
    from rig.studies.motion_map.motion_map import STUDY, output_stem, summarize_map, write_map

    loaded_scene = load_scene(scene, changes)
    stem = output_stem(loaded_scene, vertical_axis(loaded_scene, over)[0], output)
    table = stem.with_suffix(".csv")
    options |= {"over": over, "cluster": cluster, "kept": unfinished_file(table)}
    with resumable(), allow_overwriting(overwrite), STUDY.reserve(table):
        prepare_outputs(*_figure_and_table(stem))
        with count_progress("computing the motion") as progress:
            result = rig.map(loaded_scene, progress=progress, **options)
        files = write_map(result, output)
    print(summarize_map(result))
    report_written(*files)


@app.command(
    example="rig design fig9 --budget '50 g' --bodies 3 --levels 3N -o design",
    options="--budget MASS|PERCENT --bodies BODY,... --dampers N --clearance LOW,HIGH --levels F,F,... --band LOW,HIGH "
    "--watched BODY,...",
)
def design(
    scene: SceneName,
    changes: Changes = None,
    *,
    damping_off: Annotated[
        str,
        "PERCENT: Largest relative error of the structure's damping, such as '30 %'. The dampers minimize the "
        "largest peak within this error.",
    ] = "0 %",
    stiffness_off: Annotated[
        str,
        "PERCENT: Largest relative error of the structure's stiffness, such as '5 %'. The dampers minimize the "
        "largest peak within this error.",
    ] = "0 %",
    cluster: Cluster = None,
    output: Annotated[
        Path, "DIR: Folder for scene, figure and table, which are named design-NAME after the name in the scene."
    ] = Path(),
    overwrite: Overwrite = False,
    **options: Any,
) -> None:
    """Choose mass, clearance and location of dampers.

    The chosen dampers minimize the largest peak of the compliance over all levels. To continue an interrupted run, give
    the same command again.

    New dampers have the restitution and contact of the scene's first damper.
    """
    from rig.core.base.extensions import test_predictions
    from rig.core.base.output_files import allow_overwriting, file_stem, prepare_outputs
    from rig.studies.design.check_text import describe_check
    from rig.studies.design.design import design as choose_dampers
    from rig.studies.design.evaluator import STUDY
    from rig.studies.design.figure import write
    from rig.studies.design.summary import summary

    loaded_scene = load_scene(scene, changes)
    stem = output / file_stem("design", loaded_scene.name)
    table = stem.with_suffix(".csv")
    for name in ("bodies", "clearance", "levels", "band", "watched"):
        options[name] = _split_list(options[name])
    with (
        resumable(),
        allow_overwriting(overwrite),
        STUDY.reserve(table),
        progress("evaluating designs") as report_progress,
    ):
        prepare_outputs(*(stem.with_suffix(suffix) for suffix in (".yaml", ".png", ".svg")))
        result = choose_dampers(
            loaded_scene,
            uncertain=(damping_off, stiffness_off),
            cluster=cluster,
            table=table,
            progress=lambda n_completed, total: report_progress(n_completed / total, f"{n_completed} of {total}"),
            say=partial(report_progress, 1.0),
            **options,
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


def main() -> None:
    """Run the `rig` command."""
    run_command("rig.commands.cli")
