"""The `rig` command line."""

from __future__ import annotations

from typing import Annotated

import typer

from rig.command import application, run

app = application("The physics of the virtual vibration rig.")

SceneName = Annotated[
    str,
    typer.Argument(metavar="SCENE", help="A bundled scene (see: rig scenes) or the path of a scene file."),
]


@app.command()
def scenes() -> None:
    """List the bundled scenes."""
    from rich.console import Console
    from rich.table import Table

    from rig.scene_file import bundled, summary

    console = Console()
    if not console.is_terminal:
        # A pipe gets one scene to a line, whatever the width of the terminal it may end in.
        for name in bundled():
            print(f"{name}\t{summary(name)}")
        return
    table = Table("scene", "what it is", box=None, pad_edge=False)
    for name in bundled():
        table.add_row(name, summary(name))
    console.print(table)


@app.command()
def schema() -> None:
    """Print the JSON Schema of scene files, for editors."""
    from rig.scene_schema import schema_text

    print(schema_text(), end="")


def main() -> None:
    """Run the `rig` command."""
    run(app)
