"""Arguments shared by several commands: scene, changes by `--set`, cluster, overwriting."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import typer

from rig.core.scene.scene_files import bundled_scenes

if TYPE_CHECKING:
    from rig.core.scene.scene import Scene

SCENE_HELP = "Name of a bundled scene (`rig scenes` lists them) or path of a scene file."


def completions(prefix: str) -> list[str]:
    """Return the names of bundled scenes with a prefix, for shell completion."""
    return [name for name in bundled_scenes() if name.startswith(prefix)]


SceneName = Annotated[str, typer.Argument(metavar="SCENE", help=SCENE_HELP, autocompletion=completions)]
SceneNames = Annotated[
    list[str],
    typer.Argument(
        metavar="SCENE", help=f"{SCENE_HELP} Several scenes are run one after another.", autocompletion=completions
    ),
]
Changes = Annotated[
    list[str] | None,
    "KEY=VALUE: Change a value of the scene, such as test.force=5N or dampers[2].clearance=0.5mm. Repeat the option to "
    "change several values. `rig help` lists the keys.",
]
Cluster = Annotated[
    str | None,
    "ADDRESS: Distribute the computation over the workers of a Dask scheduler at this address, such as "
    "tcp://host:8786. Default: use the cores of this computer.",
]
Overwrite = Annotated[bool, "Replace existing output files, even if they have been changed or come from another input."]


def load_scene(scene: str, changes: Sequence[str] | None) -> Scene:
    """Load the scene of a command and apply its changes; raise the errors of `rig.load`."""
    from rig.core.scene.loading import load_with_options

    return load_with_options(scene, changes or ())
