"""The `analysis` command line."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.arguments import Changes, Cluster, Overwrite, SceneName, loaded
from rig.command_line import application, run
from rig.console import counting, goes_on
from rig.provenance import overwriting

if TYPE_CHECKING:
    from analysis.presentation.presentation import Result

app = application("From recordings to curves, modes and reports.")

Files = Annotated[list[Path], typer.Argument(metavar="FILE...", help="Recordings; several are overlaid.")]
Output = Annotated[
    Path | None,
    typer.Option("--output", "-o", metavar="DIR", help="Where to write; default beside the first FILE."),
]
Reference = Annotated[
    str, typer.Option(help="What to divide by: force (on the structure) or table (its displacement).")
]
Block = Annotated[float | None, typer.Option(help="Block length in s, for random tests and hits.")]
Unit = Annotated[
    str | None,
    typer.Option(metavar="UNIT", help="Of responses in a .uff or .csv FILE that says none: g/N, m/N."),
]
Count = Annotated[
    int | None, typer.Option("--modes", help="How many modes to keep; default all stable ones.")
]
Table = Annotated[
    Path, typer.Option("--output", "-o", metavar="FILE", help="Table; what is in it is not done again.")
]


@app.command()
def frf(
    files: Files,
    output: Output = None,
    response: Annotated[
        list[str] | None, typer.Option(help="Channel; may be repeated; default all bodies.")
    ] = None,
    reference: Reference = "force",
    motion: Annotated[
        str, typer.Option(help="displacement, velocity or acceleration of the response.")
    ] = "displacement",
    estimator: Annotated[
        str | None,
        typer.Option(
            help="H1, H2 or Hv: average blocks of random or hits; default: take it whole, without leakage."
        ),
    ] = None,
    block: Block = None,
    overlap: Annotated[
        float | None, typer.Option(help="Part of a block that it shares with the next; default 0.5.")
    ] = None,
    window: Annotated[
        str | None, typer.Option(help="Over blocks: hann, none, ...; default hann, none for hits.")
    ] = None,
    unit: Unit = None,
    theory: Annotated[
        bool, typer.Option("--theory", help="Add the exact curve of the bare structure.")
    ] = False,
    overwrite: Overwrite = False,
) -> None:
    """Frequency responses: compliance against frequency, with error bars and coherence."""
    from analysis.presentation.presentation import present_frf

    with overwriting(overwrite), counting("analysing") as progress:
        result = present_frf(
            files,
            output,
            response,
            reference,
            motion,
            estimator,
            block,
            theory,
            progress,
            overlap,
            window,
            unit,
        )
    _show(result)


@app.command()
def decay(
    files: Files,
    output: Output = None,
    channel: Annotated[str | None, typer.Option(help="Channel; default the last body's.")] = None,
    hit: Annotated[int, typer.Option(help="Which hit, from 1.")] = 1,
    overwrite: Overwrite = False,
) -> None:
    """Free decays: envelope, natural frequencies, and damping ratio against amplitude."""
    from analysis.presentation.presentation import present_decay

    with overwriting(overwrite):
        result = present_decay(files, output, channel, hit)
    _show(result)


@app.command()
def modes(
    files: Files,
    output: Output = None,
    reference: Reference = "force",
    modes: Count = None,
    block: Block = None,
    unit: Unit = None,
    overwrite: Overwrite = False,
) -> None:
    """Natural frequencies, damping ratios and mode shapes, of recordings or of responses in .uff or .csv."""
    from analysis.presentation.presentation import present_modes

    with overwriting(overwrite), counting("analysing") as progress:
        result = present_modes(files, output, reference, modes, block, progress, unit)
    _show(result)


@app.command()
def dampers(files: Files, output: Output = None, overwrite: Overwrite = False) -> None:
    """Motion of the dampers and energy they take out, at each frequency of a stepped sine."""
    from analysis.presentation.damper_findings import present_dampers

    with overwriting(overwrite), counting("analysing") as progress:
        result = present_dampers(files, output, progress)
    _show(result)


@app.command()
def compare(files: Files, output: Output = None, overwrite: Overwrite = False) -> None:
    """How far every resonance peak of the first recording is lowered and moved in the others, with bounds."""
    from analysis.presentation.comparison import present_compare

    with overwriting(overwrite), counting("analysing") as progress:
        result = present_compare(files, output, progress)
    _show(result)


@app.command()
def fit(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="RECORDING...", help="Of one structure, without and with dampers, at any levels."
        ),
    ],
    scene: SceneName,
    changes: Changes = None,
    free: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KEY",
            help="Fit this, such as structure.masses or dampers[1].clearance; may be repeated; default masses, "
            "springs, damping and all of the dampers.",
        ),
    ] = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FILE", help="The fitted scene; figures lie beside it.")
    ] = Path("fitted.yaml"),
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace FILE if it exists.")] = False,
) -> None:
    """Fit a scene to recordings of the real structure: values with 95 % intervals."""
    from analysis.fitting.presentation import present_fit

    files_written, warnings = present_fit(files, loaded(scene, changes), free, output, overwrite, print)
    for warning in warnings:
        print(f"warning: {warning}", file=sys.stderr)
    for path in files_written:
        print(f"wrote {path}")


@app.command()
def report(
    files: Files,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="DIR|FILE.html", help="Where to write; default beside the first FILE."
        ),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """One self-contained HTML page about recordings."""
    from analysis.report.report import write_report

    with overwriting(overwrite), counting("analysing") as progress:
        result = write_report(files, output, progress)
    _show(result)


@app.command()
def demo(
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="DIR", help="Where recordings and figures go.")
    ] = Path("recordings"),
    overwrite: Overwrite = False,
) -> None:
    """Record the paper's sweep and impulse tests and draw its figures from the recordings."""
    from analysis.presentation.demo import demonstrate

    with overwriting(overwrite):
        demonstrate(output, _say)


