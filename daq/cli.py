"""The `daq` command line."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rig.command import application, run

app = application("The instrument: record, look at, repair and replay tests.")

SceneName = Annotated[
    str,
    typer.Argument(metavar="SCENE", help="A bundled scene (see: rig scenes) or the path of a scene file."),
]


@app.command()
def record(
    scene: SceneName,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", metavar="FILE", help="Recording to write (default: recordings/SCENE.mcap)."
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the file if it exists.")] = False,
    block: Annotated[
        int | None,
        typer.Option(metavar="N", help="Most samples to acquire at a time; the recording stays the same."),
    ] = None,
) -> None:
    """Run the test of a scene and record it."""
    from daq.run_report import record_and_report

    path = output if output is not None else Path("recordings") / f"{Path(scene).stem}.mcap"
    raise typer.Exit(record_and_report(scene, path, overwrite, block))


@app.command()
def replay(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The recording.")],
    save: Annotated[
        Path | None, typer.Option(metavar="FILE.rrd", help="Write a file for the viewer, open no window.")
    ] = None,
    web: Annotated[bool, typer.Option("--web", help="Serve it to browsers on this machine.")] = False,
    screenshot: Annotated[
        Path | None, typer.Option(metavar="FILE.png", help="Draw a picture; needs no display.")
    ] = None,
    at: Annotated[
        float | None,
        typer.Option(metavar="S", help="Time of the picture (default: where the dampers fly highest)."),
    ] = None,
    start: Annotated[float | None, typer.Option("--from", metavar="S", help="Begin at this time.")] = None,
    stop: Annotated[float | None, typer.Option("--to", metavar="S", help="End at this time.")] = None,
    speed: Annotated[float, typer.Option(metavar="X", help="Playback speed; 0.1 is slow motion.")] = 1.0,
) -> None:
    """Look at a recording: the rig in motion, channels, dampers, test marks."""
    from daq.show import show

    show(file, (start, stop), speed, save=save, screenshot=screenshot, at_s=at, web=web)


def main() -> None:
    """Run the `daq` command."""
    run(app)
