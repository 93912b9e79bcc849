"""The `analysis` command line."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.commands.arguments import Changes, Cluster, Overwrite, SceneName, load_scene
from rig.commands.command_line import create_application, run_command
from rig.core.base.console import count_progress, report_written, resumable
from rig.core.base.output_files import allow_overwriting

if TYPE_CHECKING:
    from analysis.commands.presentation.outputs import CommandOutput

app = create_application("Curves, modes and reports from recordings.")

Recordings = Annotated[list[Path], "FILE...: Recordings (.mcap)."]
Curves = Annotated[list[Path], "FILE...: Recordings (.mcap), or responses from other programs (.uff, .csv)."]
Compared = Annotated[list[Path], "FILE...: Recordings (.mcap). The first is the baseline of the comparison."]
Reported = Annotated[
    list[Path], "FILE...: Recordings (.mcap). The baseline is the first without moving dampers, otherwise the first."
]
Folder = Annotated[Path | None, "DIR: Folder to write to. Default: the folder of the first FILE."]
Table = Annotated[Path, "FILE: CSV table of results. Points in this table are not computed again."]


@app.command(
    example="analysis frf sweep.mcap --response body3",
    options="--response CHANNEL --reference --motion QUANTITY --estimator --block S --overlap FRACTION --window NAME "
    "--unit UNIT",
)
def frf(
    files: Curves,
    output: Folder = None,
    *,
    theory: Annotated[
        bool, "Add the linear response computed from the scene, without beds and sliding masses."
    ] = False,
    overwrite: Overwrite = False,
    **options: Any,
) -> None:
    """Estimate frequency responses with 95 % intervals and coherence."""
    from analysis.commands.presentation.frf_findings import present_frf

    with allow_overwriting(overwrite), count_progress("analyzing") as progress:
        _print_output(present_frf(files, output, theory=theory, progress=progress, **options))


@app.command(example="analysis decay impulse.mcap --channel body3", options="--channel CHANNEL --impact N")
def decay(files: Recordings, output: Folder = None, *, overwrite: Overwrite = False, **options: Any) -> None:
    """Estimate natural frequencies and damping from a free decay."""
    from analysis.commands.presentation.decay_findings import present_decay

    with allow_overwriting(overwrite):
        _print_output(present_decay(files, output, **options))


@app.command(
    example="analysis srs shock.mcap --channel table --q 10", options="--q Q --lowest HZ --highest HZ --from S --to S"
)
def srs(
    files: Recordings,
    output: Folder = None,
    channel: Annotated[list[str] | None, "CHANNEL: Channel. May be repeated. Default: all channels on bodies."] = None,
    *,
    overwrite: Overwrite = False,
    **options: Any,
) -> None:
    """Compute shock response spectra of any channel."""
    from analysis.commands.presentation.shock_findings import present_srs

    with allow_overwriting(overwrite):
        _print_output(present_srs(files, output, channel, **options))


@app.command(example="analysis profile random.mcap")
def profile(files: Recordings, output: Folder = None, overwrite: Overwrite = False) -> None:
    """Compare controlled motion with the profile of its test."""
    from analysis.commands.presentation.profile_findings import present_profile

    with allow_overwriting(overwrite):
        _print_output(present_profile(files, output))


@app.command(example="analysis backbone resonance.mcap")
def backbone(files: Recordings, output: Folder = None, overwrite: Overwrite = False) -> None:
    """Estimate frequency and damping as functions of amplitude."""
    from analysis.commands.presentation.backbone_findings import present_backbone

    with allow_overwriting(overwrite):
        _print_output(present_backbone(files, output))


@app.command(example="analysis continuation curve.mcap --theory")
def continuation(
    files: Recordings,
    output: Folder = None,
    theory: Annotated[bool, "Add the exact orbits of the scene."] = False,
    overwrite: Overwrite = False,
) -> None:
    """Draw responses at constant force with their folds."""
    from analysis.commands.presentation.continuation_findings import present_continuation

    with allow_overwriting(overwrite):
        _print_output(present_continuation(files, output, theory))


@app.command(example="analysis surface held.mcap --force 1")
def surface(
    files: Recordings,
    output: Folder = None,
    force: Annotated[list[float] | None, "N: Draw the response at this force amplitude in N. May be repeated."] = None,
    overwrite: Overwrite = False,
) -> None:
    """Draw the force as a function of frequency and amplitude."""
    from analysis.commands.presentation.surface_findings import present_surface

    with allow_overwriting(overwrite):
        _print_output(present_surface(files, output, force or ()))


@app.command(
    example="analysis modes sweep.mcap", options="--response CHANNEL --reference --block S --unit UNIT --modes N"
)
def modes(
    files: Curves,
    output: Folder = None,
    *,
    modes: int | None,
    exponential_window: Annotated[
        float | None,
        "S: Correct damping ratios for an exponential window with this time constant in s, which was applied to the "
        "signals.",
    ] = None,
    roving: Annotated[
        bool,
        "Each FILE contains impacts at a different point, with the same fixed sensor. Identify the modes of all "
        "points at once, by reciprocity.",
    ] = False,
    overwrite: Overwrite = False,
    **options: Any,
) -> None:
    """Estimate natural frequencies, damping ratios and mode shapes."""
    from analysis.commands.presentation.mode_findings import present_modes

    options |= {"count": modes, "exponential_window": exponential_window, "roving": roving}
    with allow_overwriting(overwrite), count_progress("analyzing") as progress:
        _print_output(present_modes(files, output, progress=progress, **options))


@app.command(example="analysis dampers sweep.mcap")
def dampers(files: Recordings, output: Folder = None, overwrite: Overwrite = False) -> None:
    """Estimate the impacts of dampers, and the energy they dissipate.

    Each frequency of a sine or stepped-sine test is evaluated.
    """
    from analysis.commands.presentation.damper_findings import present_dampers

    with allow_overwriting(overwrite), count_progress("analyzing") as progress:
        _print_output(present_dampers(files, output, progress))


@app.command(example="analysis compare without.mcap with.mcap")
def compare(files: Compared, output: Folder = None, overwrite: Overwrite = False) -> None:
    """Compare height and frequency of resonance peaks.

    The changes relative to the first recording are printed with 95 % intervals.
    """
    from analysis.commands.presentation.comparison import present_compare

    with allow_overwriting(overwrite), count_progress("analyzing") as progress:
        _print_output(present_compare(files, output, progress))


@app.command(example="analysis fit sweep.mcap guess.yaml --free structure -o fitted.yaml", options="--free KEY")
def fit(
    files: Annotated[list[Path], "RECORDING...: Recordings of one structure, with or without dampers, at any level."],
    scene: SceneName,
    changes: Changes = None,
    *,
    free: list[str] | None,
    output: Annotated[Path, "FILE: Fitted scene to write; the figure of residuals is written next to it."] = Path(
        "fitted.yaml"
    ),
    overwrite: Annotated[bool, "Replace FILE if it exists."] = False,
) -> None:
    """Fit the values of a scene to recordings, with 95 % intervals."""
    from analysis.commands.presentation.fit_findings import present_fit

    files_written, warnings = present_fit(files, load_scene(scene, changes), free, output, overwrite, print)
    for warning in warnings:
        print(f"warning: {warning}", file=sys.stderr)
    report_written(*files_written)


@app.command(example="analysis report without.mcap with.mcap -o report.html")
def report(
    files: Reported,
    output: Annotated[
        Path | None, "DIR|FILE.html: Folder or page to write. Default: the folder of the first FILE."
    ] = None,
    note: Annotated[str | None, "TEXT: Text below the summary: date, operator, remarks."] = None,
    overwrite: Overwrite = False,
) -> None:
    """Write an interactive HTML page about recordings."""
    from analysis.commands.report_page.report import write_report

    with allow_overwriting(overwrite), count_progress("analyzing") as progress:
        _print_output(write_report(files, output, progress, note or ""))


@app.command(example="analysis demo -o recordings")
def demo(
    output: Annotated[Path, "DIR: Folder for the recordings and figures."] = Path("recordings"),
    overwrite: Overwrite = False,
) -> None:
    """Record and analyze tests of Inoue, Yokomichi, Hiraki (2011).

    Two stepped sines and two impact tests are recorded. Figs 8 and 10b of the paper are drawn from the recordings.
    """
    from analysis.commands.presentation.demo import demonstrate

    demonstrate(output, _print_line, overwrite=overwrite)


@app.command(
    example="analysis export sweep.mcap -o sweep.uff", options="--channel CHANNEL --from S --to S --speed X --what"
)
def export(
    file: Annotated[Path, "FILE: The recording."],
    output: Annotated[Path, "OUT: File to write: .uff, .mat, .csv, .npz or .wav."],
    *,
    channel: list[str] | None,
    from_s: float | None,
    to_s: float | None,
    speed: float,
    overwrite: Annotated[bool, "Replace OUT if it exists."] = False,
    what: str,
) -> None:
    """Export a recording as UFF, MATLAB, CSV, NPZ or WAV file."""
    from analysis.core.recordings.slices import Slice
    from analysis.extras.formats.export import expected_bytes, extension_of
    from analysis.extras.formats.export import export as export_segment
    from analysis.extras.formats.results import export_results
    from daq.core.recording.recording import open as open_recording

    if what != "samples":
        if channel or from_s is not None or to_s is not None or speed != 1.0:
            raise typer.BadParameter(
                "--channel, --from, --to and --speed apply to samples only. Omit these options, or omit --what."
            )
        with count_progress("analyzing") as progress:
            lines = export_results(file, output, what, overwrite, progress)
        print(*lines, sep="\n")
        return
    with open_recording(file) as recording:
        segment = Slice.of(recording, channel, from_s, to_s)
        n_bytes = expected_bytes(segment, extension_of(output))
        print(f"writing {output}: about {n_bytes / 1e6:.3g} MB", file=sys.stderr)
        with count_progress("exporting") as progress:
            lines = export_segment(segment, output, speed, overwrite, progress)
    for line in lines:
        print(line)
    report_written(output)


@app.command(example="analysis cost fig9", options="--frequency HZ")
def cost(
    scene: SceneName,
    changes: Changes = None,
    *,
    frequency: list[float] | None,
    output: Annotated[Path, "DIR: Folder for the figure and the table."] = Path(),
    overwrite: Overwrite = False,
) -> None:
    """Measure error and computing time of the measurement chain.

    One part of the chain is changed at a time.
    """
    from analysis.studies.cost.figure import output_files, table, write
    from analysis.studies.cost.study import chain_study
    from rig.core.base.output_files import prepare_outputs

    loaded_scene = load_scene(scene, changes)
    with allow_overwriting(overwrite):
        prepare_outputs(*output_files(loaded_scene, output))
        with count_progress("recording and analyzing") as progress:
            study = chain_study(loaded_scene, frequency, progress)
        files = write(study, output)
    print(table(study))
    report_written(*files)


@app.command(example="analysis paper -o paper")
def paper(
    output: Annotated[Path, "DIR: Folder for data, figures and the page."] = Path("recordings/paper"),
    fresh: Annotated[list[str] | None, "PART: Part to compute again, such as rec-fig9. May be repeated."] = None,
    cluster: Cluster = None,
    overwrite: Overwrite = False,
) -> None:
    """Reproduce the paper of Inoue, Yokomichi, Hiraki (2011).

    The figures are drawn, and each claim is checked. A repeated command computes only the missing parts.
    """
    from analysis.studies.paper.reproduce import reproduce

    with resumable(), allow_overwriting(overwrite):
        reproduce(output, _print_line, fresh or (), cluster)


@app.command(example="analysis beds --points 6")
def beds(
    output: Table = Path("recordings/beds.csv"),
    points: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Number of operating points to compute, spread over the study. Six points take minutes. Default: all.",
        ),
    ] = None,
    cluster: Cluster = None,
) -> None:
    """Compare beds of grains with the single-mass model.

    This checks claim C7 of the paper, that a bed moves as a single mass. All points take over half an hour.
    """
    from analysis.studies.paper.bed_study import follow

    with resumable():
        follow(output, points, _print_line, cluster)
    report_written(output)


@app.command(example="analysis contacts")
def contacts(output: Table = Path("recordings/contacts.csv"), cluster: Cluster = None) -> None:
    """Simulate the single-mass model on compliant walls.

    The operating points of `analysis beds` at 50 Hz are computed with several contact durations and restitutions. This
    takes minutes.
    """
    from analysis.studies.paper.contact_study import follow

    with resumable():
        follow(output, _print_line, cluster)
    report_written(output)


def _print_line(line: str) -> None:
    print(line, flush=True)


def _print_output(result: CommandOutput) -> None:
    for line in result.lines:
        print(line)
    for warning in result.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    report_written(*result.files)


def main() -> None:
    """Run the `analysis` command."""
    run_command("analysis.commands.cli")