@app.command()
def export(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The recording.")],
    output: Annotated[
        Path,
        typer.Option("-o", "--output", metavar="OUT", help="File to write: .uff, .mat, .csv, .npz or .wav."),
    ],
    channel: Annotated[
        list[str] | None, typer.Option(help="Channel; may be repeated; default all of them.")
    ] = None,
    start: Annotated[float | None, typer.Option("--from", metavar="S", help="Begin at this time.")] = None,
    stop: Annotated[float | None, typer.Option("--to", metavar="S", help="End at this time.")] = None,
    speed: Annotated[float, typer.Option(metavar="X", help="Play sound this much faster.")] = 1.0,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace OUT if it exists.")] = False,
    what: Annotated[
        str, typer.Option(help="samples; or frfs or modes, into .uff (58, 55) or .mat.")
    ] = "samples",
) -> None:
    """Write a recording for other tools: UFF, MATLAB, CSV, NPZ, or WAV to listen to."""
    from analysis.export.export import expected_bytes, kind_of
    from analysis.export.export import export as export_stretch
    from analysis.export.results import export_results
    from analysis.recordings.slices import Slice
    from daq.recording.recording import open as open_recording

    if what != "samples":
        if channel or start is not None or stop is not None or speed != 1.0:
            raise typer.BadParameter(
                "--channel, --from, --to and --speed are of samples; they do not go with --what"
            )
        with counting("analysing") as progress:
            lines = export_results(file, output, what, overwrite, progress)
        print(*lines, sep="\n")
        return
    with open_recording(file) as recording:
        stretch = Slice.of(recording, channel, start, stop)
        size = expected_bytes(stretch, kind_of(output))
        print(f"writing {output}: about {size / 1e6:.3g} MB", file=sys.stderr)
        with counting("exporting") as progress:
            lines = export_stretch(stretch, output, speed, overwrite, progress)
    for line in lines:
        print(line)
    print(f"wrote {output}")


@app.command()
def cost(
    scene: SceneName,
    changes: Changes = None,
    frequency: Annotated[
        list[float] | None,
        typer.Option(
            metavar="HZ", help="Measure here; may be repeated; default the test's ends and hardest."
        ),
    ] = None,
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="DIR", help="Where to write the figure and the table."),
    ] = Path(),
    overwrite: Overwrite = False,
) -> None:
    """Measure what the measurement chain costs: error of the compliance against time, one effect at a time."""
    from analysis.chain_cost.figure import output_files, table, write
    from analysis.chain_cost.study import chain_study
    from rig.output_files import make_ready
    from rig.provenance import made_from, refuse_others

    setting = loaded(scene, changes)
    make_ready(output)
    with overwriting(overwrite), made_from("chain-cost", setting.to_yaml()):
        refuse_others(*output_files(setting, output))
        with counting("recording and analysing") as progress:
            study = chain_study(setting, frequency, progress)
        files = write(study, output)
    print(table(study))
    for path in files:
        print(f"wrote {path}")


@app.command()
def paper(
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="DIR", help="Where data, figures and the page go.")
    ] = Path("recordings/paper"),
    fresh: Annotated[list[str] | None, typer.Option(help="Compute this part again; may be repeated.")] = None,
    cluster: Cluster = None,
    overwrite: Overwrite = False,
) -> None:
    """Reproduce the paper's figures and judge its claims; goes on where it stopped."""
    from analysis.paper.reproduce import reproduce

    with goes_on(), overwriting(overwrite):
        reproduce(output, _say, fresh or (), cluster)


@app.command()
def beds(
    output: Table = Path("recordings/beds.csv"),
    points: Annotated[
        int | None, typer.Option(min=1, help="Only so many settings, spread over all; 6 take minutes.")
    ] = None,
    cluster: Cluster = None,
) -> None:
    """Follow beds of grains and the same as one mass, for the paper's claim on them; takes over half an hour."""
    from analysis.paper.bed_study import follow

    with goes_on():
        follow(output, points, _say, cluster)
    print(f"\nwritten: {output}")


@app.command()
def contacts(
    output: Table = Path("recordings/contacts.csv"),
    cluster: Cluster = None,
) -> None:
    """Follow one mass on floors and ceilings that give way, at the settings of `analysis beds`; takes minutes."""
    from analysis.paper.contact_study import follow

    with goes_on():
        follow(output, _say, cluster)
    print(f"\nwritten: {output}")


def _say(line: str) -> None:
    print(line, flush=True)


def _show(result: Result) -> None:
    for line in result.lines:
        print(line)
    for warning in result.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    for path in result.files:
        print(f"wrote {path}")


def main() -> None:
    """Run the `analysis` command."""
    run("analysis.cli")
