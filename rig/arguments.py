"""Arguments shared by several commands: scene, changes by `--set`, frequencies, cluster."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import typer

from rig.scene.scene_files import bundled_scenes

if TYPE_CHECKING:
    from rig.scene.scene import Scene

SCENE_HELP = "Name of a bundled scene (`rig scenes` lists them) or path of a scene file."


def completions(prefix: str) -> list[str]:
    """Return the names of bundled scenes with a prefix, for shell completion."""
    return [name for name in bundled_scenes() if name.startswith(prefix)]


SceneName = Annotated[str, typer.Argument(metavar="SCENE", help=SCENE_HELP, autocompletion=completions)]
SceneNames = Annotated[
    list[str],
    typer.Argument(
        metavar="SCENE", help=f"{SCENE_HELP} Several are run one after the other.", autocompletion=completions
    ),
]
Changes = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Change a value of the scene, such as test.force=5N or dampers[2].clearance=0.5mm. May be repeated. "
        "`rig help` lists the keys.",
    ),
]

# Upper limit for numbers of frequencies or periods, to reject typing errors.
MAX_COUNT = 100_000
First = Annotated[
    str | None, typer.Option("--from", metavar="F", help="Lowest frequency, such as '8 Hz'. Default: as in the test.")
]
Last = Annotated[str | None, typer.Option("--to", metavar="F", help="Highest frequency. Default: as in the test.")]
Points = Annotated[
    int | None,
    typer.Option(min=2, max=MAX_COUNT, metavar="N", help="Number of frequencies. Default: as in the test."),
]
Cluster = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS", help="Address of a Dask scheduler that distributes the computation; 'local' starts one."
    ),
]

Overwrite = Annotated[
    bool,
    typer.Option("--overwrite", help="Also replace files that were not written by this command from the same input."),
]


def load_scene(scene: str, changes: Sequence[str] | None) -> Scene:
    """Load the scene of a command and apply its changes.

    Raises the errors of `rig.load`.
    """
    from rig.scene.loading import load_with_options

    return load_with_options(scene, changes or ())
